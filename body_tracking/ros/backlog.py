"""Which of the frames that wait to leave out, where a node is too slow for what comes: the oldest, and no more.

A queue that empties now and then has been of use: it kept what came while its owner was held up. One in which
everything waits, always, is only delay. So nothing is dropped until even the frames of each look have waited for longer
than a target for a whole interval (controlled delay: Nichols and Jacobson 2012, "Controlling queue delay"); but never
is more taken on at once than can be done in a while, by what frames have cost so far.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from body_tracking.core.skeleton import NANOSECONDS

TARGET = 0.1
"""Seconds that a frame may wait, always."""

INTERVAL = 1.0
"""Seconds for which it may wait longer: who is held up once is not too slow."""

AT_ONCE = 0.5
"""Seconds that the work on the frames that are here may take at most: as long as readers keep what comes meanwhile."""

_AGAIN = 10.0
"""For so long, seconds, after frames were dropped ..."""

_SOONER = 0.1
"""... this much of the interval is enough to drop some again."""

MAX_AGE = 0.25
"""Seconds: a longer pause between two messages may be a standstill, and after it older ones are left out. With what the
nodes behind add it is below the age up to which a robot follows angles (``SafetyLimits.max_age``, 0.3 s)."""

_RECOVERY = 1.0
"""Seconds after a standstill in which messages that were sent before may still come."""

_SMOOTHING = 0.3
"""Weight of the last work in what a frame costs."""


class Backlog:
    """Leaves out the oldest frames of a node that is too slow.

    Attributes:
        dropped: how many frames of each topic, since the construction.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._above_since_ns: int | None = None
        self._dropped_ns: int | None = None
        self._cost_ns = 0.0
        self._taken, self._taken_ns = 0, 0

    def late(self, arrived: Sequence[tuple[str, int]], now_ns: int) -> list[int]:
        """Those of the frames that are here which are not worth handling any more.

        Args:
            arrived: topic and time of arrival, nanoseconds, of each frame that waits.
            now_ns: the time now, by the same clock.

        Returns:
            Their places among those given; never that of a topic's newest frame.
        """
        late: list[int] = []
        if arrived:
            if self._too_slow(now_ns - min(at_ns for _, at_ns in arrived), now_ns):
                late = self._beyond(arrived, TARGET, now_ns - round(TARGET * NANOSECONDS))
            elif len(arrived) * self._cost_ns > AT_ONCE * NANOSECONDS:
                late = self._beyond(arrived, AT_ONCE)
        if late:
            self.dropped.update(arrived[place][0] for place in late)
            self._dropped_ns = now_ns
        self._taken, self._taken_ns = len(arrived) - len(late), now_ns
        return late

    def done(self, now_ns: int) -> None:
        """The others have been handled."""
        if self._taken:
            cost = max(0.0, (now_ns - self._taken_ns) / self._taken)
            self._cost_ns += _SMOOTHING * (cost - self._cost_ns)

    def _too_slow(self, waited_ns: int, now_ns: int) -> bool:
        """Whether frames have been waiting for too long for some time."""
        if waited_ns <= TARGET * NANOSECONDS:
            self._above_since_ns = None
            return False
        if self._above_since_ns is None:
            self._above_since_ns = now_ns
        again = self._dropped_ns is not None and now_ns - self._dropped_ns < _AGAIN * NANOSECONDS
        return now_ns - self._above_since_ns >= INTERVAL * NANOSECONDS * (_SOONER if again else 1.0)

    def _beyond(self, arrived: Sequence[tuple[str, int]], work: float, since_ns: int = 0) -> list[int]:
        """All but the newest of each topic, and as many of the newest as can be done in so many seconds."""
        kept: list[int] = []
        topics: set[str] = set()
        for place in sorted(range(len(arrived)), key=lambda each: arrived[each][1], reverse=True):
            topic, at_ns = arrived[place]
            fits = (len(kept) + 1) * self._cost_ns <= work * NANOSECONDS and at_ns >= since_ns
            if topic not in topics or fits:
                topics.add(topic)
                kept.append(place)
        return sorted(set(range(len(arrived))) - set(kept))


class Standstill:
    """Leaves out old messages where a process was stopped (or held up for as long) and goes on.

    What was sent meanwhile waits in the socket's buffer, which keeps the oldest of it, whatever the depth of the queue.
    At other times the rule does not apply: the sender may be another computer whose clock is wrong.

    Attributes:
        left_out: how many messages of each topic, since the construction.
    """

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        self._last_ns: int | None = None
        self._over_ns: int | None = None

    def is_stale(self, topic: str, sent_ns: int, now_ns: int) -> bool:
        """Whether a message is to be left out; to be asked of every message.

        Args:
            topic: on which it came.
            sent_ns: when it was sent.
            now_ns: the time now, by the same clock.
        """
        if self._last_ns is not None and now_ns - self._last_ns > MAX_AGE * NANOSECONDS:
            self._over_ns = now_ns
        self._last_ns = now_ns
        over = self._over_ns is not None and now_ns - self._over_ns < _RECOVERY * NANOSECONDS
        if not over or now_ns - sent_ns <= MAX_AGE * NANOSECONDS:
            return False
        self.left_out[topic] += 1
        return True


class Sequences:
    """Counts messages that were sent and never came, by the numbers that their publishers give them.

    Attributes:
        lost: how many of each topic, since the construction.
        switched: how often a message of each topic came from another publisher than the one before. Of one publisher
            numbers only rise; of two that take turns every second message counts.
    """

    def __init__(self) -> None:
        self.lost: Counter[str] = Counter()
        self.switched: Counter[str] = Counter()
        self._latest: dict[str, int] = {}
        self._last: dict[str, list[int]] = {}

    def note(self, topic: str, number: int) -> None:
        """A message came.

        Args:
            topic: on which.
            number: its publisher's, which goes up by one from each message to the next.
        """
        if number == _UNKNOWN:
            return
        self.switched[topic] += number <= self._latest.get(topic, -1)
        self._latest[topic] = number
        last = self._last.setdefault(topic, [])
        before = max((each for each in last if each < number), default=None)
        if before is None or number - before > _MOST_LOST:
            # a publisher that is new; of more than a few on one topic nobody can tell
            last.append(number)
            del last[:-_PUBLISHERS]
            return
        last[last.index(before)] = number
        if number > before + 1:
            self.lost[topic] += number - before - 1


_UNKNOWN = 2**64 - 1
"""What a middleware says that gives messages no numbers."""
_PUBLISHERS, _MOST_LOST = 4, 10_000
"""Publishers of a topic that are told apart, and the largest number of messages lost at once."""
