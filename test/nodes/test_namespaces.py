"""Rigs in namespaces: every name of every node, and two rigs in one domain."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from running import BAG, ROOT, Running  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking import systems  # noqa: E402
from body_tracking.core import names  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.recording.rosbag2 import BagReader  # noqa: E402
from domains import domain  # noqa: E402
from pose_networks import startable  # noqa: E402

MARKER_NODES = (
    "marker_cameras",
    "marker_detector",
    "marker_triangulation",
    "rigid_body_tracker",
    "marker_joint_angles",
)
NEEDED: dict[str, dict[str, object]] = {
    "kinect_skeleton": {"file": BAG},
    "imu_skeleton": {"segments": "[forearm_left]"},
    "skeleton_filter": {"filter": "ekf", "orientations": "[forearm_left]"},
    "joint_angles": {"input": "model_state"},
    "robot_commands": {"mapping": ROOT / "config" / "robots" / "iiwa7.yaml"},
    "bag_player": {"bag": BAG},
    "camera_rig": {"setup": ROOT / "config" / "camera_rig"},
    "bag_recorder": {"start_recording": False},
    "viewer": {"port": 0},
    **{name: {"setup": ROOT / "config" / "marker_setup"} for name in MARKER_NODES},
}
"""Parameters without which an executable does not start, or has fewer topics."""


@pytest.mark.parametrize("executable", startable(systems.EXECUTABLES))
def test_every_name_of_a_node_is_in_its_namespace(executable: str) -> None:
    given = {"use_sim_time": True, **NEEDED.get(executable, {})}
    parameters = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    rclpy.init(args=["--ros-args", "-r", "__ns:=/lab/left", *parameters], domain_id=domain())
    try:
        (node_class,) = importlib.import_module(f"body_tracking.nodes.{executable}").main.args
        node = node_class()
        used = {each.topic_name for each in (*node.publishers, *node.subscriptions)}
        services = {each.service_name for each in (*node.services, *node.clients)}
        node.close()
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    own = {name for name in used - names.WHOLE_DOMAIN if name.startswith("/lab/left/")}
    # names with a leading slash in a user's file hold in every namespace
    outside = {"/iiwa7/forward_position_controller/commands", "/iiwa7/joint_states"}
    assert used - names.WHOLE_DOMAIN - own == (outside if executable == "robot_commands" else set())
    assert bool(own) == (executable != "bag_recorder")
    assert services and all(name.startswith("/lab/left/") for name in services)


class Rigs(Running):
    """Two times ``body_tracking up`` in one domain, each with one sensor that plays a bag of its own."""

    BAGS = ("tpose_wave", "tpose_slow_down")

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.angles = {}
        for name, bag in zip(("left", "right"), self.BAGS, strict=True):
            parameters = folder / f"{name}.yaml"
            parameters.write_text(f"kinect1_skeleton: {{ros__parameters: {{file: {ROOT / 'bags' / bag}, loop: true}}}}")
            self.angles[name] = self.collect(JointState, names.resolved(graph.joint_states_topic("body1"), f"/{name}"))
            arguments = ["--namespace", name, "--sensors", "kinect1", "--params-file", parameters]
            words = ["--record", folder / f"{name}_bag", "--log-dir", folder]
            self.start_module(name, "body_tracking.cli", "up", *arguments, *words)


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rigs]:
    with Rigs(tmp_path_factory.mktemp("rigs")) as running:
        assert running.until(lambda: all(len(each) > 60 for each in running.angles.values()), 120.0), running.log(
            "left"
        ) + running.log("right")
        yield running


@pytest.mark.slow
def test_two_rigs_run_in_one_domain(rigs: Rigs) -> None:
    there = {topic for topic, _ in rigs.node.get_topic_names_and_types()}
    assert not [topic for topic in there - names.WHOLE_DOMAIN if not topic.startswith(("/left/", "/right/"))]
    for rig in ("left", "right"):
        own = [
            names.resolved(topic, f"/{rig}")
            for topic in (graph.skeleton_topic("kinect1"), graph.FUSED, graph.FILTERED, graph.CALIBRATION)
        ]
        assert rigs.until(lambda own=own: [rigs.node.count_publishers(topic) for topic in own] == [1] * len(own))
        # fusion receives the rate of one sensor, and the rig's own supervisor reports it
        key = f"rate in /{rig}/kinect1/skeleton"
        assert rigs.until(lambda r=rig, k=key: 15.0 < float(rigs.said(f"{r}/fusion").get(k, 0.0)) < 45.0)
        line = re.compile(r"kinect1 [1-9]\d*, fused [1-9]\d*, angles [1-9]\d* Hz")
        assert rigs.until(lambda r=rig, pattern=line: pattern.search(rigs.log(r)), 60.0), rigs.log(rig)
    assert rigs.call(Trigger, "/right/recorder/stop", Trigger.Request()).success
    with BagReader(rigs.folder / "right_bag") as reader:
        assert {topic for topic in reader.topics if not topic.startswith("/right/")} <= {graph.DIAGNOSTICS_TOPIC}
        assert reader.topics["/right/humans/bodies/body1/joint_states"].count > 30
