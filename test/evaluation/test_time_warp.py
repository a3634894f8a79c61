"""Laws of aligning and comparing two recordings without a common clock."""

from __future__ import annotations

import numpy as np
import pytest
import time_warp
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import FloatArray
from body_tracking.evaluation.metrics import sample
from draws import draws


def movement(times: FloatArray) -> FloatArray:
    """Three features of an arm that is raised once and lowered again within some 3 s."""
    raised = np.exp(-(((times - 1.5) / 0.6) ** 2))
    return np.stack([raised, np.sin(2.0 * raised), np.exp(-(((times - 1.9) / 0.5) ** 2))], axis=1)


REFERENCE_TIMES = np.arange(0.0, 3.0, 0.01)
REFERENCE = movement(REFERENCE_TIMES)
TIMES = np.arange(0.0, 2.0, 1.0 / 30.0)


@settings(max_examples=draws(1, 10))
@given(offset=st.floats(0.0, 0.6), rate=st.floats(0.8, 1.2), bend=st.floats(-0.1, 0.1))
def test_a_smooth_warp_is_recovered(offset: float, rate: float, bend: float) -> None:
    true = offset + rate * TIMES + bend * np.sin(np.pi * TIMES / 2.0)
    warp = time_warp.estimate_warp(TIMES, movement(true), REFERENCE_TIMES, REFERENCE)
    at = warp(TIMES)
    inside = np.isfinite(at)
    assert inside.sum() > 30
    # the slower the movement, the less it determines the time: the error is weighted by the speed
    error = np.abs(movement(at) - movement(true))[inside]
    # at the ends the warp is held by one side only: offset 0.5, rate 0.8125, bend -0.09375 errs by 0.064 there
    assert np.quantile(error, 0.95) < 0.05 and error.max() < 0.1
    assert (np.diff(at[np.isfinite(at)]) > 0.0).all()
    assert warp.explained > 0.999


def test_a_recording_is_aligned_with_itself_by_no_warp() -> None:
    warp = time_warp.estimate_warp(REFERENCE_TIMES, REFERENCE, REFERENCE_TIMES, REFERENCE)
    at = warp(REFERENCE_TIMES)
    assert np.nanmax(np.abs(at - REFERENCE_TIMES)) < 0.005
    assert warp.rates == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_bias_and_scale_of_a_feature_are_no_differences_of_time() -> None:
    features = movement(0.3 + TIMES)
    plain = time_warp.estimate_warp(TIMES, features, REFERENCE_TIMES, REFERENCE)
    # all gains alike: one that differs would weigh a feature anew
    changed = time_warp.estimate_warp(TIMES, 1.3 * features + [5.0, -2.0, 0.1], REFERENCE_TIMES, REFERENCE)
    assert changed(TIMES) == pytest.approx(plain(TIMES), abs=1e-3, nan_ok=True)


@pytest.mark.slow
def test_noise_is_not_taken_for_time() -> None:
    # dynamic time warping shows this noise smaller than it is, by 22 % with all features and 42 % with the first alone
    generator = np.random.default_rng(5)
    noise = 0.05 * generator.standard_normal((len(TIMES), 3))
    true = 0.4 + TIMES
    noisy = movement(true) + noise
    at = time_warp.estimate_warp(TIMES, noisy, REFERENCE_TIMES, REFERENCE)(TIMES)
    measured = time_warp.compare(noisy[:, 0], sample(at, REFERENCE_TIMES, REFERENCE[:, 0])).debiased_rms
    assert measured == pytest.approx(noise[:, 0].std(), rel=0.15)


@pytest.mark.slow
def test_a_cycle_that_was_cut_elsewhere_is_continued() -> None:
    cycle = np.arange(0.0, 2.0, 0.01)

    def features(times: FloatArray) -> FloatArray:
        return np.stack([np.cos(np.pi * times), np.sin(np.pi * times) ** 3], axis=1)

    warp = time_warp.estimate_warp(TIMES, features(TIMES + 1.0), cycle, features(cycle), period=2.0)
    expected = np.mod(TIMES + 1.0, 2.0)
    apart = np.abs(warp(TIMES) - expected)
    assert np.minimum(apart, 2.0 - apart).max() < 0.03
    assert np.isfinite(warp(TIMES)).all()


@pytest.mark.slow
def test_the_opposite_movement_explains_nothing() -> None:
    raising = np.linspace(0.0, 1.0, 60)[:, None]
    times = np.arange(60) / 30.0
    assert time_warp.estimate_warp(times, raising, times, 1.0 - raising).explained == pytest.approx(0.0, abs=1e-9)


@given(
    values=st.lists(st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)), min_size=2, max_size=30),
    shift=st.floats(-50.0, 50.0),
)
def test_bias_and_debiased_rms_make_up_the_rms(values: list[tuple[float, float]], shift: float) -> None:
    estimate, reference = np.array(values).T
    one, other = time_warp.compare(estimate, reference), time_warp.compare(estimate + shift, reference)
    assert one.rms**2 == pytest.approx(one.bias**2 + one.debiased_rms**2, abs=1e-6)
    assert other.bias == pytest.approx(one.bias + shift, abs=1e-6)
    assert other.debiased_rms == pytest.approx(one.debiased_rms, abs=1e-6)


def test_only_common_samples_are_compared() -> None:
    reference = np.array([1.0, 2.0, 3.0, np.nan, 5.0])
    estimate = np.array([2.0, np.nan, 6.0, 8.0, 10.0])
    agreement = time_warp.compare(estimate, reference)
    assert agreement.samples == 3
    assert agreement.bias == pytest.approx(3.0)


def test_samples_lie_on_the_line_and_not_beyond_its_ends() -> None:
    times = np.array([0.0, 1.0, 3.0])
    values = np.array([[0.0, 1.0], [2.0, 1.0], [6.0, 1.0]])
    sampled = sample(np.array([-0.1, 0.0, 0.5, 2.0, 3.0, 3.1, np.nan]), times, values)
    assert np.isnan(sampled[[0, 5, 6]]).all()
    assert sampled[1:5] == pytest.approx(np.array([[0.0, 1.0], [1.0, 1.0], [4.0, 1.0], [6.0, 1.0]]))


def test_recordings_that_cannot_overlap_are_refused() -> None:
    with pytest.raises(ValueError, match="overlap"):
        time_warp.estimate_warp(10.0 * TIMES, movement(TIMES), REFERENCE_TIMES, REFERENCE)
