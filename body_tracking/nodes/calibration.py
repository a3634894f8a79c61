"""All ``/<sensor>/skeleton`` to ``/calibration`` and ``/calibration/clock``: the poses and clocks of the sensors."""

from __future__ import annotations

from body_tracking.calibration.stage import CalibrationStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class CalibrationNode(StageNode):
    STAGE = CalibrationStage


def main() -> None:
    """The executable ``calibration``."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
