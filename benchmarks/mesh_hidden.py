"""A forearm of a simulated person hidden for half a second, with and without an inertial sensor on it.

A board hides one forearm for 0.5 s of every 1.2 s, left and right alternately; inertial sensors on both forearms have
the errors left by an alignment. Errors of the hidden elbow and wrist in these images, of the mesh without and with the
sensors, of the simulated Kinect, and of the filter ``ekf`` behind the mesh, which takes the sensors itself, or only
through the mesh, or both; the turn of the hand about the forearm (by the thumb, constant offset removed); and the share
of coordinates within 1.96 stated standard deviations. ``floor`` is the fit of one image with the sensors, started at
the true joints: the information of an image and the sensors without earlier images. A second table is without the
constant offset of each joint in a run, further tables are of each motion.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from common import NORMAL, report, verdicts
from imu_and_camera import aligned
from mesh_runs import SIDES, Job, ekf_stage, fed, fit_from_truth, kinect_skeletons, mesh_stage, runs_of, scene_of

from body_tracking.core.camera import Camera
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, Joint, SingleArray
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.fusion.placement import Placement
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.kinect.occlusion import Capsules
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.sensor_orientations import SensorOrientations
from body_tracking.mesh.solver import Orientation
from body_tracking.mesh.topics import depth_topic, mesh_sensor
from body_tracking.pipeline import graph
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene

MOTIONS = ("reaching", "two_handed_wave", "torso_twist")
SEGMENTS = tuple(f"forearm_{side}" for side in SIDES)
HIDDEN, EVERY, FIRST = 0.5, 1.2, 1.0
"""Seconds for which a forearm is hidden, between two starts, and before the first."""
VARIANTS = (
    "mesh",
    "mesh+sensor",
    "floor",
    "kinect",
    "ekf",
    "ekf+sensor",
    "ekf, mesh+sensor",
    "ekf+sensor, mesh+sensor",
)
"""Sources of the estimates, with the users of the inertial sensors."""
_BOARD = 0.5
"""Distance of the board from the camera as a share of the arm's."""
_FLOOR = 3
"""The floor is computed for every third image with a hidden forearm."""


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRun:
    """Errors in the images with a hidden forearm.

    Attributes:
        job: motion, person and duration.
        sides: (n,) 0 or 1, the hidden forearm.
        errors: (n, 2, 3) of the hidden elbow and wrist, metres, by variant; NaN without an estimate.
        turns: (n,) errors of the hidden hand's turn about the forearm, radians, by variant; NaN without an estimate.
        within: (n, 2, 3) whether each coordinate is within 1.96 stated deviations; NaN where none is stated.
    """

    job: Job
    sides: IntArray
    errors: dict[str, FloatArray]
    turns: dict[str, FloatArray]
    within: dict[str, FloatArray]


def hidden_side(time: float) -> int | None:
    """0 or 1 for the forearm behind the board at a time in seconds; None for neither."""
    number, since = divmod(time - FIRST, EVERY)
    return int(number) % 2 if number >= 0 and since < HIDDEN else None


def behind_board(depth: SingleArray, camera: Camera, joints: FloatArray, side: int) -> SingleArray:
    """The image (metres) with a board in front of forearm and hand of (25, 3) joints in the optical frame."""
    name = SIDES[side].upper()
    arm = joints[[Joint[f"{joint}_{name}"] for joint in ("ELBOW", "WRIST", "HAND_TIP")]]
    nearer = _nearer(joints, side)
    width = round(0.2 * float(camera.matrix[0, 0]) / float(arm[:, 2].mean()))
    board = np.zeros(depth.shape, np.uint8)
    cv2.polylines(board, [np.round(camera.project(arm)).astype(np.int32)], False, 1, width)
    rim = cv2.dilate(board, np.ones((5, 5), np.uint8)) > 0
    return np.where(board > 0, np.float32(nearer), np.where(rim, np.float32(0.0), depth))


def _nearer(joints: FloatArray, side: int) -> float:
    """Distance of the board in front of the forearm of (25, 3) joints, metres."""
    return _BOARD * float(
        joints[[Joint[f"{name}_{SIDES[side].upper()}"] for name in ("ELBOW", "WRIST", "HAND_TIP")], 2].min()
    )


def worn(scene: DepthScene, seconds: float) -> list[SegmentOrientation]:
    """Orientations of both forearms, in the order of their stamps."""
    p, found = EkfParameters(), []
    left_over = p.misalignment_stddev**2 * np.eye(3) + np.diag([0.0, 0.0, p.heading_stddev**2])
    for number, segment in enumerate(SEGMENTS):
        imu = SimulatedImu(f"imu_{segment}", segment, usual_mounting(segment, scene.who.person.stature), oriented=True)
        samples = imu.samples(scene.motion_of(segment), seconds, 0, np.random.default_rng([scene.seed, 4, number]))
        own = aligned(imu, samples, p, np.random.default_rng([scene.seed, 9, number]))
        found += [replace(each, covariance=each.covariance + left_over) for each in own]
    return sorted(found, key=lambda each: each.stamp_ns)


def run(job: Job) -> HiddenRun:
    """One person in one motion, with a forearm hidden repeatedly."""
    scene = scene_of(job.motion, job.seed)
    frames = [*scene.frames(0.0, job.seconds)]
    truth = {round(frame.time * NANOSECONDS): frame.joints for frame in frames}
    images = {
        stamp: to_metres(frame.image)
        if (side := hidden_side(frame.time)) is None
        else behind_board(to_metres(frame.image), scene.camera, frame.joints, side)
        for stamp, frame in zip(truth, frames, strict=True)
    }
    orientations, pose = worn(scene, job.seconds), replace(scene.pose, sensor=mesh_sensor(SENSOR))
    chosen = [(stamp, side) for stamp in truth if (side := hidden_side(stamp / NANOSECONDS)) is not None]
    unstated = np.full((len(Joint), 3, 3), np.nan)
    tracks: dict[str, dict[int, tuple[FloatArray, FloatArray]]] = {}
    for name, segments in (("mesh", ()), ("mesh+sensor", SEGMENTS)):
        stage = mesh_stage(scene, segments)
        seen = [(stamp, depth_topic(SENSOR), (stamp, "", depth)) for stamp, depth in images.items()]
        given = orientations if segments else []
        skeletons = {
            stamp: skeleton
            for stamp, (skeleton,) in fed(stage, pose, seen, given, graph.skeleton_topic(stage.sensor.name))
        }
        tracks[name] = {stamp: (each.positions, each.covariances) for stamp, each in skeletons.items()}
        for behind in ("ekf", "ekf+sensor"):
            of_filter = SEGMENTS if behind == "ekf+sensor" else ()
            topic = graph.skeleton_topic(pose.sensor)
            measured = [(stamp, topic, (each,)) for stamp, each in skeletons.items()]
            own = orientations if of_filter else []
            filtered = fed(ekf_stage(pose.sensor, of_filter), pose, measured, own, graph.FILTERED)
            tracks[behind if name == "mesh" else f"{behind}, mesh+sensor"] = {
                stamp: (
                    (each.positions - pose.translation) @ pose.rotation,
                    # infinite for the legs, which are not in the filter's model
                    pose.rotation.T @ np.where(np.isfinite(each.covariances), each.covariances, np.nan) @ pose.rotation,
                )
                for stamp, (each,) in filtered
            }
    persons = {stamp: frame.person for stamp, frame in zip(truth, frames, strict=True)}
    body, view = stage.sensor.body, DepthCamera(scene.camera)
    turned = orientations_at(orientations, pose, [stamp for stamp, _ in chosen[::_FLOOR]], body.model.joint_names)
    tracks["floor"] = {}
    for stamp, side in chosen[::_FLOOR]:
        mask = persons[stamp] & (images[stamp] > _nearer(truth[stamp], side) + 0.1)
        found = fit_from_truth(body, view, images[stamp], mask, truth[stamp], turned[stamp]).points
        tracks["floor"][stamp] = found, unstated
    read = _kinect(scene, np.array([*truth.values()]))
    tracks["kinect"] = {stamp: (positions, unstated) for stamp, positions in zip(truth, read, strict=True)}
    nothing = np.full((len(Joint), 3), np.nan), unstated
    result = HiddenRun(job, np.array([side for _, side in chosen]), {}, {}, {})
    for name in VARIANTS:
        each = [tracks[name].get(stamp, nothing) for stamp, _ in chosen]
        pairs = [*zip(each, chosen, strict=True)]
        off = np.array([(positions - truth[stamp])[_arm(side)] for (positions, _), (stamp, side) in pairs])
        covariances = np.array([covariance[_arm(side)] for (_, covariance), (_, side) in pairs])[:, :2]
        spread = np.sqrt(np.diagonal(covariances, axis1=2, axis2=3))
        result.errors[name] = off[:, :2]
        result.within[name] = np.where(np.isfinite(spread), np.abs(off[:, :2]) < NORMAL * spread, np.nan)
        result.turns[name] = np.array(
            [_turn(error, truth[stamp][_arm(side)]) for error, (stamp, side) in zip(off, chosen, strict=True)]
        )
    return result


def orientations_at(
    measured: Sequence[SegmentOrientation], pose: SensorPose, stamps: Sequence[int], names: Sequence[str]
) -> dict[int, list[Orientation]]:
    """The orientations at the times of images, as the mesh takes them."""
    placement, worn_now, found = Placement(), SensorOrientations(SEGMENTS), {}
    placement.set_pose(pose)
    rest = [*measured]
    for stamp in stamps:
        while rest and rest[0].stamp_ns <= stamp:
            worn_now.add(rest.pop(0))
        found[stamp] = worn_now.seen_from(placement, stamp, names, Counter())
    return found


def _arm(side: int) -> list[int]:
    return [Joint[f"{name}_{SIDES[side].upper()}"] for name in ("ELBOW", "WRIST", "THUMB")]


def _kinect(scene: DepthScene, joints: FloatArray) -> FloatArray:
    """(n, 25, 3) joints of a Kinect behind the same board, from true joints, metres in the optical frame."""
    board = np.tile([50.0, 0.0, 1.0], (len(joints), len(Joint), 1))
    for number in range(len(joints)):
        if (side := hidden_side(number / RATE)) is not None:
            arm = joints[number][[Joint[f"{name}_{SIDES[side].upper()}"] for name in ("ELBOW", "WRIST", "HAND_TIP")]]
            board[number, :3] = _BOARD * arm
    flesh = Capsules(np.array([0, 1]), np.array([1, 2]), np.full(2, 0.2))
    return kinect_skeletons(scene, joints, [(scene.pose.apply(board), flesh)])


def _turn(off: FloatArray, true: FloatArray) -> float:
    """Turn of elbow, wrist and thumb with errors (3, 3) about the forearm against the true ones, radians."""
    axis = (true[1] - true[0]) / np.linalg.norm(true[1] - true[0])
    across = [each[2] - each[1] - ((each[2] - each[1]) @ axis) * axis for each in (true + off, true)]
    return float(np.arctan2(np.cross(across[1], across[0]) @ axis, across[1] @ across[0]))


def figures_of(runs: Sequence[HiddenRun], *, offset: bool = True) -> dict[str, dict[str, float]]:
    """Mean errors of several runs by variant, in the images with estimates by all variants but the floor.

    Args:
        runs: the runs.
        offset: keep each joint's constant offset in a run, per side.
    """
    compared = [name for name in VARIANTS if name != "floor"]
    known = {id(run): np.all([np.isfinite(run.errors[n]).all(axis=(1, 2)) for n in compared], axis=0) for run in runs}
    figures = {}
    for name in VARIANTS:
        distances, turns, inside = [], [], []
        for run in runs:
            use = known[id(run)] & np.isfinite(run.errors[name]).all(axis=(1, 2))
            errors = run.errors[name].copy()
            for side in () if offset else (0, 1):
                own = use & (run.sides == side)
                errors[own] -= errors[own].mean(axis=0)
            distances.append(np.linalg.norm(errors[use], axis=2))
            turned = np.exp(1j * run.turns[name][use])
            turns.append(np.angle(turned * np.conj(turned.mean())))
            inside.append(run.within[name][use])
        mm = 1e3 * np.concatenate(distances)
        figures[name] = {
            "elbow, mm": float(mm[:, 0].mean()),
            "wrist, mm": float(mm[:, 1].mean()),
            "both, mm": float(mm.mean()),
            "wrist 95 %, mm": float(np.percentile(mm[:, 1], 95)),
            "turn, deg RMS": float(np.degrees(np.sqrt(np.mean(np.concatenate(turns) ** 2)))),
            "in 1.96 sd, %": float(100.0 * np.concatenate(inside).mean()),
            "images": float(len(mm)),
            "without estimate": float(sum(np.isnan(run.errors[name][:, 1, 0]).sum() for run in runs)),
        }
    return figures


def main() -> int:
    arguments, _, runs = runs_of(run, __doc__, MOTIONS, seeds=3, seconds=8.0, least=FIRST + HIDDEN)
    tables = {
        "as they are": figures_of(runs),
        "without constant offsets": figures_of(runs, offset=False),
        **{motion: figures_of([each for each in runs if each.job.motion == motion]) for motion in arguments.motions},
    }

    report(arguments, tables)
    figures = tables["as they are"]
    without, sensor, kinect = (figures[name] for name in ("mesh", "mesh+sensor", "kinect"))
    return verdicts(
        arguments,
        {
            "with sensor 45 % below the simulated Kinect": sensor["both, mm"] <= 0.55 * kinect["both, mm"],
            "without sensor the wrist 40 % worse": without["wrist, mm"] >= 1.4 * sensor["wrist, mm"],
            "without sensor the elbow 20 % worse": without["elbow, mm"] >= 1.2 * sensor["elbow, mm"],
        },
    )


if __name__ == "__main__":
    sys.exit(main())
