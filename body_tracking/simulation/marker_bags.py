"""``body_tracking markers render``: images of a simulated arm with targets as a bag, and the setup to track them.

Also writes the shipped recording of images, ``bags/markers_arm``, and its setup, ``config/marker_setup``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from body_tracking.core import so3
from body_tracking.core.files import check_new
from body_tracking.core.message_types import IMAGE, JOINT_STATE
from body_tracking.core.qos import LATCHED, RELIABLE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.boards import Chessboard, Image
from body_tracking.markers.camera_calibration import calibrate_cameras, find_boards
from body_tracking.markers.chain import JointDescription
from body_tracking.markers.chain_files import save_chain
from body_tracking.markers.codecs import CameraImage
from body_tracking.markers.rendering import RenderingError, Sensor, render, render_chessboard
from body_tracking.markers.rig import Rig
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.targets_file import save_targets
from body_tracking.messages.base import to_header
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.marker_commands import fit_recording
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter, check_new_bag
from body_tracking.simulation.marker_scene import DIAMETER, JOINTS, MarkerScene, marker_scene, stereo_rig
from body_tracking.simulation.messages import print_bag
from body_tracking.simulation.repertoire import MOTIONS

START_NS = 1_750_000_000 * NANOSECONDS
TRUE_ANGLES = graph.true_angles_topic(setup.BODY)
COLUMNS, ROWS, SQUARE = 9, 6, 0.04
"""Chessboard: inner corners per row and column, and width of a square, metres."""
WAND: Final = (0.0, 0.1, 0.3)
"""Positions of the balls along the wand, metres."""
SHIPPED: Final = "markers_arm"
"""The recording of images in ``bags/``."""
DARK: Final = Sensor(background=0.0, read_noise=0.0008)
"""The sensor of the shipped images: 62 dB from read noise to saturation, as in data sheets of global shutter sensors,
and a filter that passes only the balls' light. Most dark pixels are then 0, and the images compress to a thirtieth;
with the noise of :class:`Sensor` itself they compress to a fifth."""
SEED, _MOTION = 10, "random"
"""A motion that turns all joints about all their axes, with no angle near a singularity."""
_RATE, FIT_RATE = 30.0, 15.0
_START, _SECONDS, FIT_SECONDS = 15.0, 5.0, 14.0
"""Seconds: the joints are fitted to the beginning of the motion, the recording is a later part."""
_BOARDS: Final = 16


def write_scene(scene: MarkerScene, output: Path, sensor: Sensor, seed: int, *, overwrite: bool = False) -> None:
    """Write images, calibrations and the true angles of the scene's chain.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    frames = [camera.frame_id for camera in scene.rig.cameras]
    with BagWriter(output, overwrite=overwrite, flush_interval_s=float("inf")) as bag:
        for camera in scene.rig.cameras:
            bag.add_topic(setup.image_topic(camera.frame_id), IMAGE, RELIABLE)
            bag.add_topic(setup.info_topic(camera.frame_id), CAMERA_INFO, LATCHED)
            bag.write(setup.info_topic(camera.frame_id), CameraInfo().encode((START_NS, camera), BAG_WIRE), START_NS)
        bag.add_topic(TRUE_ANGLES, JOINT_STATE, RELIABLE)
        progress = Progress(0, len(scene.times))
        angles = scene.angles()
        for index, time in enumerate(scene.times - scene.times[0]):
            stamp_ns = START_NS + round(float(time) * NANOSECONDS)
            for camera, image in zip(scene.rig.cameras, images(scene, index, sensor, seed), strict=True):
                message = CameraImage().encode((stamp_ns, camera.frame_id, image), BAG_WIRE)
                bag.write(setup.image_topic(camera.frame_id), message, stamp_ns)
            bag.write(TRUE_ANGLES, _angles(stamp_ns, frames[0], scene.chain.angle_names, angles[index]), stamp_ns)
            progress.at(index)
        progress.end()


def images(scene: MarkerScene, index: int, sensor: Sensor, seed: int) -> list[Image]:
    """The image of each camera at one time; balls move during the exposure."""
    near = slice(max(index - 1, 0), index + 2)
    velocity = np.gradient(scene.translations[near], scene.times[near], axis=0)[index - near.start]
    speeds = np.repeat(velocity, [len(target.points) for target in scene.targets], axis=0)
    return [
        render(
            camera,
            rotation,
            translation,
            scene.balls(index),
            DIAMETER,
            sensor,
            seed * 100_003 + index,
            velocities=speeds,
        ).image
        for camera, rotation, translation in zip(
            scene.rig.cameras, scene.rig.rotations, scene.rig.translations, strict=True
        )
    ]


class RenderedImages:
    """The images of the shipped recording's motion, rendered on first request (0.2 s per pair) and cached.

    Args:
        frames: of a rig's cameras.

    Raises:
        RenderingError: the frames are not those of the scene.
    """

    unpaired = 0

    def __init__(self, frames: Sequence[str]) -> None:
        self._scene: MarkerScene | None = None
        self._made: dict[int, list[Image]] = {}
        own = [camera.frame_id for camera in stereo_rig().cameras]
        if list(frames) != own:
            raise RenderingError(f"the simulated scene has the cameras {', '.join(own)}, not {', '.join(frames)}")

    def __len__(self) -> int:
        return round(_RATE * _SECONDS)

    def images(self, index: int) -> list[Image]:
        """The image of each camera."""
        self._scene = self._scene or shipped_scene()
        if index not in self._made:
            self._made[index] = images(self._scene, index, DARK, SEED)
        return self._made[index]


def _angles(stamp_ns: int, frame_id: str, names: tuple[str, ...], angles: FloatArray) -> bytes:
    message = BAG_MESSAGES.make(
        JOINT_STATE,
        header=to_header(stamp_ns, frame_id, BAG_MESSAGES),
        name=list(names),
        position=BAG_MESSAGES.floats(angles),
        velocity=BAG_MESSAGES.floats(np.empty(0)),
        effort=BAG_MESSAGES.floats(np.empty(0)),
    )
    return BAG_WIRE.serialize(JOINT_STATE, message)


def board_images(rig: Rig, count: int, seed: int, sensor: Sensor | None = None) -> Iterator[list[Image]]:
    """Images, one per camera, of a chessboard in ``count`` poses in front of the rig."""
    rng = np.random.default_rng([seed, 1999])
    size = np.array([(COLUMNS - 1) * SQUARE, (ROWS - 1) * SQUARE, 0.0])
    for number in range(count):
        turn = so3.quat_to_matrix(so3.exp(rng.uniform(-0.5, 0.5, 3)))
        place = np.array([rng.uniform(-0.05, 0.2), rng.uniform(-0.1, 0.1), rng.uniform(0.9, 1.5)]) - turn @ size / 2.0
        yield [
            render_chessboard(
                camera,
                rotation @ turn,
                rotation @ place + translation,
                COLUMNS,
                ROWS,
                SQUARE,
                seed * 1009 + number,
                sensor,
            )
            for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True)
        ]


def write_boards(rig: Rig, folder: Path, count: int, seed: int) -> None:
    """Write images of a chessboard in ``count`` poses in front of the rig, one folder per camera."""
    names = [setup.camera_name(camera.frame_id) for camera in rig.cameras]
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number, images in enumerate(board_images(rig, count, seed)):
        for name, image in zip(names, images, strict=True):
            cv2.imwrite(str(folder / name / f"{number:02d}.png"), image)


def wand_places(count: int, seed: int) -> FloatArray:
    """(n, 3, 3) balls of a wand in ``count`` poses in front of the rig, metres in its frame."""
    rng = np.random.default_rng([seed, 450])
    middle = rng.uniform([0.0, -0.2, 0.9], [0.2, 0.2, 1.5], (count, 3))
    along = rng.normal(0.0, [1.0, 1.0, 0.5], (count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return middle[:, None] + (np.array(WAND) - 0.5 * WAND[-1])[:, None] * along[:, None]


def write_wand(rig: Rig, output: Path, count: int, seed: int, *, overwrite: bool = False) -> None:
    """Write a recording of images of a wand in ``count`` poses in front of the rig.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    with BagWriter(output, overwrite=overwrite, flush_interval_s=float("inf")) as bag:
        for camera in rig.cameras:
            bag.add_topic(setup.image_topic(camera.frame_id), IMAGE, RELIABLE)
        for number, balls in enumerate(wand_places(count, seed)):
            stamp_ns = START_NS + number * NANOSECONDS // 10
            for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True):
                image = render(camera, rotation, translation, balls, DIAMETER, Sensor(), seed * 1013 + number).image
                message = CameraImage().encode((stamp_ns, camera.frame_id, image), BAG_WIRE)
                bag.write(setup.image_topic(camera.frame_id), message, stamp_ns)


def shipped_scene() -> MarkerScene:
    """The scene of the shipped recording."""
    return marker_scene(_MOTION, SEED, _RATE, _SECONDS, _START)


def make_shipped(bags: Path, folder: Path) -> None:
    """Write the shipped recording of images, and the setup to track it, as a laboratory would make it.

    The cameras are calibrated from rendered boards, the targets' geometry is given as by a drawing, and the joints are
    fitted to rendered images of an earlier part of the motion.

    Args:
        bags: folder of the recording :data:`SHIPPED`, which is replaced.
        folder: of the setup, whose files are replaced.

    Raises:
        BagError: the recording cannot be written.
    """
    scene = shipped_scene()
    write_scene(scene, bags / SHIPPED, DARK, SEED, overwrite=True)
    make_setup(marker_scene(_MOTION, SEED, FIT_RATE, FIT_SECONDS, 0.0), folder, SEED)
    print_bag(bags / SHIPPED, f"{len(scene.times)} pairs of images, setup in {folder}")


def make_setup(scene: MarkerScene, folder: Path, seed: int, joints: Sequence[JointDescription] = JOINTS) -> None:
    """Calibrate the cameras of a scene from rendered boards, and fit the joints to its motion.

    Args:
        scene: all joints move; the targets' geometry is known.
        folder: of the setup, whose files are replaced.
        seed: of the boards and of the images' noise.
        joints: between the targets.
    """
    folder.mkdir(parents=True, exist_ok=True)
    series = list(zip(*board_images(scene.rig, _BOARDS, seed, DARK), strict=True))
    frames = [camera.frame_id for camera in scene.rig.cameras]
    sizes = [(camera.width, camera.height) for camera in scene.rig.cameras]
    found = calibrate_cameras(frames, sizes, find_boards(Chessboard(COLUMNS, ROWS, SQUARE), series))
    save_rig(found.rig, folder / setup.RIG)
    save_targets(scene.targets, folder / setup.TARGETS)
    with tempfile.TemporaryDirectory() as temporary:
        motion = Path(temporary) / "motion"
        write_scene(scene, motion, DARK, seed + 1)
        save_chain(fit_recording(motion, folder, joints, DIAMETER).chain, folder / setup.CHAIN)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``markers render``."""
    parser = commands.add_parser(
        "render",
        help="render a simulated arm with targets before two cameras",
        description="Renders images of a simulated person with targets on shoulder, upper arm and forearm before two "
        "infrared cameras, and writes them as a bag, with the true rig.yaml and targets.yaml.",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    parser.add_argument("--setup", type=Path, required=True, metavar="FOLDER", help="where to write the true setup")
    text = f"default: %(default)s; one of {', '.join(MOTIONS)}"
    parser.add_argument("--motion", default="slow_down", choices=tuple(MOTIONS), metavar="NAME", help=text)
    parser.add_argument("--seconds", type=float, default=4.0, metavar="S", help="of images (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=60.0, metavar="HZ", help="images a second (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the person and the noise")
    parser.add_argument("--boards", type=int, default=0, metavar="N", help="also N views of a chessboard, in FOLDER")
    parser.add_argument("--wand", type=int, default=0, metavar="N", help="also N places of a wand, as FOLDER/wand")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT and setup")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    for bag in (args.output, *([args.setup / "wand"] if args.wand else [])):
        check_new_bag(bag, overwrite=args.overwrite)
    for name in (setup.RIG, setup.TARGETS):
        check_new(args.setup / name, overwrite=args.overwrite)
    scene = marker_scene(args.motion, args.seed, args.rate, args.seconds)
    args.setup.mkdir(parents=True, exist_ok=True)
    save_rig(scene.rig, args.setup / setup.RIG)
    save_targets(scene.targets, args.setup / setup.TARGETS)
    write_scene(scene, args.output, Sensor(), args.seed, overwrite=args.overwrite)
    if args.boards:
        write_boards(scene.rig, args.setup / "boards", args.boards, args.seed)
        print(f"boards: {COLUMNS} x {ROWS} inner corners, squares of {SQUARE} m, in {args.setup / 'boards'}")
    if args.wand:
        write_wand(scene.rig, args.setup / "wand", args.wand, args.seed, overwrite=args.overwrite)
        print(f"wand: balls at {', '.join(map(str, WAND))} m, in {args.setup / 'wand'}")
    print(f"{len(scene.times)} pairs of images, balls of {DIAMETER} m; written to {args.output} and {args.setup}")
    return 0
