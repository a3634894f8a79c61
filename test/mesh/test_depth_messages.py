"""Depth images as messages: both encodings, any row length and byte order, and refused messages."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from depth_shapes import camera

from body_tracking.mesh.codecs import BodyIndex, DepthImage
from body_tracking.messages.base import MessageError
from body_tracking.messages.codecs import CameraInfo
from body_tracking.messages.images import DEPTH, array_to_image, image_to_array
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE

STAMP_NS = 1_700_000_000_000_000_123
MILLIMETRES = np.array([[0, 1500, 4500], [780, 65535, 1]], dtype=np.uint16)


def test_millimetres_and_metres_are_the_same_image() -> None:
    metres = np.array([[np.nan, 1.5, 4.5], [0.78, np.inf, 0.001]], dtype=np.float32)
    by_metres = BAG_WIRE.serialize(
        "sensor_msgs/msg/Image", array_to_image(metres, STAMP_NS, "kinect1_optical_frame", BAG_MESSAGES, "32FC1")
    )
    by_millimetres = DepthImage().encode((STAMP_NS, "kinect1_optical_frame", MILLIMETRES), BAG_WIRE)
    one, other = (DepthImage().decode(cdr, BAG_WIRE) for cdr in (by_metres, by_millimetres))
    assert one[:2] == other[:2] == (STAMP_NS, "kinect1_optical_frame")
    np.testing.assert_array_equal(one[2], other[2])
    np.testing.assert_array_equal(one[2], np.float32([[0.0, 1.5, 4.5], [0.78, 0.0, 0.001]]))
    assert DepthImage().stamp_ns(one) == STAMP_NS


@pytest.mark.parametrize(("encoding", "kind"), [("32FC1", "f4"), ("16UC1", "u2")])
def test_byte_order_and_padded_rows_change_nothing(encoding: str, kind: str) -> None:
    pixels = np.arange(12).reshape(3, 4).astype(kind)
    padded = np.zeros((3, 6), f">{kind}")
    padded[:, :4] = pixels
    message = array_to_image(pixels, STAMP_NS, "k", BAG_MESSAGES, encoding)
    other = SimpleNamespace(**{name: getattr(message, name) for name in ("header", "height", "width", "encoding")})
    other.is_bigendian, other.step, other.data = 1, 6 * np.dtype(kind).itemsize, padded.tobytes()
    np.testing.assert_array_equal(image_to_array(other, DEPTH)[2], pixels)
    np.testing.assert_array_equal(image_to_array(message, DEPTH)[2], pixels)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "8UC1", "64FC1", ""])
def test_other_encodings_are_refused_by_name(encoding: str) -> None:
    message = array_to_image(np.zeros((2, 3), np.uint8), STAMP_NS, "k", BAG_MESSAGES, encoding or "x")
    message.encoding = encoding
    with pytest.raises(MessageError, match=rf"encoding '{encoding}', expected one of 16UC1, 32FC1"):
        DepthImage().decode(BAG_WIRE.serialize("sensor_msgs/msg/Image", message), BAG_WIRE)


def test_sizes_that_contradict_each_other_are_refused() -> None:
    message = array_to_image(MILLIMETRES, STAMP_NS, "k", BAG_MESSAGES, "16UC1")
    message.width = 4
    with pytest.raises(MessageError, match="4 x 2 pixels of 16UC1, 6 bytes a row"):
        image_to_array(message, DEPTH)


def test_body_index_and_calibration_come_back() -> None:
    index = np.array([[255, 0], [5, 255]], dtype=np.uint8)
    stamp_ns, frame, pixels = BodyIndex().decode(BodyIndex().encode((STAMP_NS, "k", index), BAG_WIRE), BAG_WIRE)
    assert (stamp_ns, frame) == (STAMP_NS, "k") and BodyIndex().stamp_ns((STAMP_NS, "k", pixels)) == STAMP_NS
    np.testing.assert_array_equal(pixels, index)
    with pytest.raises(MessageError, match="encoding 'mono16', expected one of mono8, 8UC1"):
        BodyIndex().decode(BodyIndex().encode((STAMP_NS, "k", MILLIMETRES), BAG_WIRE), BAG_WIRE)
    own = camera(k1=0.09)
    found = CameraInfo().decode(CameraInfo().encode((STAMP_NS, own), BAG_WIRE), BAG_WIRE)
    assert (found.frame_id, found.width, found.height) == (own.frame_id, own.width, own.height)
    np.testing.assert_array_equal(found.matrix, own.matrix)
    np.testing.assert_array_equal(found.distortion, own.distortion)
