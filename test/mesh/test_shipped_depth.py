"""``bags/mesh_reaching``: small, whole, and its truth is in its images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint
from body_tracking.mesh.codecs import DepthImage, DepthInfo
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.person import PersonFinder
from body_tracking.mesh.topics import depth_topic, info_topic
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader
from body_tracking.simulation.depth_bags import SECONDS, SHIPPED
from body_tracking.simulation.depth_scene import RATE, SENSOR

BAG = Path(__file__).resolve().parents[2] / "bags" / SHIPPED


@pytest.fixture(scope="module")
def content() -> tuple[Camera, dict[int, FloatArray], dict[int, np.ndarray]]:
    """The camera; by stamp the true joints (25, 3) in the optical frame, and the depth images, metres."""
    joints, images, camera, pose = {}, {}, None, None
    with BagReader(BAG) as bag:
        for raw in bag.messages():
            if raw.topic == info_topic(SENSOR):
                camera = DepthInfo().decode(raw.cdr, BAG_WIRE)
            elif raw.topic == depth_topic(SENSOR):
                stamp_ns, frame, images[stamp_ns] = DepthImage().decode(raw.cdr, BAG_WIRE)
                assert camera is not None and frame == camera.frame_id
            elif raw.topic == graph.TRUE_CALIBRATION:
                pose = transform_to_pose(BAG_WIRE.deserialize("geometry_msgs/msg/TransformStamped", raw.cdr))
            elif raw.topic == graph.TRUE_SKELETON:
                decoded = decode_skeletons(raw.cdr)
                assert decoded is not None
                joints[decoded[0].stamp_ns] = decoded[0].positions
    assert camera is not None and pose is not None
    return camera, {at: (each - pose.translation) @ pose.rotation for at, each in joints.items()}, images


def test_it_is_small_and_whole(content: tuple[Camera, dict[int, FloatArray], dict[int, np.ndarray]]) -> None:
    camera, joints, images = content
    assert sum(path.stat().st_size for path in BAG.iterdir()) < 4e6
    assert len(images) == round(SECONDS * RATE) and images.keys() == joints.keys()
    stamps = np.array(list(images)) / NANOSECONDS
    assert np.diff(stamps) == pytest.approx(1.0 / RATE, abs=1e-6)
    assert {image.shape for image in images.values()} == {(camera.height, camera.width)}


def test_the_person_is_found_in_its_images_and_the_true_joints_are_inside(
    content: tuple[Camera, dict[int, FloatArray], dict[int, np.ndarray]],
) -> None:
    camera, joints, images = content
    finder = PersonFinder(DepthCamera(camera))
    # wrists leave the outline's inside first
    chosen = [Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT, Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT, Joint.SPINE_MID]
    inside = []
    for stamp_ns in list(images)[::30]:
        found = finder.find(images[stamp_ns])
        assert found.people == 1
        columns, rows = np.round(camera.project(joints[stamp_ns][chosen])).astype(int).T
        near = np.array(
            [found.mask[row - 2 : row + 3, c - 2 : c + 3].any() for row, c in zip(rows, columns, strict=True)]
        )
        inside.append(near)
    assert np.mean(inside) > 0.95
