"""Topics of colour-and-depth cameras, by the ROS 2 driver that publishes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class CameraTopics:
    """The four topics of a camera.

    Attributes:
        colour: images.
        colour_info: their calibration.
        depth: images.
        depth_info: their calibration.
    """

    colour: str
    colour_info: str
    depth: str
    depth_info: str

    def of(self, camera: str) -> CameraTopics:
        """With the camera's name in place of ``{camera}``."""
        return CameraTopics(*(getattr(self, name).replace("{camera}", camera) for name in self.__slots__))


def _topics(colour: str, depth: str) -> CameraTopics:
    return CameraTopics(f"{colour}/image_raw", f"{colour}/camera_info", f"{depth}/image_raw", f"{depth}/camera_info")


DRIVERS: Final = {
    "plain": _topics("/{camera}/color", "/{camera}/depth"),
    "realsense": _topics("/camera/{camera}/color", "/camera/{camera}/aligned_depth_to_color"),
    "orbbec": _topics("/{camera}/color", "/{camera}/depth"),
    "azure_kinect": _topics("/{camera}/rgb", "/{camera}/depth_to_rgb"),
    "oak": _topics("/{camera}/rgb", "/{camera}/stereo"),
}
"""Topics of the drivers realsense2_camera (``align_depth.enable:=true``), orbbec_camera (``depth_registration:=true``),
Azure_Kinect_ROS_Driver (in a namespace of the camera's name) and depthai_ros_driver; ``plain`` where the names are
chosen, as in recordings of ours."""

RIG_SENSOR: Final = "camera_rig"
"""The sensor whose skeletons are triangulated, in the frame of the rig's first camera."""
COMPRESSION: Final = ("none", "colour", "both")
"""Which images are compressed."""
PICTURE_WIDTH: Final = 640
"""Pixels of a picture with people drawn in, at most."""
COMPRESSED: Final = "/compressed"
"""After the topic of colour images that image_transport compresses."""
COMPRESSED_DEPTH: Final = "/compressedDepth"
"""After the topic of depth images that image_transport compresses."""

BALLS: Final = "/robot/balls"
"""``geometry_msgs/PoseArray``: where a robot has the balls that a camera tracks, in the robot's frame."""


def infrared_topic(camera: str) -> str:
    """The infrared images of a depth camera; their calibration is on ``camera_info`` beside it."""
    return f"/{camera}/infrared/image_raw"


def info_beside(topic: str) -> str:
    """The calibration of the images of a topic, where drivers publish it."""
    return f"{topic.rpartition('/')[0]}/camera_info"


def images_of(topics: CameraTopics, compressed: str) -> tuple[str, str]:
    """The topics of colour and depth images, of which ``none``, ``colour`` or ``both`` are compressed."""
    colour = topics.colour if compressed == "none" else topics.colour + COMPRESSED
    return colour, topics.depth + COMPRESSED_DEPTH if compressed == "both" else topics.depth


def people_topic(camera: str) -> str:
    """The colour images with the people drawn in, as JPEG."""
    return f"/{camera}/people/image_raw{COMPRESSED}"
