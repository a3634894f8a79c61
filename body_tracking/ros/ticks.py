"""Simulated time of ``/clock`` beside the wall clock: the time since capture, and how much of a bag was played."""

from __future__ import annotations

from collections import deque

from body_tracking.core.skeleton import NANOSECONDS

_KEPT = 1000
"""Ticks: ten seconds of the player's default."""
_STEP_NS = NANOSECONDS
"""A larger step of simulated time may be a change of place in the bag."""
_FASTEST = 100
"""Simulated seconds per second; a larger step that is faster is a change of place."""


class Ticks:
    """The latest ticks of ``/clock``.

    Attributes:
        played_ns: simulated time that has passed, without changes of place and backward jumps, nanoseconds.
    """

    def __init__(self) -> None:
        self.played_ns = 0
        self._ticks: deque[tuple[int, int]] = deque(maxlen=_KEPT)

    def __bool__(self) -> bool:
        return bool(self._ticks)

    def add(self, time_ns: int, sent_ns: int) -> None:
        """Add a tick: its simulated time, and the wall time at which it was sent, nanoseconds."""
        if self._ticks:
            step_ns, passed_ns = time_ns - self._ticks[-1][0], sent_ns - self._ticks[-1][1]
            if 0 < step_ns <= max(_STEP_NS, _FASTEST * passed_ns):
                self.played_ns += step_ns
        self._ticks.append((time_ns, sent_ns))

    def since_ns(self, stamp_ns: int, sent_ns: int, now_ns: int) -> int:
        """Time since a stamp: simulated time up to the last tick before an input was sent, then real time.

        A bag's own time says how late its messages were when they were recorded; what the nodes take is real time,
        whatever the playback speed. Thus it is at least the time since the input was sent, unless the bag's stamps are
        later than its messages.

        Args:
            stamp_ns: simulated time of the capture.
            sent_ns: wall time at which the input was sent.
            now_ns: wall time now.

        Raises:
            IndexError: there is no tick.
        """
        at = self._ticks[0]
        for tick in reversed(self._ticks):
            if tick[1] <= sent_ns:
                at = tick
                break
        return at[0] - stamp_ns + now_ns - at[1]
