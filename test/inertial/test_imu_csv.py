"""Inertial readings as separated values: every layout is converted to REP-145's units; errors name file and line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import STANDARD_GRAVITY, RecordedImu
from body_tracking.inertial.imu_csv import BACKWARDS, BAD, HELD, IGNORED, ImuCsvRecording, is_imu_csv

OWN = (
    "sensor,stamp,received,orientation_x,orientation_y,orientation_z,orientation_w,"
    "angular_velocity_x,angular_velocity_y,angular_velocity_z,"
    "linear_acceleration_x,linear_acceleration_y,linear_acceleration_z,battery\n"
)
ROW = "wrist,1700000000.123456789,2.5,0,0,0,1,0.1,0.2,0.3,0,0,9.8,87\n"


def written(folder: Path, text: str, name: str = "imu.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def read(path: Path, **options: object) -> tuple[list[RecordedImu], ImuCsvRecording]:
    recording = ImuCsvRecording(path, **options)  # type: ignore[arg-type]
    return list(recording), recording


def test_own_layout(tmp_path: Path) -> None:
    (reading,), recording = read(written(tmp_path, OWN + ROW))
    sample = reading.sample
    assert (reading.sensor, reading.received_ns, sample.frame_id) == ("wrist", 2_500_000_000, "wrist_link")
    assert sample.stamp_ns == 1_700_000_000_123_456_789
    np.testing.assert_array_equal(sample.orientation, [0.0, 0.0, 0.0, 1.0])
    np.testing.assert_array_equal(sample.angular_velocity, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(sample.acceleration, [0.0, 0.0, 9.8])
    assert sample.magnetic_field is None
    assert recording.problems == {IGNORED: 1}
    assert recording.progress == 1.0


def test_an_empty_group_is_a_quantity_that_is_not_there(tmp_path: Path) -> None:
    (reading,), _ = read(written(tmp_path, OWN + ROW.replace("0,0,0,1,", ",,,,")))
    assert reading.sample.orientation is None
    assert reading.sample.angular_velocity is not None


def test_readings_that_cannot_be_and_stamps_that_repeat_are_counted_and_the_first_is_shown(tmp_path: Path) -> None:
    rows = ROW + ROW.replace("0,0,0,1,", "0,0,0,0,") + ROW.replace("9.8", "nan") + ROW
    readings, recording = read(written(tmp_path, OWN + rows))
    assert len(readings) == 2
    assert (recording.problems[BAD], recording.problems[BACKWARDS]) == (2, 1)
    (warning,) = recording.warnings
    assert "line 3" in warning and "zero quaternion" in warning


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        (OWN, "no rows"),
        (OWN + ROW + ROW.replace("0.2", "O.2"), "line 3: 'O.2' is not a number"),
        (OWN + ROW.replace("1700000000.123456789", "noon"), "line 2: stamp: 'noon' is not a number"),
        (OWN + ROW.replace("1700000000.123456789", "1e300"), "line 2: .* not a time in seconds"),
        (OWN + ROW.replace(",87", ""), "line 2: 13 columns, expected 14"),
        (OWN + ROW.replace("wrist", "left wrist"), "line 2: sensor name 'left wrist'"),
        (OWN.replace("orientation_w", "w") + ROW, "line 1: missing column orientation_w"),
        (OWN.replace("stamp", "time") + ROW, "line 1: missing column stamp"),
        ((OWN + ROW).replace(",", ";"), "line 1: cells are separated by ';', expected ','"),
        ((OWN + ROW).replace(",", "\t"), r"line 1: cells are separated by '\\t', expected ','"),
        (OWN.replace("battery", "stamp") + ROW, "line 1: column 'stamp' is there twice"),
        ("IMU_TIMESTAMP(0)_0,IMU_GYROSCOPE(0)_0\n1,2\n", r"missing column IMU_GYROSCOPE\(0\)_1"),
        ("stamp\n1\n", "no column of orientation_x"),
        (OWN + '"wri"st,1\n', "line 2: "),
    ],
)
def test_a_malformed_file_says_where(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BodyTrackingError, match=message) as error:
        read(written(tmp_path, text))
    assert str(tmp_path) in str(error.value)


def test_a_file_that_is_cut_off_is_read_if_asked(tmp_path: Path) -> None:
    whole = (OWN + ROW * 2000).encode()
    damaged = tmp_path / "imu.csv.gz"
    damaged.write_bytes(gzip.compress(whole)[:-40])
    for path in (written(tmp_path, OWN + ROW * 2 + ROW[:20]), damaged):
        with pytest.raises(BodyTrackingError, match=r"cut off; \d+ row\(s\) before that are whole"):
            read(path)
        readings, recording = read(path, partial=True)
        assert len(readings) >= 2
        assert "cut off" in recording.warnings[-1]


def test_skeletons_are_no_inertial_readings(tmp_path: Path) -> None:
    assert not is_imu_csv(written(tmp_path, "sensor,stamp,SpineBase_x\n"))
    assert not is_imu_csv(written(tmp_path, ""))
    assert is_imu_csv(written(tmp_path, OWN))


def test_two_imus_side_by_side(shared_data: Path) -> None:
    """Gravity and angular rate agree with the quaternions only if all three were turned to REP-145's conventions."""
    (path,) = (shared_data / "imu" / "two_arm_imus").glob("*.csv.gz")
    readings, recording = read(path, names=["upper_arm_left", "forearm_left"])
    for sensor in ("upper_arm_left", "forearm_left"):
        own = [reading for reading in readings if reading.sensor == sensor]
        assert len(own) == 3051
        quats = np.array([reading.sample.orientation for reading in own])
        forces = np.array([reading.sample.acceleration for reading in own])
        rates = np.array([reading.sample.angular_velocity for reading in own])
        x, y, z, w = quats.T
        up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
        assert (forces * up).sum(axis=1).mean() == pytest.approx(STANDARD_GRAVITY, rel=0.05)
        # the vertical in the sensor's frame turns by -w x up
        stamps = np.array([reading.sample.stamp_ns for reading in own]) / 1e9
        turned = (up[2:] - up[:-2]) / (stamps[2:] - stamps[:-2])[:, None]
        expected = np.cross(up[1:-1], rates[1:-1])
        # not 1: one sensor's orientation is half a reading behind its rate. The inverse quaternions have 0.3 and less
        assert np.corrcoef(turned.ravel(), expected.ravel())[0, 1] > 0.94
        received = np.array([reading.received_ns for reading in own]) / 1e9
        apart = 0.0 if sensor == "upper_arm_left" else 11.03
        np.testing.assert_allclose(stamps - received, apart, atol=0.011)
    with pytest.raises(BodyTrackingError, match=r"1 sensor name\(s\) for 2 sensor"):
        read(path, names=["wrist"])
    assert set(recording.problems) == {IGNORED}


def test_the_pendulum(shared_data: Path) -> None:
    path = shared_data / "imu" / "pendulum_with_reference" / "Pendulum_Test02a_Trial1_Segment_1.csv.gz"
    readings, recording = read(path, names=["link1"])
    assert len(readings) + recording.problems[HELD] == 15630
    first = readings[0].sample
    np.testing.assert_allclose(first.acceleration, [9.7412, 0.11035, 0.13574])
    np.testing.assert_allclose(first.magnetic_field, np.array([-0.89844, -0.45703, 0.37207]) * 50e-6)
    # if each row were a reading, there would be 15630, at 89.8 Hz
    assert 45.0 < len(readings) / 174.1 < 55.0
