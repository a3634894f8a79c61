"""Markers as a process: every body of a cloud is there, sensors stand where they are calibrated, the silent vanish."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from running import RELIABLE, Running  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from body_tracking.core.qos import LATCHED  # noqa: E402
from body_tracking.core.sensor_poses import level_pose  # noqa: E402
from body_tracking.core.skeleton import N_JOINTS, Skeleton  # noqa: E402
from body_tracking.messages.base import RosMessages  # noqa: E402
from body_tracking.messages.calibration import pose_to_transform  # noqa: E402
from body_tracking.messages.skeletons import skeletons_to_cloud  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.ros.bag_topics import to_profile  # noqa: E402

ROS = RosMessages()


def standing(body: int, frame_id: str, covariance: bool) -> Skeleton:
    positions = np.random.default_rng(body).normal(size=(N_JOINTS, 3))
    covariances = np.tile(1e-4 * np.eye(3), (N_JOINTS, 1, 1)) if covariance else None
    return Skeleton(5, frame_id, positions, np.full(N_JOINTS, 2, np.uint8), body, covariances)


def test_markers_show_only_topics_with_new_messages(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        running.start("body_markers", rate=10.0)
        arrays = running.collect(MarkerArray, graph.markers_topic("body1"), RELIABLE)
        node = running.node
        filtered = node.create_publisher(PointCloud2, graph.FILTERED, to_profile(graph.SKELETON))
        sensor = node.create_publisher(PointCloud2, graph.skeleton_topic("kinect2"), to_profile(graph.SKELETON))
        poses = node.create_publisher(TransformStamped, graph.CALIBRATION, to_profile(LATCHED))
        bodies = skeletons_to_cloud([standing(0, "world", True), standing(1, "world", True)], ROS)
        seen = skeletons_to_cloud([standing(2, "kinect2_optical_frame", False)], ROS)

        def shown(wanted: set[str]) -> bool:
            filtered.publish(bodies)
            sensor.publish(seen)
            return bool(arrays) and {marker.ns for marker in arrays[-1].markers} == wanted

        skeletons = {"filtered/joints", "filtered/bones", "uncertainty"}
        assert running.until(lambda: shown(skeletons), 60.0), running.log("body_markers")
        joints = next(marker for marker in arrays[-1].markers if marker.ns == "filtered/joints")
        assert len(joints.points) == 2 * N_JOINTS  # both bodies
        assert sum(marker.ns == "uncertainty" for marker in arrays[-1].markers) == 2 * N_JOINTS

        # A sensor's skeleton is drawn once its place is known.
        poses.publish(pose_to_transform(level_pose("kinect2", 1.0), "world", ROS))
        placed = skeletons | {"kinect2/joints", "kinect2/bones", "sensors", "sensors/names"}
        assert running.until(lambda: shown(placed), 60.0)
        view = next(marker for marker in arrays[-1].markers if marker.ns == "sensors")
        assert view.pose.position.z == 1.0
        assert running.until(lambda: {marker.ns for marker in arrays[-1].markers} == {"sensors", "sensors/names"}, 60.0)
