"""Skeletons, their uncertainty and the sensors as markers for RViz and Foxglove, and a person's segments as TF."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from visualization_msgs.msg import MarkerArray

from body_tracking.core.parameters import Parameter
from body_tracking.core.qos import LATCHED, LATEST, RELIABLE
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import Skeleton
from body_tracking.core.sources import check_sensor_name
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import BODY, SENSORS, WORLD_FRAME
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import STEADY, GraphNode
from body_tracking.ros.wire import ROS
from body_tracking.viewing.colours import FILTERED, FUSED, UNCERTAINTY, sensor_colours
from body_tracking.viewing.markers import Markers, segments_to_transforms
from body_tracking.viewing.shapes import ellipsoids, figure, frustum, in_world

try:  # not on PyPI
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

PARAMETERS = (
    Parameter(
        "rate",
        15.0,
        "publish markers at most this often, and only while there is a subscriber",
        unit="Hz",
        min=0.1,
        max=100.0,
    ),
    Parameter(
        "tf",
        "segments",
        "segments that become frames on /tf, if the filter has a model: all; only the pelvis, for "
        "robot_state_publisher with the person's URDF; none",
        choices=("segments", "root", "none"),
    ),
    SENSORS,
    BODY,
    WORLD_FRAME,
)

_FRUSTUM_DEPTH: Final = 0.3
"""Metres: depth of the drawn frustum of a sensor."""


class BodyMarkers(GraphNode):
    """Keeps the latest message of each topic, and publishes markers at a limited rate."""

    NAME = "body_markers"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
        given: dict[str, Any] = dict(self.values)
        self.body, self.world = graph.check_body(given["body"]), given["world_frame"]
        sensors = [check_sensor_name(sensor) for sensor in given["sensors"]]
        self.colours = {**sensor_colours(sensors), "fused": FUSED, "filtered": FILTERED}
        self.latest: dict[str, dict[int, Skeleton]] = {}
        self.poses: dict[str, SensorPose] = {}
        self.output = self.make_publisher(MarkerArray, graph.markers_topic(self.body), to_profile(RELIABLE))
        sources = {graph.FUSED: "fused", graph.FILTERED: "filtered", **{graph.skeleton_topic(s): s for s in sensors}}
        for topic, name in sources.items():
            self.subscribe(topic, PointCloud2, to_profile(LATEST), partial(self.on_skeletons, topic, name))
        self.subscribe(graph.CALIBRATION, TransformStamped, to_profile(LATCHED), self.on_pose)
        model = UpperBody()
        self.framed = {"segments": model.segment_names, "root": model.segment_names[:1], "none": ()}[given["tf"]]
        if TFMessage is not None and self.framed:
            self.tf = self.make_publisher(TFMessage, graph.TF, to_profile(RELIABLE))
            segments = graph.segments_topic(self.body)
            self.subscribe(segments, MultiDOFJointState, to_profile(LATEST), self.on_segments)
        self.create_timer(1.0 / given["rate"], self.publish, clock=STEADY)

    def on_skeletons(self, topic: str, name: str, message: Any, sent_ns: int) -> None:
        skeletons = cloud_to_skeletons(message)
        self.monitor.message_in(topic, skeletons[0].stamp_ns)
        self.latest.setdefault(name, {}).update({each.body: each for each in skeletons})

    def on_pose(self, message: Any, sent_ns: int) -> None:
        pose = transform_to_pose(message)
        if pose.sensor in self.colours:
            self.poses[pose.sensor] = pose

    def on_segments(self, message: Any, sent_ns: int) -> None:
        self.send(self.tf, segments_to_transforms(message, self.body, self.framed, ROS))

    def publish(self) -> None:
        """Publish markers of the new messages; markers that are not updated expire."""
        latest, self.latest = self.latest, {}
        if not self.output.get_subscription_count():
            return
        markers = Markers(0, self.world, ROS)
        for name, people in latest.items():
            skeletons = tuple(people.values())
            pose = self.poses.get(name)
            if pose is None and skeletons[0].frame_id != self.world:
                continue  # of a sensor that is not calibrated
            placed = skeletons if pose is None else tuple(in_world(each, pose) for each in skeletons)
            markers.figure(name, figure(placed, self.colours[name]), self.colours[name], 0.02, 0.01)
        markers.ellipsoids("uncertainty", ellipsoids(tuple(latest.get("filtered", {}).values())), UNCERTAINTY, 0.3)
        for number, (name, pose) in enumerate(sorted(self.poses.items())):
            markers.lines("sensors", number, frustum(_FRUSTUM_DEPTH), pose, self.colours[name])
        self.send(self.output, markers.message())


main = partial(run, BodyMarkers)
