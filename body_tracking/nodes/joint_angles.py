"""``/filtered/skeleton`` or the state of its model to ``/humans/bodies/<id>/joint_states`` and standard deviations."""

from __future__ import annotations

from body_tracking.kinematics.stage import AnglesStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class JointAnglesNode(StageNode):
    STAGE = AnglesStage


def main() -> None:
    """The executable ``joint_angles``."""
    run(JointAnglesNode)


if __name__ == "__main__":
    main()
