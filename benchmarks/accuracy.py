"""Accuracy of each method on simulated people with a known truth: single sensor, thesis, ours.

Each run is a person who performs one motion in their own way in front of Kinect v2 sensors with realistic errors
(``calibrate_simulator.py`` compares them with real ones). All methods get the same frames. The simulator was calibrated
with other people and mostly other motions; no filter was tuned on these runs.

methods   ``one sensor``: the skeleton of kinect1, in world; ``thesis ...``: the pipeline of Schlagenhauf (2017)
          (``thesis_pipeline``); ``fused``, ``default`` and ``ekf``: this package at its defaults, offline, through the
          messages of the live graph (calibration, fusion, filter, joint angles). ``offsets alone`` is no method but a
          sensor whose only errors are the constant offsets of its joint centres, which no method can know.
errors    of the ten joints of the thesis's model, in world, at the stamps that each method claims, from the time when
          all methods have started: mean 3D error (mm); the same without each joint's constant offset in the body's
          own frames ("fixed"); "fixed" where a joint is hidden from one sensor or more; RMSE of shoulder elevation
          and elbow flexion (degrees); share of the frames with these angles within 1.96 stated standard deviations;
          delay by the stamps (ms), without the time that a method waits.

Parts: ``main`` (every motion in layout 4), ``layouts`` (the nine layouts), ``sensitivity`` (every parameter of the
simulator halved and doubled). Means over seeds with 95 % confidence intervals (Student). ``--write`` writes
these parts of docs/accuracy.md and its figure.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import common
import numpy as np
from common import Mean
from offline_graph import play
from thesis_pipeline import EKF, LKF1, LKF2, run_thesis

from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Skeleton, TrackingState
from body_tracking.core.so3 import wrapped
from body_tracking.core.sources import RecordedFrame
from body_tracking.evaluation.metrics import Curve, Trajectory, find_delay, joint_errors
from body_tracking.evaluation.segments import segment_frames
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.kinect.occlusion import Capsules, obstruction
from body_tracking.kinect.simulated import KinectErrors, parameters
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.replay import ReplaySettings
from body_tracking.simulation.layouts import NUMBERS, layout
from body_tracking.simulation.people import Person
from body_tracking.simulation.repertoire import MOTIONS, make_movement
from body_tracking.simulation.scene import Setup, SimulatedRecording, simulate

TEN = Schlagenhauf26().joints
ONE, FUSED, DEFAULT, OURS = "one sensor", "fused", f"default ({DEFAULT_FILTER})", "ekf"
ALONE = "offsets alone"
METHODS = (ALONE, ONE, FUSED, LKF1, LKF2, EKF, DEFAULT, OURS)
KNOWN = ("two_handed_wave", "slow_down", "torso_twist", "move_along")
"""Motions with which the simulator was calibrated."""
TWIST = "torso_twist"
ANGLES = {
    "elevation": [ANGLE_NAMES.index(f"shoulder_elevation_{side}") for side in ("left", "right")],
    "elbow": [ANGLE_NAMES.index(f"elbow_flexion_{side}") for side in ("left", "right")],
}
_FIRST_SEED = 1000
"""Far from the seeds of the calibration."""
_HIDDEN_FROM = 0.35


@dataclass(frozen=True, slots=True)
class Run:
    """A motion, a layout, a seed, and optionally one parameter of the sensors times a factor."""

    motion: str
    layout: int = 4
    seed: int = _FIRST_SEED
    parameter: str = ""
    factor: float = 1.0

    def recording(self, *, offsets_alone: bool = False, imus: Sequence[str] = ()) -> SimulatedRecording:
        """Simulate the run.

        Args:
            offsets_alone: the offsets of the joint centres are the cameras' only errors.
            imus: segments that carry an inertial sensor.
        """
        errors = KinectErrors()
        if self.parameter:
            errors = errors.scaled(self.factor, (self.parameter,))
        if offsets_alone:
            errors = errors.offsets_alone()
        worn = tuple(SimulatedImu(f"imu_{each}", each, usual_mounting(each), oriented=True) for each in imus)
        return simulate(Setup(self.motion, layout(self.layout), imus=worn, seed=self.seed, errors=errors))


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one method in one run, in mm, degrees, shares and ms; NaN where they are not defined."""

    error: float
    fixed: float
    hidden: float
    elevation: float
    elbow: float
    covered_elevation: float
    covered_elbow: float
    delay: float
    frames: float


def run_ours(recording: SimulatedRecording, filter_name: str) -> tuple[list[Skeleton], list[Skeleton]]:
    """Fused and filtered skeletons of the graph at its defaults."""
    sensors = tuple(sensor.pose.sensor for sensor in recording.sensors)
    return filtered_by(ReplaySettings(sensors, filter_name=filter_name), recording.frames)


def filtered_by(settings: ReplaySettings, frames: Sequence[RecordedFrame]) -> tuple[list[Skeleton], list[Skeleton]]:
    """Fused and filtered skeletons of the graph from frames of its sensors in the order of receipt."""
    found: dict[str, list[Skeleton]] = {graph.FUSED: [], graph.FILTERED: []}

    def take(topic: str, cdr: bytes, _at_ns: int) -> None:
        if topic in found:
            found[topic] += decode_skeletons(cdr) or ()

    play(settings, frames, take)
    return found[graph.FUSED], found[graph.FILTERED]


def reported(recording: SimulatedRecording) -> list[Skeleton]:
    """Skeletons of the first sensor, in world."""
    reference = recording.sensors[0].pose
    return [
        Skeleton(each.stamp_ns, "world", reference.apply(each.positions), each.states)
        for frame in recording.frames
        if frame.sensor == reference.sensor
        for each in frame.skeletons
    ]


def outputs_of(recording: SimulatedRecording, methods: Sequence[str]) -> dict[str, list[Skeleton]]:
    """Output of each method for a recording, in world and in the reference clock."""
    outputs: dict[str, list[Skeleton]] = {}
    if ONE in methods:
        outputs[ONE] = reported(recording)
    hers = [name for name in (LKF1, LKF2, EKF) if name in methods]
    if hers:
        names = [sensor.pose.sensor for sensor in recording.sensors]
        outputs |= {name: own for name, own in run_thesis(recording.frames, names, hers).items() if name in hers}
    for name, filter_name in ((DEFAULT, DEFAULT_FILTER), (OURS, "ekf")):
        if name in methods:
            fused, outputs[name] = run_ours(recording, filter_name)
            if FUSED in methods:
                outputs[FUSED] = fused
    return outputs


def figures_of(run: Run, methods: Sequence[str] = METHODS) -> dict[str, Figures]:
    """Simulate a run and evaluate every method."""
    recording = run.recording()
    truth = recording.truths[0]
    zero = int(truth.stamps_ns[0])
    curve = Curve((truth.stamps_ns - zero) / NANOSECONDS, truth.positions)
    outputs = outputs_of(recording, methods)
    if ALONE in methods:
        outputs[ALONE] = reported(run.recording(offsets_alone=True))
    silent = Figures(*[float("nan")] * len(fields(Figures)))
    speaking = {name: each for name, each in outputs.items() if len(each) > 30}
    begin = max(each[0].stamp_ns for each in speaking.values())
    poses, capsules = [sensor.pose for sensor in recording.sensors], truth.person.capsules()
    return {
        name: compared([each for each in outputs[name] if each.stamp_ns >= begin], poses, capsules, curve, zero)
        if name in speaking
        else silent
        for name in methods
    }


def compared(
    skeletons: Sequence[Skeleton],
    poses: Sequence[SensorPose],
    capsules: Capsules,
    curve: Curve,
    zero_ns: int,
) -> Figures:
    """Compare skeletons with the true joints.

    Args:
        skeletons: output of a method, in world.
        poses: of the sensors in world, for hidden joints.
        capsules: the person's limbs, which hide joints.
        curve: true joints by time, seconds.
        zero_ns: stamp of the curve's time 0.
    """
    times = np.array([(each.stamp_ns - zero_ns) / NANOSECONDS for each in skeletons])
    first, last = curve.span
    inside = (times >= first) & (times <= last) & (np.diff(times, prepend=-np.inf) > 0.0)
    times = times[inside]
    skeletons = [each for each, there in zip(skeletons, inside, strict=True) if there]
    found = np.stack([np.where(each.valid[:, None], each.positions, np.nan) for each in skeletons])
    true = curve.at(times)
    errors = joint_errors(found, true)
    own = np.einsum("njba,njb->nja", segment_frames(true), found - true) - errors.offset
    apart = np.linalg.norm(own, axis=-1)[:, TEN]
    hidden = _hidden(poses, capsules, true)[:, TEN] & np.isfinite(apart)
    angles, stddev = _angles(skeletons)
    right, _ = _angles([_true_skeleton(each) for each in true])
    off = wrapped(angles - right)
    covered = np.where(np.isfinite(stddev), np.abs(off) <= common.NORMAL * stddev, np.nan)
    rmse = {name: float(np.degrees(np.sqrt(np.nanmean(off[:, columns] ** 2)))) for name, columns in ANGLES.items()}
    cover_of = {name: _nanmean(covered[:, columns]) for name, columns in ANGLES.items()}
    delay = find_delay(Trajectory(times, found), curve, window=0.25)
    return Figures(
        1e3 * float(np.nanmean(errors.mean[TEN])),
        1e3 * float(np.nanmean(errors.fixed_mean[TEN])),
        1e3 * float(apart[hidden].mean()) if hidden.any() else float("nan"),
        rmse["elevation"],
        rmse["elbow"],
        cover_of["elevation"],
        cover_of["elbow"],
        1e3 * delay,
        float(len(times)),
    )


def _nanmean(values: FloatArray) -> float:
    there = np.isfinite(values)
    return float(values[there].mean()) if there.any() else float("nan")


def _hidden(poses: Sequence[SensorPose], capsules: Capsules, true: FloatArray) -> BoolArray:
    """(n, 25) whether a joint lies behind the body for one sensor or more."""
    return np.any(
        [obstruction((true - pose.translation) @ pose.rotation, capsules).cover > _HIDDEN_FROM for pose in poses],
        axis=0,
    )


def _true_skeleton(positions: FloatArray) -> Skeleton:
    return Skeleton(0, "world", positions, np.full(len(positions), TrackingState.TRACKED, dtype=np.uint8))


def _angles(skeletons: Iterable[Skeleton]) -> tuple[FloatArray, FloatArray]:
    """(n, m) positional angles and their standard deviations, radians; NaN and infinity where unknown."""
    found = [positional_angles(each) for each in skeletons]
    return np.stack([each.position for each in found]), np.stack([each.position_stddev for each in found])


# --- many runs


def _measure(job: tuple[Run, tuple[str, ...]]) -> dict[str, Figures]:
    return figures_of(*job)


Table = dict[str, dict[str, dict[str, Mean]]]
"""Motion (or another kind of run), method, figure."""


def table_of(kinds: Sequence[str], results: Sequence[Mapping[str, Figures]]) -> Table:
    """Means of the results of each kind."""
    table: Table = {}
    for kind in dict.fromkeys(kinds):
        own = [result for name, result in zip(kinds, results, strict=True) if name == kind]
        table[kind] = {
            method: {item.name: Mean.of(getattr(each[method], item.name) for each in own) for item in fields(Figures)}
            for method in own[0]
        }
    return table


def main_part(seeds: int, workers: int, motions: Sequence[str]) -> Table:
    """Every motion in layout 4."""
    runs = [Run(motion, seed=_FIRST_SEED + seed) for motion in motions for seed in range(seeds)]
    return table_of([run.motion for run in runs], common.mapped(_measure, [(run, METHODS) for run in runs], workers))


def layouts_part(seeds: int, workers: int, motions: Sequence[str]) -> Table:
    """Every motion in every layout; the default pipeline and the thesis's second linear filter."""
    runs = [
        Run(motion, number, _FIRST_SEED + seed) for motion in motions for number in NUMBERS for seed in range(seeds)
    ]
    kinds = [f"{run.motion} {run.layout}" for run in runs]
    return table_of(kinds, common.mapped(_measure, [(run, (LKF2, DEFAULT)) for run in runs], workers))


def sensitivity_part(seeds: int, workers: int, motions: Sequence[str]) -> Table:
    """Each parameter of the simulator halved and doubled."""
    runs = [
        Run(motion, 4, _FIRST_SEED + seed, item.name, factor)
        for item in parameters()
        for factor in (0.5, 2.0)
        for motion in motions
        for seed in range(seeds)
    ]
    kinds = [f"{run.parameter} x{run.factor:g}" for run in runs]
    return table_of(kinds, common.mapped(_measure, [(run, (LKF2, EKF, DEFAULT, OURS)) for run in runs], workers))


# --- the page

DOCS = common.ROOT / "docs"


def _section(part: str, table: Table) -> list[str]:
    people = _people(table)
    if part == "layouts":
        return [
            "## Layouts",
            "",
            "Mean 3D error of the default pipeline in the layouts of table 5.1 of Schlagenhauf (2017). A frame marks",
            f"the best layout of each motion; {people} people each.",
            "",
            "![error by motion and layout](accuracy_layouts.svg)",
        ]
    if part == "sensitivity":
        return [
            "## Sensitivity to the simulated sensors",
            "",
            "Mean error without constant offsets over the torso twist and reaching, with each parameter of the",
            "simulator halved and doubled. The change is smaller where a parameter reaches a bound of its range.",
            "",
            *_markdown(table, "fixed"),
        ]
    lines = [
        f"## Every motion in layout 4, {people} people each",
        "",
        f"The simulator was calibrated with other people, in {', '.join(KNOWN)}.",
        "The thesis calibrates in a T-pose. Its EKF starts from one and assumes that the base of the spine does",
        "not move, which is wrong when people walk or squat. Motions that begin without a T-pose: "
        f"{', '.join(_unposed(table)) or 'none'}.",
        "",
    ]
    for figure, title in _TITLES.items():
        lines += [f"### {title}", "", *_markdown(table, figure), ""]
    return [
        *lines,
        "### Ratios of errors without constant offsets: this package to the thesis",
        "",
        *_ratios(table),
    ]


_TITLES = {
    "error": "Mean 3D error, mm",
    "fixed": "Mean 3D error without each joint's constant offset, mm",
    "hidden": "Mean 3D error without constant offsets of joints that are hidden from a sensor, mm",
    "elevation": "Shoulder elevation, RMSE in degrees",
    "elbow": "Elbow flexion, RMSE in degrees",
    "covered_elevation": "Shoulder elevation: share of errors within 1.96 standard deviations",
    "covered_elbow": "Elbow flexion: share of errors within 1.96 standard deviations",
    "delay": "Delay by the stamps, ms (without the time that a method waits)",
}


def _unposed(motions: Iterable[str]) -> list[str]:
    """The motions that do not begin with a T-pose."""
    anybody = Person.average("female")
    return [motion for motion in motions if not make_movement(motion, anybody, None).tpose_s]


def _people(table: Table) -> int:
    return max(row[DEFAULT]["error"].count for row in table.values())


def _read(path: Path) -> dict[str, Table]:
    return {
        part: {
            kind: {method: {name: Mean(**mean) for name, mean in row.items()} for method, row in rows.items()}
            for kind, rows in table.items()
        }
        for part, table in json.loads(path.read_text()).items()
    }


def _markdown(table: Table, figure: str) -> list[str]:
    methods = list(next(iter(table.values())))
    digits = 2 if figure.startswith("covered") else 1
    rows = [f"| | {' | '.join(methods)} |", "|---|" + "---:|" * len(methods)]
    for kind, row in table.items():
        cells = []
        for method in methods:
            mean = row[method][figure]
            half = "" if np.isnan(mean.half) else f" ± {mean.half:.{digits}f}"
            cells.append("-" if np.isnan(mean.value) else f"{mean.value:.{digits}f}{half}")
        rows.append(f"| {kind} | {' | '.join(cells)} |")
    columns = ([row[method][figure].value for row in table.values()] for method in methods)
    medians = (float("nan") if np.isnan(column).all() else np.nanmedian(column) for column in columns)
    rows.append("| **median** | " + " | ".join("-" if np.isnan(m) else f"**{m:.{digits}f}**" for m in medians) + " |")
    return rows


def _ratios(table: Table) -> list[str]:
    pairs = [(own, hers) for own in (DEFAULT, OURS) for hers in (LKF2, EKF)]
    rows = ["| | " + " | ".join(f"{own} / {hers}" for own, hers in pairs) + " |", "|---|" + "---:|" * len(pairs)]
    ratios = {
        motion: [row[own]["fixed"].value / row[hers]["fixed"].value for own, hers in pairs]
        for motion, row in table.items()
    }
    rows += [f"| {motion} | " + " | ".join(f"{ratio:.2f}" for ratio in row) + " |" for motion, row in ratios.items()]
    medians = np.median(np.array(list(ratios.values())), axis=0)
    rows.append("| **median** | " + " | ".join(f"**{ratio:.2f}**" for ratio in medians) + " |")
    return rows


def draw_layouts(table: Table, path: Path) -> None:
    """Draw the mean error of the default pipeline by motion and layout."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Picture

    motions = list(dict.fromkeys(kind.rsplit(" ", 1)[0] for kind in table))
    values = np.array([[table[f"{m} {n}"][DEFAULT]["error"].value for n in NUMBERS] for m in motions])
    picture = Picture(figsize=(8.0, 0.42 * len(motions) + 1.6), layout="constrained")
    FigureCanvasSVG(picture)
    axes = picture.add_subplot()
    image = axes.imshow(values, aspect="auto", cmap="viridis_r", vmax=float(np.nanquantile(values, 0.95)))
    axes.set_xticks(range(len(NUMBERS)), [str(number) for number in NUMBERS])
    axes.set_yticks(range(len(motions)), motions)
    axes.set_xlabel("layout (1-6: both sensors at 0, 15, ... 75 degrees; 7-9: one in front, one at 30, 60, 90)")
    for row, line in enumerate(values):
        best = int(np.nanargmin(line))
        for column, value in enumerate(line):
            dark = image.norm(value) > 0.6
            axes.text(
                column, row, f"{value:.0f}", ha="center", va="center", fontsize=8, color="white" if dark else "black"
            )
        axes.add_patch(_frame(best, row))
    picture.colorbar(image, label="mean 3D error, mm")
    picture.savefig(path, metadata={"Date": None})


def _frame(column: int, row: int) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, fill=False, edgecolor="red", linewidth=1.5)


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__, seeds=20, motions=MOTIONS, jobs=True)
    parser.add_argument("--layout-seeds", type=int, default=4, metavar="N", help="of the layouts (default: 4)")
    parser.add_argument("--sensitivity-seeds", type=int, default=2, metavar="N", help="of each change (default: 2)")
    parser.add_argument(
        "--parts",
        type=common.names,
        default=["main", "layouts", "sensitivity"],
        metavar="A,B",
        help="of main,layouts,sensitivity (default: all); parts that FILE has from before stay in it",
    )
    parser.add_argument("--write", action="store_true", help="write docs/accuracy.md and its figure")
    args = parser.parse_args()
    parts = _read(args.out) if args.out and args.out.exists() else {}
    for part in args.parts:
        if part == "main":
            parts[part] = main_part(args.seeds, args.jobs, args.motions)
        elif part == "layouts":
            parts[part] = layouts_part(args.layout_seeds, args.jobs, args.motions)
        elif part == "sensitivity":
            parts[part] = sensitivity_part(args.sensitivity_seeds, args.jobs, [TWIST, "reaching"])
        else:
            parser.error(f"no such part: {part}")
    common.report(args, parts)
    if args.write:
        for part, table in parts.items():
            common.write_section(DOCS / "accuracy.md", part, "accuracy.py", _section(part, table))
        if "layouts" in parts:
            draw_layouts(parts["layouts"], DOCS / "accuracy_layouts.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
