"""``/markers/<target>/pose`` of all targets of a chain to ``/humans/bodies/markers/joint_states``."""

from __future__ import annotations

from body_tracking.markers.stages import AnglesOfTargetsStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MarkerJointAnglesNode(StageNode):
    STAGE = AnglesOfTargetsStage


def main() -> None:
    """The executable ``marker_joint_angles``."""
    run(MarkerJointAnglesNode)


if __name__ == "__main__":
    main()
