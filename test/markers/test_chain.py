"""Chains fitted as a whole: errors as stated, whatever order and whatever is missing."""

from __future__ import annotations

import time

import numpy as np
import pytest
from marker_people import measured, random_joint, random_posture
from scipy.stats import chi2

from body_tracking.markers.chain import Chain, ChainError, JointDescription, fit_chain
from body_tracking.markers.joint_model import SIZE, JointError, JointKind
from body_tracking.markers.joint_tree import Tree, TreeError, tree_of
from body_tracking.markers.joints import JointFitError
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
    frames = measured(rng, tree, random_posture(rng, tree, 200))
    wrong = [DESCRIPTION[0], DESCRIPTION[1], JointDescription("neck", "torso", "head", JointKind.HINGE)]
    fit = fit_chain(frames, wrong)
    assert len(fit.warnings) == 1 and fit.warnings[0].startswith("neck: errors are")
    assert fit.chain.scale > 3.0


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
        Chain(tree.joints, np.zeros((3, 3)))
    with pytest.raises(ChainError, match="each after that of its parent"):
        Chain(tree.joints[::-1], np.zeros((3 * SIZE, 3 * SIZE)))


@pytest.mark.slow
def test_2000_frames_take_less_than_half_a_minute() -> None:
    rng, tree = upper_body(14)
    frames = measured(rng, tree, random_posture(rng, tree, 2000), lost=0.05)
    begin = time.process_time()
    fit_chain(frames, DESCRIPTION)
    spent = time.process_time() - begin
    print(f"{spent:.1f} s")
    assert spent < 30.0
