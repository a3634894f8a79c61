"""Joint angles behind the mesh with inertial sensors on both forearms, and behind a Kinect's skeleton.

Depth images, readings of the sensors and skeletons of a simulated Kinect v2, of held-out people in clothes, go through
the graph of ``body_tracking replay``: calibration, alignment of the sensors, the mesh, fusion, a filter and angles.
RMSE of shoulder elevation and elbow flexion against the true joints in degrees, in brackets the median stated deviation
and the share of errors within 1.96 of them, all after the first second. Positional angles of the filtered skeletons;
``default`` is ``lkf_constant_velocity``. ``floor``: fits of one image a second, which start at the true joints.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import common
import numpy as np
from common import NORMAL, report, verdicts
from mesh_runs import Job, fit_from_truth, runs_of, scene_of

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.reading import read, true_at
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.kinematics.positional import positional_angles
from body_tracking.mesh.body_model import load
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.pipeline import graph
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.depth_bags import write_depth_bag
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene

MOTIONS = ("reaching", "two_handed_wave", "torso_twist", "arm_raises", "slow_down", "squat")
ANGLES = {
    "elevation": ("shoulder_elevation_left", "shoulder_elevation_right"),
    "elbow": ("elbow_flexion_left", "elbow_flexion_right"),
}
MESH, KINECT, FLOOR = "mesh and sensors", "kinect", "floor"
FILTERS = {"default": DEFAULT_FILTER, "ekf": "ekf"}
_FOREARMS = ("forearm_left", "forearm_right")
_SETTLED_S = 1.0


def run(job: Job) -> dict[str, dict[str, tuple[FloatArray, FloatArray]]]:
    """Errors and stated deviations (n, 2) of each kind of angle by source and filter, radians; NaN and inf: unknown."""
    found = {}
    scene = scene_of(job.motion, job.seed)
    with tempfile.TemporaryDirectory() as scratch:
        bag = Path(scratch) / "bag"
        write_depth_bag(scene, bag, min(job.seconds, scene.movement.duration))
        for source, more in ((MESH, {"depth": (SENSOR,)}), (KINECT, {})):
            for label, name in FILTERS.items():
                given: dict[str, Any] = {"imus": _FOREARMS} if more else {"sensors": (SENSOR,)}
                settings = ReplaySettings(filter_name=name, convention=graph.POSITIONAL, more=more, **given)
                out = Path(scratch) / f"{len(found)}"
                replay(bag, out, settings)
                found[f"{source}, {label}"] = errors_in(out)
    found[FLOOR] = floor_of(scene, job.seconds)
    return found


def floor_of(scene: DepthScene, seconds: float) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Errors of the angles of fits that start at the true joints, as :func:`errors_in` returns them."""
    body, view = load().body(), DepthCamera(scene.camera)
    pairs = []
    for frame in scene.frames(_SETTLED_S, seconds, round(RATE)):
        fitted = fit_from_truth(body, view, to_metres(frame.image), frame.person, frame.joints).points
        pairs.append([_positional(scene.pose.apply(joints)) for joints in (fitted, frame.joints)])
    found = {}
    for kind, names in ANGLES.items():
        angles = np.array([[_named(each, names) for each in both] for both in pairs])
        off = wrapped(angles[:, 0] - angles[:, 1])
        found[kind] = off, np.full(off.shape, np.nan)
    return found


def _named(angles: JointAngles, names: Sequence[str]) -> list[float]:
    return [float(angles.position[angles.names.index(name)]) for name in names]


def _positional(joints: FloatArray) -> JointAngles:
    """Positional angles of (25, 3) joints in ``world``."""
    return positional_angles(Skeleton(0, "world", joints, np.full(len(joints), TrackingState.TRACKED, dtype=np.uint8)))


def errors_in(recording: Path) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Errors and stated deviations of the angles in a recording with their truth, after it has settled."""
    tracked = read(recording)
    found = {}
    for kind, names in ANGLES.items():
        angles = tracked.angles.only(names)
        true = true_at(angles, tracked.true_angles)
        settled = angles.stamps_ns >= angles.stamps_ns[0] + _SETTLED_S * NANOSECONDS
        found[kind] = wrapped(angles.known - true)[settled], angles.stddev[settled]
    return found


def figures_of(off: FloatArray, stated: FloatArray) -> dict[str, float]:
    """RMSE and median deviation, degrees, and shares of errors within 1.96 of it and of known angles."""
    known = np.isfinite(off)
    return {
        "rmse": common.rms_deg(off),
        "stated": float(np.degrees(np.median(stated[known]))) if known.any() else float("nan"),
        "inside": float((np.abs(off) <= NORMAL * stated)[known].mean()) if known.any() else float("nan"),
        "known": float(known.mean()),
    }


def main() -> int:
    """The benchmark."""
    arguments, jobs, runs = runs_of(run, __doc__, MOTIONS, seeds=4, seconds=10.0)
    table: dict[str, dict[str, str]] = {}
    met: dict[str, bool] = {}
    for kind in ANGLES:
        every: dict[str, list[dict[str, float]]] = {name: [] for name in runs[0]}
        for motion in (*arguments.motions, "all"):
            chosen = [each for job, each in zip(jobs, runs, strict=True) if motion in (job.motion, "all")]
            row = {}
            for name in runs[0]:
                parts = [each[name][kind] for each in chosen]
                row[name] = figures_of(*(np.concatenate(part) for part in zip(*parts, strict=True)))
                every[name].append(row[name])
            table[f"{kind}, {motion}"] = {
                name: f"{each['rmse']:.1f}"
                + ("" if name == FLOOR else f" ({each['stated']:.1f}, {each['inside']:.2f})")
                for name, each in row.items()
            }
        for label in FILTERS:
            mesh, kinect = (every[f"{source}, {label}"] for source in (MESH, KINECT))
            better = [a["rmse"] < b["rmse"] for a, b in zip(mesh[:-1], kinect[:-1], strict=True)]
            met[f"{kind}, {label}: better than a Kinect's in every motion"] = all(better)
            met[f"{kind}, {label}: 90 to 99 % inside"] = 0.9 <= mesh[-1]["inside"] <= 0.99
    report(arguments, table)
    return verdicts(arguments, met)


if __name__ == "__main__":
    sys.exit(main())
