"""Motion of joints toward a target that may jump, within limits of position, rate and acceleration."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray


class Limiter:
    """Moves n joints, one step of time after the other; the steps need not be equal.

    In a step of ``dt`` a joint moves by ``v dt``. Without a limit of acceleration ``v`` is what is needed, up to the
    rate. With one, ``v`` changes by at most ``a dt``, and is kept so low that the joint can still come to rest before
    its target: a joint that moves by ``v dt`` and then slows down, in steps however long, goes no further than
    ``v dt + v^2 / 2a``; that must be no more than the distance ``d``, so ``v <= a (sqrt(dt^2 + 2 d / a) - dt)``. Where
    the target has come closer than that, the joint overshoots it, but not a limit: from where it could rest before the
    limit it still can after slowing down for one more step.

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
        """Stand at (n,) radians, or at the limit that they are beyond."""
        self.position: FloatArray = np.clip(position, self._lower, self._upper)
        self.velocity: FloatArray = np.zeros_like(position)

    def step(self, target: FloatArray, dt: float, share: FloatArray | float = 1.0) -> FloatArray:
        """Go on for some time.

        Args:
            target: (n,) radians; a target beyond a limit is taken for the limit.
            dt: seconds, at least 0.
            share: of the rates that may be used, 0 to 1, per joint; a joint that is faster slows down as it may.

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
        # rounding alone: what was clipped is no more than that
        self.velocity, self.position = (moved - self.position) / dt, moved
        return self.position

    def brake(self, dt: float) -> FloatArray:
        """Come to rest, as fast as the acceleration allows; (n,) the new positions."""
        return self.step(self.position, dt, 0.0)

    def _toward(self, away: FloatArray, dt: float) -> FloatArray:
        """(n,) velocities that get there, or as near as a joint may get that must be able to rest there."""
        straight = away / dt
        limited = np.isfinite(self._acceleration)
        if not limited.any():
            return straight
        a = np.where(limited, self._acceleration, 1.0)
        careful = a * (np.sqrt(dt * dt + 2.0 * np.abs(away) / a) - dt)
        return np.where(limited, np.copysign(careful, away), straight)
