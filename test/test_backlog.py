"""Frames that a slow node drops: none after a single delay, the oldest if it is always too slow."""

from __future__ import annotations

from collections import Counter

import pytest

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.ros.backlog import INTERVAL, MAX_AGE, TARGET, Backlog, Sequences, Standstill

PERIOD_NS = NANOSECONDS // 30
TOPICS = ("/kinect1/skeleton", "/kinect2/skeleton")
DEPTH = 16
"""Frames that a reader keeps."""


def run(
    work_s: float, seconds: float, stall: tuple[float, float] = (0.0, 0.0)
) -> tuple[Backlog, list[int], Counter[str]]:
    """A node that works ``work_s`` on each frame of two sensors, and is delayed once: ``stall`` is (time, duration).

    Returns:
        Its backlog, the waiting times of the handled frames in nanoseconds, and counts of frames lost in full readers.
    """
    backlog, waited, lost = Backlog(), [], Counter[str]()
    queue: list[tuple[str, int]] = []
    now_ns, sent = 0, 0
    while now_ns < seconds * NANOSECONDS:
        while sent * PERIOD_NS <= now_ns:
            queue += [(topic, sent * PERIOD_NS) for topic in TOPICS]
            sent += 1
        for topic in TOPICS:
            mine = [each for each in queue if each[0] == topic]
            lost[topic] += max(0, len(mine) - DEPTH)
            queue = [each for each in queue if each[0] != topic or each in mine[-DEPTH:]]
        late = set(backlog.late(queue, now_ns))
        handled, queue = [each for place, each in enumerate(queue) if place not in late], []
        waited += [now_ns - at_ns for _, at_ns in handled]
        now_ns += round(work_s * NANOSECONDS) * len(handled)
        now_ns = now_ns if handled else sent * PERIOD_NS
        if now_ns >= stall[0] * NANOSECONDS and stall[1]:
            now_ns, stall = now_ns + round(stall[1] * NANOSECONDS), (0.0, 0.0)
    return backlog, waited, lost


@pytest.mark.parametrize("work_s", [0.001, 0.012])
@pytest.mark.parametrize("stall_s", [0.0, 0.4])
def test_fast_node_drops_nothing_after_a_single_delay(work_s: float, stall_s: float) -> None:
    backlog, waited, lost = run(work_s, 10.0, (3.0, stall_s))
    assert not backlog.dropped and not +lost
    assert len(waited) >= 2 * 10 * 30 - 2 * DEPTH
    assert max(waited[-60:]) <= TARGET * NANOSECONDS


@pytest.mark.parametrize("work_s", [0.02, 0.03, 0.08])
def test_slow_node_drops_the_oldest_frames(work_s: float) -> None:
    backlog, waited, lost = run(work_s, 20.0)
    sent = 2 * 20 * 30
    assert sum(backlog.dropped.values()) + sum(lost.values()) + len(waited) == pytest.approx(sent, abs=2 * DEPTH)
    # of both sensors alike, and no more than it has to
    assert abs(backlog.dropped[TOPICS[0]] - backlog.dropped[TOPICS[1]]) <= 0.05 * sent
    assert len(waited) > 0.9 * 20.0 / work_s
    # two frames at least are worked on while others wait; at first the readers are full
    assert max(waited) <= (2.0 * work_s + TARGET) * NANOSECONDS + DEPTH * PERIOD_NS
    assert max(waited[len(waited) // 4 :]) <= (4.0 * work_s + 2.0 * TARGET + 0.1 * INTERVAL) * NANOSECONDS


def test_the_newest_frame_of_each_sensor_is_never_dropped() -> None:
    backlog = Backlog()
    frames = [("one", 0), ("two", 5), ("one", 10), ("two", 2)]
    assert backlog.late(frames, NANOSECONDS) == []
    assert backlog.late(frames, round((1.0 + INTERVAL) * NANOSECONDS)) == [0, 3]
    assert backlog.late([], 10 * NANOSECONDS) == []
    assert backlog.dropped == {"one": 1, "two": 1}


def test_lost_messages_are_counted_by_sequence_numbers() -> None:
    sequences = Sequences()
    for number in (5, 6, 9, 10):
        sequences.note("one", number)
    assert sequences.lost == {"one": 2}
    # the publisher is started again, and another one is there too
    for number in (1, 2, 100_000, 3, 100_001, 4, 100_003):
        sequences.note("one", number)
    assert sequences.lost == {"one": 3}


def test_messages_between_two_subscriptions_are_not_lost() -> None:
    sequences = Sequences()
    for number in (5, 6):
        sequences.note("one", number)
    sequences.forget("one")
    for number in (200, 201):
        sequences.note("one", number)
    assert not +sequences.lost and not sequences.switched["one"]


def test_alternating_publishers_are_counted_and_a_restart_once() -> None:
    sequences = Sequences()
    for number in (5, 6, 9, 10, 1, 2, 3):
        sequences.note("one", number)
    assert sequences.switched["one"] == 1
    for first, second in zip(range(1000, 1100), range(5, 105), strict=True):
        sequences.note("two", first)
        sequences.note("two", second)
    assert sequences.switched["two"] == 100
    for number in (7, 7, 8, 8, 9, 9):  # of the same age
        sequences.note("three", number)
    assert sequences.switched["three"] == 3
    for _ in range(3):
        sequences.note("four", 2**64 - 1)  # a middleware that gives no numbers
    assert sequences.switched["four"] == sequences.lost["four"] == 0


@pytest.mark.parametrize("stood_s", [0.5, 2.0, 60.0])
def test_only_messages_from_before_the_end_of_a_standstill_are_dropped(stood_s: float) -> None:
    standstill, now_ns = Standstill(), 10**18
    for _ in range(90):
        now_ns += PERIOD_NS
        assert not standstill.is_stale("one", now_ns - 2 * PERIOD_NS, now_ns)
    begin_ns = now_ns
    now_ns += round(stood_s * NANOSECONDS)
    for sent_ns in range(begin_ns, now_ns, PERIOD_NS):
        now_ns += 10_000
        assert standstill.is_stale("one", sent_ns, now_ns) == (now_ns - sent_ns > MAX_AGE * NANOSECONDS)
    assert standstill.left_out["one"] == pytest.approx((stood_s - MAX_AGE) * 30, abs=2)
    # of another computer, whose clock is wrong
    for _ in range(90):
        now_ns += PERIOD_NS
        left_out = standstill.is_stale("two", now_ns - 5 * NANOSECONDS, now_ns)
    assert not left_out
