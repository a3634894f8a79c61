"""Frames of several sensors, brought into the order of their capture."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Skeleton
from body_tracking.fusion.ordering import Ordering
from body_tracking.fusion.rhythm import PATIENCE

MS = 1_000_000
PERIOD = 33 * MS


def frame(stamp_ns: int) -> Skeleton:
    return Skeleton(stamp_ns, "world", np.zeros((N_JOINTS, 3)), np.full(N_JOINTS, 2, dtype=np.uint8))


def stamps(ready: list[tuple[str, Skeleton]]) -> list[int]:
    return [skeleton.stamp_ns for _, skeleton in ready]


def known(ordering: Ordering, offsets: dict[str, int], rounds: int = 4) -> int:
    """Let every sensor deliver some frames without delay; the time after them."""
    arrivals = sorted((k * PERIOD + offset, sensor) for k in range(rounds) for sensor, offset in offsets.items())
    for at, sensor in arrivals:
        ordering.push(sensor, frame(at), at)
    return rounds * PERIOD


def test_expected_time_is_a_lower_bound_of_the_next_frame() -> None:
    ordering = Ordering(["kinect1", "kinect2"], 0.04)
    assert ordering.expected_ns is None
    known(ordering, {"kinect1": 0, "kinect2": 12 * MS})
    first_ns, second_ns = 3 * PERIOD, 3 * PERIOD + 12 * MS
    assert ordering.expected_ns == first_ns + PERIOD - 2 * MS
    ordering.push("kinect1", frame(first_ns + PERIOD), first_ns + PERIOD)
    assert ordering.expected_ns == second_ns + PERIOD - 2 * MS
    # a frame that waits for an older one has not been released yet
    ordering.push("kinect1", frame(first_ns + 2 * PERIOD), first_ns + 2 * PERIOD)
    ordering.hold("kinect2", frame(first_ns + PERIOD + MS), first_ns + 2 * PERIOD)
    assert ordering.expected_ns == first_ns + PERIOD + MS
    # who falls silent is not waited for
    for k in range(3, 12):
        ordering.push("kinect1", frame(first_ns + k * PERIOD), first_ns + k * PERIOD)
    assert ordering.expected_ns == first_ns + 12 * PERIOD - 2 * MS


@given(
    delays=st.lists(st.integers(0, 25), min_size=2, max_size=4),
    phases=st.lists(st.integers(0, 32), min_size=4, max_size=4, unique=True),
    jitter=st.integers(0, 4),
    seed=st.integers(0, 1000),
)
def test_frames_of_steady_sensors_leave_once_and_in_order(
    delays: list[int], phases: list[int], jitter: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sensors = [f"kinect{k}" for k in range(len(delays))]
    ordering = Ordering(sensors, 0.04)
    events = sorted(
        ((k * 33 + phase + delay + int(rng.integers(0, jitter + 1))) * MS, (k * 33 + phase) * MS, sensor)
        for sensor, delay, phase in zip(sensors, delays, phases, strict=False)
        for k in range(30)
    )
    left = []
    for now_ns, stamp_ns, sensor in events:
        for _, skeleton in ordering.push(sensor, frame(stamp_ns), now_ns):
            left.append((skeleton.stamp_ns, now_ns))
    left += [(skeleton.stamp_ns, 0) for _, skeleton in ordering.flush()]
    assert sorted(stamp for stamp, _ in left) == sorted(stamp for _, stamp, _ in events)
    # before its first frame a sensor is unknown
    settled = [stamp for stamp, _ in left if stamp > (33 + 32) * MS]
    assert settled == sorted(settled)


def test_a_frame_waits_for_an_older_one_and_no_longer() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    now = known(ordering, {"a": 10 * MS, "b": 0})
    assert stamps(ordering.push("a", frame(now + 10 * MS), now + 10 * MS)) == []
    assert ordering.deadline_ns == now + 30 * MS
    assert ordering.poll(now + 29 * MS) == []
    assert stamps(ordering.push("b", frame(now), now + 12 * MS)) == [now, now + 10 * MS]
    assert ordering.deadline_ns is None


def test_of_frames_that_arrived_together_the_oldest_goes_first() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    now = known(ordering, {"a": 10 * MS, "b": 0})
    assert ordering.push("a", frame(now + 10 * MS), now + 10 * MS) == []
    # no poll for longer than the wait
    later = now + 60 * MS
    ordering.hold("a", frame(now + 10 * MS + PERIOD), later)
    ordering.hold("b", frame(now), later)
    ordering.hold("b", frame(now + PERIOD), later)
    assert stamps(ordering.poll(later)) == [now, now + 10 * MS, now + PERIOD, now + 10 * MS + PERIOD]
    assert ordering.deadline_ns is None
    assert ordering.counters["expired waits"] == 0


def test_waiting_frames_go_first_after_a_jump_back() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    now = known(ordering, {"a": 10 * MS, "b": 0}) + 5 * NANOSECONDS
    for stamp_ns in (now, now + PERIOD, 0, PERIOD):
        ordering.hold("a", frame(stamp_ns), now + PERIOD)
    ordering.hold("b", frame(now + 5 * MS), now + PERIOD)
    ordering.hold("b", frame(5 * MS), now + PERIOD)
    left = stamps(ordering.poll(now + PERIOD)) + stamps(ordering.poll(now + PERIOD + 20 * MS))
    assert left[:2] == [now, now + PERIOD]
    assert sorted(left[2:]) == [0, 5 * MS, PERIOD, now + 5 * MS]


def test_a_frame_leaves_alone_at_its_deadline() -> None:
    polled, pushed = Ordering(("a", "b"), 0.02), Ordering(("a", "b"), 0.02)
    for ordering in (polled, pushed):
        now = known(ordering, {"a": 10 * MS, "b": 0})
        ordering.push("a", frame(now + 10 * MS), now + 10 * MS)
    assert stamps(polled.poll(now + 30 * MS)) == [now + 10 * MS]
    assert stamps(polled.push("b", frame(now), now + 31 * MS)) == [now]
    # polls in between do not change the order
    assert stamps(pushed.push("b", frame(now), now + 31 * MS)) == [now + 10 * MS, now]
    assert polled.counters == pushed.counters == {"expired waits": 1}


def test_with_zero_wait_frames_pass_at_once() -> None:
    ordering = Ordering(("a", "b"), 0.0)
    now = known(ordering, {"a": 10 * MS, "b": 0})
    assert stamps(ordering.push("a", frame(now + 10 * MS), now + 10 * MS)) == [now + 10 * MS]
    assert stamps(ordering.push("b", frame(now), now + 12 * MS)) == [now]


def test_sensors_of_equal_delay_do_not_wait_for_each_other() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    for k in range(50):
        for sensor, phase in (("a", 0), ("b", 16 * MS)):
            stamp = k * PERIOD + phase
            assert stamps(ordering.push(sensor, frame(stamp), stamp + 30 * MS)) == [stamp]


def test_no_frame_waits_for_a_vanished_sensor() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    now = known(ordering, {"a": 10 * MS, "b": 0})
    waited = 0
    for k in range(12):
        at = now + 10 * MS + k * PERIOD
        waited += ordering.push("a", frame(at), at) == []
        ordering.poll(at + 20 * MS)
    # by patience, and because no frame is expected of a sensor that was silent for long
    assert 1 <= waited <= PATIENCE


def test_a_jump_back_in_time_flushes_waiting_frames() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    now = known(ordering, {"a": 10 * MS, "b": 0}) + 5 * NANOSECONDS
    for sensor in ("b", "a"):
        ordering.push(sensor, frame(now - PERIOD), now - PERIOD)
    assert stamps(ordering.push("a", frame(now), now)) == []
    assert stamps(ordering.push("a", frame(0), now + 10 * MS)) == [now, 0]
    assert ordering.deadline_ns is None


def test_no_frame_waits_for_a_sensor_that_is_always_late() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    events = sorted(
        (k * PERIOD + delay, k * PERIOD, name) for name, delay in (("a", 0), ("b", 70 * MS)) for k in range(40)
    )
    waited = 0
    for now_ns, stamp_ns, sensor in events:
        while (deadline_ns := ordering.deadline_ns) is not None and deadline_ns < now_ns:
            ordering.poll(deadline_ns)
        left = ordering.push(sensor, frame(stamp_ns), now_ns)
        waited += sensor == "a" and left == []
    assert 1 <= waited <= PATIENCE


def test_an_older_frame_does_not_extend_the_wait_of_newer_ones() -> None:
    ordering = Ordering(("a", "b", "c"), 0.02)
    now = known(ordering, {"a": 20 * MS, "b": 10 * MS, "c": 0})
    assert ordering.push("a", frame(now + 20 * MS), now + 20 * MS) == []
    assert ordering.push("b", frame(now + 10 * MS), now + 35 * MS) == []
    assert ordering.deadline_ns == now + 40 * MS
    assert stamps(ordering.poll(now + 40 * MS)) == [now + 10 * MS, now + 20 * MS]


def test_no_frame_waits_for_a_slow_sensor_between_its_frames() -> None:
    ordering = Ordering(("a", "b"), 0.02)
    waits = []
    for k in range(120):
        if k % 15 == 0:
            ordering.push("b", frame(k * PERIOD), k * PERIOD)
        now_ns = k * PERIOD + 10 * MS
        waits.append(ordering.push("a", frame(now_ns), now_ns) == [])
        ordering.poll(now_ns + 20 * MS)
    assert not any(waits[30:])
