"""``/fused/skeleton``, or every sensor's skeletons and orientations, to ``/filtered/skeleton`` and a body's state."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, Imu, JointState, MultiDOFJointState, PointCloud2, TimeReference
from std_msgs.msg import String

from body_tracking import graph
from body_tracking.errors import BodyTrackingError
from body_tracking.filtering import (
    FILTER,
    INPUT,
    ORDER_WAIT,
    ORIENTATIONS,
    PREDICT_AFTER,
    FilterSettings,
    FilterStage,
    filter_parameters,
    filter_table,
    orientation_topics,
)
from body_tracking.messages import message_to_orientation, time_reference_to_clock, transform_to_pose
from body_tracking.nodes.bag_topics import to_profile
from body_tracking.nodes.common import (
    BODY,
    REFERENCE,
    RELIABLE,
    SENSORS,
    WORLD_FRAME,
    Alarm,
    GraphNode,
    run,
)
from body_tracking.parameters import Value
from body_tracking.recording.qos import LATCHED, Qos
from body_tracking.sensors import check_sensor_name
from body_tracking.skeleton import Skeleton

PARAMETERS = (
    FILTER,
    INPUT,
    SENSORS,
    REFERENCE,
    WORLD_FRAME,
    BODY,
    ORDER_WAIT,
    PREDICT_AFTER,
    ORIENTATIONS,
    *filter_table(),
    RELIABLE,
)

_CALIBRATIONS = 1000
"""Poses, and clocks, that may wait while the filter is busy; none is to be lost."""
_ORIENTATIONS = 32
"""Orientations of a segment that may wait likewise: half a second of them."""


class SkeletonFilterNode(GraphNode):
    """Feeds the filter and publishes what it makes."""

    NAME = "skeleton_filter"
    PARAMETERS = PARAMETERS

    def __init__(self) -> None:
        self.stage: FilterStage | None = None
        self.inputs: list[Subscription] = []
        self.outputs: dict[str, Publisher] = {}
        self.sent_ns: int | None = None
        super().__init__()

    def configure(self, values: Mapping[str, Value]) -> None:
        """A new filter starts from the next frame on."""
        given: dict[str, Any] = dict(values)
        name = given["filter"]
        orientation_topics(given["orientations"])
        settings = FilterSettings(
            name,
            filter_parameters(name, values),
            given["input"],
            tuple(check_sensor_name(sensor) for sensor in given["sensors"]),
            given["reference"],
            given["world_frame"],
            graph.check_body(given["body"]),
            given["predict_after"],
            given["order_wait"],
        )
        before, stage = self.stage, FilterStage(settings, self.publish, self.wanted, time.monotonic_ns)
        if before is not None and before.by_sensor and stage.by_sensor:
            stage.alignment = before.alignment  # latched poses come once
        self.stage = stage
        if before is not None:
            self.advertise(values)
            if before.by_sensor != stage.by_sensor:
                self.connect(values)

    def start(self) -> None:
        """Connect."""
        self.advertise(self.values)
        self.connect(self.values)
        self.waiting = Alarm(self, self.on_alarm)
        self.silence = Alarm(self, self.on_alarm, self.now_ns)

    def advertise(self, values: Mapping[str, Value]) -> None:
        """Make the publishers that the filter needs, and that are not there yet."""
        assert self.stage is not None
        skeletons, body = self.skeleton_qos(), str(values["body"])
        topics: dict[str, tuple[type[Any], Any]] = {graph.FILTERED: (PointCloud2, skeletons)}
        if self.stage.models:
            topics |= {
                graph.MODEL_STATE: (JointState, skeletons),
                graph.MODEL_STATE_STDDEV: (JointState, skeletons),
                graph.MODEL_COVARIANCE: (Image, skeletons),
                graph.segments_topic(body): (MultiDOFJointState, self.result_qos()),
                graph.urdf_topic(body): (String, to_profile(graph.URDF_QOS)),
            }
        for topic in topics.keys() - self.outputs.keys():
            kind, qos = topics[topic]
            self.outputs[topic] = self.create_publisher(kind, topic, qos)

    def connect(self, values: Mapping[str, Value]) -> None:
        """Listen to what the filter takes, and to nothing else."""
        assert self.stage is not None
        for subscription in self.inputs:
            self.destroy_subscription(subscription)
        if not self.stage.by_sensor:
            self.inputs = [self.listen_to_skeletons(graph.FUSED, self.on_fused)]
            return
        given: dict[str, Any] = dict(values)
        sensors = given["sensors"]
        latched = to_profile(Qos(LATCHED.reliability, LATCHED.durability, _CALIBRATIONS))
        self.inputs = [
            self.listen(graph.CALIBRATION_CLOCK, TimeReference, latched, self.on_clock),
            self.listen(graph.CALIBRATION, TransformStamped, latched, self.on_pose),
        ]
        for sensor in sensors:
            topic = graph.skeleton_topic(sensor)
            self.inputs.append(self.listen_to_skeletons(topic, partial(self.on_sensor, sensor)))
        qos = self.skeleton_qos()
        qos.depth = max(qos.depth, _ORIENTATIONS)
        for topic, segment in orientation_topics(given["orientations"]).items():
            self.inputs.append(self.listen(topic, Imu, qos, partial(self.on_orientation, segment)))

    def on_pose(self, message: Any, sent_ns: int) -> None:
        """A sensor's pose."""
        assert self.stage is not None
        self.stage.set_pose(transform_to_pose(message))

    def on_clock(self, message: Any, sent_ns: int) -> None:
        """A sensor's clock."""
        assert self.stage is not None
        self.stage.set_clock(*time_reference_to_clock(message))

    def on_fused(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Filter and publish."""
        assert self.stage is not None
        self.sent_ns = sent_ns
        self.stage.on_fused(skeletons[0], self.now_ns())
        self.set_alarms()

    def on_sensor(self, sensor: str, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Note, for when all that have come are there."""
        assert self.stage is not None
        self.sent_ns = sent_ns
        self.stage.hold(sensor, skeletons, self.now_ns())

    def on_orientation(self, segment: str, message: Any, sent_ns: int) -> None:
        """How an inertial sensor has a segment; what it changes comes with the next frame."""
        assert self.stage is not None
        self.sent_ns = sent_ns
        self.stage.on_orientation(message_to_orientation(message, segment), self.now_ns())

    def messages_taken(self) -> None:
        """Filter and publish what sensors have sent."""
        assert self.stage is not None
        if self.stage.by_sensor:
            self.on_alarm()
        self.sent_ns = None

    def on_alarm(self) -> None:
        """Publish what frames say that need wait no longer, or what is to be expected where none has come for long."""
        assert self.stage is not None
        try:
            self.stage.poll(self.now_ns())
        except BodyTrackingError as error:
            self.malformed("a frame that waited", str(error), "refused")
        finally:
            self.set_alarms()

    def set_alarms(self) -> None:
        """For what is due next."""
        assert self.stage is not None
        self.waiting.at(self.stage.deadline_ns)
        self.silence.at(self.stage.due_ns)

    def wanted(self, topic: str) -> bool:
        """Whether anybody listens."""
        return bool(self.outputs[topic].get_subscription_count())

    def publish(self, topic: str, cdr: bytes, stamp_ns: int) -> None:
        """One message of the filter."""
        if topic in (graph.FILTERED, graph.MODEL_STATE):
            self.send(self.outputs[topic], cdr, stamp_ns, self.sent_ns)
        else:
            self.outputs[topic].publish(cdr)

    def time_jumped_back(self, topic: str) -> None:
        """Start anew; of a sensor, the stage finds out what that means for the others."""
        assert self.stage is not None
        if topic == graph.FUSED:
            self.stage.reset()
        else:
            self.stage.sensor_jumped_back(topic.removeprefix("/").removesuffix(graph.SKELETON_SUFFIX))

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The filter's counters."""
        assert self.stage is not None
        return 0, str(self.values["filter"]), dict(self.stage.counters)


def main() -> None:
    """The executable ``skeleton_filter``."""
    run(SkeletonFilterNode)


if __name__ == "__main__":
    main()
