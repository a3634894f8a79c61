"""A person's joint angles to the commands of a robot's controller, with a safe stop.

This is a node of its own, so that it does not end with the nodes that it monitors. If the inputs cease for any reason,
it holds the robot ``silence`` seconds after the last one, by the wall clock, also while ``/clock`` stands still. If
this node ends, the commands end, and the robot's controller decides what follows. The node publishes no command while
another node publishes commands. It is not a safety-rated function: docs/robots.md.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import LATCHED
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.skeleton import Skeleton
from body_tracking.core.sources import check_sensor_name
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.messages.angles import joint_states_to_angles
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.robots import command_to_array, command_to_trajectory
from body_tracking.pipeline import graph
from body_tracking.pipeline.pairs import Pairs
from body_tracking.pipeline.shared import BODY, RELIABLE, SENSORS, result_qos
from body_tracking.robot.calibration import CalibrationQuality
from body_tracking.robot.follower import Command, Follower, FollowerError, State
from body_tracking.robot.mapping import TRAJECTORY, MappingError, load
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import STEADY, GraphNode
from body_tracking.ros.wire import ROS

PARAMETERS = (
    Parameter("mapping", "", "the robot's mapping file; see docs/robots.md"),
    BODY,
    SENSORS,
    Parameter("rate", 100.0, "commands per second", unit="Hz", min=10.0, max=1000.0),
    RELIABLE,
)

_UNPAIRED = 16
"""Stamps whose angles or standard deviations may wait for their counterpart."""
_LOOK_AROUND_NS = 4_000_000_000
"""Time after which a node has found all other publishers: DDS announces them at least every 3 s."""
_SWITCHED = "of another publisher than before (a restarted node, or two at a time)"
_LEVELS = {State.FOLLOWING: 0, State.APPROACHING: 0, State.HOLDING: 1, State.STOPPED: 2}


class RobotCommands(GraphNode):
    """Passes its inputs to the follower, and publishes the follower's commands at a steady rate."""

    NAME = "robot_commands"
    PARAMETERS = PARAMETERS

    def configure(self, values: Mapping[str, Value]) -> None:
        given: dict[str, Any] = dict(values)
        if not given["mapping"]:
            raise MappingError("parameter 'mapping': no mapping file of a robot; see docs/robots.md")
        self.body = graph.check_body(given["body"])
        self.sensors = tuple(check_sensor_name(sensor) for sensor in given["sensors"])
        self.mapping = load(Path(given["mapping"]).expanduser(), {name: angle_names(name) for name in ALL_CONVENTIONS})
        self.follower = Follower(self.mapping, 1.0 / given["rate"])
        self.follower.watch_sensors(self.sensors)

    def start(self) -> None:
        self.pairs = Pairs(_UNPAIRED)
        self.command: Command | None = None
        self.switched: Counter[str] = Counter()
        self.started_ns = time.monotonic_ns()
        output = self.mapping.output
        kind = JointTrajectory if output.kind == TRAJECTORY else Float64MultiArray
        self.output = self.create_publisher(kind, output.topic, to_profile(RELIABLE_QOS))
        qos = to_profile(result_qos(self.values))
        values, deviations = graph.joint_states_topic(self.body), graph.joint_states_stddev_topic(self.body)
        for topic, part in ((values, "values"), (deviations, "deviations")):
            self.subscribe(topic, JointState, qos, partial(self.on_angles, self.full_name(topic), part))
        for sensor in self.sensors:
            self.subscribe_to_skeletons(graph.skeleton_topic(sensor), partial(self.on_skeletons, sensor))
        self.subscribe(graph.CALIBRATION, TransformStamped, to_profile(LATCHED), self.on_calibration)
        self.subscribe(graph.DIAGNOSTICS_TOPIC, DiagnosticArray, to_profile(RELIABLE_QOS), self.on_diagnostics)
        if output.state_topic:
            self.subscribe(output.state_topic, JointState, to_profile(RELIABLE_QOS), self.on_robot, absolute=True)
        enable = self.create_service(Trigger, "~/enable", self.on_enable)
        if not self.follower.enabled:
            self.get_logger().warning(
                f"waits for a person: without a state_topic the position of {self.mapping.robot} is unknown. Once it "
                f"stands at home: body_tracking call {enable.service_name}"
            )
        self.create_timer(1.0 / float(str(self.values["rate"])), self.publish_command, clock=STEADY)

    def on_angles(self, topic: str, part: str, message: JointState, sent_ns: int) -> None:
        """Pair angles and their standard deviations by stamp, and pass pairs to the follower."""
        if self.has_switched(topic):
            self.follower.refuse_angles(f"{topic}: angles {_SWITCHED}")
        stamp_ns = to_nanoseconds(message.header.stamp)
        self.monitor.message_in(topic, stamp_ns)
        pair = self.pairs.add(stamp_ns, part, message)
        if pair is None:
            return
        values = pair["values"]
        try:
            angles = joint_states_to_angles(values, pair["deviations"], self.body)
        except MessageError as error:
            self.follower.refuse_angles(str(error))
            raise
        convention = str(values.header.frame_id)
        if self.follower.receive_angles(angles, convention, self.now_ns(), time.monotonic_ns()):
            self.log_jump(topic)

    def on_skeletons(self, sensor: str, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        topic = self.full_name(graph.skeleton_topic(sensor))
        if self.has_switched(topic):  # the angles may be of two people in turn
            self.follower.refuse_angles(f"{topic}: frames {_SWITCHED}")
        self.follower.receive_frame(sensor, skeletons[0].stamp_ns, time.monotonic_ns())

    def on_calibration(self, message: TransformStamped, sent_ns: int) -> None:
        pose = transform_to_pose(message)
        if pose.sensor in self.sensors:
            self.follower.calibration.receive_pose(pose.sensor, pose.valid_from_ns)

    def on_diagnostics(self, message: DiagnosticArray, sent_ns: int) -> None:
        for status in statuses(message, namespace=self.get_namespace()):
            if status.node == "calibration":
                quality = CalibrationQuality.from_diagnostics(status.values, self.sensors)
                self.follower.calibration.receive_quality(quality, time.monotonic_ns())

    def on_robot(self, message: JointState, sent_ns: int) -> None:
        topic = self.resolve_topic_name(self.mapping.output.state_topic)
        if self.has_switched(topic):
            self.follower.refuse_robot_state(f"{topic}: joint states {_SWITCHED}")
        position = np.array(message.position, dtype=np.float64)
        self.follower.receive_robot_state(tuple(message.name), position, time.monotonic_ns())

    def on_enable(self, _: Any, response: Any) -> Any:
        self.follower.report_publishers(self.others())
        try:
            self.follower.enable()
            response.success, response.message = True, "enabled"
        except FollowerError as error:
            response.message = str(error)
        return response

    def has_switched(self, topic: str) -> bool:
        """Whether this message of a topic is of another publisher than the one before."""
        before, self.switched[topic] = self.switched[topic], self.sequences.switched[topic]
        return self.switched[topic] != before

    def others(self) -> str:
        """A line that names other publishers of the robot's commands or says that the search goes on; else empty."""
        topic = self.output.topic_name
        if time.monotonic_ns() - self.started_ns < _LOOK_AROUND_NS:
            return f"looking for other publishers of {topic}"
        if self.count_publishers(topic) <= 1:
            return ""
        found = self.publishers_of(topic)
        with contextlib.suppress(ValueError):
            found.remove(self.get_fully_qualified_name())
        return f"another publisher of {topic}: {', '.join(found)}"

    def restart(self) -> None:
        self.pairs.clear()
        self.follower.time_jumped_back()

    def publish_command(self) -> None:
        now_ns = self.now_ns()
        self.follower.report_publishers(self.others())
        self.command = command = self.follower.step(now_ns, time.monotonic_ns())
        if command.position is not None:
            output = self.mapping.output
            if output.kind == TRAJECTORY:
                stamp_ns = now_ns if output.stamped else 0
                message = command_to_trajectory(
                    self.mapping.joints, command.position, stamp_ns, output.time_from_start, ROS
                )
            else:
                message = command_to_array(command.position, ROS)
            self.send(self.output, message)
        for change in self.follower.transitions:
            self.monitor.totals[f"{change.after} began"] += 1
            self.get_logger().info(str(change))
        if self.follower.transitions:
            self.follower.transitions.clear()
            self._report()

    def state(self) -> tuple[int, str, dict[str, object]]:
        command = self.command
        if command is None:
            return 2, "stopped: nothing received yet", {}
        values: dict[str, object] = {
            "robot": self.mapping.robot,
            "state": command.state,
            "reason": command.reason,
            "age of angles ms": f"{1e3 * command.age:.1f}",
            "margin to limits rad": f"{command.margin:.3f}",
            "nearest to a limit": command.nearest,
            "joints that keep their place": ", ".join(command.kept),
        }
        if self.pairs.unpaired:
            values["unpaired"] = self.pairs.unpaired
        return _LEVELS[command.state], f"{command.state}: {command.reason}", values


main = partial(run, RobotCommands)
