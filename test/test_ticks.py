"""Time since capture and played time of a bag, from the ticks of its clock."""

from __future__ import annotations

import pytest

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.ros.ticks import Ticks

MS = NANOSECONDS // 1000
RECORDED = 7 * MS
"""From the capture to the recorder."""


def played(speed: float, start_ns: int = 100 * NANOSECONDS, count: int = 300) -> tuple[Ticks, list[tuple[int, int]]]:
    """A bag of 100 frames a second, with a tick before each one, at this speed; stamps and wall times of the frames."""
    ticks, frames = Ticks(), []
    for k in range(count):
        time_ns, sent_ns = start_ns + 10 * k * MS, 5000 * NANOSECONDS + round(10 * k * MS / speed)
        ticks.add(time_ns, sent_ns)
        frames.append((time_ns - RECORDED, sent_ns + MS // 10))
    return ticks, frames


@pytest.mark.parametrize("speed", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("delay_ns", [3 * MS, 26 * MS, 200 * MS])
def test_latency_is_the_recorded_part_and_the_delay_at_any_speed(speed: float, delay_ns: int) -> None:
    ticks, frames = played(speed)
    for stamp_ns, sent_ns in frames[-20:]:
        latency_ns = ticks.since_ns(stamp_ns, sent_ns, sent_ns + delay_ns)
        assert latency_ns == RECORDED + MS // 10 + delay_ns
        assert latency_ns > delay_ns


def test_latency_of_a_later_node_has_the_delay_of_the_earlier_one() -> None:
    ticks, frames = played(0.1)
    stamp_ns, sent_ns = frames[-1]
    assert ticks.since_ns(stamp_ns, sent_ns + 4 * MS, sent_ns + 9 * MS) == RECORDED + MS // 10 + 9 * MS


@pytest.mark.parametrize("speed", [0.1, 1.0, 10.0])
def test_played_time_is_that_of_the_bag_without_changes_of_place(speed: float) -> None:
    ticks, _ = played(speed)
    assert ticks.played_ns == 2990 * MS
    wall_ns = 5000 * NANOSECONDS + round(3000 * MS / speed)
    for place_ns in (500 * NANOSECONDS, 100 * NANOSECONDS, 100 * NANOSECONDS + 5 * MS):
        wall_ns += 10 * MS
        ticks.add(place_ns, wall_ns)
    assert ticks.played_ns == 2995 * MS
