"""The shipped depth recording, decoded."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.topics import depth_topic, info_topic
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader
from body_tracking.simulation.depth_bags import SHIPPED
from body_tracking.simulation.depth_scene import SENSOR

BAG = Path(__file__).resolve().parents[2] / "bags" / SHIPPED


class Recording(NamedTuple):
    """The camera; by stamp the depth images, metres, and joints (25, 3) in the optical frame: true, and a Kinect's."""

    camera: Camera
    images: dict[int, SingleArray]
    joints: dict[int, FloatArray]
    kinect: dict[int, FloatArray]


@cache
def recording() -> Recording:
    joints, kinect, images, camera, pose = {}, {}, {}, None, None
    with BagReader(BAG) as bag:
        for raw in bag.messages():
            if raw.topic == info_topic(SENSOR):
                camera = CameraInfo().decode(raw.cdr, BAG_WIRE)
            elif raw.topic == depth_topic(SENSOR):
                stamp_ns, frame, images[stamp_ns] = DepthImage().decode(raw.cdr, BAG_WIRE)
                assert camera is not None and frame == camera.frame_id
            elif raw.topic == graph.TRUE_CALIBRATION:
                pose = transform_to_pose(BAG_WIRE.deserialize("geometry_msgs/msg/TransformStamped", raw.cdr))
            elif raw.topic in (graph.TRUE_SKELETON, graph.skeleton_topic(SENSOR)):
                decoded = decode_skeletons(raw.cdr)
                assert decoded is not None
                of = joints if raw.topic == graph.TRUE_SKELETON else kinect
                of[decoded[0].stamp_ns] = decoded[0].positions
    assert camera is not None and pose is not None
    joints = {at: (each - pose.translation) @ pose.rotation for at, each in joints.items()}
    return Recording(camera, images, joints, kinect)
