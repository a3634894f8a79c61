"""Serialisation of messages by the client library."""

from __future__ import annotations

from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from body_tracking.messages.base import MessageError, RosMessages
from body_tracking.ros.bag_topics import message_class

ROS = RosMessages()


def deserialized(cdr: bytes, kind: type[Any]) -> Any:
    """A message from CDR bytes; MessageError where they are not of this type."""
    try:
        return deserialize_message(cdr, kind)
    except Exception as error:  # each RMW raises errors of its own
        raise MessageError(f"{len(cdr)} bytes are no {kind.__name__}") from error


class RosWire:
    """The :class:`~body_tracking.messages.codecs.Wire` of rclpy."""

    types = ROS

    def serialize(self, type_name: str, message: Any) -> bytes:
        return bytes(serialize_message(message))

    def deserialize(self, type_name: str, cdr: bytes) -> Any:
        return deserialized(cdr, message_class(type_name))


WIRE = RosWire()
