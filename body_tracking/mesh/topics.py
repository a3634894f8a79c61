"""Topics of the mesh system (names as in depth_image_proc)."""

from __future__ import annotations

from typing import Final

from body_tracking.core.qos import Qos
from body_tracking.pipeline.graph import ARM_SEGMENTS

IMAGES: Final = Qos(reliability="reliable", depth=10)
"""QoS of images: best effort loses one in fourteen."""
MESH_SUFFIX: Final = "_mesh"
"""Suffix of the sensor name under which the tracker publishes skeletons."""

_TURNED_BY: Final = {"upper_arm": "shoulder", "forearm": "elbow", "hand": "wrist"}
JOINTS_OF: Final = {
    each: f"{side}_{_TURNED_BY[segment]}" for each in ARM_SEGMENTS for segment, _, side in [each.rpartition("_")]
}
"""Joint of the mesh at the start of each segment whose inertial sensor the fit can use."""


def depth_topic(sensor: str) -> str:
    """The depth images of a sensor."""
    return f"/{sensor}/depth/image_raw"


def info_topic(sensor: str) -> str:
    """The calibration of a sensor's depth camera."""
    return f"/{sensor}/depth/camera_info"


def body_index_topic(sensor: str) -> str:
    """Body-index images of a sensor: the body's number at each pixel, 255 for none; stamps equal the depth images'."""
    return f"/{sensor}/body_index/image_raw"


def mesh_topic(sensor: str) -> str:
    """The fitted mesh as a marker."""
    return f"/{sensor}{MESH_SUFFIX}/mesh"


def mesh_sensor(sensor: str) -> str:
    """Name of the sensor under which the skeletons of a depth camera's mesh are published."""
    return f"{sensor}{MESH_SUFFIX}"


def personalise_service(sensor: str) -> str:
    """The service that estimates the shape of the person before a depth camera anew."""
    return f"{mesh_sensor(sensor)}/personalise"
