"""No message ends a node or lets its memory grow without bound."""

from __future__ import annotations

import contextlib
import random
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from hostile import class_of, hostile, message  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from running import LATCHED, RELIABLE, ROOT, Running, recorded, refusal, stop  # noqa: E402
from sensor_msgs.msg import Image, Imu, JointState, PointCloud2, TimeReference  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from body_tracking.core.clocks import ClockModel  # noqa: E402
from body_tracking.core.sensor_poses import level_pose  # noqa: E402
from body_tracking.core.skeleton import NANOSECONDS, Skeleton  # noqa: E402
from body_tracking.kinematics.conventions import angle_names  # noqa: E402
from body_tracking.kinematics.upper_body import UpperBody  # noqa: E402
from body_tracking.messages.base import MessageError, RosMessages, to_nanoseconds  # noqa: E402
from body_tracking.messages.calibration import clock_to_time_reference, pose_to_transform  # noqa: E402
from body_tracking.messages.skeletons import skeletons_to_cloud  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT  # noqa: E402
from body_tracking.pipeline.stage import Output, Stage  # noqa: E402
from body_tracking.recording.rosbag2 import BagReader  # noqa: E402
from body_tracking.ros.executor import LeanExecutor  # noqa: E402
from body_tracking.ros.host import StageNode, node_of  # noqa: E402
from body_tracking.ros.node import STEADY, GraphNode, RCLError  # noqa: E402
from domains import domain  # noqa: E402
from draws import draws  # noqa: E402

ROS = RosMessages()
ROBOT = ROOT / "config" / "robots" / "two_joint_arm.yaml"
FRAME_NS = 33_333_333
START_NS = 10**12


FRAMES = recorded("kinect1")


# --- clocks


def misstated(sec: int, nanosec: int = 0) -> TimeReference:
    """A message of ``/calibration/clock`` for kinect2 with this stamp and ``time_ref``."""
    reference = TimeReference(source="kinect2")
    reference.header.stamp.sec = reference.time_ref.sec = sec
    reference.header.stamp.nanosec = reference.time_ref.nanosec = nanosec
    return reference


def test_invalid_clocks_and_poses_end_no_node(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        clocks = running.node.create_publisher(TimeReference, graph.CALIBRATION_CLOCK, LATCHED)
        poses = running.node.create_publisher(TransformStamped, graph.CALIBRATION, LATCHED)
        for reference in (misstated(-(2**31)), misstated(5, 4_000_000_000), misstated(-1)):
            clocks.publish(reference)
        far = pose_to_transform(level_pose("kinect2", 1e30), "world", ROS)
        before = pose_to_transform(level_pose("kinect2"), "world", ROS)
        before.header.stamp.sec = -(2**31)
        for transform in (far, before):
            poses.publish(transform)
        nodes = ("fusion", "skeleton_filter")
        running.start("fusion")
        running.start("skeleton_filter", filter="ekf")  # both start after the latched messages
        assert running.until(lambda: all(running.number(node, "malformed") == 5 for node in nodes)), running.diagnostics
        for node in nodes:
            assert running.processes[node].poll() is None
            assert "expected 0 to 2147483647 s" in running.log(node)


def test_fusion_recovers_after_a_wrong_clock_is_corrected(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.start("fusion", reliable=True)
        fused = running.collect(PointCloud2, graph.FUSED)
        sensors = [
            running.node.create_publisher(PointCloud2, graph.skeleton_topic(name), RELIABLE)
            for name in ("kinect1", "kinect2")
        ]
        clocks = running.node.create_publisher(TimeReference, graph.CALIBRATION_CLOCK, LATCHED)
        poses = running.node.create_publisher(TransformStamped, graph.CALIBRATION, LATCHED)
        for name in ("kinect1", "kinect2"):
            poses.publish(pose_to_transform(level_pose(name), "world", ROS))
        assert running.until(lambda: all(each.get_subscription_count() for each in (*sensors, clocks, poses)))

        def play(first: int, seconds: float, streams: tuple[int, ...]) -> None:
            """Frames in their own time, from the number ``first`` on."""
            for number in range(first, first + round(30 * seconds)):
                for stream in streams:
                    body = FRAMES[number % 100]
                    frame = Skeleton(START_NS + number * FRAME_NS, body.frame_id, body.positions, body.states)
                    sensors[stream].publish(skeletons_to_cloud([frame], ROS))
                end = time.monotonic() + FRAME_NS / NANOSECONDS
                running.until(lambda end=end: time.monotonic() > end, 1.0)

        # By this clock the sensor's frames are half an hour later, and its frames come first.
        wrong = ClockModel(-1800 * NANOSECONDS)
        clocks.publish(clock_to_time_reference("kinect2", wrong, 1900 * NANOSECONDS, ROS))
        play(0, 0.5, (1,))
        play(15, 2.0, (0, 1))
        clocks.publish(clock_to_time_reference("kinect2", ClockModel(), 0, ROS))
        play(75, 1.0, (0, 1))
        newest = START_NS + 104 * FRAME_NS
        assert running.until(lambda: fused and to_nanoseconds(fused[-1].header.stamp) == newest), running.diagnostics
        stamps = [to_nanoseconds(each.header.stamp) for each in fused]
        assert max(stamps) > START_NS + 1800 * NANOSECONDS  # it was accepted while there was no other sensor
        assert stamps[-25:] == [START_NS + number * FRAME_NS for number in range(80, 105)]
        assert running.number("fusion", "other_clock") > 0


def test_invalid_simulated_time_is_ignored(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.start("fusion", use_sim_time=True)
        ticks = running.node.create_publisher(Clock, graph.CLOCK_TOPIC, RELIABLE)
        assert running.until(lambda: ticks.get_subscription_count() == 2)

        def malformed() -> int:
            for sec, nanosec in ((100, 0), (-1, 0), (-(2**31), 0), (101, 2_000_000_000), (102, 0)):
                tick = Clock()
                tick.clock.sec, tick.clock.nanosec = sec, nanosec
                ticks.publish(tick)
            return int(running.number("fusion", "malformed"))

        assert running.until(lambda: malformed() >= 3)
        assert running.processes["fusion"].poll() is None
        assert "/clock: malformed message ignored: a stamp of" in running.log("fusion")


def test_recorder_without_clock_records_nothing_and_reports_it(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.start("bag_recorder", folder=tmp_path / "bag", topics="[/text,/latched]", use_sim_time=True)
        texts = running.node.create_publisher(String, "/text", RELIABLE)
        latched = running.node.create_publisher(String, "/latched", LATCHED)
        latched.publish(String(data="latched"))
        assert running.until(lambda: texts.get_subscription_count() and latched.get_subscription_count())

        def left_out() -> int:
            texts.publish(String(data=10_000 * "x"))
            return int(running.number("bag_recorder", "before the clock, not recorded"))

        assert running.until(lambda: left_out() > 100), running.diagnostics
        assert running.said("bag_recorder")[""] == "waiting for /clock (use_sim_time): nothing is recorded"
        assert running.said("bag_recorder")["messages"] == "0"
        # the clock comes: of the earlier messages only the latched ones are recorded
        running.until(lambda: False, 1.5)
        ticks = running.node.create_publisher(Clock, graph.CLOCK_TOPIC, RELIABLE)

        def kept() -> int:
            tick = Clock()
            tick.clock.sec = 100
            ticks.publish(tick)
            texts.publish(String(data="now"))
            return int(running.number("bag_recorder", "messages"))

        assert running.until(lambda: kept() > 3), running.diagnostics
        stop(running.processes["bag_recorder"])
    with BagReader(tmp_path / "bag") as reader:
        found = list(reader.messages())
    assert {raw.log_time_ns for raw in found} == {100 * NANOSECONDS}
    assert [raw.topic for raw in found].count("/latched") == 1
    assert max(len(raw.cdr) for raw in found) < 100


# --- errors of callbacks


class Failing(GraphNode):
    """Raises in the callbacks of a message, a timer and a service."""

    NAME = "failing"
    PARAMETERS = ()

    def start(self) -> None:
        self.restarts = 0
        self.subscribe("/one", String, RELIABLE, self.on_one)
        self.create_timer(0.02, self.on_timer, clock=STEADY)
        self.create_service(Trigger, "~/ask", self.on_ask)

    def on_one(self, message: Any, sent_ns: int) -> None:
        raise {"value": ValueError, "memory": MemoryError, "key": KeyError}[message.data]("on purpose")

    def on_timer(self) -> None:
        raise ZeroDivisionError

    def on_ask(self, request: Any, response: Any) -> Any:
        raise OSError("no disk")

    def restart(self) -> None:
        self.restarts += 1


def test_callback_errors_are_counted_by_input_and_kind(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        rclpy.init(domain_id=running.context.get_domain_id())
        node = Failing()
        executor = LeanExecutor(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        publisher = running.node.create_publisher(String, "/one", RELIABLE)
        assert running.until(lambda: publisher.get_subscription_count() == 1)
        for said in ("value", "value", "memory", *["key"] * 9):
            publisher.publish(String(data=said))
        answer = running.call(Trigger, "/failing/ask", Trigger.Request())
        assert not answer.success
        assert "failed" in answer.message
        wanted = {"raised /one ValueError": 2, "raised /one MemoryError": 1, "raised /one KeyError": 9}
        wanted |= {"raised service ~/ask OSError": 1, "raised timer on_timer ZeroDivisionError": 2}
        counts: dict[str, str] = {}

        def all_counted() -> bool:
            counts.update(running.diagnostics.get("failing", {}))
            return all(int(counts.get(key, 0)) >= count for key, count in wanted.items())

        assert running.until(all_counted), counts
        assert all(counts[key] == str(wanted[key]) for key in wanted if "/one" in key)
        assert "callbacks failed" in counts[""]
        assert thread.is_alive()
        executor.stop()
        thread.join(10.0)
        # ten failures of a callback in a row reset the node, because its state may be the cause
        assert node.restarts == sum(count // 10 for count in node._failed_in_a_row.values())
        assert node._failed_in_a_row["/one"] == 12
        rclpy.try_shutdown()


class Stuck(Stage):
    """Raises whenever it is asked for what waits, but for the first time, and goes on waiting."""

    NAME = "stuck"
    PARAMETERS = (TRANSPORT,)
    polls = 0

    @property
    def deadline_ns(self) -> int | None:
        return 1

    def poll(self, steady_ns: int) -> Iterable[Output]:
        self.polls += 1
        if self.polls == 1:
            return ()
        raise (ValueError if self.values["reliable"] else MessageError)("on purpose")


class StuckNode(StageNode):
    STAGE = Stuck


@pytest.mark.parametrize("reliable", ["true", "false"])
def test_what_waits_and_cannot_be_used_keeps_no_processor_busy(reliable: str) -> None:
    rclpy.init(args=["--ros-args", "-p", f"reliable:={reliable}"], domain_id=domain())
    node = StuckNode()
    executor = LeanExecutor(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    began = time.monotonic()
    time.sleep(1.0)
    while node.stage.polls < 3 and time.monotonic() - began < 30.0:  # a busy computer takes its time
        time.sleep(0.1)
    executor.stop()
    thread.join(10.0)
    assert 2 < node.stage.polls < 15 * (time.monotonic() - began)
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize("executable", ["fusion", "skeleton_filter", "mesh_tracker"])
def test_ten_failures_in_a_row_reset_every_input_of_a_stage_in_any_namespace(
    executable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ValueError("on purpose")

    rclpy.init(args=["--ros-args", "-r", "__ns:=/lab"], domain_id=domain())
    node = node_of(executable)()
    resets: list[str] = []
    monkeypatch.setattr(node.stage, "reset", resets.append)
    for where in (node.full_name(node.stage.inputs[0].topic), "timer poll", "messages"):
        guarded = node.guarded(where, fail)
        for _ in range(9):
            guarded()
        assert resets == []
        guarded()
        assert resets == [port.topic for port in node.stage.inputs]
        resets.clear()
    node.destroy_node()
    rclpy.try_shutdown()


# --- files that rcl would read


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[" * 200_000, "nested deeper than 40"),
        ("/fusion: {ros__parameters: {a: " + "{b: " * 35 + "1" + "}" * 37, "unknown parameter"),
        ("/fusion: {ros__parameters: {silence: " + "9" * 5000 + "}}", "a number of 5000 characters"),
        ("/fusion: {ros__parameters: {silence: &a 0.1, max_wait: *a}}", "an alias in line 1"),
        ("/fusion: {ros__parameters: {sensors: [" + "[a], " * 1000 + "]}}", "a list holds no lists"),
        ("/fusion: {ros__parameters: {? [a]: b}}", "is not YAML"),
    ],
)
def test_hostile_parameters_file_is_refused_in_one_line(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "bad.yaml").write_text(content)
    assert said in refusal(tmp_path, "fusion", "--params-file", str(tmp_path / "bad.yaml"))


# --- at random

NODES: dict[str, dict[str, object]] = {
    "calibration": {"calibration_file": "calibration.yaml"},
    "fusion": {},
    "skeleton_filter": {"filter": "ekf", "orientations": "[forearm_left]"},
    "joint_angles": {"input": "model_state", "convention": "isb"},
    "imu_skeleton": {"segments": "[forearm_left,upper_arm_left]"},
    "skeleton_adapter": {},
    "body_markers": {},
    "robot_commands": {"mapping": ROBOT},
    "viewer": {"port": 0},
    "bag_recorder": {"folder": "bag"},
}
OTHERS: dict[str, tuple[str, dict[str, object]]] = {
    "linear_filter": ("skeleton_filter", {}),
    "other_angles": ("joint_angles", {"input": "skeleton", "convention": "positional"}),
    "simulated_fusion": ("fusion", {"use_sim_time": True}),
}


def right(topic: str, type_name: str) -> Any:
    """A valid message of a topic."""
    kind = class_of(type_name)
    draw = random.Random(topic)
    if kind is PointCloud2:
        return skeletons_to_cloud([draw.choice(FRAMES)], ROS)
    if kind is TransformStamped:
        return pose_to_transform(level_pose("kinect2"), "world", ROS)
    if kind is TimeReference:
        return clock_to_time_reference("kinect2", ClockModel(), START_NS, ROS)
    made = message(draw, kind)
    if hasattr(made, "header"):
        made.header.stamp.sec, made.header.stamp.nanosec, made.header.frame_id = 1000, 0, "isb"
    if kind is JointState:
        model = UpperBody().coordinate_names
        names = list(model if "model" in topic else [f"{each}_body1" for each in angle_names("isb")])
        made.name, made.position, made.velocity, made.effort = names, [0.1] * len(names), [0.0] * len(names), []
    if kind is Imu:
        made.orientation.x = made.orientation.y = made.orientation.z = 0.0
        made.orientation.w = 1.0
        made.orientation_covariance = np.eye(3).ravel() * 1e-3
    if kind is Image:
        count = len(UpperBody().coordinate_names)
        made.height, made.width, made.step, made.encoding = 2 * count, count, 4 * count, "32FC1"
        made.is_bigendian, made.data = 0, np.ones((2 * count, count), "<f4").tobytes()
    if kind is DiagnosticArray:
        values = [KeyValue(key="kinect2 rotation_stddev_deg", value="1.0"), KeyValue(key="reference", value="kinect1")]
        made.status = [DiagnosticStatus(name="calibration: stream", message="good", values=values)]
    if kind is MarkerArray:
        made.markers = [Marker(id=100 + number) for number in range(32)]
    return made


def resident(running: Running) -> dict[str, int]:
    """Bytes of memory that each node has."""
    return {name: psutil.Process(process.pid).memory_info().rss for name, process in running.processes.items()}


GROWTH = {"bag_recorder": 0.15}
"""Allowed growth of memory where it is more than 0.05: each slot of a queue of 1000 keeps its largest message."""


@pytest.mark.parametrize("seed", [1])
def test_no_message_drawn_at_random_ends_a_node_or_takes_memory(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, rate = draws(2_000, 300_000), 1000.0
    # The viewer levels off late: with its topics alone it has 194 MB, 241 after 40,000 messages, 245 after 80,000, 249
    # after 160,000 and 252 after 320,000; it has a third of these topics.
    warm = count * 2 // 3
    monkeypatch.chdir(tmp_path)
    started = time.monotonic()
    with Running(tmp_path) as running:
        for name, parameters in NODES.items():
            running.start(name, **parameters)
        for name, (executable, parameters) in OTHERS.items():
            running.start(executable, name=name, **parameters)

        def listening() -> dict[str, str]:
            found: dict[str, str] = {}
            for name in running.processes:
                with contextlib.suppress(Exception):  # not there yet
                    topics = running.node.get_subscriber_names_and_types_by_node(name, "/")
                    found |= {topic: types[0] for topic, types in topics}
            return found

        assert running.until(lambda: running.diagnostics.keys() >= running.processes.keys(), 60.0), running.diagnostics
        running.until(lambda: False, 3.0)  # the recorder finds topics
        topics = listening()
        assert len(topics) > 25, topics
        qos = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        sender = rclpy.create_node("sender", context=running.context)  # not spun, receives nothing
        publishers = {topic: sender.create_publisher(class_of(kind), topic, qos) for topic, kind in topics.items()}
        rights = {topic: right(topic, kind) for topic, kind in topics.items()}
        print(f"{len(topics)} topics after {time.monotonic() - started:.1f} s")
        draw, begin, before = random.Random(seed), time.monotonic(), resident(running)
        for number in range(count):
            topic = draw.choice(list(publishers))
            with contextlib.suppress(RCLError):  # messages that the middleware refuses to send
                publishers[topic].publish(hostile(draw, rights[topic]))
            if number == warm:
                before = resident(running)
            time.sleep(max(0.0, begin + number / rate - time.monotonic()))
            if number % 500 == 0:
                ended = [name for name, process in running.processes.items() if process.poll() is not None]
                assert not ended, (number, running.log(ended[0])[-3000:])
        time.sleep(1.0)
        after = resident(running)
        for name, process in running.processes.items():
            assert process.poll() is None, running.log(name)[-3000:]
        grown = {name: after[name] / before[name] - 1.0 for name in after}
        print(f"{count} messages in {time.monotonic() - begin:.0f} s, on {len(topics)} topics; grown by", grown)
        raised = {
            name: {
                line.split("callback")[0][-80:] for line in running.log(name).splitlines() if "in a callback" in line
            }
            for name in running.processes
        }
        print({name: lines for name, lines in raised.items() if lines})
        if count > 100_000:  # of fewer, many would be the first of their kind
            assert all(more < GROWTH.get(name, 0.05) for name, more in grown.items()), grown


def test_malformed_clouds_at_500_a_second_leave_memory_flat(tmp_path: Path) -> None:
    count = draws(900, 30_000)
    bodies = [Skeleton(START_NS, "kinect1", each.positions, each.states, 7) for each in FRAMES[:1]]
    cut, big, short, none = (skeletons_to_cloud(bodies, ROS) for _ in range(4))
    cut.data, big.is_bigendian, short.fields, none.width = bytes(cut.data)[:-1], True, short.fields[:3], 0
    kinds = (cut, big, short, none, b"\x00\x01\x00\x00garbage", bytes(serialize_message(cut))[:-300])
    with Running(tmp_path) as running:
        for name in ("fusion", "body_markers"):  # one reads bytes, the other messages
            running.start(name, reliable=True) if name == "fusion" else running.start(name)
        clouds = running.node.create_publisher(PointCloud2, graph.skeleton_topic("kinect1"), RELIABLE)
        assert running.until(lambda: clouds.get_subscription_count() == 2 and running.said("fusion"), 60.0)
        sizes = []
        for part in (range(count // 3), range(count // 3, count)):
            begin = time.monotonic()
            for number in part:
                clouds.publish(kinds[number % len(kinds)])
                end = begin + (number - part.start) / 500.0
                running.executor.spin_once(timeout_sec=max(0.0, end - time.monotonic()))
                time.sleep(max(0.0, end - time.monotonic()))
            # of nodes that have taken all of them: a busy machine leaves messages in queues
            assert running.until(lambda: running.number("fusion", "malformed") == part.stop, 60.0)  # noqa: B023
            sizes.append(resident(running))
        before, after = sizes
        assert all(after[name] - before[name] < 1 << 20 for name in after), (before, after)
