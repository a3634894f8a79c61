"""Our filters against the thesis's on the project's own recordings, of which the truth is known.

Each recording in ``bags/`` goes through the offline graph, which calibrates the two sensors and fuses them. The fused
skeletons then go through the thesis's filters, the linear ones and ``ekf``, and the sensors' own frames, unpaired,
through ``ekf`` as the graph runs it; all at default settings. What is compared begins when all of them have begun: the
thesis's extended filter takes 50 frames in the T-pose.

position  distance of the ten joints of the thesis's model from the truth in ``world``, RMS and mean, mm. "fitted":
          after the rigid transform that brings all of them closest to the truth over the whole recording (Umeyama
          1991): without what calibration and sensors have in common with all methods.
angles    RMSE in degrees of the angles of ``kinematics.positional`` against those of the true skeleton: trunk (3),
          shoulder elevation and plane (4), elbow flexion (2). Trunk angles need hips, which the thesis's model has not:
          it is given those of its own fixed base, so that its trunk angles are its model's.
offsets   ``offsets alone`` is no method: a sensor that is wrong by nothing but where it takes the joints' centres to
          be, constantly beside an anatomist's (``KinectErrors.offsets_alone``). Methods that know nothing of these
          offsets come to about as much, one that knows a body's proportions to somewhat less.

The bar: in the torso twist, errors of ``ekf`` at most 60 % of those of ``schlagenhauf_ekf``, positions (RMS, in world)
and angles alike. ``--more N`` draws N recordings of each motion besides, of other people with other errors: one
recording is one draw of what sensors make of a person, and the ratio differs from draw to draw.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from accuracy import ALONE, reported

from body_tracking import graph
from body_tracking.calibration.rigid import rigid_registration
from body_tracking.cdr import decode_skeletons
from body_tracking.evaluation.comparison import skeleton_angles
from body_tracking.evaluation.metrics import Curve, joint_errors, wrapped
from body_tracking.filters import SkeletonFilter, make_filter
from body_tracking.filters.schlagenhauf import SchlagenhaufKalmanFilter
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from body_tracking.messages.base import POINT_CLOUD
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import deserialize
from body_tracking.simulation.bags import SEED, SHIPPED, shipped, write_bag
from body_tracking.simulation.scene import Setup, simulate
from body_tracking.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState

BAGS = Path(__file__).parent.parent / "bags"
TWIST = "tpose_torso_twist"
BAR = 0.6
THESIS, EKF = "schlagenhauf_ekf", "ekf"
FUSED_FILTERS = (THESIS, "thesis_lkf1", "thesis_lkf2", "lkf_zero_velocity", "lkf_constant_velocity", EKF)
BY_SENSOR = "ekf, both sensors"

TEN = Schlagenhauf26().joints
GROUPS: dict[str, tuple[str, ...]] = {
    "trunk": ("trunk_flexion", "trunk_lateral_lean", "trunk_axial_lean"),
    "elevation": ("shoulder_elevation_left", "shoulder_elevation_right"),
    "plane": ("shoulder_plane_left", "shoulder_plane_right"),
    "elbow": ("elbow_flexion_left", "elbow_flexion_right"),
}
ANGLES = np.array([ANGLE_NAMES.index(name) for names in GROUPS.values() for name in names])
_HIPS = {Joint.HIP_LEFT: 0.1, Joint.HIP_RIGHT: -0.1}
"""Metres to the left of her base."""


@dataclass(frozen=True, slots=True)
class Errors:
    """Of one method in one recording: millimetres and degrees; of each joint and angle, and of each group of angles."""

    rms: float
    mean: float
    fitted_rms: float
    fitted_mean: float
    angles: float
    groups: dict[str, float]
    joints: dict[str, float]
    frames: int


def run_filter(skeletons: Iterable[Skeleton], filter_: SkeletonFilter) -> list[Skeleton]:
    """What a filter makes of skeletons; of the thesis's, with the hips of its base."""
    outputs = []
    for skeleton in skeletons:
        output = filter_.update(skeleton)
        if output is None:
            continue
        if isinstance(filter_, SchlagenhaufKalmanFilter):
            positions, states = output.positions.copy(), output.states.copy()
            for joint, left in _HIPS.items():
                positions[joint] = filter_.model.base_position + left * filter_.model.base_rotation[:, 1]
                states[joint] = TrackingState.INFERRED
            output = Skeleton(output.stamp_ns, output.frame_id, positions, states)
        outputs.append(output)
    return outputs


def methods_of(bag: Path, setup: Setup) -> tuple[list[Skeleton], dict[str, list[Skeleton]]]:
    """The true skeletons of a recording of what was set up, and those of each method."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        replay(bag, out, ReplaySettings((), filter_name=EKF))
        truth, fused, filtered = (_read(out, topic) for topic in (graph.TRUE_SKELETON, graph.FUSED, graph.FILTERED))
    methods = {"fused": fused, ALONE: reported(simulate(replace(setup, errors=setup.errors.offsets_alone())))}
    methods |= {name: run_filter(fused, make_filter(name)) for name in FUSED_FILTERS}
    methods[BY_SENSOR] = filtered
    return truth, methods


def _read(bag: Path, topic: str) -> list[Skeleton]:
    with RigReader(bag) as reader:
        return [
            (decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr)))[0]
            for raw in reader.messages([topic])
        ]


class Truth:
    """The true joints at any time, by cubic splines between the captures."""

    def __init__(self, skeletons: Sequence[Skeleton]) -> None:
        self._zero_ns = skeletons[0].stamp_ns
        self.end_ns = skeletons[-1].stamp_ns
        times = [(each.stamp_ns - self._zero_ns) / NANOSECONDS for each in skeletons]
        self._curve = Curve(np.array(times), np.stack([each.positions for each in skeletons]))

    def at(self, stamps_ns: Sequence[int]) -> FloatArray:
        """(n, 25, 3) metres."""
        return self._curve.at(np.array([(stamp - self._zero_ns) / NANOSECONDS for stamp in stamps_ns]))


def errors_of(skeletons: Sequence[Skeleton], truth: Truth, begin_ns: int) -> Errors:
    """Compare one method with the truth from a stamp on; NaN positions (a joint not fused) are left out."""
    counted = [each for each in skeletons if begin_ns <= each.stamp_ns <= truth.end_ns]
    right = truth.at([each.stamp_ns for each in counted])
    found = np.stack([np.where(each.valid[:, None], each.positions, np.nan) for each in counted])
    apart = 1e3 * np.linalg.norm((found - right)[:, TEN], axis=-1)
    here = np.isfinite(apart)
    points, targets = found[:, TEN][here], right[:, TEN][here]
    rotation, translation = rigid_registration(targets, points)
    fitted = 1e3 * np.linalg.norm(points @ rotation.T + translation - targets, axis=-1)
    mine, true = (skeleton_angles(each)[0][:, ANGLES] for each in (found, right))
    off = np.degrees(wrapped(mine - true))
    columns = np.cumsum([0, *(len(names) for names in GROUPS.values())])
    groups = {
        name: _rms(off[:, first:last]) for name, first, last in zip(GROUPS, columns[:-1], columns[1:], strict=True)
    }
    of_joints = 1e3 * joint_errors(found, right).rms
    joints = {Joint(joint).name.lower(): float(of_joints[joint]) for joint in TEN}
    known = apart[here]
    return Errors(
        _rms(known), float(known.mean()), _rms(fitted), float(fitted.mean()), _rms(off), groups, joints, len(counted)
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def compare(bag: Path, setup: Setup) -> dict[str, Errors]:
    """All methods on one recording, from the frame on with which the last of them begins."""
    true_skeletons, methods = methods_of(bag, setup)
    missing = [name for name, skeletons in methods.items() if not skeletons]
    if missing:
        raise SystemExit(f"{bag}: nothing came out of {', '.join(missing)}")
    begin_ns = max(skeletons[0].stamp_ns for skeletons in methods.values())
    truth = Truth(true_skeletons)
    return {name: errors_of(skeletons, truth, begin_ns) for name, skeletons in methods.items()}


def show(name: str, results: Mapping[str, Errors]) -> None:
    """One recording's table."""
    print(f"\n{name}")
    head = " ".join(f"{group:>9}" for group in GROUPS)
    print(f"  {'':<24} {'RMS':>6} {'mean':>6} {'fitted':>7} {'mean':>6} {'angles':>7} {head} {'frames':>7}")
    for method, e in results.items():
        groups = " ".join(f"{value:9.2f}" for value in e.groups.values())
        print(
            f"  {method:<24} {e.rms:6.1f} {e.mean:6.1f} {e.fitted_rms:7.1f} {e.fitted_mean:6.1f} {e.angles:7.2f} "
            f"{groups} {e.frames:7d}"
        )
    for method in (EKF, BY_SENSOR):
        p, a = ratios(results, method)
        print(f"  {method} / {THESIS}: positions {p:.2f}, angles {a:.2f}")


def ratios(results: Mapping[str, Errors], method: str) -> tuple[float, float]:
    """Error of a method over that of the thesis's filter: positions (RMS, in world) and angles."""
    ours, hers = results[method], results[THESIS]
    return ours.rms / hers.rms, ours.angles / hers.angles


def main() -> int:
    """Run everything and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--more", type=int, default=0, metavar="N", help="N more recordings of each motion")
    parser.add_argument("--only", metavar="TEXT", help="recordings whose name contains this")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, also those of each joint")
    arguments = parser.parse_args()
    names = [name for name in SHIPPED if arguments.only is None or arguments.only in name]
    if not names or arguments.more < 0:
        parser.error("no such recording" if not names else "--more: not less than 0")

    results: dict[str, dict[str, Errors]] = {}
    drawn: dict[str, list[tuple[float, float]]] = {}
    for name in names:
        print(f"bags/{name}", file=sys.stderr, flush=True)
        results[name] = compare(BAGS / name, shipped(name))
        show(name, results[name])
        for number in range(1, arguments.more + 1):
            with tempfile.TemporaryDirectory() as folder:
                bag = Path(folder) / name
                setup = shipped(name, SEED + number)
                write_bag(simulate(setup), bag)
                found = compare(bag, setup)
            results[f"{name} seed {SEED + number}"] = found
            drawn.setdefault(name, []).append(ratios(found, BY_SENSOR))
            p, a = drawn[name][-1]
            print(f"  seed {SEED + number}: positions {p:.2f}, angles {a:.2f}", file=sys.stderr, flush=True)
    for name, pairs in drawn.items():
        p, a = np.median(pairs, axis=0)
        least, most = np.min(pairs, axis=0), np.max(pairs, axis=0)
        print(
            f"\n{name}, {len(pairs)} other draws, {BY_SENSOR} / {THESIS}: positions {p:.2f} in the median "
            f"({least[0]:.2f} to {most[0]:.2f}), angles {a:.2f} ({least[1]:.2f} to {most[1]:.2f})"
        )
    if arguments.json:
        rows = {name: {method: asdict(e) for method, e in found.items()} for name, found in results.items()}
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    if TWIST not in results:
        return 0
    print()
    missed = False
    for what, ratio in zip(("position", "angle"), ratios(results[TWIST], BY_SENSOR), strict=True):
        missed |= ratio > BAR
        verdict = "MISSED" if ratio > BAR else "met   "
        print(f"{verdict}  {TWIST}: {what} error of ekf {ratio:.2f} of {THESIS}'s, bar {BAR}")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
