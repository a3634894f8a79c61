"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``."""

from __future__ import annotations

from body_tracking.fusion.stage import FusionStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class FusionNode(StageNode):
    STAGE = FusionStage


def main() -> None:
    """The executable ``fusion``."""
    run(FusionNode)


if __name__ == "__main__":
    main()
