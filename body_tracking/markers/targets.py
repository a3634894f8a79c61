"""A target: a rigid arrangement of balls."""

from __future__ import annotations

from dataclasses import dataclass

from body_tracking.core.skeleton import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A rigid body with balls.

    Attributes:
        name: of the target.
        points: (k, 3) centres of the balls in the target's frame, metres.
        covariance: (3k, 3k) of the points, square metres; zeros for an exactly known geometry.
        diameter: of the balls, metres.
    """

    name: str
    points: FloatArray
    covariance: FloatArray
    diameter: float = 0.0
