"""``/fused/skeleton``, or every sensor's skeletons and orientations, to ``/filtered/skeleton`` and a body's state."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

try:
    from hri_msgs.msg import IdsList
except ImportError:  # not on PyPI
    IdsList = None
from geometry_msgs.msg import TransformStamped
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu, TimeReference

from body_tracking import graph
from body_tracking.errors import BodyTrackingError
from body_tracking.filtering import (
    FILTER,
    INPUT,
    ORDER_WAIT,
    ORIENTATIONS,
    PEOPLE,
    PREDICT_AFTER,
    FilterSettings,
    FilterStage,
    PeopleStage,
    filter_parameters,
    filter_table,
    make_stage,
    orientation_topics,
    people_from,
)
from body_tracking.messages.base import SEGMENTS, STRING, to_header
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.messages.imus import message_to_orientation
from body_tracking.nodes.bag_topics import message_class, to_profile
from body_tracking.nodes.common import (
    BODY,
    REFERENCE,
    RELIABLE,
    ROS,
    SENSORS,
    WORLD_FRAME,
    GraphNode,
    run,
)
from body_tracking.parameters import Value
from body_tracking.recording.qos import LATCHED, Qos
from body_tracking.recording.qos import RELIABLE as RELIABLE_QOS
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
    *PEOPLE,
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
        self.stage: FilterStage | PeopleStage | None = None
        self.inputs: list[Subscription] = []
        self.outputs: dict[str, Publisher] = {}
        self.sent_ns: int | None = None
        self.t_poses = 0
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
            people_from(values),
        )
        before, stage = self.stage, make_stage(settings, self.publish, self.wanted)
        if before is not None:
            stage.inherit(before)
        self.stage = stage
        self.told_apart = {graph.FILTERED} | {topic for topic in stage.topics if topic.endswith("/model_state")}
        if before is not None:
            self.advertise()
            if before.by_sensor != stage.by_sensor:
                self.connect(values)

    def start(self) -> None:
        """Connect."""
        self.ids = IdsList and self.make_publisher(IdsList, graph.TRACKED, to_profile(RELIABLE_QOS))
        self.tracked: tuple[str, ...] = ()
        self.advertise()
        self.connect(self.values)
        self.due = self.make_alarm(self.on_alarm)

    def advertise(self) -> None:
        """Make the publishers that the filter needs, and no others: joint_angles goes by them."""
        assert self.stage is not None
        for topic in self.outputs.keys() - self.stage.topics.keys():
            self.destroy_publisher(self.outputs.pop(topic))
        qos = {SEGMENTS: self.result_qos(), STRING: to_profile(graph.URDF_QOS)}
        for topic, kind in self.stage.topics.items():
            if topic not in self.outputs:
                profile = qos.get(kind) or self.skeleton_qos()
                self.outputs[topic] = self.make_publisher(message_class(kind), topic, profile)

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
        self.stage.on_fused(skeletons, self.arrived_waiting_ns)
        self.set_alarms()

    def on_sensor(self, sensor: str, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Note, for when all that have come are there; in a recording, each in its own time, as offline."""
        assert self.stage is not None
        self.sent_ns = sent_ns
        take = self.stage.on_sensor if self.simulated else self.stage.hold
        take(sensor, skeletons, self.arrived_waiting_ns)

    def on_orientation(self, segment: str, message: Any, sent_ns: int) -> None:
        """How an inertial sensor has a segment; what it changes comes with the next frame."""
        assert self.stage is not None
        self.sent_ns = sent_ns
        self.stage.on_orientation(message_to_orientation(message, segment), self.arrived_waiting_ns)

    def messages_taken(self) -> None:
        """Filter and publish what sensors have sent."""
        assert self.stage is not None
        if self.stage.by_sensor:
            self.on_alarm()
            self.stage.settle()
        self.sent_ns = None

    def on_alarm(self) -> None:
        """Publish what frames say that need wait no longer, or what is to be expected where none has come for long."""
        assert self.stage is not None
        try:
            self.stage.poll(self.waiting_ns())
        except BodyTrackingError as error:
            self.malformed("a frame that waited", str(error), "refused")
        finally:
            self.set_alarms()

    def set_alarms(self) -> None:
        """For what is due next; and say so if others are tracked now."""
        assert self.stage is not None
        if self.stage.tracked != self.tracked:
            self.tell_tracked()
        deadline_ns = self.stage.deadline_ns
        self.due.at(self.stage.due_ns if deadline_ns is None else deadline_ns)

    def tell_tracked(self) -> None:
        """The ids of those who are tracked, for those who follow ROS4HRI (REP-155)."""
        assert self.stage is not None
        self.tracked = self.stage.tracked
        if self.ids is not None:
            header = to_header(self.now_ns(), str(self.values["world_frame"]), ROS)
            self.ids.publish(IdsList(header=header, ids=list(self.tracked)))

    def wanted(self, topic: str) -> bool:
        """Whether anybody listens."""
        return bool(self.outputs[topic].get_subscription_count())

    def publish(self, topic: str, cdr: bytes, stamp_ns: int) -> None:
        """One message of the filter."""
        if topic in self.told_apart:
            self.send(self.outputs[topic], cdr, stamp_ns, self.sent_ns)
        elif self.sent_ns is None or not self.is_stale(topic, self.sent_ns):
            self.outputs[topic].publish(cdr)

    def finish(self) -> None:
        """What waits for an older frame that does not come."""
        assert self.stage is not None
        while (deadline_ns := self.stage.deadline_ns) is not None:
            self.stage.poll(deadline_ns)

    def time_jumped_back(self, topic: str) -> None:
        """Start anew; of a sensor, the stage finds out by itself."""
        assert self.stage is not None
        if topic == graph.FUSED:
            self.stage.reset()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The filter's counters."""
        assert self.stage is not None
        self.tell_tracked()
        counters = self.stage.counters
        before, self.t_poses = self.t_poses, counters.get("t_poses", 0)
        if self.t_poses > before:
            self.get_logger().info("a T-pose told where sensors take this person's joints to be: angles are better now")
        return 0, str(self.values["filter"]), {"tracked": ", ".join(self.tracked), **counters}


def main() -> None:
    """The executable ``skeleton_filter``."""
    run(SkeletonFilterNode)


if __name__ == "__main__":
    main()
