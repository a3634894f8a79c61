"""One measured orientation of one segment of the body: what inertial sensors say once they are aligned.

The counterpart of ``skeleton.py`` for sources that know how a segment is turned and not where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray

SEGMENT_NUMBER: Final = {name: number for number, name in enumerate(SEGMENTS)}
"""Of each segment its place in :data:`~body_tracking.core.body_model.SEGMENTS`."""

MAX_RATE: Final = 70.0
"""Radians per second: a gyroscope's greatest range is 4000 deg/s; beyond is no measurement but a damaged number."""
_ORTHOGONAL = 1e-6
_EYE3 = np.eye(3)


class OrientationError(BodyTrackingError):
    """Something that should be the orientation of a segment is not one."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentOrientation:
    """How a segment was turned at one instant, as its sensor has it.

    Attributes:
        stamp_ns: capture time in nanoseconds, in the reference clock.
        source: name of the inertial sensor.
        segment: on which it sits, one of ``upper_body.SEGMENTS``.
        rotation: (3, 3) the segment's vectors to ``frame_id``.
        covariance: (3, 3) rad2 about the axes of ``frame_id``, positive definite: of all that is wrong with
            the orientation, not only of what changes from one sample to the next.
        angular_velocity: (3,) rad/s of the segment about its own axes, or None.
        angular_velocity_variance: rad2/s2 per axis; of no meaning without the former.
        frame_id: a fixed frame with z up.

    Raises:
        OrientationError: not finite, no rotation, no covariance, an unknown segment.
    """

    stamp_ns: int
    source: str
    segment: str
    rotation: FloatArray
    covariance: FloatArray
    angular_velocity: FloatArray | None = None
    angular_velocity_variance: float = 0.0
    frame_id: str = "world"

    def __post_init__(self) -> None:
        if self.segment not in SEGMENT_NUMBER:
            raise self._error(f"segment {self.segment!r}, expected one of {', '.join(SEGMENTS)}")
        for name in ("rotation", "covariance"):
            value: FloatArray = getattr(self, name)
            if value.shape != (3, 3):
                raise self._error(f"{name} of shape {value.shape}, expected (3, 3)")
            if not np.isfinite(value).all():
                raise self._error(f"{name} is not finite")
        rotation = self.rotation
        if np.abs(rotation @ rotation.T - _EYE3).max() > _ORTHOGONAL or np.linalg.det(rotation) < 0.0:
            raise self._error("rotation is no rotation matrix")
        covariance = self.covariance
        if np.abs(covariance - covariance.T).max() > _ORTHOGONAL * covariance.trace():
            raise self._error("covariance is not symmetric")
        if not np.linalg.eigvalsh(covariance)[0] > 0.0:
            raise self._error("covariance is not positive definite")
        if self.angular_velocity is not None:
            if self.angular_velocity.shape != (3,):
                raise self._error(f"angular velocity of shape {self.angular_velocity.shape}, expected (3,)")
            if not (np.abs(self.angular_velocity) <= MAX_RATE).all():
                raise self._error(f"angular velocity {self.angular_velocity} rad/s, expected at most {MAX_RATE:g}")
            if not 0.0 < self.angular_velocity_variance < np.inf:
                raise self._error(f"variance of the angular velocity of {self.angular_velocity_variance}")

    def _error(self, text: str) -> OrientationError:
        return OrientationError(f"orientation by {self.source!r} at {self.stamp_ns} ns: {text}")
