"""``/filtered/skeleton`` or the state of its model to ``/humans/bodies/<id>/joint_states`` and standard deviations."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Mapping
from functools import partial
from typing import Any

from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, JointState

from body_tracking import graph
from body_tracking.cdr import decode_covariance, decode_model_state, encode_angles
from body_tracking.filtering import ANGLES, PEOPLE, angle_streams, by_person, people_from
from body_tracking.fusion.association import HOLD
from body_tracking.fusion.subject import ALL
from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.tracking import AngleStream, state_estimate
from body_tracking.messages.model import image_to_covariance, joint_state_to_model
from body_tracking.nodes.common import BODY, RELIABLE, STEADY, GraphNode, deserialized, run
from body_tracking.parameters import Value
from body_tracking.skeleton import Skeleton

PARAMETERS = (BODY, *(item for item in PEOPLE if item.name in ("subject", "people")), *ANGLES, RELIABLE)

_LOOK_S = 0.1
"""Seconds between two looks for what the filter publishes."""
_UNPAIRED = 1000
"""States and covariances that may wait for each other, of each person: as many as reliable topics keep, for what was
lost and is sent again comes late."""


class JointAnglesNode(GraphNode):
    """Computes the angles of one skeleton, or one state of the model, per message and person."""

    NAME = "joint_angles"
    PARAMETERS = PARAMETERS

    def __init__(self) -> None:
        self.streams: dict[str, AngleStream] = {}
        self.inputs: list[Subscription] = []
        self.outputs: dict[str, tuple[Publisher, Publisher]] = {}
        self.published = self.seen = ""  # which input the filter publishes: settled, and at the last look
        # Of each person what has come of each stamp, state or covariance, in the order of arrival.
        self.waiting: dict[str, OrderedDict[int, dict[str, Any]]] = {}
        super().__init__()

    def configure(self, values: Mapping[str, Value]) -> None:
        """New angles start from the next message on."""
        asked = str(values["convention"])
        known = self.published if values["input"] == graph.AUTO else str(values["input"])
        convention, source = graph.angles_for(asked, known or graph.SKELETON_INPUT)
        # Not before it is known what to take: angles of another convention than all later ones could come.
        self.source = source if known or asked == graph.POSITIONAL else ""
        people = people_from({**values, "hold": HOLD})
        self.several = people.subject == ALL
        self.streams = angle_streams(convention, graph.check_body(str(values["body"])), people)
        if self.outputs:
            self.connect()

    def start(self) -> None:
        """Connect."""
        qos = self.result_qos()
        self.outputs = {
            body: (
                self.make_publisher(JointState, graph.joint_states_topic(body), qos),
                self.make_publisher(JointState, graph.joint_states_stddev_topic(body), qos),
            )
            for body in self.streams
        }
        self.connect()
        self.create_timer(_LOOK_S, self.look, clock=STEADY)

    @property
    def covariance(self) -> str:
        """The topic that only a filter with a model publishes."""
        return graph.model_topics(next(iter(self.streams)), self.several).covariance

    def look(self) -> None:
        """Follow the filter to what it publishes, once that is the same at two looks: topics are found one by one.

        While no filter is there, as when it is started again, nothing changes.
        """
        before, self.seen = self.seen, ""
        for source, topic in ((graph.MODEL_INPUT, self.covariance), (graph.SKELETON_INPUT, graph.FILTERED)):
            if self.count_publishers(self.full_name(topic)):
                self.seen = source
                break
        if self.seen == before != "" and self.published != self.seen:
            self.published = self.seen
            if self.values["input"] == graph.AUTO:
                self.configure(self.values)

    def connect(self) -> None:
        """Listen to what the angles are made of, and to nothing else."""
        for subscription in self.inputs:
            self.destroy_subscription(subscription)
        self.inputs = []
        self.waiting = {body: OrderedDict() for body in self.streams}
        if not self.source:
            return
        if self.source == graph.SKELETON_INPUT:
            self.inputs = [self.listen_to_skeletons(graph.FILTERED, self.on_filtered)]
            return
        qos = self.skeleton_qos()
        for body in self.streams:
            topics = graph.model_topics(body, self.several)
            self.inputs += [
                self.listen(topics.state, JointState, qos, partial(self.on_state, body, topics.state), raw=True),
                self.listen(
                    topics.covariance, Image, qos, partial(self.on_covariance, body, topics.covariance), raw=True
                ),
            ]

    def on_filtered(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Compute and publish."""
        for body, skeleton in by_person(skeletons, self.streams, several=self.several):
            angles = self.streams[body].of_skeleton(skeleton)
            if angles is not None:
                self.publish(body, angles, sent_ns)

    def on_state(self, body: str, topic: str, cdr: bytes, sent_ns: int) -> None:
        """The coordinates of the model."""
        if self.is_stale(topic, sent_ns):
            return
        model = self.streams[body].model
        state = decode_model_state(cdr, model) or joint_state_to_model(deserialized(cdr, JointState), model)
        if self.monitor.message_in(topic, state[0]):
            self.log_seldom("jump", f"{topic}: time jumped back, starting anew", period_s=1.0)
            self.time_jumped_back(topic)
        self.pair(body, state[0], "state", (state, sent_ns))

    def on_covariance(self, body: str, topic: str, cdr: bytes, sent_ns: int) -> None:
        """Their covariance."""
        if self.is_stale(topic, sent_ns):
            return
        model = self.streams[body].model
        stamp_ns, covariance = decode_covariance(cdr, model) or image_to_covariance(deserialized(cdr, Image), model)
        self.pair(body, stamp_ns, "covariance", covariance)

    def pair(self, body: str, stamp_ns: int, kind: str, value: Any) -> None:
        """Compute and publish, once both are there; what came before and is not complete will never be."""
        waiting, stream = self.waiting[body], self.streams[body]
        found = waiting.setdefault(stamp_ns, {})
        found[kind] = value
        if len(found) == 2:
            while waiting.popitem(last=False)[0] != stamp_ns:
                self.monitor.totals["unpaired"] += 1
            (_, frame_id, q, velocity), sent_ns = found["state"]
            estimate = state_estimate(stream.model, stamp_ns, frame_id, q, velocity, found["covariance"])
            self.publish(body, stream.of_estimate(estimate), sent_ns)
        elif len(waiting) > _UNPAIRED:
            waiting.popitem(last=False)
            self.monitor.totals["unpaired"] += 1

    def publish(self, body: str, angles: JointAngles, sent_ns: int) -> None:
        """Angles and their standard deviations; both name the convention."""
        states, stddevs = encode_angles(angles, body, self.streams[body].convention)
        output, stddev_output = self.outputs[body]
        if self.send(output, states, angles.stamp_ns, sent_ns):
            stddev_output.publish(stddevs)

    def time_jumped_back(self, topic: str) -> None:
        """Start anew."""
        for stream in self.streams.values():
            stream.reset()
        for waiting in self.waiting.values():
            waiting.clear()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The convention, and what fits say of themselves."""
        fits: Counter[str] = Counter()
        for stream in self.streams.values():
            fits.update(stream.fit.counters)
        values: dict[str, object] = {f"fit {name}": count for name, count in fits.items()}
        if not self.source:
            return 1, "no filter publishes anything", values
        text = f"{next(iter(self.streams.values())).convention} angles of {self.source}"
        if self.source == graph.MODEL_INPUT != self.seen:
            text += f", but no filter publishes {self.full_name(self.covariance)}"
            if self.seen:
                self.log_seldom("input", text)
            return 1, text, values
        return 0, text, values


def main() -> None:
    """The executable ``joint_angles``."""
    run(JointAnglesNode)


if __name__ == "__main__":
    main()
