"""``/markers/points`` to ``/markers/<target>/pose`` of each target."""

from __future__ import annotations

from body_tracking.markers.stages import TrackerStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class RigidBodyTrackerNode(StageNode):
    STAGE = TrackerStage


def main() -> None:
    """The executable ``rigid_body_tracker``."""
    run(RigidBodyTrackerNode)


if __name__ == "__main__":
    main()
