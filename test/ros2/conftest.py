"""The workspace with the real ``ros2`` and ``launch``, and a domain in which a test uses them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")

from tools import Tools

HERE = Path(__file__).resolve().parent
SETUP = HERE.parents[1] / ".ros2_workspace" / "setup.sh"
ABSENT = 77
"""Exit code of ``workspace`` where the sources of ``ros2`` are not there."""
PROCESSOR = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES")
"""Variables that emulate another processor; compiled code is kept for each."""
OWN = ("HOME", "LANG", "PATH", "TMPDIR", "XDG_CACHE_HOME", *PROCESSOR)
"""All variables that a terminal with the sourced workspace inherits from the tests."""


@pytest.fixture(scope="session")
def workspace() -> dict[str, str]:
    """The environment of such a terminal; changes since ``make ros2-workspace`` are built first."""
    if os.environ.get("TEST_ROS2") == "failed":
        pytest.skip("the workspace could not be made, by which make fails; test/ros2/workspace says why")
    made = subprocess.run([HERE / "workspace"], capture_output=True, text=True, check=False)
    if made.returncode == ABSENT:
        pytest.skip(made.stdout.strip())
    assert made.returncode == 0, made.stdout + made.stderr
    own = {name: os.environ[name] for name in OWN if name in os.environ}
    source = ["bash", "-c", f'. "{SETUP}" && env -0']
    printed = subprocess.run(source, env=own, capture_output=True, text=True, check=True).stdout
    return dict(line.split("=", 1) for line in printed.split("\0") if line)


@pytest.fixture
def tools(workspace: dict[str, str], tmp_path: Path) -> Iterator[Tools]:
    """``ros2`` for one test."""
    with Tools(workspace, tmp_path) as tools:
        yield tools
