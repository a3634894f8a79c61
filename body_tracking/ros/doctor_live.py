"""Checks of the ROS domain: publishers and subscribers of each topic, received messages, and status of the nodes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from statistics import median
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from body_tracking.core import names
from body_tracking.core.message_types import IMU, POINT_CLOUD, SEGMENTS
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinect.ros_time import OTHER_CLOCK_NS
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.node_status import NodeStatus
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.ros.bag_topics import message_class
from body_tracking.ros.doctor import LEAST_RATE, OK, PROBLEM, WARNING, Finding

PATIENCE = 10.0
"""Seconds for a required sensor to begin."""
OLD = 0.5
"""Seconds; a greater age of a stamp means another clock, not a delay."""
_WATCHERS = ("body_tracking_doctor_", "body_tracking_up_")
_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


class Listener(Node):
    """Subscribes to the sensors, the skeletons and the angles that are published."""

    def __init__(self) -> None:
        super().__init__(f"{_WATCHERS[0]}{time.time_ns()}")
        self.came: dict[str, list[tuple[float, float, float]]] = {}
        """By topic: steady time of receipt, stamp and age of each message, seconds; age by ``/clock`` if it exists."""
        self.malformed: dict[str, str] = {}
        self.statuses: dict[str, NodeStatus] = {}
        self._clock_ns = 0
        self.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, _QOS)
        self.create_subscription(Clock, names.CLOCK, self._on_clock, _QOS)
        self.create_timer(0.3, self._look)

    def _look(self) -> None:
        """Subscribe to new topics."""
        for topic, (kind, *_) in self.get_topic_names_and_types():
            wanted = kind == IMU or (kind in LEAST_RATE and graph.has_one_publisher(topic))
            if wanted and topic not in self.came and self.count_publishers(topic):
                self.came[topic] = []
                self.create_subscription(message_class(kind), topic, partial(self._on_message, topic), _QOS)

    def _on_diagnostics(self, message: Any) -> None:
        self.statuses |= {status.name: status for status in statuses(message)}

    def _on_clock(self, message: Any) -> None:
        self._clock_ns = 1_000_000_000 * message.clock.sec + message.clock.nanosec

    def _on_message(self, topic: str, message: Any) -> None:
        try:
            stamp_ns = to_nanoseconds(message.header.stamp)
            if topic.endswith(graph.SKELETON_SUFFIX):
                cloud_to_skeletons(message)
        except MessageError as error:
            self.malformed[topic] = str(error)
            return
        age_ns = (self._clock_ns or time.time_ns()) - stamp_ns
        self.came[topic].append((time.monotonic(), stamp_ns / 1e9, age_ns / 1e9))


def domain(sensors: Sequence[str], seconds: float = 3.0) -> Iterator[Finding]:
    """Findings after receiving for some seconds, which begin when all required sensors have begun."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node, wanted = Listener(), {graph.skeleton_topic(sensor) for sensor in sensors}
    try:
        began = now = time.monotonic()
        end = began + seconds
        while now < end:
            rclpy.spin_once(node, timeout_sec=0.1)
            now = time.monotonic()
            if not all(map(node.came.get, wanted)):
                end = min(now, began + PATIENCE) + seconds
        others = set(node.get_node_names()) - {node.get_name()}
        remedy = "start body_tracking up; where it runs, compare env | grep ROS_ there, and look for firewall and VPN"
        found = f"{len(others)} other node{'' if len(others) == 1 else 's'} in this domain"
        yield Finding(OK if others else WARNING, found, "" if others else remedy)
        topics = dict.fromkeys(wanted, ()) | dict(node.get_topic_names_and_types())
        for topic in sorted(topics.keys() - names.WHOLE_DOMAIN | {names.CLOCK}):
            yield from _topic(node, topic, topics[topic], topic in wanted)
        for name, status in sorted(node.statuses.items()):
            remedy = "docs/troubleshooting.md has these texts; the node's log says more" if status.level else ""
            yield Finding((OK, WARNING, PROBLEM)[min(status.level, 2)], f"{name}: {status.text}", remedy)
    finally:
        node.destroy_node()
        rclpy.shutdown()


def _topic(node: Listener, topic: str, kinds: Sequence[str], wanted: bool) -> Iterator[Finding]:
    publishers = node.get_publishers_info_by_topic(topic)
    readers = [each for each in node.get_subscriptions_info_by_topic(topic) if not each.node_name.startswith(_WATCHERS)]
    by, to = (
        ", ".join(sorted({f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in side})) or "no subscriber"
        for side in (publishers, readers)
    )
    if not publishers:
        if wanted or (readers and SEGMENTS not in kinds):  # only filters with a body model publish segments
            remedy = "start its publisher; where it runs, compare env | grep ROS_ in both shells"
            source = wanted or topic == names.CLOCK or kinds[0] in (POINT_CLOUD, IMU)
            found = f"{topic}: no publisher" + (f", wanted by {to}" if readers else "")
            yield Finding(PROBLEM if source else WARNING, found, remedy)
        return
    if len(publishers) > 1 and graph.has_one_publisher(topic):
        remedy = f"end all but one of these nodes (where ros2 is there, ros2 topic info -v {topic} says more)"
        yield Finding(PROBLEM, f"{topic}: {len(publishers)} publishers, {by}", remedy)
    for publisher, reader in product(publishers, readers):
        compatible, reason = qos_check_compatible(publisher.qos_profile, reader.qos_profile)
        if compatible == QoSCompatibility.ERROR:
            found = f"{topic}: nothing goes from {publisher.node_name} to {reader.node_name}: {reason.strip()}"
            yield Finding(PROBLEM, found, f"offer what the reader asks for: ros2 topic info -v {topic}")
    text = f"{topic} from {by} to {to}"
    if topic in node.malformed:
        remedy = "its publisher must send the fields that docs/your_own_sensor.md lists"
        yield Finding(PROBLEM, f"{text}: malformed: {node.malformed[topic]}", remedy)
    elif topic in node.came:
        yield stream(text, kinds[0], node.came[topic])
    else:
        yield Finding(OK, text)


def stream(text: str, kind: str, came: Sequence[tuple[float, float, float]]) -> Finding:
    """Rate and stamps of received messages (:attr:`Listener.came`), compared with the least rate of their type."""
    if not came:
        remedy = "is a person in view, the sensor on, or a bag paused? Between containers: "
        remedy += "export FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
        return Finding(PROBLEM if kind == IMU else WARNING, f"{text}: nothing came", remedy)
    times, _, ages = zip(*came, strict=True)
    rate = (len(came) - 1) / max(times[-1] - times[0], 1e-3)
    age = median(ages)
    text += f": {rate:.1f} Hz, stamps {age:.2f} s old"
    remedy = ""
    if rate < LEAST_RATE[kind]:
        remedy = f"it should have {LEAST_RATE[kind]:.0f} Hz: more light, USB 3, the driver's settings, less load"
    elif abs(age) > OTHER_CLOCK_NS / NANOSECONDS:
        remedy = "its driver must stamp in ROS time: docs/your_own_sensor.md (right for a recording without /clock)"
    elif abs(age) > OLD:
        remedy = "synchronise the clocks: sudo timedatectl set-ntp true (right for a recording without /clock)"
    return Finding(WARNING if remedy else OK, text, remedy)
