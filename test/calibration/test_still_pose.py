"""The thesis's calibration: an averaged still pose, detected."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.still_pose import FRAMES, is_still, is_t_pose, still_pose_registration
from body_tracking.simulation.bags import true_positions
from body_tracking.simulation.motions import MOTIONS
from walkers import OPTICAL_FROM_LEVEL, about_y, walk

TIMES = np.arange(FRAMES) / 30.0
POSE = true_positions(MOTIONS[0], np.array([1.0]))[0] @ OPTICAL_FROM_LEVEL.T


def repeated(noise: float = 0.008) -> np.ndarray:
    rng = np.random.default_rng(0)
    return POSE + rng.normal(scale=noise, size=(FRAMES, 25, 3))


def test_a_noisy_still_pose_is_still_and_a_walk_is_not() -> None:
    assert is_still(TIMES, repeated())
    assert not is_still(TIMES, walk(5.0 + TIMES))


def test_too_few_frames_or_too_slow_ones_are_not_a_pose() -> None:
    assert not is_still(TIMES[:-1], repeated()[:-1])
    assert not is_still(TIMES * 5.0, repeated())


def test_a_body_that_is_not_seen_is_not_still() -> None:
    assert not is_still(TIMES, np.full((FRAMES, 25, 3), np.nan))


def test_the_t_pose_is_recognised() -> None:
    assert is_t_pose(POSE)
    hanging = true_positions(MOTIONS[1], np.array([MOTIONS[1].duration]))[0]
    assert is_t_pose(hanging) == (abs(hanging[6, 2] - hanging[4, 2]) < 0.2)
    arms_down = POSE.copy()
    arms_down[[6, 10]] = POSE[[4, 8]] + [0.0, 0.5, 0.0]
    assert not is_t_pose(arms_down)


def test_the_averages_are_registered_on_what_both_track() -> None:
    rotation = about_y(60.0)
    states = np.full((FRAMES, 25), 2)
    theirs = (repeated() - [1.0, 0.2, 0.3]) @ rotation
    inferred = states.copy()
    theirs[:, 7] += 0.5  # wrong, and the sensor says so
    inferred[:, 7] = 1
    found, moved, residual = still_pose_registration((repeated(), states), (theirs, inferred))
    assert_allclose(found, rotation, atol=1e-6)
    assert_allclose(moved, [1.0, 0.2, 0.3], atol=1e-6)
    assert residual < 1e-6


def test_nothing_tracked_by_both_is_refused() -> None:
    states = np.full((FRAMES, 25), 2)
    with pytest.raises(CalibrationError, match="0 joints"):
        still_pose_registration((repeated(), states), (repeated(), np.ones_like(states)))
