"""The thesis's calibration: an averaged still pose, detected."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.still_pose import FRAMES, is_still, is_t_pose, still_pose_registration
from body_tracking.core.skeleton import FloatArray
from body_tracking.simulation.repertoire import make_movement
from walkers import ABOUT_FACE, OPTICAL_FROM_LEVEL, PERSON, about_y, performed, walk

TIMES = np.arange(FRAMES) / 30.0


def seen(motion: str, time: float) -> FloatArray:
    """(25, 3) metres of a person 2 m in front of a sensor at a height of 0.9 m."""
    pose = performed(motion, np.array([time]))[0] * ABOUT_FACE + [2.0, 0.0, -0.9]
    return np.asarray(pose @ OPTICAL_FROM_LEVEL.T)


POSE = seen("two_handed_wave", 1.0)


def repeated(noise: float = 0.008) -> np.ndarray:
    rng = np.random.default_rng(0)
    return POSE + rng.normal(scale=noise, size=(FRAMES, 25, 3))


def test_a_noisy_still_pose_is_still() -> None:
    """A walk is not, nor are too few or too slow frames, nor an unseen body."""
    assert is_still(TIMES, repeated())
    assert not is_still(TIMES, walk(5.0 + TIMES))
    assert not is_still(TIMES[:-1], repeated()[:-1])
    assert not is_still(TIMES * 5.0, repeated())
    assert not is_still(TIMES, np.full((FRAMES, 25, 3), np.nan))


def test_the_t_pose_is_recognised() -> None:
    assert is_t_pose(POSE[None])
    assert is_t_pose(seen("slow_down", make_movement("slow_down", PERSON).duration)[None])
    assert not is_t_pose(seen("standing_still", 1.0)[None])
    arms_down = POSE.copy()
    arms_down[[6, 10]] = POSE[[4, 8]] + [0.0, 0.5, 0.0]
    assert not is_t_pose(arms_down[None])
    assert not is_t_pose(np.where(np.arange(25)[:, None] == 6, np.nan, POSE)[None])


def test_averages_are_registered_on_joints_that_both_track() -> None:
    rotation = about_y(60.0)
    states = np.full((FRAMES, 25), 2)
    theirs = (repeated() - [1.0, 0.2, 0.3]) @ rotation
    inferred = states.copy()
    theirs[:, 7] += 0.5  # wrong, and stated as inferred
    inferred[:, 7] = 1
    found, moved, residual = still_pose_registration((repeated(), states), (theirs, inferred))
    assert_allclose(found, rotation, atol=1e-6)
    assert_allclose(moved, [1.0, 0.2, 0.3], atol=1e-6)
    assert residual < 1e-6
    with pytest.raises(CalibrationError, match="0 joints"):
        still_pose_registration((repeated(), states), (repeated(), np.ones_like(states)))
