"""Xsens's recordings: the file's contents under our names and in our units."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.imu import STANDARD_GRAVITY, RecordedAngles, RecordedImu
from body_tracking.inertial.mvnx import BACKWARDS, BAD, LEGS, MvnxError, MvnxRecording

HEAD = """<?xml version="1.0"?>
<mvnx xmlns="http://www.xsens.com/mvn/mvnx" version="4"><subject frameRate="60">
<segments><segment label="Pelvis"/><segment label="RightHand"/></segments>
<sensors><sensor label="RightHand"/><sensor label="LeftFoot"/></sensors>
<joints><joint label="jRightWrist"/></joints><frames>
<frame type="tpose"><orientation>1 0 0 0 1 0 0 0</orientation></frame>
"""
FRAME = """<frame index="{index}" type="normal"><orientation>1 0 0 0 1 0 0 0</orientation>
<position>0 0 1 0 0.5 1.25</position>
<sensorFreeAcceleration>0 0 1 0 0 0</sensorFreeAcceleration>
<sensorOrientation>0.707107 0 0.707107 0 1 0 0 0</sensorOrientation>
<jointAngle>10 -20 90</jointAngle></frame>
"""
TAIL = "</frames></subject></mvnx>\n"
WHOLE = HEAD + FRAME.format(index=0) + FRAME.format(index=3) + TAIL


def written(folder: Path, text: str) -> Path:
    path = folder / "suit.mvnx"
    path.write_text(text)
    return path


def test_a_recording(tmp_path: Path) -> None:
    recording = MvnxRecording(written(tmp_path, WHOLE))
    hand, angles, later, _ = recording
    assert isinstance(hand, RecordedImu) and isinstance(angles, RecordedAngles) and isinstance(later, RecordedImu)
    assert (hand.sensor, hand.sample.frame_id, hand.sample.stamp_ns) == ("hand_right", "hand_right_link", 0)
    np.testing.assert_allclose(hand.sample.orientation, [0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)], atol=1e-6)
    # a quarter turn about y brings the sensor's x down: up is its -x
    np.testing.assert_allclose(hand.sample.acceleration, [-STANDARD_GRAVITY - 1.0, 0.0, 0.0], atol=1e-4)
    assert hand.sample.angular_velocity is None and hand.sample.magnetic_field is None
    assert later.sample.stamp_ns == later.received_ns == 50_000_000
    assert angles.names == ("jRightWrist_x", "jRightWrist_y", "jRightWrist_z")
    np.testing.assert_allclose(np.degrees(angles.angles), [10.0, -20.0, 90.0])
    assert recording.problems == {f"{LEGS} (LeftFoot)": 1}
    assert recording.header is not None and recording.header.rate_hz == 60.0
    assert recording.progress == 1.0


def test_poses_stand_before_the_frames(tmp_path: Path) -> None:
    pose, first, _ = MvnxRecording(written(tmp_path, WHOLE)).frames()
    assert (pose.kind, pose.index, first.kind, first.index) == ("tpose", -1, "normal", 0)
    assert pose.sensor_xyzw is None and pose.segment_positions is None
    np.testing.assert_array_equal(pose.segment_xyzw, [[0.0, 0.0, 0.0, 1.0]] * 2)
    np.testing.assert_array_equal(first.segment_positions, [[0.0, 0.0, 1.0], [0.0, 0.5, 1.25]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cut off after 0"),
        ("stamp,x\n1,2\n", "not XML"),
        ("<html/>", "not an MVNX file: its first element is <html>"),
        (WHOLE.replace('"60"', '"sixty"'), "frameRate 'sixty'"),
        (WHOLE.replace("10 -20 90", "10 -20"), "frame 0, jointAngle: 2 numbers, expected 3"),
        (WHOLE.replace("0.5 1.25", "0.5 1,25"), "frame 0, position: could not convert string"),
        (WHOLE.replace('index="3"', 'index="x"'), "frame x: index 'x'"),
        (WHOLE.replace('index="3"', 'index="²"'), "frame ²: index '²'"),
        (WHOLE.replace('index="3"', 'index="--3"'), "frame --3: index '--3'"),
        (WHOLE.replace('index="3"', f'index="{10**17}"'), "frame 1000.*: no recording is that long"),
        (WHOLE.replace("LeftFoot", "RightHand"), "several sensors of the segment hand_right"),
        (
            WHOLE.replace("LeftFoot", "Sternum").replace('"RightHand"', '"T8"'),
            "several sensors of the segment upper_trunk",
        ),
        (WHOLE.replace("sensorOrientation", "sensorPosition"), "frame 0: no sensorOrientation"),
        (HEAD.replace('<sensor label="RightHand"/><sensor label="LeftFoot"/>', "") + TAIL, "no sensors"),
        (HEAD[: HEAD.index("<frame type")] + TAIL, "no frames"),
        (WHOLE.replace("</jointAngle>", "</jointAngel>"), "not XML"),
    ],
)
def test_a_malformed_file_says_where(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MvnxError, match=message) as error:
        list(MvnxRecording(written(tmp_path, text)))
    assert "suit.mvnx" in str(error.value) and "\n" not in str(error.value)


def test_an_excerpt_counts_as_a_whole_file_does(tmp_path: Path) -> None:
    text = WHOLE.replace('index="0"', 'index="7"').replace('index="3"', 'index="7"')
    recording = MvnxRecording(written(tmp_path, text.replace(' version="4"', "")))
    assert len(list(recording)) == 4
    assert recording.problems == {f"{LEGS} (LeftFoot)": 1, BACKWARDS: 1}


def test_a_zero_quaternion_is_left_out_and_counted(tmp_path: Path) -> None:
    recording = MvnxRecording(written(tmp_path, WHOLE.replace("0.707107 0 0.707107 0", "0 0 0 0")))
    assert all(isinstance(item, RecordedAngles) for item in recording)
    assert recording.problems[BAD] == 2
    assert "frame 0, sensor RightHand: orientation is the zero quaternion" in recording.warnings[0]


def test_a_file_that_is_cut_off_is_read_if_asked(tmp_path: Path) -> None:
    plain = written(tmp_path, WHOLE[: WHOLE.index('index="3"') + 40])
    packed = tmp_path / "suit.mvnx.gz"
    many = HEAD + "".join(FRAME.format(index=index) for index in range(500)) + TAIL
    packed.write_bytes(gzip.compress(many.encode())[:-40])
    for path in (plain, packed):
        with pytest.raises(MvnxError, match=r"cut off after \d+ whole frames \(--partial"):
            list(MvnxRecording(path))
        recording = MvnxRecording(path, partial=True)
        assert len(list(recording)) >= 2
        assert "cut off" in recording.warnings[0]


def test_the_real_suit(shared_data: Path) -> None:
    recording = MvnxRecording(shared_data / "imu" / "xsens_upper_body" / "test_mocap.mvnx.gz")
    items = list(recording)
    readings = [item for item in items if isinstance(item, RecordedImu)]
    assert len({reading.sensor for reading in readings}) == 11
    assert len(readings) == 11 * 112 and len(items) - len(readings) == 112
    assert recording.problems == {} and recording.warnings == []
    # somebody who sings: the mean specific force is gravity
    forces = np.array([reading.sample.acceleration for reading in readings])
    assert np.linalg.norm(forces, axis=1).mean() == pytest.approx(STANDARD_GRAVITY, rel=0.05)
    kinds = [frame.kind for frame in recording.frames()]
    assert kinds[:3] == ["identity", "tpose", "tpose-isb"] and kinds[3:] == ["normal"] * 112
