"""Parts of motions end at their targets, at rest, and without jumps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from body_tracking.kinematics.trajectories import Moves, Waves, eased, minimum_jerk


@given(st.floats(0.5, 30.0), st.floats(0.05, 0.5))
def test_an_eased_way_is_gone_at_a_rate_of_1_between_two_rests(way: float, ramp: float) -> None:
    times = np.linspace(-1.0, way + ramp + 1.0, 2001)
    gone = eased(times, way, ramp)
    assert_allclose(gone[times <= 0.0], 0.0, atol=1e-12)
    assert_allclose(gone[times >= way + ramp], way, atol=1e-9)
    rate = np.gradient(gone, times)
    assert rate.min() > -1e-9 and rate.max() < 1.0 + 1e-9
    steady = (times > ramp + 0.05) & (times < way - 0.05)
    assert_allclose(rate[steady], 1.0, atol=1e-6)


def test_the_rate_of_an_eased_way_is_minimum_jerk() -> None:
    times, step = np.linspace(-0.2, 3.0, 400), 1e-5
    rate = (eased(times + step, 2.0, 0.5) - eased(times - step, 2.0, 0.5)) / (2.0 * step)
    assert_allclose(rate, minimum_jerk(times / 0.5) - minimum_jerk((times - 2.0) / 0.5), atol=1e-8)


def test_moves_go_from_target_to_target_and_wait_for_each_other() -> None:
    moves = Moves(np.array([0.0, 1.0]))
    moves.move(1.0, 2.0, np.array([4.0, 1.0]))
    moves.move(2.0, 1.0, np.array([4.0, 5.0]))  # too soon: it begins when the first one ends
    assert moves.end == 4.0
    assert_allclose(
        moves.at(np.array([0.0, 1.0, 2.0, 3.0, 3.5, 9.0])), [[0, 1], [0, 1], [2, 1], [4, 1], [4, 3], [4, 5]]
    )


@given(st.integers(0, 2**32 - 1))
def test_waves_stay_between_minus_1_and_1(seed: int) -> None:
    waves = Waves(np.random.default_rng(seed), 5, 0.8).at(np.linspace(0.0, 100.0, 500))
    assert waves.shape == (500, 5) and np.abs(waves).max() <= 1.0 and waves.std(axis=0).min() > 0.1
