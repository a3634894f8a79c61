"""The notebook in ``examples/``. README.md's test runs ``elbow.py``, ``test_fifth_system.py`` the system there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from threading import Timer
from typing import Any

import pytest

from body_tracking.cli import main
from body_tracking.recording.rosbag2 import BagReader, BagWriter

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.parametrize("program", [("elbow.py",), ("robot_arms/drive.py", "two_joint_arm")], ids=["elbow", "drive"])
def test_a_wrong_domain_is_refused_in_one_line(program: tuple[str, ...]) -> None:
    pytest.importorskip("mujoco" if len(program) > 1 else "rclpy")
    words = [sys.executable, str(ROOT / "examples" / program[0]), *program[1:]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "ROS_DOMAIN_ID": "seven"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=100)
    assert done.returncode and "ROS_DOMAIN_ID" in done.stderr and done.stderr.count("\n") == 1


def test_the_elbow_says_what_it_waits_for() -> None:
    """Without a graph it would print nothing; on stderr, since stdout has the angles."""
    pytest.importorskip("rclpy")
    words = [sys.executable, str(ROOT / "examples" / "elbow.py")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True) as elbow:
        assert elbow.stderr
        killer = Timer(60.0, elbow.kill)
        killer.start()
        try:
            said = elbow.stderr.readline()
        finally:
            killer.cancel()
            elbow.terminate()
    assert said.startswith("elbow: waits for /humans/bodies/body1/joint_states and ")


def test_malformed_angles_do_not_end_the_elbow(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rclpy")
    from sensor_msgs.msg import JointState

    names: dict[str, Any] = {}
    exec((ROOT / "examples" / "elbow.py").read_text().partition("\ntry:")[0], names)
    elbow = names["Elbow"].__new__(names["Elbow"])
    elbow.angles = {}
    name = ["other", "elbow_flexion_left_body1"]
    for positions, deviations in (([], [0.1, 0.1]), ([0.0, 1.0], [0.1]), ([0.0, 1.0], [0.1, 0.1])):
        elbow.on_angles(JointState(name=name, position=positions))
        elbow.on_stddev(JointState(name=name, position=deviations))
    assert capsys.readouterr().out == "1.00 +- 0.10 rad\n"


def test_options_of_a_recording_need_one() -> None:
    pytest.importorskip("mujoco")
    words = [sys.executable, str(ROOT / "examples" / "robot_arms" / "drive.py"), "two_joint_arm", "--kill", "6"]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and "--angles and --kill need --bag" in done.stderr


def test_angles_of_a_missing_recording_are_refused_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    drive, bag = ROOT / "examples" / "robot_arms" / "drive.py", tmp_path / "missing"
    words = [sys.executable, str(drive), "two_joint_arm", "--bag", str(bag), "--angles"]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and done.stderr == f"drive: {bag}: no such recording\n"


def test_a_time_or_a_picture_that_is_none_is_named(tmp_path: Path) -> None:
    words = [sys.executable, str(ROOT / "examples" / "robot_arms" / "drive.py"), "two_joint_arm", "--bag", "bag"]
    for option, value, named in (
        ("--kill", "nan", "--kill: nan, expected seconds from 0 on"),
        ("-o", str(tmp_path), f"--output: {tmp_path} is a folder, expected a file"),
    ):
        done = subprocess.run(
            [*words, option, value],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 2 and done.stderr.endswith(f"drive.py: error: {named}\n")


@pytest.mark.slow
def test_the_notebook_plots_a_recording(tmp_path: Path, wave: Path) -> None:
    """Its cells, run one after the other as a program, of a recording that lacks a message of a pair."""
    notebook = json.loads((ROOT / "examples" / "angles.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    (tmp_path / "notebook.py").write_text("\n".join([*cells, "figure.savefig('angles.png')"]), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    options = ("--filter", "ekf", "--convention", "isb")
    assert main(["replay", str(wave), "-o", str(tmp_path / "whole"), *options]) == 0
    with BagReader(tmp_path / "whole") as source, BagWriter(tmp_path / "angles") as copy:
        for name, info in source.topics.items():
            copy.add_topic(name, info.type_name, info.offered)
        lacks = "/humans/bodies/body1/joint_states_stddev"
        for raw in source.messages():
            if raw.topic != lacks:
                copy.write(raw.topic, raw.cdr, raw.log_time_ns)
            else:
                lacks = ""  # the first one only
    command = (sys.executable, "notebook.py")
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "elbow_flexion_left_body1" in done.stdout
    assert (tmp_path / "angles.png").stat().st_size > 10_000
