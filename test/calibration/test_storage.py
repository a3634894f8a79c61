"""Calibrations survive the disk, and a damaged file is refused by name."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.calibration.advice import next_step
from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.stage import CalibrationStage
from body_tracking.calibration.storage import load, save
from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import CalibrationResult, SensorPose, SensorQuality, level_pose
from body_tracking.core.skeleton import NANOSECONDS, Skeleton, TrackingState
from body_tracking.messages.node_status import NodeStatus
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from body_tracking.recording.rosbag2 import BAG_WIRE
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import Setup, simulate

BODY = np.random.default_rng(0).normal(scale=0.3, size=(25, 3)) + [0.0, 0.0, 2.0]
TRACKED = np.full(25, TrackingState.TRACKED, dtype=np.uint8)


def example(seed: int = 0) -> CalibrationResult:
    rng = np.random.default_rng(seed)
    pose = SensorPose("kinect2", rng.normal(size=3), Rotation.random(None, rng).as_quat())
    return CalibrationResult(
        "kinect1",
        {"kinect1": level_pose("kinect1", 0.9), "kinect2": pose},
        {
            "kinect1": ClockModel(),
            "kinect2": ClockModel(int(rng.integers(-(10**10), 10**10)), 42.5, 123456789, np.inf, 33.5),
        },
        {"kinect1": SensorQuality(0, 0, 0), "kinect2": SensorQuality(0.05, 0.01, 0.004, 400)},
    )


@given(seed=st.integers(0, 2**32 - 1))
def test_a_calibration_survives_the_disk(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("calibration") / "new folder" / "room.yaml"
    result = example(seed)
    save(result, path)
    read = load(path)
    assert read.reference == result.reference
    for name, pose in result.poses.items():
        assert_allclose(read.poses[name].translation, pose.translation, atol=1e-12)
        assert_allclose(read.poses[name].rotation, pose.rotation, atol=1e-12)
        assert abs(read.clocks[name].offset_ns - result.clocks[name].offset_ns) <= 1
        assert read.clocks[name].drift_ppm == result.clocks[name].drift_ppm
        assert_allclose(read.quality[name].rotation_stddev, result.quality[name].rotation_stddev)
        assert read.clocks[name].stddev == result.clocks[name].stddev
        assert read.clocks[name].drift_stddev_ppm == result.clocks[name].drift_stddev_ppm


def test_the_clock_of_a_file_is_published_as_the_offset_that_was_estimated(tmp_path: Path) -> None:
    """A clock that is valid for all times has no drift: 0.2 ppm over the time since 1970 would be six minutes."""
    path, now_ns = tmp_path / "room.yaml", 1_790_000_000 * NANOSECONDS
    result = example()
    for drift_ppm in (-300.0, -0.2, 0.0, 0.2, 300.0):
        clock = ClockModel(2_400_000, drift_ppm, now_ns - 60 * NANOSECONDS)
        save(replace(result, clocks=result.clocks | {"kinect2": clock}), path)
        values = {each.name: each.default for each in CalibrationStage.PARAMETERS} | {"calibration_file": str(path)}
        stage = CalibrationStage(values)
        (port,) = [each for each in stage.outputs if each.topic == graph.CALIBRATION_CLOCK]
        (payload,) = [each.payload for each in stage.start(Now(0, 0)) if each.topic == graph.CALIBRATION_CLOCK]
        received = port.codec.decode(port.codec.encode(payload, BAG_WIRE), BAG_WIRE)
        assert received.valid_from_ns == 0
        for carried in (payload, received):
            assert abs(carried.clock.offset_ns_at(now_ns) - clock.offset_ns) <= 1
        stage._unsaved = True
        stage.save()  # the drift is kept for the next session's start
        assert load(path).clocks["kinect2"].drift_ppm == drift_ppm


@pytest.mark.parametrize("stamps", ["of sensors", "of a recording"])
@pytest.mark.parametrize("existed", [True, False])
def test_a_recording_played_beside_changes_no_existing_file(tmp_path: Path, stamps: str, existed: bool) -> None:
    path = tmp_path / "room.yaml"
    if existed:
        save(example(), path)
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS} | {"calibration_file": str(path)}
    stage = CalibrationStage(values)
    before = path.read_text() if existed else ""
    at_ns = time.time_ns() - (3600 * NANOSECONDS if stamps == "of a recording" else 0)
    for number in range(40):
        person = Skeleton(at_ns + number * NANOSECONDS // 30, "kinect1_optical_frame", BODY, TRACKED)
        list(stage.take("/kinect1/skeleton", [person], Now(person.stamp_ns, person.stamp_ns)))
    stage._unsaved = True
    if existed:
        stage.calibration.load(example(seed=1))
    stage.save()
    kept = existed and stamps == "of a recording"
    assert (path.read_text() == before) is kept
    text = stage.state(at_ns)[1]
    assert ("room.yaml is not written, as the stamps are those of a recording: 3" in text) is kept


def test_several_people_leave_the_poses_of_a_file_as_they_are(tmp_path: Path) -> None:
    """Each sensor follows the person nearest to it, here another one: their motions contradict the poses."""
    recording = simulate(Setup("torso_twist", around(np.radians([0.0, 60.0]).tolist()), number=3, seconds=12.0))
    poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
    quality = dict.fromkeys(poses, SensorQuality(0.05, 0.01, 0.004, 400))
    save(CalibrationResult("kinect1", poses, dict.fromkeys(poses, ClockModel()), quality), tmp_path / "room.yaml")
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS}
    file = {"calibration_file": str(tmp_path / "room.yaml"), "sensors": ("kinect1", "kinect2")}
    stage = CalibrationStage(values | file)
    before = stage.calibration.current_update().result.poses["kinect2"]
    for frame in recording.frames:
        now = Now(frame.received_ns, frame.received_ns)
        list(stage.take(graph.skeleton_topic(frame.sensor), frame.skeletons, now))
    after = stage.calibration.current_update().result.poses["kinect2"]
    assert_allclose(after.translation, before.translation)
    assert_allclose(after.rotation, before.rotation)


def test_several_people_are_named_until_the_sensors_are_calibrated() -> None:
    frames = simulate(Setup("torso_twist", around(np.radians([0.0, 60.0]).tolist()), number=2, seconds=12.0)).frames
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS} | {"sensors": ("kinect1", "kinect2")}
    stage = CalibrationStage(values)
    for people in (2, 1):
        for frame in frames[:60]:
            now = Now(frame.received_ns, frame.received_ns)
            list(stage.take(graph.skeleton_topic(frame.sensor), frame.skeletons[:people], now))
        level, text, _ = stage.state(now.ros_ns)
        assert level  # after two seconds without a movement
        assert ("several people are in view of kinect1, kinect2" in text) is (people == 2)
        assert next_step(NodeStatus("calibration", level, text)).startswith("leave one person in view") is (people == 2)


def test_a_file_that_is_only_to_be_loaded_is_never_written(tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    save(example(), path)
    before = path.read_text()
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS}
    stage = CalibrationStage(values | {"calibration_file": str(path), "save": False})
    assert stage.events == [f"{path}: loaded, not to be written"]
    stage.calibration.load(example(seed=1))
    stage._unsaved = True
    stage.save()
    assert path.read_text() == before


def test_a_restart_keeps_the_poses_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    save(example(), path)
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS}
    stage = CalibrationStage(values | {"calibration_file": str(path), "sensors": ("kinect1", "kinect2")})
    before = stage.calibration.result().poses
    stage.restart()
    list(stage.take("/kinect1/skeleton", [Skeleton(1, "kinect1_optical_frame", BODY, TRACKED)], Now(1, 1)))
    assert "starting again from the calibration so far" in stage.events[-1]
    for name, pose in stage.calibration.result().poses.items():
        assert_allclose(pose.translation, before[name].translation)
        assert_allclose(pose.rotation, before[name].rotation)


def test_a_file_that_the_parameters_contradict_is_named_at_once(tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    save(example(), path)
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS}
    stage = CalibrationStage(values | {"calibration_file": str(path), "reference_height": 5.0})
    loaded, contradicted = stage.events
    assert loaded.startswith(f"{path}: loaded")
    assert "not the saved calibration, which differs by" in contradicted


def test_frames_that_waited_during_a_standstill_are_those_of_a_sensor(tmp_path: Path) -> None:
    path = tmp_path / "room.yaml"
    save(example(), path)
    values = {each.name: each.default for each in CalibrationStage.PARAMETERS} | {"calibration_file": str(path)}
    stage = CalibrationStage(values)
    before = path.read_text()
    for age_s, written in ((60, False), (0, True)):
        for number in range(10):
            stamp_ns = time.time_ns() - age_s * NANOSECONDS + number
            person = Skeleton(stamp_ns, "kinect1_optical_frame", BODY, TRACKED)
            list(stage.take("/kinect1/skeleton", [person], Now(stamp_ns, stamp_ns)))
        stage.calibration.load(example(seed=1))
        stage._unsaved = True
        stage.save()
        assert (path.read_text() != before) is written


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("reference: kinect1", "", "reference"),
        ("reference: kinect1", "reference: kinect9", "kinect9"),
        ("quat_xyzw:\n    - ", "quat_xyzw:\n    - 7", "kinect1"),
        ("translation:\n    - ", "translation:\n    - x", "kinect1"),
        ("translation:", "place:", "translation"),
        ("sensors:", "sensors: [", "YAML"),
        ("clock_drift_ppm: ", "clock_drift_ppm: -1000000 #", "clock_drift_ppm is -1e[+]06"),
        ("clock_drift_ppm: ", "clock_drift_ppm: .nan #", "clock_drift_ppm is nan"),
        ("clock_offset_s: ", "clock_offset_s: 1.0e+300 #", "clock_offset_s"),
        ("clock_anchor_ns: ", "clock_anchor_ns: .inf #", "clock_anchor_ns"),
        ("translation:\n    - ", "translation:\n    - 1.0e+30 #", "expected at most 100 m"),
    ],
)
def test_a_damaged_file_is_refused_with_its_name(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "room.yaml"
    save(example(), path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=message) as caught:
        load(path)
    assert "room.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_an_unwritable_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nothing\.yaml"):
        load(tmp_path / "nothing.yaml")
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match=r"cannot be written \(Not a directory\)"):
        save(example(), tmp_path / "file" / "room.yaml")
