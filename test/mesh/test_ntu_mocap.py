"""Folders in the format of the NTU motion capture data set become bags; broken ones are refused by name."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import RecordedImu
from body_tracking.core.protobuf import ProtobufError, fields, signed
from body_tracking.core.skeleton import NANOSECONDS, Joint, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.mesh.codecs import BodyIndex, DepthImage
from body_tracking.mesh.ntu_mocap import (
    HEIGHT,
    WIDTH,
    NtuMocapError,
    NtuMocapRecording,
    RecordedDepth,
    RecordedMarkers,
    is_ntu_mocap,
)
from body_tracking.mesh.topics import body_index_topic, depth_topic, info_topic
from body_tracking.messages.codecs import CameraInfo
from body_tracking.recording.importer import import_files
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader

IMAGES = 3
STAMPS_MS = (1000.0, 1033.4, 1066.5)
INTRINSICS = (365.5, 365.5, 260.0, 208.0, 0.09, -0.27, 0.09)
WRIST = (0.3, 0.2, 2.0)
"""In Kinect camera space: to the sensor's left, up, forward."""


def varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def tag(field: int, kind: int) -> bytes:
    return varint(field << 3 | kind)


def integer(field: int, value: int) -> bytes:
    return tag(field, 0) + varint(value)


def zigzag(field: int, value: int) -> bytes:
    return integer(field, value << 1 if value >= 0 else (-value << 1) - 1)


def double(field: int, value: float) -> bytes:
    return tag(field, 1) + struct.pack("<d", value)


def single(field: int, value: float) -> bytes:
    return tag(field, 5) + struct.pack("<f", value)


def inside(field: int, data: bytes) -> bytes:
    return tag(field, 2) + varint(len(data)) + data


def body(tracked: bool) -> bytes:
    joints = b""
    for joint in (Joint.SPINE_BASE, Joint.WRIST_LEFT):
        point = b"".join(single(axis, value) for axis, value in enumerate(WRIST, 1))
        # numbers that are 0 are not written: SpineBase is the key 0
        key = integer(1, joint) if joint else b""
        joints += inside(4, key + inside(2, inside(1, point) + integer(2, TrackingState.TRACKED)))
    return integer(1, 72057594037930000) + (integer(2, 1) if tracked else b"") + joints


def sample(ms: float) -> bytes:
    def vector(values: tuple[int, int, int]) -> bytes:
        return b"".join(zigzag(axis, value) for axis, value in enumerate(values, 1))

    bias = b"".join(single(axis, value) for axis, value in enumerate((1.0, -2.0, 0.0), 1))
    readings = inside(8, vector((0, 0, 5556))) + inside(9, vector((101, -2, 0))) + inside(10, vector((110, 20, -30)))
    return integer(1, 17) + readings + double(15, ms) + inside(17, bias)


def ray_table() -> np.ndarray:
    """The SDK's table of rays for its mirrored image: x to the sensor's left, y up."""
    fx, fy, cx, cy, second, fourth, sixth = INTRINSICS
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    camera = Camera("sdk", WIDTH, HEIGHT, matrix, np.array([second, fourth, 0.0, 0.0, sixth]))
    pixels = np.stack(np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT))), axis=-1)
    return (camera.undistort(pixels) * [1.0, -1.0]).astype("<f4")


TABLE = ray_table()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording of three images, with everything."""
    path = tmp_path / "FA2"
    for name in ("kinect", "imu1", "imu9", "imu17", "vicon"):
        (path / name).mkdir(parents=True)
    depth = np.full((IMAGES, HEIGHT, WIDTH), 2000, "<u2")
    depth[:, 100, 400] = [1001, 1002, 1003]  # in the mirrored image on the right
    bodies = np.full((IMAGES, HEIGHT, WIDTH), 255, "u1")
    bodies[:, 100, 400] = 2
    frames = b"".join(inside(1, double(1, ms) + inside(3, body(False)) + inside(3, body(True))) for ms in STAMPS_MS)
    samples = b"".join(inside(1, sample(1000.0 + 12.5 * k)) for k in range(6))
    rows = [f"{k + 1}\t{k / 100:.2f}\t{100 + k}\t200\t300\t\t\t" for k in range(4)]
    table = ["PathFileType\t4", "DataRate\tCameraRate", "100\t100", "Frame#\tTime\tx:LWRA\t\t\tx:LWRB", "\tX1", *rows]
    files = {
        "kinect/timestamp.bin": np.array(STAMPS_MS, "<f8").tobytes(),
        "kinect/depthBuffer.bin": depth.tobytes(),
        "kinect/bodyIndexBuffer.bin": bodies.tobytes(),
        "kinect/cameraIntrinsics.bin": np.array(INTRINSICS, "<f4").tobytes(),
        "kinect/depthToCameraSpaceTable.bin": TABLE.tobytes(),
        "kinect/OfflineBodyframe.protobuf": frames,
        "setting.SettingProto": integer(1, 1) + integer(2, 9) + integer(3, 17),
        **{f"imu{k}/RawSample.RawSampleListProto": samples for k in (1, 9, 17)},
        **{
            f"imu{k}/magCalibrationParameters.bin": np.array([10.0, 0, 0, *np.eye(3).ravel()], "<f4").tobytes()
            for k in (1, 9, 17)
        },
        "vicon/viconRecord.TRC": "\r\n".join(table).encode(),
        "vicon/viconStartOffset.bin": struct.pack("<d", 0.5),
    }
    for name, data in files.items():
        (path / name).write_bytes(data)
    return path


def test_a_folder_has_images_skeletons_readings_and_markers_in_the_order_of_their_times(folder: Path) -> None:
    assert is_ntu_mocap(folder) and not is_ntu_mocap(folder / "kinect")
    recording = NtuMocapRecording(folder, "kinect1")
    items = list(recording)
    assert recording.warnings == [] and recording.problems == {} and recording.progress == 1.0
    assert [item.received_ns for item in items] == sorted(item.received_ns for item in items)
    kinds = [sum(isinstance(item, kind) for item in items) for kind in (RecordedDepth, RecordedFrame, RecordedImu)]
    assert kinds == [3, 3, 18]
    # half an image after the first, and every 10 ms from there
    markers = [item for item in items if isinstance(item, RecordedMarkers)]
    assert [each.received_ns for each in markers] == [1016700000 + 10000000 * k for k in range(4)]
    np.testing.assert_allclose(markers[1].positions, [[0.101, 0.2, 0.3]])
    assert markers[1].names == ("LWRA",)


def test_images_and_skeletons_are_in_one_optical_frame(folder: Path) -> None:
    items = list(NtuMocapRecording(folder))
    image = next(item for item in items if isinstance(item, RecordedDepth))
    # the right of the SDK's mirrored image is on the left here
    assert image.depth[100, WIDTH - 1 - 400] == 1001 and image.bodies is not None
    assert image.bodies[100, WIDTH - 1 - 400] == 2 and (image.bodies == 255).sum() == WIDTH * HEIGHT - 1
    (skeleton,) = next(item for item in items if isinstance(item, RecordedFrame)).skeletons
    np.testing.assert_allclose(skeleton.positions[Joint.WRIST_LEFT], [-0.3, -0.2, 2.0], rtol=1e-6)
    assert skeleton.states[Joint.SPINE_BASE] == TrackingState.TRACKED and skeleton.valid.sum() == 2
    # a pixel of the table sees the point where the intrinsics project it to
    row, column = 120, 300
    x, y = TABLE[row, column].astype(float)
    pixel = image.camera.project(np.array([[-2.0 * x, -2.0 * y, 2.0]]))
    np.testing.assert_allclose(pixel[0], [WIDTH - 1 - column, row], atol=0.05)


def test_readings_are_in_si_units_without_the_bias(folder: Path) -> None:
    readings = {item.sensor: item.sample for item in NtuMocapRecording(folder) if isinstance(item, RecordedImu)}
    assert set(readings) == {"imu_camera", "imu_forearm_left", "imu_forearm_right"}
    found = readings["imu_forearm_left"]
    assert found.acceleration is not None and found.angular_velocity is not None and found.magnetic_field is not None
    assert found.acceleration[2] == pytest.approx(9.807, abs=0.01)
    np.testing.assert_allclose(found.angular_velocity, [np.radians(7.0), 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.magnetic_field, [0.8e-6, 0.16e-6, -0.24e-6], atol=1e-12)


def test_the_bag_has_what_a_depth_camera_publishes(folder: Path, tmp_path: Path) -> None:
    report = import_files([folder], tmp_path / "bag")
    assert report.sensors["kinect1"].frames == 6 and report.warnings == []
    found: dict[str, list[bytes]] = {}
    with BagReader(tmp_path / "bag") as bag:
        for raw in bag.messages():
            found.setdefault(raw.topic, []).append(raw.cdr)
    stamp_ns, frame_id, depth = DepthImage().decode(found[depth_topic("kinect1")][1], BAG_WIRE)
    assert stamp_ns == round(1033.4e-3 * NANOSECONDS) and depth[100, WIDTH - 401] == pytest.approx(1.002)
    assert BodyIndex().decode(found[body_index_topic("kinect1")][1], BAG_WIRE)[0] == stamp_ns
    camera = CameraInfo().decode(found[info_topic("kinect1")][0], BAG_WIRE)
    assert camera.frame_id == frame_id and camera.matrix[0, 2] == pytest.approx(WIDTH - 1 - 260.0)
    assert {"/kinect1/skeleton", "/imu_camera/imu/data_raw", "/imu_forearm_right/imu/mag", "/markers/points"} <= set(
        found
    )


def test_what_is_absent_is_named_and_the_rest_is_read(folder: Path) -> None:
    for name in ("kinect/bodyIndexBuffer.bin", "vicon/viconRecord.TRC", "setting.SettingProto"):
        (folder / name).unlink()
    recording = NtuMocapRecording(folder)
    items = list(recording)
    assert [type(item) for item in items] == [RecordedDepth, RecordedFrame] * 3 or len(items) == 6
    assert all(item.bodies is None for item in items if isinstance(item, RecordedDepth))
    assert [
        word for word in ("body index", "markers", "setting") if not any(word in w for w in recording.warnings)
    ] == []


def cut(data: bytes) -> bytes:
    return data[:-5]


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("kinect/depthBuffer.bin", cut, "expected 1302528 for 3 images"),
        ("kinect/bodyIndexBuffer.bin", lambda data: data + b"\0", "expected 651264"),
        ("kinect/timestamp.bin", lambda data: data[::-1], "milliseconds"),
        ("kinect/timestamp.bin", cut, "no whole number"),
        ("kinect/cameraIntrinsics.bin", lambda data: data[:12], "3 numbers, expected 7"),
        ("kinect/cameraIntrinsics.bin", lambda data: bytes(28), "no intrinsics"),
        ("kinect/depthToCameraSpaceTable.bin", lambda data: bytes(len(data)), "differ from the intrinsics"),
        ("kinect/OfflineBodyframe.protobuf", cut, "cut off"),
        ("kinect/OfflineBodyframe.protobuf", lambda data: data * 2, "more frames than the 3 images"),
        ("imu9/RawSample.RawSampleListProto", lambda data: inside(1, b"\xff\xff"), "item 0"),
        ("vicon/viconRecord.TRC", lambda data: b"PathFileType", "no header"),
        ("vicon/viconRecord.TRC", lambda data: data.replace(b"200", b"abc"), "line 6"),
        ("vicon/viconStartOffset.bin", lambda data: struct.pack("<d", 99.0), "99.0 of 3 images"),
    ],
)
def test_a_broken_file_is_named(folder: Path, name: str, change: Callable[[bytes], bytes], said: str) -> None:
    file = folder / name
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(NtuMocapError, match=said) as error:
        list(NtuMocapRecording(folder))
    assert name in str(error.value)


def test_a_missing_file_that_is_needed_is_named_and_no_bag_is_left(folder: Path, tmp_path: Path) -> None:
    (folder / "kinect/cameraIntrinsics.bin").unlink()
    with pytest.raises(BodyTrackingError, match="cameraIntrinsics"):
        import_files([folder], tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_recording_that_was_cut_off_is_read_up_to_its_last_whole_image(folder: Path) -> None:
    file = folder / "kinect/depthBuffer.bin"
    file.write_bytes(file.read_bytes()[: -WIDTH * HEIGHT])
    recording = NtuMocapRecording(folder, partial=True)
    assert sum(isinstance(item, RecordedDepth) for item in recording) == 2
    assert "depthBuffer" in recording.warnings[0]


def test_messages_without_a_schema() -> None:
    found = fields(integer(1, 300) + double(2, 0.5) + inside(3, b"text") + integer(1, 7) + zigzag(4, -3))
    assert found[1] == [300, 7] and found[2] == [0.5] and found[3] == [b"text"] and signed(found, 4) == -3
    for broken in (b"\x08", b"\x80" * 11, tag(3, 2) + b"\x7f", tag(1, 3), b"\x00\x01", tag(2, 1) + b"1234"):
        with pytest.raises(ProtobufError):
            fields(broken)
