"""``/<camera>/balls`` of all cameras of a rig to ``/markers/points``."""

from __future__ import annotations

from body_tracking.markers.stages import TriangulationStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MarkerTriangulationNode(StageNode):
    STAGE = TriangulationStage


def main() -> None:
    """The executable ``marker_triangulation``."""
    run(MarkerTriangulationNode)


if __name__ == "__main__":
    main()
