"""Colour images and compressed ones: decoding inverts encoding, and hostile images are refused."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np
import pytest

from body_tracking.camera.codecs import ColourImage, CompressedColour, CompressedDepth
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE
from body_tracking.messages.base import MessageError, to_header
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, serialize

STAMP = 1_750_000_000_123_456_789


def picture() -> np.ndarray[Any, np.dtype[np.uint8]]:
    rows, columns = np.mgrid[:48, :64]
    return np.stack([4 * columns, 5 * rows, 255 - 2 * (rows + columns) // 2], axis=-1).astype(np.uint8)


def image(encoding: str, pixels: np.ndarray[Any, Any]) -> bytes:
    height, width = pixels.shape[:2]
    return serialize(
        BAG_MESSAGES.make(
            IMAGE,
            header=to_header(STAMP, "camera1", BAG_MESSAGES),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=pixels.nbytes // height,
            data=BAG_MESSAGES.octets(np.ascontiguousarray(pixels).tobytes()),
        )
    )


def compressed(data: bytes, form: str) -> bytes:
    header = to_header(STAMP, "camera1", BAG_MESSAGES)
    return serialize(BAG_MESSAGES.make(COMPRESSED_IMAGE, header=header, format=form, data=BAG_MESSAGES.octets(data)))


def test_colours_come_in_the_order_red_green_blue_whatever_the_encoding() -> None:
    rgb = picture()
    alpha = np.full((*rgb.shape[:2], 1), 255, np.uint8)
    for encoding, pixels in (
        ("rgb8", rgb),
        ("bgr8", rgb[..., ::-1]),
        ("rgba8", np.concatenate([rgb, alpha], axis=2)),
        ("bgra8", np.concatenate([rgb[..., ::-1], alpha], axis=2)),
    ):
        stamp_ns, frame, read = ColourImage().decode(image(encoding, pixels), BAG_WIRE)
        assert (stamp_ns, frame) == (STAMP, "camera1")
        np.testing.assert_array_equal(read, rgb)
    _, _, grey = ColourImage().decode(image("mono8", rgb[..., 0]), BAG_WIRE)
    np.testing.assert_array_equal(grey, np.repeat(rgb[..., :1], 3, axis=2))
    written = ColourImage().encode((STAMP, "camera1", rgb), BAG_WIRE)
    np.testing.assert_array_equal(ColourImage().decode(written, BAG_WIRE)[2], rgb)


def test_other_encodings_are_named() -> None:
    with pytest.raises(MessageError, match="'32FC1', expected one of rgb8, bgr8"):
        ColourImage().decode(image("32FC1", np.zeros((4, 4), np.float32)), BAG_WIRE)


def test_compressed_colours_are_nearly_the_same_and_depth_exactly() -> None:
    rgb = picture()
    stamp_ns, frame, read = CompressedColour().decode(
        CompressedColour().encode((STAMP, "camera1", rgb), BAG_WIRE), BAG_WIRE
    )
    assert (stamp_ns, frame) == (STAMP, "camera1")
    assert np.abs(read.astype(int) - rgb).mean() < 4.0
    depth = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    stamp_ns, _, metres = CompressedDepth().decode(
        CompressedDepth().encode((STAMP, "camera1", depth), BAG_WIRE), BAG_WIRE
    )
    assert stamp_ns == STAMP
    np.testing.assert_array_equal(metres, (depth / np.float32(1e3)).astype(np.float32))


def png(width: int, height: int) -> bytes:
    """A PNG that states a size and has next to no data."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """A JPEG whose head states another size than it has."""
    done, data = cv2.imencode(".jpg", picture())
    assert done
    octets = bytearray(data.tobytes())
    place = octets.index(b"\xff\xc0")
    octets[place + 5 : place + 9] = struct.pack(">HH", height, width)
    return bytes(octets)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no JPEG or PNG"),
        (b"GIF89a" + bytes(100), "no JPEG or PNG"),
        (b"\xff\xd8\xff", "no JPEG or PNG"),
        (b"\xff\xd8" + b"\xff\xe0\x00\x02" * 1000, "no JPEG or PNG"),
        (png(30_000, 30_000), "900000000 pixels"),
        (jpeg(65_535, 65_535), "4294836225 pixels"),
        (png(0, 5), "image of 0 pixels"),
        (png(5, 5)[:40], "damaged"),
    ],
)
def test_hostile_images_are_refused_before_memory_is_taken(data: bytes, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        CompressedColour().decode(compressed(data, "jpeg"), BAG_WIRE)
    with pytest.raises(MessageError):
        CompressedDepth().decode(compressed(bytes(12) + data, "16UC1; compressedDepth png"), BAG_WIRE)


def test_quantised_depth_is_named() -> None:
    with pytest.raises(MessageError, match="'32FC1; compressedDepth png', expected 16UC1"):
        CompressedDepth().decode(compressed(bytes(40), "32FC1; compressedDepth png"), BAG_WIRE)
