"""``/<sensor>/depth/image_raw`` to ``/<sensor>_mesh/skeleton`` and the mesh."""

from __future__ import annotations

from body_tracking.mesh.stage import MeshStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MeshTrackerNode(StageNode):
    STAGE = MeshStage


def main() -> None:
    """The executable ``mesh_tracker``."""
    run(MeshTrackerNode)


if __name__ == "__main__":
    main()
