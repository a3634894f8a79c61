"""Two sensors that see a person walk, with their poses and clocks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from walkers import OPTICAL_FROM_LEVEL, about_y, walk

FRAME = 1 / 30
OFFSET = 0.4
"""Seconds by which the second sensor's clock is ahead."""
OFFSET_NS = round(OFFSET * NANOSECONDS)
POSES = {
    "kinect1": level_pose("kinect1"),
    "kinect2": SensorPose(
        "kinect2",
        OPTICAL_FROM_LEVEL.T @ np.array([2.0, 0.0, 1.4]),
        Rotation.from_matrix(OPTICAL_FROM_LEVEL.T @ about_y(-60.0)).as_quat(),
    ),
}


def truth(times: FloatArray) -> FloatArray:
    """(n, 25, 3) the walk in world."""
    return walk(times) @ OPTICAL_FROM_LEVEL
