"""``mesh_tracker`` takes the depth and body-index images of drivers, whatever quality of service these offer."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from running import Running  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # noqa: E402

from body_tracking.core.camera import Camera  # noqa: E402
from body_tracking.mesh.topics import body_index_topic, depth_topic, info_topic, mesh_sensor  # noqa: E402
from body_tracking.messages import codecs  # noqa: E402
from body_tracking.messages.skeletons import cloud_to_skeletons  # noqa: E402
from body_tracking.pipeline.graph import skeleton_topic  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_WIRE  # noqa: E402

CAMERA = Camera("camera", 128, 106, np.array([[92.0, 0.0, 64.0], [0.0, 92.0, 53.0], [0.0, 0.0, 1.0]]), np.zeros(5))
SENSOR_DATA = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The profile of many drivers: neither latched nor reliable."""


def test_images_and_calibrations_of_a_driver_that_starts_later_and_latches_nothing(tmp_path: Path) -> None:
    from body_tracking.mesh import body_model  # not by every worker: numba takes half a second
    from body_tracking.mesh.codecs import BodyIndex, DepthImage
    from body_tracking.mesh.raster import render
    from body_tracking.mesh.solver import MeshFitter

    body = body_model.load().body()
    standing = body.posed(MeshFitter(body).neutral(np.array([0.0, 0.0, 2.3]), 0.6)).vertices
    seen = render(standing, body.model.faces, CAMERA).depth
    depth = np.where(seen > 0.0, 1e3 * seen, 4e3).astype(np.uint16)
    with Running(tmp_path) as running:
        running.start("mesh_tracker", camera="kinect1")
        found = running.collect(PointCloud2, skeleton_topic(mesh_sensor("kinect1")), SENSOR_DATA)
        # the node's subscriptions are there before the driver
        assert running.until(lambda: "mesh_tracker" in running.diagnostics, 60.0)
        infos = running.node.create_publisher(CameraInfo, info_topic("kinect1"), SENSOR_DATA)
        images = running.node.create_publisher(Image, depth_topic("kinect1"), SENSOR_DATA)
        bodies = running.node.create_publisher(Image, body_index_topic("kinect1"), SENSOR_DATA)
        index = np.where(seen > 0.0, 3, 255).astype(np.uint8)
        stamp_ns, due = 0, 0.0

        def capture() -> bool:
            """Ten images a second: a busy computer loses parts of a flood, and so one image of every pair."""
            nonlocal stamp_ns, due
            if time.monotonic() < due:
                return False
            stamp_ns, due = stamp_ns + 33_333_333, time.monotonic() + 0.1
            infos.publish(codecs.CameraInfo().encode((stamp_ns, CAMERA), BAG_WIRE))
            images.publish(DepthImage().encode((stamp_ns, "camera", depth), BAG_WIRE))
            bodies.publish(BodyIndex().encode((stamp_ns, "camera", index), BAG_WIRE))
            return bool(found) and running.number("mesh_tracker", "images with a body index") > 0

        assert running.until(capture, 60.0)
        (skeleton,) = cloud_to_skeletons(found[0])
        assert skeleton.valid.all() and running.number("mesh_tracker", "images of another size") == 0
