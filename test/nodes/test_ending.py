"""Ctrl-C ends a node with exit code 0 and without output, at any moment of its life and if repeated."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from running import Running, environment

from body_tracking.core.signals import signals_held
from draws import some

NODES = ("calibration", "joint_angles", "skeleton_filter", "fusion")


@pytest.fixture
def started(tmp_path: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Nodes that have just been started, as ``up`` and the scripts of a colcon workspace start them."""
    processes = []
    for name in NODES:
        with signals_held(), (tmp_path / f"{name}.log").open("wb") as log:
            command = [sys.executable, "-m", "body_tracking.nodes", name]
            processes.append(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment()))
    yield processes
    for process in processes:
        process.kill()
        process.wait()


def said(folder: Path) -> dict[str, str]:
    """Output of nodes other than log messages of level INFO, by node."""
    texts = {name: (folder / f"{name}.log").read_text() for name in NODES}
    return {name: text for name, text in texts.items() if any("[INFO]" not in line for line in text.splitlines())}


def test_a_page_in_the_background_of_a_script_ends_by_ctrl_c(tmp_path: Path) -> None:
    """Shells let such jobs ignore SIGINT."""
    file = tmp_path / "page.yaml"
    file.write_text("viewer: {ros__parameters: {port: 0}}")
    code = "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); from body_tracking.cli import main; "
    command = [sys.executable, "-c", f"{code}sys.exit(main())", "view", "--params-file", str(file)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment(), cwd=tmp_path) as page:
        try:
            assert page.stdout is not None and "open http" in page.stdout.readline()
            page.send_signal(signal.SIGINT)
            assert page.wait(timeout=60.0) == 0
        finally:
            page.kill()


@pytest.mark.parametrize("after", some([0.05, 0.0, 0.3, 0.7, 1.2, 2.0], 3))
def test_starting_node_ends_at_once(started: list[subprocess.Popen[bytes]], tmp_path: Path, after: float) -> None:
    time.sleep(after)
    for process in started:
        process.send_signal(signal.SIGINT)
    assert [process.wait(timeout=60.0) for process in started] == [0] * len(NODES)
    assert not said(tmp_path)


def test_repeated_ctrl_c_is_like_one(started: list[subprocess.Popen[bytes]], tmp_path: Path) -> None:
    """From the first instruction until nothing is left of the process, shutdown of Python included."""
    end = time.monotonic() + 60.0
    while any(process.poll() is None for process in started):
        assert time.monotonic() < end
        for process in started:
            process.send_signal(signal.SIGINT)
        time.sleep(0.002)
    assert [process.returncode for process in started] == [0] * len(NODES)
    assert not said(tmp_path)


def test_running_node_survives_many_signals_until_its_end(tmp_path: Path) -> None:
    with Running(tmp_path) as running:
        for name in NODES:
            running.start(name)
        assert running.until(lambda: set(NODES) <= running.diagnostics.keys(), 120.0)
        end = time.monotonic() + 60.0
        while any(process.poll() is None for process in running.processes.values()):
            assert time.monotonic() < end
            for process in running.processes.values():
                process.send_signal(signal.SIGINT)
            time.sleep(0.002)
        assert {process.returncode for process in running.processes.values()} == {0}
    assert not said(tmp_path)
