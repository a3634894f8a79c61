"""Orientations of segments give the configuration back, with large variances where no sensor observes it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.inertial.posture import OrientationKinematics
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws

MODEL = UpperBody()
LENGTHS = MODEL.default_lengths()
SEEDS = st.integers(0, 2**32 - 1)


def configuration(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return RandomMotion(rng, 4.0).configuration(np.array([2.0]))[0]


def sharp(count: int, degrees: float = 0.05) -> FloatArray:
    return np.broadcast_to(np.radians(degrees) ** 2 * np.eye(3), (count, 3, 3))


@settings(max_examples=draws(12, 25), deadline=None)
@given(SEEDS)
def test_all_segments_give_the_configuration_back(seed: int) -> None:
    q = configuration(seed)
    rotations = MODEL.forward(q, LENGTHS).rotations
    found, covariance = OrientationKinematics(MODEL, MODEL.segment_names).solve(rotations, sharp(12))
    again = MODEL.forward(found, LENGTHS).rotations
    assert np.degrees(np.abs(so3.rotation_vectors(again.swapaxes(-1, -2) @ rotations))).max() < 0.1
    np.testing.assert_allclose(MODEL.difference(q, found)[3:], 0.0, atol=np.radians(0.5))
    assert np.isinf(covariance.diagonal()[:3]).all()
    assert np.degrees(np.sqrt(covariance.diagonal()[3:])).max() < 0.5


@settings(max_examples=draws(8, 15), deadline=None)
@given(SEEDS)
def test_errors_agree_with_the_covariance_and_unobserved_angles_keep_their_ranges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    worn = ("pelvis", "upper_trunk", "upper_arm_left", "forearm_left")
    numbers = [MODEL.segment_names.index(name) for name in worn]
    q = configuration(seed)
    noise = so3.quat_to_matrix(so3.exp(np.radians(3.0) * rng.normal(size=(4, 3))))
    rotations = MODEL.forward(q, LENGTHS).rotations[numbers] @ noise
    found, covariance = OrientationKinematics(MODEL, worn).solve(rotations, sharp(4, 3.0))
    names = MODEL.coordinate_names
    seen = [names.index("elbow_flexion_left"), names.index("forearm_pronation_left"), 3, 4, 5]
    off = MODEL.difference(found, q)[seen]
    assert (np.abs(off) < 4.5 * np.sqrt(covariance[seen, seen])).all()
    assert np.sqrt(covariance[seen, seen]).max() < np.radians(6.0)
    unseen = names.index("elbow_flexion_right")
    assert np.sqrt(covariance[unseen, unseen]) > np.radians(20.0)
