"""The noise model has the sensor's known weaknesses, and the body's heading does not depend on the sensor's place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.core.measurement import (
    BASE_STDDEV,
    HEAD_CORRELATION,
    INFERRED_FACTOR,
    back_view_factor,
    body_heading,
    joint_correlation,
    joint_stddev,
    joint_variance,
    left_right_axes,
    viewing_angle,
)
from body_tracking.core.skeleton import BONES, MIRROR, N_JOINTS, Joint
from walkers import TRACKED, about_y, walk

BODY = walk(np.zeros(1))[0]
AT_TWO_METRES = BODY - BODY[Joint.SPINE_MID] + [0.0, 0.0, 2.0]


def turned(degrees: float) -> np.ndarray:
    centre = AT_TWO_METRES[Joint.SPINE_SHOULDER]
    return (AT_TWO_METRES - centre) @ about_y(degrees).T + centre


@pytest.mark.parametrize("degrees", [0, 20, 45, 90, 135, 180, -60])
def test_viewing_angle_is_the_yaw_to_the_sensor(degrees: float) -> None:
    assert viewing_angle(turned(degrees)) == pytest.approx(np.radians(abs(degrees)), abs=0.02)


def test_swapped_sides_look_like_a_back() -> None:
    assert viewing_angle(AT_TWO_METRES[MIRROR]) == pytest.approx(np.pi, abs=0.02)
    assert_allclose(body_heading(AT_TWO_METRES[MIRROR]), -body_heading(AT_TWO_METRES))
    axes = left_right_axes(AT_TWO_METRES)
    for hidden, seen in (("HIP", axes[0]), ("SHOULDER", axes[1])):
        partly = AT_TWO_METRES.copy()
        partly[[Joint[f"{hidden}_LEFT"], Joint[f"{hidden}_RIGHT"]]] = np.nan
        both = np.stack([partly, AT_TWO_METRES])
        assert_allclose(body_heading(both), [seen, body_heading(AT_TWO_METRES)])


def test_noise_is_larger_from_the_side_from_afar_and_when_inferred() -> None:
    frontal = joint_stddev(AT_TWO_METRES, TRACKED)
    assert_allclose(frontal, BASE_STDDEV)
    assert_allclose(joint_stddev(turned(90), TRACKED), 3.2 * BASE_STDDEV, rtol=0.03)
    assert_allclose(joint_stddev(AT_TWO_METRES + [0.0, 0.0, 2.0], TRACKED), 2.0 * BASE_STDDEV)
    assert_allclose(joint_stddev(AT_TWO_METRES, TRACKED - 1), INFERRED_FACTOR * BASE_STDDEV)


def test_untracked_joints_have_infinite_noise() -> None:
    states = TRACKED.copy()
    states[Joint.HEAD] = 0
    positions = AT_TWO_METRES.copy()
    positions[Joint.FOOT_LEFT] = np.nan
    stddev = joint_stddev(positions, states)
    assert np.isinf(stddev[[Joint.HEAD, Joint.FOOT_LEFT]]).all()
    assert np.isfinite(np.delete(stddev, [Joint.HEAD, Joint.FOOT_LEFT])).all()


def test_stated_covariances_are_used() -> None:
    states = TRACKED.copy()
    states[Joint.HEAD] = 0
    assert_allclose(joint_variance(AT_TWO_METRES, states, None), joint_stddev(AT_TWO_METRES, states) ** 2)
    covariances = np.tile(np.diag([0.05**2, 0.06**2, 0.2**2]), (N_JOINTS, 1, 1))
    covariances[Joint.HAND_LEFT] = np.nan
    variance = joint_variance(AT_TWO_METRES, states, covariances)
    unknown = [Joint.HEAD, Joint.HAND_LEFT]
    assert np.isinf(variance[unknown]).all()
    assert_allclose(np.delete(variance, unknown), (0.05**2 + 0.06**2 + 0.2**2) / 3.0)
    # but not below the errors for which the correlation is known
    smaller = joint_variance(AT_TWO_METRES, states, 0.01 * covariances)
    assert_allclose(np.delete(smaller, unknown), np.delete(BASE_STDDEV**2, unknown))


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_a_back_that_is_taken_for_the_front_is_as_uncertain_as_a_back(degrees: float) -> None:
    front, back = turned(degrees), turned(180.0 - degrees)
    factor = back_view_factor(float(viewing_angle(front)))
    # the body's middle is 0.2 % farther away where it shows the back
    assert_allclose(factor * joint_stddev(front, TRACKED) ** 2, joint_stddev(back, TRACKED) ** 2, rtol=0.01)


@pytest.mark.parametrize("angle", [np.radians(90.0), np.radians(150.0), np.nan])
def test_a_frame_with_swapped_sides_is_less_certain_at_any_angle(angle: float) -> None:
    assert back_view_factor(angle) == 2.0


def test_frames_are_weighed_one_by_one_or_together() -> None:
    several = np.stack([turned(degrees) for degrees in (0, 30, 60)])
    states = np.broadcast_to(TRACKED, several.shape[:2])
    assert_allclose(joint_stddev(several, states), [joint_stddev(body, TRACKED) for body in several])
    assert_allclose(joint_stddev(several, states, viewing_angle(several)), joint_stddev(several, states))


@pytest.mark.parametrize("of_bones", [0.0, 0.5, 0.86])
def test_errors_of_joints_are_correlated_less_with_each_bone_between_them(of_bones: float) -> None:
    correlation = joint_correlation(of_bones)
    expected = np.eye(N_JOINTS)
    for parent, child in BONES:  # from the base outwards: a child is one bone farther from all others than its parent
        shared = min(of_bones, HEAD_CORRELATION) if child == Joint.HEAD else of_bones
        known = expected[parent] * shared
        known[child] = 1.0
        expected[child] = expected[:, child] = known
    assert_allclose(correlation, expected, atol=1e-9)
    assert np.linalg.eigvalsh(correlation)[0] > 0.0
