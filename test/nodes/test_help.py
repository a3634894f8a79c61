"""``--help`` of a node prints its purpose and its parameters, and starts nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from node_process import NodeProcess
from running import environment

from body_tracking import systems
from body_tracking.core.parameters import check_all, read_file


@pytest.mark.parametrize("executable", systems.EXECUTABLES)
def test_help_ends_with_a_parameters_file_of_all_defaults(executable: str, tmp_path: Path) -> None:
    process = NodeProcess(executable, ["--help"], tmp_path / "log", environment())
    try:
        assert process.wait(60.0) == 0
    finally:
        process.kill()
    text, _, file = process.output().partition("as a parameters file:\n")
    assert text.startswith(f"usage: ros2 run body_tracking {executable} ")
    (tmp_path / "parameters.yaml").write_text(file)
    (values,) = read_file(tmp_path / "parameters.yaml").values()
    table = systems.parameters_of(executable)
    assert check_all(table, values) == {parameter.name: parameter.default for parameter in table}


def test_help_without_a_reader_prints_no_traceback() -> None:
    command = f"{sys.executable} -m body_tracking.nodes joint_angles --help | true"
    assert subprocess.run(["bash", "-c", command], stderr=subprocess.PIPE, text=True, env=environment()).stderr == ""
