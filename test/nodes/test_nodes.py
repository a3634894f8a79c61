"""The nodes as processes over DDS: refused input, invalid messages, and their reports."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from running import BAG, LATCHED, RELIABLE, Running, environment, recorded, refusal, stop  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2, TimeReference  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking.calibration.storage import load  # noqa: E402
from body_tracking.core.sensor_poses import level_pose  # noqa: E402
from body_tracking.core.skeleton import NANOSECONDS, Skeleton  # noqa: E402
from body_tracking.messages.base import RosMessages, to_nanoseconds, to_time  # noqa: E402
from body_tracking.messages.calibration import pose_to_transform  # noqa: E402
from body_tracking.messages.cdr import decode_skeletons  # noqa: E402
from body_tracking.messages.skeletons import cloud_to_skeletons, skeletons_to_cloud  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.recording.rig import RigReader  # noqa: E402
from draws import some  # noqa: E402

ROS = RosMessages()
FRAME_NS = 33_333_333


# --- parameters


@pytest.mark.parametrize(
    ("executable", "parameters", "said"),
    [
        ("kinect_skeleton", "sensr:=kinect1", "unknown parameter 'sensr'; did you mean 'sensor'?"),
        ("kinect_skeleton", "rate:=-1.0", "parameter 'rate': -1.0, expected 0.01 to 100"),
        ("kinect_skeleton", "backend:=xbox", "parameter 'backend': 'xbox', expected one of network, recording"),
        ("kinect_skeleton", "sensor:=fused", "sensor name 'fused' is reserved"),
        ("kinect_skeleton", "file:=/nowhere.csv", "/nowhere.csv: no such file"),
        ("calibration", "calibration_fil:=a", "unknown parameter 'calibration_fil'"),
        ("fusion", "people:=1.5", "parameter 'people': 1.5, expected a whole number"),
        ("calibration", "reference:=kinect9", "kinect9"),
        ("fusion", "silence:=99.0", "parameter 'silence': 99.0, expected 0.02 to 5"),
        ("fusion", "sensors:=3", "parameter 'sensors': 3, expected a list of strings"),
        ("skeleton_filter", "filter:=ekg", "parameter 'filter': 'ekg', expected one of"),
        ("skeleton_filter", "predict_for:=true", "parameter 'predict_for': True, expected a number"),
        ("joint_angles", "body:=a/b", "parameter 'body': 'a/b'"),
        ("bag_player", "bags:=x", "unknown parameter 'bags'; did you mean 'bag'?"),
        ("bag_recorder", "chunk_seconds:=-1.0", "parameter 'chunk_seconds'"),
        ("kinect_skeleton", "port:=0", "parameter 'port': 0, expected 1 to 65535"),
        ("kinect_skeleton", "backend:=network address:=0.0.0.0", "needs the parameter 'key_file'"),
        ("kinect_skeleton", "backend:=network key_file:=/nowhere", "'key_file': /nowhere: cannot be read"),
        ("imu_skeleton", "", "segments"),
        ("imu_skeleton", "segments:=[nose]", "nose"),
        ("imu_skeleton", "segments:=[]", "inertial sensors: none;"),
        ("fusion", "use_sim_time:=maybe", "'use_sim_time' to 'maybe' of type 'STRING'"),
        ("marker_joint_angles", "", "no folder given; it has to hold chain.yaml"),
        ("imu_skeleton", "segments:=[head] mountings:=['head:up']", "mounting 'up' on head"),
        ("robot_commands", "", "parameter 'mapping': no mapping file of a robot; see docs/robots.md"),
        ("robot_commands", f"mapping:={BAG}/metadata.yaml", f"{BAG}/metadata.yaml: the file: unknown key"),
        ("bag_player", "", "no bag to play"),
        ("bag_player", "bag:=absent", "absent: no such recording"),
        ("bag_player", f"bag:={BAG} topics:=[/nothing]", "no topic /nothing"),
        ("bag_player", f"bag:={BAG} wait_for_subscribers:=[/nothing]", "/nothing"),
        ("bag_player", f"bag:={BAG} start_offset:=99.0", "no message to play after 99 s"),
        ("bag_player", f"bag:={BAG} rate:=0.0", "rate"),
        ("bag_player", f"bag:={BAG} on_end:=explode", "on_end"),
        ("bag_player", "bag:=empty.mcap", "empty"),
    ],
)
def test_a_node_refuses_bad_parameters_in_one_line(tmp_path: Path, executable: str, parameters: str, said: str) -> None:
    (tmp_path / "empty.mcap").touch()
    words = [word for parameter in parameters.split() for word in ("-p", parameter)]
    assert said in refusal(tmp_path, executable, *words)


def test_wildcard_section_may_have_parameters_of_some_nodes(tmp_path: Path) -> None:
    def reason(name: str) -> str:
        file = tmp_path / f"{name}.yaml"
        file.write_text(f"/**:\n  ros__parameters:\n    {name}: map\n")
        return refusal(tmp_path, "kinect_skeleton", "--params-file", str(file))

    # The node gets past its parameters, to the recording that it was not given.
    assert "needs the parameter 'file'" in reason("world_frame")
    assert "unknown parameter 'wurld_frame'" in reason("wurld_frame")


# --- messages


def valid() -> PointCloud2:
    return skeletons_to_cloud([recorded("kinect1")[0]], ROS)


def changed(change: Callable[[PointCloud2], object]) -> PointCloud2:
    cloud = valid()
    change(cloud)
    return cloud


def with_points(change: Callable[[np.ndarray], None]) -> PointCloud2:
    cloud = valid()
    data = np.frombuffer(bytes(cloud.data), np.uint8).reshape(25, 16).copy()
    change(data)
    cloud.data = data.tobytes()
    return cloud


def _no_points(cloud: PointCloud2) -> None:
    cloud.width, cloud.row_step, cloud.data = 0, 0, b""


def _other_count(cloud: PointCloud2) -> None:
    cloud.width, cloud.row_step, cloud.data = 24, 24 * 16, bytes(cloud.data)[: 24 * 16]


def _state_three(data: np.ndarray) -> None:
    data[7, 13] = 3


def _joint_twice(data: np.ndarray) -> None:
    data[7, 12] = 8


MALFORMED: dict[str, Callable[[], Any]] = {
    "missing fields": lambda: changed(lambda cloud: setattr(cloud, "fields", cloud.fields[:3])),
    "another type": lambda: changed(lambda cloud: setattr(cloud.fields[0], "datatype", 8)),
    "a field beyond the point": lambda: changed(lambda cloud: setattr(cloud.fields[2], "offset", 15)),
    "too few bytes": lambda: changed(lambda cloud: setattr(cloud, "data", bytes(cloud.data)[:-1])),
    "a wrong row step": lambda: changed(lambda cloud: setattr(cloud, "row_step", 7)),
    "a wrong point step": lambda: changed(lambda cloud: setattr(cloud, "point_step", 0)),
    "big-endian": lambda: changed(lambda cloud: setattr(cloud, "is_bigendian", True)),
    "no points": lambda: changed(_no_points),
    "another number of points": lambda: changed(_other_count),
    "a state above 2": lambda: with_points(_state_three),
    "a joint twice": lambda: with_points(_joint_twice),
    "no message at all": lambda: b"\x00\x01\x00\x00garbage",
}


INPUTS = {
    "calibration": "/kinect2/skeleton",
    "fusion": "/kinect2/skeleton",
    "skeleton_filter": graph.FUSED,
    "joint_angles": graph.FILTERED,
}


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with Running(tmp_path_factory.mktemp("nodes")) as running:
        for executable in INPUTS:
            running.start(executable, reliable=True)
        assert running.until(lambda: len(running.diagnostics) >= 4)
        yield running


@pytest.mark.parametrize("topic", sorted(set(INPUTS.values())))
def test_every_malformed_message_is_counted(nodes: Running, topic: str) -> None:
    readers = [name for name, own in INPUTS.items() if own == topic]
    publisher = nodes.node.create_publisher(PointCloud2, topic, RELIABLE)
    assert nodes.until(lambda: publisher.get_subscription_count() == len(readers))
    for make in MALFORMED.values():
        publisher.publish(make())
    nodes.until(lambda: all(nodes.number(name, "malformed") >= len(MALFORMED) for name in readers))
    assert [nodes.number(name, "malformed") for name in readers] == [len(MALFORMED)] * len(readers)
    for name in readers:
        assert nodes.processes[name].poll() is None
        assert topic in nodes.said(name).get("last malformed", "")
        assert "malformed message ignored" in nodes.log(name)
    publisher.publish(valid())
    assert nodes.until(lambda: all(nodes.number(name, "received") >= 1 for name in readers))
    nodes.node.destroy_publisher(publisher)


def test_invalid_pose_is_counted(nodes: Running) -> None:
    before = nodes.number("fusion", "malformed")
    publisher = nodes.node.create_publisher(TransformStamped, graph.CALIBRATION, LATCHED)
    assert nodes.until(lambda: publisher.get_subscription_count() == 1)
    no_rotation = pose_to_transform(level_pose("kinect1"), "world", ROS)
    no_rotation.transform.rotation.w = no_rotation.transform.rotation.x = 0.0
    no_sensor = pose_to_transform(level_pose("kinect1"), "world", ROS)
    no_sensor.child_frame_id = "kinect1"
    for message in (no_rotation, no_sensor):
        publisher.publish(message)
    assert nodes.until(lambda: nodes.number("fusion", "malformed") == before + 2)
    nodes.node.destroy_publisher(publisher)


def test_one_sensor_gives_angles_and_a_person_who_leaves_comes_back(nodes: Running) -> None:
    angles = nodes.collect(JointState, graph.joint_states_topic("body1"))
    stddevs = nodes.collect(JointState, graph.joint_states_stddev_topic("body1"))
    publisher = nodes.node.create_publisher(PointCloud2, "/kinect1/skeleton", RELIABLE)
    assert nodes.until(lambda: publisher.get_subscription_count() == 2)
    frames = recorded("kinect1")

    def send(start_ns: int, unseen: bool = False) -> None:
        for index, frame in enumerate(frames[:20]):
            positions = np.full((25, 3), np.nan) if unseen else frame.positions
            states = np.zeros(25, np.uint8) if unseen else frame.states
            body = Skeleton(start_ns + index * FRAME_NS, frame.frame_id, positions, states, frame.body)
            publisher.publish(skeletons_to_cloud([body], ROS))
            nodes.executor.spin_once(timeout_sec=0.005)

    start = 10**12
    send(start)
    assert nodes.until(lambda: len(angles) >= 20 and len(stddevs) >= 20)
    elbow = angles[-1].name.index("elbow_flexion_left_body1")
    assert np.isfinite(angles[-1].position[elbow])
    assert 0.0 < stddevs[-1].position[elbow] < 1.0
    assert angles[-1].header.frame_id == stddevs[-1].header.frame_id == "positional"
    assert to_nanoseconds(angles[0].header.stamp) == start  # the capture time, to the nanosecond

    send(start + 20 * FRAME_NS, unseen=True)
    angles.clear()
    back = start + 100 * FRAME_NS
    send(back)
    assert nodes.until(lambda: angles and to_nanoseconds(angles[-1].header.stamp) == back + 19 * FRAME_NS)
    assert np.isfinite(angles[-1].position[elbow])

    # The recording begins again: stamps far behind are a jump of time, after which everything goes on.
    angles.clear()
    send(start)
    assert nodes.until(lambda: angles and to_nanoseconds(angles[-1].header.stamp) == start + 19 * FRAME_NS)
    assert "time jumped back" in nodes.log("fusion")
    assert "time jumped back" in nodes.log("skeleton_filter")

    # Stamps that repeat or run back a little are counted and change nothing.
    for back_ns in (0, FRAME_NS):
        cloud = skeletons_to_cloud([frames[0]], ROS)
        cloud.header.stamp = to_time(start + 19 * FRAME_NS - back_ns, ROS)
        publisher.publish(cloud)
    assert nodes.until(lambda: nodes.number("fusion", "repeated stamps") == 1)
    assert nodes.until(lambda: nodes.number("fusion", "stamps backwards") >= 1)
    assert nodes.number("fusion", "time jumps") >= 1
    assert all(process.poll() is None for process in nodes.processes.values())


def test_a_t_pose_that_is_held_is_logged(nodes: Running) -> None:
    publisher = nodes.node.create_publisher(PointCloud2, "/kinect1/skeleton", RELIABLE)
    assert nodes.until(lambda: publisher.get_subscription_count() == 2)
    first, begin = recorded("kinect1")[0].stamp_ns, 2 * 10**12
    held = [frame for frame in recorded("kinect1") if frame.stamp_ns < first + 2 * NANOSECONDS]
    for frame in held:
        publisher.publish(skeletons_to_cloud([replace(frame, stamp_ns=begin + frame.stamp_ns - first)], ROS))
        nodes.executor.spin_once(timeout_sec=0.005)
    assert nodes.until(lambda: nodes.said("skeleton_filter").get("t_poses") == "1")
    assert nodes.until(lambda: "estimated from a T-pose" in nodes.log("skeleton_filter"))
    nodes.node.destroy_publisher(publisher)


def test_late_subscriber_gets_the_calibration_and_services_answer(nodes: Running) -> None:
    poses = nodes.collect(TransformStamped, graph.CALIBRATION, LATCHED)
    assert nodes.until(lambda: poses)
    assert poses[0].child_frame_id == "kinect1_optical_frame"
    assert poses[0].header.frame_id == "world"
    for service in (graph.START_SERVICE, graph.RESET_SERVICE):
        answer = nodes.call(Trigger, service, Trigger.Request())
        assert answer.success and answer.message


# --- nodes on their own


def test_a_recording_plays_as_it_was_recorded(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        received = running.collect(PointCloud2, "/kinect2/skeleton")
        start = time.time() + 10.0  # by then it has discovered its subscribers, also on a busy machine
        running.start("kinect_skeleton", sensor="kinect2", file=BAG, rate=20.0, reliable=True, start_time=start)
        frames = recorded("kinect2")
        with RigReader(BAG) as reader:
            zero_ns = reader.start_ns
            raws = reader.messages([graph.skeleton_topic("kinect2")])
            captured = np.array([(decode_skeletons(raw.cdr) or ())[0].stamp_ns - zero_ns for raw in raws])
        assert running.until(lambda: running.said("kinect_skeleton").get("") == "ended")
        said = running.said("kinect_skeleton")
        left_out = int(said.get("left out, late", 0))  # on a busy machine
        running.until(lambda: len(received) == len(frames) - left_out)
        assert len(received) == len(frames) - left_out > 0.5 * len(frames)
        # when the message plays, less its delay then
        stamps = np.array([to_nanoseconds(cloud.header.stamp) - round(start * NANOSECONDS) for cloud in received])
        places = np.abs(captured[None] / 20.0 - stamps[:, None]).argmin(axis=1)
        np.testing.assert_allclose(stamps, captured[places] / 20.0, rtol=0.0, atol=1e3)
        assert (np.diff(places) > 0).all()
        last = cloud_to_skeletons(received[-1])[0]
        assert np.array_equal(last.positions, frames[places[-1]].positions, equal_nan=True)
        assert stop(running.processes["kinect_skeleton"]) == 0


CAMERA = """
import time

import numpy as np

from body_tracking.core.sources import RecordedFrame
from body_tracking.core.skeleton import Skeleton


class Camera:
    ended, problem, counters = False, "", {}

    def __init__(self, settings):
        self.sensor, self.stamps = settings.sensor, iter(range(1, 4))

    def read(self, timeout):
        stamp = next(self.stamps, None)
        if stamp is None:
            raise OSError("the cable was pulled")
        points, states = np.ones((25, 3)), np.full(25, 2, np.uint8)
        return RecordedFrame(self.sensor, stamp, (Skeleton(stamp, self.sensor, points, states, 1),))

    def close(self):
        pass


class Mute(Camera):
    @property
    def counters(self):
        raise KeyError("temperature")

    def read(self, timeout):
        if self.stamps.__length_hint__():
            return super().read(timeout)
        time.sleep(timeout)

    def close(self):
        raise OSError("closed twice")
"""


def installed(folder: Path, entry: str) -> dict[str, str]:
    """A package with a backend of its own, as pip leaves it; the environment in which it is found."""
    (folder / "mycamera.py").write_text(CAMERA)
    information = folder / "mycamera-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: mycamera\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[body_tracking.backends]\nmine = {entry}\n")
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))}


def test_backend_of_another_package_is_found_and_its_failure_reported(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.environment |= installed(tmp_path, "mycamera:Camera")
        process = running.start_interpreter("kinect_skeleton", backend="mine")
        failure = "OSError: the cable was pulled"
        assert running.until(lambda: running.said("kinect_skeleton").get("") == failure, 60.0)
        assert running.said("kinect_skeleton").get("published", "") == "3"
        assert "in read" in running.log("kinect_skeleton")  # the place of the error, for the backend's author
        assert process.poll() is None
        assert stop(process) == 0


def test_backend_whose_status_raises_keeps_publishing(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.environment |= installed(tmp_path, "mycamera:Mute")
        process = running.start_interpreter("kinect_skeleton", backend="mine")
        assert running.until(lambda: running.said("kinect_skeleton").get("published") == "3")
        assert running.said("kinect_skeleton").get("", "") == "streaming; counters: KeyError: 'temperature'"
        assert "in counters" in running.log("kinect_skeleton")
        assert stop(process) == 0
        assert "OSError: closed twice" in running.log("kinect_skeleton")


@pytest.mark.parametrize(("entry", "said"), some([("nowhere:Camera", "nowhere"), ("mycamera:Film", "Film")]))
def test_backend_that_cannot_be_loaded_is_reported_in_one_line(tmp_path: Path, entry: str, said: str) -> None:
    with Running(tmp_path) as running:
        running.environment |= installed(tmp_path, entry)
        assert running.start_interpreter("kinect_skeleton", backend="mine").wait(60.0) == 2
        (line,) = running.log("kinect_skeleton").splitlines()
        assert line.startswith("kinect_skeleton: backend 'mine': ")
        assert said in line


NEVER_LEAVES = """\
import ctypes
from body_tracking.pipeline.shared import RELIABLE
from body_tracking.ros import main, node

class Stuck(node.GraphNode):
    NAME = "stuck"
    PARAMETERS = (RELIABLE,)

    def __init__(self):
        super().__init__()
        print("here", flush=True)  # signals are handled from before this

    def close(self):
        print("closed", flush=True)

    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)  # keeps the interpreter's lock, as rclpy does

main._LEAVE_S = 1.0
main.run(Stuck)
"""


def test_closed_node_that_the_middleware_blocks_ends_in_order(tmp_path: Path) -> None:
    file = tmp_path / "stuck.py"
    file.write_text(NEVER_LEAVES)
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen([sys.executable, file], stdout=log, stderr=log, env=environment())
    end = time.monotonic() + 30.0
    while not (tmp_path / "log").read_text() and time.monotonic() < end:
        time.sleep(0.1)
    assert stop(process) == 0
    assert (tmp_path / "log").read_text().splitlines() == ["here", "closed"]


def test_calibration_is_saved_and_loaded(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    with Running(tmp_path) as running:
        poses = running.collect(TransformStamped, graph.CALIBRATION, LATCHED)
        running.start("calibration", reliable=True, calibration_file=file)
        running.start(
            "bag_player",
            bag=BAG,
            rate=8.0,
            reliable=True,
            wait_for_subscribers='["/kinect1/skeleton", "/kinect2/skeleton"]',
        )
        assert running.until(lambda: running.processes["bag_player"].poll() is not None, timeout=30.0)
        # The player has sent everything, the calibration may still be at work on it.
        assert running.until(lambda: any("kinect2" in pose.child_frame_id for pose in poses), timeout=30.0)
        assert stop(running.processes["calibration"]) == 0
        assert running.log("calibration").count(f"{file}: written") == 1
    result = load(file)
    assert result.reference == "kinect1"
    assert set(result.poses) == {"kinect1", "kinect2"}
    with Running(tmp_path) as running:
        running.start("calibration", calibration_file=file)
        poses = running.collect(TransformStamped, graph.CALIBRATION, LATCHED)
        clocks = running.collect(TimeReference, graph.CALIBRATION_CLOCK, LATCHED)
        come = running.until(lambda: len({pose.child_frame_id for pose in poses}) == 2 and clocks, timeout=60.0)
        assert come, (poses, clocks, running.log("calibration"), running.diagnostics)
        assert running.until(lambda: f"{file}: loaded" in running.log("calibration"))
        loaded = {pose.child_frame_id: pose.transform.translation for pose in poses}
        assert loaded["kinect2_optical_frame"].x == pytest.approx(result.poses["kinect2"].translation[0])
        assert clocks[0].source == "kinect2"


def test_a_reliable_graph_takes_a_sensor_that_publishes_best_effort(tmp_path: Path) -> None:
    """``up --reliable --external``: a sensor of another package, which starts after the nodes."""
    readers: dict[str, dict[str, object]] = {
        "fusion": {},
        "calibration": {},
        "robot_commands": {"mapping": BAG.parents[1] / "config" / "robots" / "two_joint_arm.yaml"},
    }
    frame = recorded("kinect1")[0]
    with Running(tmp_path) as running:
        for name, more in readers.items():
            running.start(name, reliable=True, sensors="[kinect1, kinect2]", **more)
        assert running.until(lambda: readers.keys() <= running.diagnostics.keys(), 60.0)
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        sensor = running.node.create_publisher(PointCloud2, graph.skeleton_topic("kinect1"), best_effort)

        def publish() -> bool:
            sensor.publish(skeletons_to_cloud([replace(frame, stamp_ns=time.time_ns())], ROS))
            return all("rate in /kinect1/skeleton" in running.said(name) for name in readers)

        assert running.until(publish, 30.0)
