"""Arrangements of sensors around a person: the nine layouts of the dual-Kinect thesis, and arbitrary ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.so3 import wrapped

DISTANCE: Final = 2.0
"""Metres from the person to the sensors (thesis 5.2.2)."""
HEIGHT: Final = 1.0
"""Height of the sensors above the floor, metres: at 2 m, feet and raised hands are both in view."""
_WIDTH: Final = 0.249
"""Width of a Kinect v2's case, metres; limits how close two sensors stand."""
_GAMMA: Final = {1: 0.0, 2: 15.0, 3: 30.0, 4: 45.0, 5: 60.0, 6: 75.0}
_DELTA: Final = {7: 30.0, 8: 60.0, 9: 90.0}
NUMBERS: Final = (*_GAMMA, *_DELTA)
"""The layouts of Schlagenhauf 2017, table 5.1."""


class LayoutError(BodyTrackingError):
    """Raised for an unknown or impossible layout."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Sensors around a person, in ``world``: the first sensor at its origin, looking along x.

    Attributes:
        poses: of the sensors, the reference first.
        position: (3,) metres, the point on the floor between the person's feet.
        yaw: heading of the person about z, radians; 0 faces along x.
    """

    poses: tuple[SensorPose, ...]
    position: FloatArray
    yaw: float


def layout(number: int) -> Layout:
    """One of the nine layouts of Schlagenhauf 2017, table 5.1 and figures 5.2-5.3, with ``kinect1`` and ``kinect2``.

    In 1 to 6 both stand at the angle gamma from the front, the first to the person's left, the second to the right; in
    7 to 9 the first stands in front and the second at the angle delta to the person's right. In 1 they stand side by
    side.

    Raises:
        LayoutError: an unknown number.
    """
    if number in _GAMMA:
        gamma = max(np.radians(_GAMMA[number]), np.arcsin(0.5 * _WIDTH / DISTANCE))
        return around((gamma, -gamma))
    if number in _DELTA:
        return around((0.0, -np.radians(_DELTA[number])))
    raise LayoutError(f"layout {number}: expected {NUMBERS[0]} to {NUMBERS[-1]}")


def around(
    azimuths: Sequence[float],
    distances: float | Sequence[float] = DISTANCE,
    heights: float | Sequence[float] = HEIGHT,
) -> Layout:
    """Sensors around a person, all facing the person.

    Args:
        azimuths: radians from the person's front to each sensor, positive to the person's left.
        distances: horizontal, metres, one for all or one each, greater than zero.
        heights: metres above the floor.

    Raises:
        LayoutError: no sensor, or azimuths that are not finite.
    """
    count = len(azimuths)
    if count == 0:
        raise LayoutError("layout: no sensor")
    azimuth, distance, height = (
        np.broadcast_to(np.asarray(values, dtype=np.float64), (count,)) for values in (azimuths, distances, heights)
    )
    if not np.isfinite(azimuth).all():
        raise LayoutError(f"layout: azimuths {np.degrees(azimuth).round(3).tolist()} degrees, expected finite numbers")
    # the first sensor looks along x at the person; the person's yaw puts the sensor at its azimuth
    yaw = np.pi - azimuth[0]
    position = np.array([distance[0], 0.0, -height[0]])
    directions = yaw + azimuth
    offsets = np.stack([distance * np.cos(directions), distance * np.sin(directions), height], axis=1)
    level = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    poses = []
    for number, (offset, direction) in enumerate(zip(offsets, directions, strict=True)):
        turn = Rotation.from_euler("Z", direction + np.pi) * level
        poses.append(SensorPose(f"kinect{number + 1}", position + offset, turn.as_quat()))
    return Layout(tuple(poses), position, float(wrapped(yaw)))
