"""A node that was stopped and goes on publishes no old angles: real processes, SIGSTOP and SIGCONT."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from running import RELIABLE, Running, free_port  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from body_tracking.core.skeleton import NANOSECONDS  # noqa: E402
from body_tracking.messages.base import to_nanoseconds  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.ros import dds  # noqa: E402
from body_tracking.ros.backlog import MAX_AGE  # noqa: E402

STOPPED = 2.5
"""Seconds for which a node is stopped."""


class Live(Running):
    """The nodes from one sensor on the network, whose stamps are ROS time, to the angles."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        # as under ``up``: over UDP, whose buffers keep messages while a process is stopped
        del self.environment["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        with patch.dict(os.environ, self.environment, clear=True):
            dds.stay_on_this_machine()
            self.environment = dict(os.environ)
        port = free_port()
        for name in ("calibration", "fusion", "skeleton_filter"):
            self.start(name, sensors="[kinect1]")
        self.start("joint_angles")
        self.start("kinect_skeleton", sensor="kinect1", backend="network", port=port)
        self.replay("kinect_sender", port)
        self.stamps: list[tuple[int, int]] = []
        """Capture and arrival of the angles, nanoseconds."""
        self.node.create_subscription(JointState, graph.joint_states_topic("body1"), self.note, RELIABLE)

    def note(self, angles: JointState) -> None:
        """Record capture and arrival of angles."""
        self.stamps.append((to_nanoseconds(angles.header.stamp), time.time_ns()))


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    with Live(tmp_path_factory.mktemp("live")) as running:
        assert running.until(lambda: len(running.stamps) > 30, 60.0), running.diagnostics
        yield running


def stopped_and_continued(live: Live, name: str) -> tuple[float, float]:
    """Seconds: age at the end of the standstill of the oldest angles but one that came after it; delay otherwise."""
    process = live.processes[name]
    process.send_signal(signal.SIGSTOP)
    live.until(lambda: False, STOPPED)
    before = live.stamps[-60:]
    live.stamps.clear()
    continued_ns = time.time_ns()
    process.send_signal(signal.SIGCONT)
    assert live.until(lambda: sum(stamp > continued_ns for stamp, _ in live.stamps) > 60, 30.0)
    undisturbed = [*before, *(each for each in live.stamps if each[0] > continued_ns)]
    delay = max(arrival - stamp for stamp, arrival in undisturbed)
    # One message may have been between the last check of the clock and the system call that sends it.
    oldest = continued_ns - sorted(stamp for stamp, _ in live.stamps)[1]
    return oldest / NANOSECONDS, delay / NANOSECONDS


@pytest.mark.parametrize("name", ["kinect_skeleton", "fusion", "skeleton_filter", "joint_angles"])
def test_no_old_angles_are_published_after_a_standstill(live: Live, name: str) -> None:
    for _ in range(3):
        oldest, delay = stopped_and_continued(live, name)
        # A message older than MAX_AGE is dropped; on a busy machine the nodes add their own delay.
        assert oldest < MAX_AGE + max(0.2, delay)
        if delay < STOPPED / 2:
            return
    pytest.fail(f"angles come {delay:.1f} s late without a standstill, so that the test says nothing")
