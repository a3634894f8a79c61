"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import PointCloud2, TimeReference

from body_tracking import graph
from body_tracking.cdr import encode_skeletons
from body_tracking.filtering import PEOPLE, people_from
from body_tracking.fusion.fusion import FusionParameters
from body_tracking.fusion.people_fusion import PeopleFusion
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.nodes.bag_topics import to_profile
from body_tracking.nodes.common import REFERENCE, RELIABLE, SENSORS, WORLD_FRAME, GraphNode, run
from body_tracking.parameters import Value, fields_of, parameters_from
from body_tracking.recording.qos import LATCHED, Qos
from body_tracking.sensors import check_sensor_name
from body_tracking.skeleton import Skeleton

_FIXED = {"turned_hold": "a body that is held reversed is held for as long as was said when it was seen"}
PARAMETERS = (
    SENSORS,
    REFERENCE,
    WORLD_FRAME,
    *PEOPLE,
    *parameters_from(FusionParameters, live=True, fixed=_FIXED),
    RELIABLE,
)


class FusionNode(GraphNode):
    """Feeds the fusion and publishes what it makes."""

    NAME = "fusion"
    PARAMETERS = PARAMETERS

    def configure(self, values: Mapping[str, Value]) -> None:
        """Make the fusion."""
        given: dict[str, Any] = dict(values)
        parameters = FusionParameters(**fields_of(FusionParameters, values))
        self.sensors = tuple(check_sensor_name(sensor) for sensor in given["sensors"])
        people = people_from(values)
        self.fusion = PeopleFusion(self.sensors, parameters, people, given["reference"] or None, given["world_frame"])

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        """From the next frame on."""
        self.fusion.parameters = FusionParameters(**fields_of(FusionParameters, values))

    def start(self) -> None:
        """Connect."""
        self.last_sent_ns = 0
        self.output = self.make_publisher(PointCloud2, graph.FUSED, self.skeleton_qos())
        latched = to_profile(Qos(LATCHED.reliability, LATCHED.durability, 2 * max(1, len(self.sensors))))
        self.listen(graph.CALIBRATION_CLOCK, TimeReference, latched, self.on_clock)
        self.listen(graph.CALIBRATION, TransformStamped, latched, self.on_pose)
        for sensor in self.sensors:
            self.listen_to_skeletons(graph.skeleton_topic(sensor), partial(self.on_skeletons, sensor))
        self.due = self.make_alarm(self.on_deadline)

    def on_pose(self, message: Any, sent_ns: int) -> None:
        """A sensor's pose."""
        self.fusion.set_pose(transform_to_pose(message))

    def on_clock(self, message: Any, sent_ns: int) -> None:
        """A sensor's clock."""
        self.fusion.set_clock(*time_reference_to_clock(message))

    def on_skeletons(self, sensor: str, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Feed one frame and publish what follows from it."""
        if any(skeleton.valid.any() for skeleton in skeletons):
            self.last_sent_ns = sent_ns
            self.publish(self.fusion.push(sensor, skeletons, self.arrived_waiting_ns))

    def on_deadline(self) -> None:
        """Nothing more to wait for."""
        self.publish(self.fusion.poll(self.waiting_ns()))

    def publish(self, fused: list[tuple[Skeleton, ...]]) -> None:
        """Send the skeletons and set the timer for the next that cannot wait longer."""
        for skeletons in fused:
            self.send(self.output, encode_skeletons(skeletons), skeletons[0].stamp_ns, self.last_sent_ns)
        self.due.at(self.fusion.deadline_ns)

    def finish(self) -> None:
        """What waits for a frame that does not come."""
        while (deadline_ns := self.fusion.deadline_ns) is not None:
            self.publish(self.fusion.poll(deadline_ns))

    def time_jumped_back(self, topic: str) -> None:
        """Start anew; poses and clocks stay."""
        self.fusion.reset()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The fusion's counters."""
        return 0, "", dict(self.fusion.counters)


def main() -> None:
    """The executable ``fusion``."""
    run(FusionNode)


if __name__ == "__main__":
    main()
