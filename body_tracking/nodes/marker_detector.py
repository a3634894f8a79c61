"""``/<camera>/image_raw`` of each camera to ``/<camera>/balls``."""

from __future__ import annotations

from body_tracking.markers.stages import DetectorStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MarkerDetectorNode(StageNode):
    STAGE = DetectorStage


def main() -> None:
    """The executable ``marker_detector``."""
    run(MarkerDetectorNode)


if __name__ == "__main__":
    main()
