"""The time of capture of a sensor at another computer, in this computer's clock.

Three clocks are concerned. The sensor's own one stamps frames; it has a rate and a zero of its own. The sender's one is
read when a frame is sent and when a clock request comes. The local one is this computer's. Round trips relate the
sender's to the local one (:class:`RoundTrips`); the delays between the sensor's time and the sending of its frames
relate the sensor's to the sender's (:class:`CaptureClock`), but for the shortest delay, which nothing tells.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from body_tracking.core.clocks import ClockModel, LeastDelay, clock_of_line, fit_clock, jumped_back
from body_tracking.core.skeleton import NANOSECONDS

WINDOW = 60
"""Seconds with round trips that count, the latest ones; those of a cut of the link between them do not."""

LONGEST = 300.0
"""Seconds after which a round trip counts no more."""

DRIFT_PRIOR = 50e-6
"""Standard deviation of the drift of one computer's clock against another's: crystals keep 50 ppm."""

_BIN = NANOSECONDS
"""Of the round trips of a second only the shortest one counts."""
_ERROR = 50e-6
"""Seconds by which the shortest round trips err: the scheduling of the two processes."""
_STEP = 0.01
"""Seconds beyond its own bounds by which a round trip must contradict the others for a clock to have been set."""
_CONTRADICTIONS = 3

_LAG_WINDOW = 300
"""Frames, ten seconds of a Kinect's: after a cut of the link the first frames need not be fast ones."""
_SLEW = 100
"""The correction of a stamp changes by at most a hundredth of the time that has passed."""
_SET_NS = NANOSECONDS // 4
"""A correction that is off by more is set at once: a clock was set, or the first round trip was a bad one."""


class RoundTrips:
    """The local clock minus a remote one, by messages there and back.

    A round trip with t1 and t4 by the local clock, t2 and t3 by the remote one, bounds the offset,

        t1 - t2 <= offset <= t4 - t3,                                                                               (1)

    whatever either way took. Jitter only ever makes a way longer, so short round trips say more than long ones: a line
    (offset and drift) is fitted to the middles of eq. 1 of the shortest round trip of each second, with a standard
    deviation of half of that by which it is longer than the shortest one of all. Where all bounds can be kept, they
    are. What no round trip can tell is half the difference between the shortest ways there and back.
    """

    def __init__(self) -> None:
        self._bins: deque[tuple[int, int, int]] = deque()
        self._clock = ClockModel()  # the local one against the remote one
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
        """The shortest one of the window."""
        return min((trip for _, _, trip in self._bins), default=0)

    def offset_ns(self, remote_ns: int) -> int:
        """The local clock minus the remote one when that shows this time."""
        return self._clock.offset_ns_at(remote_ns)

    def add(self, t1: int, t2: int, t3: int, t4: int) -> bool:
        """Take a round trip, nanoseconds; whether it counts.

        It does not where it contradicts the others; when several in a row do, a clock was set, and they count alone.
        """
        trip = (t4 - t1) - (t3 - t2)
        if t4 < t1 or t3 < t2 or trip < 0:
            return False
        remote, offset = (t2 + t3) // 2, (t1 - t2 + t4 - t3) // 2
        # the middle of a round trip is off by half of it, and what is known by half of the shortest one (eq. 1)
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
    """Capture times in the local clock, ever later.

    A frame is sent some time after its capture, the sensor's delay, never less than the least one. So the least of
    sending time minus sensor's time over some hundred frames is the difference of the two clocks plus that least delay.
    The correction of the stamps follows what is known by and by, so that their distances stay those of the sensor.

    Args:
        least_delay_ns: what the sensor takes at least from capture until its frame can be sent.
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
            Nanoseconds; later than that of the frame before, unless the local clock itself was set back by more than a
            second, where time jumps back for everybody.
        """
        lag, step = sent_ns - sensor_ns, sensor_ns - self._last_sensor_ns
        anew = self._last_stamp_ns is None or step < 0  # the sensor has begun to count anew
        if anew:
            self._lag.clear()
        self._frames += 1
        self._lag.add(self._frames, lag)
        target = self._lag.at(self._frames) + offset_ns - self._least_delay_ns
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
