"""What the size of balls does to their images, and the calibration of the cameras to poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
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
    turned = [targets[pose.name].points @ pose.rotation.T for pose in poses]
    starts = np.cumsum([0, *(len(each) for each in turned[:-1])])
    arms = np.concatenate(turned)
    points = arms + np.repeat([pose.translation for pose in poses], [len(each) for each in turned], axis=0)
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -so3.skew(arms)], axis=-1)
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
