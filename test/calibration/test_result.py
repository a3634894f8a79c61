"""The reference pose has the axes that REP-103 asks for."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from body_tracking.core.sensor_poses import level_pose


def test_the_reference_sensor_looks_along_x_with_z_up() -> None:
    pose = level_pose("kinect1", height=0.9)
    assert_allclose(pose.apply(np.array([0.0, 0.0, 2.0])), [2.0, 0.0, 0.9], atol=1e-12)  # forward
    assert_allclose(pose.apply(np.array([1.0, 0.0, 0.0])), [0.0, -1.0, 0.9], atol=1e-12)  # right
    assert_allclose(pose.apply(np.array([0.0, 1.0, 0.0])), [0.0, 0.0, -0.1], atol=1e-12)  # down


def test_a_sensor_that_looks_down_sees_the_floor_ahead() -> None:
    ahead = level_pose("kinect1", pitch=0.3).apply(np.array([0.0, 0.0, 2.0]))
    assert_allclose(ahead, [2.0 * np.cos(0.3), 0.0, -2.0 * np.sin(0.3)], atol=1e-12)


def test_a_sensor_rolled_clockwise_sees_its_right_lower() -> None:
    assert level_pose("kinect1", roll=0.2).apply(np.array([1.0, 0.0, 0.0]))[2] < 0.0
