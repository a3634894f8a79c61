"""``sensor_msgs/Imu`` per segment to ``/imu/<segment>/orientation`` and ``/imu/skeleton``, with or without a camera."""

from __future__ import annotations

from body_tracking.inertial.stage import ImuStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class ImuSkeletonNode(StageNode):
    STAGE = ImuStage


def main() -> None:
    """The executable ``imu_skeleton``."""
    run(ImuSkeletonNode)


if __name__ == "__main__":
    main()
