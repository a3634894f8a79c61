"""Offset and drift between clocks, the least delay of messages, and backward jumps of time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, FloatArray

JUMP_BACK_NS = NANOSECONDS
"""A stamp that is earlier than its predecessor by more than this is a backward jump of time (a loop, another recording,
a clock that was set), not a late frame."""


def jumped_back(stamp_ns: int, last_ns: int | None) -> bool:
    """Whether a stamp is a backward jump of time after the last one, if there is one."""
    return last_ns is not None and stamp_ns < last_ns - JUMP_BACK_NS


@dataclass(frozen=True, slots=True)
class ClockModel:
    """A sensor's clock against a reference clock, and how well it is known.

    ``sensor = reference + offset + drift * (reference - anchor)``; two sensors that count from their own start have an
    offset of seconds and a drift of some tens of parts per million.

    Attributes:
        offset_ns: sensor clock minus reference clock at the anchor, nanoseconds.
        drift_ppm: relative rate by which the sensor's clock is fast, parts per million.
        anchor_ns: reference time at which the offset holds exactly, and at which the errors of offset and drift are
            uncorrelated.
        stddev: of the offset at the anchor, seconds; infinity while unknown.
        drift_stddev_ppm: of the drift, parts per million; infinity while unknown.
    """

    offset_ns: int = 0
    drift_ppm: float = 0.0
    anchor_ns: int = 0
    stddev: float = float("inf")
    drift_stddev_ppm: float = float("inf")

    @property
    def offset(self) -> float:
        """The offset at the anchor in seconds."""
        return self.offset_ns / NANOSECONDS

    def offset_ns_at(self, reference_ns: int) -> int:
        """The offset at a reference time, nanoseconds."""
        return self.offset_ns + round(self.drift_ppm * 1e-6 * (reference_ns - self.anchor_ns))

    def stddev_at(self, reference_ns: int) -> float:
        """Standard deviation of the offset at a reference time, seconds."""
        elapsed = (reference_ns - self.anchor_ns) / NANOSECONDS
        return float(np.hypot(self.stddev, 1e-6 * self.drift_stddev_ppm * elapsed)) if elapsed else self.stddev

    def to_sensor(self, reference_ns: int) -> int:
        """Reference time to the sensor's time."""
        return reference_ns + self.offset_ns_at(reference_ns)

    def to_reference(self, sensor_ns: int) -> int:
        """The sensor's time to reference time; the inverse of :meth:`to_sensor` to a nanosecond."""
        # Integer arithmetic except for the small drift: a float cannot hold nanoseconds since 1970.
        elapsed = sensor_ns - self.offset_ns - self.anchor_ns
        drift = self.drift_ppm * 1e-6
        return self.anchor_ns + elapsed - round(elapsed * (drift / (1.0 + drift)))

    def carried_to(self, reference_ns: int, wander_ppm: float = 0.0) -> ClockModel:
        """The clock anchored at another time; ``wander_ppm`` is the standard deviation of the drift's change."""
        drift_stddev_ppm = float(np.hypot(self.drift_stddev_ppm, wander_ppm))
        stddev = ClockModel(anchor_ns=self.anchor_ns, stddev=self.stddev, drift_stddev_ppm=drift_stddev_ppm)
        return ClockModel(
            self.offset_ns_at(reference_ns),
            self.drift_ppm,
            reference_ns,
            stddev.stddev_at(reference_ns),
            drift_stddev_ppm,
        )

    def minus(self, base: ClockModel) -> ClockModel:
        """Offset and drift minus those of another clock, which is taken to be exact."""
        return self._with(self.offset_ns - base.offset_ns_at(self.anchor_ns), self.drift_ppm - base.drift_ppm)

    def plus(self, base: ClockModel) -> ClockModel:
        """The inverse of :meth:`minus`."""
        return self._with(self.offset_ns + base.offset_ns_at(self.anchor_ns), self.drift_ppm + base.drift_ppm)

    def _with(self, offset_ns: int, drift_ppm: float) -> ClockModel:
        return ClockModel(offset_ns, drift_ppm, self.anchor_ns, self.stddev, self.drift_stddev_ppm)


def line_information(times: FloatArray, weights: FloatArray) -> FloatArray:
    """(2, 2) information of offsets at times (n,) on ``offset + drift * time``; weights (n,) are inverse variances."""
    once, twice = float(weights @ times), float(weights @ times**2)
    return np.array([[float(weights.sum()), once], [once, twice]])


def clock_of_line(line: FloatArray, information: FloatArray, zero_ns: int, floor: float = 0.0) -> ClockModel:
    """The clock of a fitted line, anchored where the errors of offset and drift are uncorrelated.

    Args:
        line: (2,) offset in seconds at the zero of time, and drift.
        information: (2, 2) inverse of its covariance, the drift's prior included.
        zero_ns: reference time of the line's zero.
        floor: seconds, added in quadrature to the offset's standard deviation.
    """
    (variance, both), (_, drift_variance) = np.linalg.inv(information)
    at = -both / drift_variance
    stddev = float(np.sqrt(variance - both**2 / drift_variance + floor**2))
    offset_ns, at_ns = round(float(line[0] + line[1] * at) * NANOSECONDS), zero_ns + round(float(at) * NANOSECONDS)
    return ClockModel(offset_ns, 1e6 * float(line[1]), at_ns, stddev, 1e6 * float(np.sqrt(drift_variance)))


def fit_clock(
    times: FloatArray, offsets: FloatArray, stddevs: FloatArray, drift_stddev: float
) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares of offset and drift, with a normal prior of the drift around zero.

    Args:
        times: (n,) seconds.
        offsets: (n,) seconds.
        stddevs: (n,) seconds, of the offsets.
        drift_stddev: of the prior.

    Returns:
        The line (2,), offset at time zero and drift, and its information (2, 2); see :func:`clock_of_line`.
    """
    weights = stddevs**-2
    information = line_information(times, weights) + np.diag([0.0, drift_stddev**-2])
    line = np.linalg.solve(information, np.array([weights @ offsets, weights @ (times * offsets)]))
    return np.asarray(line, dtype=np.float64), information


class LeastDelay:
    """The lower envelope of the delays of messages, to which transport only ever adds.

    Args:
        window: length of the window, in the unit of the times.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._lowest: deque[tuple[int, int]] = deque()  # time and delay; both ascend

    def __bool__(self) -> bool:
        return bool(self._lowest)

    def clear(self) -> None:
        """Forget all messages."""
        self._lowest.clear()

    def add(self, time: int, delay: int) -> None:
        """Add a message; times must not descend."""
        while self._lowest and self._lowest[-1][1] >= delay:
            self._lowest.pop()
        self._lowest.append((time, delay))
        while time - self._lowest[0][0] >= self._window:
            self._lowest.popleft()

    @property
    def least(self) -> int:
        """The least delay at the last message, of which there must have been one."""
        return self._lowest[0][1]


class ReceiptClock:
    """Estimates a clock's offset from the times of receipt, by the least delay of the last half minute."""

    WINDOW_NS = 30 * NANOSECONDS
    SET_NS = NANOSECONDS // 2
    """A delay that shrinks by more than this means that the clock was set."""

    def __init__(self) -> None:
        self._least = LeastDelay(self.WINDOW_NS)

    def reset(self) -> None:
        """Forget all messages."""
        self._least.clear()

    @property
    def delay_ns(self) -> int | None:
        """The least difference of receipt and stamp; None before the first message."""
        return self._least.least if self._least else None

    def add(self, stamp_ns: int, received_ns: int) -> bool:
        """Add a message; False when the clock was set since the last one."""
        delay, known = received_ns - stamp_ns, self.delay_ns
        was_set = known is not None and delay < known - self.SET_NS
        if was_set:
            self.reset()
        self._least.add(received_ns, delay)
        return not was_set
