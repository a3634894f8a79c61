"""The offline graph: deterministic, equal in one process and in two, with clear errors for unusable bags."""

from __future__ import annotations

import contextlib
import gc
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from body_tracking import cli
from body_tracking.calibration import online
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import DIAGNOSTICS, JOINT_STATE, POINT_CLOUD, TIME_REFERENCE, TRANSFORM
from body_tracking.core.parameters import ParameterError
from body_tracking.core.repeats import FROZEN_NS
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.filters.smoothing import MAX_LAG
from body_tracking.kinect.simulated import KinectErrors
from body_tracking.kinematics.conventions import convention
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.messages.codecs import Skeletons
from body_tracking.messages.diagnostics import diagnostics
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording import forked
from body_tracking.recording.forked import Downstream, ForkedDownstream
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplayError, ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import (
    BAG_MESSAGES,
    BAG_WIRE,
    BagError,
    BagReader,
    BagWriter,
    deserialize,
)
from body_tracking.recording.summary import summary
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.scene import Setup, simulate
from draws import some
from excerpts import beginning, contents
from patience import PATIENCE
from pose_networks import MISSING, REASON

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "tpose_wave"
ANGLES = "/humans/bodies/body1/joint_states"


def reference_frames(recording: Path) -> int:
    """How many frames of the reference sensor there are to be fused."""
    with BagReader(recording) as bag:
        return bag.topics["/kinect1/skeleton"].count


def seconds(recording: Path) -> float:
    with BagReader(recording) as bag:
        return (bag.end_ns - bag.start_ns) / NANOSECONDS


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """A function that runs a command in this process and returns exit code and output."""

    def run(*arguments: str | Path) -> tuple[int, str, str]:
        try:
            code = cli.main([str(word) for word in arguments])
        except SystemExit as end:  # of argparse
            code = int(end.code or 0)
        return code, *capsys.readouterr()

    return run


def test_everything_that_the_graph_publishes_is_in_the_new_bag(replayed_wave: Path, wave: Path) -> None:
    with BagReader(replayed_wave) as bag, BagReader(wave) as original:
        counts = {topic: info.count for topic, info in bag.topics.items()}
        for topic in ("/kinect1/skeleton", "/kinect2/skeleton", graph.TRUE_SKELETON):
            assert counts[topic] == original.topics[topic].count
        assert counts["/fused/skeleton"] == counts["/filtered/skeleton"] == counts[ANGLES]
        assert counts[ANGLES] > 0.9 * reference_frames(wave)
        assert counts[f"{ANGLES}_stddev"] == counts[ANGLES]
        assert counts["/calibration"] >= 2
        assert counts["/calibration/clock"] >= 1


def test_deviations_are_finite_where_something_is_known(replayed_wave: Path) -> None:
    """Each angle is known at some time; the rotation of the arms while they are straight (T-pose) is not."""
    with BagReader(replayed_wave) as bag:
        assert bag.whole
        stddevs = [deserialize(JOINT_STATE, raw.cdr).position for raw in bag.messages([f"{ANGLES}_stddev"])]
    finite = np.isfinite(np.array(stddevs))
    assert finite.any(axis=0).all() and not finite.all()


@pytest.mark.parametrize("filter_name", some([DEFAULT_FILTER, "ekf"]))
def test_one_process_and_several_give_the_same_messages_each_time(
    replayed_wave: Path, wave: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filter_name: str
) -> None:
    settings = ReplaySettings(filter_name=filter_name)
    reports = {}
    for stage in (Downstream, ForkedDownstream):
        monkeypatch.setattr(forked, "start_downstream", stage)
        reports[stage] = replay(wave, tmp_path / stage.__name__, settings)
    assert contents(tmp_path / "Downstream") == contents(tmp_path / "ForkedDownstream")
    assert reports[Downstream].counters == reports[ForkedDownstream].counters
    if filter_name == DEFAULT_FILTER:
        assert contents(tmp_path / "Downstream") == contents(replayed_wave)


class Owner:
    """An object in a reference cycle, as ROS nodes are; records the process that destroys it."""

    def __init__(self, notes: Path) -> None:
        self._notes, self._own = notes, self

    def __del__(self) -> None:
        with self._notes.open("a") as file:
            file.write(f"{os.getpid()}\n")


def test_the_other_process_does_not_collect_inherited_garbage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Collecting(Downstream):
        def finish(self, at_ns: int) -> forked.Written:
            gc.collect()
            return super().finish(at_ns)

    monkeypatch.setattr(forked, "Downstream", Collecting)
    notes = tmp_path / "notes"
    thresholds = gc.get_threshold()
    gc.set_threshold(10**9)  # the garbage is still there at the fork
    try:
        Owner(notes)
        ForkedDownstream(job(tmp_path / "out")).finish(0)
    finally:
        gc.set_threshold(*thresholds)
    assert gc.isenabled()
    gc.collect()
    assert notes.read_text() == f"{os.getpid()}\n"


def job(out: Path, **settings: str) -> forked.Job:
    chosen = ReplaySettings(("kinect1",), **settings)  # type: ignore[arg-type]
    return forked.Job(chosen.stages(), out, {}, overwrite=False, model_covariance=False)


def test_the_end_of_the_other_process_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Ending(Downstream):
        def take(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
            time.sleep(0.2)  # until more messages have come, which stay unread
            os._exit(7)

    monkeypatch.setattr(forked, "Downstream", Ending)
    stage = ForkedDownstream(job(tmp_path / "out"))
    for _ in range(300):
        stage.take(graph.FUSED, b"", 0)
    with pytest.raises(BagError, match="ended with code 7"):
        stage.finish(0)


MODEL_TOPICS = (graph.MODEL_STATE, graph.MODEL_STATE_STDDEV, graph.segments_topic("body1"))


def test_the_extended_filter_publishes_its_whole_state(extended_wave: Path, replayed_wave: Path, wave: Path) -> None:
    with BagReader(extended_wave) as bag, BagReader(replayed_wave) as linear:
        counts = {topic: info.count for topic, info in bag.topics.items()}
        assert not set(MODEL_TOPICS) & set(linear.topics)
        assert graph.MODEL_COVARIANCE not in bag.topics
        first = deserialize(JOINT_STATE, next(iter(bag.messages([ANGLES]))).cdr)
        frames = [cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))[0] for raw in bag.messages([graph.FILTERED])]
    for topic in (*MODEL_TOPICS, ANGLES, f"{ANGLES}_stddev"):
        assert counts[topic] == counts["/filtered/skeleton"] > reference_frames(wave)
    assert 1 <= counts[graph.urdf_topic("body1")] <= 1 + seconds(wave)  # at most once a second
    assert tuple(first.name) == tuple(f"{name}_body1" for name in convention("model", UpperBody()).names)
    assert first.header.frame_id == "model"
    # Two sensors out of step, with an output for each frame at its own time: more than the reference has, and in order.
    stamps = np.array([each.stamp_ns for each in frames])
    assert (np.diff(stamps) > 0).all()


def test_nothing_is_stated_to_be_vaguer_than_the_prior_of_a_pose(extended_wave: Path) -> None:
    """Forearms were stated with up to 63 degrees and wrists with 20, since only the trunk and clavicles had priors."""
    model = UpperBody()
    prior = PosturePrior(model, Ranges(model))
    vaguest = dict(zip(model.coordinate_names[6:], prior.stddev.tolist(), strict=True))
    with BagReader(extended_wave) as bag:
        states = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([f"{ANGLES}_stddev"])]
    stated = np.median([state.position for state in states], axis=0)
    for name, stddev in zip(states[0].name, stated.tolist(), strict=True):
        coordinate = name.removesuffix("_body1")
        if coordinate.startswith(("forearm", "wrist", "clavicle", "neck")):
            assert stddev < vaguest[coordinate], coordinate


@pytest.mark.usefixtures("loaded_ekf")
def test_the_covariance_of_the_model_is_written_where_asked_for_and_nothing_else_changes(
    tmp_path: Path,
) -> None:
    excerpt, found = beginning(BAG, tmp_path / "excerpt", 2.0), []
    for asked in (True, False):
        settings = ReplaySettings(filter_name="ekf", convention="isb", model_covariance=asked)
        report = replay(excerpt, tmp_path / str(asked), settings)
        found.append(contents(tmp_path / str(asked)))
    assert sum(raw.topic == graph.MODEL_COVARIANCE for raw in found[0]) == report.frames > 30
    assert [raw for raw in found[0] if raw.topic != graph.MODEL_COVARIANCE] == found[1]


@pytest.mark.parametrize("filter_name", some(["schlagenhauf_ekf", "lkf_constant_velocity"]))
def test_every_filter_gives_the_angles_of_a_model(wave: Path, tmp_path: Path, filter_name: str) -> None:
    report = replay(wave, tmp_path / "out", ReplaySettings(filter_name=filter_name, convention="model"))
    with BagReader(tmp_path / "out") as bag:
        assert bag.topics[ANGLES].count == bag.topics["/filtered/skeleton"].count == report.frames
        calibrating = report.counters.get("filter calibrating", 0)  # frames from which a filter learns the person
        assert calibrating <= 50
        assert report.frames + calibrating > 0.9 * reference_frames(wave)
        last = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([ANGLES])][-1]
        stddev = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([f"{ANGLES}_stddev"])][-1]
    known = dict(zip(last.name, stddev.position, strict=True))
    assert known["elbow_flexion_left_body1"] < np.radians(30.0)
    assert np.isfinite(last.position).all()


@pytest.mark.usefixtures("loaded_ekf")
def test_where_all_sensors_fall_silent_the_extended_filter_predicts(tmp_path: Path) -> None:
    with BagReader(BAG) as bag, BagWriter(tmp_path / "gap") as writer:
        topics = [topic for topic in bag.topics if topic.startswith("/kinect")]
        start, end = bag.start_ns + 2 * NANOSECONDS, bag.start_ns + 3 * NANOSECONDS
        for topic in topics:
            writer.add_topic(topic, bag.topics[topic].type_name)
        for raw in bag.messages(topics):
            if not start <= raw.log_time_ns < end:
                writer.write(raw.topic, raw.cdr, raw.log_time_ns)
            if raw.log_time_ns > end + NANOSECONDS // 2:
                break
    report = replay(tmp_path / "gap", tmp_path / "out", ReplaySettings(filter_name="ekf"))
    with BagReader(tmp_path / "out") as bag:
        frames = [cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))[0] for raw in bag.messages([graph.FILTERED])]
        assert bag.topics[ANGLES].count == len(frames)
    predicted = [each for each in frames if (each.states <= TrackingState.INFERRED).all()]
    # From 0.1 s after the last frame on, 30 a second, until the next one.
    assert 26 <= len(predicted) <= 29
    assert report.counters["filter predicted frames"] == len(predicted)
    spread = [np.trace(each.covariances, axis1=1, axis2=2)[Joint.HAND_LEFT] for each in predicted]
    # For half a second the deviation grows; then the posture prior, linearised at an uncertain pose, makes it vary.
    soon, later = spread[:15], spread[15:]
    assert (np.diff(soon) > 0.0).all()
    assert min(later) > soon[-1]


def test_measurements_that_come_too_late_are_named(tmp_path: Path) -> None:
    """Frames of one sensor on a network that becomes slow."""
    with BagReader(BAG) as bag:
        known = {topic: bag.topics[topic].type_name for topic in bag.topics if topic.startswith("/kinect")}
        slow_ns, end_ns = bag.start_ns + 4 * NANOSECONDS, bag.start_ns + 6 * NANOSECONDS
        messages = [raw for raw in bag.messages(list(known)) if raw.log_time_ns < end_ns]
    late = {
        id(raw): raw.log_time_ns
        + round(0.3 * NANOSECONDS) * (raw.topic == "/kinect2/skeleton" and raw.log_time_ns > slow_ns)
        for raw in messages
    }
    with BagWriter(tmp_path / "late") as writer:
        for topic, kind in known.items():
            writer.add_topic(topic, kind)
        for raw in sorted(messages, key=lambda raw: late[id(raw)]):
            writer.write(raw.topic, raw.cdr, late[id(raw)])
    report = replay(tmp_path / "late", tmp_path / "out", ReplaySettings(filter_name="ekf"))
    count = report.counters["filter too_late"]
    assert count > 40
    expected = f"skeleton_filter: {count} measurements came more than 0.2 s late and were not used"
    assert report.warnings == (expected,)


@pytest.mark.parametrize("filter_name", ["lkf_constant_velocity", "ekf"])
def test_a_sensor_that_repeats_one_frame_is_named(filter_name: str, tmp_path: Path) -> None:
    topic = "/kinect2/skeleton"
    with BagReader(BAG) as bag, BagWriter(tmp_path / "frozen") as writer:
        known = {each: bag.topics[each].type_name for each in bag.topics if each.startswith("/kinect")}
        for each, kind in known.items():
            writer.add_topic(each, kind)
        from_ns, to_ns, end_ns = (bag.start_ns + count * NANOSECONDS for count in (3, 4, 5))
        codec, left_out = Skeletons(), 0
        last: tuple[Skeleton, ...] = ()
        for raw in bag.messages(list(known)):
            if raw.log_time_ns > end_ns:
                break
            cdr = raw.cdr
            if raw.topic == topic:
                (seen,) = codec.decode(cdr, BAG_WIRE)
                last = last if last and from_ns < raw.log_time_ns < to_ns else (seen,)
                left_out += seen.stamp_ns - last[0].stamp_ns > FROZEN_NS
                cdr = codec.encode((replace(seen, positions=last[0].positions),), BAG_WIRE)
            writer.write(raw.topic, cdr, raw.log_time_ns)
    report = replay(tmp_path / "frozen", tmp_path / "out", ReplaySettings(filter_name=filter_name))
    assert report.warnings == (f"{left_out} repeated frames of kinect2 were not used",)


def elbows(bag_path: Path) -> tuple[FloatArray, FloatArray]:
    """(2, n) radians each: estimated flexion of the elbows, NaN where unknown, and the true one."""
    with BagReader(bag_path) as bag:
        angles = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([ANGLES])][90:]
        truth = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([graph.TRUE_ANGLES])]
    true_ns = np.array([to_nanoseconds(each.header.stamp) for each in truth])
    nearest = [np.argmin(np.abs(true_ns - to_nanoseconds(each.header.stamp))) for each in angles]
    names = ("elbow_flexion_left_body1", "elbow_flexion_right_body1")
    found, right = (
        np.array([[each.position[list(each.name).index(name)] for each in those] for name in names])
        for those in (angles, [truth[k] for k in nearest])
    )
    return found, right


def test_the_angles_follow_the_truth(replayed_wave: Path, tmp_path: Path) -> None:
    """Exactly if sensors only lose frames and have different clocks; correlated with it if they err as usual."""
    errors = KinectErrors()
    clean = replace(KinectErrors.none(), white=errors.white, lost=errors.lost, delay=errors.delay)
    write_bag(simulate(Setup("two_handed_wave", seconds=9.0, standard=True, errors=clean)), tmp_path / "clean")
    replay(tmp_path / "clean", tmp_path / "out", ReplaySettings())
    found, truth = elbows(tmp_path / "out")
    assert np.degrees(np.sqrt(np.nanmean((found - truth) ** 2, axis=1))).max() < 3.0
    for found, truth in zip(*elbows(replayed_wave), strict=True):
        known = np.isfinite(found)
        assert np.corrcoef(found[known], truth[known])[0, 1] > 0.8


@pytest.mark.parametrize("words", some([("--smooth",), ("--lag", "0.15")]))
def test_smoothing_loses_no_frame_and_trembles_less(
    wave: Path, replayed_wave: Path, tmp_path: Path, command: Command, words: tuple[str, ...]
) -> None:
    code, _, error = command("replay", wave, "-o", tmp_path / "out", *words)
    assert code == 0, error
    stamps, trembling = [], []
    for folder in (tmp_path / "out", replayed_wave):
        with BagReader(folder) as bag:
            angles = [deserialize(JOINT_STATE, raw.cdr) for raw in bag.messages([ANGLES])]
        stamps.append([to_nanoseconds(each.header.stamp) for each in angles])
        trembling.append(float(np.nanmedian(np.abs(np.diff(elbows(folder)[0], 2, axis=1)))))
    assert stamps[0] == stamps[1]
    assert trembling[0] < trembling[1]


def test_only_a_replay_smooths_by_more_than_a_live_graph(wave: Path, tmp_path: Path, command: Command) -> None:
    (lag,) = (each.values["lag"] for each in ReplaySettings(smooth=True).stages() if each.node == "skeleton_filter")
    assert lag > MAX_LAG
    code, _, error = command("replay", wave, "-o", tmp_path / "out", "--lag", MAX_LAG + 0.1)
    assert code == 2
    assert "lag" in error
    assert not (tmp_path / "out").exists()


def test_the_command_prints_a_report(t_pose: Path, tmp_path: Path, command: Command) -> None:
    words = ("replay", t_pose, "-o", tmp_path / "out", "--filter", "lkf_zero_velocity", "--json")
    BagWriter(tmp_path / "out").close()
    code, _, error = command(*words)
    assert code == 2
    assert error.count("\n") == 1 and "--overwrite replaces it" in error
    code, shown, error = command(*words, "--overwrite")
    assert code == 0, error
    report = json.loads(shown)
    assert report["frames"] > 0.9 * reference_frames(t_pose)
    assert report["recording_s"] == pytest.approx(seconds(t_pose), abs=0.1)
    assert 0.0 < report["elapsed_s"] < 60.0


def test_a_recording_is_not_replaced_by_its_own_angles(tmp_path: Path, command: Command) -> None:
    bag = tmp_path / "mine"
    shutil.copytree(BAG, bag)
    before = {each: each.read_bytes() for each in bag.iterdir()}
    for given in (bag, next(bag.glob("*.mcap"))):
        code, _, error = command("replay", given, "-o", bag, "--overwrite")
        assert code == 2 and error == f"body_tracking: {bag}: is the recording itself; give another folder\n"
        assert {each: each.read_bytes() for each in bag.iterdir()} == before


def test_a_recording_without_skeletons_is_refused_with_the_options_for_it(tmp_path: Path, command: Command) -> None:
    code, _, error = command("replay", BAG.with_name("cameras_turning"), "-o", tmp_path / "out")
    assert code == 2 and "the option that takes them: --camera-rig FOLDER" in error
    code, _, error = command("calibrate", BAG.with_name("cameras_turning"), "-o", tmp_path / "lab.yaml")
    assert code == 2 and "no topic /<sensor>/skeleton" in error and "--camera" not in error
    assert "replay makes skeletons of the images of colour and depth cameras; body_tracking markers calibrates" in error


def test_a_sensor_that_a_recording_lacks_is_refused_with_those_that_it_has(tmp_path: Path, command: Command) -> None:
    """All its topics but the truth, only where it has no such sensor; an inertial sensor in the form of ``--imus``."""
    five, coloured, out = BAG.with_name("five_systems"), BAG.with_name("camera_reaching"), ("-o", tmp_path / "out")
    turning = BAG.with_name("cameras_turning")
    worn = "forearm_left, forearm_right, pelvis, upper_arm_left, upper_arm_right, upper_trunk"
    listed = "/kinect1/skeleton, /kinect2/skeleton"
    for words, said in (
        (("replay", five, *out, "--sensors", "kinect1,kinect9"), "kinect9/skeleton; its sensors are kinect1, kinect2"),
        (("calibrate", five, "--sensors", "kinect9"), "/kinect9/skeleton; its sensors are kinect1, kinect2"),
        (("replay", five, *out, "--imus", "hand_left"), f"for hand_left; its inertial sensors are {worn}"),
        (("replay", BAG, *out, "--imus", "hand_left"), "for hand_left; it has no topic /<segment>/imu/data"),
        (("up", "--bag", BAG, "--imus", "hand_left"), "for hand_left; it has no topic /<segment>/imu/data"),
        (("replay", coloured, *out, "--camera", "cam1"), "/cam1/color/camera_info; it has the cameras camera1"),
        (
            ("replay", coloured, *out, "--camera", "camera1", "--driver", "oak"),
            "no topic /camera1/rgb/camera_info; it has those of --driver plain",
        ),
        (("replay", coloured, *out, "--camera", "camera1"), "(it comes compressed: --compressed colour)"),
        (("replay", BAG, *out, "--camera", "camera1"), "/camera1/color/camera_info; it has no camera"),
        (
            ("replay", turning, *out, "--camera", "camera1"),
            "/camera1/color/camera_info; of camera1 it has /camera1/color/image_raw/compressed",
        ),
        (("replay", five, *out, "--depth", "camera9"), "camera_info; its depth cameras are camera1, kinect1"),
        (("replay", BAG, *out, "--depth", "kinect1"), f"no topic /kinect1/depth/camera_info; it has {listed}"),
        (
            ("replay", BAG, *out, "--marker-setup", BAG.parents[1] / "config" / "marker_setup"),
            f"no topic /left/image_raw or /left/balls or /markers/points; it has {listed}",
        ),
        (("replay", five, *out, "--imus", "pelvis,hand_left"), f"for hand_left; its inertial sensors are {worn}"),
    ):
        code, _, error = command(*words)
        assert code == 2 and error.count("\n") == 1
        assert error.endswith(f"{said}\n")
    driver = ("/imu_forearm_left/imu/data_raw", "/imu7/imu/data", "/imu7/imu/data_raw")
    with pytest.raises(graph.GraphError, match="are SEGMENT:imu7, forearm_left:imu_forearm_left"):
        graph.played_imu_topics(["hand_left"], driver)


@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_images_of_a_camera_become_angles(tmp_path: Path) -> None:
    bag, out = beginning(BAG.with_name("camera_reaching"), tmp_path / "excerpt", 1.0), tmp_path / "out"
    assert cli.main(["replay", str(bag), "-o", str(out), "--camera", "camera1", "--compressed", "colour"]) == 0
    with BagReader(out) as reader:
        counts = [reader.topics[topic].count for topic in (graph.skeleton_topic("camera1"), ANGLES)]
    assert counts[0] >= 14 and counts[1] >= 10


def test_the_summary_of_a_replay_has_poses_and_known_angles(replayed_wave: Path, extended_wave: Path) -> None:
    lines = list(summary(replayed_wave))
    assert lines[0].startswith("kinect1: the reference sensor, at the origin of world")
    assert "looks 87 deg to the right of x" in lines[1] or "looks 88 deg to the right of x" in lines[1]
    assert [line.partition(":")[0] for line in lines[1:]] == [
        "kinect2",
        *(f"body1, {limb}" for limb in ("left arm", "right arm", "trunk and head")),
    ]
    assert all(
        re.search(
            r"[1-9] of \d angles known in (at least \d|every).*: standard deviation below 30 deg, median \d",
            line,
        )
        for line in lines[2:]
    )
    # an angle with the prior's deviation counts as unknown
    assert any("; not known: left" in line for line in summary(extended_wave))


def test_a_replay_names_its_filter_and_that_of_the_recorded_graph(tmp_path: Path, command: Command) -> None:
    """Of a recording of a live graph, whose diagnostics say which filter made the angles in it."""
    brief = beginning(BAG, tmp_path / "brief", 2.0)
    with BagReader(brief) as bag, BagWriter(tmp_path / "live") as writer:
        for topic, info in bag.topics.items():
            writer.add_topic(topic, info.type_name)
        for raw in bag.messages():
            writer.write(raw.topic, raw.cdr, raw.log_time_ns)
        writer.add_topic(graph.DIAGNOSTICS_TOPIC, DIAGNOSTICS)
        for name, text in (("skeleton_filter: state", "ekf"), ("fusion: state", "lkf_zero_velocity")):
            status = diagnostics(bag.start_ns, name, "", 0, text, {}, BAG_MESSAGES)
            writer.write_message(graph.DIAGNOSTICS_TOPIC, status, bag.start_ns)
        writer.write(graph.DIAGNOSTICS_TOPIC, b"no diagnostics", bag.end_ns)
    code, plain, error = command("replay", brief, "-o", tmp_path / "plain")
    assert code == 0, error
    assert f"\nfilter: {DEFAULT_FILTER}\n" in plain
    code, live, error = command("replay", tmp_path / "live", "-o", tmp_path / "out")
    assert code == 0, error
    assert f"\nfilter: {DEFAULT_FILTER}; the recorded angles (filter ekf) are not read\n" in live
    assert contents(tmp_path / "out") == contents(tmp_path / "plain")


def test_calibrate_prints_poses_and_clocks(
    wave: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RigReader(BAG) as bag:
        transforms = [deserialize(TRANSFORM, raw.cdr) for raw in bag.messages([graph.TRUE_CALIBRATION])]
        references = [deserialize(TIME_REFERENCE, raw.cdr) for raw in bag.messages([graph.TRUE_CLOCK])]
    poses, clocks = map(transform_to_pose, transforms), list(map(time_reference_to_clock, references))
    (true,) = (pose for pose in poses if pose.sensor == "kinect2")
    _, valid_ns, clock = clocks[0]
    offset_s = (clock.to_sensor(valid_ns) - valid_ns) / NANOSECONDS
    # The reference sensor looks along x.
    ahead = true.rotation[:, 2]
    yaw_deg = np.degrees(np.arctan2(ahead[1], ahead[0]))
    for method in ("thesis", "robust"):
        code, out, error = command("calibrate", wave, "--method", method, "--json", "-o", tmp_path / f"{method}.yaml")
        assert code == 0, error
        result = json.loads(out)
        assert result["reference"] == "kinect1"
        sensor = result["sensors"]["kinect2"]
        assert np.allclose(sensor["translation"], true.translation, atol=0.25)
        assert np.linalg.norm(sensor["quat_xyzw"]) == pytest.approx(1.0)
        assert sensor["relative_yaw_deg"] == pytest.approx(yaw_deg, abs=6.0)
        assert sensor["clock_offset_s"] == pytest.approx(offset_s, abs=0.06)
        assert sensor["residual_mm"] < 100.0
    _, _, error = command("calibrate", wave, "-o", tmp_path / "robust.yaml")
    assert "robust.yaml: exists already; --overwrite replaces it" in error
    code, out, error = command("calibrate", wave, "-o", tmp_path / "thesis.yaml", "--overwrite")
    assert code == 0, error
    assert "warning" not in out
    assert (tmp_path / "thesis.yaml").read_text() == (tmp_path / "robust.yaml").read_text()
    for method, kind in (("thesis", "mean"), ("robust", "median")):
        said = command("calibrate", wave, "--method", method)[1]
        assert re.search(
            r"^kinect2: calibrated from a T-pose, with a mean residual of \d+ mm in it$", said, re.MULTILINE
        )
        assert re.search(rf"^kinect2: at \(.*, {kind} residual \d+ mm$", said, re.MULTILINE)
    strict = tmp_path / "strict.yaml"
    strict.write_text("calibration:\n  ros__parameters:\n    max_rotation_stddev: 0.001\n")
    assert "\ngood: kinect2 to 1." in out and " mm at the person's place (good is below 2.9 degrees and 50 mm)" in out
    said = command("calibrate", wave, "--params-file", strict)[1]
    assert "\nnot good enough: kinect2: roughly calibrated" in said and "(good is below 0.1 degrees and 50 mm)" in said
    assert "\nnext: record again, and walk about and turn where all sensors see you\n" in said
    monkeypatch.setattr(online, "MAX_RESIDUAL", 0.01)
    said = command("calibrate", wave)[1]
    assert "\nnot good enough: kinect1 and kinect2 do not see the same pose (median residual above 10 mm); " in said
    # A saved calibration can be used from the first frame on.
    brief = beginning(BAG, tmp_path / "brief", 2.0)
    code, out, error = command(
        "replay", brief, "-o", tmp_path / "out", "--calibration", tmp_path / "robust.yaml", "--json"
    )
    assert code == 0, error
    assert json.loads(out)["counters"].get("fusion uncalibrated", 0) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        ("nothing", "no such"),
        ("empty", "no topic"),
        ("other type", "expected sensor_msgs/msg/PointCloud2"),
        ("malformed", "malformed /kinect1/skeleton: 1, the first: "),
    ],
)
def test_a_bag_without_skeletons_is_named_in_one_line(
    tmp_path: Path, command: Command, make: str, message: str
) -> None:
    bag = tmp_path / "bag"
    if make != "nothing":
        with BagWriter(bag) as writer:
            if make == "empty":
                writer.add_topic("/tf", "geometry_msgs/msg/TransformStamped")
            elif make == "other type":
                writer.add_topic("/kinect1/skeleton", JOINT_STATE)
            else:
                writer.add_topic("/kinect1/skeleton", "sensor_msgs/msg/PointCloud2")
                writer.write("/kinect1/skeleton", b"\x00\x01\x00\x00 no such message", 1)
    for words in (("replay", bag, "-o", tmp_path / "out"), ("calibrate", bag)):
        code, _, error = command(*words)
        assert code == 2
        assert error.count("\n") == 1
        if words[0] == "replay":
            assert message in error
    assert not (tmp_path / "out").exists()


def test_a_failure_of_the_second_half_is_reported_and_leaves_no_bag(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for stage in (Downstream, ForkedDownstream):
        with pytest.raises(BagError):
            stage(job(tmp_path / "file" / "out"))
        with pytest.raises(BodyTrackingError, match="no_such_filter"):
            stage(job(tmp_path / "out", filter_name="no_such_filter"))
    broken = ForkedDownstream(job(tmp_path / "out"))
    with pytest.raises(BagError):
        for _ in range(1000):
            broken.take("/nobody", b"", 0)
        broken.finish(0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--reference", "kinect9"), "kinect9"),
        (("--calibration", "absent.yaml"), "absent.yaml"),
    ],
)
def test_an_error_of_the_first_stage_ends_both_processes_and_leaves_no_bag(
    tmp_path: Path, command: Command, arguments: tuple[str, str], message: str
) -> None:
    code, _, error = command("replay", BAG, "-o", tmp_path / "out", *arguments)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_an_error_of_the_first_stage_leaves_the_bag_that_was_to_be_replaced(
    tmp_path: Path, replayed_wave: Path
) -> None:
    shutil.copytree(replayed_wave, tmp_path / "out")
    with pytest.raises(BodyTrackingError, match="kinect9"):
        replay(BAG, tmp_path / "out", ReplaySettings(reference="kinect9"), overwrite=True)
    assert contents(tmp_path / "out") == contents(replayed_wave)


def test_an_error_while_frames_come_ends_both_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: object, *frame: object) -> None:
        raise ReplayError("no more")

    monkeypatch.setattr(forked, "start_downstream", ForkedDownstream)
    monkeypatch.setattr(OfflineRunner, "push", fail)
    with pytest.raises(ReplayError, match="no more"):
        replay(BAG, tmp_path / "out", ReplaySettings())
    assert not (tmp_path / "out").exists()
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("victim", some(["reader", "writer", "filter"], 2))
def test_where_one_process_is_killed_the_others_end_and_leave_no_bag(tmp_path: Path, victim: str) -> None:
    out = tmp_path / "out"
    arguments = [sys.executable, "-m", "body_tracking.cli", "replay", str(BAG), "-o", str(out)]
    reader = psutil.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    others: list[psutil.Process] = []
    deadline = time.monotonic() + PATIENCE
    try:
        while not out.exists() or len(others) < 2:
            assert time.monotonic() < deadline
            others = reader.children(recursive=True)
            time.sleep(0.01)
        {"reader": reader, "filter": others[0], "writer": others[1]}[victim].kill()
        _, reported = reader.communicate(timeout=PATIENCE)
        while out.exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        for process in (*others, reader):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
    assert not psutil.wait_procs(others, timeout=PATIENCE)[1]
    if victim != "reader":
        assert reader.returncode == 2, reported.decode()
        assert reported.count(b"\n") == 1


def test_parameters_are_checked_before_anything_runs(tmp_path: Path, command: Command) -> None:
    for text, message in (
        ("fusion: {ros__parameters: {max_wate: 3.0}}", "did you mean 'max_wait'"),
        ("calibration: {ros__parameters: {method: best}}", "method"),
        ("skeleton_filter: {ros__parameters: {measurement_noise_scale: -7.0}}", "measurement_noise_scale"),
        ("skeleton_filter: {ros__parameters: {filter: ekf, ekf: {predict_fro: 7.0}}}", "'ekf.predict_for'"),
        ("skeleton_filter: {ros__parameters: {filter: ekg}}", "expected one of"),
        ("joint_angles: {ros__parameters: {convention: isp}}", "expected one of"),
        ("joint_angles: {ros__parameters: {convention: isb, input: model_state}}", "has no model of the body"),
    ):
        file = tmp_path / "parameters.yaml"
        file.write_text(text)
        code, _, reported = command("replay", BAG, "-o", tmp_path / "out", "--params-file", file)
        assert code == 2
        assert message in reported
        assert reported.count("\n") == 1
    assert command("replay", BAG, "-o", tmp_path / "out", "--filter", "ukf")[0] == 2
    assert "kinect7" in command("replay", BAG, "-o", tmp_path / "out", "--sensors", "kinect1,kinect7")[2]


def test_sensors_none_leaves_out_the_skeletons_of_a_bag(tmp_path: Path, command: Command) -> None:
    setup = Path(__file__).resolve().parents[2] / "config" / "marker_setup"
    for more, message in (
        ((), "no sensors"),
        (("--marker-setup", "nowhere"), "nowhere: no such folder"),
        (("--marker-setup", setup / "rig.yaml"), "rig.yaml: a file, expected its folder"),
        (("--marker-setup", setup.parent), "config: holds neither rig.yaml nor targets.yaml, so it is no marker setup"),
        (("--marker-setup", setup), "no topic /left/image_raw or /left/balls or /markers/points"),
    ):
        code, _, reported = command("replay", BAG, "-o", tmp_path / "out", "--sensors", "none", *more)
        assert code == 2 and message in reported
    assert not (tmp_path / "out").exists()


def test_inertial_sensors_without_a_pose_are_named(tmp_path: Path, command: Command) -> None:
    """The stage's own status is the reported reason, not the counters of dropped messages."""
    readings = "".join(f"{k / 50},{k % 7},0.3,0.1,0,0,9.81\n" for k in range(200))
    header = "stamp,angular_velocity_x,angular_velocity_y,angular_velocity_z"
    (tmp_path / "a.csv").write_text(
        f"{header},linear_acceleration_x,linear_acceleration_y,linear_acceleration_z\n{readings}"
    )
    import_files([tmp_path / "a.csv"], tmp_path / "bag", sensors={tmp_path / "a.csv": "forearm_left"})
    words = ("replay", tmp_path / "bag", "-o", tmp_path / "out", "--sensors", "none", "--imus", "forearm_left")
    code, _, reported = command(*words)
    assert code == 2 and reported.count("\n") == 1 and "(imu_skeleton: forearm_left: not aligned: " in reported
    assert "has to hold a T-pose with palms down" in reported
    assert not (tmp_path / "out").exists()


def test_what_a_calibration_lacks_and_what_no_option_takes_is_named(
    wave: Path, tmp_path: Path, command: Command
) -> None:
    brief, file = beginning(BAG, tmp_path / "brief", 1.0), tmp_path / "lab.yaml"
    with_imus = beginning(ROOT / "bags" / "mesh_reaching", tmp_path / "with_imus", 1.0)
    assert command("calibrate", wave, "-o", file)[0] == 0
    file.write_text(file.read_text().replace("kinect2", "kinect9"))
    code, _, reported = command("replay", brief, "-o", tmp_path / "out", "--calibration", file)
    assert code == 0 and "lab.yaml; it has kinect1, kinect9, but not kinect2" in reported
    code, printed, _ = command("replay", with_imus, "-o", tmp_path / "skeletons")
    assert code == 0 and "not taken without an option: --imus: forearm_left, forearm_right" in printed
    code, _, reported = command("calibrate", with_imus)
    assert code == 2 and "only the sensor kinect1" in reported


def test_a_file_of_the_person_that_is_missing_is_an_error(tmp_path: Path, command: Command) -> None:
    words = ("replay", ROOT / "bags" / "mesh_reaching", "--depth", "kinect1", "--person", tmp_path / "typo.yaml")
    code, _, reported = command(*words, "-o", tmp_path / "out")
    assert code == 2 and "typo.yaml: no such file; body_tracking mesh personalise makes it" in reported
    assert not (tmp_path / "out").exists()


def test_errors_have_one_base() -> None:
    for error in (ReplayError, BagError, ParameterError):
        assert issubclass(error, BodyTrackingError)
