"""``robot_commands`` never follows stale, foreign or doubled angles, and begins at the robot's position."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from bench_node import BenchNode  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from running import RELIABLE  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2  # noqa: E402
from std_msgs.msg import Float64MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking.core.joint_angles import JointAngles  # noqa: E402
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton  # noqa: E402
from body_tracking.kinematics.conventions import angle_names  # noqa: E402
from body_tracking.messages.angles import angles_to_joint_states  # noqa: E402
from body_tracking.messages.cdr import encode_skeletons  # noqa: E402
from body_tracking.nodes.robot_commands import RobotCommands  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.ros.executor import LeanExecutor  # noqa: E402
from body_tracking.ros.wire import ROS  # noqa: E402
from domains import domain  # noqa: E402
from spinning import spin_until  # noqa: E402

RATE = 2.0
"""rad/s of the arm's joint."""
ANGLE = {"isb": "shoulder_elevation_left", "positional": "shoulder_elevation_left"}
ROBOTS = {
    # name: whether the robot publishes its position
    "stale": True,
    "clock": True,
    "convention": True,
    "names": True,
    "doubled": True,
    "standstill": True,
    "unknown": False,
    "angles": True,
    "twin": True,
    "frames": True,
    "remapped": True,
}
REMAPPED = ("/remapped/values", "/remapped/deviations")
"""Topics of the angles of the robot "remapped"; by name the deviations come first."""


def mapping(name: str, folder: Path, *, state: bool) -> Path:
    """A mapping file of one joint that follows the left shoulder's elevation."""
    joint = {"name": "shoulder", "angle": ANGLE["isb"], "lower": -2.5, "upper": 2.5, "rate": RATE, "home": 0.0}
    output = {"kind": "float64_multi_array", "topic": f"/{name}/commands", "order": ["shoulder"]}
    if state:
        output["state_topic"] = f"/{name}/joint_states"
    # tolerant of a busy machine: these tests are about other faults than a short silence
    safety = {
        "calibration": False,
        "silence": 1.0,
        "max_age": 2.0,
        "recover_after": 0.2,
        "approach": 0.5,
        "stop_after": 0.5,
    }
    content = {"robot": name, "convention": "isb", "output": output, "joints": [joint], "safety": safety}
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(content))
    return file


def topics_of(body: str) -> tuple[str, str]:
    """The topics of a person's angles and of their standard deviations."""
    return graph.joint_states_topic(body), graph.joint_states_stddev_topic(body)


class Robot:
    """One arm with its node, and the angles of the person that it follows.

    Attributes:
        angle: radians, the person's.
        age: seconds, of the angles when they are sent.
        convention: of the angles.
        names: of the angles.
        doubled: whether a second publisher sends the opposite angle.
        second_states: a second publisher of the arm's position.
        position: of the arm, radians; it follows the commands while ``released``.
        commands: received ones, radians.
    """

    def __init__(self, bench: Bench, name: str, node: RobotCommands) -> None:
        self.bench, self.name, self.node = bench, name, node
        self.angle, self.age, self.convention = 0.5, 0.0, "isb"
        self.names: tuple[str, ...] = angle_names("isb")
        self.doubled, self.released = False, True
        self.position = 0.0
        self.commands: list[float] = []
        kinds = REMAPPED if name == "remapped" else topics_of(name)
        self.publishers = [[bench.node.create_publisher(JointState, topic, 10) for topic in kinds] for _ in range(2)]
        self.second_states: Any = None
        self.states = bench.node.create_publisher(JointState, f"/{name}/joint_states", 10)
        bench.node.create_subscription(Float64MultiArray, f"/{name}/commands", self._on_command, RELIABLE)

    def _on_command(self, message: Float64MultiArray) -> None:
        self.commands.append(message.data[0])
        if self.released:
            self.position = message.data[0]

    def said(self) -> str:
        """Its state and the reason, from the diagnostics."""
        return str(self.node.state()[1])

    def publish(self, now_ns: int) -> None:
        """Publish the person's angles and the arm's position."""
        for publisher in filter(None, (self.states, self.second_states)):
            publisher.publish(JointState(name=["shoulder"], position=[self.position]))
        stamp_ns = now_ns - round(self.age * NANOSECONDS)
        for number, publishers in enumerate(self.publishers[: 1 + self.doubled]):
            position = np.zeros(len(self.names))
            if ANGLE["isb"] in self.names:
                position[self.names.index(ANGLE["isb"])] = -self.angle if number else self.angle
            still, sure = np.zeros_like(position), np.full_like(position, 0.05)
            angles = JointAngles(stamp_ns + number, self.names, position, still, sure, sure)
            messages = angles_to_joint_states(angles, self.name, self.convention, ROS)
            for publisher, message in zip(publishers, messages, strict=True):
                publisher.publish(message)

    def follows(self) -> bool:
        return self.said().startswith("following") and bool(self.commands)

    def until_it_follows(self) -> None:
        """Wait until the arm has the person's angle; enable it again if a standstill of the machine stopped it."""

        def arrived() -> bool:
            return self.follows() and abs(self.commands[-1] - self.angle) < 0.02

        for _ in range(3):
            assert self.bench.until(lambda: arrived() or not self.node.follower.enabled), self.said()
            if arrived():
                return
            self.enable()
        raise AssertionError(self.said())

    def until_it_says(self, *words: str) -> None:
        assert self.bench.until(lambda: all(word in self.said() for word in words)), (words, self.said())

    def is_told_nothing(self) -> bool:
        """Whether no command comes for a second, after those that were on their way."""
        self.bench.go_on(0.5)
        count = len(self.commands)
        self.bench.go_on(1.0)
        return len(self.commands) == count

    def enable(self) -> Any:
        client = self.bench.node.create_client(Trigger, f"/{self.name}/enable")
        future = None
        if client.wait_for_service(10.0):
            future = client.call_async(Trigger.Request())
            self.bench.until(future.done)
        return None if future is None else future.result()


class Bench:
    """All robots, their nodes in a thread each until the next robot's turn, and the inputs of the nodes at 30 Hz."""

    def __init__(self, folder: Path) -> None:
        files = {name: mapping(name, folder, state=state) for name, state in ROBOTS.items()}
        arguments = ["--ros-args"]
        for name in (*ROBOTS, "second"):
            of = "doubled" if name == "second" else name
            arguments += ["-p", f"{name}:mapping:={files[of]}", "-p", f"{name}:body:={of}"]
            arguments += ["-p", f"{name}:sensors:=[kinect1]"]
        for topic, other in zip(topics_of("remapped"), REMAPPED, strict=True):
            arguments += ["-r", f"remapped:{topic.removeprefix('/')}:={other}"]
        rclpy.init(args=arguments, domain_id=domain())
        self.node = BenchNode("bench")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.frames = [self.publisher_of_frames()]
        self.node.create_timer(1.0 / 30.0, self._tell)
        self.running: dict[RobotCommands, tuple[LeanExecutor, threading.Thread]] = {}
        self._robots = {name: Robot(self, name, self.start(name)) for name in ROBOTS}
        self._active: Robot | None = None

    def publisher_of_frames(self) -> Any:
        """A publisher of the sensor's frames."""
        return self.node.create_publisher(PointCloud2, graph.skeleton_topic("kinect1"), 10)

    def robot(self, name: str) -> Robot:
        """A robot that receives angles from now on, instead of the one before, whose node ends."""
        if self._active is not None:
            self.end(self._active.node)
        self._active = self._robots[name]
        return self._active

    def start(self, name: str) -> RobotCommands:
        """A node of this name, in a thread of its own."""
        node: RobotCommands = type("Named", (RobotCommands,), {"NAME": name})()
        executor = LeanExecutor(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        self.running[node] = executor, thread
        return node

    def end(self, node: RobotCommands) -> None:
        """End a node."""
        executor, thread = self.running.pop(node)
        executor.stop()
        thread.join(10.0)
        assert not thread.is_alive()
        node.destroy_node()

    def _tell(self) -> None:
        now_ns = time.time_ns()
        body = Skeleton(now_ns, "kinect1_optical_frame", np.ones((25, 3)), np.full(25, 2, np.uint8))
        for publisher in self.frames:
            publisher.publish(encode_skeletons([body]))
        if self._active is not None:
            self._active.publish(now_ns)

    def until(self, condition: Callable[[], object], timeout: float = 30.0) -> bool:
        return spin_until(self.executor, condition, timeout)

    def go_on(self, seconds: float) -> None:
        self.until(lambda: False, seconds)

    def close(self) -> None:
        for node in tuple(self.running):
            self.end(node)
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    made = Bench(tmp_path_factory.mktemp("robots"))
    yield made
    made.close()
    monkeypatch.undo()


# --- H1: stale angles


def test_angles_of_ros_time_are_stale_however_old_they_are_at_the_start(bench: Bench) -> None:
    robot = bench.robot("stale")
    for age in (12.0, 600.0):
        robot.age = age
        robot.until_it_says("stopped", f"angles are {age:.0f}")
        bench.go_on(1.0)
        assert robot.commands == []
    robot.age = 0.0
    robot.until_it_follows()


def test_stamps_by_another_clock_stop_the_robot(bench: Bench) -> None:
    robot = bench.robot("clock")
    robot.until_it_follows()
    robot.age = time.time() - 40.0  # from now on stamps count from a start, as a Kinect's do
    robot.angle = 1.5
    robot.until_it_says("stopped", "not in ROS time")
    assert robot.is_told_nothing()
    assert max(robot.commands) < 0.6
    # nor can a person make it follow them
    assert robot.enable().success
    robot.until_it_says("stopped", "not in ROS time")
    assert robot.is_told_nothing()
    robot.age = 0.0
    robot.until_it_follows()


# --- H2: foreign angles


def test_angles_of_another_convention_are_refused(bench: Bench) -> None:
    robot = bench.robot("convention")
    robot.until_it_follows()
    robot.convention, robot.names, robot.angle = "positional", angle_names("positional"), -0.5
    robot.until_it_says("stopped", "convention 'positional'", "'isb'")
    assert min(robot.commands) > -0.02
    robot.convention, robot.names = "", angle_names("isb")
    robot.until_it_says("convention", "empty")
    assert robot.is_told_nothing()
    robot.convention = "isb"
    robot.until_it_follows()


def test_angles_with_other_names_are_refused(bench: Bench) -> None:
    robot = bench.robot("names")
    robot.until_it_follows()
    robot.names, robot.angle = angle_names("isb")[:-1], -0.5
    robot.until_it_says("stopped", angle_names("isb")[-1])
    robot.names = (*angle_names("isb"), "tail")
    robot.until_it_says("stopped", "tail")
    robot.names = angle_names("isb")[::-1]
    robot.until_it_says("stopped", "order")
    assert min(robot.commands) > -0.02


def test_angles_of_remapped_topics_are_not_their_deviations(bench: Bench) -> None:
    robot = bench.robot("remapped")
    robot.until_it_follows()


# --- H3: doubled commands and doubled angles


def test_two_commanders_of_one_robot_both_stop(bench: Bench) -> None:
    robot = bench.robot("doubled")
    robot.until_it_follows()
    second = bench.start("second")
    assert bench.until(lambda: "another publisher of /doubled/commands" in robot.said()), robot.said()
    assert bench.until(lambda: "another publisher of /doubled/commands" in str(second.state()[1])), second.state()
    assert robot.is_told_nothing()
    assert "/second" in robot.said() and "/doubled" in str(second.state()[1])
    bench.end(second)
    robot.until_it_follows()


def test_angles_of_two_alternating_publishers_are_refused(bench: Bench) -> None:
    robot = bench.robot("angles")
    robot.until_it_follows()
    robot.doubled = True
    robot.until_it_says("stopped", "angles of another publisher than before")
    # on a busy machine messages of only one of the two may arrive for a while, which cannot be detected
    assert any(robot.is_told_nothing() for _ in range(4))
    assert min(robot.commands) > -0.1  # and the other one was never followed
    robot.doubled = False
    robot.until_it_follows()


def test_angles_are_not_followed_while_two_sensors_publish_on_one_topic(bench: Bench) -> None:
    robot = bench.robot("frames")
    robot.until_it_follows()
    second = bench.publisher_of_frames()
    bench.frames.append(second)
    robot.until_it_says("stopped", "/kinect1/skeleton: frames of another publisher than before")
    assert any(robot.is_told_nothing() for _ in range(4))  # a busy machine may deliver only those of one for a while
    bench.frames.remove(second)
    bench.node.destroy_publisher(second)
    robot.until_it_follows()


def test_joint_states_of_two_robots_on_one_topic_are_refused(bench: Bench) -> None:
    robot = bench.robot("twin")
    robot.until_it_follows()
    robot.second_states = bench.node.create_publisher(JointState, "/twin/joint_states", 10)
    robot.until_it_says("stopped", "/twin/joint_states: joint states of another publisher than before")
    assert any(robot.is_told_nothing() for _ in range(4))  # a busy machine may deliver only those of one for a while
    robot.second_states = None
    robot.until_it_follows()


# --- H4: a robot that does not move


def largest_lead(robot: Robot) -> float:
    return float(np.abs(np.array(robot.commands) - robot.position).max(initial=0.0))


def test_commands_do_not_run_on_while_the_robot_stands_still(bench: Bench) -> None:
    robot = bench.robot("standstill")
    robot.until_it_follows()
    robot.released = False
    stood = robot.position
    robot.commands.clear()
    robot.angle = 2.0  # the way there is 1.5 rad
    assert bench.until(lambda: "from its command" in robot.said()), robot.said()
    bench.go_on(4.0)  # it may try again
    assert largest_lead(robot) < 0.35
    # moved by hand meanwhile
    robot.position = stood - 0.4
    assert bench.until(lambda: abs(robot.commands[-1] - robot.position) < 0.1, 20.0)
    robot.commands.clear()
    robot.released = True
    robot.until_it_follows()
    commands: FloatArray = np.array([stood - 0.4, *robot.commands])
    assert np.abs(np.diff(commands)).max() < 0.35


# --- H5: the robot's position is unknown


def test_robot_without_state_topic_waits_for_the_enable_service(bench: Bench) -> None:
    robot = bench.robot("unknown")
    robot.until_it_says("stopped", "waits for a person", "enable", "home")
    bench.go_on(2.0)
    assert robot.commands == []
    assert robot.enable().success
    robot.until_it_follows()
    answer = robot.enable()
    assert not answer.success and "following" in answer.message
