"""Nine recordings of two real Kinect v2 sensors: calibration, agreement, left and right, beside the thesis's method.

Imports each recording of ``kinect_pairs`` into a bag, replays the graph over it (``body_tracking replay``) and
calibrates it with both methods (``body_tracking calibrate``). The taped marks give the true relative yaw.

With ``--ekf`` the extended filter on the same people; their true dimensions are unknown, but constant:

lengths   segment lengths from the first half of each recording (fused skeletons) against those from the second half,
          both estimated from scratch: the largest difference of the 21, its stated standard deviation, and the median.
NIS       normalised innovation squared over its expectation, summed over all frames after the first seconds: of the
          fused skeletons, and of both calibrated sensors unpaired, each frame at its own time. 1 is consistent; more:
          stated deviations are too small; less: too large (Bar-Shalom, Li and Kirubarajan 2001, chapter 5.4.2).
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import common
import numpy as np

from body_tracking.calibration.online import CalibrationParameters
from body_tracking.core.measurement import left_right_axes
from body_tracking.core.message_types import TRANSFORM
from body_tracking.core.sensor_poses import CalibrationResult
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, Skeleton
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.fusion.alignment import SensorAlignment
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline.graph import CALIBRATION, FILTERED, FUSED
from body_tracking.recording.calibrate import calibrate, relative_yaw
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay, sensor_topics, skeletons_of
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import deserialize

NOMINAL = {"parallel": 0.8, "45deg": -45.8, "90deg": -88.0}
"""Relative yaw of kinect2 to kinect1 in Kinect camera axes, degrees."""

LIMITS = {"parallel": 36.0, "45deg": 62.0, "90deg": 107.0}
"""Largest distance of a joint between the two sensors: mean over joints and frames, median over recordings, mm."""

LENGTH_BAR, NIS_BAR = 0.010, (0.7, 1.4)
"""Bars of the extended filter: difference of lengths, metres; bounds of the NIS."""

LEARNING = 2.0
"""Seconds at the start and after a gap that do not count for the NIS: the filter learns the noise."""

PEOPLE = ("p02", "p07", "p12")

PAUSE = 5.0
"""The first movement starts after the first gap longer than this, seconds."""


def skeletons(bag: Path, topic: str) -> list[Skeleton]:
    """All skeletons of a topic, in the order of their stamps."""
    with RigReader(bag) as reader:
        found = [decode_skeletons(raw.cdr) for raw in reader.messages([topic])]
    return sorted((each[0] for each in found if each), key=lambda each: each.stamp_ns)


def paired(
    one: Sequence[Skeleton], two: Sequence[Skeleton], result: CalibrationResult
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Positions by both sensors at the captures of the first, where the second has frames close before and after.

    Args:
        one: frames of kinect1, in the order of their stamps.
        two: frames of kinect2.
        result: poses and clocks of both.

    Returns:
        (n,) nanoseconds of kinect1's clock; (n, 25, 3) positions in ``world`` by kinect1, metres; the same by kinect2.
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
    """Mean distance of a joint between both sensors, over all joints and all frames covered by both, metres."""
    _, ours, theirs = paired(skeletons(bag, "/kinect1/skeleton"), skeletons(bag, "/kinect2/skeleton"), result)
    return float(np.linalg.norm(ours - theirs, axis=-1).mean())


def settling(bag: Path, movement_ns: int, nominal: float) -> float:
    """Seconds of movement until the published yaw is within 3 degrees of the marks for good."""
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
    """Number of turns of an axis by more than a right angle between two frames."""
    axes = axes[np.isfinite(axes).all(axis=1)]
    return int((np.einsum("ni,ni->n", axes[1:], axes[:-1]) <= 0.0).sum())


def unpaired_frames(bag: Path, result: CalibrationResult) -> list[tuple[str, Skeleton]]:
    """Each sensor's frames in world, in the order of receipt."""
    with RigReader(bag) as reader:
        topics = sensor_topics(reader)
        alignment = SensorAlignment(tuple(topics.values()), result.reference)
        for sensor, clock in result.clocks.items():
            alignment.set_clock(sensor, 0, clock)
        for pose in result.poses.values():
            alignment.set_pose(pose)
        found = [(each[0], alignment.push(*each[:2])) for each in skeletons_of(reader, topics, Counter())]
    return [(sensor, skeleton) for sensor, skeleton in found if skeleton is not None]


def learnt(frames: Sequence[tuple[str, Skeleton]], parameters: EkfParameters) -> tuple[FloatArray, FloatArray]:
    """(21,) lengths and their standard deviations after all frames, metres."""
    estimator = ExtendedKalmanFilter(parameters)
    for sensor, skeleton in frames:
        estimator.update(skeleton, sensor)
    estimate = estimator.estimate
    if estimate is None:
        raise RuntimeError("the filter had no estimate")
    return estimate.lengths, estimate.lengths_stddev


def halves(frames: Sequence[tuple[str, Skeleton]], parameters: EkfParameters) -> dict[str, Any]:
    """Difference between the lengths from the first half of the time and from the second, metres."""
    stamps = [skeleton.stamp_ns for _, skeleton in frames]
    middle = (min(stamps) + max(stamps)) // 2
    parts = [[frame for frame in frames if (frame[1].stamp_ns < middle) == first] for first in (True, False)]
    (one, one_stddev), (two, two_stddev) = (learnt(part, parameters) for part in parts)
    apart = np.abs(one - two)
    worst = int(apart.argmax())
    stated = float(np.hypot(one_stddev[worst], two_stddev[worst]))
    which = UpperBody().length_names[worst]
    return {"worst": float(apart[worst]), "median": float(np.median(apart)), "which": which, "stated": stated}


def innovations(frames: Sequence[tuple[str, Skeleton]], parameters: EkfParameters) -> dict[str, float]:
    """The NIS over its expectation, the share of measured points beyond the gate, and restarts."""
    estimator = ExtendedKalmanFilter(parameters)
    distance, dimension, gaps, counts_from = 0.0, 0, -1, 0
    for sensor, skeleton in frames:
        if gaps != estimator.counters["gaps"]:
            gaps = estimator.counters["gaps"]
            counts_from = skeleton.stamp_ns + round(LEARNING * NANOSECONDS)
        measured = estimator.counters["measured"]
        if estimator.update(skeleton, sensor) is None or skeleton.stamp_ns < counts_from:
            continue
        if estimator.counters["measured"] > measured:
            distance += estimator.innovation_distance
            dimension += estimator.innovation_dimension
    counters = estimator.counters
    rejected = counters["rejected"] / max(counters["measured"] + counters["rejected"], 1)
    return {"nis": distance / max(dimension, 1), "rejected": rejected, "restarts": counters["restarts"]}


def of_ekf(bag: Path, out: Path, result: CalibrationResult, parameters: EkfParameters) -> dict[str, Any]:
    """The figures of the extended filter."""
    fused = [("", each) for each in skeletons(out, FUSED)]
    sources = {"fused": fused, "unpaired": unpaired_frames(bag, result)}
    return {
        "lengths": halves(fused, parameters),
        **{name: innovations(frames, parameters) for name, frames in sources.items()},
    }


def measure(file: Path, folder: Path, parameters: EkfParameters | None = None) -> dict[str, Any]:
    """All figures of one recording; with ``parameters`` also those of the extended filter."""
    layout = file.name.split("_")[1].split(".")[0]
    bag, out = folder / f"{file.name}.bag", folder / f"{file.name}.out"
    import_files([file], bag)
    report = replay(bag, out, ReplaySettings(()))
    figures: dict[str, Any] = {"recording": file.name.split(".")[0], "layout": layout}
    for method in ("robust", "thesis"):
        result, *_ = calibrate(bag, CalibrationParameters(method=method))
        figures[f"{method}_yaw_deg"] = float(np.degrees(relative_yaw(result, "kinect2")))
        figures[f"{method}_mm"] = 1e3 * disagreement(bag, result)
        if method == "robust":
            figures["stddev_deg"] = float(np.degrees(result.quality["kinect2"].rotation_stddev))
            figures["clock_ms"] = 1e3 * result.clocks["kinect2"].offset
            figures["ekf"] = of_ekf(bag, out, result, parameters) if parameters else {}
    stamps = np.array([each.stamp_ns for each in skeletons(bag, "/kinect1/skeleton")])
    movement = int(stamps[np.flatnonzero(np.diff(stamps) > PAUSE * NANOSECONDS)[0] + 1])
    figures["settling_s"] = settling(out, movement, NOMINAL[layout])
    filtered = np.stack([each.positions for each in skeletons(out, FILTERED)])
    figures["reversals"] = sum(reversals(left_right_axes(filtered)[:, half]) for half in (0, 1))
    figures["times_real_time"] = report.recording_s / report.elapsed_s
    return figures


def bars(rows: Sequence[Mapping[str, Any]], medians: Mapping[str, Mapping[str, float]]) -> dict[str, bool]:
    """Whether each bar is met."""
    met = {
        f"{layout}: {LIMITS[layout]:.0f} mm apart": own["robust"] <= LIMITS[layout] for layout, own in medians.items()
    }
    low, high = NIS_BAR
    for row in rows:
        found = {
            "yaw": abs(row["robust_yaw_deg"] - NOMINAL[row["layout"]]) <= 2.0,
            "settling": row["settling_s"] <= 15.0,
            "reversals": not row["reversals"] or row["layout"] != "90deg",
        }
        if row["ekf"]:
            found["lengths"] = row["ekf"]["lengths"]["worst"] <= LENGTH_BAR
            found |= {f"NIS {name}": low <= row["ekf"][name]["nis"] <= high for name in ("fused", "unpaired")}
        met |= {f"{row['recording']}: {what}": is_met for what, is_met in found.items()}
    return met


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed."""
    parser = common.parser(__doc__, data=True)
    parser.add_argument("--only", metavar="NAME", default="", help="recordings whose name contains this")
    parser.add_argument("--ekf", action="store_true", help="the extended filter, too")
    common.add_set(parser)
    args = parser.parse_args()
    wanted = [name for layout in NOMINAL for who in PEOPLE if args.only in (name := f"{who}_{layout}.csv.gz")]
    files = common.recordings(args.data / "kinect_pairs", wanted)
    parameters = EkfParameters(**dict(args.set)) if args.ekf or args.set else None
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number, file in enumerate(files, 1):
            common.progress(f"{number}/{len(files)} {file.name}")
            rows.append(measure(file, Path(folder), parameters))
    layouts = {row["layout"] for row in rows}
    medians = {
        layout: {
            method: median(row[f"{method}_mm"] for row in rows if row["layout"] == layout)
            for method in ("robust", "thesis")
        }
        for layout in NOMINAL
        if layout in layouts
    }
    tables = {
        "recordings": {row["recording"]: {"marks": NOMINAL[row["layout"]]} | row | {"ekf": {}} for row in rows},
        "apart, mm": medians,
        **{
            f"ekf, {part}": {row["recording"]: row["ekf"][part] for row in rows if row["ekf"]}
            for part in ("lengths", "fused", "unpaired")
        },
    }
    common.report(args, tables)
    return common.verdicts(args, bars(rows, medians))


if __name__ == "__main__":
    sys.exit(main())
