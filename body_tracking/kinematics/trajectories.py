"""Smooth functions of time for synthetic motion: minimum-jerk moves and slow waves.

Both are closed functions of time; the caller seeds the random generator.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray

WAVE_BAND = (0.05, 0.8)
"""Hertz: lowest and highest frequency of a person's waves."""
_WAVES = 3


def minimum_jerk(share: FloatArray) -> FloatArray:
    """0 before 0, 1 after 1, minimum-jerk between (Flash and Hogan 1985)."""
    x = np.clip(share, 0.0, 1.0)
    result: FloatArray = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    return result


def eased(time: FloatArray, way: float, ramp: float) -> FloatArray:
    """From 0 to ``way`` at a rate of 1, with ramps of ``ramp`` seconds from and to rest.

    The rate is minimum-jerk in the ramps, so that the third derivative is continuous. It takes ``way + ramp`` seconds.
    """

    def up(share: FloatArray) -> FloatArray:  # the integral of minimum_jerk
        x = np.clip(share, 0.0, 1.0)
        result: FloatArray = x**4 * (2.5 - 3.0 * x + x**2) + np.maximum(share - 1.0, 0.0)
        return result

    result: FloatArray = ramp * (up(time / ramp) - up((time - way) / ramp))
    return result


class Moves:
    """Successive minimum-jerk moves from target to target, with rests between.

    ``half`` (d,) is the factor from positions to radians, ``rate`` the greatest rate of the moves in rad/s.
    """

    def __init__(self, start: FloatArray, half: FloatArray | float = 1.0, rate: float = 1.0) -> None:
        self.half, self.rate = half, rate
        self._begins: list[float] = []
        self._durations: list[float] = []
        self._targets = [start]

    @property
    def target(self) -> FloatArray:
        """(d,) the position after the last move."""
        return self._targets[-1]

    @property
    def end(self) -> float:
        """Seconds: the end of the last move; minus infinity without moves."""
        return self._begins[-1] + self._durations[-1] if self._begins else -np.inf

    def move(self, begin: float, duration: float, target: FloatArray) -> None:
        """Append a move; no sooner than the last one ends."""
        self._begins.append(max(begin, self.end))
        self._durations.append(duration)
        self._targets.append(target)

    def at(self, times: FloatArray) -> FloatArray:
        """(n, d) at (n,) seconds."""
        result: FloatArray = np.tile(self._targets[0], (len(times), 1))
        if self._begins:
            share = minimum_jerk((times[:, None] - np.array(self._begins)) / np.array(self._durations))
            result += share @ np.diff(np.array(self._targets), axis=0)
        return result


class Waves:
    """(d,) sums of sinusoids that stay between -1 and 1."""

    def __init__(self, rng: np.random.Generator, size: int, fastest: float) -> None:
        low, high = WAVE_BAND[0], max(fastest, 2.0 * WAVE_BAND[0])
        self._rates = 2.0 * np.pi * low * (high / low) ** rng.random((size, _WAVES))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, (size, _WAVES))
        amplitudes = rng.uniform(0.2, 1.0, (size, _WAVES))
        self._amplitudes = amplitudes / amplitudes.sum(axis=1, keepdims=True)

    def at(self, times: FloatArray) -> FloatArray:
        """(n, d) at (n,) seconds."""
        waves = np.sin(times[:, None, None] * self._rates + self._phases)
        result: FloatArray = (self._amplitudes * waves).sum(axis=2)
        return result
