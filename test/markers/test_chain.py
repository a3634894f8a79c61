"""Chains fitted as a whole: errors as stated, whatever order and whatever is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marker_people import measured, random_posture
from markers_lab import random_joint
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.angles import AngleError, AngleEstimator
from body_tracking.markers.chain import Chain, ChainError, JointDescription, fit_chain
from body_tracking.markers.joint_model import SIZE, JointError, JointKind
from body_tracking.markers.joint_tree import Tree, TreeError, tree_of
from body_tracking.markers.joints import JointFitError
from body_tracking.markers.observations import TargetPose
from draws import draws

UPPER_BODY = (
    ("shoulder", "torso", "upper_arm", JointKind.BALL),
    ("elbow", "upper_arm", "forearm", JointKind.HINGE),
    ("neck", "torso", "head", JointKind.UNIVERSAL),
)
DESCRIPTION = [JointDescription(*each) for each in UPPER_BODY]


def upper_body(seed: int) -> tuple[np.random.Generator, Tree]:
    rng = np.random.default_rng(seed)
    return rng, tree_of([random_joint(rng, kind, name, parent, child) for name, parent, child, kind in UPPER_BODY])


@pytest.mark.slow
def test_errors_of_a_chain_are_as_large_as_stated_where_poses_are_missing() -> None:
    count, total, parameters, inside = draws(3, 40), 0.0, 6 + 9 + 10, 0
    for seed in range(count):
        rng, tree = upper_body(seed)
        fit = fit_chain(measured(rng, tree, random_posture(rng, tree, 300), lost=0.1), DESCRIPTION)
        assert not fit.warnings and 0.95 < fit.chain.scale < 1.05
        error = np.concatenate([a.difference(b) for a, b in zip(fit.chain.joints, tree.joints, strict=True)])
        values, vectors = np.linalg.eigh(fit.chain.covariance)
        total += float(((vectors[:, -parameters:].T @ error) ** 2 / values[-parameters:]).sum())
        inside += int((np.abs(error) <= 3.0 * np.sqrt(fit.chain.covariance.diagonal()) + 1e-12).sum())
    print(f"chi squared {total / (count * parameters):.3f} per parameter, {inside / (36 * count):.4f} within 3 sigma")
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], count * parameters)
    assert 0.8 * low < total < 1.2 * high
    assert inside >= 0.97 * 36 * count


@pytest.mark.slow
def test_the_whole_is_not_less_exact_than_its_joints() -> None:
    rng, tree = upper_body(10)
    fit = fit_chain(measured(rng, tree, random_posture(rng, tree, 300)), DESCRIPTION)
    for joint, alone in zip(fit.chain.joints, fit.joints, strict=True):
        whole, single = np.sqrt(joint.covariance.diagonal()), np.sqrt(alone.joint.covariance.diagonal())
        assert (whole <= 1.02 * single + 1e-12).all()


def test_the_order_of_the_description_does_not_matter() -> None:
    rng, tree = upper_body(11)
    frames = measured(rng, tree, random_posture(rng, tree, 60))
    here, there = fit_chain(frames, DESCRIPTION).chain, fit_chain(frames, DESCRIPTION[::-1]).chain
    for joint in here.joints:
        other = there.joints[there.names.index(joint.name)]
        assert (np.abs(other.difference(joint)) <= 0.02 * np.sqrt(joint.covariance.diagonal()) + 1e-12).all()
    assert there.targets[0] == "torso"


def test_a_joint_of_another_kind_is_named() -> None:
    rng, tree = upper_body(12)
    frames = measured(rng, tree, random_posture(rng, tree, 50))
    wrong = [DESCRIPTION[0], DESCRIPTION[1], JointDescription("neck", "torso", "head", JointKind.HINGE)]
    fit = fit_chain(frames, wrong)
    assert len(fit.warnings) == 1 and fit.warnings[0].startswith("neck: errors are")
    assert fit.chain.scale > 3.0


def calibrated(frame: list[TargetPose]) -> dict[str, FloatArray]:
    """Sensitivities to three parameters: the scale of space, a turn of the cameras, and depth that bends poses."""
    found = {}
    for pose in frame:
        sensitivity = np.zeros((6, 3))
        sensitivity[:3, 0] = pose.translation
        sensitivity[:3, 1], sensitivity[3:, 1] = np.cross([0.0, 1.0, 0.0], pose.translation), [0.0, 1.0, 0.0]
        sensitivity[2, 2] = sensitivity[4, 2] = pose.translation[0]
        found[pose.name] = sensitivity
    return found


def wrong(frames: list[list[TargetPose]], step: FloatArray) -> list[list[TargetPose]]:
    """The poses by cameras whose calibration is wrong by a step."""
    result = []
    for frame in frames:
        steps = {name: sensitivity @ step for name, sensitivity in calibrated(frame).items()}
        result.append(
            [
                replace(
                    pose,
                    translation=pose.translation + steps[pose.name][:3],
                    rotation=Rotation.from_rotvec(steps[pose.name][3:]).as_matrix() @ pose.rotation,
                )
                for pose in frame
            ]
        )
    return result


@pytest.mark.slow
def test_errors_of_the_cameras_calibration_are_propagated_to_a_chain_and_its_angles() -> None:
    rng, tree = upper_body(15)
    frames = measured(rng, tree, random_posture(rng, tree, 150), scale=0.1)
    sensitivities = [calibrated(frame) for frame in frames]
    chain = fit_chain(frames, DESCRIPTION, sensitivities).chain
    # a wrong scale moves the centres by their own distance and turns nothing, a turn of the cameras does nothing
    for index, joint in enumerate(chain.joints):
        by_scale = chain.sensitivity[SIZE * index : SIZE * (index + 1), 0]
        expected = np.concatenate([joint.parent_centre, np.zeros(3), joint.child_centre, np.zeros(3)])
        assert np.abs(by_scale - expected).max() < 0.01
    assert np.abs(chain.sensitivity[:, 1]).max() < 0.01

    step = np.array([0.0, 0.0, 2e-3])
    other = fit_chain(wrong(frames, step), DESCRIPTION).chain
    apart = np.concatenate([a.difference(b) for a, b in zip(other.joints, chain.joints, strict=True)])
    assert np.abs(apart - chain.sensitivity @ step).max() < 0.03 * np.abs(apart).max()
    # the angles of the wrong chain by the wrong cameras err as stated
    right, off = AngleEstimator(chain), AngleEstimator(other)
    for frame, (shifted,) in ((frame, wrong([frame], step)) for frame in frames[:40]):
        stated = right.estimate(frame, calibrated(frame), np.diag([0.0, 0.0, step[2] ** 2]))
        errors = np.abs(np.exp(1j * off.estimate(shifted).angles) - np.exp(1j * stated.angles))
        assert np.abs(errors - stated.calibration).max() < 0.05 * stated.calibration.max()
        assert right.estimate(frame, calibrated(frame), np.diag([1e-4, 1e-4, 0.0])).calibration.max() < 1e-4
    with pytest.raises(ChainError, match="2 frames, expected 150"):
        fit_chain(frames, DESCRIPTION, sensitivities[:2])
    with pytest.raises(ChainError, match=r"frame 3, target torso: sensitivities none"):
        fit_chain(frames, DESCRIPTION, [*sensitivities[:3], {"head": np.zeros((6, 3))}, *sensitivities[4:]])
    with pytest.raises(AngleError, match="2 parameters, expected 3"):
        right.estimate(frames[0], {pose.name: np.zeros((6, 2)) for pose in frames[0]}, np.eye(2))


def test_descriptions_that_are_no_tree_are_refused() -> None:
    rng, tree = upper_body(13)
    frames = measured(rng, tree, random_posture(rng, tree, 20))

    def refused(error: type[Exception], match: str, *joints: JointDescription) -> None:
        with pytest.raises(error, match=match):
            fit_chain(frames, joints)

    ball = JointKind.BALL
    refused(TreeError, "none")
    refused(TreeError, "name of its own", DESCRIPTION[0], DESCRIPTION[0])
    refused(TreeError, "two parents", *DESCRIPTION, JointDescription("other", "head", "forearm", ball))
    refused(TreeError, "2 targets without a parent", *DESCRIPTION, JointDescription("knee", "thigh", "shank", ball))
    circle = JointDescription("a", "x", "y", ball), JointDescription("b", "y", "x", ball)
    refused(TreeError, "circle", *DESCRIPTION, *circle)
    refused(JointError, "two targets", JointDescription("a", "torso", "torso", ball))
    refused(JointFitError, "hip: 0 frames", *DESCRIPTION, JointDescription("hip", "torso", "thigh", ball))
    with pytest.raises(ChainError, match="covariance"):
        Chain(tree.joints, np.zeros((3, 3)), np.zeros((36, 0)))
    with pytest.raises(ChainError, match="each after that of its parent"):
        Chain(tree.joints[::-1], np.zeros((3 * SIZE, 3 * SIZE)), np.zeros((3 * SIZE, 0)))
