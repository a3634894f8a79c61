"""What each mechanism for left and right is worth: the same people with all mechanisms, and with one switched off.

Each row is one mechanism switched off. Each figure is the mean over the people; after it, half the width of the 95 %
confidence interval of the difference to all mechanisms on the same people. A smaller difference is chance. Nothing was
tuned on these people, motions, layouts and seeds.

1. Left and right (``fusion.sides`` and the gate of ``fusion.fusion``), fused skeletons: RMS error of the twist of
   shoulders against hips (deg), share of the frames in which it is wrong by more than 60 deg (%), share of frames with
   shoulders or hips reversed (%), mean error of the ten joints of the thesis (mm).
2. The same on the real pairs of Kinects (without truth; ``--data``), filtered skeletons: number of reversals of
   shoulders or hips between two frames, number of their turns by more than 30 deg between two frames, share of the
   frames in which shoulders are twisted against hips by more than 60 deg (%).
3. The same on the shipped recordings, default filter: largest error of a trunk angle (deg), number of angles with an
   error of more than 3 stated standard deviations.

The posture prior of ``ekf``: ``every_angle.py --set posture=false``.

  python benchmarks/ablation.py                        24 people: about 40 minutes on two cores
  python benchmarks/ablation.py --seeds 1 --parts sides
"""

from __future__ import annotations

import contextlib
import math
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import common
import numpy as np
from accuracy import TEN, Run, run_ours
from every_angle import against_truth
from real_pairs import reversals, skeletons

from body_tracking.core.measurement import left_right_axes
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.metrics import Curve
from body_tracking.evaluation.reading import read
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.fusion import sides
from body_tracking.fusion.fusion import Fusion
from body_tracking.pipeline.graph import FILTERED
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import SHIPPED

ALL = "all mechanisms"
_SHOULDERS, _HIPS = (
    (Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT),
    (Joint.HIP_LEFT, Joint.HIP_RIGHT),
)
_FIRST_SEED = 5000
"""Far from the seeds of all other benchmarks."""


def _no_exemption(gated: Callable[..., FloatArray]) -> Callable[..., FloatArray]:
    return lambda self, stamp, names, points, variance, heading_agrees: gated(
        self, stamp, names, points, variance, np.zeros_like(heading_agrees)
    )


SIDES: Mapping[str, Callable[[], Any]] = {
    ALL: contextlib.nullcontext,
    "jumps of one end": lambda: patch.object(sides, "JUMP", math.inf),
    "view sense kept": lambda: patch.object(sides, "VIEW_KEPT", -1),
    "gate exemption": lambda: patch.object(Fusion, "_gated", _no_exemption(Fusion._gated)),
    "bounded turning": lambda: patch.multiple(sides, TURN_RATE=math.inf, TURN_ONCE=math.inf),
    "weights by width": lambda: patch.object(sides, "heading_weights", lambda points, variance: [1.0, 1.0]),
}
"""Per mechanism, a context manager that switches it off."""


def _heading(points: FloatArray, pair: tuple[int, int]) -> FloatArray:
    """(n,) headings of the axis between two joints of (n, 25, 3), radians."""
    axis = points[:, pair[0]] - points[:, pair[1]]
    heading: FloatArray = np.arctan2(axis[:, 1], axis[:, 0])
    return heading


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
    turned = [wrapped(_heading(found, pair) - _heading(true, pair)) for pair in (_SHOULDERS, _HIPS)]
    twist = wrapped(turned[0] - turned[1])
    twist = twist[np.isfinite(twist)]
    reversed_ = np.abs(np.stack(turned)) > np.pi / 2
    return {
        "twist": common.rms_deg(twist),
        "beyond 60": 100.0 * float((np.abs(twist) > np.pi / 3).mean()),
        "reversed": 100.0 * float(reversed_.any(axis=0).mean()),
        "joints": 1e3 * float(np.nanmean(np.linalg.norm(found - true, axis=-1)[:, TEN])),
    }


def of_real(file: Path, name: str) -> dict[str, float]:
    """The figures of part 2 for one recording."""
    with tempfile.TemporaryDirectory() as folder, SIDES[name]():
        import_files([file], Path(folder) / "in")
        replay(Path(folder) / "in", Path(folder) / "out", ReplaySettings(()))
        filtered = np.stack([each.positions for each in skeletons(Path(folder) / "out", FILTERED)])
    axes = left_right_axes(filtered)
    headings = np.arctan2(axes[..., 1], axes[..., 0])
    twist = np.abs(wrapped(headings[:, 0] - headings[:, 1]))
    turns = np.abs(wrapped(headings[1:] - headings[:-1]))
    return {
        "reversals": float(sum(reversals(axes[:, half]) for half in (0, 1))),
        "turns over 30": float((turns > np.pi / 6).sum()),
        "beyond 60": 100.0 * float((twist > np.pi / 3).sum() / np.isfinite(twist).sum()),
    }


def of_shipped(bag: Path, name: str) -> dict[str, float]:
    """The figures of part 3 for one recording."""
    with tempfile.TemporaryDirectory() as folder, SIDES[name]():
        replay(bag, Path(folder) / "out", ReplaySettings(()))
        tracked = read(Path(folder) / "out")
    assert tracked.true_angles is not None
    names = [each for each in tracked.angles.names if each in tracked.true_angles.names]
    away, stddev = against_truth(tracked.angles, tracked.true_angles, names)
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
}


def _measure(job: tuple[str, Any, str]) -> dict[str, float]:
    part, run, name = job
    return _FIGURES[part](run, name)


def figures_of(part: str, names: Sequence[str], runs: Sequence[Any], processes: int) -> dict[str, dict[str, Any]]:
    """Per mechanism switched off: the mean of each figure, and its difference to all mechanisms."""
    jobs = [(part, run, name) for run in runs for name in names]
    results = dict(zip(jobs, common.mapped(_measure, jobs, processes), strict=True))
    figures: dict[str, dict[str, Any]] = {}
    for name in names:
        row = figures[f"without {name}" if name != ALL else ALL] = {}
        for column in next(iter(results.values())):
            values = np.array([results[part, run, name][column] for run in runs])
            row[column] = float(np.nanmean(values))
            if name != ALL:
                row[f"{column}, change"] = common.Mean.of(values - [results[part, run, ALL][column] for run in runs])
    return figures


def main() -> int:
    """The command line."""
    motions = ("squat", "punching", "torso_twist", "walking_and_turning")
    parser = common.parser(__doc__, seeds=2, motions=motions, jobs=True, data=True)
    parser.add_argument("--layouts", type=common.names, default=["2", "3", "4"], help="of the sensors (default: 2,3,4)")
    parser.add_argument(
        "--parts", type=common.names, default=list(_FIGURES), help=f"which tables of {','.join(_FIGURES)}"
    )
    args = parser.parse_args()
    runs = [
        Run(motion, int(number), _FIRST_SEED + seed)
        for motion in args.motions
        for number in args.layouts
        for seed in range(args.seeds)
    ]
    pairs = sorted((args.data / "kinect_pairs").glob("p??_*.csv.gz"))
    of_part = {"real": pairs, "shipped": [common.ROOT / "bags" / name for name in SHIPPED]}
    figures = {}
    for part in args.parts:
        if not of_part.get(part, runs):
            common.progress(f"{part}: left out, no recordings in {args.data}")
            continue
        figures[part] = figures_of(part, list(SIDES), of_part.get(part, runs), args.jobs)
    common.report(args, figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
