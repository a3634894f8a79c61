"""Imports, which determine how soon a process starts: heavy libraries only where they are used."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

from patience import PATIENCE

HEAVY = {"numba", "numpy", "scipy", "rclpy", "matplotlib", "rosbags"}
ABSENT = {
    "cli": HEAVY,
    "ros.up": {"scipy", "matplotlib", "rclpy"},
    "nodes.joint_angles": {"scipy", "matplotlib", "filterpy"},
    "ros.graph_monitor": {"scipy", "matplotlib"},
    "nodes.bag_player": {"scipy", "matplotlib"},
    "nodes.bag_recorder": {"scipy", "matplotlib"},
    "nodes.robot_commands": {"scipy", "matplotlib"},
    "nodes.kinect_skeleton": {"scipy", "matplotlib"},
    "nodes.viewer": {"scipy", "matplotlib"},
    "nodes.calibration": {"scipy", "matplotlib"},
    "nodes.fusion": {"scipy", "matplotlib", "filterpy"},
    "nodes.skeleton_filter": {"scipy", "matplotlib", "filterpy"},
}
"""Libraries that a module leaves out. One Python imports the modules in this order, so the strictest come first."""


def test_the_help_and_modules_that_many_processes_import_leave_out_what_they_do_not_use() -> None:
    modules = list(ABSENT) if importlib.util.find_spec("rclpy") else ["cli", "ros.up"]
    steps = "".join(
        f"import body_tracking.{module}; {'body_tracking.cli.parser().format_help(); ' if module == 'cli' else ''}"
        f"found[{module!r}] = sorted(sys.modules); "
        for module in modules
    )
    script = f"import json, sys; found = {{}}; {steps}print(json.dumps(found))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE, check=True)
    loaded = json.loads(done.stdout.splitlines()[-1])
    assert {module: found for module in modules if (found := ABSENT[module].intersection(loaded[module]))} == {}
