"""The stage of ``mesh_tracker``: bad input, the shape of the person, the mesh, and its place in the graph."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from depth_recording import recording

from body_tracking.core import so3
from body_tracking.core.clocks import ClockModel
from body_tracking.core.orientation import OrientationError, SegmentOrientation
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, Joint, SingleArray
from body_tracking.core.sources import SensorNameError
from body_tracking.mesh import body_model, storage
from body_tracking.mesh.codecs import DepthImage, MeshMarker
from body_tracking.mesh.depth import DepthError
from body_tracking.mesh.person import COVERED
from body_tracking.mesh.sensor_orientations import SensorOrientations
from body_tracking.mesh.stage import MeshStage
from body_tracking.mesh.topics import depth_topic, info_topic, mesh_topic
from body_tracking.messages.base import MessageError
from body_tracking.messages.codecs import SensorClock
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Output
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE
from body_tracking.systems import nodes_for, options_of, played

INFO, IMAGES, SKELETONS = info_topic("kinect1"), depth_topic("kinect1"), graph.skeleton_topic("kinect1_mesh")
STAMPS = [*recording().images]
NOW = Now(0, 0)


def made(wanted: bool = False, **given: Any) -> MeshStage:
    return MeshStage(check_all(MeshStage.PARAMETERS, {"camera": "kinect1", **given}), lambda topic: wanted)


def take(node: MeshStage, number: int, depth: SingleArray | None = None) -> list[Output]:
    stamp = STAMPS[number]
    return [*node.take(IMAGES, (stamp, "camera", recording().images[stamp] if depth is None else depth), NOW)]


def calibrated(**given: Any) -> MeshStage:
    node = made(**given)
    assert not [*node.take(INFO, recording().camera, NOW)]
    return node


def test_a_skeleton_with_covariance_has_the_stamp_of_its_image() -> None:
    node = calibrated()
    (output,) = take(node, 0)
    (skeleton,) = output.payload
    assert output.topic == SKELETONS and output.stamp_ns == skeleton.stamp_ns == STAMPS[0]
    assert skeleton.frame_id == "kinect1_mesh_optical_frame"
    assert np.linalg.eigvalsh(skeleton.covariances).min() > 0.0
    assert node.state(0)[0] == 0 and node.counters["images"] == 1


def test_images_without_camera_info_are_counted_and_named() -> None:
    node = made()
    assert take(node, 0) == []
    assert node.counters["images without camera_info"] == 1
    level, text, _ = node.state(0)
    assert level == 1 and INFO in text
    node = calibrated()
    assert take(node, 1) and node.state(0)[:2] == (0, "")


def test_an_image_of_another_size_in_mid_run_is_refused_until_the_calibration_follows() -> None:
    node = calibrated()
    take(node, 0)
    half = recording().images[STAMPS[1]][::2, ::2]
    with pytest.raises(DepthError, match="128 x 106"):
        take(node, 1, half)
    assert node.counters["images of another size"] == 1 and node.state(0)[0] == 1
    assert take(node, 2)  # it did no harm
    own = recording().camera
    matrix = np.diag([0.5, 0.5, 1.0]) @ own.matrix
    [*node.take(INFO, replace(own, width=128, height=106, matrix=matrix), NOW)]
    assert take(node, 3, np.ascontiguousarray(recording().images[STAMPS[3]][::2, ::2]))
    # a driver sends its calibration with each image
    searches = node.counters["searches"]
    [*node.take(INFO, replace(own, width=128, height=106, matrix=matrix.copy()), NOW)]
    assert take(node, 4, np.ascontiguousarray(recording().images[STAMPS[4]][::2, ::2]))
    assert node.counters["searches"] == searches


def test_other_encodings_are_refused_and_counted() -> None:
    node = calibrated()
    message = array_to_image(np.zeros((4, 4), np.uint8), 0, "camera", BAG_MESSAGES, "mono8")
    with pytest.raises(MessageError, match="mono8"):
        DepthImage().decode(BAG_WIRE.serialize("sensor_msgs/msg/Image", message), BAG_WIRE)
    node.refused(IMAGES)
    assert node.counters["messages that cannot be used"] == 1


def test_images_that_repeat_are_not_used_and_named() -> None:
    node = calibrated()
    first = recording().images[STAMPS[0]]
    tracked = [bool(take(node, number, first)) for number in range(15)]
    late = [stamp_ns - STAMPS[0] > 0.3 * NANOSECONDS for stamp_ns in STAMPS[:15]]
    assert 0 < sum(late) < 10 and tracked == [not each for each in late]
    assert node.state(0)[:2] == (1, "the same image again and again is not used: restart the sensor's driver")
    assert node.counters["repeated images of kinect1"] == sum(late)
    assert take(node, 15) and node.state(0)[:2] == (0, "")


@pytest.mark.parametrize("covering", [0.0, np.nan])
def test_a_covered_lens_and_a_hand_before_it_are_survived(covering: float) -> None:
    node = calibrated()
    take(node, 0)
    image = recording().images[STAMPS[1]]
    nothing = np.where(np.isnan(covering), 0.0, covering) * image
    assert take(node, 1, nothing) == [] and COVERED in node.state(0)[1]
    hand = image.copy()
    hand[40:, :] = 0.25  # metres
    take(node, 2, hand)
    assert take(node, 4) and node.state(0)[0] == 0


def test_of_two_people_the_tracked_one_is_kept() -> None:
    node = calibrated()
    take(node, 0)
    for number in range(1, 8):
        image = recording().images[STAMPS[number]].copy()
        # the same person once more, a metre nearer to the edge and half a metre nearer to the camera
        other = np.roll(image, 70, axis=1) - np.float32(0.5)
        image = np.where((other > 0.3) & (other < image - 0.4) & (np.indices(image.shape)[1] > 150), other, image)
        (output,) = take(node, number, image)
        points = output.payload[0].positions
        assert np.linalg.norm(points - recording().joints[STAMPS[number]], axis=1)[Joint.SPINE_MID] < 0.1


def test_the_shape_is_estimated_from_different_poses_and_kept_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "person.yaml"
    node = calibrated(person=str(file), personalise_from=2)
    for number in (30, 31, 106):  # a T-pose, and arms stretched forward
        node.sensor.reset()
        assert not node.counters.get("personalisations")
        take(node, number)
    assert node.counters["personalisations"] == 1 and "body of 1." in node.events[-1]
    node.save()
    again = made(person=str(file))
    np.testing.assert_allclose(again.sensor.body.shape, node.sensor.body.shape, atol=1e-6)
    assert "poses" in node.services["kinect1_mesh/personalise"]()
    for content in ("shape: [1]", "shape: {}", "- 1", "{shape: [0,0,0,0,0,0,0,0,0,0], covariance: [[1]]}"):
        file.write_text(content)
        with pytest.raises(storage.PersonFileError, match=str(file)):
            made(person=str(file))
    file.write_text("mapping: {}")
    with pytest.raises(storage.PersonFileError, match="expected the keys shape and covariance"):
        made(person=str(file))


def test_somebody_else_does_not_get_the_shape_of_who_has_left() -> None:
    node = calibrated()
    sensor = node.sensor
    take(node, 0)
    sensor._wear(body_model.load().body(np.full(12, 0.5)), 0.1 * np.eye(12))
    for number in range(1, 20):
        take(node, number, np.zeros_like(recording().images[STAMPS[0]]))
    assert node.counters["people lost"] == 1 and not sensor.body.shape.any()


def test_the_mesh_is_published_where_a_subscriber_is_and_at_its_rate() -> None:
    node = calibrated(wanted=True)
    meshes = [each for number in range(8) for each in take(node, number) if each.topic == mesh_topic("kinect1")]
    assert len(meshes) == 2  # 5 of 30 a second
    message = BAG_WIRE.deserialize("visualization_msgs/msg/Marker", MeshMarker().encode(meshes[0].payload, BAG_WIRE))
    faces = node.sensor.body.model.faces
    assert message.type == 11 and len(message.points) == faces.size
    points = np.array([[p.x, p.y, p.z] for p in message.points])
    assert np.abs(points.mean(axis=0) - recording().joints[STAMPS[0]].mean(axis=0)).max() < 0.5


def test_time_that_jumped_back_forgets_the_person() -> None:
    node = calibrated()
    take(node, 1)
    node.reset(IMAGES)
    assert take(node, 0) and node.counters["searches"] == 2


def test_a_camera_without_a_name_is_refused() -> None:
    with pytest.raises(SensorNameError, match="sensor"):
        made(camera="")


def test_a_depth_camera_is_a_sensor_of_the_graph_that_its_mesh_tracker_computes() -> None:
    alone = {spec.name: spec for spec in nodes_for(options_of(depth=("kinect1",)))}
    assert alone["kinect1_mesh"].executable == "mesh_tracker" and not any("_skeleton" in name for name in alone)
    assert alone["fusion"].parameters["sensors"] == ("kinect1_mesh",)
    both = {spec.name: spec for spec in nodes_for(options_of(depth=("kinect1",), sensors=("kinect2",)))}
    for specs in (alone, both):
        assert specs["skeleton_filter"].defaults["not_kinects"] == ("kinect1_mesh",)
    assert both["fusion"].parameters["sensors"] == ("kinect2", "kinect1_mesh") and "kinect2_skeleton" in both
    options = options_of(depth=("kinect1",), bag="bag")
    assert played(options, {INFO, IMAGES}) == (INFO, IMAGES)
    with pytest.raises(graph.GraphError, match=IMAGES):
        played(options, {INFO, "/kinect1/skeleton"})


# --- inertial sensors


CAMERA_POSE = SensorPose("kinect1_mesh", np.array([1.0, 2.0, 3.0]), so3.exp(np.array([0.4, -1.2, 2.0])))


HANGING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Axes forward, left and up of a forearm whose person faces the camera, in the optical frame."""
FOREARM = HANGING @ so3.quat_to_matrix(so3.exp(np.array([0.0, -np.radians(40.0), 0.0])))


def turned(stamp_ns: int, quat_xyzw: np.ndarray, rate: np.ndarray | None = None) -> SegmentOrientation:
    rotation, variance = so3.quat_to_matrix(quat_xyzw), 1e-4 if rate is not None else 0.0
    return SegmentOrientation(stamp_ns, "imu", "forearm_left", rotation, 1e-4 * np.eye(3), rate, variance)


def test_an_orientation_comes_to_the_fit_in_the_cameras_frame_at_the_images_time() -> None:
    worn = SensorOrientations(("forearm_left",))
    placement = calibrated().sensor.placement
    placement.set_pose(CAMERA_POSE)
    placement.set_clock(0, ClockModel(offset_ns=-5 * NANOSECONDS))
    at_ns = 100 * NANOSECONDS
    rate, true = np.array([3.0, -1.0, 2.0]), so3.exp(np.array([0.3, 0.5, -0.7]))
    for before_ns in (60_000_000, 20_000_000, -30_000_000):
        measured = so3.quat_multiply(true, so3.exp(-rate * before_ns / NANOSECONDS))
        worn.add(turned(at_ns - before_ns, measured, rate))
    names = body_model.load().joint_names
    counters: Counter[str] = Counter()
    (found,) = worn.seen_from(placement, at_ns - 5 * NANOSECONDS, names, counters)
    assert names[found.joint] == "left_elbow" and not counters
    expected = CAMERA_POSE.rotation.T @ so3.quat_to_matrix(true)
    np.testing.assert_allclose(found.rotation, expected, atol=1e-9)
    # 0.6 deg of the sensor, and the difference between the frames of person and mesh
    assert (np.radians(0.6) < found.stddev).all() and (found.stddev < np.radians(10.0)).all()
    # 60 ms after the newest orientation it is not used any more
    assert worn.seen_from(placement, at_ns - 5 * NANOSECONDS + 90_000_001, names, counters) == []
    assert counters == {"images without an orientation of forearm_left": 1}


def test_orientations_wait_for_the_pose_of_the_camera_and_then_turn_a_hidden_forearm() -> None:
    node = calibrated(orientations=("forearm_left",))
    topic = graph.orientation_topic("forearm_left")
    assert {topic, graph.CALIBRATION, graph.CALIBRATION_CLOCK} < {port.topic for port in node.inputs}
    start = 118
    (first,) = take(node, start)
    assert node.counters["images without the camera's pose for inertial sensors"] == 1
    [*node.take(graph.CALIBRATION, replace(CAMERA_POSE, sensor="kinect2"), NOW)]
    [*node.take(graph.CALIBRATION_CLOCK, SensorClock("kinect1_mesh", 0, ClockModel()), NOW)]
    [*node.take(graph.CALIBRATION, CAMERA_POSE, NOW)]
    # the arm hangs in the images; the sensor says that the forearm is raised forward by 40 degrees
    joints = recording().joints[STAMPS[start]]
    pixel = recording().camera.project(joints[[Joint.ELBOW_LEFT, Joint.WRIST_LEFT, Joint.HAND_TIP_LEFT]]).astype(int)
    (left, top), (right, bottom) = pixel.min(axis=0) - 8, pixel.max(axis=0) + 8
    measured = so3.matrix_to_quat(CAMERA_POSE.rotation @ FOREARM)
    for number in range(start + 1, start + 10):
        hidden = recording().images[STAMPS[number]].copy()
        hidden[top:bottom, left:right] = 1.2
        [*node.take(topic, turned(STAMPS[number] + 5_000_000, measured), NOW)]
        (output,) = take(node, number, hidden)
    along = [
        each.positions[Joint.WRIST_LEFT] - each.positions[Joint.ELBOW_LEFT]
        for each in (first.payload[0], output.payload[0])
    ]
    off = [np.arccos(each @ -FOREARM[:, 2] / np.linalg.norm(each)) for each in along]
    assert off[0] > np.radians(25.0) and off[1] < np.radians(8.0)
    # a jump back of its time forgets the sensor
    node.reset(topic)
    take(node, start + 10)
    assert node.counters["images without an orientation of forearm_left"] == 1
    node.refused(topic)
    assert node.counters["inertial messages that cannot be used"] == 1


def test_only_segments_that_the_mesh_turns_carry_sensors() -> None:
    with pytest.raises(OrientationError, match=r"pelvis.*forearm_left"):
        made(orientations=("forearm_left", "pelvis"))


def test_an_orientation_counts_once_in_the_mesh_or_in_the_filter() -> None:
    given: dict[str, Any] = {"imus": ("forearm_left:wrist", "pelvis"), "filter": "ekf"}
    specs = {spec.name: spec for spec in nodes_for(options_of(depth=("kinect1",), **given))}
    assert specs["kinect1_mesh"].defaults["orientations"] == ("forearm_left",)
    assert specs["skeleton_filter"].defaults["orientations"] == ("pelvis",)
    (alone,) = [spec for spec in nodes_for(options_of(**given)) if spec.name == "skeleton_filter"]
    assert alone.defaults["orientations"] == ("forearm_left", "pelvis")
