"""The mesh fitted to simulated depth images of held-out people in clothes, in ordinary motions.

Shoulders, elbows and wrists of ``mesh_tracker`` beside those of the simulated Kinect's skeleton, millimetres: the mean
and the 95th percentile, with and without the constant offset of each joint. ``floor`` is the fit of every tenth image,
started at the true joints. ``NEES`` is the mean squared error over the stated variance, per degree of freedom,
``in 1.96 sd`` the share of coordinates within 1.96 stated standard deviations. ``bone correlation`` is that of the
errors of the joints at the two ends of a bone. The time is processor time per image of 512x424 pixels, without the
first one, in which the person is searched for.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import NORMAL, bone_correlation, report, verdicts
from mesh_runs import ARMS, Job, fit_from_truth, kinect_skeletons, mesh_stage, runs_of, scene_of

from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.topics import depth_topic
from body_tracking.pipeline.stage import Now
from body_tracking.simulation.depth_scene import SENSOR

MOTIONS = ("reaching", "two_handed_wave", "torso_twist")
_FLOOR = 10


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Errors (n, 6, 3) of shoulders, elbows and wrists in the images with a tracked person, metres.

    Attributes:
        job: motion, person and duration.
        images: number of images.
        mesh, kinect, floor: errors; the Kinect's are of the same images, the floor's of every tenth.
        covariance: (n, 6, 3, 3) stated of ``mesh``, m2.
        ms: (images - 1,) processor time, milliseconds.
    """

    job: Job
    images: int
    mesh: FloatArray
    kinect: FloatArray
    floor: FloatArray
    covariance: FloatArray
    ms: FloatArray


def run(job: Job) -> Run:
    """One person in one motion."""
    scene = scene_of(job.motion, job.seed)
    stage = mesh_stage(scene)
    view = DepthCamera(scene.camera)
    truth, found, covariances, numbers, floor, ms = [], [], [], [], [], []
    for number, frame in enumerate(scene.frames(0.0, job.seconds)):
        stamp_ns, depth = round(frame.time * NANOSECONDS), to_metres(frame.image)
        began = time.process_time()
        outputs = list(stage.take(depth_topic(SENSOR), (stamp_ns, "", depth), Now(0, 0)))
        ms.append(1e3 * (time.process_time() - began))
        truth.append(frame.joints)
        if not outputs:
            continue
        (skeleton,) = outputs[0].payload
        numbers.append(number)
        found.append(skeleton.positions[ARMS] - frame.joints[ARMS])
        covariances.append(skeleton.covariances[ARMS])
        if number % _FLOOR == 0:
            points = fit_from_truth(stage.sensor.body, view, depth, frame.person, frame.joints).points
            floor.append(points[ARMS] - frame.joints[ARMS])
    joints = np.array(truth)
    positions = kinect_skeletons(scene, joints)
    shape = (-1, len(ARMS), 3)
    return Run(
        job,
        len(joints),
        np.reshape(found, shape),
        (positions - joints)[:, ARMS][numbers],
        np.reshape(floor, shape),
        np.reshape(covariances, (-1, len(ARMS), 3, 3)),
        np.array(ms[1:]),
    )


# --- figures


def _mm(errors: Sequence[FloatArray], *, offset: bool) -> FloatArray:
    """Lengths of all runs' errors, millimetres; without each run's mean error of each joint unless ``offset``."""
    moved = [each if offset else each - np.nanmean(each, axis=0) for each in errors if len(each)]
    distances = np.concatenate([1e3 * np.linalg.norm(each, axis=2).ravel() for each in moved])
    return distances[np.isfinite(distances)]


def figures_of(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures of several runs."""
    found: dict[str, Any] = {"images": sum(each.images for each in runs)}
    found["lost"] = found["images"] - sum(len(each.mesh) for each in runs)
    for name in ("mesh", "floor", "kinect"):
        errors = [getattr(each, name) for each in runs]
        for label, offset in (("", True), (" without offset", False)):
            mm = _mm(errors, offset=offset)
            found[f"{name}{label}"] = (float(mm.mean()), float(np.percentile(mm, 95)))
    errors = np.concatenate([each.mesh for each in runs])
    covariance = np.concatenate([each.covariance for each in runs])
    found["nees"] = float(np.einsum("nja,njab,njb->nj", errors, np.linalg.inv(covariance), errors).mean() / 3.0)
    found["bone correlation"] = bone_correlation(errors, range(len(ARMS)))
    spread = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    found["within"] = float((np.abs(errors) < NORMAL * spread).mean())
    found["ms"] = tuple(float(np.percentile(np.concatenate([each.ms for each in runs]), at)) for at in (50, 99))
    return found


def main() -> int:
    arguments, _, runs = runs_of(run, __doc__, MOTIONS, seeds=4, seconds=8.0)
    cases = {motion: figures_of([each for each in runs if each.job.motion == motion]) for motion in arguments.motions}
    cases["all"] = figures_of(runs)

    report(arguments, cases)
    every = cases["all"]
    return verdicts(
        arguments,
        {
            "joints: mean of 25 mm": every["mesh"][0] <= 25.0,
            "joints: 95 % within 45 mm": every["mesh"][1] <= 45.0,
            "joints without offsets: mean of 25 mm": every["mesh without offset"][0] <= 25.0,
            "half the error of the simulated Kinect or less": every["mesh"][0] <= 0.5 * every["kinect"][0],
            "NEES per degree of freedom 0.5 to 2": 0.5 <= every["nees"] <= 2.0,
            "coverage 90 to 99 %": 0.9 <= every["within"] <= 0.99,
            "time: median of 20 ms, 99 % of 33 ms": every["ms"][0] <= 20.0 and every["ms"][1] <= 33.0,
        },
    )


if __name__ == "__main__":
    sys.exit(main())
