"""``body_tracking make-bags``: the recordings in ``bags/``, two sensors and the truth.

The sensors stand as in the thesis's configuration 4 (figure 5.3): each 45 degrees off the person's front, 2 m away. The
first is the reference: level, 0.9 m above the floor, the origin of ``world`` and of its time.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.calibration.result import ClockModel, SensorPose, level_pose
from body_tracking.errors import BodyTrackingError
from body_tracking.kinematics.positional import positional_angles
from body_tracking.messages import (
    JOINT_STATE,
    POINT_CLOUD,
    TIME_REFERENCE,
    TRANSFORM,
    angles_to_joint_states,
    clock_to_time_reference,
    pose_to_transform,
    skeletons_to_cloud,
)
from body_tracking.recording.qos import LATCHED, RELIABLE, SENSOR_DATA
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter
from body_tracking.sensors import RecordedFrame
from body_tracking.simulation.figure import Figure
from body_tracking.simulation.motions import MOTIONS, Motion
from body_tracking.simulation.sensors import SimulatedSensor
from body_tracking.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState

REFERENCE = "kinect1"
WORLD = "world"
BODY = "body1"
SEED = 20170512
START_NS = 40 * NANOSECONDS
"""What the reference sensor's clock shows at the start."""
RECEIVED_FROM_NS = 1_750_000_000 * NANOSECONDS
"""What the receiver's clock shows at the start."""
SENSOR_HEIGHT, DISTANCE = 0.9, 2.0

_PERSON = np.array([DISTANCE, 0.0, -SENSOR_HEIGHT])
_HEADING = np.radians(180.0 + 45.0)


class SimulationError(BodyTrackingError):
    """A motion of this name is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRecording:
    """What the sensors said and what was true.

    Attributes:
        motion: its name.
        sensors: the true poses and clocks.
        frames: of all sensors, in the order of receipt.
        truth: in ``world``, at the reference sensor's captures and in its clock, with velocities.
    """

    motion: str
    sensors: tuple[SimulatedSensor, ...]
    frames: tuple[RecordedFrame, ...]
    truth: tuple[Skeleton, ...]


def layout() -> tuple[SimulatedSensor, SimulatedSensor]:
    """The two sensors of configuration 4; the second a little higher, not level, 2.7 s behind and 38 ppm fast."""
    reference = SimulatedSensor(level_pose(REFERENCE), ClockModel(anchor_ns=START_NS))
    yaw = np.radians(90.0)
    tilted = Rotation.from_euler("z", yaw) * Rotation.from_quat(
        level_pose("kinect2", pitch=np.radians(2.5), roll=np.radians(-1.0)).quat_xyzw
    )
    place = np.array([DISTANCE, -DISTANCE, 0.06])
    second = SimulatedSensor(
        SensorPose("kinect2", place, tilted.as_quat()),
        ClockModel(offset_ns=-2_718_281_828, drift_ppm=38.0, anchor_ns=START_NS),
        phase=0.0137,
    )
    return reference, second


def true_positions(motion: Motion, times: FloatArray) -> FloatArray:
    """(n, 25, 3) metres in ``world`` at (n,) seconds after the start."""
    turn = Rotation.from_euler("z", _HEADING).as_matrix()
    positions: FloatArray = Figure().positions(motion.pose(times)) @ turn.T + _PERSON
    return positions


def simulate(motion: Motion, seed: int = SEED) -> SimulatedRecording:
    """One recording; the same seed gives the same numbers."""
    sensors = layout()
    frames: list[RecordedFrame] = []
    truth: list[Skeleton] = []
    for number, sensor in enumerate(sensors):
        rng = np.random.default_rng([seed, zlib.crc32(motion.name.encode()), number])
        times = sensor.capture_times(motion.duration, rng)
        positions = true_positions(motion, times)
        frames += sensor.observe(times, positions, START_NS, RECEIVED_FROM_NS, rng)
        if sensor.pose.sensor == REFERENCE:
            truth = list(_truth(motion, times, positions))
    frames.sort(key=lambda frame: (frame.received_ns, frame.sensor))
    return SimulatedRecording(motion.name, sensors, tuple(frames), tuple(truth))


def _truth(motion: Motion, times: FloatArray, positions: FloatArray) -> Iterator[Skeleton]:
    step = 1e-4
    velocities = (true_positions(motion, times + step) - true_positions(motion, times - step)) / (2.0 * step)
    tracked = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
    for time, position, velocity in zip(times, positions, velocities, strict=True):
        stamp_ns = START_NS + round(time * NANOSECONDS)
        yield Skeleton(stamp_ns, WORLD, position, tracked, velocities=velocity)


def write_bag(recording: SimulatedRecording, folder: Path, *, overwrite: bool = False) -> None:
    """Write a recording as a bag.

    Topics: ``/<sensor>/skeleton``; ``/ground_truth/skeleton`` (positions only) and ``/ground_truth/joint_states`` (the
    angles of ``kinematics.positional``), stamped in the reference clock; the true ``/ground_truth/calibration`` (one
    pose per sensor) and ``/ground_truth/calibration/clock`` (the second sensor's clock once a second).

    Raises:
        BagError: the folder exists and is not to be overwritten, or cannot be written.
    """
    with BagWriter(folder, overwrite=overwrite, flush_interval_s=float("inf")) as bag:
        for sensor in recording.sensors:
            bag.add_topic(f"/{sensor.pose.sensor}/skeleton", POINT_CLOUD, SENSOR_DATA)
        bag.add_topic("/ground_truth/skeleton", POINT_CLOUD, SENSOR_DATA)
        bag.add_topic("/ground_truth/joint_states", JOINT_STATE, RELIABLE)
        bag.add_topic("/ground_truth/calibration", TRANSFORM, LATCHED)
        bag.add_topic("/ground_truth/calibration/clock", TIME_REFERENCE, LATCHED)
        for log_ns, topic, message in sorted(_messages(recording), key=lambda item: item[:2]):
            bag.write_message(topic, message, log_ns)


def _messages(recording: SimulatedRecording) -> Iterator[tuple[int, str, object]]:
    """(log time, topic, message) of everything, in no order."""
    for sensor in recording.sensors:
        yield RECEIVED_FROM_NS, "/ground_truth/calibration", pose_to_transform(sensor.pose, WORLD, BAG_MESSAGES)
    for frame in recording.frames:
        cloud = skeletons_to_cloud(frame.skeletons, BAG_MESSAGES)
        yield frame.received_ns, f"/{frame.sensor}/skeleton", cloud
    second = -1
    for truth in recording.truth:
        log_ns = RECEIVED_FROM_NS + truth.stamp_ns - START_NS
        bare = Skeleton(truth.stamp_ns, truth.frame_id, truth.positions, truth.states)
        yield log_ns, "/ground_truth/skeleton", skeletons_to_cloud((bare,), BAG_MESSAGES)
        angles, _ = angles_to_joint_states(positional_angles(truth), BODY, WORLD, BAG_MESSAGES)
        yield log_ns, "/ground_truth/joint_states", angles
        if truth.stamp_ns // NANOSECONDS > second:
            second = truth.stamp_ns // NANOSECONDS
            for sensor in recording.sensors:
                if sensor.pose.sensor != REFERENCE:
                    clock = clock_to_time_reference(sensor.pose.sensor, sensor.clock, truth.stamp_ns, BAG_MESSAGES)
                    yield log_ns, "/ground_truth/calibration/clock", clock


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking make-bags``."""
    parser = subparsers.add_parser(
        "make-bags",
        help="make the simulated recordings that are shipped in bags/",
        description="Simulate two Kinect v2 sensors and a person in three motions, and write a bag of each.",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("bags"), metavar="FOLDER", help="where the bags go (default: bags)"
    )
    parser.add_argument("--seed", type=int, default=SEED, help=f"of all chance (default: {SEED})")
    parser.add_argument("--motion", choices=[motion.name for motion in MOTIONS], help="only this one")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the bags, replacing those that are there."""
    if args.seed < 0:
        raise SimulationError(f"--seed {args.seed}: must not be negative")
    for motion in MOTIONS:
        if args.motion in (None, motion.name):
            folder = args.output / motion.name
            recording = simulate(motion, args.seed)
            write_bag(recording, folder, overwrite=True)
            size = sum(path.stat().st_size for path in folder.iterdir())
            print(f"{folder}: {motion.duration:.1f} s, {len(recording.frames)} frames, {size / 1e6:.2f} MB")
    return 0
