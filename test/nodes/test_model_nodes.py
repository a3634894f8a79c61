"""The extended filter and its joint angles as processes over DDS: outputs, invalid input, and silent sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from rcl_interfaces.msg import ParameterValue  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from running import BAG, LATCHED, RELIABLE, Running  # noqa: E402
from sensor_msgs.msg import Image, JointState, MultiDOFJointState, PointCloud2, TimeReference  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from body_tracking.core.skeleton import NANOSECONDS, Joint, Skeleton, TrackingState  # noqa: E402
from body_tracking.kinematics.upper_body import UpperBody  # noqa: E402
from body_tracking.messages.base import to_nanoseconds  # noqa: E402
from body_tracking.messages.model import image_to_covariance, joint_state_to_model  # noqa: E402
from body_tracking.messages.skeletons import cloud_to_skeletons  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.recording.rosbag2 import BagReader  # noqa: E402

MODEL = UpperBody()
SENSORS = ("kinect1", "kinect2")
STATE, COVARIANCE = graph.MODEL_STATE, graph.MODEL_COVARIANCE


class Tracking(Running):
    """Filter and angles; the test plays sensors and calibration: a shipped recording and its true calibration."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.start("joint_angles", reliable=True, input="model_state", convention="isb")
        self.start_filter()
        with BagReader(BAG) as reader:
            self.frames = [
                (each.topic, each.cdr, each.log_time_ns)
                for each in reader.messages([graph.skeleton_topic(sensor) for sensor in SENSORS])
            ]
            calibration = {graph.TRUE_CALIBRATION: TransformStamped, graph.TRUE_CLOCK: TimeReference}
            self.calibration = [
                (each.topic, deserialize_message(each.cdr, calibration[each.topic]))
                for each in reader.messages(calibration)
            ]
        self.at = 0
        self.publishers = {
            graph.skeleton_topic(sensor): self.node.create_publisher(
                PointCloud2, graph.skeleton_topic(sensor), RELIABLE
            )
            for sensor in SENSORS
        }
        self.poses = self.node.create_publisher(TransformStamped, graph.CALIBRATION, LATCHED)
        self.clocks = self.node.create_publisher(TimeReference, graph.CALIBRATION_CLOCK, LATCHED)
        self.skeletons = self.collect(PointCloud2, graph.FILTERED)
        self.states = self.collect(JointState, STATE)
        self.stddevs = self.collect(JointState, graph.MODEL_STATE_STDDEV)
        self.covariances = self.collect(Image, COVARIANCE)
        self.segments = self.collect(MultiDOFJointState, graph.segments_topic("body1"))
        self.angles = self.collect(JointState, graph.joint_states_topic("body1"))
        self.deviations = self.collect(JointState, graph.joint_states_stddev_topic("body1"))

    def start_filter(self) -> None:
        self.start("skeleton_filter", reliable=True, filter="ekf", predict_after=0.3)

    def calibrate(self) -> None:
        """Publish the true calibration once, in force from the beginning."""
        clock = next(message for topic, message in self.calibration if topic.endswith("clock"))
        self.clocks.publish(clock)
        for topic, message in self.calibration:
            if not topic.endswith("clock"):
                self.poses.publish(message)

    def wait_for_subscribers(self) -> None:
        """Wait until the nodes and the test have found each other."""
        outputs = dict.fromkeys((graph.FILTERED, graph.MODEL_STATE_STDDEV, graph.segments_topic("body1")), 1)
        angles = (graph.joint_states_topic("body1"), graph.joint_states_stddev_topic("body1"))
        self.wait_for_links(
            {"skeleton_filter": outputs | {STATE: 2, COVARIANCE: 2}, "joint_angles": dict.fromkeys(angles, 1)}
        )

    def connected(self) -> bool:
        """Whether the filter has subscribed to both sensors, which it does after the calibration."""
        return all(publisher.get_subscription_count() == 1 for publisher in self.publishers.values())

    def play(self, count: int) -> None:
        """The next frames of the recording, faster than they were; after its end it begins anew."""
        if self.at >= len(self.frames):
            self.at = 0
        for topic, cdr, _ in self.frames[self.at : self.at + count]:
            self.publishers[topic].publish(cdr)
            self.executor.spin_once(timeout_sec=0.01)
        self.at += count

    def silence(self, seconds: float) -> None:
        """Sensors that send nothing while their time goes on: frames within the time that the filter has predicted
        already come too late for it.
        """
        self.until(lambda: False, seconds)
        self.at += round(seconds * 60)

    def play_until(self, condition: Callable[[], object]) -> bool:
        """Play frame after frame, since nodes that connect anew may miss some; returns whether it held in time."""

        def one_more() -> object:
            self.play(1)
            self.until(lambda: False, 0.03)  # there are no more than a recording has
            return condition()

        return self.until(one_more, 30.0)

    def cut_short(self) -> None:
        """Forget the collected messages."""
        for messages in (self.skeletons, self.states, self.stddevs, self.covariances, self.segments, self.angles):
            messages.clear()
        self.deviations.clear()


@pytest.fixture(scope="module")
def tracking(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tracking]:
    with Tracking(tmp_path_factory.mktemp("tracking")) as running:
        assert running.until(running.connected)
        running.wait_for_subscribers()
        yield running


def stamps(messages: list[Any]) -> list[int]:
    return [to_nanoseconds(message.header.stamp) for message in messages]


def test_filter_publishes_only_after_the_calibration(tracking: Tracking) -> None:
    tracking.play(10)
    assert tracking.until(lambda: "10" in tracking.diagnostics.get("skeleton_filter", {}).get("received", ""))
    assert tracking.until(lambda: tracking.said("skeleton_filter").get("alignment uncalibrated") == "10"), (
        tracking.diagnostics
    )
    assert not tracking.skeletons
    tracking.calibrate()
    tracking.until(lambda: False, timeout=1.0)
    tracking.play(60)
    everything = (tracking.skeletons, tracking.states, tracking.stddevs, tracking.covariances, tracking.segments)
    everything += (tracking.angles, tracking.deviations)
    # Predicted ones follow: at some moment all have come.
    assert tracking.until(
        lambda: len(tracking.angles) >= 30 and len({tuple(stamps(messages)) for messages in everything}) == 1
    )


def test_all_messages_describe_the_same_state(tracking: Tracking) -> None:
    for cloud, state, deviation, image, segments in list(
        zip(
            tracking.skeletons, tracking.states, tracking.stddevs, tracking.covariances, tracking.segments, strict=False
        )
    )[-5:]:
        stamp_ns, frame_id, q, _ = joint_state_to_model(state, MODEL)
        assert frame_id == cloud.header.frame_id == segments.header.frame_id == "world"
        (skeleton,) = cloud_to_skeletons(cloud)
        other = [joint for joint in Joint if joint.name.startswith(("KNEE", "ANKLE", "FOOT"))]
        assert (skeleton.states[other] == TrackingState.NOT_TRACKED).all()
        assert (image.height, image.width, image.step, image.encoding) == (64, 32, 128, "32FC1")
        stamp, covariance = image_to_covariance(image, MODEL)
        assert stamp == stamp_ns
        np.testing.assert_allclose(
            np.sqrt(covariance.diagonal()), [*deviation.position, *deviation.velocity], rtol=1e-5
        )
        # Base and segments are where the state has them.
        np.testing.assert_allclose(q[:3], skeleton.positions[Joint.SPINE_BASE], atol=1e-5)
        assert tuple(segments.joint_names) == MODEL.segment_names
        forearm = segments.transforms[MODEL.segment_names.index("forearm_left")].translation
        np.testing.assert_allclose([forearm.x, forearm.y, forearm.z], skeleton.positions[Joint.ELBOW_LEFT], atol=1e-5)


def test_late_subscriber_gets_the_urdf(tracking: Tracking) -> None:
    models = tracking.collect(String, graph.urdf_topic("body1"), LATCHED)
    assert tracking.until(lambda: models)
    robot = ElementTree.fromstring(models[-1].data)
    assert robot.tag == "robot"
    assert any(joint.get("name") == "elbow_flexion_left_body1" for joint in robot.iter("joint"))


def test_without_inputs_the_filter_predicts_and_then_stops(tracking: Tracking) -> None:
    def predicted_ones() -> list[Skeleton]:
        """The skeletons after the last with a tracked joint."""
        seen = [cloud_to_skeletons(cloud)[0] for cloud in tracking.skeletons]
        real = [number for number, each in enumerate(seen) if (each.states == TrackingState.TRACKED).any()]
        return seen[real[-1] + 1 :] if real else []

    def lasted(predicted: list[Skeleton]) -> int:
        return predicted[-1].stamp_ns - predicted[0].stamp_ns

    # 30 a second, from 0.3 s to the 2 s that the filter allows itself; messages are best effort, and a busy machine
    # loses some, or holds up a frame of a sensor until the filter has predicted its time already
    for _ in range(4):
        tracking.silence(2.5)
        tracking.cut_short()
        tracking.play(40)
        tracking.until(lambda: len(predicted_ones()) >= 15, 5.0)
        tracking.until(lambda: False, timeout=2.5)
        predicted = predicted_ones()
        steps = np.diff([each.stamp_ns for each in predicted]) / (NANOSECONDS / 30)
        # a frame of a sensor that came too late has no tracked joint, but stands among the predicted ones, off their
        # grid, and the 2 s count from it
        regular = np.abs(steps - np.round(steps)).max(initial=0.0) < 1e-6
        if regular and 15 <= len(predicted) <= 52 and 1.0 * NANOSECONDS <= lasted(predicted) <= 1.8 * NANOSECONDS:
            break
    assert 15 <= len(predicted) <= 55
    assert all((each.states <= TrackingState.INFERRED).all() for each in predicted)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert (steps >= 0.5).all()
    assert 1.0 * NANOSECONDS <= lasted(predicted) <= 1.8 * NANOSECONDS
    assert len(set(stamps(tracking.angles)) & {each.stamp_ns for each in predicted}) >= 10
    assert tracking.number("skeleton_filter", "predicted frames") >= len(predicted)
    assert predicted[0].covariances is not None
    assert predicted[-1].covariances is not None
    hand = Joint.HAND_LEFT
    assert np.trace(predicted[-1].covariances[hand]) > 2.0 * np.trace(predicted[0].covariances[hand])
    tracking.cut_short()
    tracking.play(20)
    assert tracking.until(lambda: tracking.angles)


def test_restarted_filter_gets_the_latched_calibration(tracking: Tracking) -> None:
    process = tracking.processes["skeleton_filter"]
    process.kill()
    process.wait()
    tracking.until(lambda: False, timeout=0.5)
    tracking.cut_short()
    tracking.start_filter()
    assert tracking.until(lambda: all(p.get_subscription_count() >= 1 for p in tracking.publishers.values()), 30.0)

    def back() -> bool:
        tracking.play(2)
        return bool(tracking.angles and tracking.states and tracking.covariances)

    assert tracking.until(back)


def test_invalid_state_or_covariance_is_counted(tracking: Tracking) -> None:
    tracking.until(lambda: False, timeout=0.5)
    state, image = tracking.states[-1], tracking.covariances[-1]
    states = tracking.node.create_publisher(JointState, STATE, RELIABLE)
    images = tracking.node.create_publisher(Image, COVARIANCE, RELIABLE)
    assert tracking.until(lambda: states.get_subscription_count() and images.get_subscription_count())

    def with_numbers(**changes: Any) -> JointState:
        fields = {"header": state.header, "name": state.name, "position": state.position, "velocity": state.velocity}
        return JointState(**(fields | changes))

    def with_data(data: bytes, **changes: Any) -> Image:
        fields = {"header": image.header, "height": 64, "width": 32, "step": 128, "encoding": "32FC1", "data": data}
        return Image(**(fields | changes))

    bad_states: list[Any] = [
        with_numbers(name=state.name[:-1]),
        with_numbers(name=["nose", *state.name[1:]]),
        with_numbers(position=[float("nan")] * 32),
        with_numbers(velocity=[]),
        b"\x00\x01\x00\x00garbage",
    ]
    bad_images: list[Any] = [
        with_data(bytes(image.data)[:-4]),
        with_data(bytes(image.data), height=32, width=64),
        with_data(bytes(image.data), encoding="mono8"),
        with_data(np.full(2048, np.nan, "<f4").tobytes()),
        b"\x00\x01\x00\x00garbage",
    ]
    wanted = tracking.number("joint_angles", "malformed") + len(bad_states) + len(bad_images)
    for publisher, messages in ((states, bad_states), (images, bad_images)):
        for message in messages:
            publisher.publish(message)
    assert tracking.until(lambda: tracking.number("joint_angles", "malformed") == wanted)
    assert f"{STATE}: malformed message ignored" in tracking.log("joint_angles")
    assert f"{COVARIANCE}: malformed message ignored" in tracking.log("joint_angles")
    tracking.cut_short()
    # some may come too late for a filter that has predicted their time already
    assert tracking.play_until(lambda: tracking.angles)


def test_change_of_filter_keeps_the_sensor_poses(tracking: Tracking) -> None:
    for name, sensors in (("lkf_constant_velocity", 0), ("ekf", 1)):  # a linear filter takes fused skeletons
        assert tracking.set_parameter("skeleton_filter", "filter", ParameterValue(type=4, string_value=name))[0]
        assert tracking.until(
            lambda count=sensors: all(p.get_subscription_count() == count for p in tracking.publishers.values())
        )
    tracking.cut_short()
    assert tracking.play_until(lambda: tracking.angles), (tracking.at, len(tracking.frames), tracking.diagnostics)
