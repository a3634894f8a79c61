"""Codecs of the mesh system's messages."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.message_types import IMAGE
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.depth import DepthError, to_metres
from body_tracking.messages.base import MessageError, to_header, to_nanoseconds
from body_tracking.messages.codecs import Codec, Image, Wire
from body_tracking.messages.images import BRIGHTNESS, DEPTH, image_to_array
from body_tracking.messages.markers import MARKER, marker, to_colour, to_points

_TRIANGLES: Final = 11
"""``visualization_msgs/Marker``: list of triangles."""
_SKIN: Final = (214, 180, 150)
"""Colour of the mesh: red, green, blue."""


class DepthImage(Image):
    """A depth image: stamp in nanoseconds, frame, (height, width) metres; encoded from ``uint16`` millimetres."""

    encoding = "16UC1"

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, SingleArray]:
        stamp_ns, frame_id, pixels = image_to_array(wire.deserialize(IMAGE, cdr), DEPTH)
        try:
            return stamp_ns, frame_id, to_metres(pixels)
        except DepthError as error:
            raise MessageError(str(error)) from error


class BodyIndex(Image):
    """A body-index image: stamp in nanoseconds, frame, (height, width) number of the body, 255 for none."""

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, NDArray[Any]]:
        eight = {name: kind for name, kind in BRIGHTNESS.items() if kind == "u1"}
        return image_to_array(wire.deserialize(IMAGE, cdr), eight)


class MeshMarker(Codec):
    """A mesh as a marker of triangles: stamp in nanoseconds, frame, (F, 3, 3) corners in metres."""

    type_name = MARKER

    def encode(self, payload: tuple[int, str, FloatArray], wire: Wire) -> bytes:
        stamp_ns, frame_id, corners = payload
        types = wire.types
        pose = types.make(
            "geometry_msgs/msg/Pose",
            position=types.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
            orientation=types.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        scale = types.make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0)
        given = to_header(stamp_ns, frame_id, types), "mesh", 0, _TRIANGLES, scale, to_colour(_SKIN, types), pose, types
        return wire.serialize(MARKER, marker(*given, points=to_points(corners.reshape(-1, 3), types)))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, FloatArray]:
        message = wire.deserialize(MARKER, cdr)
        if message.type != _TRIANGLES or not message.points or len(message.points) % 3:
            raise MessageError(f"marker of type {message.type} with {len(message.points)} points, expected triangles")
        corners = np.array([(point.x, point.y, point.z) for point in message.points])
        return to_nanoseconds(message.header.stamp), str(message.header.frame_id), corners.reshape(-1, 3, 3)
