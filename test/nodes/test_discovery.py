"""What is discovered of a graph that has ended."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from body_tracking.ros.discovery import Watch
from body_tracking.ros.graph_monitor import GraphMonitor
from domains import domain
from patience import PATIENCE

pytestmark = pytest.mark.processes

LOOKED_S = 1.5
"""Seconds for another participant to be discovered."""


def test_a_graph_is_not_discovered_after_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain()))
    monitor = GraphMonitor(["/body1/joint_states"])
    with Watch() as watch:
        end = time.monotonic() + PATIENCE
        while not watch.now().runs:
            assert time.monotonic() < end
            time.sleep(0.05)
    monitor.close()
    with Watch() as watch:
        end = time.monotonic() + LOOKED_S
        while time.monotonic() < end:
            assert not watch.now().runs
            time.sleep(0.05)
