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
from mesh_runs import ARMS, kinect_skeletons, people

from body_tracking.camera import lifting
from body_tracking.camera.lifting import Lifted, is_flat, lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import Landmarks, PoseModel
from body_tracking.camera.triangulation import View, match, triangulate
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, TrackingState
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.camera_bags import pose_around, rig_of
from body_tracking.simulation.colour_images import Painter, colour_camera
from body_tracking.simulation.depth_scene import DepthFrame, DepthScene, held_out
from body_tracking.simulation.layouts import Layout, around, layout
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
    kinect = kinect_skeletons(scene, true, times=np.array(times)) - true
    return {name: run_of(lifted, true, kinect, images, spent) for name, lifted in found.items()}


def run_of(lifted: Sequence[Lifted], true: FloatArray, kinect: FloatArray, images: int, spent: float) -> Run:
    """The figures of frames with true joints (n, 25, 3)."""
    error = np.array([each.positions for each in lifted]) - true
    covariances = np.array([each.covariances for each in lifted])
    inverse = np.linalg.inv(np.where(np.isfinite(covariances), covariances, np.eye(3)))
    distances = np.einsum("nji,njik,njk->nj", error, inverse, error)
    seen = np.array([each.states for each in lifted]) == TrackingState.TRACKED
    return Run(error, distances, seen, kinect, images, spent)


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
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion (8)")
    parser.add_argument("--step", type=int, default=3, metavar="N", help="every n-th image of 30 a second (3)")
    parser.add_argument("--pair", action="store_true", help="two colour cameras in place of one with depth")
    parser.add_argument("--azimuth", type=float, default=0.0, metavar="DEG", help="of the camera from the front (0)")
    parser.add_argument("--ablation", action="store_true", help="leave out one mechanism of the lifting at a time")
    args = parser.parse_args()
    if args.pair and (args.ablation or args.azimuth):
        parser.error("--ablation and --azimuth are of the camera with depth")
    return args


def main() -> int:
    args = arguments()
    data, model = people(), PoseModel(default_folder())
    variants = tuple(ABLATION) if args.ablation else (ALL,)
    runs: dict[str, dict[str, list[Run]]] = {name: {motion: [] for motion in args.motions} for name in variants}
    for motion in args.motions:
        for seed in range(args.seeds):
            who = held_out(data, seed)
            scene = DepthScene(who, motion, seed, colour_camera())
            if args.azimuth:
                scene = Placed(who, motion, seed, colour_camera(), where=around((np.radians(args.azimuth),)))
            for name, found in runs_of(scene, model, args.seconds, args.step, args.pair, variants).items():
                runs[name][motion].append(found)
    total = {name: [run for each in of_motion.values() for run in each] for name, of_motion in runs.items()}
    if args.ablation:
        common.report(args, {f"without {name}": figures_of(each) for name, each in total.items()})
        return 0
    figures: dict[str, Any] = {motion: figures_of(each) for motion, each in (*runs[ALL].items(), ("all", total[ALL]))}
    for name in ("errors", "kinect"):
        errors = np.concatenate([getattr(each, name) for each in total[ALL]])
        figures[f"correlation of a bone's {name}"] = common.bone_correlation(errors, ARMS)
    common.report(args, figures)
    return 0


def figures_of(runs: list[Run]) -> dict[str, float]:
    """Means over all frames of the runs, errors in mm, shares in percent, time in ms per image."""

    def mean(moved: bool, kinect: bool, joints: Any) -> float:
        found = [sizes(each.kinect if kinect else each.errors, moved=moved)[:, joints].ravel() for each in runs]
        return float(np.nanmean(np.concatenate(found)))

    distances = np.concatenate([each.distances.ravel() for each in runs])
    known = np.isfinite(distances)
    seen = known & np.concatenate([each.seen.ravel() for each in runs])
    images = sum(each.images for each in runs)
    return {
        "arms": mean(False, False, ARMS),
        "moved": mean(True, False, ARMS),
        "Kinect": mean(False, True, ARMS),
        "Kinect moved": mean(True, True, ARMS),
        "all": mean(False, False, slice(None)),
        "inside": 100.0 * (distances[known] < INSIDE).mean(),
        "seen inside": 100.0 * (distances[seen] < INSIDE).mean(),
        "NEES": distances[known].mean() / 3.0,
        "seen NEES": distances[seen].mean() / 3.0,
        "tracked": 100.0 * np.concatenate([each.seen[:, ARMS].ravel() for each in runs]).mean(),
        "lost": images - sum(len(each.errors) for each in runs),
        "ms": 1e3 * sum(each.seconds for each in runs) / images,
    }


if __name__ == "__main__":
    raise SystemExit(main())
