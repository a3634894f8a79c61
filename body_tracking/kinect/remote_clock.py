"""The time of capture of a sensor at another computer, in this computer's clock.

There are three clocks. The sensor's clock stamps frames; it has its own rate and zero. The sender reads its clock when
it sends a frame and when it receives a clock request. The local clock is this computer's. Round trips relate the
sender's clock to the local one (:class:`RoundTrips`); the delays from the sensor's stamps to the sending of its frames
relate the sensor's clock to the sender's (:class:`CaptureClock`), up to the shortest delay, which is unobservable.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from body_tracking.core.clocks import ClockModel, LeastDelay, clock_of_line, fit_clock, jumped_back
from body_tracking.core.skeleton import NANOSECONDS

WINDOW = 60
"""Number of bins of one second, not counting those without round trips."""

LONGEST = 300.0
"""Greatest age of a round trip, seconds."""

DRIFT_PRIOR = 50e-6
"""Standard deviation of the drift between two computers' clocks: crystals keep 50 ppm."""

_BIN = NANOSECONDS
"""Only the shortest round trip of each bin counts."""
_ERROR = 50e-6
"""Error of the shortest round trips by the scheduling of the two processes, seconds."""
_STEP = 0.01
"""A round trip contradicts the others when it deviates by this beyond its own bounds, seconds: a clock was set."""
_CONTRADICTIONS = 3

_LAG_WINDOW = 300
"""Frames, ten seconds of a Kinect: after an interruption of the link the first frames may be slow."""
_SLEW = 100
"""The correction of a stamp changes by at most a hundredth of the elapsed time."""
_SET_NS = NANOSECONDS // 4
"""A greater error of the correction is removed at once: a clock was set, or the first round trip was inaccurate."""


class RoundTrips:
    """The local clock minus a remote one, from round trips of messages.

    A round trip with t1 and t4 by the local clock, t2 and t3 by the remote one, bounds the offset,

        t1 - t2 <= offset <= t4 - t3,                                                                               (1)

    whatever the two delays. Jitter only lengthens delays, so short round trips are more accurate: a line (offset and
    drift) is fitted to the midpoints of eq. 1 of the shortest round trip of each second, with a standard deviation of
    half its excess over the shortest one of all. The offset is clipped to all bounds if they are consistent. Half the
    difference between the shortest delays of the two directions is unobservable.
    """

    def __init__(self) -> None:
        self._bins: deque[tuple[int, int, int]] = deque()
        self._clock = ClockModel()  # local minus remote
        self._contradictions = 0
        self.steps = 0

    @property
    def known(self) -> bool:
        """Whether there was a round trip."""
        return bool(self._bins)

    @property
    def remote_ns(self) -> int:
        """The remote time of the last round trip."""
        return self._bins[-1][0] if self._bins else 0

    @property
    def drift(self) -> float:
        """Seconds per second by which the local clock is faster."""
        return 1e-6 * self._clock.drift_ppm

    @property
    def round_trip_ns(self) -> int:
        """The shortest round trip of the window."""
        return min((trip for _, _, trip in self._bins), default=0)

    def offset_ns(self, remote_ns: int) -> int:
        """The local clock minus the remote one, at a time of the remote clock."""
        return self._clock.offset_ns_at(remote_ns)

    def add(self, t1: int, t2: int, t3: int, t4: int) -> bool:
        """Add a round trip, nanoseconds; returns whether it was accepted.

        A round trip that contradicts the others is rejected; after several in a row, a clock was set, and the earlier
        ones are discarded.
        """
        trip = (t4 - t1) - (t3 - t2)
        if t4 < t1 or t3 < t2 or trip < 0:
            return False
        remote, offset = (t2 + t3) // 2, (t1 - t2 + t4 - t3) // 2
        # the midpoint errs by at most half the round trip, the fitted line by half of the shortest one (eq. 1)
        if self.known and abs(offset - self.offset_ns(remote)) > (trip + self.round_trip_ns) // 2 + _STEP * NANOSECONDS:
            self._contradictions += 1
            if self._contradictions < _CONTRADICTIONS:
                return False
            self._bins.clear()
            self.steps += 1
        self._contradictions = 0
        if self._bins and remote // _BIN == self._bins[-1][0] // _BIN:
            if trip >= self._bins[-1][2]:
                return True
            self._bins.pop()
        self._bins.append((remote, offset, trip))
        while len(self._bins) > WINDOW or remote - self._bins[0][0] > LONGEST * NANOSECONDS:
            self._bins.popleft()
        self._fit()
        return True

    def _fit(self) -> None:
        zero_ns, offset_ns, _ = self._bins[-1]
        bins = np.array([(remote - zero_ns, offset - offset_ns, trip) for remote, offset, trip in self._bins])
        age, offset, half = (bins * [1.0, 1.0, 0.5] / NANOSECONDS).T
        line, information = fit_clock(age, offset, half - half.min() + _ERROR, DRIFT_PRIOR)
        level = offset - line[1] * age
        lower, upper = (level - half).max(), (level + half).min()
        if lower <= upper:
            line[0] = min(max(line[0], lower), upper)
        self._clock = clock_of_line(line, information, zero_ns).plus(ClockModel(offset_ns))


class CaptureClock:
    """Monotonic capture times in the local clock.

    A frame is sent after the sensor's delay, which is at least the least delay. So the minimum of sending time minus
    sensor time over some hundred frames is the offset of the two clocks plus the least delay. The correction of the
    stamps follows this estimate slowly, so that their distances stay those of the sensor.

    Args:
        least_delay_ns: the sensor's least delay from capture until its frame can be sent.
    """

    def __init__(self, least_delay_ns: int = 0) -> None:
        self._least_delay_ns = least_delay_ns
        self._lag = LeastDelay(_LAG_WINDOW)
        self._frames = 0
        self._last_sensor_ns = 0
        self._correction_ns = 0
        self._last_stamp_ns: int | None = None

    def stamp(self, sensor_ns: int, sent_ns: int, offset_ns: int) -> int:
        """The local time of a capture.

        Args:
            sensor_ns: by the sensor's clock.
            sent_ns: when the frame was sent, by the sender's clock.
            offset_ns: the local clock minus the sender's.

        Returns:
            Nanoseconds; later than the previous stamp, unless the local clock was set back by more than a second.
        """
        lag, step = sent_ns - sensor_ns, sensor_ns - self._last_sensor_ns
        anew = self._last_stamp_ns is None or step < 0  # the sensor's clock has restarted
        if anew:
            self._lag.clear()
        self._frames += 1
        self._lag.add(self._frames, lag)
        target = self._lag.least + offset_ns - self._least_delay_ns
        error = target - self._correction_ns
        if anew or abs(error) > _SET_NS:
            self._correction_ns = target
        else:
            self._correction_ns += max(-step // _SLEW, min(step // _SLEW, error))
        self._last_sensor_ns = sensor_ns
        stamp = sensor_ns + self._correction_ns
        if self._last_stamp_ns is not None and not jumped_back(stamp, self._last_stamp_ns):
            stamp = max(stamp, self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp
        return stamp
