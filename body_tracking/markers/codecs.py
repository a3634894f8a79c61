"""Codecs of the marker system's messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from body_tracking.core import so3
from body_tracking.core.message_types import IMAGE, POINT_CLOUD, TF, TRANSFORM
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.messages import (
    POSE,
    balls_to_cloud,
    cloud_to_balls,
    cloud_to_points,
    message_to_target_pose,
    points_to_cloud,
    target_pose_to_message,
)
from body_tracking.markers.observations import ImageBalls, Points, TargetPose
from body_tracking.messages.base import to_header, to_transform
from body_tracking.messages.codecs import Codec, Image, Wire
from body_tracking.messages.images import image_to_array


class CameraImage(Image):
    """A monochrome image: stamp in nanoseconds, frame, (height, width) pixels."""

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, NDArray[Any]]:
        return image_to_array(wire.deserialize(IMAGE, cdr))


class Balls(Codec):
    """The balls in one image."""

    type_name = POINT_CLOUD

    def encode(self, payload: ImageBalls, wire: Wire) -> bytes:
        return wire.serialize(POINT_CLOUD, balls_to_cloud(payload, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> ImageBalls:
        return cloud_to_balls(wire.deserialize(POINT_CLOUD, cdr))

    def stamp_ns(self, payload: ImageBalls) -> int:
        return payload.stamp_ns


class SpacePoints(Codec):
    """Points in space at one time."""

    type_name = POINT_CLOUD

    def encode(self, payload: Points, wire: Wire) -> bytes:
        return wire.serialize(POINT_CLOUD, points_to_cloud(payload, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> Points:
        return cloud_to_points(wire.deserialize(POINT_CLOUD, cdr))

    def stamp_ns(self, payload: Points) -> int:
        return payload.stamp_ns


class Frames(Codec):
    """Transforms for ``tf2``: stamp in nanoseconds, parent frame, and per child frame its name, (3, 3) rotation and
    (3,) origin in the parent.
    """

    type_name = TF

    def encode(self, payload: tuple[int, str, Sequence[tuple[str, FloatArray, FloatArray]]], wire: Wire) -> bytes:
        stamp_ns, parent, frames = payload
        transforms = [
            wire.types.make(
                TRANSFORM,
                header=to_header(stamp_ns, parent, wire.types),
                child_frame_id=name,
                transform=to_transform(origin, so3.matrix_to_quat(rotation), wire.types),
            )
            for name, rotation, origin in frames
        ]
        return wire.serialize(TF, wire.types.make(TF, transforms=transforms))


class PoseOfTarget(Codec):
    """The pose of one target."""

    type_name = POSE

    def __init__(self, name: str) -> None:
        self.name = name

    def encode(self, payload: TargetPose, wire: Wire) -> bytes:
        return wire.serialize(POSE, target_pose_to_message(payload, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> TargetPose:
        return message_to_target_pose(wire.deserialize(POSE, cdr), self.name)

    def stamp_ns(self, payload: TargetPose) -> int:
        return payload.stamp_ns
