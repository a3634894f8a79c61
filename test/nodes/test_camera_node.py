"""``camera_skeleton`` on the shipped images, as ``up`` starts it: skeletons, and angles behind them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from running import ROOT, Running
from sensor_msgs.msg import Image

from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader
from body_tracking.ros.wire import ROS
from excerpts import beginning
from pose_networks import MISSING, REASON
from test_up import Up

BAG = ROOT / "bags" / "camera_reaching"


@pytest.mark.slow  # the angles of `ros2 launch body_tracking cameras.launch.py` come the same way
@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_images_become_skeletons_and_angles_with_deviations(tmp_path: Path) -> None:
    images, recording = beginning(BAG, tmp_path / "excerpt", 2.0), tmp_path / "recording"
    given = ("--bag", images, "--camera", "camera1", "--compressed", "colour", "--record", recording, "--reliable")
    live = Up(tmp_path, *given, "--rate", "0.5")  # at full speed a busy machine leaves images out
    try:
        assert live.until(lambda: live.process.poll() is not None, timeout=120.0), live.text()
        assert live.process.returncode == 0, live.text()
    finally:
        live.close()
    of_body = graph.joint_states_topic("body1"), graph.joint_states_stddev_topic("body1")
    topics = [graph.skeleton_topic("camera1"), *of_body]
    with BagReader(recording) as reader:
        counts = {topic: reader.topics[topic].count for topic in topics}
        skeletons = [decode_skeletons(raw.cdr) or () for raw in reader.messages(topics[:1])]
    assert counts[topics[0]] >= 29 and all(len(each) == 1 for each in skeletons)
    assert counts[topics[1]] == counts[topics[2]] >= 25


@pytest.mark.parametrize(
    ("node", "parameters", "topic"),
    [
        pytest.param(
            "camera_skeleton",
            {"camera": "camera1", "driver": "realsense", "depth_pose": "[-0.015, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]"},
            "/camera/camera1/color/image_raw",
            marks=pytest.mark.skipif(bool(MISSING), reason=REASON),
        ),
        ("marker_detector", {"setup": str(ROOT / "config" / "marker_setup")}, "/left/image_raw, /right/image_raw"),
        ("mesh_tracker", {"camera": "kinect1"}, "/kinect1/depth/camera_info, /kinect1/depth/image_raw"),
    ],
)
def test_a_driver_that_does_not_run_is_reported_with_the_topics_that_are_missing(
    node: str, parameters: dict[str, str], topic: str, tmp_path: Path
) -> None:
    with Running(tmp_path) as running:
        running.start(node, **parameters)
        assert running.until(lambda: running.said(node).get("level") == "1", timeout=60.0)
    text = running.said(node)[""]
    assert text.startswith("nothing arrives on ") and topic in text


def test_images_of_drivers_become_sets_with_equal_stamps(tmp_path: Path) -> None:
    setup = ROOT / "config" / "marker_setup"
    with Running(tmp_path) as running:
        running.start("marker_cameras", setup=setup, images="/first/image,/second/image")
        images = running.collect(Image, "/right/image_raw")
        publishers = [running.node.create_publisher(Image, f"/{name}/image", 10) for name in ("first", "second")]

        def publish() -> None:
            for publisher in publishers:
                stamp_ns = running.node.get_clock().now().nanoseconds // 100_000_000 * 100_000_000
                publisher.publish(array_to_image(np.zeros((480, 640), np.uint8), stamp_ns, "driver", ROS))

        running.node.create_timer(0.1, publish)
        assert running.until(lambda: len(images) > 3, 30.0), (
            running.said("marker_cameras"),
            running.log("marker_cameras"),
        )
    assert images[0].header.frame_id == "right_optical_frame"
