"""The timing of playback: the messages of a bag that are due, and the time on ``/clock``.

The caller passes a steady clock to :meth:`Playback.step`, publishes the result, and calls again at its ``wake_ns``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.recording.rosbag2 import BagError, BagReader, RawMessage

_BATCH = 200  # messages per step at most, so that a pause takes effect while the player is catching up
_LOOP_GAP_NS = 10_000_000  # between two loops, so that a bag of one instant is no busy loop


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of one log time, to be published after the clock.

    Attributes:
        clock_ns: the bag's time to publish on ``/clock``.
        messages: to publish; none for a mere tick of the clock.
    """

    clock_ns: int
    messages: tuple[RawMessage, ...]


@dataclass(frozen=True, slots=True)
class Step:
    """Result of a step.

    Attributes:
        batches: to publish now, in order.
        wake_ns: steady time of the next step; None at the end.
    """

    batches: tuple[Batch, ...]
    wake_ns: int | None


class Playback:
    """Plays a bag against a steady clock.

    The bag's time runs ``rate`` times as fast as the steady clock, from the first step on. Messages that are late,
    because the caller was, are returned at once and never dropped. The clock never runs ahead of a pending message nor
    beyond the last one, and jumps back only when the bag restarts.

    Args:
        reader: of the bag; must stay open.
        rate: bag seconds per second, above 0.
        loop: restart at the end.
        start_offset_s: seconds to skip at the beginning of the bag.
        topics: only these; empty for all.
        clock_hz: ticks of the clock per second of the steady clock; 0 for none but those with messages.
        paused: do not run until :meth:`resume`.

    Raises:
        BagError: there are no messages to play.
    """

    def __init__(
        self,
        reader: BagReader,
        *,
        rate: float = 1.0,
        loop: bool = False,
        start_offset_s: float = 0.0,
        topics: Collection[str] = (),
        clock_hz: float = 100.0,
        paused: bool = False,
    ) -> None:
        self.loop = loop
        self.loops = 0
        """Number of restarts."""
        self.sent = 0
        """Messages returned so far."""
        self.late_ns = 0
        """Delay of the latest messages, in steady time."""
        self._reader = reader
        self._topics = frozenset(topics) or None
        self._rate = rate
        self._start_ns = reader.start_ns + round(start_offset_s * NANOSECONDS)
        self._tick_ns = round(NANOSECONDS / clock_hz) if clock_hz else 0
        self._paused = paused
        self._next: RawMessage | None
        self._stream: Iterator[RawMessage]
        if not self._rewind():
            what = f" after {start_offset_s:g} s" if start_offset_s else ""
            raise BagError(f"{reader.path}: no message to play{what}")
        # The bag's time at a steady time; the first step sets the latter.
        self._bag_ns: int = self._start_ns
        self._steady_ns: int | None = None
        self._next_tick_ns: int = 0

    @property
    def paused(self) -> bool:
        return self._paused

    @property
    def finished(self) -> bool:
        """Whether all messages were returned and the bag does not restart."""
        return self._next is None and not self.loop

    @property
    def rate(self) -> float:
        """Bag seconds per second."""
        return self._rate

    def bag_time_ns(self, steady_ns: int) -> int:
        """The bag's time at a steady time that is not before the latest step; it stands still at the end."""
        if self._paused or self._steady_ns is None:
            return self._bag_ns
        bag_ns = self._bag_ns + int((steady_ns - self._steady_ns) * self._rate)
        return min(bag_ns, self._reader.end_ns) if self.finished else bag_ns

    def pause(self, steady_ns: int) -> None:
        self._anchor(steady_ns)
        if self._next is not None:
            # Messages that are due but not yet returned keep their time: /clock would run back with them.
            self._bag_ns = min(self._bag_ns, max(self._next.log_time_ns, self._start_ns))
        self._paused = True

    def resume(self, steady_ns: int) -> None:
        self._anchor(steady_ns)
        self._paused = False

    def set_rate(self, rate: float, steady_ns: int) -> None:
        """Change the rate, which is above 0, from now on."""
        self._anchor(steady_ns)
        self._rate = rate

    def seek(self, start_offset_s: float, steady_ns: int) -> None:
        """Continue at another place of the bag; as paused as before.

        Raises:
            BagError: there are no messages from there on; the place does not change then.
        """
        start_ns = self._reader.start_ns + round(start_offset_s * NANOSECONDS)
        stream = self._reader.messages(self._topics, start_ns)
        first = next(stream, None)
        if first is None:
            raise BagError(f"{self._reader.path}: no message to play after {start_offset_s:g} s")
        self._stream, self._next, self._bag_ns = stream, first, start_ns
        if self._steady_ns is not None:
            self._steady_ns = self._next_tick_ns = steady_ns

    def step(self, steady_ns: int) -> Step:
        """The messages that are due.

        Args:
            steady_ns: nanoseconds of any steady clock, never decreasing.
        """
        if self._steady_ns is None:
            self._steady_ns = self._next_tick_ns = steady_ns
        if self._next is None:
            if not self.loop:
                return Step((), None)
            # Restart; the bag's time jumps back, and stands still during the gap.
            self.loops += 1
            self._rewind()
            self._bag_ns, self._steady_ns = self._start_ns, steady_ns + (0 if self._paused else _LOOP_GAP_NS)
            self._next_tick_ns = self._steady_ns
            return Step((), self._steady_ns)
        now_ns = self.bag_time_ns(steady_ns)
        batches = self._due(now_ns, steady_ns)
        pending: RawMessage | None = self._next
        if pending is not None and pending.log_time_ns <= now_ns and not self._paused:
            return Step(tuple(batches), steady_ns)
        if self._tick_ns and steady_ns >= self._next_tick_ns and pending is not None:
            if not batches or batches[-1].clock_ns < now_ns:
                batches.append(Batch(now_ns, ()))
            # Missed ticks are skipped.
            missed = (steady_ns - self._next_tick_ns) // self._tick_ns
            self._next_tick_ns += (missed + 1) * self._tick_ns
        return Step(tuple(batches), self._wake(pending, steady_ns))

    def _anchor(self, steady_ns: int) -> None:
        if self._steady_ns is not None:
            # During the gap between two loops, the bag's time does not run yet.
            self._bag_ns = max(self._bag_ns, self.bag_time_ns(steady_ns))
            self._steady_ns = max(self._steady_ns, steady_ns) if not self._paused else steady_ns

    def _rewind(self) -> bool:
        """Start at the beginning; False without messages."""
        self._stream = self._reader.messages(self._topics, self._start_ns)
        self._next = next(self._stream, None)
        return self._next is not None

    def _due(self, now_ns: int, steady_ns: int) -> list[Batch]:
        batches: list[Batch] = []
        group: list[RawMessage] = []
        taken = 0
        while not self._paused and self._next is not None and self._next.log_time_ns <= now_ns and taken < _BATCH:
            if group and group[0].log_time_ns != self._next.log_time_ns:
                batches.append(Batch(group[0].log_time_ns, tuple(group)))
                group = []
            group.append(self._next)
            taken += 1
            self._next = next(self._stream, None)
        if group:
            batches.append(Batch(group[0].log_time_ns, tuple(group)))
            self.late_ns = int((now_ns - group[-1].log_time_ns) / self._rate)
        self.sent += taken
        return batches

    def _wake(self, pending: RawMessage | None, steady_ns: int) -> int | None:
        if pending is None and not self.loop:
            return None
        times = []
        if self._tick_ns:
            times.append(self._next_tick_ns)
        if not self._paused and self._steady_ns is not None:
            if pending is None:
                times.append(steady_ns)
            else:
                ahead_ns = (pending.log_time_ns - self._bag_ns) / self._rate
                wake_ns = self._steady_ns + math.ceil(ahead_ns)
                # By rounding, the bag's time may be a nanosecond short of the message.
                while self.bag_time_ns(wake_ns) < pending.log_time_ns:
                    wake_ns += 1
                times.append(wake_ns)
        # Paused and without ticks, only a call of resume changes anything.
        return max(steady_ns, min(times, default=steady_ns + NANOSECONDS))
