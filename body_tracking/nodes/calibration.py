"""All ``/<sensor>/skeleton`` to ``/calibration`` and ``/calibration/clock``: the poses and clocks of the sensors."""

from __future__ import annotations

from body_tracking.calibration.stage import CalibrationStage
from body_tracking.nodes.common import run
from body_tracking.nodes.host import StageNode

PARAMETERS = CalibrationStage.PARAMETERS


class CalibrationNode(StageNode):
    STAGE = CalibrationStage


def main() -> None:
    """The executable ``calibration``."""
    run(CalibrationNode)


if __name__ == "__main__":
    main()
