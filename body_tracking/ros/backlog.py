"""Dropping of the oldest waiting frames where a node is too slow for its inputs, and counters of lost messages.

A queue that becomes empty now and then only absorbs bursts; a standing queue is only delay. So frames are dropped when
the oldest one has waited for longer than a target throughout an interval (controlled delay: Nichols and Jacobson 2012,
"Controlling queue delay").
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from body_tracking.core.skeleton import NANOSECONDS

TARGET = 0.1
"""Seconds that a frame may always wait."""

INTERVAL = 1.0
"""Seconds for which frames may wait longer: a single delay does not mean that the node is too slow."""

_AGAIN = 10.0
"""Seconds after a drop during which only the share ``_SOONER`` of the interval is needed for the next one."""
_SOONER = 0.1

MAX_AGE = 0.25
"""Seconds: a longer pause between two messages may be a standstill, after which older messages are dropped. With the
delay of the later nodes it is below the age up to which a robot follows angles (``SafetyLimits.max_age``, 0.3 s)."""

_RECOVERY = 1.0
"""Seconds after a standstill in which older messages may still arrive."""


class Backlog:
    """Drops the oldest frames of a node that is too slow.

    Attributes:
        dropped: number of frames by topic.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._above_since_ns: int | None = None
        self._dropped_ns: int | None = None

    def late(self, arrived: Sequence[tuple[str, int]], now_ns: int) -> list[int]:
        """The waiting frames to be dropped.

        Args:
            arrived: topic and time of arrival, nanoseconds, of each waiting frame.
            now_ns: the time now, by the same clock.

        Returns:
            Their indices in ``arrived``; never that of a topic's newest frame.
        """
        if not self._too_slow(now_ns - min((at_ns for _, at_ns in arrived), default=now_ns), now_ns):
            return []
        newest = {arrived[place][0]: place for place in sorted(range(len(arrived)), key=lambda each: arrived[each][1])}
        late = [
            place
            for place, (topic, at_ns) in enumerate(arrived)
            if now_ns - at_ns > TARGET * NANOSECONDS and place != newest[topic]
        ]
        if late:
            self.dropped.update(arrived[place][0] for place in late)
            self._dropped_ns = now_ns
        return late

    def _too_slow(self, waited_ns: int, now_ns: int) -> bool:
        """Whether the oldest frame has been above the target throughout the interval."""
        if waited_ns <= TARGET * NANOSECONDS:
            self._above_since_ns = None
            return False
        if self._above_since_ns is None:
            self._above_since_ns = now_ns
        again = self._dropped_ns is not None and now_ns - self._dropped_ns < _AGAIN * NANOSECONDS
        return now_ns - self._above_since_ns >= INTERVAL * NANOSECONDS * (_SOONER if again else 1.0)


class Standstill:
    """Drops old messages after a standstill of the process (stopped, or not scheduled for long).

    The socket's buffer keeps the oldest messages of that time, whatever the depth of the queue. At other times the age
    of a message does not count, because the sender may be another computer with a wrong clock.

    Attributes:
        left_out: number of messages by topic.
    """

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self._last_ns: int | None = None
        self._over_ns: int | None = None

    def is_stale(self, topic: str, sent_ns: int, now_ns: int) -> bool:
        """Whether to drop a message; must be called for every message, with both times by the same clock."""
        if self._last_ns is not None and now_ns - self._last_ns > MAX_AGE * NANOSECONDS:
            self._over_ns = now_ns
        self._last_ns = now_ns
        over = self._over_ns is not None and now_ns - self._over_ns < _RECOVERY * NANOSECONDS
        if not over or now_ns - sent_ns <= MAX_AGE * NANOSECONDS:
            return False
        self.left_out[topic] += 1
        return True


class Sequences:
    """Counts lost messages by the sequence numbers of their publishers.

    Attributes:
        lost: number of lost messages by topic.
        switched: number of messages by topic whose sequence number did not rise: with one publisher none, with two
            alternating ones every second message.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        self.switched: Counter[str] = Counter()
        self._latest: dict[str, int] = {}
        self._last: dict[str, list[int]] = {}

    def note(self, topic: str, number: int) -> None:
        """Count a message with its sequence number."""
        if number == _UNKNOWN:
            return
        self.switched[topic] += number <= self._latest.get(topic, -1)
        self._latest[topic] = number
        last = self._last.setdefault(topic, [])
        before = max((each for each in last if each < number), default=None)
        if before is None or number - before > _MOST_LOST:
            # a new publisher
            last.append(number)
            del last[:-_PUBLISHERS]
            return
        last[last.index(before)] = number
        if number > before + 1:
            self.lost[topic] += number - before - 1

    def forget(self, topic: str) -> None:
        """Count nothing that is published from now until the next message."""
        self._latest.pop(topic, None)
        self._last.pop(topic, None)


_UNKNOWN = 2**64 - 1
"""The number of a middleware without sequence numbers."""
_PUBLISHERS, _MOST_LOST = 4, 10_000
"""Publishers of a topic that are distinguished, and the largest number of messages lost at once."""
