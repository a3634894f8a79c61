"""Simulated targets on chains of joints: poses with the noise that two infrared cameras at a metre leave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markers_lab import random_joint
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.joint_model import JointKind, nearest_turns
from body_tracking.markers.joint_tree import Posture, Tree, place, tree_of
from body_tracking.markers.observations import TargetPose

BALLS = 0.049 * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0.9, 0], [0.2, -0.8, 0.3], [0.1, 0.1, 0.65]])
"""Five balls of a target of 98 mm, metres."""
BALL_NOISE = np.array([0.078, 0.078, 0.36]) * 1e-3
"""Metres, standard deviation of a ball across and along the view: pose noise of 0.17 mm and 0.14 deg."""


def pose_covariances(rotations: FloatArray, scale: float = 1.0) -> FloatArray:
    """(..., 6, 6) of targets of five balls at (..., 3, 3) rotations, seen along z."""
    points = np.einsum("...ij,kj->...ki", rotations, BALLS)
    information = np.zeros((*rotations.shape[:-2], 6, 6))
    for index in range(len(BALLS)):
        x, y, z = np.moveaxis(points[..., index, :], -1, 0)
        derivative = np.zeros((*rotations.shape[:-2], 3, 6))
        derivative[..., :3] = np.eye(3)
        derivative[..., 0, 4], derivative[..., 0, 5] = z, -y
        derivative[..., 1, 3], derivative[..., 1, 5] = -z, x
        derivative[..., 2, 3], derivative[..., 2, 4] = y, -x
        information += derivative.swapaxes(-1, -2) @ ((scale * BALL_NOISE) ** -2 * np.eye(3)) @ derivative
    return np.linalg.inv(information)


def random_posture(
    rng: np.random.Generator, tree: Tree, frames: int, motion: float = 60.0, about: int = 3, body: float = 30.0
) -> Posture:
    """Postures at a metre that fill ranges of +- motion degrees about so many axes of each joint, smooth over time."""

    def smooth(width: int, size: float) -> FloatArray:
        t = np.linspace(0.0, 1.0, frames)[:, None]
        phases = rng.uniform(0, 2 * np.pi, (3, width))
        rates = rng.uniform(3.0, 20.0, (3, width))
        waves = np.sin(2.0 * np.pi * rates[:, None] * t + phases[:, None])
        return size / 1.5 * (waves / np.arange(1, 4)[:, None, None]).sum(axis=0)

    turns = []
    for joint in tree.joints:
        if joint.kind is JointKind.BALL:
            base = Rotation.random(random_state=rng)
            vector = np.radians(smooth(3, motion))
            vector[:, about:] = 0.0
            mixing = Rotation.random(random_state=rng)
            turns.append((Rotation.from_rotvec(mixing.apply(vector)) * base).as_matrix())
            continue
        angles = np.radians(smooth(2, motion)) + rng.uniform(-1.0, 1.0, 2)
        if joint.kind is JointKind.HINGE:
            turns.append(Rotation.from_rotvec(angles[:, :1] * [0, 0, 1]).as_matrix())
        else:
            middle = Rotation.from_euler("x", -90, degrees=True)
            first, second = (Rotation.from_rotvec(angles[:, i : i + 1] * [0, 0, 1]) for i in range(2))
            turns.append((first * middle * second).as_matrix())
        assert np.allclose(nearest_turns(joint.kind, turns[-1]), turns[-1])
    base = Rotation.random(random_state=rng)
    rotation = (Rotation.from_rotvec(np.radians(smooth(3, body))) * base).as_matrix()
    return Posture(rotation, np.array([0.0, 0.0, 1.0]) + smooth(3, 0.1), tuple(turns))


def measured(
    rng: np.random.Generator, tree: Tree, posture: Posture, scale: float = 1.0, lost: float = 0.0
) -> list[list[TargetPose]]:
    """Frames of poses with noise of ``scale`` times :data:`BALL_NOISE`; each pose is lost with some probability."""
    rotations, translations = place(tree, posture)
    covariances = pose_covariances(rotations, scale)
    factors = np.linalg.cholesky(covariances)
    noise = (factors @ rng.normal(size=(*factors.shape[:2], 6, 1)))[..., 0]
    turned = Rotation.from_rotvec(noise[..., 3:].reshape(-1, 3)).as_matrix().reshape(rotations.shape) @ rotations
    placed = translations + noise[..., :3]
    # by the Cholesky factors the noise is exactly of the covariance at the true pose
    residual = scale * float(np.sqrt((BALL_NOISE**2).sum() * 0.6))
    frames = []
    for row in range(len(rotations)):
        frame = [
            TargetPose(
                target,
                row * 10_000_000,
                "rig",
                turned[row, index],
                placed[row, index],
                covariances[row, index],
                np.arange(len(BALLS)),
                residual,
            )
            for index, target in enumerate(tree.targets)
            if rng.random() >= lost
        ]
        frames.append(frame)
    return frames


def columns(frames: Sequence[Sequence[TargetPose]]) -> list[list[TargetPose]]:
    """The poses of each target of frames in which all are seen."""
    return [list(column) for column in zip(*frames, strict=True)]


def pair(rng: np.random.Generator, kind: JointKind) -> Tree:
    """Two targets and a random joint."""
    return tree_of([random_joint(rng, kind, "joint", "upper", "lower")])
