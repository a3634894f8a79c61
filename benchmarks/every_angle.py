"""How wrong is every angle of a convention? Both filters on simulated people before two Kinects v2 (layouts 2 and 4).

Columns, in degrees: RMSE of the median person, median stated standard deviation, mean error; then the share of the
errors within 1.96 of the deviation, and of the frames with a finite one. Left and right count together. The people,
motions and seeds are those of the table in docs/accuracy.md; no filter was tuned on them.

  python benchmarks/every_angle.py                        30 people: about 5 minutes on two cores
  python benchmarks/every_angle.py --motions squat --convention model
  python benchmarks/every_angle.py --sensors kinect1 --motions walking_and_turning --seeds 6   the first one alone
  python benchmarks/every_angle.py --set posture=false    ``ekf`` with a mechanism switched off
  python benchmarks/every_angle.py --imus pelvis upper_trunk   with inertial sensors, which ``ekf`` takes
  python benchmarks/every_angle.py --unseen legs     as behind a table: nothing is seen below the waist
"""

from __future__ import annotations

import functools
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
from accuracy import Run

from body_tracking.core.skeleton import FloatArray, Joint, TrackingState
from body_tracking.core.so3 import wrapped
from body_tracking.core.sources import RecordedFrame
from body_tracking.evaluation.reading import AngleSeries, nearest, read
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.kinematics.conventions import CONVENTIONS
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.repertoire import MOTIONS

FILTERS = (DEFAULT_FILTER, "ekf")
LAYOUTS = (2, 4)
_FIRST_SEED = 9700
_LEGS = "SPINE_BASE", "HIP", "KNEE", "ANKLE", "FOOT"
UNSEEN = {"": (), "legs": _LEGS, "trunk": (*_LEGS, "SPINE_MID")}
"""Beginnings of the names of joints that no sensor sees."""


def filters_for(unseen: str) -> tuple[str, ...]:
    """The filters compared; without a trunk the default one has no model's angles."""
    return FILTERS[1:] if unseen == "trunk" else FILTERS


Errors = dict[str, dict[str, tuple[FloatArray, FloatArray]]]
"""By filter and angle without its side: (n,) errors and (n,) stated standard deviations, radians."""


def errors_of(
    convention: str,
    sensors: tuple[str, ...],
    imus: tuple[str, ...],
    unseen: str,
    ekf: Mapping[str, float],
    run: Run,
) -> Errors:
    """The errors of one person's angles, with these parameters of ``ekf``."""
    found: Errors = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = run.recording(imus=imus)
        seen = tuple(without(each, UNSEEN[unseen]) for each in recording.frames)
        write_bag(replace(recording, frames=seen), Path(folder) / "in")
        for name in filters_for(unseen):
            out = Path(folder) / name
            given = {"skeleton_filter": {f"ekf.{key}": value for key, value in ekf.items()}}
            worn = tuple(f"{each}:imu_{each}" for each in imus)
            settings = ReplaySettings(sensors, filter_name=name, convention=convention, imus=worn, parameters=given)
            replay(Path(folder) / "in", out, settings)
            tracked = read(out)
            true = canonical(tracked.true_angles)
            errors, stddevs = against_truth(canonical(tracked.angles), true, tracked.angles.names)
            kinds = np.array([kind_of(each) for each in tracked.angles.names])
            found[name] = {
                kind: (errors[:, kinds == kind].ravel(), stddevs[:, kinds == kind].ravel())
                for kind in dict.fromkeys(kinds)
            }
    return found


def without(frame: RecordedFrame, unseen: tuple[str, ...]) -> RecordedFrame:
    """A frame in which joints whose names begin so are not tracked."""
    rows = [joint for joint in Joint if unseen and joint.name.startswith(unseen)]
    found = []
    for seen in frame.skeletons:
        positions, states = seen.positions.copy(), seen.states.copy()
        positions[rows], states[rows] = np.nan, TrackingState.NOT_TRACKED
        found.append(replace(seen, positions=positions, states=states))
    return replace(frame, skeletons=tuple(found))


def against_truth(
    angles: AngleSeries, truth: AngleSeries | None, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """(n, k) errors of angles at stamps with a known truth, and (n, k) their stated standard deviations; radians."""
    assert truth is not None
    matches = nearest(truth.stamps_ns, angles.stamps_ns)
    here = matches >= 0
    own = [angles.names.index(each) for each in names]
    true = truth.position[matches[here]][:, [truth.names.index(each) for each in names]]
    return wrapped(angles.position[here][:, own] - true), angles.stddev[here][:, own]


def canonical(angles: AngleSeries) -> AngleSeries:
    """The angles with ISB's elevation negative throughout.

    ISB's three angles of a shoulder, (plane, elevation, rotation) and (plane + pi, -elevation, rotation + pi), are one
    pose, and each series continues its own of them through a hanging arm.
    """
    position = angles.position.copy()
    for side in ("left", "right"):
        names = [f"shoulder_{each}_{side}" for each in ("plane_of_elevation", "elevation", "internal_rotation")]
        if set(names) <= set(angles.names):
            plane, elevation, rotation = (angles.names.index(name) for name in names)
            other = position[:, elevation] > 0.0
            position[other, elevation] *= -1.0
            position[np.ix_(other, [plane, rotation])] += np.pi
    return replace(angles, position=position)


def kind_of(angle: str) -> str:
    """The name without the side of an arm; ``thorax_axial_left`` is a direction."""
    limb, _, side = angle.rpartition("_")
    return limb if side in ("left", "right") and not angle.startswith(("thorax", "neck")) else angle


def figures_of(people: list[tuple[FloatArray, FloatArray]]) -> dict[str, float]:
    """The columns of one angle, from the errors and deviations of each person."""
    errors, stddevs = (np.concatenate(each) for each in zip(*people, strict=True))
    known = np.isfinite(errors) & np.isfinite(stddevs)
    return {
        "rmse": float(np.median([common.rms_deg(error) for error, _ in people])),
        "stddev": float(np.degrees(np.median(stddevs[known]))),
        "bias": float(np.degrees(errors[known].mean())),
        "covered": float((np.abs(errors) <= common.NORMAL * stddevs)[known].mean()),
        "finite": float(known.mean()),
    }


def main() -> int:
    """The command line."""
    parser = common.parser(__doc__, seeds=1, motions=list(MOTIONS), jobs=True)
    parser.add_argument("--convention", choices=list(CONVENTIONS), default="isb", help="default: %(default)s")
    parser.add_argument("--sensors", nargs="+", default=[], metavar="NAME", help="default: both")
    parser.add_argument("--imus", nargs="+", default=[], metavar="SEGMENT", help="segments with inertial sensors")
    parser.add_argument("--unseen", choices=list(UNSEEN), default="", help="parts of the body that no sensor sees")
    common.add_set(parser)
    args = parser.parse_args()
    cases = [(motion, layout) for motion in args.motions for layout in LAYOUTS for _ in range(args.seeds)]
    runs = [Run(motion, layout, _FIRST_SEED + number) for number, (motion, layout) in enumerate(cases)]
    work = functools.partial(
        errors_of, args.convention, tuple(args.sensors), tuple(args.imus), args.unseen, dict(args.set)
    )
    people = common.mapped(work, runs, args.jobs)
    figures = {
        name: {kind: figures_of([each[name][kind] for each in people]) for kind in people[0][name]}
        for name in filters_for(args.unseen)
    }
    met = {}
    for name, rows in figures.items():
        met[f"{name}: every angle finite in 99 %"] = min(row["finite"] for row in rows.values()) >= 0.99
        low = {kind: row["covered"] for kind, row in rows.items() if row["covered"] < 0.9}
        met[f"{name}: every angle covered in 90 %{'; not ' + ', '.join(low) if low else ''}"] = not low
    if DEFAULT_FILTER in figures:
        default = figures[DEFAULT_FILTER]
        worse = [kind for kind, row in figures["ekf"].items() if row["rmse"] > default[kind]["rmse"]]
        met[
            f"ekf: no angle worse than with the default filter{'; not ' + ', '.join(worse) if worse else ''}"
        ] = not worse
    for rows in figures.values():
        columns = next(iter(rows.values()))
        rows["mean"] = {column: float(np.mean([row[column] for row in rows.values()])) for column in columns}
    common.report(args, figures)
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
