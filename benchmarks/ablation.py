"""What each mechanism is worth: the same simulated people with all mechanisms, and with one of them switched off.

Every row is a mechanism that is off, every figure the mean over the people and, after it, half the width of the 95 %
confidence interval of the difference to all mechanisms on the same people: a difference that is smaller is chance.
People, motions, layouts and seeds are none that anything was tuned on.

1. Left and right (``fusion.sides`` and the gate of ``fusion.fusion``), fused skeletons: RMS error of the twist of
   shoulders against hips (deg), share of the frames in which it is wrong by more than 60 deg (%), share of frames with
   shoulders or hips reversed (%), mean error of the ten joints of the thesis (mm).
2. The same on the real pairs of Kinects (no truth; ``--data``), filtered skeletons: reversals of shoulders or hips
   between two frames, turns of them by more than 30 deg between two frames, share of the frames in which shoulders are
   twisted against hips by more than 60 deg (%).
3. The same on the shipped recordings, default filter: greatest error of a trunk angle (deg), frames in which an angle
   is off by more than 3 stated deviations.
4. The posture prior (``kinematics.posture``), filter ``ekf``: RMS error of trunk, lumbar and thoracic flexion, shoulder
   abduction and elbow flexion (deg), and the share of errors within 1.96 stated deviations (%); with the prior's
   deviations halved and doubled, too.

  python benchmarks/ablation.py                        24 people: about 40 minutes on two cores
  python benchmarks/ablation.py --seeds 1 --parts sides
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import contextlib
import math
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from accuracy import TEN, Run, run_ours
from real_pairs import reversals, skeletons
from scipy.stats import t as student

from body_tracking.evaluation.metrics import Curve
from body_tracking.evaluation.reading import nearest, read
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.fusion import sides
from body_tracking.fusion.fusion import Fusion
from body_tracking.graph import FILTERED
from body_tracking.kinematics import posture
from body_tracking.measurement import left_right_axes
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import SHIPPED, write_bag
from body_tracking.skeleton import NANOSECONDS, FloatArray, Joint

ALL = "all mechanisms"
_SHOULDERS, _HIPS = (
    (Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT),
    (Joint.HIP_LEFT, Joint.HIP_RIGHT),
)
_ROOT = Path(__file__).resolve().parent.parent
_FIRST_SEED = 5000
"""Far from the seeds of every other benchmark."""


def _no_exemption(gated: Callable[..., FloatArray]) -> Callable[..., FloatArray]:
    return lambda self, stamp, names, points, variance, as_believed: gated(
        self, stamp, names, points, variance, np.zeros_like(as_believed)
    )


SIDES: Mapping[str, Callable[[], Any]] = {
    ALL: contextlib.nullcontext,
    "jumps of one end": lambda: patch.object(sides, "JUMP", math.inf),
    "view sense kept": lambda: patch.object(sides, "VIEW_KEPT", -1),
    "gate exemption": lambda: patch.object(Fusion, "_gated", _no_exemption(Fusion._gated)),
    "bounded turning": lambda: patch.multiple(sides, TURN_RATE=math.inf, TURN_ONCE=math.inf),
    "weights by width": lambda: patch.object(sides, "heading_weights", lambda points, variance: [1.0, 1.0]),
}
"""Mechanism, and a context without it."""


def _scaled(factor: float) -> Any:
    return patch.multiple(
        posture,
        STDDEV={name: factor * degrees for name, degrees in posture.STDDEV.items()},
        TILT_STDDEV=tuple(factor * degrees for degrees in posture.TILT_STDDEV),
    )


POSTURE: Mapping[str, tuple[Callable[[], Any], dict[str, bool]]] = {
    ALL: (contextlib.nullcontext, {}),
    "posture prior": (contextlib.nullcontext, {"posture": False}),
    "(deviations halved)": (lambda: _scaled(0.5), {}),
    "(deviations doubled)": (lambda: _scaled(2.0), {}),
}
FLEXIONS = {
    "trunk": ("trunk_flexion",),
    "lumbar": ("lumbar_flexion",),
    "thoracic": ("thoracic_flexion",),
    "abduction": ("shoulder_abduction_left", "shoulder_abduction_right"),
    "elbow": ("elbow_flexion_left", "elbow_flexion_right"),
}


def _heading(points: FloatArray, pair: tuple[int, int]) -> FloatArray:
    """(n,) radians, of the axis between two joints of (n, 25, 3)."""
    axis = points[:, pair[0]] - points[:, pair[1]]
    heading: FloatArray = np.arctan2(axis[:, 1], axis[:, 0])
    return heading


def _off(found: FloatArray, true: FloatArray) -> FloatArray:
    away: FloatArray = np.remainder(found - true + np.pi, 2.0 * np.pi) - np.pi
    return away


def of_sides(run: Run, name: str) -> dict[str, float]:
    """The figures of part 1."""
    recording = run.recording()
    truth = recording.truths[0]
    zero = int(truth.stamps_ns[0])
    curve = Curve((truth.stamps_ns - zero) / NANOSECONDS, truth.positions)
    with SIDES[name]():
        fused, _ = run_ours(recording, DEFAULT_FILTER)
    times = np.array([(each.stamp_ns - zero) / NANOSECONDS for each in fused])
    inside = (times >= curve.span[0]) & (times <= curve.span[1])
    found = np.stack([np.where(each.valid[:, None], each.positions, np.nan) for each in fused])[inside]
    true = curve.at(times[inside])
    turned = [_off(_heading(found, pair), _heading(true, pair)) for pair in (_SHOULDERS, _HIPS)]
    twist = _off(turned[0], turned[1])
    twist = twist[np.isfinite(twist)]
    reversed_ = np.abs(np.stack(turned)) > np.pi / 2
    return {
        "twist": float(np.degrees(np.sqrt((twist**2).mean()))),
        "beyond 60": 100.0 * float((np.abs(twist) > np.pi / 3).mean()),
        "reversed": 100.0 * float(reversed_.any(axis=0).mean()),
        "joints": 1e3 * float(np.nanmean(np.linalg.norm(found - true, axis=-1)[:, TEN])),
    }


def of_posture(run: Run, name: str) -> dict[str, float]:
    """The figures of part 2."""
    without, parameters = POSTURE[name]
    with tempfile.TemporaryDirectory() as folder, without():
        write_bag(run.recording(), Path(folder) / "in")
        settings = ReplaySettings((), filter_name="ekf", filter_parameters=parameters)
        replay(Path(folder) / "in", Path(folder) / "out", settings)
        tracked = read(Path(folder) / "out")
    angles, truth = tracked.angles, tracked.true_angles
    assert truth is not None
    matches = nearest(truth.stamps_ns, angles.stamps_ns)
    here = matches >= 0
    figures: dict[str, float] = {}
    within: list[FloatArray] = []
    for label, names in FLEXIONS.items():
        own = [angles.names.index(each) for each in names]
        true = truth.position[matches[here]][:, [truth.names.index(each) for each in names]]
        away = _off(angles.position[here][:, own], true)
        figures[label] = float(np.degrees(np.sqrt((away**2).mean())))
        within.append(np.abs(away) <= 1.96 * angles.stddev[here][:, own])
    figures["within"] = 100.0 * float(np.concatenate(within, axis=1).mean())
    return figures


def of_real(file: Path, name: str) -> dict[str, float]:
    """The figures of part 2, of one recording."""
    with tempfile.TemporaryDirectory() as folder, SIDES[name]():
        import_files([file], Path(folder) / "in")
        replay(Path(folder) / "in", Path(folder) / "out", ReplaySettings(()))
        filtered = np.stack([each.positions for each in skeletons(Path(folder) / "out", FILTERED)])
    axes = left_right_axes(filtered)
    headings = np.arctan2(axes[..., 1], axes[..., 0])
    twist = np.abs(_off(headings[:, 0], headings[:, 1]))
    turns = np.abs(_off(headings[1:], headings[:-1]))
    return {
        "reversals": float(sum(reversals(axes[:, half]) for half in (0, 1))),
        "turns over 30": float((turns > np.pi / 6).sum()),
        "beyond 60": 100.0 * float((twist > np.pi / 3).sum() / np.isfinite(twist).sum()),
    }


def of_shipped(bag: Path, name: str) -> dict[str, float]:
    """The figures of part 3, of one recording."""
    with tempfile.TemporaryDirectory() as folder, SIDES[name]():
        replay(bag, Path(folder) / "out", ReplaySettings(()))
        tracked = read(Path(folder) / "out")
    angles, truth = tracked.angles, tracked.true_angles
    assert truth is not None
    matches = nearest(truth.stamps_ns, angles.stamps_ns)
    here = matches >= 0
    names = [each for each in angles.names if each in truth.names]
    own = [angles.names.index(each) for each in names]
    true = truth.position[matches[here]][:, [truth.names.index(each) for each in names]]
    away, stddev = _off(angles.position[here][:, own], true), angles.stddev[here][:, own]
    trunk = [each.startswith("trunk") for each in names]
    known = np.isfinite(stddev)
    return {
        "trunk": float(np.degrees(np.nanmax(np.where(known, np.abs(away), np.nan)[:, trunk]))),
        "beyond 3": float((np.abs(away)[known] > 3.0 * stddev[known]).sum()),
    }


_FIGURES: Mapping[str, Callable[[Any, str], dict[str, float]]] = {
    "sides": of_sides,
    "real": of_real,
    "shipped": of_shipped,
    "posture": of_posture,
}


def _measure(job: tuple[str, Any, str]) -> dict[str, float]:
    part, run, name = job
    return _FIGURES[part](run, name)


def table(part: str, names: Sequence[str], runs: Sequence[Any], workers: int) -> None:
    """Measure one part and print it."""
    jobs = [(part, run, name) for run in runs for name in names]
    began, results = time.monotonic(), {}
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for number, (job, figures) in enumerate(zip(jobs, pool.map(_measure, jobs), strict=True), start=1):
            results[job] = figures
            left = (time.monotonic() - began) / number * (len(jobs) - number)
            print(f"\r{number} of {len(jobs)}, {left / 60:.0f} min left ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    columns = list(next(iter(results.values())))
    print(f"\n{part}: {len(runs)} recordings\n{'without':24}" + "".join(f"{each:>20}" for each in columns))
    for name in names:
        cells = []
        for column in columns:
            values = np.array([results[part, run, name][column] for run in runs])
            cell = f"{values.mean():.1f}"
            if name != ALL and len(runs) > 1:
                apart = values - [results[part, run, ALL][column] for run in runs]
                half = student.ppf(0.975, len(runs) - 1) * apart.std(ddof=1) / math.sqrt(len(runs))
                cell += f" ({apart.mean():+.1f} ±{half:.1f})"
            cells.append(f"{cell:>20}")
        print(f"{name:24}" + "".join(cells))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="people for each motion and layout")
    parser.add_argument("--layouts", default="2,3,4", help="of the sensors")
    parser.add_argument("--motions", default="squat,punching,torso_twist,walking_and_turning", help="of the people")
    parser.add_argument("--parts", default=",".join(_FIGURES), help="which tables (default: %(default)s)")
    data = Path(os.environ.get("BODY_TRACKING_DATA", _ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of real recordings (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    runs = [
        Run(motion, int(number), _FIRST_SEED + seed)
        for motion in args.motions.split(",")
        for number in args.layouts.split(",")
        for seed in range(args.seeds)
    ]
    pairs = sorted((args.data / "kinect_pairs").glob("p??_*.csv.gz"))
    of_part = {"real": pairs, "shipped": [_ROOT / "bags" / name for name in SHIPPED]}
    for part in args.parts.split(","):
        if not of_part.get(part, runs):
            print(f"{part}: left out, no recordings in {args.data}")
            continue
        table(part, list(POSTURE if part == "posture" else SIDES), of_part.get(part, runs), args.workers)


if __name__ == "__main__":
    main()
