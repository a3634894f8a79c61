"""A mapping of two joints, to be changed."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from body_tracking.core.joint_angles import JointAngles
from body_tracking.robot.mapping import RobotMapping, parse

ANGLES = {"positional": ("shoulder_elevation_left", "shoulder_plane_left", "elbow_flexion_left"), "isb": ("neck",)}
CONTENT: dict[str, Any] = {
    "robot": "small",
    "convention": "positional",
    "output": {"kind": "joint_trajectory", "topic": "/arm/joint_trajectory", "order": ["shoulder", "elbow"]},
    "joints": [
        {
            "name": "shoulder",
            "angle": "shoulder_elevation_left",
            "lower": -1.0,
            "upper": 2.5,
            "rate": 2.0,
            "acceleration": 20.0,
            "home": 0.0,
        },
        {"name": "elbow", "angle": "elbow_flexion_left", "lower": 0.0, "upper": 2.0, "rate": 3.0, "home": 0.1},
    ],
    "safety": {"calibration": False, "max_stddev": 0.4},
}


def content(**safety: Any) -> dict[str, Any]:
    """The content of a mapping file, with other thresholds."""
    made = copy.deepcopy(CONTENT)
    made["safety"] |= safety
    return made


def mapping(made: dict[str, Any] | None = None) -> RobotMapping:
    """A mapping with this content."""
    return parse(content() if made is None else made, ANGLES)


def seen(
    stamp_ns: int,
    position: list[float],
    velocity: list[float] | None = None,
    stddev: list[float] | None = None,
    velocity_stddev: float = 0.2,
) -> JointAngles:
    """The three angles of a message."""
    n = len(ANGLES["positional"])
    return JointAngles(
        stamp_ns,
        ANGLES["positional"],
        np.array(position),
        np.array(velocity if velocity is not None else [0.0] * n),
        np.array(stddev if stddev is not None else [0.1] * n),
        np.full(n, velocity_stddev),
    )
