"""Bodies from the ROS driver of another camera (``visualization_msgs/MarkerArray``) to ``/<sensor>/skeleton``."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from body_tracking.core.parameters import Parameter
from body_tracking.core.qos import SENSOR_DATA
from body_tracking.core.skeleton import TrackingState
from body_tracking.core.sources import check_sensor_name, optical_frame
from body_tracking.kinect.azure import bodies_of
from body_tracking.kinect.ros_time import RosTime
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.skeletons import markers_to_points
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE, skeleton_qos
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import GraphNode

PARAMETERS = (
    Parameter(
        "sensor", "azure1", "the sensor's name, in its topic /<sensor>/skeleton and its frame <sensor>_optical_frame"
    ),
    Parameter(
        "topic",
        "body_tracking_data",
        "the input topic: the visualization_msgs/MarkerArray of Microsoft's driver of the Azure Kinect",
    ),
    Parameter(
        "state",
        "tracked",
        "the state of every joint: the driver does not report which ones the camera sees and which it infers",
        choices=("tracked", "inferred"),
    ),
    RELIABLE,
)

SILENCE = 1.0
"""Seconds without a message after which the node reports a warning."""


class SkeletonAdapter(GraphNode):
    """Converts and publishes each message."""

    NAME = "skeleton_adapter"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
        given: dict[str, Any] = dict(self.values)
        sensor = check_sensor_name(given["sensor"])
        self.frame_id = optical_frame(sensor)
        self.joint_state = TrackingState[given["state"].upper()]
        self.topic: str = self.resolve_topic_name(given["topic"])
        self.last_received: float | None = None
        self.ros_time = RosTime()
        qos = to_profile(skeleton_qos(self.values))
        self.output = self.make_publisher(PointCloud2, graph.skeleton_topic(sensor), qos)
        self.subscribe(self.topic, MarkerArray, to_profile(SENSOR_DATA), self.on_markers, absolute=True)

    def on_markers(self, message: Any, sent_ns: int) -> None:
        """Publish the bodies of one message; nothing if there are none."""
        self.last_received = time.monotonic()
        if not message.markers:
            return
        stamp_ns, ids, points = markers_to_points(message)
        if self.monitor.message_in(self.topic, stamp_ns):
            self.log_jump(self.topic)
        stamp_ns = self.ros_time.stamp(stamp_ns, self.arrived_ns)
        skeletons = bodies_of(ids, points, stamp_ns, self.frame_id, self.joint_state)
        if skeletons:
            self.send(self.output, encode_skeletons(skeletons), stamp_ns, sent_ns)

    def state(self) -> tuple[int, str, dict[str, object]]:
        if self.last_received is None:
            return 1, f"no usable message on {self.topic} yet", {}
        silent = time.monotonic() - self.last_received
        if silent > SILENCE:
            return 1, f"no usable message on {self.topic} for {silent:.0f} s", {}
        return 0, "streaming", {}


main = partial(run, SkeletonAdapter)
