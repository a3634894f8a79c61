"""Inertial sensors without errors."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from body_tracking.inertial.simulated_errors import CONSUMER, ImuErrors

IDEAL = replace(
    CONSUMER,
    **{
        item.name: np.inf if item.name.endswith("_range") else 0.0
        for item in fields(ImuErrors)
        if item.name.startswith(("gyro", "acc", "mag", "driver", "stated"))
        or item.name in ("misalignment", "tissue_sag", "twist_share", "jitter", "stamp_jitter")
        or item.name in ("lost", "outages", "delay", "delay_jitter")
    },
    packet=1,
)
"""No errors; acceleration and iron still affect a driver's fusion."""
