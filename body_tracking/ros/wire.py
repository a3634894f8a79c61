"""Serialisation of messages by the client library."""

from __future__ import annotations

from typing import Any

from rclpy.serialization import serialize_message

from body_tracking.ros.bag_topics import message_class
from body_tracking.ros.node import ROS, deserialized


class RosWire:
    """The :class:`~body_tracking.messages.codecs.Wire` of rclpy."""

    types = ROS

    def serialize(self, type_name: str, message: Any) -> bytes:
        return bytes(serialize_message(message))

    def deserialize(self, type_name: str, cdr: bytes) -> Any:
        return deserialized(cdr, message_class(type_name))


WIRE = RosWire()
