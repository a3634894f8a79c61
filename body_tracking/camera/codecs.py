"""Codecs of images in colour, and of images that image_transport has compressed."""

from __future__ import annotations

import struct
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE
from body_tracking.core.skeleton import SingleArray
from body_tracking.mesh.depth import DepthError, to_metres
from body_tracking.messages.base import MessageError, to_header, to_nanoseconds
from body_tracking.messages.codecs import Codec, Image, Wire
from body_tracking.messages.images import MAX_PIXELS, to_rgb

Colour = tuple[int, str, NDArray[np.uint8]]
"""Stamp in nanoseconds, frame, (height, width, 3) red, green, blue."""
_QUALITY: Final = 90
"""Of JPEG images, percent."""
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of the segment that states the size."""
_DEPTH_HEADER: Final = struct.Struct("<iff")
"""Before the PNG of a compressed depth image: a number for the format (0: 16-bit millimetres) and two coefficients for
quantised metres, which are not used with it (compressed_depth_image_transport)."""


class ColourImage(Image):
    """``sensor_msgs/Image`` in colour."""

    encoding = "rgb8"

    def decode(self, cdr: bytes, wire: Wire) -> Colour:
        return to_rgb(wire.deserialize(IMAGE, cdr))


class CompressedColour(Codec):
    """``sensor_msgs/CompressedImage`` of a colour image; written as JPEG."""

    type_name = COMPRESSED_IMAGE

    def encode(self, payload: Colour, wire: Wire) -> bytes:
        stamp_ns, frame_id, pixels = payload
        done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not done:
            raise MessageError(f"image of {pixels.shape} cannot be written as JPEG")
        return _compressed(data.tobytes(), stamp_ns, frame_id, "rgb8; jpeg compressed bgr8", wire)

    @staticmethod
    def packed(data: bytes, stamp_ns: int, frame_id: str, form: str, wire: Wire) -> bytes:
        """The message of an image that is compressed already: ``form`` is ``jpeg`` or ``png``."""
        return _compressed(data, stamp_ns, frame_id, f"rgb8; {form} compressed bgr8", wire)

    def decode(self, cdr: bytes, wire: Wire) -> Colour:
        message = wire.deserialize(COMPRESSED_IMAGE, cdr)
        pixels = _decoded(memoryview(message.data), cv2.IMREAD_COLOR, str(message.format))
        return _stamp_and_frame(message) + (np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8),)

    def stamp_ns(self, payload: Colour) -> int:
        return payload[0]


class CompressedDepth(Codec):
    """``sensor_msgs/CompressedImage`` of a depth image, by compressed_depth_image_transport: PNG of 16-bit millimetres.

    Decoded as stamp in nanoseconds, frame, (height, width) metres, 0 where missing.
    """

    type_name = COMPRESSED_IMAGE

    def encode(self, payload: tuple[int, str, NDArray[np.uint16]], wire: Wire) -> bytes:
        stamp_ns, frame_id, pixels = payload
        done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not done:
            raise MessageError(f"depth image of {pixels.shape} cannot be written as PNG")
        header = _DEPTH_HEADER.pack(0, 0.0, 0.0)
        return _compressed(header + data.tobytes(), stamp_ns, frame_id, "16UC1; compressedDepth png", wire)

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, str, SingleArray]:
        message = wire.deserialize(COMPRESSED_IMAGE, cdr)
        if not str(message.format).startswith("16UC1"):
            raise MessageError(f"format {message.format!r}, expected 16UC1 in PNG")
        pixels = _decoded(memoryview(message.data)[_DEPTH_HEADER.size :], cv2.IMREAD_UNCHANGED, str(message.format))
        try:
            return _stamp_and_frame(message) + (to_metres(pixels),)
        except DepthError as error:
            raise MessageError(str(error)) from error

    def stamp_ns(self, payload: tuple[int, str, SingleArray]) -> int:
        return payload[0]


def _compressed(data: bytes, stamp_ns: int, frame_id: str, form: str, wire: Wire) -> bytes:
    types = wire.types
    message = types.make(
        COMPRESSED_IMAGE, header=to_header(stamp_ns, frame_id, types), format=form, data=types.octets(data)
    )
    return wire.serialize(COMPRESSED_IMAGE, message)


def _decoded(data: memoryview, flags: int, form: str) -> NDArray[Any]:
    """The pixels of a JPEG or PNG image; MessageError for other data, a damaged image or a hostile size."""
    size = _size_of(bytes(data))
    if size is None:
        raise MessageError(f"{len(data)} bytes of format {form!r} are no JPEG or PNG image")
    if not 0 < size <= MAX_PIXELS:
        raise MessageError(f"image of {size} pixels, at most {MAX_PIXELS} are read")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise MessageError(f"image of format {form!r}: {' '.join(str(error).split())}") from error
    if pixels is None:
        raise MessageError(f"image of format {form!r} is damaged")
    return pixels


def _size_of(data: bytes) -> int | None:
    """Number of pixels by the header of an image, before memory is allocated; None without such a header."""
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width) * int(height)
    if not data.startswith(b"\xff\xd8"):
        return None
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack(">HH", data[place + 5 : place + 9])
            return int(width) * int(height)
        place += 2 + length
    return None


def _stamp_and_frame(message: Any) -> tuple[int, str]:
    return to_nanoseconds(message.header.stamp), str(message.header.frame_id)
