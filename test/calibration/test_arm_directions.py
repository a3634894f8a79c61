"""Laws of the directions of a Kinect v2's arms: its inverse, mirror and frame; the fit finds it again."""

from __future__ import annotations

import numpy as np
import pytest
from kinect_vs_vicon import fit_arm_law
from scipy.spatial.transform import Rotation

from body_tracking.calibration.arm_directions import KINECT_V2, ArmLaw, corrected_arms, turn_arms
from body_tracking.calibration.joint_centres import body_axes
from body_tracking.core.skeleton import BONES, MIRROR, FloatArray, Joint, TrackingState
from walkers import performed, tracked

POSE = performed("reaching", np.array([6.0]))[0]
RNG = np.random.default_rng(1)
MOVED = [joint for joint in Joint if joint.name.startswith(("ELBOW", "WRIST", "HAND", "THUMB"))]


def random_directions(count: int) -> FloatArray:
    """(n, 2, 3) unit vectors."""
    vectors = RNG.normal(size=(count, 2, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def arms(positions: FloatArray) -> FloatArray:
    """(2, 2, 3) upper arm and forearm, left and right, in the thorax's axes."""
    bones = [
        [positions[Joint[f"{b}_{side}"]] - positions[Joint[f"{a}_{side}"]] for a, b in pairs]
        for side in ("LEFT", "RIGHT")
        for pairs in [(("SHOULDER", "ELBOW"), ("ELBOW", "WRIST"))]
    ]
    return np.array(bones) @ body_axes(positions)


def test_measured_is_the_inverse_of_anatomical() -> None:
    directions = random_directions(2000)
    assert np.abs(KINECT_V2.anatomical(KINECT_V2.measured(directions)) - directions).max() < 1e-12
    assert np.abs(KINECT_V2.measured(KINECT_V2.anatomical(directions)) - directions).max() < 1e-12


def test_a_lifted_arm_is_lowered_and_a_stretched_elbow_bent() -> None:
    """As in the recordings: a gain of elevation above 1 to the side, elbows 6 to 10 degrees too straight."""
    side = np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 0.0]])
    upper, forearm = KINECT_V2.anatomical(side)
    assert upper[2] < -0.05
    assert 3.0 < np.degrees(np.arccos(upper @ forearm)) < 12.0


def test_the_fit_finds_a_law_again_and_subjects_weigh_alike() -> None:
    law = ArmLaw(0.05 * RNG.normal(size=(3, 4)), 0.05 * RNG.normal(size=(3, 7)))
    measured = random_directions(3000)
    u, f = measured[:, 0], measured[:, 1]
    one = np.ones((len(u), 1))
    linear = [np.hstack([one, u]) @ law.upper.T, np.hstack([one, u, f]) @ law.forearm.T]
    fitted = fit_arm_law([("a", measured, measured + np.stack(linear, axis=1))], 1e-9)
    assert np.allclose(fitted.upper, law.upper, atol=1e-6) and np.allclose(fitted.forearm, law.forearm, atol=1e-6)
    more = [("a", measured, law.anatomical(measured))] * 3 + [("b", measured, measured)]
    half = fit_arm_law(more, 1e-9)
    even = fit_arm_law([more[0], more[-1]], 1e-9)
    assert np.allclose(half.upper, even.upper) and np.allclose(half.forearm, even.forearm)


def test_correction_turns_arms_alone_keeps_lengths_and_follows_the_body() -> None:
    body = POSE
    found = corrected_arms(tracked(body)).positions
    still = [joint for joint in Joint if joint not in MOVED]
    assert np.array_equal(found[still], body[still])
    for parent, child in BONES:
        assert np.linalg.norm(found[child] - found[parent]) == pytest.approx(np.linalg.norm(body[child] - body[parent]))
    assert np.allclose(turn_arms(found, body_axes(found), KINECT_V2.measured), body)
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 2.0])
    assert np.allclose(corrected_arms(tracked(turn.apply(body) + 1.0)).positions, turn.apply(found) + 1.0)


def test_left_is_the_mirror_of_right() -> None:
    body = POSE
    mirrored = (body * [1.0, -1.0, 1.0])[MIRROR]
    assert np.allclose(
        corrected_arms(tracked(mirrored)).positions,
        (corrected_arms(tracked(body)).positions * [1.0, -1.0, 1.0])[MIRROR],
    )
    law_of_right = KINECT_V2.anatomical(arms(body)[1] / np.linalg.norm(arms(body)[1], axis=-1, keepdims=True))
    found = arms(corrected_arms(tracked(body)).positions)[1]
    assert np.allclose(found / np.linalg.norm(found, axis=-1, keepdims=True), law_of_right)


@pytest.mark.parametrize("missing", [Joint.SPINE_MID, Joint.SHOULDER_LEFT, Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT])
def test_unknown_joints_leave_the_others_unchanged(missing: Joint) -> None:
    frame = tracked(POSE.copy())
    frame.positions[missing] = np.nan
    frame.states[missing] = TrackingState.NOT_TRACKED
    found = corrected_arms(frame).positions
    assert np.array_equal(np.isfinite(found), np.isfinite(frame.positions))
    thorax = missing == Joint.SHOULDER_LEFT
    assert np.array_equal(found[Joint.ELBOW_LEFT], frame.positions[Joint.ELBOW_LEFT]) == thorax


def test_the_thorax_of_a_person_at_a_table_counts_as_upright() -> None:
    frame, whole = tracked(POSE.copy()), tracked(POSE.copy())
    frame.positions[Joint.SPINE_MID] = np.nan
    frame.states[Joint.SPINE_MID] = TrackingState.NOT_TRACKED
    whole.positions[Joint.SPINE_MID] = POSE[Joint.SPINE_SHOULDER] - [0.0, 0.0, 0.3]
    seen = [joint for joint in Joint if joint != Joint.SPINE_MID]
    assert np.allclose(corrected_arms(frame).positions[seen], corrected_arms(whole).positions[seen])
