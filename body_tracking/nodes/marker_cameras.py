"""Images of drivers, of files or rendered ones to ``/<camera>/image_raw``."""

from __future__ import annotations

from body_tracking.markers.camera_images import CameraImagesStage
from body_tracking.ros.host import StageNode
from body_tracking.ros.node import run


class MarkerCamerasNode(StageNode):
    STAGE = CameraImagesStage


def main() -> None:
    """The executable ``marker_cameras``."""
    run(MarkerCamerasNode)


if __name__ == "__main__":
    main()
