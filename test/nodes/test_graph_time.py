"""What a live graph publishes over a recording by the sensors' own clocks can be compared with ``/clock``."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest

pytest.importorskip("rclpy")
from running import environment

from body_tracking.core.message_types import TRANSFORM
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader, deserialize, first_field

MOST_S, LATEST_S = 1.0, 10.0
"""From capture to the log, as a rule and on a machine with much else to do."""
TICK_S = 0.05
"""Of ``/clock``: the recorder may have received one tick less than the publisher of a stamp."""
HOLD_FROM_S = 1.0
"""Calibration is stamped with the time from which on it holds, half a second ahead."""


def test_every_stamp_of_a_live_graph_is_in_the_time_of_its_clock(wave: Path, tmp_path: Path) -> None:
    live = tmp_path / "live"
    words = ["up", "--bag", wave, "--rate", "0.5", "--record", live, "--reliable"]
    done = subprocess.run(
        [sys.executable, "-m", "body_tracking.cli", *words],
        capture_output=True,
        text=True,
        timeout=240,
        env=environment(),
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, list[float]] = {}
    poses: list[int] = []
    shown: list[int] = []
    with BagReader(live) as reader:
        for raw in reader.messages():  # logged by /clock
            if first_field(reader.topics[raw.topic].type_name)[1] != "std_msgs/msg/Header":
                continue
            seconds, rest = struct.unpack_from("<iI", raw.cdr, 4)
            stamp_ns = seconds * NANOSECONDS + rest
            if stamp_ns:  # calibration before anything is known holds always
                found.setdefault(raw.topic, []).append((raw.log_time_ns - stamp_ns) / NANOSECONDS)
            if raw.topic == graph.CALIBRATION:
                poses.append(transform_to_pose(deserialize(TRANSFORM, raw.cdr)).valid_from_ns)
            elif raw.topic == graph.joint_states_topic("body1"):
                shown.append(stamp_ns)
    wanted = {graph.skeleton_topic("kinect1"), graph.FUSED, graph.FILTERED, graph.joint_states_topic("body1")}
    assert wanted <= found.keys()
    for topic, ages in found.items():
        holds = topic in (graph.CALIBRATION, graph.CALIBRATION_CLOCK)
        early = HOLD_FROM_S if holds else TICK_S
        assert -early <= min(ages) and median(ages) < MOST_S and max(ages) < LATEST_S, (topic, min(ages), max(ages))
    # as for a buffer of tf2: at the time of these angles a pose is in force, by its own stamp
    later = [stamp for stamp in shown if any(0 < pose <= stamp for pose in poses)]
    assert len(later) > 30
