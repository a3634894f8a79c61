"""Do published angles teleport? Impossible steps between frames, and the cost of a replay with each filter.

A teleport is a step of an angle by more than 60 degrees between two frames at most 0.1 s apart, with stated standard
deviations below 15 degrees. All angles of the filter's default convention count, in three kinds of recordings:

simulated   people with seeds on which nothing was tuned: all motions in turn, layouts 1 to 9 in turn
pairs       the nine real pairs of Kinect v2 sensors (``kinect_pairs``)
clips       real exercises of the right arm in front of one Kinect v2 (``kinect_vs_vicon``)

``unusual`` is the percentage of the shoulders with a known direction (first two angles below 15 degrees, conventions of
the model) in an unusual branch: the angles are outside their usual ranges by 30 degrees more than the equivalent triple
of the same rotation. ``twisted`` is the percentage of the known twists of the trunk (standard deviation below 15
degrees) that no person can do, more than 80 degrees. Steps, unusual branches and such twists mislead a user.

Recordings and pairs are replayed as by ``body_tracking replay``, with each filter in turn; clips are filtered frame by
frame. ``known`` is the share of the frames with angles in which elevation, plane of elevation, elbow and trunk angles
have a stated standard deviation below 15 degrees (the plane where the arm is raised by 30 to 150 degrees). ``cpu`` is
the processor time of a replay, both processes, in seconds per second of the recording; ``speed`` is the duration of the
recording over that of the replay, which depends on the load of the machine.
"""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import numpy as np
from kinect_vs_vicon import kinect_skeletons

from body_tracking.calibration.kinect_spine import corrected_kinect
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.reading import AngleSeries, read
from body_tracking.filters import DEFAULT_FILTER, ModelFilter, make_filter
from body_tracking.kinematics.conventions import CONVENTIONS, angles_of, convention
from body_tracking.kinematics.positional import positional_angles
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.layouts import NUMBERS, layout
from body_tracking.simulation.repertoire import MOTIONS
from body_tracking.simulation.scene import Setup, simulate

FILTERS = (DEFAULT_FILTER, "ekf")
STEP, SURE = np.radians(60.0), np.radians(15.0)
SOON_NS = NANOSECONDS // 10
"""Frames that are farther apart are not compared."""
ALLOWED = 0
"""Allowed number of teleports."""
KNOWN = 90.0
"""Percent of the frames of a real pair."""
PARTS = ("simulated", "pairs", "clips")
RAISED = np.radians(30.0), np.radians(150.0)
_UNUSUAL = np.radians(30.0)
_TWISTED = np.radians(80.0)
_FIRST_SEED = 5300
"""Far from the seeds of all other benchmarks."""


@dataclass(frozen=True, slots=True)
class Job:
    """A recording to evaluate: its part, its name, and its file or the number of the simulated run."""

    part: str
    name: str
    file: Path | None = None
    number: int = 0


def teleports(angles: AngleSeries) -> list[str]:
    """Per teleport: the angle, its time in seconds, and the step in degrees."""
    steps = np.abs(wrapped(np.diff(angles.position, axis=0)))
    sure = np.maximum(angles.stddev[1:], angles.stddev[:-1]) < SURE
    sure &= (np.diff(angles.stamps_ns) < SOON_NS)[:, None]
    seconds = (angles.stamps_ns - angles.stamps_ns[0]) / NANOSECONDS
    return [
        f"{angles.names[column]} at {seconds[row + 1]:.2f} s by {np.degrees(steps[row, column]):.0f}"
        for row, column in np.argwhere((steps > STEP) & sure)
    ]


def unusual(angles: AngleSeries) -> tuple[int, int]:
    """Number of known shoulders, and number of those in an unusual branch."""
    found = np.zeros(2, dtype=np.int64)
    model = UpperBody()
    chains = [
        chain for name in CONVENTIONS if (c := convention(name, model)).names == angles.names for chain in c.chains
    ]
    for chain in chains:
        if not all(name is not None and "shoulder" in name for name in chain.names):
            continue
        columns = [angles.names.index(str(name)) for name in chain.names]
        triples, (low, high) = angles.position[:, columns], np.radians(np.array(chain.angles.usual)).T
        first, _, last = chain.angles.axes
        # the equivalent triple adds half a turn to two angles and mirrors the middle one: at 0 for proper Euler angles,
        # at 90 degrees for Cardan angles
        mirrored = (0.0 if abs(first @ last) > 0.5 else np.pi) - triples[:, 1]
        others = np.stack([triples[:, 0] + np.pi, mirrored, triples[:, 2] + np.pi], axis=1)
        together = np.radians(chain.angles.together)
        own, other = (_outside(each, low, high, together) for each in (triples, others))
        sure = (angles.stddev[:, columns[:2]] < SURE).all(axis=1)
        found += np.array([sure.sum(), (sure & (own - other > _UNUSUAL)).sum()])
    return int(found[0]), int(found[1])


def twisted(angles: AngleSeries) -> tuple[int, int]:
    """Number of known twists of the trunk, and number of those that no person can do."""
    column = next(k for k, name in enumerate(angles.names) if name.startswith("trunk_axial"))
    sure = angles.stddev[:, column] < SURE
    return int(sure.sum()), int((sure & (np.abs(angles.position[:, column]) > _TWISTED)).sum())


def _outside(triples: FloatArray, low: FloatArray, high: FloatArray, together: float) -> FloatArray:
    """(n,) sum of the amounts by which (n, 3) angles, modulo full turns, leave their usual ranges, radians."""
    middle = 0.5 * (low + high)
    inside = middle + wrapped(triples - middle)
    outside: FloatArray = np.maximum(np.maximum(inside - high, low - inside), 0.0).sum(axis=1)
    outside += np.maximum(np.abs(inside[:, :2]).sum(axis=1) - together, 0.0)
    return outside


def known(angles: AngleSeries) -> dict[str, float]:
    """Percentage of the frames in which an angle has a small stated standard deviation, the least of each kind."""
    trunk = "thorax" if any(name.startswith("thorax") for name in angles.names) else "trunk"
    kinds = {"elevation": "shoulder_elevation", "plane": "shoulder_plane", "elbow": "elbow", "trunk": trunk}
    found: dict[str, float] = {}
    for kind, part in kinds.items():
        for column, name in enumerate(angles.names):
            if part not in name:
                continue
            counted = np.ones(len(angles.stamps_ns), dtype=np.bool_)
            if kind == "plane":
                counted = _raised(angles, name.rpartition("_")[2])
            if counted.any():
                share = 100.0 * float((angles.stddev[counted, column] < SURE).mean())
                found[kind] = min(found.get(kind, 100.0), share)
    return found


def _raised(angles: AngleSeries, side: str) -> BoolArray:
    """(n,) whether the plane of elevation of an arm is well defined."""
    elevation = np.abs(angles.position[:, angles.names.index(f"shoulder_elevation_{side}")])
    raised: BoolArray = (elevation > RAISED[0]) & (elevation < RAISED[1])
    return raised


def _cpu() -> float:
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def of_replays(job: Job) -> dict[str, dict[str, Any]]:
    """The figures of a recording with each filter."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "in"
        if job.file is None:
            number = job.number
            setup = Setup(
                list(MOTIONS)[number % len(MOTIONS)], layout(NUMBERS[number % len(NUMBERS)]), seed=_FIRST_SEED + number
            )
            write_bag(simulate(setup), bag)
        else:
            import_files([job.file], bag)
        for name in FILTERS:
            before = _cpu()
            report = replay(bag, Path(folder) / name, ReplaySettings((), filter_name=name))
            spent = _cpu() - before
            angles = read(Path(folder) / name).angles
            found[name] = {
                "teleports": teleports(angles),
                "unusual": unusual(angles),
                "twisted": twisted(angles),
                "frames": len(angles.stamps_ns),
                "cpu": spent / report.recording_s,
                "speed": report.recording_s / report.elapsed_s,
                **known(angles),
            }
    return found


def of_clip(job: Job) -> dict[str, dict[str, Any]]:
    """The figures of a clip with each filter."""
    assert job.file is not None
    skeletons = [corrected_kinect(each) for each in kinect_skeletons(job.file)]
    found = {}
    for name in FILTERS:
        chosen, series, last = make_filter(name), [], None
        for each in skeletons:
            out = chosen.update(each)
            if out is None:
                continue
            if isinstance(chosen, ModelFilter):
                estimate = chosen.estimate
                assert estimate is not None
                last = angles_of(estimate, UpperBody(), "model", last)
            else:
                last = positional_angles(out)
            series.append(last)
        angles = AngleSeries(
            np.array([each.stamp_ns for each in series], dtype=np.int64),
            series[0].names,
            np.stack([each.position for each in series]),
            np.stack([each.position_stddev for each in series]),
        )
        found[name] = {
            "teleports": teleports(angles),
            "unusual": unusual(angles),
            "twisted": twisted(angles),
            "frames": len(series),
        }
    return found


def measure(job: Job) -> dict[str, dict[str, Any]]:
    """The figures of a recording of any part."""
    return of_clip(job) if job.part == "clips" else of_replays(job)


def summary(results: list[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Figures of each filter over several recordings: sums of frames and teleports, medians of the rest."""
    found: dict[str, dict[str, Any]] = {}
    for name in FILTERS:
        own = [each[name] for each in results]
        row: dict[str, Any] = {
            "recordings": len(own),
            "frames": sum(each["frames"] for each in own),
            "teleports": sum(len(each["teleports"]) for each in own),
        }
        for column in ("unusual", "twisted"):
            sure, astray = (sum(each[column][k] for each in own) for k in range(2))
            if sure:
                row[column] = 100.0 * astray / sure
        for column in ("cpu", "speed", "elevation", "plane", "elbow", "trunk"):
            values = [each[column] for each in own if column in each]
            if values:
                row[column] = float(np.median(values))
        found[name] = row
    if all("cpu" in found[name] for name in FILTERS):
        ratios: FloatArray = np.array([each["ekf"]["cpu"] / each[DEFAULT_FILTER]["cpu"] for each in results])
        found["ekf"]["cpu of default"] = float(np.median(ratios))
    return found


def main() -> int:
    """The benchmark; exit code 1 if there are too many teleports."""
    parser = common.parser(__doc__, jobs=True, data=True)
    parser.add_argument("--parts", type=common.names, default=list(PARTS), help=f"which of {','.join(PARTS)}")
    parser.add_argument("--runs", type=int, default=40, metavar="N", help="simulated runs (default: %(default)s)")
    args = parser.parse_args()
    pairs = sorted((args.data / "kinect_pairs").glob("p??_*.csv.gz"))
    clips = sorted((args.data / "kinect_vs_vicon").glob("*_kinect.csv.gz"))
    jobs = [Job("simulated", f"run {number}", number=number) for number in range(args.runs)]
    jobs += [Job("pairs", file.name.split(".")[0], file) for file in pairs]
    jobs += [Job("clips", file.name.split(".")[0], file) for file in clips]
    jobs = [job for job in jobs if job.part in args.parts]
    if not jobs:
        return common.ABSENT
    results = common.mapped(measure, jobs, args.jobs)
    figures: dict[str, Any] = {}
    for part in dict.fromkeys(job.part for job in jobs):
        figures[part] = summary([result for job, result in zip(jobs, results, strict=True) if job.part == part])
    where = {
        f"{job.name}, {name}": result[name]["teleports"]
        for job, result in zip(jobs, results, strict=True)
        for name in FILTERS
        if result[name]["teleports"]
    }
    common.report(args, figures | {"where": where})
    counts = {name: sum(part[name]["teleports"] for part in figures.values()) for name in FILTERS}
    return common.verdicts(
        args, {f"{name}: {count} teleports, allowed {ALLOWED}": count <= ALLOWED for name, count in counts.items()}
    )


if __name__ == "__main__":
    sys.exit(main())
