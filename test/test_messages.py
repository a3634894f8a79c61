"""Round trips of messages, in both families of classes; inconsistent ones are refused by name."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.imu import ImuSample, ImuSampleError
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import FLOAT_ARRAY, JOINT_TRAJECTORY, MARKERS, SEGMENTS
from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import BONES, N_JOINTS, FloatArray, Joint, Skeleton
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.angles import angles_to_joint_states, joint_state_values, joint_states_to_angles
from body_tracking.messages.base import MessageError, MessageTypes
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.clouds import FLOAT32, POSITION, UINT8, UINT16, make_cloud, read_cloud, record_of
from body_tracking.messages.codecs import Skeletons
from body_tracking.messages.diagnostics import diagnostics, statuses
from body_tracking.messages.imus import message_to_magnetic_field, message_to_sample, sample_to_messages
from body_tracking.messages.model import joint_state_to_segments, segments_to_joint_state
from body_tracking.messages.node_status import NodeStatus
from body_tracking.messages.robots import command_to_array, command_to_trajectory
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, deserialize, serialize
from body_tracking.viewing.colours import INFERRED, PALETTE
from body_tracking.viewing.markers import Markers
from body_tracking.viewing.shapes import ELLIPSOID_RADIUS, ellipsoids, figure, frustum

# --- covariances of joints

UPRIGHT = Skeleton(1, "kinect1_optical_frame", np.ones((N_JOINTS, 3)), np.full(N_JOINTS, 2, dtype=np.uint8))
POSSIBLE = {
    "zero": np.zeros((3, 3)),
    "isotropic": 4e-4 * np.eye(3),
    "of one direction": 1e-4 * np.ones((3, 3)),
    "known across its ray": 1e-6 * np.eye(3) + 1e-2 * np.outer([0.6, 0.0, 0.8], [0.6, 0.0, 0.8]),
    "infinite": np.diag([np.inf] * 3),
}
IMPOSSIBLE = {
    "negative": -1e-4 * np.eye(3),
    "nan": np.full((3, 3), np.nan),
    "correlations above 1": 1e-4 * np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "a negative eigenvalue": 1e-4 * (1.9 * np.eye(3) - 0.9 * np.ones((3, 3))),
}


def with_covariance(of_head: FloatArray) -> tuple[Skeleton, ...]:
    covariances = np.tile(4e-4 * np.eye(3), (N_JOINTS, 1, 1))
    covariances[Joint.HEAD] = of_head
    read = Skeletons().decode(encode_skeletons([replace(UPRIGHT, covariances=covariances)]), BAG_WIRE)
    assert isinstance(read, tuple)
    return read


@pytest.mark.parametrize("kind", POSSIBLE)
def test_possible_covariances_are_read(kind: str) -> None:
    (read,) = with_covariance(POSSIBLE[kind])
    assert read.covariances is not None
    np.testing.assert_allclose(read.covariances[Joint.HEAD], POSSIBLE[kind], rtol=1e-6)


@pytest.mark.parametrize("kind", IMPOSSIBLE)
def test_an_impossible_covariance_is_refused_by_joint(kind: str) -> None:
    with pytest.raises(MessageError, match="covariance of HEAD is impossible"):
        with_covariance(IMPOSSIBLE[kind])


def test_covariances_that_are_all_zero_are_unknown() -> None:
    zero = replace(UPRIGHT, covariances=np.zeros((N_JOINTS, 3, 3)))
    (read,) = Skeletons().decode(encode_skeletons([zero]), BAG_WIRE)
    assert read.covariances is None


def test_the_covariance_of_a_joint_without_a_position_does_not_matter() -> None:
    covariances = np.tile(4e-4 * np.eye(3), (N_JOINTS, 1, 1))
    covariances[Joint.HEAD] = np.nan
    states = UPRIGHT.states.copy()
    states[Joint.HEAD] = 0
    (read,) = Skeletons().decode(encode_skeletons([replace(UPRIGHT, states=states, covariances=covariances)]), BAG_WIRE)
    assert read.covariances is not None


FIELDS = (*POSITION, ("joint", UINT8), ("tracking_state", UINT8), ("body", UINT16))


@pytest.mark.parametrize("field", ["xx", "zz", "vx", "vy"])
def test_skeletons_with_a_part_of_a_covariance_or_a_velocity_are_refused_by_field(field: str) -> None:
    fields = (*FIELDS, (field, FLOAT32))
    points = np.zeros(N_JOINTS, record_of(fields))
    points["joint"] = np.arange(N_JOINTS)
    cloud = make_cloud(points, fields, 1, "kinect1_optical_frame", BAG_MESSAGES)
    with pytest.raises(MessageError, match=f"only the fields {field}"):
        cloud_to_skeletons(cloud)


# --- angles, commands, states of nodes

ANGLES = JointAngles(
    1_750_000_000_123_456_789,
    ("elbow_flexion_left", "shoulder_plane_left"),
    np.array([0.5, np.nan]),
    np.array([0.1, 0.2]),
    np.array([0.05, np.inf]),
    np.array([0.3, 0.4]),
)


def test_an_empty_cloud_of_a_point_step_beyond_all_records_is_refused() -> None:
    cloud = make_cloud(np.empty(0, record_of(POSITION)), POSITION, 1, "camera", BAG_MESSAGES)
    assert len(read_cloud(cloud, dict(POSITION), ["x"], 10)) == 0
    cloud.point_step = 2**32 - 1
    with pytest.raises(MessageError, match="point_step 4294967295 of 0 bytes"):
        read_cloud(cloud, dict(POSITION), ["x"], 10)


def test_angles_round_trip(types: MessageTypes) -> None:
    found = joint_states_to_angles(*angles_to_joint_states(ANGLES, "body1", "world", types), "body1")
    assert (found.stamp_ns, found.names) == (ANGLES.stamp_ns, ANGLES.names)
    for name in ("position", "velocity", "position_stddev", "velocity_stddev"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ANGLES, name))


@pytest.mark.parametrize(
    ("frame_id", "changes", "body", "said"),
    [
        ("world", {"name": ["elbow_flexion_left_body1"]}, "body1", "other names, stamps or frames"),
        ("isb", {}, "body1", "other names, stamps or frames"),
        ("world", {}, "body2", "does not end in _body2"),
        ("world", {"position": np.empty(0)}, "body1", "2, 2, 0, 2 numbers of 2 names"),
    ],
)
def test_deviations_that_do_not_belong_to_the_angles_are_refused(
    types: MessageTypes, frame_id: str, changes: dict[str, Any], body: str, said: str
) -> None:
    values, _ = angles_to_joint_states(ANGLES, "body1", "world", types)
    _, deviations = angles_to_joint_states(ANGLES, "body1", frame_id, types)
    for name, value in changes.items():
        setattr(deviations, name, types.floats(value) if name == "position" else value)
    with pytest.raises(MessageError, match=said):
        joint_states_to_angles(values, deviations, body)


def test_joint_states_of_other_sizes_are_refused() -> None:
    stamp = SimpleNamespace(sec=1, nanosec=5)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=["a", "b"], position=[0.1, 0.2])
    stamp_ns, names, values = joint_state_values(message)
    assert (stamp_ns, names, values.tolist()) == (1_000_000_005, ("a", "b"), [0.1, 0.2])
    message.position = [0.1]
    with pytest.raises(MessageError, match="1 positions for 2 names"):
        joint_state_values(message)


def test_a_trajectory_has_one_point_without_velocities(types: MessageTypes) -> None:
    trajectory = command_to_trajectory(("a", "b"), np.array([0.25, -1.0]), 3_000_000_007, 0.05, types)
    array = command_to_array(np.array([0.25, -1.0]), types)
    if types is BAG_MESSAGES:  # a recording can hold them
        trajectory, array = (
            deserialize(kind, serialize(each)) for kind, each in ((JOINT_TRAJECTORY, trajectory), (FLOAT_ARRAY, array))
        )
    assert list(trajectory.joint_names) == ["a", "b"]
    assert (trajectory.header.stamp.sec, trajectory.header.stamp.nanosec) == (3, 7)
    (point,) = trajectory.points
    assert list(point.positions) == [0.25, -1.0]
    assert len(point.velocities) == 0
    assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 50_000_000)
    assert list(array.data) == [0.25, -1.0]


@pytest.mark.parametrize("level", [0, 2])
def test_statuses_round_trip(types: MessageTypes, level: int) -> None:
    values = {"rate": "29.5", "to": "all"}
    sent = diagnostics(5, "fusion: stream", "", level, "waiting", {"rate": 29.5, "to": "all"}, types)
    (status,) = statuses(sent, 7.0)
    assert status == NodeStatus("fusion: stream", level, "waiting", values, 7.0)
    assert status.node == "fusion"
    assert [status.number(key) for key in ("rate", "to", "absent")] == [29.5, None, None]


# --- inertial sensors

vectors = st.none() | arrays(np.float64, 3, elements=st.floats(-40.0, 40.0))
fields = st.none() | arrays(np.float64, 3, elements=st.floats(-1e-4, 1e-4))
covariances = st.none() | st.floats(1e-6, 1.0).map(lambda variance: variance * np.eye(3))
oriented = st.tuples(st.just(np.array([0.5, -0.5, 0.5, 0.5])), covariances) | st.just((None, None))


@given(st.integers(0, 2**60), oriented, vectors, vectors, fields)
def test_inertial_readings_round_trip(
    types: MessageTypes,
    stamp_ns: int,
    orientation: tuple[FloatArray | None, FloatArray | None],
    rate: FloatArray | None,
    force: FloatArray | None,
    magnetic: FloatArray | None,
) -> None:
    sample = ImuSample(stamp_ns, "wrist_link", *orientation, rate, force, magnetic)
    imu, field = sample_to_messages(sample, types)
    back = replace(
        message_to_sample(imu), magnetic_field=None if field is None else message_to_magnetic_field(field)[2]
    )
    for name in ImuSample.__slots__:
        np.testing.assert_array_equal(getattr(back, name), getattr(sample, name), err_msg=name)
    if sample.orientation is None:
        assert imu.orientation_covariance[0] == -1.0


def test_zero_quaternion_is_absent_only_with_covariance_minus_one() -> None:
    message, _ = sample_to_messages(
        ImuSample(0, "wrist_link", orientation=np.array([0.0, 0.0, 0.0, 1.0])), BAG_MESSAGES
    )
    message.orientation.w = 0.0
    with pytest.raises(ImuSampleError, match="zero quaternion"):
        message_to_sample(message)
    message.orientation_covariance[0] = -1.0
    assert message_to_sample(message).orientation is None


# --- markers and segments


def standing() -> Skeleton:
    rng = np.random.default_rng(0)
    states = np.full(N_JOINTS, 2, np.uint8)
    states[Joint.HEAD] = 1
    covariances = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (N_JOINTS, 1, 1))
    return Skeleton(0, "world", rng.normal(size=(N_JOINTS, 3)), states, 0, covariances)


def test_markers_round_trip() -> None:
    skeleton, pose = standing(), level_pose("kinect1", 1.0)
    markers = Markers(5, "world", BAG_MESSAGES)
    markers.figure("filtered", figure([skeleton], PALETTE[0]), PALETTE[0], 0.02, 0.01)
    markers.ellipsoids("uncertainty", ellipsoids([skeleton]), PALETTE[1], 0.3)
    markers.lines("sensors", 0, frustum(0.3), pose, PALETTE[0])
    message = deserialize(MARKERS, serialize(markers.message()))
    assert {marker.header.frame_id for marker in message.markers} == {"world"}
    assert len({(marker.ns, marker.id) for marker in message.markers}) == len(message.markers)
    found = {marker.ns: marker for marker in message.markers}
    joints = found["filtered/joints"]
    assert np.array([[p.x, p.y, p.z] for p in joints.points]) == pytest.approx(skeleton.positions)
    assert joints.colors[Joint.HEAD].r == pytest.approx(INFERRED[0] / 255.0)
    assert joints.colors[Joint.NECK].r == pytest.approx(PALETTE[0][0] / 255.0)
    assert len(found["filtered/bones"].points) == 2 * len(BONES)
    clouds = [marker for marker in message.markers if marker.ns == "uncertainty"]
    assert len(clouds) == N_JOINTS
    size = sorted([clouds[0].scale.x, clouds[0].scale.y, clouds[0].scale.z])
    assert size == pytest.approx([2 * ELLIPSOID_RADIUS * sigma for sigma in (0.01, 0.02, 0.03)])  # diameters
    assert found["sensors"].pose.position.z == 1.0
    assert found["sensors/names"].text == "kinect1"
    assert all(0 < marker.lifetime.nanosec < 1_000_000_000 for marker in message.markers)


def test_segments_round_trip_and_invalid_poses_are_refused_by_name() -> None:
    model = UpperBody()
    q, nv = model.neutral(), model.nv
    estimate = ModelEstimate(7, "world", 0, q, np.zeros(nv), np.eye(2 * nv), np.empty(0), np.empty(0))
    count = len(model.segment_names)
    origins = np.random.default_rng(1).normal(size=(count, 3))
    quats = Rotation.random(count, random_state=1).as_quat()
    message: Any = segments_to_joint_state(estimate, model.segment_names, origins, quats, BAG_MESSAGES)
    found = joint_state_to_segments(deserialize(SEGMENTS, serialize(message)))
    assert found[0] == model.segment_names
    np.testing.assert_allclose(found[1], origins)
    np.testing.assert_allclose(found[2], quats)
    message.transforms[2].rotation.w = np.nan
    with pytest.raises(MessageError, match=model.segment_names[2]):
        joint_state_to_segments(message)
    message.transforms.pop()
    with pytest.raises(MessageError, match="transforms for"):
        joint_state_to_segments(message)
