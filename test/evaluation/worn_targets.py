"""Simulated people with targets on their segments: bags of an estimate and of the marker system, with known errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.evaluation.hand_eye import Track
from body_tracking.kinematics.conventions import angles_of
from body_tracking.markers import setup
from body_tracking.markers.codecs import PoseOfTarget
from body_tracking.markers.messages import POSE
from body_tracking.markers.observations import TargetPose
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.messages.model import estimate_to_joint_state
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter
from body_tracking.simulation.people import MODEL, Course, Person
from body_tracking.simulation.repertoire import make_movement

SEGMENTS = ("clavicle_left", "upper_arm_left", "forearm_left")
OFFSET, DRIFT = 1.7, 50e-6
"""Of the marker system's clock."""
START_NS = 1_700_000_000 * NANOSECONDS


@dataclass(frozen=True, eq=False)
class Worn:
    """A person with targets.

    Attributes:
        times: (n,) s of the estimate.
        course: of the person at these.
        tracks: of the targets, in the clock of the marker system.
        mountings: (k, 3, 3) true target to segment.
        world: (3, 3) true rig to world.
    """

    times: FloatArray
    course: Course
    tracks: tuple[Track, ...]
    mountings: FloatArray
    world: FloatArray

    def segments(self) -> FloatArray:
        """(n, k, 3, 3) true segments to world."""
        return rotations_of(self.course.q)


def rotations_of(q: FloatArray) -> FloatArray:
    """(n, k, 3, 3) the mounted segments to world."""
    columns = [MODEL.segment_names.index(name) for name in SEGMENTS]
    return MODEL.forward(q, MODEL.default_lengths()).rotations[:, columns]


def correlated_noise(rng: np.random.Generator, shape: tuple[int, ...], seconds: float, rate: float) -> FloatArray:
    """Unit normal noise with an exponential autocorrelation along the first axis."""
    decay = np.exp(-1.0 / (rate * seconds))
    white = rng.normal(size=shape)
    white[1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], white, axis=0))


def worn(
    seed: int, motion: str = "reaching", seconds: float = 40.0, noise_deg: float = 0.15, drift: float = DRIFT
) -> Worn:
    """A person in a movement of the repertoire, with targets whose poses have white noise."""
    rng = np.random.default_rng([seed, 20260101])
    person = Person.draw(rng)
    movement = make_movement(motion, person, rng, seconds)
    seconds = movement.duration
    times = np.arange(0.4, seconds - 0.4, 1.0 / 30.0) + rng.uniform(0.0, 0.01)
    stamps = np.arange(0.0, seconds, 1.0 / 60.0)
    mountings = Rotation.random(len(SEGMENTS), random_state=seed).as_matrix()
    world = Rotation.random(random_state=seed + 10_000).as_matrix()
    true = world.T @ rotations_of(movement.course(stamps).q) @ mountings
    noise = np.radians(noise_deg)
    seen = so3.quat_to_matrix(so3.exp(rng.normal(0.0, noise, true.shape[:-1]))) @ true
    covariance = np.broadcast_to(noise**2 * np.eye(3), (len(stamps), 3, 3))
    clock = stamps + OFFSET + drift * stamps
    tracks = tuple(Track(clock, seen[:, k], covariance) for k in range(len(SEGMENTS)))
    return Worn(times, movement.course(times), tracks, mountings, world)


def write_markers(
    folder: Path, tracks: tuple[Track, ...], angle_deg: float = 0.16, names: tuple[str, ...] = ()
) -> Path:
    """A bag of the marker system: poses of the targets, and an angle with its deviation."""
    angle = f"{graph.joint_states_topic(setup.BODY)}"
    names = names or SEGMENTS
    with BagWriter(folder) as bag:
        for name in names:
            bag.add_topic(setup.pose_topic(name), POSE)
        for suffix in ("", "_stddev"):
            bag.add_topic(angle + suffix, JOINT_STATE)
        for index in range(len(tracks[0].times)):
            stamp_ns = START_NS + round(float(tracks[0].times[index]) * NANOSECONDS)
            for name, track in zip(names, tracks, strict=True):
                covariance = 1e-6 * np.eye(6)
                covariance[3:, 3:] = track.covariances[index]
                unseen = np.empty(0, dtype=np.intp)
                pose = TargetPose(
                    name, stamp_ns, "left", track.rotations[index], np.zeros(3), covariance, unseen, float("nan")
                )
                bag.write(setup.pose_topic(name), PoseOfTarget(name).encode(pose, BAG_WIRE), stamp_ns)
            for suffix, value in (("", 0.5), ("_stddev", np.radians(angle_deg))):
                message = BAG_MESSAGES.make(
                    JOINT_STATE,
                    header=BAG_MESSAGES.make("std_msgs/msg/Header", stamp=_stamp(stamp_ns), frame_id="markers"),
                    name=["elbow_flexion_markers"],
                    position=BAG_MESSAGES.floats(np.array([value])),
                    velocity=BAG_MESSAGES.floats(np.empty(0)),
                    effort=BAG_MESSAGES.floats(np.empty(0)),
                )
                bag.write_message(angle + suffix, message, stamp_ns)
    return folder


def _stamp(stamp_ns: int) -> object:
    return BAG_MESSAGES.make("builtin_interfaces/msg/Time", sec=stamp_ns // NANOSECONDS, nanosec=stamp_ns % NANOSECONDS)


def write_estimate(folder: Path, times: FloatArray, q: FloatArray, stddev_deg: float) -> Path:
    """A bag of an estimate: the states of the model, and its angles in the convention ``model``."""
    angle = graph.joint_states_topic(graph.DEFAULT_BODY)
    nv = MODEL.nv
    covariance = np.radians(stddev_deg) ** 2 * np.eye(2 * nv)
    rates, lengths = np.zeros(nv), MODEL.default_lengths()
    angles = None
    with BagWriter(folder) as bag:
        for topic in (graph.MODEL_STATE, angle, f"{angle}_stddev"):
            bag.add_topic(topic, JOINT_STATE)
        for time, each in zip(times.tolist(), q, strict=True):
            stamp_ns = START_NS + round(time * NANOSECONDS)
            estimate = ModelEstimate(stamp_ns, "world", 0, each, rates, covariance, lengths, np.zeros_like(lengths))
            angles = angles_of(estimate, MODEL, "model", angles)
            bag.write_message(graph.MODEL_STATE, estimate_to_joint_state(estimate, MODEL, BAG_MESSAGES), stamp_ns)
            both = angles_to_joint_states(angles, graph.DEFAULT_BODY, "model", BAG_MESSAGES)
            for topic, message in zip((angle, f"{angle}_stddev"), both, strict=True):
                bag.write_message(topic, message, stamp_ns)
    return folder
