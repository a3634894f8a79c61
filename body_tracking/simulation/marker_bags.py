"""``body_tracking markers render``: images of a simulated arm with targets, as a bag, and the setup to track them."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from body_tracking.core import so3
from body_tracking.core.message_types import IMAGE, JOINT_STATE
from body_tracking.core.qos import LATCHED, RELIABLE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import CameraImage, Info
from body_tracking.markers.rendering import Sensor, render, render_chessboard
from body_tracking.markers.rig import Rig
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.targets_file import save_targets
from body_tracking.messages.base import to_header
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.recording.replay import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter
from body_tracking.simulation.marker_scene import DIAMETER, MarkerScene, marker_scene
from body_tracking.simulation.repertoire import MOTIONS

START_NS = 1_750_000_000 * NANOSECONDS
TRUE_ANGLES = f"/ground_truth/{setup.BODY}/joint_states"
COLUMNS, ROWS, SQUARE = 9, 6, 0.04
"""Of the chessboard: inner corners, and metres."""


def write_scene(scene: MarkerScene, output: Path, sensor: Sensor, seed: int, *, overwrite: bool = False) -> None:
    """Write images, calibrations and true angles of the elbow.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    frames = [camera.frame_id for camera in scene.rig.cameras]
    with BagWriter(output, overwrite=overwrite, flush_interval_s=float("inf")) as bag:
        for camera in scene.rig.cameras:
            bag.add_topic(setup.image_topic(camera.frame_id), IMAGE, RELIABLE)
            bag.add_topic(setup.info_topic(camera.frame_id), CAMERA_INFO, LATCHED)
            bag.write(setup.info_topic(camera.frame_id), Info().encode((START_NS, camera), BAG_WIRE), START_NS)
        bag.add_topic(TRUE_ANGLES, JOINT_STATE, RELIABLE)
        progress = Progress(0, len(scene.times))
        velocity = np.gradient(scene.translations, scene.times, axis=0)
        for index, time in enumerate(scene.times - scene.times[0]):
            stamp_ns = START_NS + round(float(time) * NANOSECONDS)
            balls = scene.balls(index)
            speeds = np.repeat(velocity[index], [len(target.points) for target in scene.targets], axis=0)
            for camera, rotation, translation in zip(
                scene.rig.cameras, scene.rig.rotations, scene.rig.translations, strict=True
            ):
                image = render(
                    camera, rotation, translation, balls, DIAMETER, sensor, seed * 100_003 + index, velocities=speeds
                ).image
                message = CameraImage().encode((stamp_ns, camera.frame_id, image), BAG_WIRE)
                bag.write(setup.image_topic(camera.frame_id), message, stamp_ns)
            bag.write(TRUE_ANGLES, _angles(stamp_ns, frames[0], scene.elbow[index]), stamp_ns)
            progress.at(index)
        progress.end()


def _angles(stamp_ns: int, frame_id: str, elbow: FloatArray) -> bytes:
    message = BAG_MESSAGES.make(
        JOINT_STATE,
        header=to_header(stamp_ns, frame_id, BAG_MESSAGES),
        name=["elbow_flexion", "forearm_pronation"],
        position=BAG_MESSAGES.floats(np.ascontiguousarray(elbow)),
        velocity=BAG_MESSAGES.floats(np.empty(0)),
        effort=BAG_MESSAGES.floats(np.empty(0)),
    )
    return BAG_WIRE.serialize(JOINT_STATE, message)


def write_boards(rig: Rig, folder: Path, count: int, seed: int) -> None:
    """Write images of a chessboard, held in ``count`` poses before the rig, a folder per camera."""
    rng = np.random.default_rng([seed, 1999])
    size = np.array([(COLUMNS - 1) * SQUARE, (ROWS - 1) * SQUARE, 0.0])
    for camera in rig.cameras:
        (folder / setup.camera_name(camera.frame_id)).mkdir(parents=True, exist_ok=True)
    for number in range(count):
        turn = so3.quat_to_matrix(so3.exp(rng.uniform(-0.5, 0.5, 3)))
        place = np.array([rng.uniform(-0.05, 0.2), rng.uniform(-0.1, 0.1), rng.uniform(0.9, 1.5)]) - turn @ size / 2.0
        for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
            image = render_chessboard(
                camera, rotation @ turn, rotation @ place + translation, COLUMNS, ROWS, SQUARE, seed * 1009 + number
            )
            cv2.imwrite(str(folder / setup.camera_name(camera.frame_id) / f"{number:02d}.png"), image)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``markers render``."""
    parser = commands.add_parser(
        "render",
        help="Render a simulated arm with targets before two cameras.",
        description="Renders images of a simulated person with targets on shoulder, upper arm and forearm before two "
        "infrared cameras, and writes them as a bag, with the true rig.yaml and targets.yaml.",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    parser.add_argument("--setup", type=Path, required=True, metavar="FOLDER", help="where to write the true setup")
    parser.add_argument("--motion", default="slow_down", choices=tuple(MOTIONS), help="default: %(default)s")
    parser.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of images (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=60.0, metavar="HZ", help="images a second (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the person and the noise")
    parser.add_argument("--boards", type=int, default=0, metavar="N", help="also N views of a chessboard, in FOLDER")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT if it is there")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    scene = marker_scene(args.motion, args.seed, args.rate, args.seconds)
    args.setup.mkdir(parents=True, exist_ok=True)
    save_rig(scene.rig, args.setup / setup.RIG)
    save_targets(scene.targets, args.setup / setup.TARGETS)
    write_scene(scene, args.output, Sensor(), args.seed, overwrite=args.overwrite)
    if args.boards:
        write_boards(scene.rig, args.setup / "boards", args.boards, args.seed)
        print(f"boards: {COLUMNS} x {ROWS} inner corners, squares of {SQUARE} m, in {args.setup / 'boards'}")
    print(f"{len(scene.times)} pairs of images, balls of {DIAMETER} m; written to {args.output} and {args.setup}")
    return 0
