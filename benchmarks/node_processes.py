"""The graph's nodes as processes of a benchmark, which itself takes the place of sensors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import yaml

from body_tracking import graph
from body_tracking.calibration.result import CalibrationResult, SensorPose, SensorQuality
from body_tracking.calibration.storage import save
from body_tracking.clocks import ClockModel
from body_tracking.graph import GraphOptions, nodes_for
from body_tracking.parameters import SECTION, to_ros


def calibrated(folder: Path, poses: Mapping[str, SensorPose]) -> str:
    """A calibration file of sensors that stand there and share a clock; its path."""
    file = folder / "calibration.yaml"
    names = tuple(poses)
    quality = {name: SensorQuality(0.03, 0.005, 0.01, 0.002, 500) for name in names}
    save(CalibrationResult(names[0], dict(poses), {name: ClockModel() for name in names}, quality), file)
    return str(file)


def commands(folder: Path, options: GraphOptions, level: str = "WARN") -> list[list[str]]:
    """Command lines of the nodes of a graph without its Kinects, by the graph's own table.

    Args:
        folder: where their parameters are written.
        options: the graph.
        level: what they log.
    """
    lines = []
    for spec in nodes_for(options):
        if spec.executable == "kinect_skeleton":
            continue  # the benchmark takes the sensors' place, to know when it sent what
        values = {name: to_ros(value) for name, value in {**spec.defaults, **spec.parameters}.items()}
        file = folder / f"{spec.name}.parameters.yaml"
        file.write_text(yaml.safe_dump({spec.full_name: {SECTION: values}}), encoding="utf-8")
        line = ["-m", "body_tracking.nodes", spec.executable, "--ros-args", "--log-level", level]
        lines.append([*line, "--params-file", str(file)])
    return lines


def start(lines: Iterable[Sequence[str]], domain: int | None = None) -> list[subprocess.Popen[bytes]]:
    """A process of this Python for each command line, which ends when this process does.

    Args:
        lines: what follows the interpreter.
        domain: their ROS domain, where it is not this process's.
    """
    environment = {**os.environ, graph.PARENT_VARIABLE: str(os.getpid())}
    if domain is not None:
        environment["ROS_DOMAIN_ID"] = str(domain)
    return [subprocess.Popen([sys.executable, *line], env=environment, start_new_session=True) for line in lines]


def stop(running: Iterable[subprocess.Popen[bytes]]) -> None:
    """End them as Ctrl-C does, or, where that takes too long, at once."""
    for process in (running := list(running)):
        process.send_signal(signal.SIGINT)
    for process in running:
        try:
            process.wait(8.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
