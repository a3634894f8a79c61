"""Joint angles of real people by either of two Kinects v2 alone: do they differ by as much as their deviations state?

Each recording of ``kinect_pairs`` is replayed with one sensor at a time. A difference between the two angles at one
instant has the deviation sqrt(a^2 + b^2), if a and b are those of the two angles and their errors are independent.
Columns, medians over recordings: RMS of the differences, and the stated deviation, in degrees; means over recordings:
the share of the differences within 1.96 of it, and of the frames in which both angles are known to 30 degrees. Only
these frames count: a hanging arm has no plane of elevation, and no rotation of its own. Left and right count together.

What errs alike before both sensors is not seen: the constant offset of a joint from its anatomical place, and the means
to which `ekf` draws what points do not show (how lumbar and thoracic spine share a bend, pronation, wrists). There the
difference may be much less than stated, and is not to be more.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import common
import numpy as np
from every_angle import canonical, kind_of
from real_pairs import NOMINAL, PEOPLE

from body_tracking.calibration.online import CalibrationParameters
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.reading import AngleSeries, nearest, read
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.pipeline.graph import POSITIONAL
from body_tracking.recording.calibrate import calibrate
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay

CONVENTIONS = {DEFAULT_FILTER: POSITIONAL, "ekf": "isb"}
SENSORS = "kinect1", "kinect2"

_KNOWN = np.radians(30.0)
_LEAST_FRAMES = 100
COVERED = 0.88
"""Bar: least share of the differences within 1.96 stated deviations."""


def both(one: AngleSeries, two: AngleSeries, clock: ClockModel) -> dict[str, tuple[FloatArray, FloatArray]]:
    """By kind of angle the (n,) differences and their stated deviations, radians, of all frames of ``one``."""
    stamps = np.array([clock.to_reference(int(each)) for each in two.stamps_ns])
    matches = nearest(stamps, one.stamps_ns)
    here, there = np.flatnonzero(matches >= 0), matches[matches >= 0]
    angles = canonical(one).position[here], canonical(two).position[there]
    found: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    for column, name in enumerate(one.names):
        other = two.names.index(name)
        own, theirs = angles[0][:, column], angles[1][:, other]
        stated = one.stddev[here, column], two.stddev[there, other]
        known = (stated[0] < _KNOWN) & (stated[1] < _KNOWN)
        difference = np.where(known, wrapped(own - theirs), np.nan)
        found.setdefault(kind_of(name), []).append((difference, np.hypot(*stated)))
    return {
        name: (np.concatenate([d for d, _ in each]), np.concatenate([s for _, s in each]))
        for name, each in found.items()
    }


def figures_of(file: Path) -> dict[str, dict[str, dict[str, float]]]:
    """By filter and kind of angle the figures of one recording."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        import_files([file], bag)
        clock = calibrate(bag, CalibrationParameters())[0].clocks[SENSORS[1]]
        for name, convention in CONVENTIONS.items():
            series = []
            for sensor in SENSORS:
                out = Path(folder) / f"{name} {sensor}"
                replay(bag, out, ReplaySettings((sensor,), filter_name=name, convention=convention))
                series.append(read(out).angles)
            found[name] = {each: _figures(*values) for each, values in both(*series, clock).items()}
    return found


def _figures(difference: FloatArray, stated: FloatArray) -> dict[str, float]:
    known = np.isfinite(difference)
    if known.sum() < _LEAST_FRAMES:
        return {"rms": np.nan, "stated": np.nan, "covered": np.nan, "known": float(known.mean())}
    return {
        "rms": common.rms_deg(difference),
        "stated": float(np.degrees(np.median(stated[known]))),
        "covered": float((np.abs(difference) <= common.NORMAL * stated)[known].mean()),
        "known": float(known.mean()),
    }


def over_recordings(rows: list[dict[str, float]]) -> dict[str, float]:
    """Medians of the sizes, means of the shares; of recordings with enough frames."""
    enough = [row for row in rows if np.isfinite(row["rms"])]
    return {
        **{key: float(np.median([row[key] for row in enough])) if enough else np.nan for key in ("rms", "stated")},
        "covered": float(np.mean([row["covered"] for row in enough])) if enough else np.nan,
        "known": float(np.mean([row["known"] for row in rows])),
        "recordings": float(len(enough)),
    }


def main() -> int:
    """The benchmark; exit code 1 where differences are larger than stated."""
    parser = common.parser(__doc__, data=True, jobs=True)
    args = parser.parse_args()
    wanted = [f"{who}_{layout}.csv.gz" for layout in NOMINAL for who in PEOPLE]
    recordings = common.mapped(figures_of, common.recordings(args.data / "kinect_pairs", wanted), args.jobs)
    figures = {
        name: {each: over_recordings([row[name][each] for row in recordings]) for each in recordings[0][name]}
        for name in CONVENTIONS
    }
    common.report(args, figures)
    met = {}
    for name, rows in figures.items():
        low = [each for each, row in rows.items() if row["covered"] < COVERED]
        met[
            f"{name}: every difference within 1.96 deviations in 88 %{'; not ' + ', '.join(low) if low else ''}"
        ] = not low
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
