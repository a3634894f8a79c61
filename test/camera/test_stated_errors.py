"""Sensors whose joints have independent errors as stated: the deviations of the filtered angles are right."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.parameters import Value
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, IntArray, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinematics.positional import ANGLE_NAMES, BONE_CORRELATION, positional_angles
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.cdr import decode_skeletons, encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import BAG_WIRE, deserialize
from body_tracking.simulation.layouts import layout
from body_tracking.simulation.scene import Setup, SimulatedRecording, simulate

ACROSS, ALONG = 0.043, 0.03
"""Metres: standard deviations across the line of sight, as published for a network, and along it."""
TIME_CONSTANT = 0.5
"""Seconds: correlation time of half the variance; the other half is constant."""
NAMES = [f"{name}_{side}" for name in ("elbow_flexion", "shoulder_elevation") for side in ("left", "right")]
Take = Callable[[str, bytes, int], None]
TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, np.uint8)


def cameras(recording: SimulatedRecording, rng: np.random.Generator) -> Iterator[RecordedFrame]:
    """15 frames a second of cameras in the place of the recording's sensors."""
    truth = recording.truths[0]
    for sensor in recording.sensors:
        constant, slow, last_ns = rng.normal(size=(N_JOINTS, 3)), rng.normal(size=(N_JOINTS, 3)), None
        for frame in [each for each in recording.frames if each.sensor == sensor.pose.sensor][::2]:
            at_ns = sensor.clock.to_reference(frame.skeletons[0].stamp_ns)
            true = np.empty((N_JOINTS, 3))
            for joint in range(N_JOINTS):
                for axis in range(3):
                    true[joint, axis] = np.interp(at_ns, truth.stamps_ns, truth.positions[:, joint, axis])
            kept = 0.0 if last_ns is None else np.exp(-(at_ns - last_ns) / NANOSECONDS / TIME_CONSTANT)
            slow, last_ns = kept * slow + np.sqrt(1.0 - kept**2) * rng.normal(size=slow.shape), at_ns
            places = (true - sensor.pose.translation) @ sensor.pose.rotation
            sight = places / np.linalg.norm(places, axis=1, keepdims=True)
            outer = sight[:, :, None] * sight[:, None, :]
            covariances = ACROSS**2 * (np.eye(3) - outer) + ALONG**2 * outer
            errors = np.einsum("jab,jb->ja", np.linalg.cholesky(covariances), np.sqrt(0.5) * (constant + slow))
            skeleton = replace(frame.skeletons[0], positions=places + errors, covariances=covariances, states=TRACKED)
            yield replace(frame, skeletons=(skeleton,))


def played(recording: SimulatedRecording, seed: int, filter_parameters: dict[str, Value], take: Take) -> None:
    """Give all outputs of the graph to ``take``, with topic and time."""
    frames = sorted(cameras(recording, np.random.default_rng(seed)), key=lambda frame: frame.received_ns)
    names = tuple(sorted(sensor.pose.sensor for sensor in recording.sensors))
    given = {"skeleton_filter": {"not_kinects": names, **filter_parameters}, "joint_angles": {"convention": "isb"}}
    stages = [each.make() for each in ReplaySettings(names, parameters=given).stages()]
    whole = OfflineRunner(stages, BAG_WIRE, take)
    whole.start(frames[0].received_ns)
    for frame in frames:
        whole.push(graph.skeleton_topic(frame.sensor), encode_skeletons(frame.skeletons), frame.received_ns)
    whole.finish(frames[-1].received_ns)


def filtered(recording: SimulatedRecording, seed: int) -> list[Skeleton]:
    """The output of the default filter."""
    found: list[Skeleton] = []

    def take(topic: str, cdr: bytes, _at_ns: int) -> None:
        if topic == graph.FILTERED:
            found.extend(decode_skeletons(cdr))

    played(recording, seed, {}, take)
    return found


def angles_by_ekf(recording: SimulatedRecording, seed: int, of_bones: float) -> tuple[FloatArray, FloatArray, IntArray]:
    """(n, 4) angles ``NAMES`` of the extended filter, (n, 4) their stated deviations, radians, and (n,) stamps."""
    topics = graph.joint_states_topic(graph.DEFAULT_BODY), graph.joint_states_stddev_topic(graph.DEFAULT_BODY)
    found: dict[str, dict[int, list[float]]] = {topic: {} for topic in topics}

    def take(topic: str, cdr: bytes, _at_ns: int) -> None:
        if topic in found:
            message = deserialize(JOINT_STATE, cdr)
            names = [name.removesuffix(f"_{graph.DEFAULT_BODY}") for name in message.name]
            values = [message.position[names.index(name)] for name in NAMES]
            found[topic][to_nanoseconds(message.header.stamp)] = values

    played(recording, seed, {"filter": "ekf", "ekf.bone_correlation": of_bones}, take)
    stamps = sorted(found[topics[0]].keys() & found[topics[1]].keys())
    angles, stddev = (np.array([found[topic][stamp] for stamp in stamps]) for topic in topics)
    return angles, stddev, np.array(stamps)


def covered(recording: SimulatedRecording, skeletons: list[Skeleton], of_bones: float, angles: list[int]) -> FloatArray:
    """Share of the instants in which each angle is within 1.96 stated deviations of the truth."""
    truth, inside = recording.truths[0], []
    for skeleton in skeletons:
        instant = int(np.abs(truth.stamps_ns - skeleton.stamp_ns).argmin())
        right = positional_angles(truth.skeleton(instant)).position[angles]
        found = positional_angles(skeleton, of_bones)
        off = np.abs(np.remainder(found.position[angles] - right + np.pi, 2.0 * np.pi) - np.pi)
        inside.append(off < 1.96 * found.position_stddev[angles])
    return np.asarray(np.mean(inside, axis=0))


@pytest.mark.slow
def test_bands_of_elbows_and_elevations_hold_for_independent_errors_of_joints() -> None:
    """With the correlation of a Kinect's joints, the bands of the elbows would cover far less of the frames."""
    angles = [ANGLE_NAMES.index(name) for name in NAMES]
    people = [simulate(Setup("reaching", layout(4), seed=900 + seed)) for seed in range(4)]
    runs = [(person, filtered(person, seed)) for seed, person in enumerate(people)]
    shares = np.mean([covered(*run, 0.0, angles) for run in runs], axis=0)
    assert (shares > 0.88).all(), dict(zip(NAMES, shares, strict=True))
    assert np.mean([covered(*run, BONE_CORRELATION, angles[:2]) for run in runs]) < shares[:2].mean() - 0.15


@pytest.mark.slow
def test_bands_of_the_extended_filter_hold_for_independent_errors_of_joints() -> None:
    """The published angles; with the correlation of a Kinect's joints the bands are narrower."""
    angles = [ANGLE_NAMES.index(name) for name in NAMES]
    shares: dict[float, list[FloatArray]] = {0.0: [], BONE_CORRELATION: []}
    for seed in range(4):
        person = simulate(Setup("reaching", layout(4), seed=900 + seed))
        truth = person.truths[0]
        for of_bones, each in shares.items():
            found, stddev, stamps = angles_by_ekf(person, seed, of_bones)
            instants = [int(np.abs(truth.stamps_ns - stamp).argmin()) for stamp in stamps]
            right = np.array([positional_angles(truth.skeleton(instant)).position[angles] for instant in instants])
            found[:, 2:] = np.abs(found[:, 2:])  # elevations by ISB are negative
            each.append((np.abs(found - right) < 1.96 * stddev).mean(axis=0))
    independent, correlated = (np.mean(each, axis=0) for each in shares.values())
    assert (independent > 0.88).all(), dict(zip(NAMES, independent, strict=True))
    assert (correlated < independent).all(), dict(zip(NAMES, correlated, strict=True))
