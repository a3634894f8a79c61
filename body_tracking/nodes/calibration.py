"""All ``/<sensor>/skeleton`` to ``/calibration`` and ``/calibration/clock``: the poses and clocks of the sensors."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import TimeReference
from std_srvs.srv import Trigger

from body_tracking import graph
from body_tracking.calibration.online import CalibrationParameters, CalibrationUpdate, OnlineCalibration
from body_tracking.calibration.storage import load, save
from body_tracking.errors import BodyTrackingError
from body_tracking.fusion.subject import SubjectSelector
from body_tracking.messages.calibration import clock_to_time_reference, pose_to_transform
from body_tracking.nodes.bag_topics import to_profile
from body_tracking.nodes.common import REFERENCE, RELIABLE, ROS, SENSORS, STEADY, WORLD_FRAME, GraphNode, run
from body_tracking.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.recording.qos import LATCHED, Qos
from body_tracking.sensors import check_sensor_name
from body_tracking.skeleton import Skeleton

try:  # not on PyPI
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

SAVE_PERIOD = 2.0
"""Seconds between two writings of the calibration file at least."""

_LEVEL = "world would tilt or move under everyone who uses it"
_MEMORY = "the frames remembered so far were chosen by it"
_STAMPS = "by it a recording gives offline what it gave live"
_FIXED = {
    "method": "what one method has estimated is no start for the other",
    **dict.fromkeys(("reference_height", "reference_pitch", "reference_roll"), _LEVEL),
    **dict.fromkeys(("history", "pairs_per_place", "capacity"), _MEMORY),
    **dict.fromkeys(("settle_time", "activation_delay"), _STAMPS),
}
PARAMETERS = (
    SENSORS,
    REFERENCE,
    Parameter(
        "calibration_file",
        "",
        "YAML file: loaded at the start if it exists, saved when the result changes; or empty",
        fixed="it is loaded at the start",
    ),
    WORLD_FRAME,
    *parameters_from(CalibrationParameters, live=True, fixed=_FIXED),
    RELIABLE,
)


class CalibrationNode(GraphNode):
    """Feeds the calibration and publishes its updates."""

    NAME = "calibration"
    PARAMETERS = PARAMETERS

    def configure(self, values: Mapping[str, Value]) -> None:
        """Make the calibration, and load the one on file."""
        given: dict[str, Any] = dict(values)
        self.sensors = tuple(check_sensor_name(sensor) for sensor in given["sensors"])
        parameters = CalibrationParameters(**fields_of(CalibrationParameters, values))
        self.calibration = OnlineCalibration(self.sensors, parameters, given["reference"] or None)
        self.file = Path(given["calibration_file"]).expanduser() if given["calibration_file"] else None
        if self.file is not None and self.file.exists():
            self.calibration.load(load(self.file))

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        """From the next frame on; what was estimated stays."""
        self.calibration.parameters = CalibrationParameters(**fields_of(CalibrationParameters, values))

    def start(self) -> None:
        """Connect, and publish what holds now."""
        self.subjects = {sensor: SubjectSelector() for sensor in self.sensors}
        self.unsaved = False
        # Two batches: whoever comes late needs the one that holds now when the latest one is to hold only later.
        latched = to_profile(Qos(LATCHED.reliability, LATCHED.durability, 2 * max(1, len(self.sensors))))
        self.poses = self.make_publisher(TransformStamped, graph.CALIBRATION, latched)
        self.clocks = self.make_publisher(TimeReference, graph.CALIBRATION_CLOCK, latched)
        self.tf = None if TFMessage is None else self.make_publisher(TFMessage, graph.TF_STATIC, to_profile(LATCHED))
        self.publish(self.calibration.current_update())
        for sensor in self.sensors:
            self.listen_to_skeletons(graph.skeleton_topic(sensor), partial(self.on_skeletons, sensor))
        for name, action in (
            (graph.START_SERVICE, self.calibration.start),
            (graph.RESET_SERVICE, self.calibration.reset),
        ):
            self.create_service(Trigger, name, partial(self.on_service, action))
        if self.file is not None:
            self.create_timer(SAVE_PERIOD, self.save, clock=STEADY)

    def on_skeletons(self, sensor: str, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Feed one frame and publish what follows from it."""
        subject = self.subjects[sensor].pick(skeletons)
        if subject is None:
            return
        for update in self.calibration.push(sensor, subject, self.arrived_ns):
            self.publish(update)
            self.unsaved = True
        events = self.calibration.events
        while events:
            self.get_logger().info(events.pop(0))

    def publish(self, update: CalibrationUpdate) -> None:
        """Every sensor's pose and clock, in one batch."""
        world, result = str(self.values["world_frame"]), update.result
        transforms = [pose_to_transform(pose, world, ROS) for pose in result.poses.values()]
        # Clocks first: with a pose comes the first use.
        for sensor, clock in result.clocks.items():
            if sensor != result.reference:
                at_ns = update.valid_from_ns
                self.clocks.publish(clock_to_time_reference(sensor, clock, at_ns, ROS))
        for transform in transforms:
            self.send(self.poses, transform)
        if self.tf is not None:
            self.tf.publish(TFMessage(transforms=transforms))

    def on_service(self, action: Callable[[], str], request: Any, response: Any) -> Any:
        """``calibration/start`` and ``calibration/reset``."""
        response.message, response.success = action(), True
        self.get_logger().info(response.message)
        return response

    def save(self) -> None:
        """Write the file, if anything changed."""
        if self.file is None or not self.unsaved:
            return
        try:
            # What is published, not the estimate that it still moves toward: a restart must not jump.
            save(self.calibration.current_update().result, self.file)
            self.unsaved = False
        except BodyTrackingError as error:
            self.log_seldom("save", str(error), period_s=60.0)

    def time_jumped_back(self, topic: str) -> None:
        """The calibration itself sees it in the stamps; only who the subject is may have changed."""
        for subject in self.subjects.values():
            subject.reset()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """How well everything is known."""
        return self.calibration.status()

    def close(self) -> None:
        """Save the last state."""
        self.save()


def main() -> None:
    """The executable ``calibration``."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
