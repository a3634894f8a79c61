"""Frames of several sensors in the order of their capture, though some sensors deliver later than others.

A late frame makes a filter repeat its newer updates, and estimates published meanwhile lack it. So a frame waits while
another sensor's older one is due, for at most a few hundredths of a second, and not for a sensor whose due frames keep
missing. Where sensors have similar delays, hardly any frame waits.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from body_tracking.core.clocks import JUMP_BACK_NS, jumped_back
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.fusion.rhythm import DUE_MARGIN, Rhythm

SILENCE = 0.2
"""No frame waits for a sensor silent for longer than this, seconds."""


@dataclass(order=True, slots=True)
class _Waiting:
    """A waiting frame, ordered by its capture."""

    stamp_ns: int
    number: int  # of its arrival
    deadline_ns: int = field(compare=False)
    sensor: str = field(compare=False)
    skeleton: Skeleton = field(compare=False)


class _Source:
    def __init__(self) -> None:
        self.rhythm = Rhythm()
        self.newest_ns: int | None = None


class Ordering:
    """Orders frames by their stamps, within a bounded waiting time.

    Args:
        sensors: their names.
        wait: longest waiting time of a frame, seconds; 0 passes every frame on as it comes.

    Attributes:
        counters: event counts since the construction, for diagnostics.
    """

    def __init__(self, sensors: Sequence[str], wait: float) -> None:
        self.counters: Counter[str] = Counter()
        self.set_wait(wait)
        self._sources = {sensor: _Source() for sensor in sensors}
        self._waiting: list[_Waiting] = []
        self._flushed: list[tuple[str, Skeleton]] = []  # before a jump of time
        self._arrived = 0
        self._left_ns: int | None = None

    def set_wait(self, wait: float) -> None:
        """Change the longest waiting time of the frames to come, seconds."""
        self._wait_ns = round(wait * NANOSECONDS)

    def push(self, sensor: str, skeleton: Skeleton, now_ns: int) -> list[tuple[str, Skeleton]]:
        """Take one frame.

        Args:
            sensor: one of those given.
            skeleton: in the clock that all of them share.
            now_ns: when it arrived, in a monotonic clock.

        Returns:
            The frames whose wait is over, in the order of their capture.
        """
        # The result does not depend on whether the caller polled in between.
        ready = self.poll(now_ns)
        self.hold(sensor, skeleton, now_ns)
        return ready + self.poll(now_ns)

    def hold(self, sensor: str, skeleton: Skeleton, now_ns: int) -> None:
        """Take one frame as :meth:`push` does, without polling: for frames that arrived together, so that an older one
        of them goes before those whose wait is over.
        """
        source = self._sources[sensor]
        stamp_ns = skeleton.stamp_ns
        if jumped_back(stamp_ns, source.newest_ns):
            self._flushed = self.flush()
            source = self._sources[sensor]
        if source.newest_ns is None or stamp_ns > source.newest_ns:
            if source.newest_ns is not None and (step := stamp_ns - source.newest_ns) < JUMP_BACK_NS:
                source.rhythm.add(step / NANOSECONDS)
            source.newest_ns = stamp_ns
        self._arrived += 1
        insort(self._waiting, _Waiting(stamp_ns, self._arrived, now_ns + self._wait_ns, sensor, skeleton))

    def poll(self, now_ns: int) -> list[tuple[str, Skeleton]]:
        """The frames whose wait is over, in the order of their capture."""
        ready, self._flushed = self._flushed, []
        while (deadline_ns := self.deadline_ns) is not None:
            first = self._waiting[0]
            due = self._due(first.stamp_ns)
            waited = now_ns >= deadline_ns
            if not waited and any(rhythm.worth_waiting for rhythm in due):
                break
            # a frame that comes after newer ones have left is no evidence of the sensors' delays
            if self._left_ns is None or first.stamp_ns >= self._left_ns:
                self._left_ns = first.stamp_ns
                for source in self._sources.values():
                    source.rhythm.record(arrived=source.rhythm not in due)
            self.counters["expired waits"] += waited and bool(due) and self._wait_ns > 0
            del self._waiting[0]
            ready.append((first.sensor, first.skeleton))
        return ready

    def flush(self) -> list[tuple[str, Skeleton]]:
        """All waiting frames, in the order of their capture, before a jump of time."""
        ready = [*self._flushed, *((each.sensor, each.skeleton) for each in self._waiting)]
        self._flushed = []
        self._waiting.clear()
        self._left_ns = None
        self._sources = {sensor: _Source() for sensor in self._sources}
        return ready

    @property
    def deadline_ns(self) -> int | None:
        """When :meth:`poll` should be called, in the clock of ``now_ns``; None while no frame waits."""
        # the minimum, so that an older frame that came later does not extend the wait of those behind it
        return min((each.deadline_ns for each in self._waiting), default=None)

    @property
    def expected_ns(self) -> int | None:
        """The capture time before which no further frame is expected; None before the first frame."""
        known = [
            (newest_ns, each.rhythm) for each in self._sources.values() if (newest_ns := each.newest_ns) is not None
        ]
        if not known:
            return None
        last_ns = max(newest_ns for newest_ns, _ in known)
        next_ns = [
            newest_ns + round((rhythm.period - DUE_MARGIN) * NANOSECONDS)
            for newest_ns, rhythm in known
            if last_ns - newest_ns < SILENCE * NANOSECONDS
        ]
        return min([*next_ns, *(each.stamp_ns for each in self._waiting[:1])])

    def _due(self, stamp_ns: int) -> list[Rhythm]:
        """Rhythms of the sensors whose frame captured up to a time is due and has not arrived."""
        return [
            source.rhythm
            for source in self._sources.values()
            if source.newest_ns is not None and source.rhythm.due((stamp_ns - source.newest_ns) / NANOSECONDS, SILENCE)
        ]
