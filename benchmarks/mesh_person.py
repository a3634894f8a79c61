"""Lengths of the bones of held-out people in clothes, as personalisation estimates them.

RMS errors over people, millimetres, and in brackets the mean error: of upper arms and forearms, of the distance between
the shoulders, and of thighs. ``one image`` and ``four images``: what ``mesh_tracker`` takes in its first seconds,
``four images, true start``: the floor, the same images started at the true joints; ``kinect``: medians
of a simulated Kinect's bones over the first four seconds; ``mean person``: without a personalisation.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import common
import numpy as np
from common import report, verdicts
from mesh_runs import Job, fit_from_truth, kinect_skeletons, mesh_stage, runs_of, scene_of

from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint
from body_tracking.mesh.body_model import Body, load
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.personalisation import personalise
from body_tracking.mesh.topics import depth_topic
from body_tracking.mesh.uncertainty import kinect_landmarks
from body_tracking.pipeline.stage import Now
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthFrame, DepthScene

MOTIONS = ("reaching", "two_handed_wave")
BONES = {
    "arms": [
        (Joint[f"{start}_{side}"], Joint[f"{end}_{side}"])
        for side in ("LEFT", "RIGHT")
        for start, end in (("SHOULDER", "ELBOW"), ("ELBOW", "WRIST"))
    ],
    "shoulders": [(Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT)],
    "thighs": [(Joint.HIP_LEFT, Joint.KNEE_LEFT), (Joint.HIP_RIGHT, Joint.KNEE_RIGHT)],
}
BARS = {"arms": 0.010, "shoulders": 0.015, "thighs": 0.020}
"""Largest RMS errors after four images, metres."""
FOUR, ONE, FLOOR, KINECT, MEAN = "four images", "one image", "four images, true start", "kinect", "mean person"
_KINECT_S = 4.0


def lengths_of(points: FloatArray) -> dict[str, FloatArray]:
    """Bones of joints (..., 25, 3), metres, as (bones, ...) by kind."""
    return {
        kind: np.array([np.linalg.norm(points[..., a, :] - points[..., b, :], axis=-1) for a, b in pairs])
        for kind, pairs in BONES.items()
    }


def bones_of(body: Body) -> dict[str, FloatArray]:
    """Bones of a body, metres."""
    return lengths_of(kinect_landmarks(body).places)


def live(scene: DepthScene, frames: Sequence[DepthFrame], images: int) -> tuple[Body, list[DepthFrame]]:
    """The body after the first personalisation of ``mesh_tracker``, the mean one without, and the images it used."""
    stage, used = mesh_stage(scene, personalise_from=images), []
    for frame in frames:
        stamp, kept = round(frame.time * NANOSECONDS), len(used)
        list(stage.take(depth_topic(SENSOR), (stamp, "", to_metres(frame.image)), Now(stamp, stamp)))
        if len(stage.sensor.poses.poses) > kept:
            used.append(frame)
        if stage.counters["personalisations"]:
            break
    return stage.sensor.body, used


def run(job: Job) -> dict[str, dict[str, FloatArray]]:
    """Errors of the bones of one person by source and kind, metres."""
    scene = scene_of(job.motion, job.seed)
    frames = [*scene.frames(0.0, job.seconds)]
    joints = np.array([frame.joints for frame in frames])
    true = {kind: np.median(each, axis=1) for kind, each in lengths_of(joints).items()}
    read = kinect_skeletons(scene, joints[: round(_KINECT_S * RATE)])
    mean, view = load().body(), DepthCamera(scene.camera)
    one, _ = live(scene, frames, 1)
    four, used = live(scene, frames, 4)
    started = [fit_from_truth(mean, view, to_metres(f.image), f.person, f.joints) for f in used]
    best = personalise(mean.model, [each.seen for each in started], [each.fit.pose for each in started])
    found = {
        ONE: bones_of(one),
        FOUR: bones_of(four),
        FLOOR: bones_of(best.body),
        KINECT: {kind: np.nanmedian(each, axis=1) for kind, each in lengths_of(read).items()},
        MEAN: bones_of(mean),
    }
    return {name: {kind: each[kind] - true[kind] for kind in BONES} for name, each in found.items()}


def main() -> int:
    """The benchmark."""
    arguments, _, runs = runs_of(run, __doc__, MOTIONS, seeds=10, seconds=8.0)
    errors = {name: {kind: np.concatenate([each[name][kind] for each in runs]) for kind in BONES} for name in runs[0]}
    rms = {name: {kind: common.rms(each[kind]) for kind in BONES} for name, each in errors.items()}
    table = {
        name: {kind: f"{1e3 * rms[name][kind]:.1f} ({1e3 * each[kind].mean():+.1f})" for kind in BONES}
        for name, each in errors.items()
    }
    report(arguments, table)
    met = {f"{kind}: at most {1e3 * bar:g} mm from four images": rms[FOUR][kind] <= bar for kind, bar in BARS.items()}
    met |= {f"{kind}: better than a Kinect's": rms[FOUR][kind] < rms[KINECT][kind] for kind in BONES}
    return verdicts(arguments, met)


if __name__ == "__main__":
    sys.exit(main())
