"""Parts of every conversion: message classes, stamps and headers."""

from __future__ import annotations

import array
import importlib
from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import MAX_STAMP_NS, NANOSECONDS, FloatArray


class MessageError(BodyTrackingError):
    """A message does not have the layout that its topic promises."""


class MessageTypes(Protocol):
    """A family of message classes."""

    def make(self, type_name: str, /, **fields: Any) -> Any:
        """A message of type ``pkg/msg/Name``; all its fields must be given."""

    def octets(self, data: bytes) -> Any:
        """The value of a ``uint8[]`` field."""

    def floats(self, values: FloatArray) -> Any:
        """The value of a ``float64[]`` field."""


class RosMessages:
    """The classes that ``rclpy`` publishes."""

    @staticmethod
    @cache
    def _class(type_name: str) -> Any:
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)

    def make(self, type_name: str, /, **fields: Any) -> Any:
        return self._class(type_name)(**fields)

    def octets(self, data: bytes) -> Any:
        return array.array("B", data)

    def floats(self, values: FloatArray) -> Any:
        return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


class BagMessages:
    """The classes of a ``rosbags`` type store.

    Args:
        class_of: the class of a message type ``pkg/msg/Name``.
    """

    def __init__(self, class_of: Callable[[str], Any]) -> None:
        self._class_of = class_of

    def make(self, type_name: str, /, **fields: Any) -> Any:
        return self._class_of(type_name)(**fields)

    def octets(self, data: bytes) -> Any:
        return np.frombuffer(data, dtype=np.uint8)

    def floats(self, values: FloatArray) -> Any:
        return np.asarray(values, dtype=np.float64)


def to_nanoseconds(stamp: Any) -> int:
    """``builtin_interfaces/Time`` to integer nanoseconds, 0 to :data:`~body_tracking.core.skeleton.MAX_STAMP_NS`.

    Raises:
        MessageError: not a valid ROS time: negative, or with a second or more of nanoseconds.
    """
    sec, nanosec = int(stamp.sec), int(stamp.nanosec)
    if not (0 <= sec < 2**31 and 0 <= nanosec < NANOSECONDS):
        raise MessageError(f"a stamp of {sec} s and {nanosec} ns, expected 0 to 2147483647 s and less than 1e9 ns")
    return sec * NANOSECONDS + nanosec


def to_time(nanoseconds: int, types: MessageTypes) -> Any:
    """Integer nanoseconds to ``builtin_interfaces/Time``.

    Raises:
        MessageError: outside the range of ROS time.
    """
    if not 0 <= nanoseconds <= MAX_STAMP_NS:
        raise MessageError(f"a stamp of {nanoseconds} ns, expected 0 to {MAX_STAMP_NS}")
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return types.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def to_header(stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """``std_msgs/Header``."""
    return types.make("std_msgs/msg/Header", stamp=to_time(stamp_ns, types), frame_id=frame_id)


def to_vector(values: FloatArray, types: MessageTypes) -> Any:
    """``geometry_msgs/Vector3`` of (3,)."""
    x, y, z = (float(value) for value in values)
    return types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def to_transform(translation: FloatArray, quat_xyzw: FloatArray, types: MessageTypes) -> Any:
    """``geometry_msgs/Transform`` of (3,) metres and a unit quaternion (4,)."""
    x, y, z, w = (float(value) for value in quat_xyzw)
    return types.make(
        "geometry_msgs/msg/Transform",
        translation=to_vector(translation, types),
        rotation=types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
    )
