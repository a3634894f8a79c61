"""Angles of chains: as exact as required and as stated, continuous, and NaN where they are not observed."""

from __future__ import annotations

import numpy as np
import pytest
from marker_people import measured, random_posture
from markers_lab import random_joint
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.angles import AngleError, AngleEstimator, ChainAngles
from body_tracking.markers.chain import Chain, JointDescription, fit_chain
from body_tracking.markers.joint_model import SIZE, JointKind, turn_angles
from body_tracking.markers.joint_tree import Posture, Tree, place, tree_of
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.pose_table import PoseTableError
from draws import draws

ARM = (
    ("shoulder", "torso", "upper_arm", JointKind.BALL),
    ("elbow", "upper_arm", "forearm", JointKind.HINGE),
    ("wrist", "forearm", "hand", JointKind.UNIVERSAL),
)


def arm(seed: int, joints: tuple[tuple[str, str, str, JointKind], ...] = ARM) -> tuple[np.random.Generator, Tree]:
    rng = np.random.default_rng(seed)
    return rng, tree_of([random_joint(rng, kind, name, parent, child) for name, parent, child, kind in joints])


def known(tree: Tree) -> Chain:
    size = SIZE * len(tree.joints)
    return Chain(tree.joints, np.zeros((size, size)), np.zeros((size, 0)))


def turn_errors(found: list[ChainAngles], posture: Posture, joint: int) -> FloatArray:
    """(n, 3) rotation vectors of the errors of a joint's turns."""
    turns = np.stack([each.rotations[joint] for each in found])
    return so3.rotation_vectors(turns @ posture.turns[joint].swapaxes(-1, -2))


def rms_deg(errors: FloatArray) -> float:
    return float(np.degrees(np.sqrt((errors**2).sum(axis=-1).mean())))


def cardan(turns: FloatArray, near: FloatArray) -> FloatArray:
    """(n, 3) angles about x, y and z of turns, of the two solutions the one nearer to some angles."""
    first = Rotation.from_matrix(turns).as_euler("XYZ")
    second = np.array([np.pi, np.pi, np.pi]) + first * [1, -1, 1]
    distance = [np.abs(np.exp(1j * each) - np.exp(1j * near)).sum(axis=1) for each in (first, second)]
    return np.where((distance[0] < distance[1])[:, None], first, second)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "bar"), [(JointKind.BALL, 0.17), (JointKind.HINGE, 0.125)])
def test_angles_of_a_single_joint_reach_the_bars(kind: JointKind, bar: float) -> None:
    """With a joint that was fitted to another recording."""
    errors, inside, stated, outer = [], [], [], []
    for seed in range(draws(2, 20)):
        rng, tree = arm(seed, (("joint", "upper", "lower", kind),))
        frames = measured(rng, tree, random_posture(rng, tree, draws(400, 2000)))
        estimator = AngleEstimator(fit_chain(frames, [JointDescription("joint", "upper", "lower", kind)]).chain)
        posture = random_posture(rng, tree, 300)
        found = [estimator.estimate(frame) for frame in measured(rng, tree, posture)]
        error = turn_errors(found, posture, 0)
        errors.append(error)
        covariance = np.stack([each.rotation_covariance[0] for each in found])
        stated.append(np.trace(covariance, axis1=1, axis2=2))
        deviation = np.sqrt(np.einsum("nii->ni", covariance))
        axes = [2] if kind is JointKind.HINGE else [0, 1, 2]
        inside.append((np.abs(error) <= 1.96 * deviation)[:, axes])
        angles = np.stack([each.angles for each in found])
        true = cardan(posture.turns[0], angles) if kind is JointKind.BALL else turn_angles(kind, posture.turns[0])
        apart = np.abs(np.exp(1j * angles) - np.exp(1j * true))
        far = np.abs(np.cos(true[:, 1])) > 0.2 if kind is JointKind.BALL else np.ones(len(true), dtype=bool)
        outer.append((apart <= 1.96 * np.stack([each.stddev for each in found]))[far])
    error_deg, share, named = rms_deg(np.concatenate(errors)), np.mean(inside), np.concatenate(outer).mean()
    print(
        kind, f"{error_deg:.4f} deg, stated {np.degrees(np.sqrt(np.mean(stated))):.4f}, 95 %: {share:.3f}, {named:.3f}"
    )
    assert error_deg < bar
    assert 0.92 < share < 0.98 and 0.92 < named < 0.98


@pytest.mark.slow
def test_all_angles_of_an_arm_are_as_exact_as_stated_and_continuous() -> None:
    inside = []
    for seed in range(draws(1, 15)):
        rng, tree = arm(20 + seed)
        frames = measured(rng, tree, random_posture(rng, tree, 500), lost=0.05)
        description = [JointDescription(joint.name, joint.parent, joint.child, joint.kind) for joint in tree.joints]
        estimator = AngleEstimator(fit_chain(frames, description).chain)
        posture = random_posture(rng, tree, 400)
        found = [estimator.estimate(frame) for frame in measured(rng, tree, posture)]
        assert found[0].names == ("shoulder_x", "shoulder_y", "shoulder_z", "elbow", "wrist_1", "wrist_2")
        angles = np.stack([each.angles for each in found])
        assert np.abs(np.diff(angles[:, 3:], axis=0)).max() < np.radians(25.0)
        assert np.abs(np.diff(angles, axis=0)).max() < np.pi
        true = np.concatenate([turn_angles(tree.joints[i].kind, posture.turns[i]) for i in (1, 2)], axis=1)
        apart = np.abs(np.exp(1j * angles[:, 3:]) - np.exp(1j * true))
        inside.append(apart <= 1.96 * np.stack([each.stddev[3:] for each in found]))
        scale = np.sqrt(np.mean([each.scale**2 for each in found]))
        assert 0.9 < scale < 1.1
        assert max(each.gaps.max() for each in found) < 3e-3
    share = np.mean(inside)
    print(f"arm: 95 %: {share:.3f}")
    assert 0.92 < share < 0.98


def test_the_whole_is_more_exact_than_the_difference_of_orientations() -> None:
    """Positions carry as much information on an angle as orientations, so one fit uses both (Gaschler eq. 5.15)."""
    rng, tree = arm(40, ARM[1:2])
    posture = random_posture(rng, tree, 400)
    frames = measured(rng, tree, posture)
    estimator = AngleEstimator(known(tree))
    found = [estimator.estimate(frame) for frame in frames]
    joint = tree.joints[0]
    relative = np.stack([frame[0].rotation.T @ frame[1].rotation for frame in frames])
    plain = turn_angles(joint.kind, joint.parent_rotation.T @ relative @ joint.child_rotation)
    true = turn_angles(joint.kind, posture.turns[0])
    errors = [
        np.abs(np.exp(1j * angles) - np.exp(1j * true)) for angles in (np.stack([each.angles for each in found]), plain)
    ]
    assert np.sqrt((errors[0] ** 2).mean()) < 0.9 * np.sqrt((errors[1] ** 2).mean())


def test_a_target_that_is_not_seen_takes_its_angles_only() -> None:
    rng, tree = arm(50)
    posture = random_posture(rng, tree, 60)
    estimator = AngleEstimator(known(tree))
    for number, frame in enumerate(measured(rng, tree, posture)):
        whole = estimator.estimate(frame)
        assert np.isfinite(whole.angles).all()
        if number % 3:
            continue
        without_hand = estimator.estimate([pose for pose in frame if pose.name != "hand"])
        assert np.isnan(without_hand.angles[4:]).all() and np.isinf(without_hand.stddev[4:]).all()
        assert np.isfinite(without_hand.angles[:4]).all() and np.isnan(without_hand.gaps[2])
        assert (np.abs(without_hand.angles[:4] - whole.angles[:4]) < 6.0 * without_hand.stddev[:4] + 1e-4).all()
        # hand and upper arm still determine both joints of the forearm
        without_forearm = estimator.estimate([pose for pose in frame if pose.name != "forearm"])
        assert (np.abs(without_forearm.angles[3:] - whole.angles[3:]) < 6.0 * without_forearm.stddev[3:]).all()
        assert (without_forearm.stddev[3:] > whole.stddev[3:]).all()
        alone = estimator.estimate([pose for pose in frame if pose.name == "torso"])
        assert np.isnan(alone.angles).all() and np.isinf(alone.stddev).all() and np.isnan(alone.scale)


def test_a_hinge_turns_on_past_half_a_turn() -> None:
    rng, tree = arm(60, ARM[1:2])
    true = np.linspace(0.0, 4.0 * np.pi, 200)
    still = random_posture(rng, tree, 200)
    posture = Posture(still.rotation, still.translation, (Rotation.from_rotvec(true[:, None] * [0, 0, 1]).as_matrix(),))
    estimator = AngleEstimator(known(tree))
    angles = np.array([estimator.estimate(frame).angles[0] for frame in measured(rng, tree, posture)])
    assert np.abs(angles - true).max() < np.radians(1.0)
    estimator.reset()
    assert abs(estimator.estimate(measured(rng, tree, posture)[-1]).angles[0]) < np.radians(1.0)


@pytest.mark.slow
def test_the_calibration_of_the_cameras_is_in_the_deviation() -> None:
    """The errors of all poses depend on a few common parameters; the stated deviations include these errors."""
    rng, tree = arm(70)
    posture = random_posture(rng, tree, 1)
    (frame,) = measured(rng, tree, posture, scale=1e-3)
    size = 4
    sensitivities = {pose.name: 1e-3 * rng.normal(size=(6, size)) for pose in frame}
    root = rng.normal(size=(size, size))
    calibration = root @ root.T
    estimator = AngleEstimator(known(tree))
    stated = estimator.estimate(frame, sensitivities, calibration)
    assert (stated.calibration > 10.0 * stated.noise).all() and np.allclose(stated.model, 0.0)
    assert np.allclose(stated.stddev**2, stated.noise**2 + stated.calibration**2)
    drawn = []
    for _ in range(250):
        shared = root @ rng.normal(size=size)
        steps = {name: sensitivity @ shared for name, sensitivity in sensitivities.items()}
        changed = [
            TargetPose(
                pose.name,
                pose.stamp_ns,
                pose.frame_id,
                Rotation.from_rotvec(steps[pose.name][3:]).as_matrix() @ pose.rotation,
                pose.translation + steps[pose.name][:3],
                pose.covariance,
                pose.points,
                pose.residual,
            )
            for pose in frame
        ]
        drawn.append(estimator.estimate(changed).angles)
    ratio = np.std(drawn, axis=0) / stated.calibration
    assert (ratio > 0.85).all() and (ratio < 1.15).all()


@pytest.mark.slow
def test_the_chain_is_in_the_deviation() -> None:
    """Angles by chains that are drawn from a covariance differ as stated."""
    rng, tree = arm(80, ARM[:2])
    frames = measured(rng, tree, random_posture(rng, tree, 200, motion=20.0))
    description = [JointDescription(joint.name, joint.parent, joint.child, joint.kind) for joint in tree.joints]
    chain = fit_chain(frames, description).chain
    (frame,) = measured(rng, tree, random_posture(rng, tree, 1), scale=0.1)
    stated = AngleEstimator(chain).estimate(frame)
    values, vectors = np.linalg.eigh(chain.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = []
    for _ in range(200):
        step = root @ rng.normal(size=len(root))
        joints = tuple(joint.changed(step[SIZE * i : SIZE * (i + 1)]) for i, joint in enumerate(chain.joints))
        estimator = AngleEstimator(Chain(joints, chain.covariance, chain.sensitivity))
        drawn.append(estimator.estimate(frame).angles)
    ratio = np.std(drawn, axis=0) / stated.model
    assert (ratio > 0.8).all() and (ratio < 1.2).all()


def test_unusable_input_is_refused_by_name() -> None:
    rng, tree = arm(90)
    (frame,) = measured(rng, tree, random_posture(rng, tree, 1))
    estimator = AngleEstimator(known(tree))
    with pytest.raises(PoseTableError, match="none of a target"):
        estimator.estimate([])
    with pytest.raises(PoseTableError, match="twice"):
        estimator.estimate([*frame, frame[0]])
    sensitivities = {pose.name: np.zeros((6, 2)) for pose in frame}
    with pytest.raises(AngleError, match="torso"):
        estimator.estimate(frame, sensitivities)
    with pytest.raises(AngleError, match=r"hand.*none"):
        estimator.estimate(frame, {k: v for k, v in sensitivities.items() if k != "hand"}, np.eye(2))
    with pytest.raises(AngleError, match=r"\(6, 2\), expected \(6, 3\)"):
        estimator.estimate(frame, sensitivities, np.eye(3))


def test_places_follow_from_turns() -> None:
    """The two frames of a joint share their origin, and a hinge its axis, in every posture."""
    rng, tree = arm(99)
    rotations, translations = place(tree, random_posture(rng, tree, 20))
    for index, (joint, parent) in enumerate(zip(tree.joints, tree.parents, strict=True)):
        child = index + 1
        before = translations[:, parent] + rotations[:, parent] @ joint.parent_centre
        behind = translations[:, child] + rotations[:, child] @ joint.child_centre
        assert np.abs(before - behind).max() < 1e-12
        if joint.kind is JointKind.HINGE:
            assert (
                np.abs(rotations[:, parent] @ joint.parent_axis - rotations[:, child] @ joint.child_axis).max() < 1e-12
            )


def test_a_root_that_is_not_seen_takes_the_angles_of_its_joints_only() -> None:
    """The root's pose and the angles of its joints are then undetermined; all others are known, at any noise."""
    for seed, scale in ((50, 1.0), (51, 0.1), (52, 0.01)):
        rng, tree = arm(seed)
        whole, without = AngleEstimator(known(tree)), AngleEstimator(known(tree))
        for frame in measured(rng, tree, random_posture(rng, tree, 15), scale):
            one = whole.estimate(frame)
            other = without.estimate([pose for pose in frame if pose.name != "torso"])
            assert np.isnan(other.angles[:3]).all() and np.isinf(other.stddev[:3]).all()
            assert (np.abs(other.angles[3:] - one.angles[3:]) < 6.0 * other.stddev[3:]).all()
