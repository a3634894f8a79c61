"""Nine recordings of two real Kinect v2 sensors: calibration, agreement and left and right, beside the thesis's method.

Imports each recording of ``kinect_pairs`` into a bag, runs the graph over it offline (``body_tracking replay``) and
calibrates it with both methods (``body_tracking calibrate``). The taped marks give the true relative yaw.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from body_tracking.calibration.offline import calibrate, relative_yaw
from body_tracking.calibration.online import CalibrationParameters
from body_tracking.calibration.result import CalibrationResult
from body_tracking.cdr import decode_skeletons
from body_tracking.graph import CALIBRATION, FILTERED
from body_tracking.measurement import left_right_axes
from body_tracking.messages.base import TRANSFORM
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import deserialize
from body_tracking.skeleton import NANOSECONDS, FloatArray, IntArray, Skeleton

NOMINAL = {"parallel": 0.8, "45deg": -45.8, "90deg": -88.0}
"""Relative yaw of kinect2 to kinect1 in Kinect camera axes, degrees."""

LIMITS = {"parallel": 36.0, "45deg": 62.0, "90deg": 107.0}
"""Most that the two sensors may disagree on a joint, mean over joints and frames, median over recordings, mm."""

PEOPLE = ("p02", "p07", "p12")

PAUSE = 5.0
"""The first movement starts after the first gap longer than this, seconds."""


def skeletons(bag: Path, topic: str) -> list[Skeleton]:
    """All of a topic's skeletons, in order of their stamps."""
    with RigReader(bag) as reader:
        found = [decode_skeletons(raw.cdr) for raw in reader.messages([topic])]
    return sorted((each[0] for each in found if each), key=lambda each: each.stamp_ns)


def paired(
    one: Sequence[Skeleton], two: Sequence[Skeleton], result: CalibrationResult
) -> tuple[IntArray, FloatArray, FloatArray]:
    """What both sensors say at the captures of the first, where the second has frames close before and after.

    Args:
        one: frames of kinect1, in order of their stamps.
        two: of kinect2.
        result: where both stand, and how their clocks run.

    Returns:
        (n,) nanoseconds of kinect1's clock; (n, 25, 3) metres in ``world`` by kinect1; the same by kinect2.
    """
    clock = result.clocks["kinect2"]
    stamps = np.array([clock.to_reference(each.stamp_ns) for each in two])
    theirs = result.poses["kinect2"].apply(np.stack([each.positions for each in two]))
    at = np.array([each.stamp_ns for each in one])
    ours = result.poses["kinect1"].apply(np.stack([each.positions for each in one]))
    after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    step = stamps[after] - stamps[after - 1]
    covered = (at >= stamps[after - 1]) & (at <= stamps[after]) & (step > 0) & (step < 0.08 * NANOSECONDS)
    share = ((at - stamps[after - 1]) / np.maximum(step, 1))[:, None, None]
    between = theirs[after - 1] + share * (theirs[after] - theirs[after - 1])
    return at[covered], ours[covered], between[covered]


def disagreement(bag: Path, result: CalibrationResult) -> float:
    """Mean distance between what both sensors say of a joint, all joints, all frames that both cover; metres."""
    _, ours, theirs = paired(skeletons(bag, "/kinect1/skeleton"), skeletons(bag, "/kinect2/skeleton"), result)
    return float(np.linalg.norm(ours - theirs, axis=-1).mean())


def settling(bag: Path, movement_ns: int, nominal: float) -> float:
    """Seconds of movement until the published yaw is within 3 degrees of the marks and stays there."""
    reference, wrong_until = None, movement_ns
    with RigReader(bag) as reader:
        for raw in reader.messages([CALIBRATION]):
            pose = transform_to_pose(deserialize(TRANSFORM, raw.cdr))
            if pose.sensor == "kinect1":
                reference = pose
            elif reference is not None:
                rotation = reference.rotation.T @ pose.rotation
                yaw = np.degrees(np.arctan2(-rotation[0, 2], rotation[2, 2]))
                if abs(yaw - nominal) > 3.0:
                    wrong_until = max(wrong_until, pose.valid_from_ns)
    return (wrong_until - movement_ns) / NANOSECONDS


def reversals(axes: FloatArray) -> int:
    """How often an axis turns by more than a right angle from one frame to the next."""
    axes = axes[np.isfinite(axes).all(axis=1)]
    return int((np.einsum("ni,ni->n", axes[1:], axes[:-1]) <= 0.0).sum())


def measure(file: Path, folder: Path) -> dict[str, Any]:
    """All figures of one recording."""
    layout = file.name.split("_")[1].split(".")[0]
    bag, out = folder / f"{file.name}.bag", folder / f"{file.name}.out"
    import_files([file], bag)
    report = replay(bag, out, ReplaySettings(()))
    figures: dict[str, Any] = {"recording": file.name.split(".")[0], "layout": layout}
    for method in ("robust", "thesis"):
        result, _ = calibrate(bag, CalibrationParameters(method=method))
        figures[f"{method}_yaw_deg"] = float(np.degrees(relative_yaw(result, "kinect2")))
        figures[f"{method}_mm"] = 1e3 * disagreement(bag, result)
        if method == "robust":
            figures["stddev_deg"] = float(np.degrees(result.quality["kinect2"].rotation_stddev))
            figures["clock_ms"] = 1e3 * result.clocks["kinect2"].offset
    stamps = np.array([each.stamp_ns for each in skeletons(bag, "/kinect1/skeleton")])
    movement = int(stamps[np.flatnonzero(np.diff(stamps) > PAUSE * NANOSECONDS)[0] + 1])
    figures["settling_s"] = settling(out, movement, NOMINAL[layout])
    filtered = np.stack([each.positions for each in skeletons(out, FILTERED)])
    figures["reversals"] = sum(reversals(left_right_axes(filtered)[:, half]) for half in (0, 1))
    figures["times_real_time"] = report.recording_s / report.elapsed_s
    return figures


def main() -> int:
    """The benchmark; exit code 1 where a figure misses its bar."""
    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("BODY_TRACKING_DATA", root.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of real recordings (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")
    args = parser.parse_args()
    files = [args.data / "kinect_pairs" / f"{who}_{where}.csv.gz" for where in NOMINAL for who in PEOPLE]
    if not all(file.is_file() for file in files):
        print(f"the real recordings are absent ({args.data})", file=sys.stderr)
        return 2
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, file in enumerate(files, 1):
            print(f"{number}/{len(files)} {file.name}", file=sys.stderr, flush=True)
            rows.append(measure(file, Path(folder)))
    medians = {
        layout: {
            method: median(row[f"{method}_mm"] for row in rows if row["layout"] == layout)
            for method in ("robust", "thesis")
        }
        for layout in NOMINAL
    }
    missed = [f"{layout}: apart" for layout, limit in LIMITS.items() if medians[layout]["robust"] > limit]
    for row in rows:
        if abs(row["robust_yaw_deg"] - NOMINAL[row["layout"]]) > 2.0:
            missed.append(f"{row['recording']}: yaw")
        if row["settling_s"] > 15.0:
            missed.append(f"{row['recording']}: settling")
        if row["reversals"] and row["layout"] == "90deg":
            missed.append(f"{row['recording']}: reversals")
    if args.json:
        print(json.dumps({"recordings": rows, "median_mm": medians, "missed": missed}, indent=2))
        return bool(missed)
    print("                 yaw, degrees                          apart, mm")
    print("recording        marks  default +-sd  thesis  settled  default  thesis  clock  reversals  speed")
    for row in rows:
        print(
            f"{row['recording']:15} {NOMINAL[row['layout']]:6.1f} {row['robust_yaw_deg']:8.1f} {row['stddev_deg']:4.1f}"
            f" {row['thesis_yaw_deg']:7.1f} {row['settling_s']:6.1f} s {row['robust_mm']:8.0f} {row['thesis_mm']:7.0f}"
            f" {row['clock_ms']:3.0f} ms {row['reversals']:10} {row['times_real_time']:4.0f} x"
        )
    for layout, limit in LIMITS.items():
        apart = medians[layout]
        print(f"median, {layout}: {apart['robust']:.0f} mm apart (bar {limit:.0f}); thesis {apart['thesis']:.0f} mm")
    print("missed: " + ", ".join(missed) if missed else "every bar is met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
