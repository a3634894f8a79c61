"""``body_tracking simulate baseline``: recordings for the thesis's baseline tests, with ground truth.

Trials of a robot arm with red balls before a colour-and-depth camera, and pendulums of several lengths before an
infrared and depth camera (Schlagenhauf 2017, section 4.1). Frames are lost, and the times of capture are irregular.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.topics import BALLS, COMPRESSED, DRIVERS, info_beside, infrared_topic
from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, POSE_ARRAY
from body_tracking.core.qos import LATCHED, RELIABLE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.sources import optical_frame
from body_tracking.markers.codecs import CameraImage
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.topics import IMAGES
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.codecs import CameraInfo
from body_tracking.messages.points import points_to_pose_array
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter, serialize
from body_tracking.simulation.baseline_scenes import ArmScene, PendulumScene
from body_tracking.simulation.messages import IMAGE_CHUNK_BYTES, print_bag

CAMERA: Final = "camera1"
START_NS: Final = 1_750_000_000 * NANOSECONDS
"""ROS time of time 0; camera and robot stamp by it."""
LENGTHS: Final = (0.25, 0.4, 0.55, 0.75, 1.0)
"""Lengths of the five pendulums, metres."""
DELAY: Final = 0.04
"""Default delay of the camera's stamps against the robot's, seconds."""
_RATE: Final = 30.0
_ROBOT_RATE: Final = 100.0
_LOST: Final = 0.1
"""Share of lost images."""
_JITTER: Final = 0.01
"""Standard deviation of the capture times about an even rate, seconds."""
_DELAY_NS: Final = 30_000_000
"""Least time from the capture of an image to its receipt."""
_LEAD: Final = 0.8
"""Longest recording before the robot's motion begins, seconds."""


class BaselineError(BodyTrackingError):
    """Raised for arguments of a recording that cannot be simulated."""


def capture_times(seconds: float, rng: np.random.Generator, rate: float = _RATE) -> FloatArray:
    """(n,) s, increasing, from 0 to ``seconds``: irregular, with lost frames."""
    even = np.arange(round(seconds * rate)) / rate
    times = even + rng.normal(0.0, _JITTER, len(even))
    kept = np.sort(times[(rng.random(len(even)) >= _LOST) & (times >= 0.0)])
    return np.asarray(kept[np.diff(kept, prepend=-1.0) > 1e-3])


def write_arm(
    scene: ArmScene, folder: Path, delay: float = DELAY, *, rate: float = _RATE, overwrite: bool = False
) -> None:
    """Write one trial as a bag: colour and depth images, calibrations, and the robot's balls.

    Args:
        scene: of the trial; its seed also determines the capture times.
        folder: the bag.
        delay: s by which the camera's stamps lag the robot's.
        rate: images per second.
        overwrite: replace an existing bag.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    rng = np.random.default_rng([scene.seed, 61])
    lead = rng.uniform(0.0, _LEAD)
    names = DRIVERS["plain"].of(scene.camera)
    topics = {
        names.colour + COMPRESSED: (COMPRESSED_IMAGE, IMAGES),
        names.colour_info: (CAMERA_INFO, LATCHED),
        names.depth: (IMAGE, IMAGES),
        names.depth_info: (CAMERA_INFO, LATCHED),
        BALLS: (POSE_ARRAY, RELIABLE),
    }
    seconds = scene.seconds + lead
    robot = np.arange(round((seconds + 1.0) * _ROBOT_RATE)) / _ROBOT_RATE - 0.5
    with BagWriter(folder, overwrite=overwrite, chunk_bytes=IMAGE_CHUNK_BYTES, flush_interval_s=float("inf")) as bag:
        for topic, (kind, qos) in topics.items():
            bag.add_topic(topic, kind, qos)
        _write_info(bag, names.colour_info, scene.colour)
        _write_info(bag, names.depth_info, scene.depth)
        for time, balls in zip(robot, scene.balls(robot - lead), strict=True):
            stamp_ns = START_NS + round(float(time) * NANOSECONDS)
            message = points_to_pose_array(balls, stamp_ns, "robot_base", BAG_MESSAGES)
            bag.write(BALLS, serialize(message), _received(stamp_ns))
        times = capture_times(seconds, rng, rate)
        progress = Progress(0, len(times))
        for number, time in enumerate(times.tolist()):
            colour, depth = scene.images(time - lead, number)
            stamp_ns = START_NS + round((time + delay) * NANOSECONDS)
            frame = optical_frame(scene.camera)
            bag.write(
                names.colour + COMPRESSED,
                CompressedColour().encode((stamp_ns, frame, colour), BAG_WIRE),
                _received(stamp_ns),
            )
            bag.write(names.depth, DepthImage().encode((stamp_ns, frame, depth), BAG_WIRE), _received(stamp_ns))
            progress.at(number)
        progress.end()


def write_pendulum(scene: PendulumScene, folder: Path, seconds: float, *, overwrite: bool = False) -> None:
    """Write a pendulum's swing as a bag: infrared and depth images with their calibration.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    rng = np.random.default_rng([scene.seed, 62])
    infrared, depth = infrared_topic(CAMERA), DRIVERS["plain"].of(CAMERA).depth
    own = replace(scene.camera, frame_id=optical_frame(CAMERA))
    with BagWriter(folder, overwrite=overwrite, chunk_bytes=IMAGE_CHUNK_BYTES, flush_interval_s=float("inf")) as bag:
        for topic in (infrared, depth):
            bag.add_topic(topic, IMAGE, IMAGES)
        bag.add_topic(info_beside(infrared), CAMERA_INFO, LATCHED)
        _write_info(bag, info_beside(infrared), own)
        times = capture_times(seconds, rng)
        # the receipt is delayed by the computer's load; the stamps are capture times
        late = rng.exponential(0.005, len(times))
        progress = Progress(0, len(times))
        for number, (time, ball) in enumerate(zip(times.tolist(), scene.balls(times), strict=True)):
            light, distances = scene.images(ball, number)
            stamp_ns = START_NS + round(time * NANOSECONDS)
            log_ns = _received(stamp_ns) + round(late[number] * NANOSECONDS)
            bag.write(infrared, CameraImage().encode((stamp_ns, own.frame_id, light), BAG_WIRE), log_ns)
            bag.write(depth, DepthImage().encode((stamp_ns, own.frame_id, distances), BAG_WIRE), log_ns)
            progress.at(number)
        progress.end()


def _write_info(bag: BagWriter, topic: str, camera: Camera) -> None:
    bag.write(topic, CameraInfo().encode((START_NS, camera), BAG_WIRE), START_NS)


def _received(stamp_ns: int) -> int:
    return stamp_ns + _DELAY_NS


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking simulate baseline``."""
    command = subparsers.add_parser("simulate baseline", description=__doc__.partition("\n\n")[2])
    tests = command.add_subparsers(metavar="TEST", required=True)
    text = "trials of a robot arm with three red balls: colour and depth images"
    arm = tests.add_parser("arm", help=text, description=text)
    arm.add_argument("--trials", type=int, default=3, metavar="N", help="of one motion (default: %(default)s)")
    arm.add_argument(
        "--delay",
        type=float,
        default=DELAY,
        metavar="S",
        help="by which the camera's stamps follow the robot's (default: %(default)s)",
    )
    arm.set_defaults(run=_arm)
    text = "pendulums with a retro-reflective ball: infrared and depth images"
    pendulum = tests.add_parser("pendulum", help=text, description=text)
    pendulum.add_argument(
        "--lengths",
        default=",".join(map(str, LENGTHS)),
        metavar="A,B",
        help="of the pendulums, metres (default: %(default)s)",
    )
    pendulum.add_argument("--seconds", type=float, default=20.0, metavar="S", help="default: %(default)s")
    pendulum.set_defaults(run=_pendulum)
    for parser in (arm, pendulum):
        parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="a bag for each in it")
        parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the errors (default: %(default)s)")
        parser.add_argument("--overwrite", action="store_true", help="replace bags that are there")


def _arm(args: argparse.Namespace) -> int:
    if not (1 <= args.trials <= 20 and abs(args.delay) <= 0.5):
        raise BaselineError(f"--trials {args.trials}, --delay {args.delay}: expected 1 to 20 trials, at most 0.5 s")
    for number in range(args.trials):
        folder = args.output / f"trial{number + 1}"
        scene = ArmScene(seed=args.seed * 1000 + number)
        write_arm(scene, folder, args.delay, overwrite=args.overwrite)
        print_bag(folder, f"{scene.seconds:.1f} s of motion, stamps {1e3 * args.delay:.0f} ms late")
    return 0


def _pendulum(args: argparse.Namespace) -> int:
    try:
        lengths = [float(each) for each in args.lengths.split(",")]
    except ValueError:
        raise BaselineError(f"--lengths {args.lengths}: expected metres, separated by commas") from None
    if not all(0.05 <= length <= 1.5 for length in lengths) or not 1.0 <= args.seconds <= 600.0:
        raise BaselineError(
            f"--lengths {args.lengths}, --seconds {args.seconds}: expected 0.05 to 1.5 m, so that the ball stays in "
            "the image, and 1 to 600 s"
        )
    for number, length in enumerate(lengths):
        folder = args.output / f"length_{length:g}"
        write_pendulum(
            PendulumScene(length, seed=args.seed * 1000 + number), folder, args.seconds, overwrite=args.overwrite
        )
        print_bag(folder, f"{args.seconds:g} s of a pendulum of {length:g} m")
    return 0
