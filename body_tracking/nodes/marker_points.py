"""Points of another motion capture system to ``/markers/points``."""

from __future__ import annotations

from body_tracking.markers.point_topic import PointTopicStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MarkerPointsNode(StageNode):
    STAGE = PointTopicStage


def main() -> None:
    """The executable ``marker_points``."""
    run(MarkerPointsNode)


if __name__ == "__main__":
    main()
