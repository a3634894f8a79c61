"""``ros2 launch`` as in README.md."""

from __future__ import annotations

import time
from dataclasses import fields

import numpy as np
import pytest
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, PointCloud2
from tools import NO_DAEMON, Tools

from body_tracking.camera.topics import COMPRESSED, DRIVERS, CameraTopics
from body_tracking.core.names import WHOLE_DOMAIN
from body_tracking.core.qos import SENSOR_DATA
from body_tracking.mesh.topics import IMAGES
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader
from body_tracking.ros.bag_topics import to_profile
from draws import some
from pose_networks import MISSING, REASON

ANGLES, DEVIATIONS = graph.joint_states_topic("body1"), graph.joint_states_stddev_topic("body1")
SOON = 180.0
"""Seconds within which angles come, on a machine with much else to do; the first start compiles all that it imports."""


def test_a_rig_in_a_namespace_follows_changes_of_filter_and_convention_and_ends_with_its_bag(tools: Tools) -> None:
    angles = tools.bench.collect(JointState, f"/lab{ANGLES}")
    given = f"bag:={tools.bag('tpose_torso_twist')}", "record:=live", "filter:=ekf", "rate:=0.2"
    launch = tools.launch(*given, "namespace:=lab")

    def comes(convention: str) -> bool:
        """Whether angles of a convention come from now on."""
        angles.clear()
        return tools.bench.until(lambda: [each for each in angles if each.header.frame_id == convention], SOON)

    assert comes("model"), launch.text()

    def names() -> set[str]:
        return {name for name, _ in tools.bench.node.get_topic_names_and_types()}

    wanted = {f"/lab{topic}" for topic in (graph.FUSED, graph.FILTERED, graph.CALIBRATION)}
    assert tools.bench.until(lambda: wanted <= names(), SOON), names()  # angles may come before they are discovered
    assert not [name for name in names() - WHOLE_DOMAIN if not name.startswith("/lab/")]
    tools.ask("lumbar_flexion_body1", "topic", "echo", "--once", f"/lab{ANGLES}", NO_DAEMON, "--spin-time", "3")
    for node, parameter, value, convention in (
        ("/lab/skeleton_filter", "filter", "lkf_zero_velocity", "positional"),
        ("/lab/joint_angles", "convention", "isb", "isb"),
    ):
        tools.ask("successful", "param", "set", node, parameter, value, NO_DAEMON, "--timeout", "10")
        assert comes(convention), launch.text()
    angles.clear()
    assert not tools.bench.until(lambda: [each for each in angles if each.header.frame_id != "isb"], 1.0)
    assert angles
    tools.ask("success=True", "service", "call", "/lab/calibration/start", "std_srvs/srv/Trigger")
    # the bag was slow to last as long as all this
    fast = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=20.0)
    assert tools.bench.set_parameter("lab/bag_player", "rate", fast)[0]
    assert launch.ended() == 0, launch.text()
    assert "Traceback" not in launch.text() and "[ERROR]" not in launch.text()
    with BagReader(tools.folder / "live") as bag:
        assert bag.whole and bag.topics[f"/lab{ANGLES}"].count > 0


@pytest.mark.slow  # CI runs it in `make test-ros2`
@pytest.mark.skipif(bool(MISSING), reason=REASON)
def test_colour_and_depth_cameras_have_a_launch_of_their_own(tools: Tools) -> None:
    angles, deviations = (tools.bench.collect(JointState, topic) for topic in (ANGLES, DEVIATIONS))
    bag = tools.share / "bags" / "camera_reaching"
    given = f"bag:={bag}", "driver:=plain", "compressed:=colour", "rate:=0.4"
    launch = tools.launch(*given, file="cameras.launch.py")
    assert tools.bench.until(lambda: len(angles) > 10 and len(deviations) > 10, SOON), launch.text()
    known = [angle for angle in deviations[-1].position if np.isfinite(angle)]
    assert len(known) > 5, deviations[-1]
    launch.interrupt()
    assert launch.ended() == 0, launch.text()
    assert "Traceback" not in launch.text() and "[ERROR]" not in launch.text()


@pytest.mark.slow
@pytest.mark.skipif(bool(MISSING), reason=REASON)
@pytest.mark.parametrize("driver", ["realsense", "orbbec", "azure_kinect"])
def test_images_come_by_the_topics_of_the_driver(tools: Tools, driver: str) -> None:
    recorded, given = DRIVERS["plain"].of("camera1"), DRIVERS[driver].of("camera1")
    topics = {getattr(recorded, field.name): getattr(given, field.name) for field in fields(CameraTopics)}
    kinds = {recorded.colour: CompressedImage, recorded.depth: Image}
    node = tools.bench.node
    with BagReader(tools.share / "bags" / "camera_reaching") as bag:
        messages = [(raw.topic.removesuffix(COMPRESSED), raw.cdr) for raw in bag.messages()]
    messages = [each for each in messages if each[0] in topics]
    publishers = {
        topic: node.create_publisher(
            kinds.get(topic, CameraInfo), theirs + COMPRESSED * (topic == recorded.colour), to_profile(IMAGES)
        )
        for topic, theirs in topics.items()
    }
    skeletons = tools.bench.collect(PointCloud2, graph.skeleton_topic("camera1"), to_profile(SENSOR_DATA))
    words = f"driver:={driver}", "camera:=camera1", "compressed:=colour"
    launch = tools.launch(*words, file="cameras.launch.py")
    assert tools.bench.until(lambda: all(each.get_subscription_count() for each in publishers.values()), SOON)
    infos = [each for each in messages if each[0] not in kinds]
    waiting = [*infos, *(each for each in messages if each[0] in kinds)]

    def played() -> bool:
        if waiting:
            topic, cdr = waiting.pop(0)
            publishers[topic].publish(bytes(cdr))
            time.sleep(0.02)
        return bool(skeletons)

    assert tools.bench.until(played, SOON), launch.text()
    launch.interrupt()
    assert launch.ended() == 0, launch.text()


WRONG = {
    ("filter:=kalman", "bag:={bag}"): "filter: invalid choice: 'kalman'",
    ("viewer:=yes", "bag:={bag}"): "viewer:=yes: expected true or false",
    ("sensors:=kinect1,kinect7", "bag:={bag}"): "no topic /kinect7/skeleton; its sensors are kinect1, kinect2",
    ("bag:=nowhere",): "nowhere: no such recording",
    (): "nothing to read: give a bag, a parameters file",
    ("bag:={bag}", "record:=there"): "there: exists already",
    ("bag:={bag}", "namespace:=1st"): "1st",
    ("bag:={bag}", "recrod:=live"): "recrod: no such argument; did you mean 'record'?",
    ("bag:={bag}", "rate:=fast"): "rate: invalid float value: 'fast'",
    ("bag:={bag}", "params_file:=nowhere.yaml"): "nowhere.yaml",
}


def test_wrong_values_end_the_launch_in_one_line(tools: Tools) -> None:
    (tools.folder / "there").mkdir()
    (tools.folder / "there" / "file").touch()
    launches = {
        text: tools.launch(*(argument.format(bag=tools.bag()) for argument in arguments))
        for arguments, text in some(list(WRONG.items()), 2)
    }
    for text, launch in launches.items():
        assert launch.ended() == 1
        lines = [line for line in launch.text().splitlines() if "[INFO]" not in line]
        assert len(lines) == 1 and text in lines[0], lines


def test_the_list_of_arguments_names_them_as_launch_does(tools: Tools) -> None:
    for file in ("two_kinects.launch.py", "cameras.launch.py"):
        said = tools.ask("'params_file':", "launch", "body_tracking", file, "--show-args")
        assert "camera_rig" in said and not [line for line in said.splitlines() if "--" in line], said


def test_node_that_refuses_its_parameters_ends_the_launch(tools: Tools) -> None:
    """The node is not restarted for ever."""
    (tools.folder / "calibration.yaml").write_text("[" * 10)
    launch = tools.launch(f"bag:={tools.bag()}", "calibration:=calibration.yaml")
    assert launch.ended() == 1, launch.text()
    assert [line for line in launch.text().splitlines() if "calibration.yaml" in line], launch.text()
    assert "Traceback" not in launch.text()
