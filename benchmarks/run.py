"""The benchmarks: what each of them shows.

python benchmarks/run.py                      this table
python benchmarks/run.py NAME [options]       one of them, as python benchmarks/NAME.py [options]
python benchmarks/run.py --all                all that can run here, one after the other, as make bench does
"""

from __future__ import annotations

import ast
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from common import DATA

from body_tracking.core.errors import did_you_mean
from body_tracking.simulation.makehuman import WHEEL_VARIABLE, find_wheel

FOLDER = Path(__file__).resolve().parent
LEFT_OUT = (2, 77)
"""Exit codes of a benchmark that cannot run here."""


class Need(NamedTuple):
    """A requirement of a benchmark beside the package: its name, and a check whether it is met."""

    name: str
    there: Callable[[], bool]


def recordings(folder: str) -> Need:
    """Requirement of a folder of real recordings."""
    return Need(f"recordings `{folder}`", (DATA / folder).is_dir)


NOTHING = Need("", lambda: True)
ROOT_RIGHTS = Need("root, or user namespaces", lambda: True)  # checked by the benchmark itself
CHROMIUM = Need("chromium", lambda: any(map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
MAKEHUMAN = Need(f"MakeHuman's data, `${WHEEL_VARIABLE}`", lambda: find_wheel() is not None)
PEERS = Need("`pip install biorbd opensim`", lambda: all(map(importlib.util.find_spec, ("biorbd", "opensim"))))
PAIRS, IMU = recordings("kinect_pairs"), recordings("imu")


class Benchmark(NamedTuple):
    """A benchmark.

    Attributes:
        minutes: approximate duration with its own defaults on two cores.
        need: its requirement.
        options: for ``--all``.
    """

    minutes: float
    need: Need = NOTHING
    options: str = ""


BENCHMARKS = {
    "real_pairs": Benchmark(5, PAIRS, "--ekf"),
    "lab_faults": Benchmark(3, PAIRS),
    "real_angles": Benchmark(5, PAIRS),
    "kinect_vs_vicon": Benchmark(1, recordings("kinect_vs_vicon")),
    "baseline": Benchmark(4),
    "depth_images": Benchmark(1, MAKEHUMAN),
    "camera_skeleton": Benchmark(10, MAKEHUMAN),
    "camera_accuracy": Benchmark(20, MAKEHUMAN),
    "camera_live": Benchmark(2),
    "camera_photographs": Benchmark(1, recordings("kinect_depth")),
    "mesh_fit": Benchmark(10, MAKEHUMAN),
    "mesh_hidden": Benchmark(8, MAKEHUMAN),
    "mesh_hard": Benchmark(20, MAKEHUMAN),
    "mesh_baseline": Benchmark(6, MAKEHUMAN),
    "mesh_live": Benchmark(4),
    "mesh_person": Benchmark(4, MAKEHUMAN),
    "mesh_angles": Benchmark(10, MAKEHUMAN),
    "mesh_real": Benchmark(1, recordings("depth_turn")),
    "imu_pendulum": Benchmark(1, IMU),
    "imu_recordings": Benchmark(1, IMU),
    "people": Benchmark(10, PAIRS),
    "accuracy": Benchmark(120, options="--seeds 2 --layout-seeds 1 --sensitivity-seeds 1"),
    "every_angle": Benchmark(5, options="--motions reaching,squat"),
    "ablation": Benchmark(40, options="--seeds 1 --layouts 2,4"),
    "honesty": Benchmark(3, options="--runs 40"),
    "estimators": Benchmark(3, PEERS),
    "robustness": Benchmark(10, options="--runs 100"),
    "teleports": Benchmark(15, options="--runs 12"),
    "imu_and_camera": Benchmark(40, options="--seeds 1"),
    "imu_only": Benchmark(25, options="--motions reaching,punching"),
    "calibrate_simulator": Benchmark(1),
    "simulated_pairs": Benchmark(4, PAIRS),
    "markers_detection": Benchmark(2),
    "markers_functional": Benchmark(1, recordings("marker_functional")),
    "markers_accuracy": Benchmark(10, options="--calibrations 10"),
    "markers_wand": Benchmark(1),
    "markers_time": Benchmark(2),
    "markers_reference": Benchmark(6),
    "startup": Benchmark(2),
    "latency": Benchmark(1),
    "four_sensors": Benchmark(1),
    "imu_live": Benchmark(2),
    "viewer": Benchmark(4, CHROMIUM),
    "two_hosts": Benchmark(3, ROOT_RIGHTS),
    "soak": Benchmark(62, options="--minutes 10"),
}
"""Benchmarks by name of the file; the first line of its docstring is shown in the table."""


def rows() -> Iterator[tuple[str, str, str, str]]:
    """Name, purpose, requirement and duration of each benchmark."""
    for name, each in BENCHMARKS.items():
        text = ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text(encoding="utf-8"))) or ""
        yield f"`{name}`", text.partition("\n")[0].removesuffix("."), each.need.name, f"{each.minutes:g} min"


def run_all() -> int:
    """Run all benchmarks; returns 1 if one missed its bar."""
    missed = []
    for name, each in BENCHMARKS.items():
        print(f"\n== {name} {each.options}", flush=True)
        if not each.need.there():
            print(f"left out: no {each.need.name}")
            continue
        code = subprocess.run([sys.executable, FOLDER / f"{name}.py", *each.options.split()]).returncode
        if code and code not in LEFT_OUT:
            missed.append(name)
    print(f"\nmissed: {', '.join(missed) or 'nothing'}")
    return 1 if missed else 0


def main() -> int:
    """The command."""
    name, *options = sys.argv[1:] or ["--help"]
    if name == "--all":
        return run_all()
    if name in BENCHMARKS:
        os.execv(sys.executable, [sys.executable, str(FOLDER / f"{name}.py"), *options])
    if name not in ("-h", "--help"):
        hint = did_you_mean(name, BENCHMARKS) or "; python benchmarks/run.py lists them"
        print(f"no benchmark {name}{hint}", file=sys.stderr)
        return 2
    print(__doc__)
    for each, shows, need, minutes in rows():
        print(f"{each.strip('`'):20} {minutes:>7}  {shows}{f' (needs {need})' * bool(need)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
