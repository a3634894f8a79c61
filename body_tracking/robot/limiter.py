"""Motion of joints towards a target that may jump, within limits of position, rate and acceleration."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray


class Limiter:
    """Moves n joints in time steps of any length.

    In a step of ``dt`` a joint moves by ``v dt``. Without a limit of acceleration, ``v`` takes the joint to its target,
    up to the rate. With one, ``v`` changes by at most ``a dt``, and is kept so low that the joint can still stop at its
    target: a joint that moves by ``v dt`` and then slows down goes no further than ``v dt + v^2 / 2a``, which must not
    exceed the distance ``d``, so ``v <= a (sqrt(dt^2 + 2 d / a) - dt)``. Where the target came closer than that, the
    joint overshoots it, but never a limit: a joint that could stop before the limit still can after braking for one
    more step.

    Args:
        lower, upper: (n,) radians.
        rate: (n,) rad/s.
        acceleration: (n,) rad/s^2, infinite for no limit.
        position: (n,) radians, within the limits.

    Attributes:
        position: (n,) radians.
        velocity: (n,) rad/s of the last step.
    """

    def __init__(
        self, lower: FloatArray, upper: FloatArray, rate: FloatArray, acceleration: FloatArray, position: FloatArray
    ) -> None:
        self._lower, self._upper, self._rate, self._acceleration = lower, upper, rate, acceleration
        self.reset(position)

    def reset(self, position: FloatArray) -> None:
        """Stand still at (n,) radians, clipped to the limits."""
        self.position: FloatArray = np.clip(position, self._lower, self._upper)
        self.velocity: FloatArray = np.zeros_like(position)

    def step(self, target: FloatArray, dt: float, share: FloatArray | float = 1.0) -> FloatArray:
        """Move towards the target.

        Args:
            target: (n,) radians, clipped to the limits.
            dt: seconds, at least 0.
            share: usable part of the rates, 0 to 1, per joint; a faster joint slows down within its acceleration.

        Returns:
            (n,) the new positions.
        """
        if dt <= 0.0:
            return self.position
        away = np.clip(target, self._lower, self._upper) - self.position
        wanted = np.clip(self._toward(away, dt), -self._rate * share, self._rate * share)
        change = self._acceleration * dt
        speeds = np.clip(wanted, self.velocity - change, self.velocity + change)
        moved = np.clip(self.position + speeds * dt, self._lower, self._upper)
        self.velocity, self.position = (moved - self.position) / dt, moved  # the last clip removes rounding only
        return self.position

    def brake(self, dt: float) -> FloatArray:
        """Brake as hard as the acceleration allows; (n,) the new positions."""
        return self.step(self.position, dt, 0.0)

    def _toward(self, away: FloatArray, dt: float) -> FloatArray:
        """(n,) velocities that cover the distance ``away``, or as much of it as leaves room to stop."""
        straight = away / dt
        limited = np.isfinite(self._acceleration)
        if not limited.any():
            return straight
        a = np.where(limited, self._acceleration, 1.0)
        careful = a * (np.sqrt(dt * dt + 2.0 * np.abs(away) / a) - dt)
        return np.where(limited, np.copysign(careful, away), straight)
