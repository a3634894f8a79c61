"""What the size of balls does to their images, and the calibration of the cameras to poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers import projection
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.markers.rig import Rig
from body_tracking.markers.spheres import sphere_centre_correction
from body_tracking.markers.targets import Target


def centred(rig: Rig, balls: Sequence[ImageBalls], points: Points, diameter: float) -> tuple[ImageBalls, ...]:
    """The balls with their pixels moved from the centroids of their images to the projections of their centres.

    Args:
        rig: the cameras, of which the frames of ``balls`` name some.
        balls: as they were found.
        points: triangulated from them, for the depths; balls that are in no point stay.
        diameter: of the balls, metres.
    """
    frames, moved = [camera.frame_id for camera in rig.cameras], []
    for each in balls:
        index = frames.index(each.camera)
        seen = points.balls[:, index] >= 0
        which = points.balls[seen, index]
        depths = points.positions[seen] @ rig.rotations[index][2] + rig.translations[index][2]
        pixels = np.array(each.pixels)
        pixels[which] += sphere_centre_correction(rig.cameras[index], pixels[which], depths, 0.5 * diameter)
        moved.append(replace(each, pixels=pixels))
    return tuple(moved)


def pose_sensitivity(rig: Rig, target: Target, pose: TargetPose) -> FloatArray:
    """How a pose moves when the calibration's parameters are larger and the pixels stay.

    As :func:`body_tracking.markers.triangulation.sensitivity`, for the pose that fits the pixels of all balls best,
    each pixel as good as the other.

    Returns:
        (6, p) in the order of :attr:`TargetPose.covariance`, per unit of each parameter of :class:`Rig`.
    """
    return pose_sensitivities(rig, {target.name: target}, [pose])[target.name]


def pose_sensitivities(rig: Rig, targets: Mapping[str, Target], poses: Sequence[TargetPose]) -> dict[str, FloatArray]:
    """:func:`pose_sensitivity` of several targets at once, by their names."""
    starts, by_pose, points = _balls(targets, poses)
    information, pull, start = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6, rig.size)), 0
    for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
        seen = projection.project(camera, rotation, translation, points)
        by_ball = seen.by_point @ by_pose
        turned_back = by_ball.swapaxes(1, 2)
        end = start + projection.size(camera)
        information += np.add.reduceat(turned_back @ by_ball, starts)
        pull[:, :, start:end] = np.add.reduceat(turned_back @ seen.by_parameters, starts)
        start = end
    moves = np.asarray(-np.linalg.solve(information, pull), dtype=np.float64)
    return {pose.name: each for pose, each in zip(poses, moves, strict=True)}


def calibration_effects(
    rig: Rig | None, targets: Mapping[str, Target], poses: Sequence[TargetPose]
) -> dict[str, FloatArray] | None:
    """:func:`pose_sensitivities`; None without a rig, zeros for poses of points that the rig did not measure."""
    if rig is None:
        return None
    if measured_by(rig, poses):
        return pose_sensitivities(rig, targets, poses)
    return {pose.name: np.zeros((6, rig.size)) for pose in poses}


def measured_by(rig: Rig | None, poses: Sequence[TargetPose]) -> bool:
    """Whether poses of one time are in the frame of the rig; those of another system's points are not."""
    return rig is not None and all(pose.frame_id == rig.cameras[0].frame_id for pose in poses)


def shape_effects(rig: Rig | None, targets: Mapping[str, Target], poses: Sequence[TargetPose]) -> dict[str, FloatArray]:
    """What the errors of the targets' own geometry add to their poses, the same unknowns in all frames.

    As :func:`pose_sensitivity`, for the pose that fits the pixels best; without a rig, or for poses of points that it
    did not measure, for the pose that fits the points best, each coordinate as good as the other.

    Returns:
        Of each target (6, 3k) in the order of :attr:`TargetPose.covariance`: what independent unknowns of variance 1,
        that make up :attr:`Target.covariance`, add.
    """
    starts, by_pose, points = _balls(targets, poses)
    information, pull = np.zeros((len(poses), 6, 6)), np.zeros((len(points), 6, 3))
    measured = [np.broadcast_to(np.eye(3), (len(points), 3, 3))]
    if rig is not None and measured_by(rig, poses):
        cameras = zip(rig.cameras, rig.rotations, rig.translations, strict=True)
        measured = [projection.project(*camera, points).by_point for camera in cameras]
    for by_point in measured:
        by_ball = by_point @ by_pose
        information += np.add.reduceat(by_ball.swapaxes(1, 2) @ by_ball, starts)
        pull += by_ball.swapaxes(1, 2) @ by_point
    effects = {}
    for pose, start, known in zip(poses, starts.tolist(), information, strict=True):
        target = targets[pose.name]
        own = (pull[start : start + len(target.points)] @ pose.rotation).swapaxes(0, 1).reshape(6, -1)
        values, vectors = np.linalg.eigh(target.covariance)
        effects[pose.name] = np.linalg.solve(known, own) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return effects


def _balls(targets: Mapping[str, Target], poses: Sequence[TargetPose]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Index of the first ball of each target, (b, 3, 6) derivatives of all balls by their poses, (b, 3) balls."""
    turned = [targets[pose.name].points @ pose.rotation.T for pose in poses]
    counts = [len(each) for each in turned]
    arms = np.concatenate(turned)
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -so3.skew(arms)], axis=-1)
    points = arms + np.repeat([pose.translation for pose in poses], counts, axis=0)
    return np.cumsum([0, *counts[:-1]]), by_pose, points
