"""Angles there and back, and commands to robots, in both families of message classes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from body_tracking.kinematics.angles import JointAngles
from body_tracking.messages.angles import angles_to_joint_states, joint_states_to_angles
from body_tracking.messages.base import FLOAT_ARRAY, JOINT_TRAJECTORY, MessageError, MessageTypes, RosMessages
from body_tracking.messages.robots import command_to_array, command_to_trajectory
from body_tracking.recording.rosbag2 import BAG_MESSAGES, deserialize, serialize

ANGLES = JointAngles(
    1_750_000_000_123_456_789,
    ("elbow_flexion_left", "shoulder_plane_left"),
    np.array([0.5, np.nan]),
    np.array([0.1, 0.2]),
    np.array([0.05, np.inf]),
    np.array([0.3, 0.4]),
)


@pytest.fixture(params=["bag", "ros"])
def types(request: pytest.FixtureRequest) -> MessageTypes:
    if request.param == "bag":
        return BAG_MESSAGES
    pytest.importorskip("rclpy", reason="ROS is not installed")
    return RosMessages()


def test_angles_come_back_as_they_were(types: MessageTypes) -> None:
    found = joint_states_to_angles(*angles_to_joint_states(ANGLES, "body1", "world", types), "body1")
    assert (found.stamp_ns, found.names) == (ANGLES.stamp_ns, ANGLES.names)
    for name in ("position", "velocity", "position_stddev", "velocity_stddev"):
        np.testing.assert_array_equal(getattr(found, name), getattr(ANGLES, name))


def test_what_does_not_go_together_is_refused(types: MessageTypes) -> None:
    def pair(**changes: Any) -> tuple[Any, Any]:
        values, deviations = angles_to_joint_states(ANGLES, "body1", "world", types)
        for name, value in changes.items():
            setattr(deviations, name, value)
        return values, deviations

    with pytest.raises(MessageError, match="other names, stamps or frames"):
        joint_states_to_angles(*pair(name=["elbow_flexion_left_body1"]), "body1")
    values, _ = pair()
    _, deviations = angles_to_joint_states(ANGLES, "body1", "isb", types)
    with pytest.raises(MessageError, match="other names, stamps or frames"):
        joint_states_to_angles(values, deviations, "body1")
    with pytest.raises(MessageError, match="does not end in _body2"):
        joint_states_to_angles(*pair(), "body2")
    with pytest.raises(MessageError, match="2, 2, 0, 2 numbers of 2 names"):
        joint_states_to_angles(*pair(position=types.floats(np.empty(0))), "body1")


def test_a_trajectory_has_one_point_without_velocities(types: MessageTypes) -> None:
    message = command_to_trajectory(("a", "b"), np.array([0.25, -1.0]), 3_000_000_007, 0.05, types)
    assert list(message.joint_names) == ["a", "b"]
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 7)
    (point,) = message.points
    assert list(point.positions) == [0.25, -1.0]
    assert len(point.velocities) == 0
    assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 50_000_000)
    assert list(command_to_array(np.array([0.25, -1.0]), types).data) == [0.25, -1.0]


def test_a_recording_can_hold_them() -> None:
    position = np.array([0.5, 1.5])
    for kind, message in (
        (JOINT_TRAJECTORY, command_to_trajectory(("a", "b"), position, 1, 0.1, BAG_MESSAGES)),
        (FLOAT_ARRAY, command_to_array(position, BAG_MESSAGES)),
    ):
        found = deserialize(kind, serialize(message))
        values = found.points[0].positions if kind == JOINT_TRAJECTORY else found.data
        np.testing.assert_array_equal(values, position)
