"""Codecs of the mesh system's messages."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.message_types import IMAGE
from body_tracking.core.skeleton import SingleArray
from body_tracking.mesh.depth import DepthError, to_metres
from body_tracking.messages.base import MessageError
from body_tracking.messages.cameras import CAMERA_INFO, camera_to_info, info_to_camera
from body_tracking.messages.codecs import Codec, Wire
from body_tracking.messages.images import BRIGHTNESS, DEPTH, array_to_image, image_to_array


class DepthImage(Codec):
    """A depth image: stamp in nanoseconds, frame, (height, width) metres; written from ``uint16`` millimetres."""

    type_name = IMAGE

    def encode(self, payload: tuple[int, str, NDArray[Any]], wire: Wire) -> bytes:
        stamp_ns, frame_id, pixels = payload
        return wire.serialize(IMAGE, array_to_image(pixels, stamp_ns, frame_id, wire.types, "16UC1"))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, SingleArray]:
        stamp_ns, frame_id, pixels = image_to_array(wire.deserialize(IMAGE, cdr), DEPTH)
        try:
            return stamp_ns, frame_id, to_metres(pixels)
        except DepthError as error:
            raise MessageError(str(error)) from error

    def stamp_ns(self, payload: tuple[int, str, SingleArray]) -> int:
        return payload[0]


class BodyIndex(Codec):
    """A body-index image: stamp in nanoseconds, frame, (height, width) number of the body, 255 for none."""

    type_name = IMAGE

    def encode(self, payload: tuple[int, str, NDArray[Any]], wire: Wire) -> bytes:
        stamp_ns, frame_id, pixels = payload
        return wire.serialize(IMAGE, array_to_image(pixels, stamp_ns, frame_id, wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, NDArray[Any]]:
        eight = {name: kind for name, kind in BRIGHTNESS.items() if kind == "u1"}
        return image_to_array(wire.deserialize(IMAGE, cdr), eight)

    def stamp_ns(self, payload: tuple[int, str, NDArray[Any]]) -> int:
        return payload[0]


class DepthInfo(Codec):
    """The calibration of a depth camera; written with a stamp in nanoseconds."""

    type_name = CAMERA_INFO

    def encode(self, payload: tuple[int, Camera], wire: Wire) -> bytes:
        return wire.serialize(CAMERA_INFO, camera_to_info(payload[1], payload[0], wire.types))

    def decode(self, cdr: bytes, wire: Wire) -> Camera:
        return info_to_camera(wire.deserialize(CAMERA_INFO, cdr))
