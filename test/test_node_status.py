"""What nodes say of themselves, there and back through a message."""

from __future__ import annotations

import pytest

from body_tracking.messages.diagnostics import diagnostics, statuses
from body_tracking.node_status import NodeStatus
from body_tracking.recording.rosbag2 import BAG_MESSAGES


def test_there_and_back() -> None:
    for level in (0, 2):
        sent = diagnostics(5, "fusion: stream", "", level, "waiting", {"rate": 29.5, "to": "all"}, BAG_MESSAGES)
        (status,) = statuses(sent, 7.0)
        assert status == NodeStatus("fusion: stream", level, "waiting", {"rate": "29.5", "to": "all"}, 7.0)
        assert status.node == "fusion"


def test_the_same_through_the_client_library() -> None:
    pytest.importorskip("rclpy", reason="ROS is not installed")
    from body_tracking.messages.base import RosMessages

    (status,) = statuses(diagnostics(5, "fusion: stream", "", 2, "", {}, RosMessages()))
    assert (status.node, status.level, status.text) == ("fusion", 2, "")


def test_a_number_is_one_or_none() -> None:
    status = NodeStatus("other", 0, "", {"a": "1.5", "b": "soon"})
    assert [status.number(key) for key in "abc"] == [1.5, None, None]
