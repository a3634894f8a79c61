"""Clock offsets come from motion alone: whatever the sensors' places, and not from the arrival of messages."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.calibration.clock import FINE_RANGE, RECEIPT_PRIOR, ClockFit, correlate_clocks
from body_tracking.skeleton import FloatArray
from walkers import walk


def seen(offset: float, drift: float, seconds: float, seed: int, noise: float = 0.004) -> tuple[FloatArray, FloatArray]:
    """Stamps in a clock and noisy positions in some frame, of the same walk."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 1 / 30) + rng.uniform(0.0, 1 / 30)
    rotation = Rotation.random(None, rng).as_matrix()
    positions = walk(times, still=1.0) @ rotation.T + rng.normal(size=3)
    return times * (1.0 + drift) + offset, positions + rng.normal(scale=noise, size=positions.shape)


@pytest.mark.parametrize("offset", [-2.0, -0.37, 0.0, 0.11, 2.0])
def test_an_offset_of_seconds_is_found_without_knowing_the_poses(offset: float) -> None:
    found = correlate_clocks(seen(0.0, 0.0, 12.0, 1), seen(offset, 0.0, 12.0, 2), 0.0, 3.0)
    assert found is not None
    assert found.offset == pytest.approx(offset, abs=0.02)
    assert found.correlation > 0.8
    assert found.margin > 0.08


def test_nobody_moving_says_nothing() -> None:
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 12.0, 1 / 30)
    still = np.broadcast_to(walk(np.zeros(1))[0], (len(times), 25, 3))
    both = [(times, still + rng.normal(scale=0.004, size=still.shape)) for _ in range(2)]
    found = correlate_clocks(*both, 0.0, 3.0)
    assert found is None or found.correlation < 0.4


def test_a_periodic_motion_is_placed_next_to_the_guess() -> None:
    times = np.arange(0.0, 15.0, 1 / 30)
    body = walk(np.zeros(1))[0]

    def swing(at: FloatArray) -> FloatArray:
        shift = 0.2 * np.sin(2 * np.pi * at / 1.5) + 0.1 * np.sin(4 * np.pi * at / 1.5 + 1.0)
        return body + shift[:, None, None] * np.array([1.0, 0.0, 0.0])

    found = correlate_clocks((times, swing(times)), (times + 1.2, swing(times)), 1.1, 3.0)
    assert found is not None
    assert found.offset == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize("offset", [0.0, 0.4, 2.0])
def test_a_likely_correlation_is_no_more_than_the_correlation(offset: float) -> None:
    """The same at the guess; far from it less, and the less motion there was the lesser."""
    long, short = (
        correlate_clocks(seen(0.0, 0.0, seconds, 1), seen(offset, 0.0, seconds, 2), 0.0, 3.0)
        for seconds in (24.0, 12.0)
    )
    assert long is not None
    assert short is not None
    assert short.likely <= short.correlation
    if offset == 0.0:
        assert short.likely > short.correlation - 0.02
    else:
        assert short.correlation - short.likely > long.correlation - long.likely > 0.0


def test_too_little_overlap_is_no_answer() -> None:
    a, b = seen(0.0, 0.0, 12.0, 1), seen(0.0, 0.0, 12.0, 2)
    assert correlate_clocks((a[0][:5], a[1][:5]), b, 0.0, 3.0) is None
    assert correlate_clocks((a[0][:40], a[1][:40]), (b[0][300:], b[1][300:]), 0.0, 0.5) is None


def fitted(offset: float, drift: float, seconds: float = 60.0) -> tuple[float, float, float]:
    own, theirs = seen(0.0, 0.0, seconds, 4), seen(offset, drift, seconds, 5)
    fit = ClockFit(0.0)
    for start in np.arange(0.0, seconds - 5.0, 5.0):
        window = (own[0] > start) & (own[0] <= start + 5.0)
        around = (theirs[0] > start - 2 * FINE_RANGE) & (theirs[0] <= start + 5.0 + 2 * FINE_RANGE)
        fit.add(start + 2.5, (own[0][window], own[1][window]), (theirs[0][around], theirs[1][around]))
    found = fit.solve()
    assert found is not None
    return found


@pytest.mark.parametrize(("offset", "drift"), [(0.0, 0.0), (0.03, 100e-6), (-0.06, -200e-6)])
def test_offset_and_drift_are_fitted_within_the_stated_uncertainty(offset: float, drift: float) -> None:
    found_offset, found_drift, stddev = fitted(offset, drift)
    assert 0.0 < stddev < 0.01
    assert found_offset + found_drift * 30.0 == pytest.approx(offset + drift * 30.0, abs=3 * stddev)
    for at in (0.0, 60.0):  # a third of a frame, half a minute away from the middle
        assert found_offset + found_drift * at == pytest.approx(offset + drift * at, abs=0.011)


def test_a_shifted_stream_shifts_the_answer_by_as_much() -> None:
    plain, shifted = fitted(0.01, 0.0), fitted(0.01 + 0.05, 100e-6)
    for at, within in ((0.0, 0.008), (30.0, 0.005), (60.0, 0.008)):
        difference = (shifted[0] - plain[0]) + (shifted[1] - plain[1]) * at
        assert difference == pytest.approx(0.05 + 100e-6 * at, abs=within)


def test_the_times_of_receipt_help_as_much_as_the_motion_leaves_open() -> None:
    """The estimate is drawn to what they say, the less the more motion there was; to what cannot be, not at all."""
    own, theirs = seen(0.0, 0.0, 60.0, 4), seen(0.02, 0.0, 60.0, 5)

    def off(expected: float | None, windows: int) -> tuple[float, float]:
        fit = ClockFit(0.0, None if expected is None else (expected, 2.0))
        for start in 5.0 * np.arange(windows):
            window = (own[0] > start) & (own[0] <= start + 5.0)
            around = (theirs[0] > start - 2 * FINE_RANGE) & (theirs[0] <= start + 5.0 + 2 * FINE_RANGE)
            fit.add(start + 2.5, (own[0][window], own[1][window]), (theirs[0][around], theirs[1][around]))
        found = fit.solve()
        assert found is not None
        return found[0], found[2]

    for windows in (3, 11):
        plain, stddev = off(None, windows)
        drawn, _ = off(-0.05, windows)
        share = (stddev / RECEIPT_PRIOR) ** 2
        assert 0.0 < plain - drawn < 2.0 * share * (plain + 0.05)
        assert off(0.5, windows) == (plain, stddev)


def test_an_offset_beyond_the_grid_is_no_answer() -> None:
    fit = ClockFit(0.0)
    own, theirs = seen(0.0, 0.0, 20.0, 4), seen(0.4, 0.0, 20.0, 5)
    fit.add(10.0, own, theirs)
    assert fit.solve() is None
    assert ClockFit(0.0).solve() is None
