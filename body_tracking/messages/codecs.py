"""Codecs between the types that stages exchange and serialised messages, one class per content.

A :class:`Wire` serialises the messages that this package does not write itself: by rclpy live, by rosbags offline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from body_tracking.core.body_model import BodyModel
from body_tracking.core.camera import Camera
from body_tracking.core.clocks import ClockModel
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.imu import ImuSample
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import (
    IMAGE,
    IMU,
    JOINT_STATE,
    MAGNETIC_FIELD,
    POINT_CLOUD,
    STRING,
    TF,
    TIME_REFERENCE,
    TRANSFORM,
)
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Skeleton
from body_tracking.messages.angles import angles_to_joint_state
from body_tracking.messages.base import MessageTypes, to_header
from body_tracking.messages.calibration import (
    clock_to_time_reference,
    pose_to_transform,
    time_reference_to_clock,
    transform_to_pose,
)
from body_tracking.messages.cameras import CAMERA_INFO, camera_to_info, info_to_camera
from body_tracking.messages.cdr import decode_skeletons, encode_skeletons
from body_tracking.messages.images import array_to_image
from body_tracking.messages.imus import (
    message_to_magnetic_field,
    message_to_orientation,
    message_to_sample,
    orientation_to_message,
)
from body_tracking.messages.model import (
    covariance_to_image,
    estimate_to_joint_state,
    estimate_to_stddevs,
    image_to_covariance,
    joint_state_to_model,
)
from body_tracking.messages.skeletons import checked_covariances, cloud_to_skeletons


class Wire(Protocol):
    """Message classes of a client library, and their serialisation."""

    @property
    def types(self) -> MessageTypes: ...

    def serialize(self, type_name: str, message: Any) -> bytes:
        """A message as CDR."""

    def deserialize(self, type_name: str, cdr: bytes) -> Any:
        """A message from CDR; MessageError where the bytes are not of this type."""


class Codec:
    """Base of the codecs.

    Attributes:
        type_name: of the message.
    """

    type_name: str

    def encode(self, payload: Any, wire: Wire) -> bytes:
        """The message as CDR."""
        raise NotImplementedError

    def decode(self, cdr: bytes, wire: Wire) -> Any:
        """The content of a message; MessageError where it is malformed."""
        raise NotImplementedError

    def stamp_ns(self, payload: Any) -> int | None:
        """Capture time, for the detection of backward jumps; None for contents without one."""
        return None


class Image(Codec):
    """Base of the codecs of ``sensor_msgs/Image``: stamp in nanoseconds, frame, pixels.

    Attributes:
        encoding: in which it is written; empty for ``mono8`` or ``mono16``, by the size of a number.
    """

    type_name = IMAGE
    encoding = ""

    def encode(self, payload: tuple[int, str, NDArray[Any]], wire: Wire) -> bytes:
        stamp_ns, frame_id, pixels = payload
        return wire.serialize(IMAGE, array_to_image(pixels, stamp_ns, frame_id, wire.types, self.encoding))

    def stamp_ns(self, payload: tuple[int, str, NDArray[Any]]) -> int:
        return payload[0]


class CameraInfo(Codec):
    """The calibration of a camera; written with a stamp in nanoseconds."""

    type_name = CAMERA_INFO

    def encode(self, payload: tuple[int, Camera], wire: Wire) -> bytes:
        return wire.serialize(CAMERA_INFO, camera_to_info(payload[1], payload[0], wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> Camera:
        return info_to_camera(wire.deserialize(CAMERA_INFO, cdr))


class Skeletons(Codec):
    """All bodies in a frame."""

    type_name = POINT_CLOUD

    def encode(self, payload: Sequence[Skeleton], wire: Wire) -> bytes:
        return encode_skeletons(list(payload))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[Skeleton, ...]:
        return checked_covariances(decode_skeletons(cdr) or cloud_to_skeletons(wire.deserialize(POINT_CLOUD, cdr)))

    def stamp_ns(self, payload: Sequence[Skeleton]) -> int:
        return payload[0].stamp_ns


class Pose(Codec):
    """A sensor's pose in ``world``."""

    type_name = TRANSFORM

    def __init__(self, world: str = "") -> None:
        self.world = world

    def encode(self, payload: SensorPose, wire: Wire) -> bytes:
        return wire.serialize(TRANSFORM, pose_to_transform(payload, self.world, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> SensorPose:
        return transform_to_pose(wire.deserialize(TRANSFORM, cdr))


class Poses(Pose):
    """All poses at once, for ``tf2``."""

    type_name = TF

    def encode(self, payload: Any, wire: Wire) -> bytes:
        transforms = [pose_to_transform(each, self.world, wire.types) for each in payload]
        return wire.serialize(TF, wire.types.make(TF, transforms=transforms))


class SensorClock(NamedTuple):
    """A sensor's clock, valid from a time of the reference clock on."""

    sensor: str
    valid_from_ns: int
    clock: ClockModel


class Clock(Codec):
    """A sensor's clock."""

    type_name = TIME_REFERENCE

    def encode(self, payload: SensorClock, wire: Wire) -> bytes:
        message = clock_to_time_reference(payload.sensor, payload.clock, payload.valid_from_ns, wire.types)
        return wire.serialize(TIME_REFERENCE, message)

    def decode(self, cdr: bytes, wire: Wire) -> SensorClock:
        return SensorClock(*time_reference_to_clock(wire.deserialize(TIME_REFERENCE, cdr)))


class Orientation(Codec):
    """The orientation of a segment."""

    type_name = IMU

    def __init__(self, segment: str) -> None:
        self.segment = segment

    def encode(self, payload: SegmentOrientation, wire: Wire) -> bytes:
        return wire.serialize(IMU, orientation_to_message(payload, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> SegmentOrientation:
        return message_to_orientation(wire.deserialize(IMU, cdr), self.segment)


class Reading(Codec):
    """A reading of an inertial sensor, as its driver publishes it."""

    type_name = IMU

    def decode(self, cdr: bytes, wire: Wire) -> ImuSample:
        return message_to_sample(wire.deserialize(IMU, cdr))


class Field(Codec):
    """A magnetic field: stamp, frame, and (3,) tesla."""

    type_name = MAGNETIC_FIELD

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, FloatArray]:
        return message_to_magnetic_field(wire.deserialize(MAGNETIC_FIELD, cdr))


class OfModel(Codec):
    """Base of the codecs that need the body model of the estimates."""

    def __init__(self, model: BodyModel) -> None:
        self.model = model


class ModelState(OfModel):
    """Coordinates and rates; read as stamp, frame, configuration and velocity."""

    type_name = JOINT_STATE

    def encode(self, payload: ModelEstimate, wire: Wire) -> bytes:
        return wire.serialize(JOINT_STATE, estimate_to_joint_state(payload, self.model, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, FloatArray, FloatArray]:
        return joint_state_to_model(wire.deserialize(JOINT_STATE, cdr), self.model)

    def stamp_ns(self, payload: tuple[int, str, FloatArray, FloatArray]) -> int:
        return payload[0]


class ModelStddev(OfModel):
    """Standard deviations of coordinates and rates."""

    type_name = JOINT_STATE

    def encode(self, payload: ModelEstimate, wire: Wire) -> bytes:
        return wire.serialize(JOINT_STATE, estimate_to_stddevs(payload, self.model, wire.types))


class ModelCovariance(OfModel):
    """Covariance of coordinates and rates; read as stamp and matrix."""

    type_name = IMAGE

    def encode(self, payload: ModelEstimate, wire: Wire) -> bytes:
        return wire.serialize(IMAGE, covariance_to_image(payload, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, FloatArray]:
        return image_to_covariance(wire.deserialize(IMAGE, cdr), self.model)


class Text(Codec):
    """A string."""

    type_name = STRING

    def encode(self, payload: str, wire: Wire) -> bytes:
        return wire.serialize(STRING, wire.types.make(STRING, data=payload))


class Angles(Codec):
    """Joint angles, or their standard deviations.

    Args:
        body: id of the person.
        part: 0 for the angles, 1 for the standard deviations.
        convention: returns its name, which may change.
    """

    type_name = JOINT_STATE

    def __init__(self, body: str, part: int, convention: Callable[[], str]) -> None:
        self.body, self.part, self.convention = body, part, convention

    def encode(self, payload: JointAngles, wire: Wire) -> bytes:
        stddev = self.part == 1
        message = angles_to_joint_state(payload, self.body, self.convention(), wire.types, stddev=stddev)
        return wire.serialize(JOINT_STATE, message)


class Ids(Codec):
    """The ids of the tracked people, with stamp and frame."""

    type_name = "hri_msgs/msg/IdsList"

    def encode(self, payload: tuple[int, str, tuple[str, ...]], wire: Wire) -> bytes:
        stamp_ns, frame_id, ids = payload
        header = to_header(stamp_ns, frame_id, wire.types)
        return wire.serialize(self.type_name, wire.types.make(self.type_name, header=header, ids=list(ids)))
