"""``sensor_msgs/Imu`` per segment to ``/imu/<segment>/orientation`` and ``/imu/skeleton``, beside a camera or alone."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from sensor_msgs.msg import Imu, MagneticField, PointCloud2
from std_srvs.srv import Trigger

from body_tracking import graph
from body_tracking.cdr import encode_orientation, encode_skeletons
from body_tracking.filtering import PEOPLE
from body_tracking.fusion.association import HOLD
from body_tracking.fusion.subject import ALL, HeldSubject, SubjectSelector
from body_tracking.imu_tracking import IMU_PARAMETERS, ImuSettings, ImuStage
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.nodes.common import REFERENCE, RELIABLE, SENSORS, WORLD_FRAME, GraphNode, run
from body_tracking.parameters import Value, fields_of
from body_tracking.skeleton import Skeleton

PARAMETERS = (
    *IMU_PARAMETERS,
    *(item for item in PEOPLE if item.name == "subject"),
    SENSORS,
    REFERENCE,
    WORLD_FRAME,
    RELIABLE,
)

_READINGS = 64
"""Readings of a sensor that may wait while the node is busy: a sixth of a second of the fastest ones."""


class ImuSkeletonNode(GraphNode):
    """Feeds the tracker and publishes what it makes."""

    NAME = "imu_skeleton"
    PARAMETERS = PARAMETERS

    def configure(self, values: Mapping[str, Value]) -> None:
        """Make the tracker."""
        given: dict[str, Any] = dict(values)
        parameters = TrackingParameters(**fields_of(TrackingParameters, values))
        self.stage = ImuStage(ImuSettings(given["segments"], given["mountings"], parameters, given["world_frame"]))

    def start(self) -> None:
        """Connect."""
        self.skeletons = self.make_publisher(PointCloud2, graph.IMU_SKELETON, self.skeleton_qos())
        self.orientations = {
            each.segment: self.make_publisher(Imu, graph.orientation_topic(each.segment), self.skeleton_qos())
            for each in self.stage.sensors
        }
        waiting = self.skeleton_qos()
        waiting.depth = max(waiting.depth, _READINGS)
        for each in self.stage.sensors:
            self.listen(each.mag, MagneticField, waiting, partial(self.on_field, each.mag), absolute=each.absolute)
            for topic in each.imu:
                self.listen(topic, Imu, waiting, partial(self.on_imu, topic), absolute=each.absolute)
        self.wearer = HeldSubject(HOLD) if self.values["subject"] == ALL else SubjectSelector()
        self.listen_to_skeletons(graph.FUSED, self.on_skeletons)
        given: dict[str, Any] = dict(self.values)
        reference = given["reference"] or next(iter(given["sensors"]), "")
        if reference:
            self.listen_to_skeletons(graph.skeleton_topic(reference), self.on_frame)
        self.create_service(Trigger, graph.ALIGN_SERVICE, self.on_align)

    def on_imu(self, topic: str, message: Any, sent_ns: int) -> None:
        """Feed one reading and publish what follows from it."""
        heard = self.skeletons.get_subscription_count() > 0
        told = self.stage.on_imu(topic, message, self.arrived_ns, skeleton=heard)
        if told.orientation is not None:
            publisher = self.orientations[told.orientation.segment]
            self.send(publisher, encode_orientation(told.orientation), told.orientation.stamp_ns, sent_ns)
        if told.skeleton is not None:
            self.send(self.skeletons, encode_skeletons([told.skeleton]), told.skeleton.stamp_ns, sent_ns)

    def on_field(self, topic: str, message: Any, sent_ns: int) -> None:
        """Note a magnetic field."""
        self.stage.on_field(topic, message)

    def on_skeletons(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Note what cameras see of the one who wears the sensors: of several, who is nearest to the first camera."""
        wearer = self.wearer.pick(skeletons)
        if wearer is not None:
            self.stage.on_skeleton(wearer, self.arrived_ns)

    def on_frame(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Note when the reference sensor's frames come."""
        self.stage.on_frame(skeletons[0].stamp_ns, self.arrived_ns)

    def on_align(self, request: Any, response: Any) -> Any:
        """``imu_skeleton/align``."""
        response.message, response.success = self.stage.tracker.align(), True
        self.get_logger().info(response.message)
        return response

    def state(self) -> tuple[int, str, dict[str, object]]:
        """What is wrong with which sensor, and how well they are aligned."""
        return self.stage.state(self.now_ns())


def main() -> None:
    """The executable ``imu_skeleton``."""
    run(ImuSkeletonNode)


if __name__ == "__main__":
    main()
