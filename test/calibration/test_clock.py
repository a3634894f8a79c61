"""Clock offsets are estimated from motion, for any poses of the sensors; times of arrival are only a prior."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.calibration.clock import LIKE, RECEIPT_PRIOR, correlate_clocks, joint_speeds
from body_tracking.calibration.clock_correlation import DRIFT_PRIOR, FINE_RANGE, MIN_STDDEV, ClockFit
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from walkers import walk


@cache
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


def test_without_motion_no_offset_is_found() -> None:
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
    """Equal at the guess, smaller far from it, and the smaller the less motion there was."""
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


def known(
    offset: float, drift: float, at: float, stddev: float = RECEIPT_PRIOR, drift_stddev: float = DRIFT_PRIOR
) -> ClockModel:
    """A clock in seconds; by default with the deviations of one from times of receipt."""
    return ClockModel(round(offset * NANOSECONDS), 1e6 * drift, round(at * NANOSECONDS), stddev, 1e6 * drift_stddev)


def offset_at(clock: ClockModel, time: float) -> float:
    return clock.offset_ns_at(round(time * NANOSECONDS)) / NANOSECONDS


@cache
def fitted(
    offset: float, drift: float, seconds: float = 55.0, expected: ClockModel | None = None, repeated: int = 1
) -> ClockModel:
    """The clock from windows of 5 s up to ``seconds``, each added ``repeated`` times."""
    return solved(seen(0.0, 0.0, 60.0, 4), seen(offset, drift, 60.0, 5), seconds, expected, repeated)


def solved(
    own: tuple[FloatArray, FloatArray],
    theirs: tuple[FloatArray, FloatArray],
    seconds: float,
    expected: ClockModel | None = None,
    repeated: int = 1,
) -> ClockModel:
    fit = ClockFit(like=LIKE)
    for start in np.repeat(np.arange(0.0, seconds, 5.0), repeated):
        window = (own[0] > start) & (own[0] <= start + 5.0)
        around = (theirs[0] > start - 2 * FINE_RANGE) & (theirs[0] <= start + 5.0 + 2 * FINE_RANGE)
        fit.add(
            start + 2.5,
            joint_speeds(own[0][window], own[1][window]),
            joint_speeds(theirs[0][around], theirs[1][around]),
        )
    found = fit.solve(expected)
    assert found is not None
    return found


@pytest.mark.parametrize(("offset", "drift"), [(0.0, 0.0), (0.03, 100e-6), (-0.06, -200e-6)])
def test_offset_and_drift_are_fitted_within_the_stated_uncertainty(offset: float, drift: float) -> None:
    found = fitted(offset, drift)
    assert 0.0 < found.stddev < 0.01
    assert 0.0 < found.drift_stddev_ppm < 400.0
    middle = found.anchor_ns / NANOSECONDS
    assert middle == pytest.approx(27.5, abs=10.0)
    for at in (0.0, middle, 60.0):
        stddev = found.stddev_at(round(at * NANOSECONDS))
        assert offset_at(found, at) == pytest.approx(offset + drift * at, abs=3 * stddev)
    for at in (0.0, 60.0):  # a third of a frame, half a minute away from the middle
        assert offset_at(found, at) == pytest.approx(offset + drift * at, abs=0.011)


@pytest.mark.parametrize("phase", [0.0, 0.013, 0.025])
def test_the_offset_does_not_follow_the_phase_of_the_frames(phase: float) -> None:
    """Samples half-way between two frames have half the noise, and so correlate better."""

    def seen_from(phase: float) -> tuple[FloatArray, FloatArray]:
        times = np.arange(0.0, 65.0, 1 / 30) + phase
        positions = walk(times, still=1.0)
        return times, positions + rng.normal(scale=0.006, size=positions.shape)

    rng = np.random.default_rng(1)
    found = solved(seen_from(0.0), seen_from(phase), 60.0)
    assert abs(found.offset) < min(0.005, found.stddev)


def test_a_shifted_stream_shifts_the_answer_by_as_much() -> None:
    plain, shifted = fitted(0.01, 0.0), fitted(0.01 + 0.05, 100e-6)
    for at, within in ((0.0, 0.008), (30.0, 0.005), (60.0, 0.008)):
        assert offset_at(shifted, at) - offset_at(plain, at) == pytest.approx(0.05 + 100e-6 * at, abs=within)


def test_times_of_receipt_are_weighted_as_a_prior() -> None:
    """They pull the estimate, by their share of the information; an offset beyond the fit's range is ignored."""
    for seconds in (15.0, 55.0):
        plain, drawn, other = (
            fitted(0.02, 0.0, seconds, None if expected is None else known(expected, 0.0, 2.0))
            for expected in (None, -0.05, 0.5)
        )
        share = (plain.stddev / RECEIPT_PRIOR) ** 2
        off = (plain.offset_ns - drawn.offset_ns_at(plain.anchor_ns)) / NANOSECONDS
        assert 0.0 < off < 2.0 * share * (plain.offset + 0.05)
        assert other == plain


def test_an_exactly_known_clock_is_kept() -> None:
    expected = known(0.03, 100e-6, 10.0, 1e-5, 1e-8)
    found = fitted(0.02, 0.0, expected=expected)
    for at in (0.0, 60.0):
        assert offset_at(found, at) == pytest.approx(offset_at(expected, at), abs=2e-5)
    assert found.stddev == pytest.approx(MIN_STDDEV, rel=0.01)
    assert found.drift_stddev_ppm == pytest.approx(1e-2, rel=0.01)


def test_repeated_motion_improves_the_drift_but_not_the_offset() -> None:
    once, often = fitted(0.02, 0.0), fitted(0.02, 0.0, repeated=6)
    floor = np.sqrt((once.stddev**2 - MIN_STDDEV**2) / 2.0 + MIN_STDDEV**2)  # after a minute half is common to all
    assert 0.95 * floor < often.stddev < once.stddev
    assert often.drift_stddev_ppm < 0.5 * once.drift_stddev_ppm


def test_an_offset_beyond_the_grid_is_no_answer() -> None:
    fit = ClockFit(like=LIKE)
    own, theirs = seen(0.0, 0.0, 20.0, 4), seen(0.4, 0.0, 20.0, 5)
    fit.add(10.0, joint_speeds(*own), joint_speeds(*theirs))
    assert fit.solve() is None
    assert ClockFit().solve() is None
