"""Markers, segments and joint states as messages: whole enough to be sent, and what comes back is what went in."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.calibration.result import level_pose
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.angles import joint_state_values
from body_tracking.messages.base import MARKERS, SEGMENTS, MessageError
from body_tracking.messages.markers import Markers
from body_tracking.messages.model import joint_state_to_segments, segments_to_joint_state
from body_tracking.recording.rosbag2 import BAG_MESSAGES, deserialize, serialize
from body_tracking.skeleton import BONES, N_JOINTS, Joint, Skeleton
from body_tracking.viewing.colours import INFERRED, PALETTE
from body_tracking.viewing.shapes import ELLIPSOID_RADIUS, ellipsoids, figure, frustum


def standing() -> Skeleton:
    rng = np.random.default_rng(0)
    states = np.full(N_JOINTS, 2, np.uint8)
    states[Joint.HEAD] = 1
    covariances = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (N_JOINTS, 1, 1))
    return Skeleton(0, "world", rng.normal(size=(N_JOINTS, 3)), states, 0, covariances)


def test_markers_arrive_as_they_were_drawn() -> None:
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


def segments_message() -> object:
    model = UpperBody()
    q, nv = model.neutral(), model.nv
    estimate = ModelEstimate(7, "world", 0, q, np.zeros(nv), np.eye(2 * nv), np.empty(0), np.empty(0))
    rng = np.random.default_rng(1)
    count = len(model.segment_names)
    quats = Rotation.random(count, random_state=1).as_quat()
    return segments_to_joint_state(estimate, model.segment_names, rng.normal(size=(count, 3)), quats, BAG_MESSAGES)


def test_segments_come_back() -> None:
    message = segments_message()
    read = deserialize(SEGMENTS, serialize(message))
    names, origins, quats = joint_state_to_segments(read)
    sent = [[t.translation.x, t.translation.y, t.translation.z] for t in message.transforms]
    turned = [[t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w] for t in message.transforms]
    assert names == UpperBody().segment_names
    assert origins == pytest.approx(np.array(sent))
    assert quats == pytest.approx(np.array(turned))


def test_segments_that_are_no_poses_are_refused_by_name() -> None:
    message = segments_message()
    message.transforms[2].rotation.w = np.nan
    with pytest.raises(MessageError, match=UpperBody().segment_names[2]):
        joint_state_to_segments(message)
    message = segments_message()
    message.transforms.pop()
    with pytest.raises(MessageError, match="transforms for"):
        joint_state_to_segments(message)


def test_joint_states_of_other_sizes_are_refused() -> None:
    stamp = SimpleNamespace(sec=1, nanosec=5)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=["a", "b"], position=[0.1, 0.2])
    stamp_ns, names, values = joint_state_values(message)
    assert (stamp_ns, names, values.tolist()) == (1_000_000_005, ("a", "b"), [0.1, 0.2])
    message.position = [0.1]
    with pytest.raises(MessageError, match="1 positions for 2 names"):
        joint_state_values(message)
