"""``sensor_msgs/Image`` to and from arrays: brightness, distance or colour."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.message_types import IMAGE
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds

BRIGHTNESS: Final = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
DEPTH: Final = {"16UC1": "u2", "32FC1": "f4", "mono16": "u2"}
"""Encodings of distances: millimetres, metres (REP-118), and ``mono16``, by which some drivers mean millimetres."""
MAX_PIXELS: Final = 1 << 26
"""An image with more pixels is malformed."""


_COLOURS: Final = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
"""Channels of colour encodings."""
_GREY: Final = ("mono8", "8UC1")


def to_mono(message: Any) -> tuple[int, NDArray[Any], bool]:
    """Stamp in nanoseconds, (height, width) brightness, and whether the image was in colour.

    The brightness of a colour image is the mean of its channels: an infrared camera with such an encoding has three
    equal ones.

    Raises:
        MessageError: another encoding, sizes that contradict each other.
    """
    channels = _COLOURS.get(str(message.encoding))
    if channels is None:
        stamp_ns, _, pixels = image_to_array(message)
        return stamp_ns, pixels, False
    rows = _rows(message, channels)
    total = rows.reshape(len(rows), -1, channels)[..., :3].sum(axis=2, dtype=np.uint16)
    return to_nanoseconds(message.header.stamp), ((total + 1) // 3).astype(np.uint8), True


def to_rgb(message: Any) -> tuple[int, str, NDArray[np.uint8]]:
    """Stamp in nanoseconds, frame, and (height, width, 3) red, green and blue of a colour image or of a grey one.

    Raises:
        MessageError: another encoding, sizes that contradict each other.
    """
    encoding = str(message.encoding)
    channels = _COLOURS.get(encoding, 1 if encoding in _GREY else 0)
    if not channels:
        raise MessageError(f"encoding {encoding!r}, expected one of {', '.join((*_COLOURS, *_GREY))}")
    rows = _rows(message, channels)
    pixels = rows.reshape(len(rows), -1, channels)
    if channels == 3 and encoding.startswith("rgb"):
        colours = np.ascontiguousarray(pixels)
    else:
        # channel by channel: indexing with a list of them takes five times as long
        order = (0, 0, 0) if channels == 1 else (2, 1, 0) if encoding.startswith("bgr") else (0, 1, 2)
        colours = np.empty((*pixels.shape[:2], 3), np.uint8)
        for k, channel in enumerate(order):
            colours[..., k] = pixels[..., channel]
    return to_nanoseconds(message.header.stamp), str(message.header.frame_id), colours


def _rows(message: Any, pixel_bytes: int) -> NDArray[np.uint8]:
    """(height, width * pixel_bytes) bytes of the pixels; MessageError where sizes contradict each other."""
    height, width, step, size = int(message.height), int(message.width), int(message.step), len(message.data)
    if not 0 < height * width <= MAX_PIXELS or step < width * pixel_bytes or size != step * height:
        what = f"{width} x {height} pixels of {message.encoding}"
        raise MessageError(f"{what}, {step} bytes a row and {size} in all")
    return np.frombuffer(memoryview(message.data), np.uint8).reshape(height, step)[:, : width * pixel_bytes]


def image_to_array(message: Any, encodings: Mapping[str, str] = BRIGHTNESS) -> tuple[int, str, NDArray[Any]]:
    """Stamp in nanoseconds, frame, and the (height, width) pixels.

    Args:
        message: of ``sensor_msgs/Image``.
        encodings: the allowed ones, with numpy's type of each.

    Raises:
        MessageError: another encoding, as of a colour image; sizes that contradict each other.
    """
    encoding = str(message.encoding)
    if encoding not in encodings:
        raise MessageError(f"encoding {encoding!r}, expected one of {', '.join(encodings)}")
    kind = np.dtype(encodings[encoding]).newbyteorder(">" if message.is_bigendian else "<")
    pixels = np.ascontiguousarray(_rows(message, kind.itemsize)).view(kind)
    return to_nanoseconds(message.header.stamp), str(message.header.frame_id), pixels.astype(kind.newbyteorder("="))


def array_to_image(pixels: NDArray[Any], stamp_ns: int, frame_id: str, types: MessageTypes, encoding: str = "") -> Any:
    """The message of (height, width) or (height, width, channels) pixels.

    The default encoding is ``mono8`` or ``mono16``, by the size of a number.
    """
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
    return types.make(
        IMAGE,
        header=to_header(stamp_ns, frame_id, types),
        height=height,
        width=width,
        encoding=encoding or ("mono8" if pixels.dtype.itemsize == 1 else "mono16"),
        is_bigendian=0,
        step=width * rows.dtype.itemsize * (rows.shape[2] if rows.ndim == 3 else 1),
        data=types.octets(rows.tobytes()),
    )
