"""The status line of ``up``."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from body_tracking.messages.node_status import NodeStatus
from body_tracking.ros.graph_monitor import calibration_part


def test_the_status_line_names_a_calibration_only_where_there_is_something_to_calibrate() -> None:
    assert calibration_part(None, ()) == []
    assert calibration_part(None, ("kinect1",)) == ["calibration: none"]
    assert calibration_part(NodeStatus("calibration: state", 0, "calibrated"), ()) == ["calibration: calibrated"]
