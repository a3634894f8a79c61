"""``/filtered/skeleton`` or the state of its model to ``/humans/bodies/<id>/joint_states`` and standard deviations."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, JointState

from body_tracking import graph
from body_tracking.cdr import decode_covariance, decode_model_state, encode_angles
from body_tracking.filtering import ANGLES
from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.tracking import AngleStream, state_estimate
from body_tracking.messages import MessageError, image_to_covariance, joint_state_to_model
from body_tracking.nodes.common import BODY, RELIABLE, GraphNode, run
from body_tracking.parameters import Value
from body_tracking.skeleton import Skeleton

PARAMETERS = (BODY, *ANGLES, RELIABLE)

_UNPAIRED = 32
"""States and covariances that may wait for each other."""


class JointAnglesNode(GraphNode):
    """Computes the angles of one skeleton, or one state of the model, per message."""

    NAME = "joint_angles"
    PARAMETERS = PARAMETERS

    def __init__(self) -> None:
        self.stream: AngleStream | None = None
        self.inputs: list[Subscription] = []
        # What has come of each stamp, state or covariance, in the order of arrival.
        self.waiting: OrderedDict[int, dict[str, Any]] = OrderedDict()
        super().__init__()

    def configure(self, values: Mapping[str, Value]) -> None:
        """New angles start from the next message on."""
        self.body = graph.check_body(str(values["body"]))
        convention, self.source = graph.angles_for(str(values["convention"]), str(values["input"]))
        before, self.stream = self.stream, AngleStream(convention)
        if before is not None:
            self.connect()

    def start(self) -> None:
        """Connect."""
        qos = self.result_qos()
        self.output = self.create_publisher(JointState, graph.joint_states_topic(self.body), qos)
        self.stddev_output = self.create_publisher(JointState, graph.joint_states_stddev_topic(self.body), qos)
        self.connect()

    def connect(self) -> None:
        """Listen to what the angles are made of, and to nothing else."""
        for subscription in self.inputs:
            self.destroy_subscription(subscription)
        self.waiting.clear()
        if self.source == graph.SKELETON_INPUT:
            self.inputs = [self.listen_to_skeletons(graph.FILTERED, self.on_filtered)]
        else:
            qos = self.skeleton_qos()
            self.inputs = [
                self.listen(graph.MODEL_STATE, JointState, qos, self.on_state, raw=True),
                self.listen(graph.MODEL_COVARIANCE, Image, qos, self.on_covariance, raw=True),
            ]

    def on_filtered(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Compute and publish."""
        assert self.stream is not None
        angles = self.stream.of_skeleton(skeletons[0])
        if angles is not None:
            self.publish(angles, skeletons[0].frame_id, sent_ns)

    def on_state(self, cdr: bytes, sent_ns: int) -> None:
        """The coordinates of the model."""
        assert self.stream is not None
        model = self.stream.model
        state = decode_model_state(cdr, model) or joint_state_to_model(_deserialized(cdr, JointState), model)
        if self.monitor.message_in(graph.MODEL_STATE, state[0]):
            self.log_seldom("jump", f"{graph.MODEL_STATE}: time jumped back, starting anew", period_s=1.0)
            self.time_jumped_back(graph.MODEL_STATE)
        self.pair(state[0], "state", (state, sent_ns))

    def on_covariance(self, cdr: bytes, sent_ns: int) -> None:
        """Their covariance."""
        assert self.stream is not None
        model = self.stream.model
        stamp_ns, covariance = decode_covariance(cdr, model) or image_to_covariance(_deserialized(cdr, Image), model)
        self.pair(stamp_ns, "covariance", covariance)

    def pair(self, stamp_ns: int, kind: str, value: Any) -> None:
        """Compute and publish, once both are there; what came before and is not complete will never be."""
        assert self.stream is not None
        found = self.waiting.setdefault(stamp_ns, {})
        found[kind] = value
        if len(found) == 2:
            while self.waiting.popitem(last=False)[0] != stamp_ns:
                self.monitor.totals["unpaired"] += 1
            (_, frame_id, q, velocity), sent_ns = found["state"]
            estimate = state_estimate(self.stream.model, stamp_ns, frame_id, q, velocity, found["covariance"])
            self.publish(self.stream.of_estimate(estimate), frame_id, sent_ns)
        elif len(self.waiting) > _UNPAIRED:
            self.waiting.popitem(last=False)
            self.monitor.totals["unpaired"] += 1

    def publish(self, angles: JointAngles, frame_id: str, sent_ns: int) -> None:
        """Angles and their standard deviations."""
        states, stddevs = encode_angles(angles, self.body, frame_id)
        self.send(self.output, states, angles.stamp_ns, sent_ns)
        self.stddev_output.publish(stddevs)

    def time_jumped_back(self, topic: str) -> None:
        """Start anew."""
        assert self.stream is not None
        self.stream.reset()
        self.waiting.clear()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The convention, and what fits say of themselves."""
        assert self.stream is not None
        fits: dict[str, object] = {f"fit {name}": count for name, count in self.stream.fit.counters.items()}
        return 0, f"{self.stream.convention} angles of {self.source}", fits


def _deserialized(cdr: bytes, kind: type[Any]) -> Any:
    try:
        return deserialize_message(cdr, kind)
    except Exception as error:  # the client library's own kinds of errors, one per RMW
        raise MessageError(f"{len(cdr)} bytes are no {kind.__name__}") from error


def main() -> None:
    """The executable ``joint_angles``."""
    run(JointAnglesNode)


if __name__ == "__main__":
    main()
