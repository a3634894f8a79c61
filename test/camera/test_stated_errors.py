"""Sensors whose joints have independent errors as stated: the deviations of the filtered angles are right."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinematics.positional import ANGLE_NAMES, BONE_CORRELATION, positional_angles
from body_tracking.messages.cdr import decode_skeletons, encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import BAG_WIRE
from body_tracking.simulation.layouts import layout
from body_tracking.simulation.scene import Setup, SimulatedRecording, simulate
from body_tracking.systems import STAGES, stage_class

ACROSS, ALONG = 0.043, 0.03
"""Metres: standard deviations across the line of sight, as published for a network, and along it."""
TIME_CONSTANT = 0.5
"""Seconds: correlation time of half the variance; the other half is constant."""
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


def filtered(recording: SimulatedRecording, seed: int) -> list[Skeleton]:
    """The output of the default filter."""
    frames = sorted(cameras(recording, np.random.default_rng(seed)), key=lambda frame: frame.received_ns)
    names = tuple(sorted(sensor.pose.sensor for sensor in recording.sensors))
    found: list[Skeleton] = []

    def take(topic: str, cdr: bytes, _at_ns: int) -> None:
        if topic == graph.FILTERED:
            found.extend(decode_skeletons(cdr))

    values = ReplaySettings(names, parameters={"skeleton_filter": {"not_kinects": names}}).values()
    stages = [stage_class(name)(values[name]) for name in STAGES if name in values]
    whole = OfflineRunner(stages, BAG_WIRE, take)
    whole.start(frames[0].received_ns)
    for frame in frames:
        whole.push(graph.skeleton_topic(frame.sensor), encode_skeletons(frame.skeletons), frame.received_ns)
    whole.finish(frames[-1].received_ns)
    return found


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
    """With the correlation of a Kinect's joints, the bands of the elbows would cover two thirds of the frames."""
    names = [f"{name}_{side}" for name in ("elbow_flexion", "shoulder_elevation") for side in ("left", "right")]
    angles = [ANGLE_NAMES.index(name) for name in names]
    people = [simulate(Setup("reaching", layout(4), seed=900 + seed)) for seed in range(4)]
    runs = [(person, filtered(person, seed)) for seed, person in enumerate(people)]
    shares = np.mean([covered(*run, 0.0, angles) for run in runs], axis=0)
    assert (shares > 0.88).all(), dict(zip(names, shares, strict=True))
    assert np.mean([covered(*run, BONE_CORRELATION, angles[:2]) for run in runs]) < 0.7
