"""Balls in an image and points in space as ``sensor_msgs/PointCloud2``; poses of targets."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import MAX_RANGE
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds, to_vector
from body_tracking.messages.clouds import (
    COVARIANCE,
    FLOAT32,
    INT32,
    POSITION,
    Fields,
    columns,
    covariance_of,
    make_cloud,
    put_covariance,
    read_cloud,
    record_of,
)

MAX_POINTS: Final = 10_000
"""A message with more points is rejected."""
MAX_CAMERAS: Final = 32
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_BALL: Final[Fields] = tuple((name, FLOAT32) for name in ("u", "v", "area", "uu", "uv", "vv"))
_POINT: Final[Fields] = POSITION + COVARIANCE
_SINGLE: Final = float(np.finfo(np.float32).eps)
"""Share of a covariance's trace that exceeds its error in single precision."""
_INDEX: Final[Fields] = tuple((f"ball{camera}", INT32) for camera in range(MAX_CAMERAS))


def balls_to_cloud(balls: ImageBalls, types: MessageTypes) -> Any:
    """Cloud with the fields ``u v`` in pixels, ``area``, and the covariance ``uu uv vv``."""
    points = np.empty(len(balls.pixels), dtype=record_of(_BALL))
    points["u"], points["v"] = balls.pixels.T
    points["area"] = balls.areas
    points["uu"], points["uv"], points["vv"] = balls.covariance[:, [0, 0, 1], [0, 1, 1]].T
    return make_cloud(points, _BALL, balls.stamp_ns, balls.camera, types)


def cloud_to_balls(cloud: Any) -> ImageBalls:
    """The inverse of :func:`balls_to_cloud`.

    Raises:
        MessageError: as :func:`~body_tracking.messages.clouds.read_cloud`; numbers that are not finite, or a covariance
            that is not positive definite.
    """
    points = read_cloud(cloud, dict(_BALL), [name for name, _ in _BALL], MAX_POINTS)
    numbers = columns(points, [name for name, _ in _BALL])
    covariance = numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    if not np.isfinite(numbers).all() or (np.linalg.det(covariance) <= 0.0).any() or (numbers[:, 3] <= 0.0).any():
        raise MessageError("a ball without a place or a covariance")
    stamp_ns, camera = to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id)
    return ImageBalls(stamp_ns, camera, numbers[:, :2], numbers[:, 2], covariance)


def points_to_cloud(points: Points, types: MessageTypes) -> Any:
    """Cloud with the fields ``x y z``, the covariance, and ``ball0``, ``ball1``, ...: the ball's index in each
    camera.

    In single precision the covariance of two balls that do not belong together, whose rays are almost parallel, would
    not be positive definite: so much is added that it is.
    """
    fields = _POINT + _INDEX[: points.balls.shape[1]]
    rows = np.empty(len(points.positions), dtype=record_of(fields))
    rows["x"], rows["y"], rows["z"] = points.positions.T
    size = np.trace(points.covariance, axis1=1, axis2=2)
    put_covariance(rows, points.covariance + _SINGLE * size[:, None, None] * np.eye(3))
    for (name, _), index in zip(_INDEX, points.balls.T, strict=False):
        rows[name] = index
    return make_cloud(rows, fields, points.stamp_ns, points.frame_id, types)


def cloud_to_points(cloud: Any) -> Points:
    """The inverse of :func:`points_to_cloud`; ``ball0`` ... may be absent.

    Raises:
        MessageError: as :func:`~body_tracking.messages.clouds.read_cloud`; a position that is not finite or beyond
            :data:`~body_tracking.core.skeleton.MAX_RANGE`, a covariance that is not positive definite.
    """
    rows = read_cloud(cloud, dict(_POINT + _INDEX), [name for name, _ in _POINT], MAX_POINTS)
    positions, covariance = columns(rows, ("x", "y", "z")), covariance_of(rows)
    if not (np.abs(positions) < MAX_RANGE).all() or not np.isfinite(covariance).all():
        raise MessageError("a point without a place or a covariance")
    if len(rows) and (np.linalg.eigvalsh(covariance)[:, 0] <= 0.0).any():
        raise MessageError("the covariance of a point is not positive definite")
    names = [name for name, _ in _INDEX if name in (rows.dtype.names or ())]
    balls = np.stack([rows[name] for name in names], axis=1) if names else np.empty((len(rows), 0))
    stamp_ns, frame_id = to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id)
    return Points(stamp_ns, frame_id, positions, covariance, balls.astype(np.intp))


def target_pose_to_message(pose: TargetPose, types: MessageTypes) -> Any:
    """``geometry_msgs/PoseWithCovarianceStamped`` of a target's frame."""
    x, y, z, w = so3.matrix_to_quat(pose.rotation).tolist()
    position = to_vector(pose.translation, types)
    pose_message = types.make(
        "geometry_msgs/msg/Pose",
        position=types.make("geometry_msgs/msg/Point", x=position.x, y=position.y, z=position.z),
        orientation=types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
    covariance = types.floats(pose.covariance.reshape(-1))
    return types.make(
        POSE,
        header=to_header(pose.stamp_ns, pose.frame_id, types),
        pose=types.make("geometry_msgs/msg/PoseWithCovariance", pose=pose_message, covariance=covariance),
    )


def message_to_target_pose(message: Any, name: str) -> TargetPose:
    """The inverse of :func:`target_pose_to_message`; points and residual are not in the message.

    Raises:
        MessageError: numbers that are not finite, a position beyond :data:`~body_tracking.core.skeleton.MAX_RANGE`, a
            quaternion far from unit length, a covariance that is not positive definite.
    """
    place, quat = message.pose.pose.position, message.pose.pose.orientation
    translation = np.array([place.x, place.y, place.z])
    quat_xyzw = np.array([quat.x, quat.y, quat.z, quat.w])
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    length = float(np.linalg.norm(quat_xyzw))
    if not (np.abs(translation) < MAX_RANGE).all() or not abs(length - 1.0) < 1e-3:
        raise MessageError(f"pose of {name}: translation {translation}, quaternion of length {length:.3g}")
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] <= 0.0:
        raise MessageError(f"pose of {name}: its covariance is not positive definite")
    return TargetPose(
        name,
        to_nanoseconds(message.header.stamp),
        str(message.header.frame_id),
        so3.quat_to_matrix(quat_xyzw / length),
        translation,
        0.5 * (covariance + covariance.T),
        np.empty(0, dtype=np.intp),
        float("nan"),
    )
