"""The doctor in real ROS domains: one with a node that has most faults, an empty one, and no ROS at all."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from running import environment  # noqa: E402
from sensor_msgs.msg import Imu, PointCloud2  # noqa: E402

from body_tracking.core.message_types import IMU, POINT_CLOUD  # noqa: E402
from body_tracking.core.qos import RELIABLE, SENSOR_DATA  # noqa: E402
from body_tracking.core.skeleton import N_JOINTS, Skeleton  # noqa: E402
from body_tracking.messages.base import RosMessages  # noqa: E402
from body_tracking.messages.skeletons import skeletons_to_cloud  # noqa: E402
from body_tracking.ros import doctor_live as live  # noqa: E402
from body_tracking.ros.bag_topics import to_profile  # noqa: E402
from body_tracking.ros.doctor import OK, PROBLEM, WARNING, Finding, client_library  # noqa: E402

NOW = 1.8e9
"""A time in seconds, in this decade."""


def skeleton() -> PointCloud2:
    body = Skeleton(time.time_ns(), "kinect", np.zeros((N_JOINTS, 3)), np.full(N_JOINTS, 2, np.uint8))
    return skeletons_to_cloud((body,), RosMessages())


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ROS domain of its own."""
    for name, value in environment().items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def bench(domain: None) -> Iterator[Any]:
    """A node with a thread that handles its callbacks."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node, executor = rclpy.create_node("bench", context=context), SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = Thread(target=executor.spin)
    thread.start()
    yield node
    executor.shutdown()
    thread.join()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_faults_of_a_graph_are_reported(bench: Any) -> None:
    def publish(kind: type, topic: str, hertz: float, make: Callable[[], Any], qos: Any = 10) -> None:
        publisher = bench.create_publisher(kind, topic, qos)
        bench.create_timer(1.0 / hertz, lambda: publisher.publish(make()))

    for topic in ("/kinect1/skeleton", "/kinect2/skeleton", "/kinect5/skeleton"):
        publish(PointCloud2, topic, 30.0, skeleton, to_profile(SENSOR_DATA))
    bench.create_publisher(PointCloud2, "/kinect2/skeleton", 10)
    publish(PointCloud2, "/kinect3/skeleton", 10.0, PointCloud2)
    bench.create_subscription(PointCloud2, "/kinect5/skeleton", lambda message: None, to_profile(RELIABLE))
    bench.create_subscription(PointCloud2, "/kinect6/skeleton", lambda message: None, 10)
    bench.create_publisher(Imu, "/silent/imu/data", 10)
    watcher = rclpy.create_node("body_tracking_up_1", context=bench.context)  # listens to a clock that is not needed
    watcher.create_subscription(Clock, "/clock", lambda message: None, 10)
    publish(Imu, "/slow/imu/data", 5.0, Imu)
    status = DiagnosticStatus(level=b"\x02", name="bench: stream", message="broken")
    publish(DiagnosticArray, "/diagnostics", 5.0, lambda: DiagnosticArray(status=[status]))

    found = list(live.domain(["kinect1"], 1.5))

    def judged(text: str) -> set[str]:
        return {each.level for each in found if text in each.found and (each.level == OK) == (not each.remedy)}

    watcher.destroy_node()
    assert judged("2 other nodes in this domain") == {OK}, found
    assert not judged("/clock"), found
    assert judged("/kinect1/skeleton from /bench to no subscriber: ") <= {OK, WARNING}, found  # slow, on a busy machine
    assert judged("/kinect2/skeleton: 2 publishers, /bench") == {PROBLEM}, found
    assert judged("/kinect3/skeleton from /bench to no subscriber: malformed") == {PROBLEM}, found
    assert judged("/kinect5/skeleton: nothing goes from bench to bench: ") == {PROBLEM}, found
    assert judged("/kinect6/skeleton: no publisher, wanted by /bench") == {PROBLEM}, found
    assert judged("/silent/imu/data from /bench to no subscriber: nothing came") == {PROBLEM}, found
    assert judged("/slow/imu/data from /bench to no subscriber: ") == {WARNING}, found
    assert judged("bench: stream: broken") == {PROBLEM}, found


@pytest.mark.parametrize(
    ("kind", "hertz", "stamp", "age", "level", "said"),
    [
        (POINT_CLOUD, 30.0, NOW, 0.02, OK, "30.0 Hz, stamps 0.02 s old"),
        (POINT_CLOUD, 30.0, 60.0, NOW, WARNING, "must stamp in ROS time"),
        (POINT_CLOUD, 15.0, NOW, 0.02, WARNING, "should have 20 Hz"),
        (IMU, 30.0, NOW, 0.02, WARNING, "should have 50 Hz"),
        (POINT_CLOUD, 30.0, NOW, 3.0, WARNING, "synchronise"),
        (POINT_CLOUD, 30.0, NOW, -3.0, WARNING, "synchronise"),
    ],
)
def test_rate_and_stamps_are_judged(kind: str, hertz: float, stamp: float, age: float, level: str, said: str) -> None:
    found = live.stream("/topic", kind, [(number / hertz, stamp, age) for number in range(30)])
    assert found.level == level
    assert said in found.found + found.remedy


def test_doctor_waits_for_a_late_sensor(bench: Any) -> None:
    def begin() -> None:
        timer.cancel()
        publisher = bench.create_publisher(PointCloud2, "/kinect1/skeleton", 10)
        bench.create_timer(0.02, lambda: publisher.publish(skeleton()))

    timer = bench.create_timer(1.0, begin)
    found = list(live.domain(["kinect1"], 0.5))
    assert [each for each in found if each.found.startswith("/kinect1/skeleton from /bench to no subscriber: ")], found


def test_empty_domain_and_absent_sensor_are_reported(domain: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "PATIENCE", 0.0)
    found = [(each.level, each.found) for each in live.domain(["kinect4"], 0.5)]
    assert found == [(WARNING, "0 other nodes in this domain"), (PROBLEM, "/kinect4/skeleton: no publisher")]


def test_a_client_library_that_ends_its_process_is_a_finding(domain: None, monkeypatch: pytest.MonkeyPatch) -> None:
    assert client_library() == Finding(OK, "rclpy works, on rmw_fastrtps_cpp")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    found = client_library()
    assert found.level == PROBLEM
    assert "rmw_cyclonedds_cpp" in found.found
    assert "unset RMW_IMPLEMENTATION" in found.remedy


def test_where_nothing_comes_a_paused_bag_may_be_the_reason() -> None:
    assert "a bag paused?" in live.stream("/kinect1/skeleton from /bag_player", POINT_CLOUD, []).remedy
