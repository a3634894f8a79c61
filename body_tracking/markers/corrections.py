"""Effects of the balls' size on their images, and of the cameras' calibration on poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers import projection
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.markers.rig import Rig, parallel_cameras
from body_tracking.markers.spheres import sphere_centre_correction
from body_tracking.markers.targets import Target


def centred(rig: Rig, balls: Sequence[ImageBalls], points: Points, diameter: float) -> tuple[ImageBalls, ...]:
    """Balls with their pixels moved from the centroids of their images to the projections of their centres.

    Args:
        rig: the cameras; contains the frames of ``balls``.
        balls: detections.
        points: triangulated from ``balls``, for the depths; balls without a point stay unchanged.
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
    """Derivative of a pose by the calibration's parameters at fixed pixels.

    As :func:`body_tracking.markers.triangulation.sensitivity`, for the pose with the least squared reprojection error
    of all balls, all pixels equally weighted.

    Returns:
        (6, p) in the order of :attr:`TargetPose.covariance`, per unit of each parameter of :class:`Rig`.
    """
    return pose_sensitivities(rig, {target.name: target}, [pose])[target.name]


def pose_sensitivities(rig: Rig, targets: Mapping[str, Target], poses: Sequence[TargetPose]) -> dict[str, FloatArray]:
    """:func:`pose_sensitivity` of several targets at once, by name."""
    starts, by_pose, points = _balls(targets, poses)
    firsts = np.append(starts, len(points))
    information, pull, start = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6, rig.size)), 0
    for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
        seen = projection.project(camera, rotation, translation, points)
        _collect(firsts, by_pose, seen.by_point, seen.by_parameters, start, information, pull)
        start += projection.size(camera)
    moves = np.asarray(-np.linalg.solve(information, pull), dtype=np.float64)
    return {pose.name: each for pose, each in zip(poses, moves, strict=True)}


@compiled
def _collect(
    firsts: IntArray,
    by_pose: FloatArray,
    by_point: FloatArray,
    by_parameters: FloatArray,
    start: int,
    information: FloatArray,
    pull: FloatArray,
) -> None:
    """Add the normal equations of one camera's pixels: of the poses (t, 6, 6), and mixed with the rig (t, 6, p).

    Args:
        firsts: (t + 1,) first ball of each target.
        by_pose: (b, 3, 6) derivative of the balls by their poses.
        by_point: (b, 2, 3) derivative of the pixels by the balls.
        by_parameters: (b, 2, q) derivative of the pixels by the camera's own parameters.
        start: index in the rig of the first of these parameters.
        information: (t, 6, 6), updated.
        pull: (t, 6, p), updated.
    """
    derivative = np.empty(6)
    for target in range(len(firsts) - 1):
        for ball in range(firsts[target], firsts[target + 1]):
            for axis in range(2):
                for i in range(6):
                    derivative[i] = 0.0
                    for k in range(3):
                        derivative[i] += by_point[ball, axis, k] * by_pose[ball, k, i]
                for i in range(6):
                    for j in range(6):
                        information[target, i, j] += derivative[i] * derivative[j]
                    for j in range(by_parameters.shape[2]):
                        pull[target, i, start + j] += derivative[i] * by_parameters[ball, axis, j]


def calibration_effects(
    rig: Rig | None, targets: Mapping[str, Target], poses: Sequence[TargetPose]
) -> dict[str, FloatArray] | None:
    """:func:`pose_sensitivities`; None without a rig, zeros for poses not measured by the rig."""
    if rig is None:
        return None
    if measured_by(rig, poses):
        return pose_sensitivities(rig, targets, poses)
    return {pose.name: np.zeros((6, rig.size)) for pose in poses}


def measured_by(rig: Rig | None, poses: Sequence[TargetPose]) -> bool:
    """Whether the poses of one time are in the rig's frame; poses from another system's points are not."""
    return rig is not None and all(pose.frame_id == rig.cameras[0].frame_id for pose in poses)


def shape_effects(rig: Rig | None, targets: Mapping[str, Target], poses: Sequence[TargetPose]) -> dict[str, FloatArray]:
    """Effects of the errors of the targets' own geometry on their poses; the errors are constant in all frames.

    As :func:`pose_sensitivity`, for the pose with the least squared reprojection error; without a rig, or for poses not
    measured by it, for the pose with the least squared distance of the points, all coordinates equally weighted.

    Returns:
        By target, (6, 3k) in the order of :attr:`TargetPose.covariance`: effects of 3k independent unknowns of variance
        1, into which :attr:`Target.covariance` is decomposed.
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
    """Index of the first ball of each target, (b, 3, 6) derivatives of all balls by their poses, (b, 3) positions."""
    turned = [targets[pose.name].points @ pose.rotation.T for pose in poses]
    counts = [len(each) for each in turned]
    arms = np.concatenate(turned)
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -so3.skew(arms)], axis=-1)
    points = arms + np.repeat([pose.translation for pose in poses], counts, axis=0)
    return np.cumsum([0, *counts[:-1]]), by_pose, points


def prepare() -> None:
    """Compile the loops, or load them: a target one metre in front of two cameras."""
    target = Target("", np.eye(3), np.zeros((9, 9)))
    place = np.array([0.0, 0.0, 1.0])
    pose_sensitivity(parallel_cameras(), target, TargetPose("", 0, "", np.eye(3), place, np.eye(6), np.arange(3), 0.0))
