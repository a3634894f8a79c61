"""Poses, recognition and tracking of targets among simulated points of a stereo rig.

The rig is that of Gaschler (2011), section 6.1, with 0.1 pixels of noise; targets have five balls. A pose is wrong from
0.2 rad on. Other seeds than those of the tests; but the limits of recognition were chosen while watching these.
"""

from __future__ import annotations

import time

import common
import numpy as np

from body_tracking.markers.pose import fit_pose
from body_tracking.markers.recognition import Recogniser
from body_tracking.markers.targets import Target
from body_tracking.markers.tracking import TargetTracker
from body_tracking.simulation.target_points import (
    TARGET_POINTS,
    measure,
    moving,
    random_rotation,
    rotation_error,
    scene,
    target_set,
)


def pose(count: int = 3000) -> dict[str, float]:
    """Errors of a target at 1 m, 3D RMS, its stated covariance and the time of a fit."""
    rng = np.random.default_rng(1)
    target = Target("target", TARGET_POINTS, np.zeros((15, 15)))
    errors, nees, spent, plain = [], [], [], []
    for _ in range(count):
        rotation, centre = random_rotation(rng), np.array([0.0, 0.0, 1.0])
        points = measure(target.points @ rotation.T + centre, rng)
        begin = time.perf_counter()
        fit = fit_pose(target, points, np.arange(5))
        spent.append(time.perf_counter() - begin)
        error = np.r_[centre - fit.translation, rotation_error(rotation, fit.rotation)]
        errors.append(error)
        nees.append(error @ np.linalg.solve(fit.covariance, error))
        plain.append(np.trace(fit.covariance[:3, :3]))
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    return {
        "position, mm": 1e3 * float(np.linalg.norm(rms[:3])),
        "stated, mm": 1e3 * float(np.sqrt(np.mean(plain))),
        "orientation, deg": float(np.degrees(np.linalg.norm(rms[3:]))),
        "NEES of 6": float(np.mean(nees)),
        "median ms": 1e3 * float(np.median(spent)),
    }


def recognition(count: int = 1000) -> dict[str, dict[str, float]]:
    """Five targets of five balls from scratch, one ball of each hidden, 80 spurious points; then 300."""
    rows = {}
    for distance, spurious, deadline in ((1.0, 80, None), (2.0, 80, None), (3.0, 80, None), (1.0, 300, 0.01)):
        found = complete = wrong = extra = ambiguous = frames = 0
        spent = []
        for seed in range(count if distance < 3.0 and spurious == 80 else count // 10):
            rng = np.random.default_rng([seed, 7])
            targets = target_set(seed % 100)
            true, _, poses, assignments = scene(targets, distance, rng, spurious)
            points = measure(true, rng)
            recogniser = Recogniser(targets)
            frames += 1
            begin = time.thread_time()
            result = recogniser.recognise(points, deadline)
            spent.append(time.thread_time() - begin)
            found += len(result.poses) == 5
            complete += result.complete
            ambiguous += len(result.ambiguous)
            for fit in result.poses:
                index = [target.name for target in targets].index(fit.name)
                rotation, _ = poses[index]
                seen = fit.points >= 0
                if np.linalg.norm(rotation_error(rotation, fit.rotation)) > 0.2:
                    wrong += 1
                elif (fit.points[seen] != assignments[index][seen]).any():
                    extra += 1
        rows[f"{distance:g} m, {spurious} spurious"] = {
            "frames": frames,
            "all found, %": 100.0 * found / frames,
            "wrong poses": wrong,
            "with a spurious ball": extra,
            "ambiguous": ambiguous,
            "complete, %": 100.0 * complete / frames,
            **cpu_ms(spent),
        }
    return rows


def cpu_ms(spent: list[float]) -> dict[str, float]:
    """Median and a late percentile of seconds of CPU, ms."""
    return {"median ms": 1e3 * float(np.median(spent)), "99 % ms": 1e3 * float(np.quantile(spent, 0.99))}


def tracking(count: int = 10, frames: int = 120) -> dict[str, dict[str, float]]:
    """Five moving targets at 60 Hz, a ball of each hidden in turn (another each 20 frames), 80 spurious points."""
    rows = {}
    for distance in (1.0, 2.0, 3.0):
        wrong = extra = full = kept = held = 0
        spent = []
        for seed in range(count):
            met: set[str] = set()
            rng = np.random.default_rng([seed, 11])
            targets = target_set(seed % 100)
            tracker = TargetTracker(targets)
            for stamp, true, poses, assignments in moving(targets, distance, rng, frames, 80):
                points = measure(true, rng, stamp)
                begin = time.thread_time()
                result = tracker.update(points)
                spent.append(time.thread_time() - begin)
                names = {fit.name for fit in result}
                kept += len(met)
                held += len(met & names)
                met |= names
                full += len(result) == 5
                for fit in result:
                    index = [target.name for target in targets].index(fit.name)
                    seen = fit.points >= 0
                    wrong += np.linalg.norm(rotation_error(poses[index][0], fit.rotation)) > 0.2
                    extra += (fit.points[seen] != assignments[index][seen]).any()
        rows[f"{distance:g} m"] = {
            "all five, %": 100.0 * full / (count * frames),
            "targets once met, %": 100.0 * held / kept,
            "wrong poses": int(wrong),
            "with a spurious ball": int(extra),
            **cpu_ms(spent),
        }
    return rows


def main() -> None:
    """The benchmark."""
    args = common.parser(__doc__).parse_args()
    common.report(args, {"pose at 1 m": pose(), "recognition": recognition(), "tracking": tracking()})


if __name__ == "__main__":
    main()
