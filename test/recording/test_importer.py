"""An import writes the whole recording in time order, or no bag."""

from __future__ import annotations

import csv
import gzip
import json
import os
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from body_tracking.cli import main
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.skeleton import JOINT_NAMES, Skeleton
from body_tracking.inertial.mvnx import MvnxRecording
from body_tracking.messages.imus import message_to_magnetic_field, message_to_sample
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.importer import import_files
from body_tracking.recording.info import bag_info
from body_tracking.recording.rosbag2 import BagReader, deserialize
from draws import draws, some
from skeleton_files import COORDINATES, FIRST_ID, csv_row, skeleton_text, write_csv


def skeletons(bag: Path) -> dict[str, list[tuple[int, tuple[Skeleton, ...]]]]:
    """(log time, bodies) of each message by topic."""
    found: dict[str, list[tuple[int, tuple[Skeleton, ...]]]] = {}
    with BagReader(bag) as reader:
        assert reader.warnings == []
        for message in reader.messages():
            bodies = cloud_to_skeletons(deserialize(POINT_CLOUD, message.cdr))
            found.setdefault(message.topic, []).append((message.log_time_ns, bodies))
    return found


def frames(path: Path, *stamps: object, **more: object) -> Path:
    """A CSV recording of one body at these stamps."""
    return write_csv(path, [csv_row(stamp, **more) for stamp in stamps])


def write_ntu(path: Path, n_frames: int) -> Path:
    body = FIRST_ID, np.ones((25, 3)), np.full(25, 2)
    path.write_bytes(skeleton_text([[body]] * n_frames).encode())
    return path


def first_rows(path: Path, folder: Path, count: int) -> Path:
    """A table with the first rows of another one, under the same name in the folder."""
    with gzip.open(path, "rb") as whole, gzip.open(folder / path.name, "wb") as file:
        file.writelines(islice(whole, 1 + count))
    return folder / path.name


def test_the_real_pairs_are_imported_as_they_are(shared_data, tmp_path):
    for whole in some(sorted((shared_data / "kinect_pairs").glob("p*.csv.gz"))):
        path = first_rows(whole, tmp_path, draws(700, 10_000))
        with gzip.open(path, "rt") as file:
            rows = list(csv.DictReader(file))
        report = import_files([path], tmp_path / path.stem)
        found = skeletons(tmp_path / path.stem)
        assert set(found) == {"/kinect1/skeleton", "/kinect2/skeleton"}
        for sensor in ("kinect1", "kinect2"):
            own = [row for row in rows if row["sensor"] == sensor]
            # A bag is in the order of receipt, which in one recording runs backwards once.
            own.sort(key=lambda row: float(row["received"]))
            messages = found[f"/{sensor}/skeleton"]
            assert report.sensors[sensor].frames == len(messages) == len(own)
            assert [at for at, _ in messages] == [round(float(row["received"]) * 1000) * 10**6 for row in own]
            stamps = [bodies[0].stamp_ns for _, bodies in messages]
            assert stamps == [round(float(row["stamp"]) * 10_000) * 100_000 for row in own]
            for (_, (body,)), row in list(zip(messages, own, strict=True))[::200]:
                expected = np.array([float(row[name]) for name in COORDINATES]).reshape(25, 3) * [-1, -1, 1]
                np.testing.assert_array_equal(body.positions, expected.astype(np.float32))
                assert body.frame_id == f"{sensor}_optical_frame"
        assert report.problems["stamps that run backwards"] > 0


def test_the_real_states_are_imported_as_they_are(shared_data, tmp_path):
    path = shared_data / "kinect_states" / "skip_exercise.csv.gz"
    import_files([path], tmp_path / "bag")
    with gzip.open(path, "rt") as file:
        rows = list(csv.DictReader(file))
    messages = skeletons(tmp_path / "bag")["/kinect1/skeleton"]
    assert len(messages) == 344
    for (at, (body,)), row in zip(messages, rows, strict=True):
        assert at == body.stamp_ns == round(float(row["stamp"]) * 10_000) * 100_000
        assert body.states.tolist() == [int(row[f"{joint}_state"]) for joint in JOINT_NAMES]


def test_the_example_is_imported_without_a_remark(tmp_path):
    report = import_files([Path(__file__).parents[2] / "examples" / "recording.csv.gz"], tmp_path / "bag")
    assert {name: each.frames for name, each in report.sensors.items()} == {"kinect1": 330, "kinect2": 329}
    assert not report.problems and not report.warnings


def test_several_views_are_one_bag_in_time_order(tmp_path):
    files = [write_ntu(tmp_path / f"S001C00{camera}P003R001A010.skeleton", 10) for camera in (1, 2, 3)]
    report = import_files(files, tmp_path / "bag")
    assert {name: sensor.frames for name, sensor in report.sensors.items()} == dict.fromkeys(
        ("kinect1", "kinect2", "kinect3"), 10
    )
    with BagReader(tmp_path / "bag") as reader:
        times = [message.log_time_ns for message in reader.messages()]
        # As they lie in the file, too: other readers do not sort.
        assert [block.end_ns for file in reader.files for block in file.blocks] == [times[-1]]
    assert times == sorted(times) and len(set(times)) == 10


def test_names_of_files_without_sensors(tmp_path):
    files = [frames(tmp_path / f"{name}.csv", 0) for name in "abc"]
    report = import_files(files, tmp_path / "bag", sensors={files[1]: "side"})
    assert set(report.sensors) == {"kinect1", "side", "kinect3"}


def test_a_sensor_in_two_files_is_refused(tmp_path):
    files = [frames(tmp_path / f"{name}.csv", 0, sensor="k") for name in "ab"]
    with pytest.raises(BodyTrackingError, match=r"sensor 'k' is in .*a\.csv and in .*b\.csv"):
        import_files(files, tmp_path / "bag")
    with pytest.raises(BodyTrackingError, match="twice"):
        import_files([files[0], files[0]], tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_a_bad_file_leaves_no_bag_and_costs_none(tmp_path):
    good = frames(tmp_path / "good.csv", *range(300))
    bad = frames(tmp_path / "bad.csv", *range(300), "x")
    with pytest.raises(BodyTrackingError, match="line 302"):
        import_files([bad], tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
    import_files([good], tmp_path / "bag")
    with pytest.raises(BodyTrackingError, match="exists already"):
        import_files([good], tmp_path / "bag")
    with pytest.raises(BodyTrackingError, match="line 302"):
        import_files([bad], tmp_path / "bag", overwrite=True)
    assert len(skeletons(tmp_path / "bag")["/kinect1/skeleton"]) == 300


def test_a_stamp_or_receipt_before_time_0_is_refused(tmp_path):
    for stamp, received in ((1, -0.5), (-1.5, 0)):
        with pytest.raises(BodyTrackingError, match=r"line 2: .* is not a time in seconds"):
            import_files([frames(tmp_path / "a.csv", stamp, received=received)], tmp_path / "bag")


def test_times_in_milliseconds_get_a_warning(tmp_path):
    right, wrong = frames(tmp_path / "a.csv", 0, 0.033, 0.066), frames(tmp_path / "b.csv", 0, 33, 66)
    report = import_files([right, wrong], tmp_path / "bag")
    assert report.warnings == ["kinect2: 33 s from one message to the next, in the mean: are its times in seconds?"]


def test_times_of_receipt_that_are_all_the_same_get_a_warning(tmp_path):
    report = import_files([frames(tmp_path / "a.csv", 0, 0.033, 0.066, received=5)], tmp_path / "bag")
    assert report.warnings == ["kinect1: 0 s from one message to the next, in the mean: are its times in seconds?"]


def test_two_files_that_name_their_sensors_are_not_told_to_rename_them(shared_data, tmp_path):
    pytest.importorskip("ezc3d", reason="ezc3d is not installed")
    walk = shared_data / "marker_unlabelled" / "walkingOptiTrack.c3d"
    suit = shared_data / "imu" / "xsens_upper_body" / "test_mocap.mvnx.gz"
    for path, what in ((walk, "/markers/points"), (suit, "sensor 'pelvis'")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
        with pytest.raises(BodyTrackingError) as refused:
            import_files([path, tmp_path / path.name], tmp_path / "bag")
        assert str(refused.value) == f"{what} is in {path} and in {tmp_path / path.name}"


def test_a_file_without_a_possible_reading_says_why(tmp_path):
    axes = ",".join(f"angular_velocity_{axis}" for axis in "xyz")
    (tmp_path / "imu.csv").write_text(f"stamp,{axes}\n0,0,0,300\n0.01,0,0,300\n")
    with pytest.raises(BodyTrackingError, match=r"no inertial reading.*; 2 readings.*, line 2: .* 300 rad/s.*deg/s\?$"):
        import_files([tmp_path / "imu.csv"], tmp_path / "bag")


# --- the command


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(argument) for argument in arguments])
    output = capsys.readouterr()
    return code, output.out, output.err


def test_import_and_info_as_json_and_for_people(tmp_path, capsys):
    file = frames(tmp_path / "a.csv", *(index / 10 for index in range(11)))
    code, out, _ = run(capsys, "import", file, "-o", tmp_path / "bag", "--sensor", "left", "--json")
    report = json.loads(out)
    assert code == 0 and report["frames"] == 11 and report["recording_s"] == 1.0
    assert report["sensors"] == {"left": {"frames": 11, "bodies": 1, "seconds": 1.0, "topics": ["/left/skeleton"]}}
    code, out, _ = run(capsys, "bag", "info", tmp_path / "bag", "--json")
    info = json.loads(out)
    assert code == 0 and info["messages"] == 11 and info["duration_s"] == 1.0 and info["warnings"] == []
    (topic,) = info["topics"]
    assert (topic["name"], topic["type"], topic["count"]) == ("/left/skeleton", POINT_CLOUD, 11)
    assert topic["rate"] == pytest.approx(10.0)
    assert topic["qos"][0]["reliability"] == "best_effort"
    code, out, err = run(capsys, "import", frames(tmp_path / "b.csv", 0, 1, 1, 0.5), "-o", tmp_path / "other")
    assert code == 0 and err == ""
    assert "/kinect1/skeleton: 4 frames" in out and "1 stamps that repeat" in out
    code, out, err = run(capsys, "bag", "info", tmp_path / "other")
    assert code == 0 and err == ""
    assert "/kinect1/skeleton" in out and "best_effort" in out and "4" in out


def test_the_date_of_the_start_agrees_with_its_seconds(tmp_path, capsys):
    """Both are rounded: a recording of a simulation begins some nanoseconds before a whole second."""
    run(capsys, "import", frames(tmp_path / "a.csv", 1750000019.9997, 1750000020.5), "-o", tmp_path / "bag")
    _, out, _ = run(capsys, "bag", "info", tmp_path / "bag")
    assert "start     1750000020.000 s (2025-06-15 15:07:00 UTC)\n" in out


def test_a_clock_that_began_at_zero_has_no_date(tmp_path, capsys):
    run(capsys, "import", frames(tmp_path / "a.csv", 0.0, 0.5), "-o", tmp_path / "bag")
    _, out, _ = run(capsys, "bag", "info", tmp_path / "bag")
    assert "start     0.000 s\n" in out


def test_a_truncated_recording_is_reported_and_closed(tmp_path, capsys):
    rows = [csv_row(index / 30, index * 0.123) for index in range(1000)]
    import_files([write_csv(tmp_path / "a.csv", rows)], tmp_path / "bag")
    path = next((tmp_path / "bag").glob("*.mcap"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    code, out, err = run(capsys, "bag", "info", tmp_path / "bag")
    assert code == 0 and "warning" in err and "cut off" in err
    count = bag_info(tmp_path / "bag").messages
    assert 0 < count < 1000
    code, out, err = run(capsys, "bag", "recover", tmp_path / "bag", "--json")
    assert code == 0 and json.loads(out)["messages"] == count and json.loads(out)["warnings"] == []
    assert any("cut off" in line for line in json.loads(out)["before"])


def test_recovering_says_what_was_missing_and_leaves_a_whole_bag_as_it_is(tmp_path, capsys):
    import_files([frames(tmp_path / "a.csv", 0, 1)], tmp_path / "bag")
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.unlink()
    code, out, err = run(capsys, "bag", "recover", tmp_path / "bag")
    assert code == 0 and err == "" and "before    " in out and "metadata.yaml is missing" in out
    metadata.write_text(written := f"{metadata.read_text()}  custom_data: null\n")
    code, out, err = run(capsys, "bag", "recover", tmp_path / "bag")
    assert code == 0 and err == "" and out.startswith("before    nothing was missing")
    assert metadata.read_text() == written
    code, out, err = run(capsys, "bag", "recover", tmp_path / "bag", "--json")
    assert code == 0 and err == "" and json.loads(out)["before"] == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["import", "absent.csv", "-o", "bag"], "no such file"),
        (["import", "a.txt", "-o", "bag"], "a.txt: not a .csv, .csv.gz, .skeleton, .mvnx, .mvnx.gz or .c3d file"),
        (["import", "a.csv", "-o", "bag", "--labels", "A"], "a.csv: no points of a motion capture system"),
        (["import", "a.csv", "-o", "bag", "--noise", "0.1"], "a.csv: no points of a motion capture system"),
        (["import", "a.csv", "-o", "bag", "--rate", "10"], "a.csv: no folder of images, for which --rate"),
        (["import", "a.csv", "-o", "bag", "--depth-scale", "1"], "a.csv: no folder of images, for which --rate"),
        (["import", "images", "-o", "bag", "--labels", "A"], "images: --labels, --noise and --partial are not for"),
        (["import", "images", "-o", "bag", "--partial"], "images: --labels, --noise and --partial are not for"),
        (["import", "empty.mvnx", "-o", "bag"], "empty.mvnx: the file is empty"),
        (["import", "taken", "-o", "bag"], "taken: a folder without images in rgb/, color/ or colour/"),
        (["import", "folder.csv", "-o", "bag"], "folder.csv: a folder without images"),
        (["import", "pipe.csv", "-o", "bag"], "pipe.csv: not a file"),
        (["import", "made", "-o", "bag"], "made: a bag, which needs no import"),
        (["import", "made/made_0.mcap", "-o", "bag"], "made_0.mcap: a bag, which needs no import"),
        (["import", "a.csv", "b.csv", "-o", "bag", "--sensor", "left"], "of which"),
        (["import", "a.csv", "-o", "bag", "--sensor", "left=c.csv"], "no such file is imported"),
        (["import", "a.csv", "-o", "bag", "--sensor", "l/r"], "letters"),
        (["import", "a.csv", "-o", "taken"], "exists"),
        (["import", "a.csv", "-o", "taken", "--overwrite"], "no bag"),
        (["import", "a.csv", "-o", "a.txt/bag"], "a.txt/bag"),
        (["bag", "info", "absent"], "no such recording"),
        (["bag", "info", "a.txt"], "not an mcap file; body_tracking import makes a bag"),
        (["bag", "recover", "taken"], "no mcap file"),
        (["bag", "recover", "absent"], "absent: no such folder"),
        (["bag", "recover", "a.txt"], "a.txt: not a folder"),
        (["bag", "recover", "pipe.csv"], "pipe.csv: not a folder"),
    ],
)
def test_errors_are_one_line(tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        frames(tmp_path / f"{name}.csv", 0)
    (tmp_path / "a.txt").write_text("no recording")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "precious.txt").touch()
    (tmp_path / "empty.mvnx").touch()
    (tmp_path / "images" / "rgb").mkdir(parents=True)
    (tmp_path / "folder.csv").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    import_files([tmp_path / "a.csv"], tmp_path / "made")
    code, out, err = run(capsys, *arguments)
    assert code == 2 and text in err and len(err.strip().splitlines()) == 1 and out == ""
    assert (tmp_path / "taken" / "precious.txt").exists() and not (tmp_path / "bag").exists()


# --- inertial sensors

IMU_CSV = """stamp,received,sensor,angular_velocity_x,angular_velocity_y,angular_velocity_z,\
linear_acceleration_x,linear_acceleration_y,linear_acceleration_z,\
magnetic_field_x,magnetic_field_y,magnetic_field_z
100.00,5.00,forearm_left,0.1,0.2,0.3,0,0,9.8,2e-5,0,-4e-5
100.01,5.02,forearm_left,0.1,0.2,0.3,0,0,9.8,,,
200.00,5.01,hand_left,0.1,0.2,0.3,0,0,9.8,,,
"""


def inertial(bag: Path) -> dict[str, list[tuple[int, object]]]:
    """(log time, message) of each message by topic."""
    found: dict[str, list[tuple[int, object]]] = {}
    with BagReader(bag) as reader:
        for message in reader.messages():
            type_name = reader.topics[message.topic].type_name
            found.setdefault(message.topic, []).append((message.log_time_ns, deserialize(type_name, message.cdr)))
    return found


def test_inertial_readings_go_where_those_of_drivers_go(tmp_path):
    (tmp_path / "imu.csv").write_text(IMU_CSV)
    report = import_files([frames(tmp_path / "a.csv", 5.005), tmp_path / "imu.csv"], tmp_path / "bag")
    bodies = {name: sensor.bodies for name, sensor in report.sensors.items()}
    assert bodies == {"kinect1": 1, "forearm_left": 0, "hand_left": 0}
    assert [*report.sensors["forearm_left"].topics] == ["/forearm_left/imu/data_raw", "/forearm_left/imu/mag"]
    found = inertial(tmp_path / "bag")
    assert {topic: [at for at, _ in messages] for topic, messages in found.items()} == {
        "/forearm_left/imu/data_raw": [5_000_000_000, 5_020_000_000],
        "/forearm_left/imu/mag": [5_000_000_000],
        "/hand_left/imu/data_raw": [5_010_000_000],
        "/kinect1/skeleton": [5_005_000_000],
    }
    sample = message_to_sample(found["/forearm_left/imu/data_raw"][0][1])
    assert (sample.stamp_ns, sample.frame_id) == (100_000_000_000, "forearm_left_link")
    assert sample.orientation is None
    np.testing.assert_array_equal(sample.angular_velocity, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(sample.acceleration, [0.0, 0.0, 9.8])
    _, frame_id, magnetic = message_to_magnetic_field(found["/forearm_left/imu/mag"][0][1])
    assert frame_id == "forearm_left_link"
    np.testing.assert_array_equal(magnetic, [2e-5, 0.0, -4e-5])


def test_a_suit_goes_along_with_its_own_angles(shared_data, tmp_path):
    path = shared_data / "imu" / "xsens_upper_body" / "test_mocap.mvnx.gz"
    report = import_files([path], tmp_path / "bag")
    found = inertial(tmp_path / "bag")
    assert len(report.sensors) == 11 and report.frames == 11 * 112
    frames = [frame for frame in MvnxRecording(path).frames() if frame.kind == "normal"]
    angles = found["/ground_truth/joint_states"]
    assert [at for at, _ in angles] == [round(k * 1e9 / 60.0) for k in range(112)]
    assert angles[0][1].name[8 * 3 : 8 * 3 + 3] == [f"jRightElbow_{axis}_body1" for axis in "xyz"]
    for (_, message), frame in zip(angles, frames, strict=True):
        np.testing.assert_array_equal(message.position, frame.joint_angles.reshape(-1))
    for (_, message), frame in zip(found["/forearm_left/imu/data"], frames, strict=True):
        sample = message_to_sample(message)
        np.testing.assert_allclose(sample.orientation, frame.sensor_xyzw[9], atol=1e-5)
        assert sample.angular_velocity is None and sample.orientation_covariance is None


def test_two_imus_are_named_together(shared_data, tmp_path, capsys):
    path = first_rows(*(shared_data / "imu" / "two_arm_imus").glob("*.csv.gz"), tmp_path, 500)
    names = "upper_arm_left,forearm_left"
    assert main(["import", str(path), "-o", str(tmp_path / "bag"), "--sensor", names]) == 0
    out = capsys.readouterr().out
    assert "/forearm_left/imu/data, /forearm_left/imu/mag: 500 readings in 10.0 s" in out
    assert main(["import", str(path), "-o", str(tmp_path / "other"), "--sensor", "wrist"]) == 2
    assert "1 sensor name(s) for 2 sensor(s)" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_a_suit_cannot_be_named(tmp_path):
    (tmp_path / "a.mvnx").write_text("<mvnx/>")
    with pytest.raises(BodyTrackingError, match="names its sensors itself"):
        import_files([tmp_path / "a.mvnx"], tmp_path / "bag", sensors={tmp_path / "a.mvnx": "wrist"})
    with pytest.raises(BodyTrackingError, match=r"a\.mvnx"):
        import_files([tmp_path / "a.mvnx"], tmp_path / "bag")
    assert not (tmp_path / "bag").exists()
