"""The benchmarks: what each of them shows.

python benchmarks/run.py                      this table
python benchmarks/run.py NAME [options]       one of them, as python benchmarks/NAME.py [options]
python benchmarks/run.py --all                all that can run here, one after the other, as make bench does
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from common import DATA

from body_tracking.simulation.makehuman import WHEEL_VARIABLE, find_wheel

FOLDER = Path(__file__).resolve().parent
LEFT_OUT = (2, 77)
"""Exit codes of a benchmark that found that it cannot run here."""


class Need(NamedTuple):
    """What a benchmark needs beside the package: how it is called, and whether it is there."""

    name: str
    there: Callable[[], bool]


NOTHING = Need("", lambda: True)
ROOT_RIGHTS = Need("root, or user namespaces", lambda: True)  # it finds out by itself
CHROMIUM = Need("chromium", lambda: any(map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))


def recordings(folder: str) -> Need:
    """Real recordings."""
    return Need(f"recordings `{folder}`", (DATA / folder).is_dir)


class Benchmark(NamedTuple):
    """One of them.

    Attributes:
        name: of its file.
        shows: what it measures.
        need: what it needs.
        minutes: that it takes about, with its own defaults, on two cores.
        options: with which ``--all`` runs it.
    """

    name: str
    shows: str
    need: Need
    minutes: float
    options: str = ""


MAKEHUMAN = Need(f"MakeHuman's data, `${WHEEL_VARIABLE}`", lambda: find_wheel() is not None)
PAIRS = recordings("kinect_pairs")
BENCHMARKS = (
    Benchmark(
        "real_pairs",
        "two real sensors: yaw, agreement, left and right; with `--ekf` lengths and innovations",
        PAIRS,
        5,
        "--ekf",
    ),
    Benchmark(
        "kinect_vs_vicon",
        "arm angles of a real Kinect, raw and filtered, against Vicon",
        recordings("kinect_vs_vicon"),
        1,
    ),
    Benchmark(
        "depth_images",
        "a real depth image beside simulated ones, and the time of the depth input",
        MAKEHUMAN,
        1,
    ),
    Benchmark("imu_pendulum", "orientations from raw inertial data against Vicon", recordings("imu"), 1),
    Benchmark(
        "imu_recordings",
        "clocks, alignment and angles of inertial sensors in two real recordings",
        recordings("imu"),
        1,
    ),
    Benchmark("people", "who is who: crossings, two real people, six people live", PAIRS, 10),
    Benchmark(
        "accuracy",
        "errors of one sensor, of the thesis's methods and of this package, on simulated people",
        NOTHING,
        120,
        "--seeds 2 --layout-seeds 1 --sensitivity-seeds 1",
    ),
    Benchmark(
        "ablation", "what each mechanism is worth: the same people without it", NOTHING, 40, "--seeds 1 --layouts 2,4"
    ),
    Benchmark(
        "honesty", "whether the standard deviations of `ekf` are true, over random people", NOTHING, 3, "--runs 40"
    ),
    Benchmark(
        "robustness", "whether `ekf` survives wrong starts, dropouts, gaps and outliers", NOTHING, 10, "--runs 100"
    ),
    Benchmark(
        "imu_and_camera",
        "inertial sensors on both wrists beside one Kinect, against the Kinect alone",
        NOTHING,
        40,
        "--seeds 1",
    ),
    Benchmark(
        "imu_only", "arm angles of seven inertial sensors without a camera", NOTHING, 25, "--motions reaching,punching"
    ),
    Benchmark(
        "imu_faults",
        "what becomes of angles when an inertial sensor fails, and whether it is named",
        NOTHING,
        20,
        "--seeds 1",
    ),
    Benchmark(
        "calibrate_simulator",
        "the simulated Kinect beside the errors that the thesis published; writes docs/simulator.md",
        NOTHING,
        1,
    ),
    Benchmark(
        "simulated_pairs",
        "statistics of real pairs of sensors beside simulated ones; writes docs/simulator.md",
        PAIRS,
        4,
    ),
    Benchmark(
        "markers_detection",
        "centroids of rendered balls: apart, touching, overlapping, cut by the border, hidden",
        NOTHING,
        2,
    ),
    Benchmark("markers_targets", "poses, recognition and tracking of targets among simulated points", NOTHING, 3),
    Benchmark(
        "markers_functional",
        "joints of real marker clusters on skin, beside biobuddy where it is installed",
        recordings("marker_functional"),
        1,
    ),
    Benchmark(
        "markers_accuracy",
        "targets by distance, joints and angles with calibration estimated, beside the figures of Gaschler's thesis",
        NOTHING,
        10,
        "--calibrations 10",
    ),
    Benchmark("markers_wand", "cameras around a room, placed by a waved wand, and their stated deviations", NOTHING, 1),
    Benchmark("markers_time", "time from a pair of images to joint angles, computed and live", NOTHING, 2),
    Benchmark(
        "markers_reference",
        "a Kinect judged by the marker system beside the truth, and a real pendulum by Vicon",
        NOTHING,
        6,
    ),
    Benchmark("latency", "delay from capture to angles through the live graph, beside bare relays", NOTHING, 1),
    Benchmark("four_sensors", "four sensors live with `ekf`: frames lost, processor time, delay", NOTHING, 1),
    Benchmark("imu_live", "ten inertial sensors and two Kinects live: delay, and whether it grows", NOTHING, 2),
    Benchmark("viewer", "how much later angles come while a browser shows the viewer", CHROMIUM, 4),
    Benchmark("two_hosts", "a network that loses, delays and is cut: angles, stamps, recovery", ROOT_RIGHTS, 3),
    Benchmark(
        "soak", "an hour of the live graph at ten times the rate: memory, deaths, latency", NOTHING, 62, "--minutes 10"
    ),
)


def rows() -> Iterator[tuple[str, str, str, str]]:
    """Name, what it shows, what it needs, how long it takes."""
    for each in BENCHMARKS:
        yield f"`{each.name}`", each.shows, each.need.name, f"{each.minutes:g} min"


def run_all() -> int:
    """Run them; 1 where one missed its bar."""
    missed = []
    for each in BENCHMARKS:
        print(f"\n== {each.name} {each.options}", flush=True)
        if not each.need.there():
            print(f"left out: no {each.need.name}")
            continue
        code = subprocess.run([sys.executable, FOLDER / f"{each.name}.py", *each.options.split()]).returncode
        if code and code not in LEFT_OUT:
            missed.append(each.name)
    print(f"\nmissed: {', '.join(missed) or 'nothing'}")
    return 1 if missed else 0


def main() -> int:
    """The command."""
    name, *options = sys.argv[1:] or ["--help"]
    if name == "--all":
        return run_all()
    if name in {each.name for each in BENCHMARKS}:
        os.execv(sys.executable, [sys.executable, str(FOLDER / f"{name}.py"), *options])
    print(__doc__)
    for each in BENCHMARKS:
        print(
            f"{each.name:20} {each.minutes:4g} min  {each.shows}{f' (needs {each.need.name})' * bool(each.need.name)}"
        )
    return 0 if name in ("-h", "--help") else 2


if __name__ == "__main__":
    sys.exit(main())
