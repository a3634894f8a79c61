"""Clocks convert back and forth, lines are fitted with a true deviation, and delays only ever add."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core.clocks import (
    JUMP_BACK_NS,
    ClockModel,
    LeastDelay,
    ReceiptClock,
    clock_of_line,
    fit_clock,
    jumped_back,
)
from body_tracking.core.skeleton import NANOSECONDS

STAMPS = st.integers(0, 2_000_000_000 * NANOSECONDS)


@given(
    STAMPS,
    st.integers(-2_000_000_000, 2_000_000_000),
    st.floats(-500, 500),
    st.integers(0, 3600 * NANOSECONDS),
)
def test_a_clock_converts_back_and_forth_to_a_nanosecond(anchor: int, offset: int, drift: float, elapsed: int) -> None:
    clock = ClockModel(offset, drift, anchor)
    assert abs(clock.to_reference(clock.to_sensor(anchor + elapsed)) - (anchor + elapsed)) <= 1


@given(STAMPS, st.integers(-2_000_000_000, 2_000_000_000))
def test_without_drift_not_a_nanosecond_is_lost_even_since_an_epoch(stamp: int, offset: int) -> None:
    assert ClockModel(offset, 0.0, 0).to_reference(stamp + offset) == stamp


def test_fast_clock_gains_on_the_reference() -> None:
    clock = ClockModel(2 * NANOSECONDS, 100.0, 0)
    assert clock.to_sensor(10 * NANOSECONDS) == 12 * NANOSECONDS + 1_000_000
    assert clock.offset == 2.0


@given(STAMPS, STAMPS, STAMPS, st.integers(-2_000_000_000, 2_000_000_000), st.floats(-500, 500))
def test_a_clock_is_the_same_by_its_offset_at_another_time(
    anchor: int, other: int, at: int, offset: int, drift: float
) -> None:
    clock = ClockModel(offset, drift, anchor)
    moved = clock.carried_to(other)
    assert moved.anchor_ns == other
    # a float holds the product of drift and decades to a microsecond
    assert abs(moved.to_sensor(at) - clock.to_sensor(at)) <= 1000


def test_clock_uncertainty_grows_with_time() -> None:
    known = ClockModel(10**9, 20.0, 0, 0.003, 4.0)
    later_ns = 1000 * NANOSECONDS
    assert known.stddev_at(later_ns) == np.hypot(0.003, 0.004)
    carried = known.carried_to(later_ns, 3.0)
    assert carried.to_sensor(0) == known.to_sensor(0)
    assert carried.drift_stddev_ppm == 5.0
    assert carried.stddev == np.hypot(0.003, 0.005)
    assert ClockModel().stddev_at(later_ns) == np.inf


@given(STAMPS, STAMPS, st.integers(-(10**9), 10**9), st.floats(-500, 500))
def test_minus_and_plus_of_a_base_clock_are_inverse(anchor: int, other: int, offset: int, ppm: float) -> None:
    clock, base = ClockModel(offset, ppm, anchor, 0.01, 5.0), ClockModel(-offset, 20.0, other, 0.3, 50.0)
    both = clock.minus(base).plus(base)
    assert (both.offset_ns, both.anchor_ns, both.stddev) == (offset, anchor, 0.01)
    assert both.drift_ppm == pytest.approx(ppm, abs=1e-9)


def test_of_many_fitted_clocks_95_percent_are_within_the_stated_deviation() -> None:
    rng = np.random.default_rng(7)
    zero_ns, inside = 1_700_000_000 * NANOSECONDS, []
    for _ in range(500):
        times, drift = np.sort(rng.uniform(-60.0, 0.0, 20)), rng.normal(scale=50e-6)
        stddevs = rng.uniform(0.001, 0.02, 20)
        line, information = fit_clock(times, 0.3 + drift * times + stddevs * rng.normal(size=20), stddevs, 50e-6)
        found = clock_of_line(line, information, zero_ns)
        for later in (-60, 0, 600):
            at_ns = zero_ns + later * NANOSECONDS
            error = found.offset_ns_at(at_ns) / NANOSECONDS - (0.3 + drift * later)
            inside.append(abs(error) < 1.96 * found.stddev_at(at_ns))
    assert 0.93 < np.mean(inside) < 0.97


@given(st.lists(st.tuples(st.integers(1, 20), st.integers(-50, 50)), min_size=1), st.sampled_from([1, 30, 100]))
def test_the_least_delay_is_that_of_the_window(steps: list[tuple[int, int]], window: int) -> None:
    least, seen, time = LeastDelay(window), list[tuple[int, int]](), 0
    for step, delay in steps:
        time += step
        seen.append((time, delay))
        least.add(time, delay)
        assert least.least == min(each for at, each in seen if time - at < window)


def test_receipt_clock_detects_a_set_clock_and_follows_drift() -> None:
    clock = ReceiptClock()
    for second in range(600):
        now = second * NANOSECONDS
        assert clock.add(round(now * (1.0 - 100e-6)), now)
        assert clock.delay_ns is not None
        assert 0 <= 100e-6 * now - clock.delay_ns <= 100e-6 * ReceiptClock.WINDOW_NS
    assert not clock.add(700 * NANOSECONDS, 600 * NANOSECONDS)
    assert clock.delay_ns == -100 * NANOSECONDS


@given(STAMPS, st.integers(0, 10 * NANOSECONDS))
def test_time_jumps_back_by_more_than_frames_are_late(last: int, behind: int) -> None:
    assert jumped_back(last - behind, last) == (behind > JUMP_BACK_NS)
    assert not jumped_back(last, None)
