"""The doctor's own processes in real ROS domains: one that is silent, one in which a graph runs, and broken ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from rclpy.qos import QoSProfile
from running import Running, environment
from sensor_msgs.msg import Imu, PointCloud2

from body_tracking import graph
from body_tracking.doctor import live
from body_tracking.doctor.finding import OK, PROBLEM, WARNING

BAG = Path(__file__).resolve().parent.parent.parent / "bags" / "tpose_wave"
PATIENCE = 90.0
"""Seconds for a process to start on a busy machine."""


def observe(variables: dict[str, str], seconds: float = 2.5) -> live.Observation | str:
    return live.observe(variables, seconds, start_timeout=PATIENCE)


@pytest.fixture(scope="module")
def playing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A player and a fusion; the second sensor has another publisher besides, the third sends what cannot be read."""
    with Running(tmp_path_factory.mktemp("playing")) as running:
        running.start("fusion", reliable=True)
        running.start("bag_player", bag=BAG, loop=True, reliable=True, topics="[/kinect1/skeleton, /kinect2/skeleton]")
        publisher = running.node.create_publisher(PointCloud2, graph.skeleton_topic("kinect2"), QoSProfile(depth=1))
        wrong = running.node.create_publisher(PointCloud2, graph.skeleton_topic("kinect3"), QoSProfile(depth=1))
        running.node.create_publisher(Imu, "/wrist/imu/data", QoSProfile(depth=1))
        running.node.create_timer(0.1, lambda: wrong.publish(PointCloud2()))
        assert running.until(
            lambda: float(running.diagnostics.get("fusion", {}).get("rate in /kinect1/skeleton", 0)) > 20.0, PATIENCE
        )
        assert publisher.get_subscription_count()
        yield running


def test_what_runs_is_seen_and_judged(playing: Running) -> None:
    command = [
        sys.executable,
        "-m",
        "body_tracking.cli",
        "doctor",
        "--json",
        "--sensors",
        "kinect1,kinect4",
        "--seconds",
        "4",
    ]
    command += ["--timeout", f"{PATIENCE:g}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=playing.environment)
    assert playing.until(lambda: process.poll() is not None, 2.0 * PATIENCE)
    assert process.stdout is not None
    findings = json.load(process.stdout)["findings"]
    found = [(each["check"], each["level"], each["found"]) for each in findings]
    assert process.returncode == 1
    assert "end all but one: ros2 topic info -v /kinect2/skeleton" in [each["remedy"] for each in findings]

    def level(check: str, text: str) -> str:
        [answer] = [level for name, level, found_ in found if name == check and text in found_] or [f"none of {found}"]
        return answer

    assert level("discovery", "two processes heard each other after") == OK
    assert level("sensors", "/kinect1/skeleton: ") in (OK, WARNING)  # slow, on a busy machine
    assert any("/kinect1/skeleton: " in text and "% of the joints tracked" in text for _, _, text in found), found
    assert level("sensors", "/kinect2/skeleton: 2 publishers") == PROBLEM
    assert level("sensors", "/kinect3/skeleton: ") == PROBLEM
    assert level("sensors", "/kinect4/skeleton: nobody publishes it; there are kinect1, kinect2, kinect3") == PROBLEM
    assert level("sensors", "/wrist/imu/data: there is a publisher, but nothing came") == PROBLEM
    assert level("nodes", "bag_player: playing") == OK
    assert level("nodes", "fusion: ") in (OK, WARNING)  # a busy machine loses messages


def test_a_sensor_that_was_asked_for_and_is_about_to_begin_is_waited_for(tmp_path: Path) -> None:
    with Running(tmp_path) as running:

        def begin(elapsed: float) -> None:
            if elapsed > 3.0 and not running.processes:
                running.start("kinect_skeleton", file=BAG, loop=True)

        seen = live.observe(running.environment, 0.5, begin, PATIENCE, ("kinect1",))
        assert not isinstance(seen, str), seen
        assert next(iter(live.sensors(seen, ("kinect1",)))).level != PROBLEM


def test_a_middleware_that_is_not_there_is_named() -> None:
    variables = {**environment(), "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    seen = observe(variables)
    assert isinstance(seen, str)
    finding = live.discovery(seen, variables, True)
    assert finding.level == PROBLEM
    assert "rmw_cyclonedds_cpp" in finding.found
    assert "unset RMW_IMPLEMENTATION" in finding.remedy


def test_processes_that_do_not_hear_each_other_are_a_problem() -> None:
    variables = {**environment(), "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}
    seen = observe(variables)
    assert not isinstance(seen, str), seen
    assert seen.heard_after is None
    assert live.discovery(seen, variables, False).level == PROBLEM
    assert not seen.nodes
    assert [each.level for each in live.sensors(seen)] == [OK]


def test_without_ros_the_doctor_says_so_and_lives() -> None:
    """``-I`` and ``-S`` leave out what is installed."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from body_tracking.doctor.environment import environment as e\n"
    )
    code += "print([f.found for f in e({}) if f.level == 'problem'])"
    root = str(BAG.parent.parent)
    answer = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code, root], capture_output=True, text=True, env=variables
    )
    assert "no rclpy" in answer.stdout, answer.stderr
