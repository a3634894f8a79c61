"""By which clock stamps are is decided once, and what is late stays late."""

from __future__ import annotations

import pytest

from body_tracking.robot.clock import StampClock
from body_tracking.skeleton import NANOSECONDS

EPOCH = 1_750_000_000.0
DELAY = 0.05


def heard(clock: StampClock, stamp: float, now: float, steady: float) -> float:
    """The age of a message that comes now, seconds."""
    stamp_ns, now_ns = round(stamp * NANOSECONDS), round(now * NANOSECONDS)
    clock.note(stamp_ns, now_ns, round(steady * NANOSECONDS))
    return clock.age_ns(stamp_ns, now_ns) / NANOSECONDS


@pytest.mark.parametrize(
    ("stamp", "now", "kind"),
    [
        (EPOCH - 0.03, EPOCH, "ros"),
        (EPOCH - 12.0, EPOCH, "ros"),
        (EPOCH - 600.0, EPOCH, "ros"),
        (EPOCH - 1e8, EPOCH, "ros"),  # a recording of years ago
        (EPOCH + 3600.0, EPOCH, "ros"),
        (40.0, EPOCH, "sensor"),
        (3e5, EPOCH, "sensor"),
        (40.0, 40.03, "ros"),  # a simulator's time
        (40.0, 1000.0, "ros"),
    ],
)
def test_the_first_stamp_decides(stamp: float, now: float, kind: str) -> None:
    clock = StampClock("auto", DELAY)
    age = heard(clock, stamp, now, 0.0)
    assert clock.kind == kind
    assert age == pytest.approx(DELAY if kind == "sensor" else now - stamp, abs=1e-6)


@pytest.mark.parametrize(("first", "later"), [(EPOCH - 0.03, 40.0), (40.0, EPOCH)])
def test_and_later_ones_change_nothing(first: float, later: float) -> None:
    clock = StampClock("auto", DELAY)
    heard(clock, first, EPOCH, 0.0)
    kind = clock.kind
    for step in range(1, 3000):
        age = heard(clock, later + step / 30, EPOCH + step / 30, step / 30)
        assert clock.kind == kind and abs(age) > 1e9
    clock.reset()
    heard(clock, later, EPOCH, 200.0)
    assert clock.kind not in (kind, "auto")


def test_nothing_is_decided_before_simulated_time_has_begun() -> None:
    clock = StampClock("auto", DELAY)
    heard(clock, 40.0, 0.0, 0.0)
    assert clock.kind == "auto"
    heard(clock, 41.0, EPOCH, 1.0)
    assert clock.kind == "sensor"


def test_with_a_clock_of_its_own_what_becomes_late_stays_late() -> None:
    clock = StampClock("sensor", DELAY)
    for step in range(300):
        assert heard(clock, 40.0 + step / 30, EPOCH + step / 30, step / 30) == pytest.approx(DELAY, abs=1e-3)
    for step in range(300, 6000):  # three minutes of it
        late = heard(clock, 40.0 + step / 30 - 5.0, EPOCH + step / 30, step / 30)
        assert 4.8 < late < 5.0 + 2 * DELAY


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_a_clock_that_drifts_as_crystals_do_is_followed(drift: float) -> None:
    clock = StampClock("sensor", DELAY)
    for step in range(0, 3600 * 30, 10):
        age = heard(clock, 40.0 + step / 30 * (1.0 + drift), EPOCH + step / 30, step / 30)
        assert age == pytest.approx(DELAY, abs=1e-3)


def test_a_quicker_message_is_news_and_a_stamp_far_ahead_is_another_clock() -> None:
    clock = StampClock("sensor", DELAY)
    heard(clock, 40.0, EPOCH + 3.0, 3.0)  # the first came 3 s late
    assert heard(clock, 43.1, EPOCH + 3.1, 3.1) == pytest.approx(DELAY)
    assert heard(clock, 60.0, EPOCH + 3.2, 3.2) == pytest.approx(DELAY - 16.8, abs=1e-3)
    assert heard(clock, 43.3, EPOCH + 3.3, 3.3) == pytest.approx(DELAY, abs=1e-3)
