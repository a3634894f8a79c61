"""``/fused/skeleton``, or every sensor's skeletons and orientations, to ``/filtered/skeleton`` and a body's state."""

from __future__ import annotations

from body_tracking.filters.stage import FilterStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class SkeletonFilterNode(StageNode):
    STAGE = FilterStage


def main() -> None:
    """The executable ``skeleton_filter``."""
    run(SkeletonFilterNode)


if __name__ == "__main__":
    main()
