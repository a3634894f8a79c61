"""Our joint centres and arm angles from Plug-in Gait markers beside those that Vicon wrote into the same files.

Per file two sets of the subject's measurements: those that Vicon used, from the C3D (``file``) or, where it holds none,
from the subject file beside it (``vsk``); and none, so that all of them are estimates (``estimated``). And for each the
trajectories as they are, with gaps filled (``filled``), and smoothed as well (``smoothed``).

Joint centres: distance from Vicon's, mean and maximum over the frames of both sides, mm. Angles: ours minus Vicon's, by
the convention that ``evaluation/plug_in_gait.py`` states, degrees. The mean is the constant offset, ``debiased`` the
RMS without it. With Vicon's measurements the differences are rounding, and what smoothing takes away: nothing where
Vicon's software had smoothed before. ``estimated`` tells what the truth is worth where nobody measured the subject.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from time_warp import compare

from body_tracking.errors import BodyTrackingError
from body_tracking.evaluation.plug_in_gait import (
    MarkerTruth,
    Measurements,
    read_measurements,
    read_plug_in_gait,
)
from body_tracking.skeleton import FloatArray, Joint

UNMEASURED = Measurements.from_parameters({})
SUBJECT_FILES = {"cgm__ROM__Sample_Static.c3d": "cgm__ROM__Sample_SM.vsk"}

CENTRES = {
    "shoulder": (Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT),
    "elbow": (Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT),
    "wrist": (Joint.WRIST_LEFT, Joint.WRIST_RIGHT),
    "hand": (Joint.HAND_LEFT, Joint.HAND_RIGHT),
    "hip": (Joint.HIP_LEFT, Joint.HIP_RIGHT),
}
ANGLES = ("elbow flexion", "shoulder flexion", "shoulder abduction", "shoulder internal rotation")


def variants(path: Path) -> Iterator[tuple[str, MarkerTruth]]:
    """The name of each set of measurements, and what comes of the file with it; unsmoothed, then smoothed."""
    sets: dict[str, Measurements | None] = {"estimated": UNMEASURED}
    if not read_plug_in_gait(path, smoothing=False).estimated:
        sets = {"file": None} | sets
    elif path.name in SUBJECT_FILES:
        sets = {"vsk": read_measurements(path.parent / SUBJECT_FILES[path.name])} | sets
    for name, measurements in sets.items():
        yield f"{name}, filled", read_plug_in_gait(path, measurements=measurements, smoothing=False)
        yield f"{name}, smoothed", read_plug_in_gait(path, measurements=measurements)


def angles_of(truth: MarkerTruth, ours: bool) -> FloatArray:
    """(n, 2, 4) degrees, left and right, in the order of ANGLES."""
    angles = truth.angles if ours else truth.vicon_angles
    return np.degrees(np.concatenate([angles.elbow[..., None], angles.shoulder], axis=-1))


def measure(truth: MarkerTruth) -> dict[str, Any]:
    """The figures of one row: per centre and per angle and side; none where Vicon wrote none."""
    apart = 1e3 * np.linalg.norm(truth.positions - truth.vicon_positions, axis=-1)
    figures: dict[str, Any] = {"frames": len(truth.stamps), "gaps": [str(gap) for gap in truth.gaps]}
    for name, joints in CENTRES.items():
        known = apart[:, joints][np.isfinite(apart[:, joints])]
        if known.size:
            figures[name] = {"mean_mm": float(known.mean()), "max_mm": float(known.max())}
    theirs = angles_of(truth, ours=False)
    ours = theirs + (angles_of(truth, ours=True) - theirs + 180.0) % 360.0 - 180.0
    for column, name in enumerate(ANGLES):
        for side, word in enumerate(("left", "right")):
            if (np.isfinite(ours) & np.isfinite(theirs))[:, side, column].sum() > 1:
                figures[f"{name}, {word}"] = asdict(compare(ours[:, side, column], theirs[:, side, column]))
    return figures


def main() -> int:
    """The benchmark; exit code 1 on an error, 2 where the files are absent."""
    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("BODY_TRACKING_DATA", root.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of real recordings (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    args = parser.parse_args()
    files = sorted((args.data / "plug_in_gait").glob("*.c3d"))
    if not files:
        print(f"the real recordings are absent ({args.data / 'plug_in_gait'})", file=sys.stderr)
        return 2
    try:
        rows = {path.name: {name: measure(truth) for name, truth in variants(path)} for path in files}
    except BodyTrackingError as error:
        print(error, file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    for number, (file, variant) in enumerate(rows.items()):
        print(f"{'' if number == 0 else chr(10)}{file}: {next(iter(variant.values()))['frames']} frames")
        print(f"{'  joint centres from Vicon’s, mm (mean / max)':<48}" + "".join(f"{name:>18}" for name in CENTRES))
        for name, figures in variant.items():
            cells = (figures.get(centre) for centre in CENTRES)
            print(f"    {name:<44}" + "".join(f"{_millimetres(each):>18}" for each in cells))
        print(f"{'  angles against Vicon’s, degrees':<48}{'':<20}{'left':^34}   {'right':^34}")
        heading = f"{'mean':>11}{'rms':>11}{'debiased':>12}"
        print(f"{'':<68}{heading}   {heading}")
        for angle in ANGLES:
            for name, figures in variant.items():
                sides = "   ".join(_degrees(figures.get(f"{angle}, {side}")) for side in ("left", "right"))
                print(f"    {angle:<40}{name:<24}{sides}")
    return 0


def _millimetres(figures: dict[str, float] | None) -> str:
    return "-" if figures is None else f"{figures['mean_mm']:.4f} / {figures['max_mm']:.4f}"


def _degrees(figures: dict[str, float] | None) -> str:
    if figures is None:
        return f"{'-':>11}{'-':>11}{'-':>12}"
    return f"{figures['bias']:>z11.4f}{figures['rms']:>z11.4f}{figures['debiased_rms']:>z12.4f}"


if __name__ == "__main__":
    sys.exit(main())
