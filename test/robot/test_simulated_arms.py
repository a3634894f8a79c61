"""The simulated arms of ``examples/robot_arms``: they copy the posture of a person as mapped, and follow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from simulated_arm import SimulatedArm

from body_tracking.core import so3
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names, angles_of
from body_tracking.kinematics.stage import state_estimate
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.robot.mapping import RobotMapping, load
from draws import draws

ROOT = Path(__file__).resolve().parents[2]
NAMES = {name: angle_names(name) for name in ALL_CONVENTIONS}
ROBOTS = ("two_joint_arm", "iiwa7")
MODEL = UpperBody()
FORWARD, LEFT, DOWN = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, -1.0])


def arm_of(robot: str) -> tuple[RobotMapping, SimulatedArm]:
    """A mapping and its arm."""
    mapping = load(ROOT / "config" / "robots" / f"{robot}.yaml", NAMES)
    return mapping, SimulatedArm(ROOT / "examples" / "robot_arms" / f"{robot}.xml", mapping.joints, mapping.home)


def directions(arm: SimulatedArm, elbow: int, wrist: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along upper arm and forearm; by the places of these joints."""
    points = arm.points
    parts = points[elbow] - points[1 if elbow > 1 else 0], points[wrist] - points[elbow]
    return parts[0] / np.linalg.norm(parts[0]), parts[1] / np.linalg.norm(parts[1])


@settings(max_examples=draws(12, 30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    plane=st.floats(-0.4, 1.8),
    elevation=st.floats(0.3, 1.9),
    rotation=st.floats(-1.2, 1.2),
    flexion=st.floats(0.2, 1.9),
)
def test_the_seven_axes_point_where_the_persons_arm_does(
    plane: float, elevation: float, rotation: float, flexion: float
) -> None:
    # a person whose left upper arm is turned as the ISB's Y X Y sequence says, mirrored, with the trunk upright
    y, x = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    turned = [so3.exp(y * plane), so3.exp(np.cross(y, x) * elevation), so3.exp(y * rotation)]
    q = MODEL.neutral()
    upper_arm = so3.quat_multiply(so3.quat_multiply(turned[0], turned[1]), turned[2])
    q[MODEL.quaternion_of("upper_arm_left")] = upper_arm
    place = {MODEL.coordinate_names[v]: int(k) for v, k in zip(MODEL.scalar_v, MODEL.scalar_q, strict=True)}
    q[place["elbow_flexion_left"]] = flexion
    estimate = state_estimate(MODEL, 0, "world", q, np.zeros(MODEL.nv), 1e-4 * np.eye(2 * MODEL.nv))
    angles = angles_of(estimate, MODEL, "isb")
    mapping, _ = arm_of("iiwa7")
    person = np.array([angles.position[angles.names.index(name)] for name in mapping.angles])
    target = mapping.matrix @ person + mapping.offset
    target += mapping.period * np.round((mapping.home - target) / mapping.period)
    arm = SimulatedArm(ROOT / "examples" / "robot_arms" / "iiwa7.xml", mapping.joints, target)
    upper, lower = directions(arm, 3, 5)
    matrix = so3.quat_to_matrix(upper_arm)
    bent = so3.quat_to_matrix(so3.exp(np.array([0.0, -flexion, 0.0])))
    np.testing.assert_allclose(upper, matrix @ DOWN, atol=1e-3)
    np.testing.assert_allclose(lower, matrix @ bent @ DOWN, atol=1e-3)


def test_the_two_joint_arm_hangs_and_bends_forward() -> None:
    mapping, arm = arm_of("two_joint_arm")
    upper, lower = directions(arm, 1, 2)
    np.testing.assert_allclose([upper, lower], [DOWN, DOWN], atol=1e-9)
    raised = SimulatedArm(
        ROOT / "examples" / "robot_arms" / "two_joint_arm.xml", mapping.joints, np.array([np.pi / 2, np.pi / 2])
    )
    upper, lower = directions(raised, 1, 2)
    np.testing.assert_allclose(upper, FORWARD, atol=1e-9)
    np.testing.assert_allclose(lower, -DOWN, atol=1e-9)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_servos_follow_a_motion_within_the_limits(robot: str) -> None:
    mapping, arm = arm_of(robot)
    middle, reach = 0.5 * (mapping.lower + mapping.upper), 0.3 * (mapping.upper - mapping.lower)
    pace = 0.8 * mapping.rate.min() / reach.max()
    behind = []
    for time in np.arange(0.0, 6.0, 0.01):
        arm.go_to(middle + reach * np.sin(pace * time) * min(time, 1.0), 0.02)
        arm.advance(0.01)
        if time > 2.0:
            behind.append(np.abs(arm.position - arm.set_point))
    assert np.max(behind) < 0.15
    assert np.sqrt(np.mean(np.square(behind))) < 0.06


def test_a_point_is_reached_in_the_stated_time_and_not_before() -> None:
    mapping, arm = arm_of("two_joint_arm")
    goal = mapping.home + 0.2
    arm.go_to(goal, 0.1)
    arm.advance(0.05)
    np.testing.assert_allclose(arm.set_point, mapping.home + 0.1, atol=1e-9)
    arm.advance(0.06)
    np.testing.assert_allclose(arm.set_point, goal, atol=1e-9)
