"""``/filtered/skeleton`` to ``/humans/bodies/<id>/joint_states`` and their standard deviations."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import re

from sensor_msgs.msg import JointState

from body_tracking import graph
from body_tracking.cdr import encode_angles
from body_tracking.kinematics.positional import positional_angles
from body_tracking.nodes.bag_topics import to_profile
from body_tracking.nodes.common import BODY, RELIABLE, GraphNode, run
from body_tracking.parameters import ParameterError
from body_tracking.recording.qos import RELIABLE as RELIABLE_QOS
from body_tracking.skeleton import Skeleton

PARAMETERS = (BODY, RELIABLE)


class JointAnglesNode(GraphNode):
    """Computes the angles of one skeleton per message."""

    NAME = "joint_angles"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
        """Connect."""
        self.body = str(self.values["body"])
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", self.body):
            raise ParameterError(f"parameter 'body': {self.body!r}, expected letters, digits and _, a letter first")
        qos = to_profile(RELIABLE_QOS)
        self.output = self.create_publisher(JointState, graph.joint_states_topic(self.body), qos)
        self.stddev_output = self.create_publisher(JointState, graph.joint_states_stddev_topic(self.body), qos)
        self.listen_to_skeletons(graph.FILTERED, self.on_filtered)

    def on_filtered(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Compute and publish."""
        skeleton = skeletons[0]
        states, stddevs = encode_angles(positional_angles(skeleton), self.body, skeleton.frame_id)
        self.send(self.output, states, skeleton.stamp_ns, sent_ns)
        self.stddev_output.publish(stddevs)


def main() -> None:
    """The executable ``joint_angles``."""
    run(JointAnglesNode)


if __name__ == "__main__":
    main()
