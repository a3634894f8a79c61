"""The status line of ``up``."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from body_tracking.messages.node_status import NodeStatus
from body_tracking.ros.graph_monitor import GraphMonitor, calibration_part, problem_parts


def test_the_status_line_names_a_calibration_only_where_there_is_something_to_calibrate() -> None:
    assert calibration_part(None, ()) == []
    assert calibration_part(None, ("kinect1",)) == ["calibration: none"]
    assert calibration_part(NodeStatus("calibration: state", 0, "calibrated"), ()) == ["calibration: calibrated"]


def test_problems_are_named_by_their_nodes() -> None:
    """``up`` prints them while no angles come, and at its end if none came."""
    found = {
        "imu_skeleton": NodeStatus("imu_skeleton: state", 1, "forearm_left: not aligned"),
        "calibration": NodeStatus("calibration: state", 1, "waiting for a still pose"),
        "robot_commands": NodeStatus("robot_commands: state", 1, "stopped: no angles yet"),  # named after "robot"
        "fusion": NodeStatus("fusion: state", 0, "fusing"),
        "bag_player": NodeStatus("bag_player: bag", 2, ""),
    }
    assert problem_parts(found) == ["imu_skeleton: forearm_left: not aligned"]
    monitor = object.__new__(GraphMonitor)  # without a node
    monitor._statuses, monitor.angles = found, 0
    options = {"bag": "arm", "record": None}
    end = "played arm in 3.0 s with start and end: 0 frames of joint angles"
    assert monitor.summary(options, 3.0, {}) == f"{end} (imu_skeleton: forearm_left: not aligned)"
    monitor.angles = 7
    assert monitor.summary(options, 3.0, {}) == "played arm in 3.0 s with start and end: 7 frames of joint angles"
    stopped = monitor.summary(options, 3.0, {}, played=False)
    assert stopped == "stopped before the end of arm, after 3.0 s with the start: 7 frames of joint angles"
