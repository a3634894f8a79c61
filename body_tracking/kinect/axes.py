"""Kinect v2 camera space to the optical frame.

Camera space (Kinect for Windows SDK 2.0, ``CameraSpacePoint``): metres, x to the sensor's left, y up, z forward.
Optical frame (REP-103): x to the right, y down, z forward. Both are right-handed; they differ by half a turn about z.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray

_SIGNS = np.array([-1.0, -1.0, 1.0])


def camera_space_to_optical(points: FloatArray) -> FloatArray:
    """(..., 3) metres in Kinect camera space into the sensor's optical frame; its own inverse."""
    # 0.0 is added so that a coordinate of 0 does not become -0.
    converted: FloatArray = points * _SIGNS + 0.0
    return converted
