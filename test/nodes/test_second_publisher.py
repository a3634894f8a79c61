"""Topics with two publishers: every subscriber reports them; a second ``up`` ends."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from running import RELIABLE, environment, stop  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2  # noqa: E402

from body_tracking.core.qos import LATCHED  # noqa: E402
from body_tracking.core.skeleton import Skeleton  # noqa: E402
from body_tracking.messages.cdr import encode_skeletons  # noqa: E402
from body_tracking.messages.diagnostics import statuses  # noqa: E402
from body_tracking.messages.node_status import NodeStatus  # noqa: E402
from body_tracking.nodes.bag_recorder import BagRecorder  # noqa: E402
from body_tracking.nodes.body_markers import BodyMarkers  # noqa: E402
from body_tracking.nodes.robot_commands import RobotCommands  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.ros import up  # noqa: E402
from body_tracking.ros.bag_topics import to_profile  # noqa: E402
from body_tracking.ros.graph_monitor import GraphMonitor  # noqa: E402
from body_tracking.ros.host import node_of  # noqa: E402
from body_tracking.systems import options_of  # noqa: E402
from spinning import spin_until  # noqa: E402

ROBOT = Path(__file__).resolve().parents[2] / "config" / "robots" / "two_joint_arm.yaml"
SENSOR = graph.skeleton_topic("kinect1")
ANGLES = graph.joint_states_topic("body1")
NODES = (BagRecorder, BodyMarkers, RobotCommands, *map(node_of, ("calibration", "fusion", "skeleton_filter")))
READERS = {
    "calibration": {SENSOR},
    "fusion": {SENSOR, graph.CALIBRATION},
    "skeleton_filter": {SENSOR, graph.CALIBRATION},
    "body_markers": {SENSOR, graph.CALIBRATION},
    "robot_commands": {SENSOR, graph.CALIBRATION, ANGLES},
    "bag_recorder": {SENSOR, graph.CALIBRATION, ANGLES},
}
"""The topics of each node; the viewer, which would slow this process down, has the same base class."""


class Readers:
    """All of them in one process, two nodes that publish, and the latest diagnostics by node."""

    def __init__(self, folder: Path) -> None:
        given = {"robot_commands:mapping": ROBOT, "skeleton_filter:filter": "ekf", "bag_recorder:folder": folder}
        words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
        rclpy.init(args=["--ros-args", *words], domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self.one, self.two, self.same = (rclpy.create_node(name) for name in ("one", "two", "one"))
        self.latest: dict[str, NodeStatus] = {}
        self.one.create_subscription(DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self._on_diagnostics, RELIABLE)
        self.nodes = [kind() for kind in NODES]
        self.executor = SingleThreadedExecutor()
        for node in (self.one, self.two, self.same, *self.nodes):
            self.executor.add_node(node)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.latest |= {status.node: status for status in statuses(message)}

    def doubled(self) -> list[str]:
        """The topics with several publishers, by the diagnostics."""
        return [key for status in self.latest.values() for key in status.values if key.startswith("publishers ")]

    def until(self, condition: Callable[[], object], timeout: float = 30.0) -> bool:
        return spin_until(self.executor, condition, timeout)

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.close()
        for node in (self.one, self.two, self.same):
            node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def readers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Readers]:
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    made = Readers(tmp_path / "bag")
    yield made
    made.close()


def test_every_subscriber_reports_a_second_publisher(readers: Readers) -> None:
    readers.one.create_publisher(PointCloud2, SENSOR, to_profile(graph.SKELETON))
    readers.one.create_publisher(JointState, ANGLES, 10)
    latest = readers.latest
    assert readers.until(lambda: READERS.keys() <= latest.keys())
    readers.until(lambda: False, 1.5)
    assert not readers.doubled()
    added = [
        readers.two.create_publisher(PointCloud2, SENSOR, to_profile(graph.SKELETON)),
        readers.two.create_publisher(JointState, ANGLES, 10),
        readers.two.create_publisher(TransformStamped, graph.CALIBRATION, to_profile(LATCHED)),
    ]
    expected = {SENSOR: "/one, /two", graph.CALIBRATION: "/calibration, /two", ANGLES: "/one, /two"}

    def named() -> bool:
        return all(
            latest[name].values.get(f"publishers {topic}") == expected[topic]
            and f"2 publishers of {topic}: {expected[topic]}" in latest[name].text
            and latest[name].level >= 1
            for name, topics in READERS.items()
            for topic in topics
        )

    assert readers.until(named), latest
    for publisher in added:
        readers.two.destroy_publisher(publisher)
    assert readers.until(lambda: not readers.doubled()), latest


def test_restarted_publisher_is_not_a_second_one_but_two_active_ones_are(readers: Readers) -> None:
    profile = to_profile(graph.SKELETON)
    both = [node.create_publisher(PointCloud2, SENSOR, profile) for node in (readers.one, readers.same)]
    cloud = encode_skeletons([Skeleton(5, "kinect1_optical_frame", np.ones((25, 3)), np.full(25, 2, np.uint8))])
    assert readers.until(lambda: READERS.keys() <= readers.latest.keys())
    # all messages of the first one were received before the second started
    for publisher in both:
        for _ in range(30):
            publisher.publish(cloud)
            readers.executor.spin_once(timeout_sec=0.05)
    readers.until(lambda: False, 2.5)
    assert not readers.doubled()
    timer = readers.two.create_timer(0.05, lambda: [publisher.publish(cloud) for publisher in both])
    assert readers.until(lambda: readers.latest["fusion"].values.get(f"publishers {SENSOR}") == "/one, /one"), (
        readers.latest
    )
    readers.two.destroy_timer(timer)


def test_second_up_in_a_domain_ends_with_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = environment()
    for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(name, found[name])
    first = GraphMonitor([graph.joint_states_topic("body1")])  # the node of a ``body_tracking up``
    command = [sys.executable, "-m", "body_tracking.cli", "up", "--external", "--log-dir", str(tmp_path)]
    second = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=found)
    try:
        _, stderr = second.communicate(timeout=60.0)
        assert second.returncode == 2
        assert stderr.splitlines() == [
            f"body_tracking: another body_tracking up runs in ROS domain {found['ROS_DOMAIN_ID']} already, and the two "
            "would mix; end it, or give this one another ROS_DOMAIN_ID"
        ]
        assert not first.has_predecessor()
    finally:
        stop(second)
        first.close()


@pytest.mark.parametrize("late", [False, True])
def test_one_of_two_simultaneous_ups_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, late: bool) -> None:
    """The other one ends; it leaves no recording, unless it ran for longer before it discovered the first."""
    for name, value in environment().items():
        monkeypatch.setenv(name, value)
    monitors = [GraphMonitor([graph.joint_states_topic("body1")]) for _ in range(2)]
    end = time.monotonic() + 30.0
    while not monitors[1].has_predecessor() and time.monotonic() < end:
        time.sleep(0.05)
    assert [each.has_predecessor() for each in monitors] == [False, True]
    recording = tmp_path / "recording"
    recording.mkdir()
    if late:
        monkeypatch.setattr(up, "NOTHING_RECORDED", 0.0)
    second = up.Supervisor(options_of(record=recording), (), {}, tmp_path)
    second.run(monitors[1])
    assert "another body_tracking up runs" in second.failure
    assert recording.exists() == late
    monitors[0].close()
    monitors[1].close()
