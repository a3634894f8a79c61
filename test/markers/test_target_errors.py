"""Errors of targets displace the joints that are fitted to their poses, and are in the joints' covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from marker_people import random_joint, random_posture
from target_points import fit_pose

from body_tracking.core import so3
from body_tracking.markers.chain import JointDescription, fit_chain
from body_tracking.markers.corrections import shape_effects
from body_tracking.markers.joint_model import JointKind
from body_tracking.markers.joint_tree import place, tree_of
from body_tracking.markers.observations import Points
from body_tracking.markers.projection import project
from body_tracking.markers.targets import Target
from body_tracking.simulation.marker_scene import make_targets, stereo_rig


def test_the_errors_of_targets_are_in_the_deviations_of_joints() -> None:
    """Targets with errors drawn from their covariance, exact poses otherwise: errors of joints are as stated."""
    rig, rng, ratios = stereo_rig(), np.random.default_rng(4), []
    bodies = make_targets()[:2]
    tree = tree_of([random_joint(rng, JointKind.BALL, "joint", bodies[0].name, bodies[1].name)])
    rotations, translations = place(tree, random_posture(rng, tree, 24))
    spread = 5e-5
    for _ in range(6):
        # without errors that move or turn a target as a whole, which belong to its frame
        wrong = []
        for body in bodies:
            whole = np.concatenate([np.tile(np.eye(3), (5, 1, 1)), -so3.skew(body.points)], axis=-1).reshape(15, 6)
            free = np.linalg.svd(whole)[0][:, 6:]
            away = (free @ rng.normal(0.0, spread, 9)).reshape(5, 3)
            wrong.append(Target(body.name, body.points + away, spread**2 * free @ free.T))
        by_name, frames = {target.name: target for target in wrong}, []
        for turns, shifts in zip(rotations, translations, strict=True):
            poses = []
            for body, target, turn, shift in zip(bodies, wrong, turns, shifts, strict=True):
                true = body.points @ turn.T + shift
                views = zip(rig.cameras, rig.rotations, rig.translations, strict=True)
                seen_by = [project(*view, true).by_point for view in views]
                noise = 1e-2 * np.linalg.inv(sum(each.swapaxes(1, 2) @ each for each in seen_by))
                seen = Points(0, rig.cameras[0].frame_id, true, noise, np.zeros((5, 0), dtype=np.intp))
                poses.append(fit_pose(replace(target, covariance=np.zeros((15, 15))), seen, np.arange(5)))
            frames.append(poses)
        described = [JointDescription("joint", bodies[0].name, bodies[1].name, JointKind.BALL)]
        shapes = [shape_effects(rig, by_name, poses) for poses in frames]
        chain = fit_chain(frames, described, shapes=shapes).chain
        noise_only = fit_chain(frames, described).chain.covariance
        stated = chain.covariance - noise_only
        error = chain.joints[0].difference(tree.joints[0])
        centres = [0, 1, 2, 6, 7, 8]
        ratios.append(error[centres] ** 2 / stated.diagonal()[centres])
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.6
