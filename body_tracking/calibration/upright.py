"""How a sensor is tilted, from a person who stands still.

Who stands still on straight legs has the top of the spine above the ankles. The reference of nine real pairs of
Kinects, which were mounted level, shows it within 2 degrees of there, the other sensor within 4.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from body_tracking.calibration.still_pose import average, is_still
from body_tracking.core.skeleton import FloatArray, IntArray, Joint

_LEGS: tuple[IntArray, ...] = tuple(
    np.array([Joint[f"{name}_{side}"] for name in ("HIP", "KNEE", "ANKLE")], dtype=np.intp)
    for side in ("LEFT", "RIGHT")
)
_MOST_BEND = math.radians(30.0)
"""Most bend of a straight knee, which a Kinect shows bent by up to 15 degrees where the legs are not hidden."""
_MOST_FLEXION = math.radians(20.0)
"""Most angle between trunk and legs of a person who stands upright."""
_MOST_TILT = math.radians(6.0)
"""Tilt from which it is reported."""
_KEPT, _LEAST = 9, 3
"""Poses of which the median is taken, at most and at least."""


def standing_axis(stamps: FloatArray, positions: FloatArray, states: np.ndarray) -> FloatArray | None:
    """(3,) unit vector from the middle of the ankles to the top of the spine; None if nobody stands still and straight.

    Args:
        stamps: (n,) seconds.
        positions: (n, 25, 3) metres in any fixed frame; NaN where unknown.
        states: (n, 25) tracking states.
    """
    if not is_still(stamps, positions):
        return None
    pose, known = average(positions, states)
    if not (known[Joint.SPINE_SHOULDER] and all(known[leg].all() for leg in _LEGS)):
        return None
    hips, ankles = (0.5 * (pose[_LEGS[0][end]] + pose[_LEGS[1][end]]) for end in (0, 2))
    top = pose[Joint.SPINE_SHOULDER]
    if any(_angle(pose[knee] - pose[hip], pose[ankle] - pose[knee]) > _MOST_BEND for hip, knee, ankle in _LEGS):
        return None
    if _angle(top - hips, hips - ankles) > _MOST_FLEXION:
        return None
    axis: FloatArray = (top - ankles) / np.linalg.norm(top - ankles)
    return axis


def _angle(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


class Tilt:
    """The tilt of one sensor, as the median over some still poses."""

    def __init__(self) -> None:
        self._axes: deque[FloatArray] = deque(maxlen=_KEPT)

    def add(self, stamps: FloatArray, positions: FloatArray, states: np.ndarray) -> None:
        """Take some frames in the sensor's optical frame; see :func:`standing_axis`."""
        axis = standing_axis(stamps, positions, states)
        if axis is not None:
            self._axes.append(axis)

    def problem(self, sensor: str, base: FloatArray) -> str:
        """What to set if the sensor is not as level as it is said to be; empty if it is, or is not known yet.

        Args:
            sensor: its name.
            base: (3, 3) rotation of its optical frame in ``world``.
        """
        if len(self._axes) < _LEAST:
            return ""
        axis = np.median(self._axes, axis=0)
        tilt = _angle(base @ axis, np.array([0.0, 0.0, 1.0]))
        if tilt < _MOST_TILT:
            return ""
        pitch, roll = levelling(axis)
        return (
            f"people stand tilted by {math.degrees(tilt):.0f} deg in world: if {sensor} is not level, set "
            f"reference_pitch to {pitch:.2f} and reference_roll to {roll:.2f}"
        )


def levelling(axis: FloatArray) -> tuple[float, float]:
    """Pitch and roll, radians, with which ``level_pose`` puts a (3,) vector of the optical frame upright."""
    across, down, along = axis.tolist()
    return -math.atan2(along, math.hypot(across, down)), math.atan2(-across, -down)
