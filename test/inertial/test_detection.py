"""Exchanged and slipped sensors are named, and sensors that are where they should be are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.calibration.clock_correlation import Series
from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.inertial.alignment import pose_covariance, pose_rotations, yaw
from body_tracking.inertial.clock import turning
from body_tracking.inertial.detection import (
    SLIP_TIME,
    SURE,
    SlipDetector,
    assign,
    likelihood_by_motion,
    likelihood_by_pose,
)
from body_tracking.inertial.simulated import usual_mounting
from body_tracking.kinematics.upper_body import UpperBody
from draws import draws

MODEL = UpperBody()
WORN = ("upper_trunk", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")
NUMBERS = [MODEL.segment_names.index(name) for name in WORN]
MEANT = np.array([so3.quat_to_matrix(usual_mounting(name).quat_xyzw).T for name in WORN])
LEFT_RIGHT = [0, 3, 2, 1, 4]
UPPER_LOWER = [0, 2, 1, 3, 4]


def turnings(seed: int, noise: float) -> tuple[list[Series], list[Series]]:
    """The rates of sensors and of bones: each limb has a motion of its own, a forearm also that of its upper arm."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 40.0, 0.02)
    knots = np.arange(0.0, 41.0, 0.4)
    own = np.array([np.interp(times, knots, np.abs(rng.normal(size=len(knots)))) for _ in WORN])
    own[2] += 0.7 * own[1]
    own[4] += 0.7 * own[3]
    measured = [turning(times, np.abs(each + noise * rng.normal(size=len(times)))) for each in own]
    seen = [turning(times[::2], np.abs(each[::2] + noise * rng.normal(size=len(times[::2])))) for each in own]
    return measured, seen


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4], LEFT_RIGHT, UPPER_LOWER], ids=["none", "left_right", "upper_lower"])
def test_a_skeleton_shows_which_sensors_are_exchanged(order: list[int]) -> None:
    for seed in range(3):
        measured, seen = turnings(seed, 0.3)
        found = assign(WORN, likelihood_by_motion([measured[number] for number in order], [None, *seen[1:]]))
        assert found == tuple(WORN[number] for number in order)


def held(rng: np.random.Generator, order: list[int]) -> FloatArray:
    """Measurements of sensors worn in an order in a T-pose."""
    pose = pose_rotations(MODEL, "t")[NUMBERS]
    off = rng.multivariate_normal(np.zeros(15), pose_covariance(MODEL, "t", WORN)).reshape(5, 3)
    mounted = MEANT @ so3.quat_to_matrix(so3.exp(np.radians(6.0) * rng.normal(size=(5, 3))))
    measured = pose @ so3.quat_to_matrix(so3.exp(off)) @ mounted.swapaxes(-1, -2)
    # the stream called WORN[n] is on the segment order[n]
    return (yaw(rng.uniform(-3.0, 3.0)) @ measured)[order]


@settings(max_examples=draws(8, 15), deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([[0, 1, 2, 3, 4], LEFT_RIGHT]))
def test_a_pose_of_sensors_with_magnetometers_tells_left_from_right(seed: int, order: list[int]) -> None:
    measured = held(np.random.default_rng(seed), order)
    pose = pose_rotations(MODEL, "t")[NUMBERS]
    found = assign(WORN, likelihood_by_pose(WORN, measured, pose, MEANT, common_heading=True))
    for number, name in enumerate(found):
        assert name.endswith(WORN[order[number]].rpartition("_")[2])


@settings(max_examples=draws(8, 15), deadline=None)
@given(st.integers(0, 2**31))
def test_a_t_pose_of_both_forearms_alone_exchanges_nothing(seed: int) -> None:
    """Exchanged sensors fit the pose turned by half a turn, and the person's heading is unknown."""
    arms = [WORN.index("forearm_left"), WORN.index("forearm_right")]
    names = tuple(WORN[number] for number in arms)
    measured = held(np.random.default_rng(seed), [0, 1, 2, 3, 4])[arms]
    pose = pose_rotations(MODEL, "t")[NUMBERS][arms]
    assert assign(names, likelihood_by_pose(names, measured, pose, MEANT[arms], common_heading=True)) == names


def test_limbs_that_move_alike_are_not_exchanged() -> None:
    """Each sensor fits the other's bone as well as its own; the difference is only the camera's error."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        (one, *_), _ = turnings(seed, 0.0)
        alike = [
            turning(one.stamps, np.abs(one.values[:, 0] + 0.1 * rng.normal(size=len(one.stamps)))) for _ in range(4)
        ]
        assert assign(WORN[:2], likelihood_by_motion(alike[:2], alike[2:])) == WORN[:2]


@settings(max_examples=draws(8, 15), deadline=None)
@given(st.integers(0, 2**31))
def test_a_pose_of_sensors_with_headings_of_their_own_tells_the_trunk_from_an_arm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = [1, 0, 2, 3, 4]
    # hanging arms: their sensors' x points down, that of the chest up
    pose = pose_rotations(MODEL, "n")[NUMBERS]
    off = so3.quat_to_matrix(so3.exp(np.radians(6.0) * rng.normal(size=(5, 3))))
    hanging = yaw(rng.uniform(-3.0, 3.0, 5)) @ pose @ off @ MEANT.swapaxes(-1, -2)
    found = assign(WORN, likelihood_by_pose(WORN, hanging[order], pose, MEANT, common_heading=False))
    assert found.index("upper_trunk") == 1


def test_uncertain_exchanges_are_not_reported() -> None:
    table = np.zeros((5, 5))
    table[1, 3] = table[3, 1] = SURE - 0.1
    assert assign(WORN, table) == WORN
    table[1, 3] = table[3, 1] = SURE + 0.1
    table[2, 4] = 0.5
    assert assign(WORN, table) == ("upper_trunk", "upper_arm_right", "forearm_left", "upper_arm_left", "forearm_right")


def test_similar_motion_of_an_arms_bones_causes_no_exchange() -> None:
    """Tables of a simulated person who reaches before a Kinect: first with exchanged forearms, then without."""
    names = ("upper_trunk", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")
    forearms = np.array(
        [
            [16.5, 0.2, 0.0, 1.5, 2.9],
            [0.2, 19.7, 20.7, 1.7, 0.8],
            [3.0, 1.0, 0.6, 12.7, 13.9],
            [3.8, 1.4, 0.8, 13.2, 15.1],
            [2.3, 11.3, 8.0, 2.1, 1.7],
        ]
    )
    assert assign(names, forearms) == (*names[:2], "forearm_right", "upper_arm_right", "forearm_left")
    right = np.array(
        [
            [17.6, 0.5, 0.1, 1.7, 3.2],
            [0.1, 20.6, 32.8, 0.0, 0.0],
            [0.3, 26.4, 31.8, 0.0, 0.0],
            [3.0, 0.0, 0.0, 21.1, 17.7],
            [3.6, 0.0, 0.0, 23.2, 19.4],
        ]
    )
    assert assign(names, right) == names


def test_a_slip_is_found_within_seconds_and_noise_and_outliers_are_none() -> None:
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 120.0, 0.1)
    fades = np.exp(-0.1 / 1.0)
    turn = np.array([0.0, np.radians(20.0), 0.0])
    detector, found = SlipDetector(), []
    error = rng.normal(size=3)
    for now in times.tolist():
        error = fades * error + np.sqrt(1.0 - fades**2) * rng.normal(size=3)
        seen = np.radians(4.0) * error + (turn if now > 90.0 else 0.0)
        if rng.random() < 0.1:
            seen = rng.normal(size=3)
        slip = detector.update(now, seen, float(np.radians(4.0)))
        if slip is not None:
            found.append((now, slip))
            break
    assert len(found) == 1
    assert 90.0 < found[0][0] < 90.0 + 1.5 * SLIP_TIME
    np.testing.assert_allclose(found[0][1], turn, atol=np.radians(10.0))


def test_a_slip_within_the_uncertainty_is_not_detected() -> None:
    detector = SlipDetector()
    turn = np.array([0.0, np.radians(20.0), 0.0])
    assert all(detector.update(0.1 * n, turn, float(np.radians(15.0))) is None for n in range(600))
    assert detector.update(0.0, np.full(3, np.nan), 0.1) is None
