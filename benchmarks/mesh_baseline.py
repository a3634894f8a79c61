"""The published method of Jatesiktat et al. (2018) beside ours, in one run: errors and time.

Simulated images of clothed people with an inertial sensor on each forearm. Both methods have the same body, whose shape
``mesh_tracker`` estimated before, and the same sensors. Theirs (``body_tracking.mesh.jatesiktat``) also gets its
required inputs: the true silhouette, and the skeleton of the simulated Kinect as a start. Errors of shoulders, elbows
and wrists, millimetres, with and without the constant offset of each joint; the time is processor time per image.
``jatesiktat, mean of 3`` has the moving average, at a delay of one image.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from common import report, verdicts
from mesh_hidden import SEGMENTS, orientations_at, worn
from mesh_runs import ARMS, JOINTS, SIDES, Job, kinect_skeletons, mesh_stage, runs_of, scene_of, skeleton_of

from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.jatesiktat import JatesiktatFitter, moving_average
from body_tracking.mesh.topics import depth_topic, mesh_sensor
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from body_tracking.simulation.depth_scene import SENSOR

MOTIONS = ("reaching", "two_handed_wave")
SOURCES = ("ours", "jatesiktat", "jatesiktat, mean of 3", "kinect")
_BEGIN = 3.0
"""Seconds of the motion before the comparison: ours has seen several poses by then."""


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Errors (n, 6, 3) by source, metres, and processor times (n,) of ours and of theirs, milliseconds."""

    errors: dict[str, FloatArray]
    ms: dict[str, FloatArray]


def run(job: Job) -> Run:
    """One person in one motion."""
    scene, end = scene_of(job.motion, job.seed), _BEGIN + job.seconds
    frames = [*scene.frames(0.0, end)]
    stamps = [round(frame.time * NANOSECONDS) for frame in frames]
    truth = np.array([frame.joints for frame in frames])
    pose, measured = replace(scene.pose, sensor=mesh_sensor(SENSOR)), worn(scene, end)
    stage = mesh_stage(scene, SEGMENTS)
    list(stage.take(graph.CALIBRATION, pose, Now(0, 0)))
    own, own_ms, rest = np.full(truth.shape, np.nan), np.zeros(len(frames)), [*measured]
    for number, (stamp, frame) in enumerate(zip(stamps, frames, strict=True)):
        while rest and rest[0].stamp_ns <= stamp:
            each = rest.pop(0)
            list(stage.take(graph.orientation_topic(each.segment), each, Now(stamp, stamp)))
        depth = to_metres(frame.image)
        began = time.process_time()
        skeleton = skeleton_of(stage, stage.take(depth_topic(SENSOR), (stamp, "", depth), Now(stamp, stamp)))
        own_ms[number] = 1e3 * (time.process_time() - began)
        if skeleton is not None:
            own[number] = skeleton.positions
    compared = [number for number, frame in enumerate(frames) if frame.time >= _BEGIN]
    body, view, kinect = stage.sensor.body, DepthCamera(scene.camera), kinect_skeletons(scene, truth)
    fitter = JatesiktatFitter(body)
    turned = orientations_at(measured, pose, stamps, body.model.joint_names)
    thetas: list[FloatArray] = []
    their_ms = []
    for number in compared:
        began = time.process_time()
        frame = fitter.frame(view, to_metres(frames[number].image), frames[number].person, kinect[number])
        directions = {
            side: -each.rotation[:, 2]
            for each in turned[stamps[number]]
            for side in SIDES
            if each.joint == body.model.index(f"{side}_elbow")
        }
        starts = [*thetas[-1:], fitter.kinect_start(kinect[number])]
        thetas.append(fitter.fit(frame, starts, directions).theta)
        their_ms.append(1e3 * (time.process_time() - began))
    joints = [body.model.index(name) for name in JOINTS]

    def placed(found: FloatArray) -> FloatArray:
        return np.array([body.posed(fitter.pose(theta)).placed[joints] for theta in found])

    theirs = np.array(thetas)
    found = {
        "ours": own[compared][:, ARMS],
        "jatesiktat": placed(theirs),
        "jatesiktat, mean of 3": placed(moving_average(theirs, fitter.configuration.window)),
        "kinect": kinect[compared][:, ARMS],
    }
    true = truth[compared][:, ARMS]
    ms = {"ours": own_ms[compared], "jatesiktat": np.array(their_ms)}
    return Run({name: each - true for name, each in found.items()}, ms)


def figures_of(runs: Sequence[Run]) -> dict[str, dict[str, float]]:
    """The figures of several runs, by source."""
    figures = {}
    for name in SOURCES:
        off = np.concatenate([np.linalg.norm(each.errors[name], axis=2).ravel() for each in runs])
        centred = [each.errors[name] - np.nanmean(each.errors[name], axis=0) for each in runs]
        free = np.concatenate([np.linalg.norm(each, axis=2).ravel() for each in centred])
        ms = np.concatenate([each.ms.get(name, np.full(1, np.nan)) for each in runs])
        figures[name] = {
            "mean, mm": float(1e3 * np.nanmean(off)),
            "95 %, mm": float(1e3 * np.nanpercentile(off, 95)),
            "without offset, mm": float(1e3 * np.nanmean(free)),
            "ms, median": float(np.median(ms)),
        }
    return figures


def main() -> int:
    arguments, _, runs = runs_of(run, __doc__, MOTIONS, seeds=2, seconds=2.0)
    figures = figures_of(runs)
    report(arguments, figures)
    ours, theirs = figures["ours"], figures["jatesiktat, mean of 3"]
    return verdicts(
        arguments,
        {
            "ours errs by less than the published method": ours["mean, mm"] <= theirs["mean, mm"],
            "ours takes a tenth of its time": ours["ms, median"] <= 0.1 * figures["jatesiktat"]["ms, median"],
        },
    )


if __name__ == "__main__":
    sys.exit(main())
