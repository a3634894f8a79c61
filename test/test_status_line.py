"""The status line of ``up``."""

from __future__ import annotations

import os
import pty
import select
import sys
import time
from collections import deque
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from body_tracking.messages.node_status import NodeStatus
from body_tracking.pipeline.system import Options
from body_tracking.ros.graph_monitor import GraphMonitor, calibration_part, losses_part, problem_parts
from body_tracking.ros.up import Console
from body_tracking.systems import options_of


def test_the_status_line_names_a_calibration_only_where_there_is_something_to_calibrate() -> None:
    assert calibration_part(None, ()) == []
    assert calibration_part(None, ("kinect1",)) == ["calibration: none"]
    assert calibration_part(NodeStatus("calibration: state", 0, "calibrated"), ()) == ["calibration: calibrated"]


def test_problems_are_named_by_their_nodes(tmp_path: Path) -> None:
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
    end = "played arm in 3.0 s (start and end included): 0 frames of joint angles"
    assert monitor.summary(options, 3.0, {}) == f"{end} (imu_skeleton: forearm_left: not aligned)"
    monitor.angles = 7
    assert monitor.summary(options, 3.0, {}) == "played arm in 3.0 s (start and end included): 7 frames of joint angles"
    stopped = monitor.summary(options, 3.0, {}, played=False)
    assert stopped == "stopped before the end of arm, after 3.0 s (start included): 7 frames of joint angles"
    found["bag_player"] = NodeStatus("", 0, "at the end", {"position s": "15.4", "duration s": "15.4"})
    assert monitor.summary(options, 3.0, {}, played=False).startswith("played arm in 3.0 s")  # it stays at its end
    options["record"] = str(tmp_path / "session")
    assert monitor.summary(options, 3.0, {}).endswith(", nothing was recorded")  # the first message makes it
    (tmp_path / "session").mkdir()
    assert monitor.summary(options, 3.0, {}).endswith(f", recorded in {tmp_path / 'session'}")
    for last, more in (("session", ""), ("session_3", f" to {tmp_path / 'session_3'}")):  # a folder for each round
        found["bag_recorder"] = NodeStatus("", 0, "", {"messages": "9", "bag": str(tmp_path / last)})
        assert monitor.summary(options, 3.0, {}).endswith(f", recorded in {tmp_path / 'session'}{more}")


def test_messages_that_a_node_did_not_process_are_reported_where_they_are_many() -> None:
    def status(**values: int) -> NodeStatus:
        return NodeStatus("", 0, "", {key.replace("_", " "): str(value) for key, value in values.items()})

    found = {
        "marker_detector": status(received=82, **{"lost /left/image_raw": 89, "dropped /right/image_raw": 4}),
        "fusion": status(received=1000, **{"lost /kinect1/skeleton": 9}),
        "bag_recorder": status(received=1000, lost=0),
        "viewer": status(received=100, **{"lost /kinect1/skeleton": 1000}),  # shows what is newest
    }
    text = "messages not processed (machine or network too slow): marker_detector 93"
    assert losses_part(found) == [text]
    monitor = object.__new__(GraphMonitor)  # without a node
    monitor._statuses, monitor.angles = found, 7
    assert monitor.summary({"bag": "", "record": None}, 3.0, {}) == (
        f"ran for 3.0 s: 7 frames of joint angles; {text}; see docs/troubleshooting.md"
    )
    assert losses_part({"fusion": found["fusion"]}) == []
    assert losses_part({"robot_commands": status(received=20, **{"dropped /joint_states": 2})}) == []  # at the start


def test_a_message_without_results_counts_once_whatever_the_number_of_outputs() -> None:
    outputs = ("/filtered/skeleton", "/filtered/model_state", "/humans/bodies/body1/segments")
    values = {"received": "100", "left out after a standstill /kinect1/skeleton": "20"}
    for topic in outputs:
        values |= {f"subscribers {topic}": "1", f"left out after a standstill {topic}": "30"}
    (part,) = losses_part({"skeleton_filter": NodeStatus("", 0, "", values)})
    assert part.endswith("skeleton_filter 50")


def test_a_reliable_graph_names_every_lost_message_and_another_one_names_the_option() -> None:
    found = {"kinect1_mesh": NodeStatus("", 0, "", {"received": "299", "lost /kinect1/depth/image_raw": "2"})}
    text = "messages not processed (machine or network too slow): kinect1_mesh 2"
    assert losses_part(found) == []
    assert losses_part(found, reliable=True) == [text]
    monitor = object.__new__(GraphMonitor)  # without a node
    monitor._statuses, monitor.angles = found, 298
    options = {"bag": "reaching", "record": None, "reliable": True}
    assert monitor.summary(options, 3.0, {}).endswith(f"298 frames of joint angles; {text}")
    found["kinect1_mesh"].values["lost /kinect1/depth/image_raw"] = "50"
    assert monitor.summary(options | {"reliable": False}, 3.0, {}).endswith("mesh 50; --reliable processes them, later")
    robot = options | {"reliable": False, "robot": "arm.yaml"}
    assert monitor.summary(robot, 3.0, {}).endswith("mesh 50; see docs/troubleshooting.md")


def test_many_measurements_that_came_too_late_for_ekf_are_named_at_the_end() -> None:
    """With ``--reliable`` no message is lost on a busy machine, but its inertial sensors were silently left out."""
    found = {"skeleton_filter": NodeStatus("", 0, "", {"received": "2489", "too_late": "2161"})}
    monitor = object.__new__(GraphMonitor)  # without a node
    monitor._statuses, monitor.angles = found, 220
    options = {"bag": "arm", "record": None, "reliable": True}
    late = "angles; 2161 measurements came too late for skeleton_filter"
    assert monitor.summary(options, 3.0, {}).endswith(f"{late}; --rate 0.5 plays more slowly")
    assert monitor.summary(options | {"bag": ""}, 3.0, {}).endswith(f"{late}; see docs/troubleshooting.md")
    found["skeleton_filter"].values["too_late"] = "40"
    assert monitor.summary(options, 3.0, {}).endswith(" angles")


def monitor_without_node() -> GraphMonitor:
    monitor = object.__new__(GraphMonitor)
    monitor._angles_topics, monitor._namespace, monitor.angles, monitor.clock_ns = (), "/", 0, 0
    monitor._statuses, monitor._past, monitor._awaited = {}, deque(), []
    return monitor


def test_only_recent_losses_are_in_the_status_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor, now = monitor_without_node(), [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    found = []
    for second in range(12):
        now[0] = 100.0 + second
        lost = 0 if second < 2 else 50  # 50 messages in the third second
        values = {"received": str(100 * second), "lost /kinect1/skeleton": str(lost)}
        monitor._statuses = {"fusion": NodeStatus("", 0, "", values, received=now[0])}
        found.append("fusion 50" in monitor.line(options_of(sensors=()), 1.0, {}))
    assert found[:2] == [False, False]
    assert found[2:6] == [True] * 4
    assert not any(found[8:])


def test_a_bag_that_waits_names_the_nodes_that_it_waits_for() -> None:
    monitor = monitor_without_node()
    assert not monitor.has_subscribers({}, ["fusion", "joint_angles"])
    line = monitor.line(options_of(sensors=("kinect1",), bag="arm"), 1.0, {})
    assert line.strip() == "1.0 s (the bag plays once these nodes have started: fusion, joint_angles)"


def test_a_bag_that_begins_or_is_at_its_end_has_no_rates() -> None:
    """Rates of nodes that have not reported yet, or of a bag that stays at its end, look like silent sensors."""
    monitor, options = monitor_without_node(), options_of(sensors=("kinect1",), bag="arm")
    monitor._angles_topics, monitor.angles, monitor.clock_ns = ("/humans/bodies/body1/joint_states",), 9, 1
    rates = {"rate in /kinect1/skeleton": "28", "rate out /fused/skeleton": "28"}

    def line(position: str, text: str, fusion: dict[str, str], angles: str) -> str:
        now = time.monotonic()
        monitor._statuses = {
            "bag_player": NodeStatus("", 0, text, {"position s": position, "duration s": "15.4"}, received=now),
            "joint_angles": NodeStatus("", 0, "", {"rate out /humans/bodies/body1/joint_states": angles}, received=now),
            "fusion": NodeStatus("", 0, "", fusion, received=now),
        }
        return monitor.line(options, 10.0, {}).strip()

    assert line("0.8", "playing", {}, "26") == "10.0 s (bag 0.8/15.4 s) | calibration: none"
    assert "kinect1 28, fused 28, angles 28 Hz" in line("5.0", "playing", rates, "28")
    assert line("15.4", "at the end", rates, "0") == "10.0 s (the bag is at its end) | calibration: none"


def test_a_narrow_terminal_shows_the_whole_status_over_several_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    master, terminal = pty.openpty()
    with os.fdopen(terminal, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        console = Console()
        console.status("12.3 s | kinect1 28, fused 28, angles 28 Hz | calibration: waiting for a still pose")
        console.line("a line above")
        console.end()
        console.line("the end")
        text = ""
        # a terminal passes on what was written in pieces
        while "the end\r\n" not in text and select.select([master], [], [], 10.0)[0]:
            text += os.read(master, 10_000).decode()
    os.close(master)
    drawn, above, again = (
        text.partition("\r\x1b[2A\x1b[J")[0],
        "a line above\r\n",
        text.rpartition("above\r\n")[2].removesuffix("\r\nthe end\r\n"),
    )
    assert drawn == again and above in text
    assert [len(line) < 40 for line in drawn.split("\r\n")] == [True] * 3
    assert " ".join(drawn.split()).endswith("calibration: waiting for a still pose")


def test_until_a_node_reports_the_line_says_that_they_start() -> None:
    line = monitor_without_node().line(options_of(sensors=("kinect1",), external=True), 1.0, {})
    assert line.startswith("   1.0 s (the nodes are starting) | kinect1 -")


def test_a_sensor_that_never_sends_is_named() -> None:
    monitor = monitor_without_node()
    options = options_of(sensors=("kinect1", "misspelt"), external=True)
    values = {"rate in /kinect1/skeleton": "30"}
    monitor._statuses = {"fusion": NodeStatus("", 0, "", values, received=time.monotonic())}
    hint = "nothing comes from /misspelt/skeleton; `body_tracking doctor --sensors misspelt` says more"
    assert hint not in monitor.line(options, 2.0, {})
    assert hint in monitor.line(options, 20.0, {})
    assert hint in monitor.line({**options, "reliable": True}, 20.0, {})


def test_a_graph_that_got_malformed_messages_only_says_so_at_its_end() -> None:
    monitor = object.__new__(GraphMonitor)  # without a node
    values = {"malformed": "41", "last malformed": "/mine/skeleton: missing field(s) x"}
    monitor._statuses = {"idle": NodeStatus("", 0, ""), "fusion": NodeStatus("", 0, "no frame", values)}
    monitor.angles = 0
    end = "0 frames of joint angles (malformed 41, such as /mine/skeleton: missing field(s) x)"
    assert monitor.summary({"bag": "", "record": None}, 3.0, {}) == f"ran for 3.0 s: {end}"
    monitor.angles = 7
    assert "malformed" not in monitor.summary({"bag": "", "record": None}, 3.0, {})


def test_the_recorder_rightly_waits_for_a_bag_that_has_not_begun() -> None:
    monitor = monitor_without_node()
    alone, with_bag = options_of(sensors=()), options_of(sensors=(), bag="arm")

    def line(options: Options, level: int, text: str) -> str:
        monitor._statuses = {"bag_recorder": NodeStatus("bag_recorder: state", level, text, received=time.monotonic())}
        return monitor.line(options, 1.0, {})

    waiting = "waiting for /clock (use_sim_time): nothing is recorded"
    assert "bag_recorder" not in line(with_bag, 1, waiting)
    assert f"bag_recorder: {waiting}" in line(alone, 1, waiting)
    assert "bag_recorder: disk full" in line(with_bag, 2, "disk full")
    monitor.clock_ns = 1
    assert "bag_recorder: 2 topics" in line(with_bag, 1, "2 topics are not recorded")
    # nodes report once a second: the clock runs, of which the recorder's report knows nothing yet
    monitor._statuses["bag_player"] = NodeStatus("", 0, "playing", {"position s": "0.4"}, received=time.monotonic())
    monitor._statuses["bag_recorder"] = NodeStatus("", 1, waiting, received=time.monotonic())
    assert "bag_recorder" not in monitor.line(with_bag, 1.0, {})


def test_several_angles_have_their_names() -> None:
    monitor = monitor_without_node()
    monitor._angles_topics = tuple(f"/humans/bodies/{each}/joint_states" for each in ("body1", "body2", "markers"))
    options = options_of(sensors=(), marker_setup="lab")

    def line(**rates: str) -> str:
        values = {f"rate out /humans/bodies/{name}/joint_states": rate for name, rate in rates.items()}
        monitor._statuses = {"joint_angles": NodeStatus("joint_angles: stream", 0, "", values, time.monotonic())}
        return monitor.line(options, 1.0, {})

    assert "| angles 16 Hz" in line(body1="15.9") and "| angles - Hz" in line()
    assert "| angles body1 16, markers 30 Hz" in line(body1="15.9", body2="0.0", markers="30.1")


def test_sensors_rightly_send_nothing_before_the_bag_plays() -> None:
    monitor = monitor_without_node()
    silent = "forearm_left: nothing has come yet"
    monitor._statuses = {"imu_skeleton": NodeStatus("imu_skeleton: state", 1, silent, received=time.monotonic())}
    options = options_of(sensors=("kinect1",), bag="bag", imus=("forearm_left",))
    assert silent not in monitor.line(options, 5.0, {})
    monitor.clock_ns = 1
    assert f"imu_skeleton: {silent}" in monitor.line(options, 8.0, {})


def test_joint_angles_rightly_wait_for_a_filter_that_starts() -> None:
    monitor = monitor_without_node()
    waiting = NodeStatus("joint_angles: state", 1, "no filter publishes anything", received=time.monotonic())
    monitor._statuses = {"joint_angles": waiting}
    options = options_of(sensors=("kinect1",), external=True)
    assert "no filter" not in monitor.line(options, 5.0, {})
    assert "joint_angles: no filter publishes anything" in monitor.line(options, 20.0, {})


def test_a_recording_that_the_page_began_is_named_at_the_end() -> None:
    monitor = object.__new__(GraphMonitor)  # without a node
    monitor.angles = 7
    monitor._statuses = {"bag_recorder": NodeStatus("", 0, "stopped", {"messages": "120", "bag": "session_2"})}
    options = {"bag": "", "record": None}
    assert monitor.summary(options, 3.0, {}) == "ran for 3.0 s: 7 frames of joint angles, recorded in session_2"
    monitor._statuses = {"bag_recorder": NodeStatus("", 0, "stopped", {"messages": "0", "bag": "None"})}
    assert monitor.summary(options, 3.0, {}) == "ran for 3.0 s: 7 frames of joint angles"


def test_a_recording_that_stopped_is_named_at_once_and_at_the_end() -> None:
    monitor = monitor_without_node()
    monitor.angles = 7
    values = {"messages": "120", "bag": "session", "lost": "31"}
    full = NodeStatus("bag_recorder: bag", 2, "session_0.mcap: No space left on device", values, time.monotonic())
    monitor._statuses = {"bag_recorder": full}
    options = options_of(sensors=("kinect1",), external=True)
    assert "| bag_recorder: session_0.mcap: No space left on device" in monitor.line(options, 5.0, {})
    assert monitor.summary(options, 9.0, {}).endswith(", recorded in session (31 messages or more are missing)")
