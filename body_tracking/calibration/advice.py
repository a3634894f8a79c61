"""The quality of a calibration and the next step in words, for the viewer's page and ``body_tracking calibrate``."""

from __future__ import annotations

import math
from typing import Final

from body_tracking.messages.node_status import NodeStatus

WAITING: Final = "waiting for a still pose"
ROUGH: Final = "roughly calibrated, walk about to refine"
APART: Final = "do not see the same pose"
SEVERAL: Final = "several people are in view"
_NEXT: Final = {
    SEVERAL: "leave one person in view until the sensors are calibrated: each sensor may follow another one",
    WAITING: "hold a T-pose (arms straight, level and sideways) for four seconds where all sensors see you",
    ROUGH: "walk about and turn where all sensors see you",
    APART: "be alone in view, and turn your front to each sensor: one sees another person, or takes back for front",
}
"""By a part of the text of the status."""


def quality(status: NodeStatus) -> str:
    """The standard deviations of each sensor's pose, from the values of ``OnlineCalibration.status``."""
    known = []
    for key in status.values:
        if key.endswith(" rotation_stddev_deg"):
            sensor = key.removesuffix(" rotation_stddev_deg")
            degrees, millimetres = status.number(key), status.number(f"{sensor} translation_stddev_mm")
            if degrees is None or millimetres is None or not math.isfinite(degrees + millimetres):
                known.append(f"{sensor} not estimated from movement")
            else:
                known.append(f"{sensor} to {degrees:.1f} degrees and {millimetres:.0f} mm")
    return ", ".join(known)


def next_step(status: NodeStatus) -> str:
    """What the person should do until the calibration is good; empty where nothing is to be done."""
    return next((step for part, step in _NEXT.items() if part in status.text), "") if status.level else ""
