"""The magnetic field around simulated inertial sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.trajectories import minimum_jerk

_DIPOLE = 1e-7
"""T m / A: mu0 / (4 pi)."""


@dataclass(frozen=True, slots=True, eq=False)
class Iron:
    """A body of iron, as a magnetic dipole.

    Attributes:
        position: (3,) metres in world.
        moment: (3,) A m2 in world.
        radius: metres; inside, the field is as on the surface.
        since, until: seconds of its presence; it fades in and out within half a second before and after.
    """

    position: FloatArray
    moment: FloatArray
    radius: float = 0.05
    since: float = -np.inf
    until: float = np.inf

    def field(self, points: FloatArray, times: FloatArray) -> FloatArray:
        """(n, 3) tesla in world at points (n, 3) and times (n,): Jackson eq. 5.56, without the field inside."""
        away = points - self.position
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        direction = away / np.maximum(distance, 1e-9)
        along = direction @ self.moment
        there = minimum_jerk((times - self.since) / 0.5 + 1.0) * minimum_jerk((self.until - times) / 0.5 + 1.0)
        strength = _DIPOLE * there[:, None] / np.maximum(distance, self.radius) ** 3
        result: FloatArray = strength * (3.0 * along[:, None] * direction - self.moment)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """The magnetic field of a place.

    Attributes:
        strength: tesla, of the earth's magnetic field.
        dip: radians by which it points below the horizon.
        north: radians from world's x, counter-clockwise, to magnetic north; at a quarter turn world is east-north-up.
        iron: disturbances of the field.
    """

    strength: float = 48e-6
    dip: float = float(np.radians(64.0))
    north: float = 0.5 * np.pi
    iron: tuple[Iron, ...] = ()

    @property
    def earth(self) -> FloatArray:
        """(3,) tesla in world: the earth's field."""
        level, down = np.cos(self.dip), np.sin(self.dip)
        return self.strength * np.array([level * np.cos(self.north), level * np.sin(self.north), -down])

    def field(self, points: FloatArray, times: FloatArray) -> FloatArray:
        """(n, 3) tesla in world at points (n, 3) and times (n,)."""
        result: FloatArray = np.tile(self.earth, (len(points), 1))
        for iron in self.iron:
            result += iron.field(points, times)
        return result
