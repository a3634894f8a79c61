"""The processes by which ``body_tracking doctor`` looks at ROS: one speaks, one listens and prints what it saw.

``python -m body_tracking.nodes.doctor_probe speak TOKEN SECONDS`` and ``... listen TOKEN SECONDS PATIENCE TOPIC...``;
the latter prints an :class:`~body_tracking.doctor.live.Observation` as JSON.
"""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import Float64

from body_tracking import dds, graph, names
from body_tracking.cdr import decode_skeletons
from body_tracking.doctor.live import Observation, Stream
from body_tracking.messages.base import IMU, POINT_CLOUD, to_nanoseconds
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.node_status import NodeStatus

_LOOK_PERIOD_S = 0.3
_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def topic_of(token: str) -> str:
    """Where the two talk; other doctors use other topics."""
    return f"/body_tracking_doctor/{token}"


def speak(token: str, seconds: float) -> None:
    """Publish the wall time at which this node was there."""
    dds.prepare()
    rclpy.init()
    node = rclpy.create_node(f"doctor_speaks_{token}")
    publisher = node.create_publisher(Float64, topic_of(token), QoSProfile(depth=1))
    began, end = time.time(), time.monotonic() + seconds
    while time.monotonic() < end:
        publisher.publish(Float64(data=began))
        time.sleep(0.05)


class Listener(Node):
    """Notes what is there."""

    def __init__(self, token: str) -> None:
        super().__init__(f"doctor_listens_{token}")
        self.began = time.time()
        self.heard_after: float | None = None
        self.streams: dict[str, Stream] = {}
        self.states: dict[str, Counter[int]] = {}
        self.first: dict[str, float] = {}
        self.nodes: dict[str, NodeStatus] = {}
        self.create_subscription(Float64, topic_of(token), self.on_token, _QOS)
        self.create_subscription(DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self.on_diagnostics, _QOS)
        self.create_timer(_LOOK_PERIOD_S, self.look)

    def on_token(self, message: Any) -> None:
        if self.heard_after is None:
            self.heard_after = time.time() - max(self.began, message.data)

    def on_diagnostics(self, message: Any) -> None:
        self.nodes |= {status.name: status for status in statuses(message)}

    def look(self) -> None:
        """Listen to every sensor that there is."""
        for topic, types in self.get_topic_names_and_types():
            publishers = self.count_publishers(topic)
            if topic in self.streams:
                self.streams[topic].publishers = max(publishers, self.streams[topic].publishers)
                continue
            own = names.within(topic, names.rig_namespace([topic]))  # of whatever rig
            sensor = POINT_CLOUD in types and own is not None and graph.sensors_among([own])
            if not publishers or not (sensor or (IMU in types and not graph.is_orientation_topic(topic))):
                continue
            self.streams[topic] = Stream(types[0], publishers)
            kind, read = (PointCloud2, self.read_skeleton) if sensor else (Imu, self.read_imu)
            self.create_subscription(kind, topic, partial(self.on_message, topic, read), _QOS, raw=True)

    def on_message(self, topic: str, read: Callable[[str, bytes], int], cdr: bytes) -> None:
        stream, now = self.streams[topic], time.time()
        try:
            stamp_ns = read(topic, cdr)
        except Exception as error:  # ours, and whatever the client library raises of bytes that are no message
            stream.malformed += 1
            stream.reason = str(error)
            return
        stream.received += 1
        first = self.first.setdefault(topic, now)
        stream.seconds = now - first
        stream.age = min(now - stamp_ns / 1e9, now if stream.age is None else stream.age)

    def read_skeleton(self, topic: str, cdr: bytes) -> int:
        skeletons = decode_skeletons(cdr) or cloud_to_skeletons(deserialize_message(cdr, PointCloud2))
        counts = self.states.setdefault(topic, Counter())
        counts.update(skeletons[0].states.tolist())
        self.streams[topic].tracked = counts[2] / counts.total()
        return skeletons[0].stamp_ns

    def read_imu(self, topic: str, cdr: bytes) -> int:
        return to_nanoseconds(deserialize_message(cdr, Imu).header.stamp)


def listen(token: str, seconds: float, patience: float, wanted: Sequence[str]) -> None:
    """Note for some seconds what is there, and print it.

    Args:
        token: what the other process says.
        seconds: how long.
        patience: seconds to wait longer for what is wanted, which may just have been started.
        wanted: topics.
    """
    dds.prepare()
    rclpy.init()
    node = Listener(token)
    # deadlines of our own: the clock of a bag does not matter here
    began = time.monotonic()
    end, last = began + seconds, began + seconds + patience
    while (now := time.monotonic()) < end:
        rclpy.spin_once(node, timeout_sec=0.1)
        if not all(topic in node.first for topic in wanted):
            end = min(now + seconds, last)
    seen = Observation(get_rmw_implementation_identifier(), node.heard_after, node.streams, node.nodes)
    print(json.dumps(asdict(seen)), flush=True)


def probe() -> None:
    """One of the two."""
    role, token, seconds, *more = sys.argv[1:]
    try:
        if role == "speak":
            speak(token, float(seconds))
        else:
            listen(token, float(seconds), float(more[0]), more[1:])
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    probe()
