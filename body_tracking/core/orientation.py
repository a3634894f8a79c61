"""One measured orientation of one segment of the body, as an aligned inertial sensor gives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.skeleton import FloatArray

SEGMENT_NUMBER: Final = {name: number for number, name in enumerate(SEGMENTS)}
"""Index of each segment in :data:`~body_tracking.core.body_model.SEGMENTS`."""

MAX_RATE: Final = 70.0
"""rad/s; the widest range of a gyroscope is 4000 deg/s, a larger number is corrupt."""
_ORTHOGONAL = 1e-6
_EYE3 = np.eye(3)


class OrientationError(BodyTrackingError):
    """Not a valid orientation of a segment."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentOrientation:
    """The orientation of a segment at one instant, as its sensor measured it.

    Attributes:
        stamp_ns: capture time in nanoseconds, in the reference clock.
        source: name of the inertial sensor.
        segment: that carries it, one of ``SEGMENTS``.
        rotation: (3, 3) the segment's vectors to ``frame_id``.
        covariance: (3, 3) rad2 about the axes of ``frame_id``, positive definite; of the total error, not only of the
            white noise.
        angular_velocity: (3,) rad/s of the segment about its own axes, or None.
        angular_velocity_variance: rad2/s2 per axis; meaningless without the angular velocity.
        frame_id: a fixed frame with z up.

    Raises:
        OrientationError: not finite, an invalid rotation or covariance, an unknown segment.
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
            raise self._error(f"segment {self.segment!r}, {one_of(self.segment, SEGMENTS)}")
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
