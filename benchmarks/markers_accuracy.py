"""Accuracy of the marker system beside the figures of Gaschler (2011), chapter 6.

Simulated balls with a noise of the centroids of 0.1 pixels (his section 6.1), and corners with that of his boards
(0.06):

a. a target of five balls, 98 mm, at 0.5 to 3 m, exact calibration: RMS of position and orientation (3D), the
   Cramer-Rao bound of the same noise, his unweighted fit to the same points, and his stated figures at 1 m; a single
   ball, and the same ball by the direct linear transform (his eq. 3.4-3.5).
b. his tables 6.1 (a target moved by 400 mm, five times) and 6.2 (a still arm, the cameras moved around it over 2,000
   frames), each over several calibrations with 13 boards.
d. angles at 1 m, over calibrations, each with its own boards, measured targets and fitted chain: RMS, the share of
   errors within 1.96 stated standard deviations, and the bound with exact calibration.
e. joints from 2,000 frames, over the same calibrations: RMS of centre, axis and line, the share of errors within three
   stated standard deviations; from 500 frames with a motion of +-3 degrees: RMS of errors over stated deviations.

Rendered images, through detection:

c. rigs calibrated with rendered boards, a target in poses at 1 m: errors after one rigid alignment, which removes the
   displacement and rotation of the calibrated frame as a whole.
"""

from __future__ import annotations

import sys
from typing import Any

import common
import cv2
import markers_lab as lab
import numpy as np
from scipy.spatial.transform import Rotation
from target_points import TARGET_POINTS, fit_pose, rotation_error

from body_tracking.calibration.rigid import rigid_registration
from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import projection
from body_tracking.markers.angles import AngleEstimator
from body_tracking.markers.boards import Chessboard
from body_tracking.markers.camera_calibration import calibrate_cameras, find_boards
from body_tracking.markers.chain import ChainFit, JointDescription, fit_chain
from body_tracking.markers.corrections import centred, pose_sensitivities, shape_effects
from body_tracking.markers.detection import detect
from body_tracking.markers.joint_model import SIZE
from body_tracking.markers.joint_tree import Posture, Tree, differentiate, place
from body_tracking.markers.joints import Verdict
from body_tracking.markers.pose import umeyama
from body_tracking.markers.recognition import Recogniser
from body_tracking.markers.rendering import Sensor, render
from body_tracking.markers.rig import Rig
from body_tracking.markers.targets import Target
from body_tracking.markers.triangulation import triangulate
from body_tracking.simulation.marker_bags import COLUMNS, ROWS, SQUARE, board_images
from body_tracking.simulation.marker_scene import DIAMETER, make_targets, stereo_rig

DISTANCES = (0.5, 0.6, 0.7, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
FLOOR_BAR = 1.10
RENDERED_BARS = 0.13, 0.11
"""Bars after alignment: millimetres and degrees."""
ANGLE_BARS = {"shoulder": 0.17, "elbow": 0.125}
"""Bars, degrees: of the ball joint 3D, of the hinge."""
INSIDE_BAR = 92.0, 98.0
JOINT_BARS = {"centre, mm": 0.15, "axis, deg": 0.05, "line, mm": 0.1}
SMALL, SMALL_BAR = 3.0, 1.5
STATED = {"position, mm": 0.25, "orientation, deg": 0.3, "ball joint, deg": 0.4, "hinge, deg": 0.3}
"""Figures that he expects at 1 m (section 6.1.2)."""
TABLE_6_1 = {
    "torso": (0.4990, 0.5155, 0.3720),
    "upper arm": (0.5271, 0.6155, 0.1340),
    "lower arm": (0.7012, 0.8100, 0.5588),
}
TABLE_6_2 = {
    "upper arm wrt torso": (0.4833, 0.2382),
    "lower arm wrt torso": (0.5668, 0.1469),
    "lower arm wrt upper arm": (0.5638, 0.2304),
    "shoulder": (np.nan, 0.2060),
    "elbow": (np.nan, 0.0546),
}
MOVED, TIMES = 0.4, 5


def rms3(values: FloatArray) -> float:
    """Root of the mean squared length of (n, 3)."""
    return float(np.sqrt((values**2).sum(axis=-1).mean()))


# --- a: a target by distance


def bound(rig: Rig, target: Target, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """(6, 6) Cramer-Rao bound of a pose's covariance by the noise of the centroids."""
    arms = target.points @ rotation.T
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), -so3.skew(arms)], axis=-1)
    information = np.zeros((6, 6))
    for camera, turn, shift in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
        by_pixel = (projection.project(camera, turn, shift, arms + translation).by_point @ by_pose).reshape(-1, 6)
        information += by_pixel.T @ by_pixel
    return np.asarray(np.linalg.inv(information) * lab.BALL_NOISE**2)


def by_distance(count: int) -> dict[str, list[float]]:
    """Part a."""
    rig, target, rng = stereo_rig(), Target("target", TARGET_POINTS, np.zeros((15, 15)), DIAMETER), lab_rng(1)
    rows: dict[str, list[float]] = {}
    for distance in DISTANCES:
        errors, plain, floor, single, linear = [], [], [], [], []
        projections = [np.c_[turn, shift] for turn, shift in zip(rig.rotations, rig.translations, strict=True)]
        for _ in range(count):
            rotation, translation = Rotation.random(random_state=rng).as_matrix(), lab.before(distance)
            true = target.points @ rotation.T + translation
            seen = lab.see(rig, true, rng)
            points = lab.points_of(rig, seen)
            rows_seen = points.balls[:, 0]
            assignment = np.full(len(true), -1)
            assignment[rows_seen] = np.arange(len(rows_seen))
            fit = fit_pose(target, points, assignment)
            errors.append(np.r_[fit.translation - translation, rotation_error(rotation, fit.rotation)])
            some = umeyama(target.points[rows_seen][None], points.positions[None], np.ones((1, len(rows_seen))))
            plain.append(np.r_[some[1][0] - translation, rotation_error(rotation, some[0][0])])
            floor.append(bound(rig, target, rotation, translation).diagonal())
            single.append((points.positions - true[rows_seen])[0])
            flat = [
                camera.undistort(each.pixels[rows_seen[:1]]).T for camera, each in zip(rig.cameras, seen, strict=True)
            ]
            homogeneous = np.asarray(cv2.triangulatePoints(*projections, *flat))[:, 0]
            linear.append(homogeneous[:3] / homogeneous[3] - true[rows_seen[0]])
        found, his, least = np.array(errors), np.array(plain), np.sqrt(np.array(floor).mean(axis=0))
        for name, value in (
            ("ball, mm", 1e3 * rms3(np.array(single))),
            ("eq. 3.4-3.5, mm", 1e3 * rms3(np.array(linear))),
            ("ball's depth, mm", 1e3 * common.rms(np.array(single)[:, 2])),
            ("position, mm", 1e3 * rms3(found[:, :3])),
            ("its floor", 1e3 * float(np.linalg.norm(least[:3]))),
            ("unweighted", 1e3 * rms3(his[:, :3])),
            ("orientation, deg", np.degrees(rms3(found[:, 3:]))),
            ("the floor", np.degrees(float(np.linalg.norm(least[3:])))),
            ("unweighted, deg", np.degrees(rms3(his[:, 3:]))),
        ):
            rows.setdefault(name, []).append(float(value))
    return rows


def lab_rng(part: int, number: int = 0) -> np.random.Generator:
    """Random generator for a part and a calibration."""
    return np.random.default_rng([2011, part, number])


# --- b: his experiments


def displacements(number: int) -> FloatArray:
    """Table 6.1 with one calibration: (3, 3, times) errors of measured moves of 400 mm along x, y, z, metres."""
    rng = lab_rng(2, number)
    room = lab.Lab.make(make_targets(), rng)
    result = np.empty((3, 3, TIMES))
    for axis, (near, far) in enumerate(((0.9, 1.1), (0.9, 1.1), (0.7, 1.0))):
        for time in range(TIMES):
            turns = Rotation.random(3, random_state=rng).as_matrix()
            if axis < 2:
                start = lab.before(rng.uniform(near, far)) - 0.5 * MOVED * np.eye(3)[axis]
            else:
                start = lab.before(rng.uniform(near, far))  # away from the cameras
            move = MOVED * np.eye(3)[axis]
            places = np.stack([np.tile(start, (3, 1)), np.tile(start + move, (3, 1))])
            here, there = (
                [
                    lab.poses_of([target], lab.points_of(room.rig, lab.see(room.truth, balls, rng)))[0]
                    for target, balls in zip(
                        room.targets,
                        (
                            body.points @ turn.T + place
                            for body, turn, place in zip(room.bodies, turns, some, strict=True)
                        ),
                        strict=True,
                    )
                ]
                for some in places
            )
            for index, (one, other) in enumerate(zip(here, there, strict=True)):
                result[index, axis, time] = np.linalg.norm(other.translation - one.translation) - MOVED
    return result


def around(number: int, frames: int) -> dict[str, tuple[float, float]]:
    """Table 6.2 with one calibration: standard deviations of translations (3D, mm) and rotations (3D, degrees)."""
    rng = lab_rng(3, number)
    room = lab.Lab.make(make_targets(), rng)
    tree = lab.arm(rng, [body.name for body in room.bodies])
    chain = chain_of(room, tree, lab.motion(rng, tree, frames // 4, 60.0), rng).chain
    still = lab.motion(rng, tree, 1, 0.0)
    rotations, translations = place(tree, still)
    # poses of the cameras about the arm: all targets turn and move as one
    turns = Rotation.from_rotvec(rng.uniform(-0.8, 0.8, (frames, 3))).as_matrix()
    middle = translations[0].mean(axis=0)
    places = np.stack([lab.before(distance) for distance in rng.uniform(0.8, 1.3, frames)])
    moved = np.einsum("nij,tj->nti", turns, translations[0] - middle) + places[:, None]
    measured = room.measure(turns[:, None] @ rotations[0], moved, rng)
    found: dict[str, tuple[list[FloatArray], list[FloatArray]]] = {}
    estimator = AngleEstimator(chain)
    for poses in measured:
        torso, upper, lower = poses
        for name, one, other in (
            ("upper arm wrt torso", torso, upper),
            ("lower arm wrt torso", torso, lower),
            ("lower arm wrt upper arm", upper, lower),
        ):
            shifts, turned = found.setdefault(name, ([], []))
            shifts.append(one.rotation.T @ (other.translation - one.translation))
            turned.append(one.rotation.T @ other.rotation)
        joints = estimator.estimate(poses).rotations
        for name, turn in zip(("shoulder", "elbow"), joints, strict=True):
            found.setdefault(name, ([], []))[1].append(turn)
    result = {}
    for name, (shifts, turned) in found.items():
        mean = Rotation.from_matrix(np.array(turned)).mean().as_matrix()
        spread = np.array([rotation_error(turn, mean) for turn in turned])
        shift = 1e3 * float(np.linalg.norm(np.std(shifts, axis=0))) if shifts else float("nan")
        result[name] = shift, float(np.degrees(rms3(spread)))
    return result


# --- c: rendered images


def rendered(number: int, poses: int) -> dict[str, float]:
    """Part c with one calibration from rendered boards: RMS, mm and degrees, before and after one alignment."""
    rng, truth, sensor = lab_rng(4, number), stereo_rig(), Sensor()
    series = list(zip(*board_images(truth, lab.VIEWS, 40 + number, sensor), strict=True))
    sizes = [(camera.width, camera.height) for camera in truth.cameras]
    corners = find_boards(Chessboard(COLUMNS, ROWS, SQUARE), series)
    rig = calibrate_cameras([camera.frame_id for camera in truth.cameras], sizes, corners).rig
    target = Target("target", TARGET_POINTS, np.zeros((15, 15)), DIAMETER)
    recogniser = Recogniser([target])
    true, found, turns, missed = [], [], [], 0
    for index in range(poses):
        rotation = Rotation.random(random_state=rng).as_matrix()
        translation = lab.before(1.0) + rng.uniform(-1.0, 1.0, 3) * np.array([0.12, 0.15, 0.1])
        balls = target.points @ rotation.T + translation
        seen = [
            detect(
                render(camera, turn, shift, balls, DIAMETER, sensor, 10_000 * number + 2 * index + side).image,
                0,
                camera.frame_id,
            )
            for side, (camera, turn, shift) in enumerate(
                zip(truth.cameras, truth.rotations, truth.translations, strict=True)
            )
        ]
        points = triangulate(rig, seen)
        points = triangulate(rig, centred(rig, seen, points, DIAMETER))
        some = recogniser.recognise(points).poses
        if not some:
            missed += 1
            continue
        true.append(translation)
        found.append(some[0].translation)
        turns.append((rotation, some[0].rotation))
    turn, shift = rigid_registration(np.array(true), np.array(found))
    aligned = np.array(found) @ turn.T + shift
    after = np.array([rotation_error(one, turn @ other) for one, other in turns])
    before = np.array([rotation_error(one, other) for one, other in turns])
    return {
        "position, mm": 1e3 * rms3(np.array(found) - np.array(true)),
        "aligned, mm": 1e3 * rms3(aligned - np.array(true)),
        "orientation, deg": float(np.degrees(rms3(before))),
        "aligned, deg": float(np.degrees(rms3(after))),
        "found, %": 100.0 * (1.0 - missed / poses),
    }


# --- d and e: joints and angles


def chain_of(room: lab.Lab, tree: Tree, posture: Posture, rng: np.random.Generator) -> ChainFit:
    """The chain fitted to a motion."""
    frames = room.measure(*place(tree, posture), rng)
    by_name = {target.name: target for target in room.targets}
    joints = [JointDescription(joint.name, joint.parent, joint.child, joint.kind) for joint in tree.joints]
    sensitivities = [pose_sensitivities(room.rig, by_name, poses) for poses in frames]
    return fit_chain(frames, joints, sensitivities, [shape_effects(room.rig, by_name, poses) for poses in frames])


def joint_errors(room: lab.Lab, tree: Tree, fit: ChainFit) -> dict[str, list[float]]:
    """Errors of centre (ball joint), axis and line (hinge) in both targets, with their stated standard deviations.

    Each error is a length in mm or degrees; its stated standard deviation is the root of the summed variances.
    ``inside`` states for each coordinate whether its error is within three stated standard deviations.
    """
    chain = fit.chain
    covariance = chain.covariance + chain.sensitivity @ room.rig.covariance @ chain.sensitivity.T
    found: dict[str, list[float]] = {"centre, mm": [], "axis, deg": [], "line, mm": []}
    found |= {f"{name} stated": [] for name in list(found)}
    found["inside"] = []
    for index, (joint, true) in enumerate(zip(chain.joints, tree.joints, strict=True)):
        own = covariance[SIZE * index : SIZE * (index + 1), SIZE * index : SIZE * (index + 1)]
        away = joint.difference(room.true_joint(true))
        for start, axis in ((0, joint.parent_axis), (6, joint.child_axis)):
            parts = [("centre, mm", 1e3, np.eye(3), start)]
            if joint.kind.coordinates == 1:
                across = np.linalg.svd(axis[None])[2][1:]
                parts = [("line, mm", 1e3, across, start), ("axis, deg", float(np.degrees(1.0)), across, start + 3)]
            for name, unit, wanted, first in parts:
                error = wanted @ away[first : first + 3]
                variance = np.diag(wanted @ own[first : first + 3, first : first + 3] @ wanted.T)
                found[name].append(unit * float(np.linalg.norm(error)))
                found[f"{name} stated"].append(unit * float(np.sqrt(variance.sum())))
                found["inside"] += (np.abs(error) <= 3.0 * np.sqrt(variance)).tolist()
    return found


def calibration(job: tuple[int, int, int]) -> dict[str, Any]:
    """Parts d and e with one calibration."""
    number, frames, test = job
    rng = lab_rng(5, number)
    room = lab.Lab.make(make_targets(), rng)
    tree = lab.arm(rng, [body.name for body in room.bodies])
    fit = chain_of(room, tree, lab.motion(rng, tree, frames, 60.0), rng)
    small = chain_of(room, tree, lab.motion(rng, tree, frames // 4, SMALL), rng)
    posture = lab.motion(rng, tree, test, 60.0)
    rotations, translations = place(tree, posture)
    measured = room.measure(rotations, translations, rng)
    by_name = {target.name: target for target in room.targets}
    estimator = AngleEstimator(fit.chain)
    errors: dict[str, list[FloatArray]] = {joint.name: [] for joint in tree.joints}
    stated: dict[str, list[FloatArray]] = {joint.name: [] for joint in tree.joints}
    for row, poses in enumerate(measured):
        found = estimator.estimate(poses, pose_sensitivities(room.rig, by_name, poses), room.rig.covariance)
        for index, joint in enumerate(tree.joints):
            true = room.true_joint(joint)
            own = rotations[row, index : index + 2] @ room.turns[index : index + 2].swapaxes(1, 2)
            turn = true.parent_rotation.T @ own[0].T @ own[1] @ true.child_rotation
            errors[joint.name].append(rotation_error(turn, found.rotations[index]))
            stated[joint.name].append(np.sqrt(found.rotation_covariance[index].diagonal()))
    return {
        "errors": {name: np.array(each) for name, each in errors.items()},
        "stated": {name: np.array(each) for name, each in stated.items()},
        "floor": floor_of_angles(room.truth, room.bodies, tree, posture),
        "joints": joint_errors(room, tree, fit),
        "small": joint_errors(room, tree, small),
        "warned": all(each.verdict is Verdict.SMALL_MOTION for each in small.joints),
    }


def floor_of_angles(truth: Rig, bodies: tuple[Target, ...], tree: Tree, posture: Posture) -> dict[str, FloatArray]:
    """(n,) Cramer-Rao bound of each joint's variance by the noise of the centroids alone, all else known; rad2."""
    rotations, translations = place(tree, posture)
    derivative = differentiate(tree, posture, rotations, False)
    bounds = np.array(
        [
            [bound(truth, body, turn, shift) for body, turn, shift in zip(bodies, some, others, strict=True)]
            for some, others in zip(rotations, translations, strict=True)
        ]
    )
    information = (derivative.swapaxes(-1, -2) @ np.linalg.solve(bounds, derivative)).sum(axis=1)
    variances = np.linalg.inv(information).diagonal(axis1=1, axis2=2)
    return {joint.name: variances[:, where].sum(axis=1) for joint, where in zip(tree.joints, tree.slices, strict=True)}


def pooled(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Parts d and e over all calibrations."""
    angles = {}
    for name in ANGLE_BARS:
        axes = slice(None) if name == "shoulder" else slice(2, None)
        errors = np.concatenate([each["errors"][name] for each in results])[:, axes]
        stated = np.concatenate([each["stated"][name] for each in results])[:, axes]
        inside = [
            100.0 * np.mean(np.abs(each["errors"][name][:, axes]) <= 1.96 * each["stated"][name][:, axes])
            for each in results
        ]
        angles[name] = {
            "RMS, deg": float(np.degrees(rms3(errors))),
            "stated, deg": float(np.degrees(rms3(stated))),
            "floor, deg": float(np.degrees(np.sqrt(np.concatenate([each["floor"][name] for each in results]).mean()))),
            "inside, %": 100.0 * float(np.mean(np.abs(errors) <= 1.96 * stated)),
            "inside, least, %": float(min(inside)),
        }
    joints: dict[str, dict[str, float]] = {}
    for motion in ("joints", "small"):
        joints[motion] = {
            "inside 3, %": 100.0 * float(np.mean([v for each in results for v in each[motion]["inside"]]))
        }
        for name in JOINT_BARS:
            error = np.array([value for each in results for value in each[motion][name]])
            stated = np.array([value for each in results for value in each[motion][f"{name} stated"]])
            joints[motion] |= {name: common.rms(error), f"{name} stated": common.rms(stated)}
            joints[motion][f"{name} over stated"] = common.rms(error / stated)
    return {"angles": angles, "joints": joints, "warned": sum(each["warned"] for each in results)}


# --- the command


def _displaced(jobs: list[int]) -> dict[str, dict[str, list[float]]]:
    """Per target along x, y, z: standard deviation of the moves, RMS against the true length, and his figures; mm."""
    moves = 1e3 * np.stack([displacements(job) for job in jobs])  # (c, target, axis, times)
    spread, total = np.sqrt(moves.var(axis=3, ddof=1).mean(axis=0)), np.sqrt((moves**2).mean(axis=(0, 3)))
    return {
        name: {"spread": spread[index].tolist(), "RMS": total[index].tolist(), "his": list(his)}
        for index, (name, his) in enumerate(TABLE_6_1.items())
    }


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--calibrations", type=int, default=12, metavar="N", help="of d and e (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=2000, metavar="N", help="of a recording (default: %(default)s)")
    parser.add_argument("--poses", type=int, default=120, metavar="N", help="of c (default: %(default)s)")
    args = parser.parse_args()
    figures: dict[str, Any] = {
        "calibrations": args.calibrations,
        "by distance, m": {"m": list(DISTANCES)} | by_distance(400),
    }
    figures["table 6.1"] = _displaced(list(range(12)))
    sets = [around(number, args.frames) for number in range(2)]
    figures["table 6.2"] = {
        name: {
            f"{unit}{own}": value
            for part, unit in enumerate(("mm", "deg"))
            for own, value in (("", common.rms(np.array([each[name][part] for each in sets]))), (", his", his[part]))
        }
        for name, his in TABLE_6_2.items()
    }
    figures["rendered"] = [rendered(number, args.poses) for number in range(3)]
    jobs = [(number, args.frames, 300) for number in range(args.calibrations)]
    figures |= pooled(common.mapped(calibration, jobs, args.jobs))
    common.report(args, figures)

    rows = figures["by distance, m"]
    ratio = max(
        np.max(np.divide(rows["position, mm"], rows["its floor"])),
        np.max(np.divide(rows["orientation, deg"], rows["the floor"])),
    )
    met = {f"a: within {FLOOR_BAR:g} of the floor at all distances ({ratio:.3f})": bool(ratio <= FLOOR_BAR)}
    for name, bar in zip(("aligned, mm", "aligned, deg"), RENDERED_BARS, strict=True):
        worst = max(each[name] for each in figures["rendered"])
        met[f"c: {name} {worst:.4f}, at most {bar:g}"] = worst <= bar
    for name, bar in ANGLE_BARS.items():
        row = figures["angles"][name]
        met[f"d: {name} {row['RMS, deg']:.4f} deg, at most {bar:g}"] = row["RMS, deg"] <= bar
        met[f"d: {name} {row['inside, %']:.1f} % inside, 92 to 98"] = INSIDE_BAR[0] <= row["inside, %"] <= INSIDE_BAR[1]
    for name, bar in JOINT_BARS.items():
        value = figures["joints"]["joints"][name]
        met[f"e: {name} {value:.4f}, at most {bar:g}"] = value <= bar
        factor = figures["joints"]["small"][f"{name} over stated"]
        met[f"e: +-{SMALL:g} deg, {name} over stated {factor:.2f}, within 1.5"] = 1.0 / SMALL_BAR <= factor <= SMALL_BAR
    share = figures["joints"]["joints"]["inside 3, %"]
    met[f"e: {share:.1f} % within three deviations, 99 or more"] = share >= 99.0
    met[f"e: +-{SMALL:g} deg is warned of"] = figures["warned"] == args.calibrations
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
