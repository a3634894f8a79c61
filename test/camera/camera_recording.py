"""The shipped recording of colour and depth images, decoded."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.topics import COMPRESSED, DRIVERS
from body_tracking.core.camera import Camera
from body_tracking.core.message_types import TRANSFORM
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.codecs import DepthImage
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, deserialize
from body_tracking.simulation.camera_bags import SHIPPED
from body_tracking.simulation.colour_images import CAMERA

BAG = Path(__file__).resolve().parents[2] / "bags" / SHIPPED
NAMES = DRIVERS["plain"].of(CAMERA)


class Recorded(NamedTuple):
    """By stamp: colour images, depth images, and true joints (25, 3) in the camera's optical frame."""

    colour_camera: Camera
    depth_camera: Camera
    colour: dict[int, NDArray[np.uint8]]
    depth: dict[int, SingleArray]
    joints: dict[int, FloatArray]


@cache
def recording() -> Recorded:
    colour: dict[int, NDArray[np.uint8]] = {}
    depth: dict[int, SingleArray] = {}
    truth: dict[int, FloatArray] = {}
    cameras: dict[str, Camera] = {}
    with BagReader(BAG) as bag:
        for raw in bag.messages():
            if raw.topic == NAMES.colour + COMPRESSED:
                stamp_ns, _, pixels = CompressedColour().decode(raw.cdr, BAG_WIRE)
                colour[stamp_ns] = pixels
            elif raw.topic == NAMES.depth:
                stamp_ns, _, distances = DepthImage().decode(raw.cdr, BAG_WIRE)
                depth[stamp_ns] = distances
            elif raw.topic in (NAMES.colour_info, NAMES.depth_info):
                cameras[raw.topic] = CameraInfo().decode(raw.cdr, BAG_WIRE)
            elif raw.topic == graph.TRUE_SKELETON:
                (skeleton,) = decode_skeletons(raw.cdr) or ()
                truth[skeleton.stamp_ns] = skeleton.positions
            elif raw.topic == graph.TRUE_CALIBRATION:
                pose = transform_to_pose(deserialize(TRANSFORM, raw.cdr))
    optical = {stamp: (places - pose.translation) @ pose.rotation for stamp, places in truth.items()}
    return Recorded(cameras[NAMES.colour_info], cameras[NAMES.depth_info], colour, depth, optical)
