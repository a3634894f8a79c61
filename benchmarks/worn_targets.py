"""Targets of the marker system on a simulated person, as bags: a reference with its own clock and frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.qos import RELIABLE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import PoseOfTarget
from body_tracking.markers.messages import POSE
from body_tracking.markers.observations import TargetPose
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter
from body_tracking.simulation.people import MODEL

ARM = ("clavicle_left", "upper_arm_left", "forearm_left")
_FRAME = "left_optical_frame"
_PLACE_STDDEV = 0.0003
"""Standard deviation of positions, metres; positions are not used."""
_ANGLE_STDDEV = float(np.radians(0.16))
"""Standard deviation that the marker system states for its angle, radians."""


@dataclass(frozen=True, slots=True, eq=False)
class WornTargets:
    """Measurements by the marker system of targets on segments.

    Attributes:
        segments: k names, each with a target.
        times: (n,) s on the marker system's clock.
        rotations: (n, k, 3, 3) targets to rig, with noise.
        stddev: of the noise, radians per axis.
        mountings: (k, 3, 3) true target to segment.
        world: (3, 3) true rig to world.
    """

    segments: tuple[str, ...]
    times: FloatArray
    rotations: FloatArray
    stddev: float
    mountings: FloatArray
    world: FloatArray

    def until(self, seconds: float) -> WornTargets:
        """The measurements of the first seconds."""
        count = int(np.searchsorted(self.times, self.times[0] + seconds))
        return replace(self, times=self.times[:count], rotations=self.rotations[:count])

    @property
    def covariances(self) -> FloatArray:
        """(n, 3, 3) covariances of a target, square radians."""
        return np.broadcast_to(self.stddev**2 * np.eye(3), (len(self.times), 3, 3))


def segment_rotations(q: FloatArray, segments: Sequence[str]) -> FloatArray:
    """(n, k, 3, 3) true rotations from segments to world, for (n, 35) configurations."""
    columns = [MODEL.segment_names.index(name) for name in segments]
    rotations: FloatArray = MODEL.forward(q, MODEL.default_lengths()).rotations[:, columns]
    return rotations


def wear_targets(
    times: FloatArray,
    q: FloatArray,
    rng: np.random.Generator,
    *,
    segments: tuple[str, ...] = ARM,
    stddev: float = np.radians(0.15),
    offset: float = 0.0,
    drift: float = 0.0,
) -> WornTargets:
    """Targets with random mountings in front of a rig with a random orientation.

    Args:
        times: (n,) s on the world's clock.
        q: (n, 35) configurations of the person.
        rng: draws mountings, rig and noise.
        segments: with a target each.
        stddev: white noise of each pose, radians per axis.
        offset: s, the marker system's clock minus the world's at time 0.
        drift: relative drift of this offset.
    """
    mountings = Rotation.random(len(segments), random_state=rng).as_matrix()
    world = Rotation.random(random_state=rng).as_matrix()
    true = world.T @ segment_rotations(q, segments) @ mountings
    noise = so3.quat_to_matrix(so3.exp(rng.normal(0.0, stddev, true.shape[:-1])))
    return WornTargets(segments, times + offset + drift * times, noise @ true, stddev, mountings, world)


def write_targets(
    worn: WornTargets,
    folder: Path,
    start_ns: int,
    *,
    names: Sequence[str] | None = None,
) -> None:
    """Write poses of the targets, and an angle with its standard deviation, as the marker system's nodes do.

    Args:
        worn: the targets.
        folder: of the bag.
        start_ns: stamp of time 0.
        names: of the targets; None for those of their segments.

    Raises:
        BagError: the folder exists, or cannot be written.
    """
    names = worn.segments if names is None else names
    angle = graph.joint_states_topic(setup.BODY)
    covariance = np.diag([_PLACE_STDDEV**2] * 3 + [max(worn.stddev, 1e-5) ** 2] * 3)
    unseen, unknown = np.empty(0, dtype=np.intp), np.full(1, np.nan)
    with BagWriter(folder, flush_interval_s=float("inf")) as bag:
        for name in names:
            bag.add_topic(setup.pose_topic(name), POSE, RELIABLE)
        for suffix in ("", "_stddev"):
            bag.add_topic(f"{angle}{suffix}", JOINT_STATE, RELIABLE)
        for time, rotations in zip(worn.times.tolist(), worn.rotations, strict=True):
            stamp_ns = start_ns + round(time * NANOSECONDS)
            for name, rotation in zip(names, rotations, strict=True):
                pose = TargetPose(name, stamp_ns, _FRAME, rotation, np.zeros(3), covariance, unseen, float("nan"))
                bag.write(setup.pose_topic(name), PoseOfTarget(name).encode(pose, BAG_WIRE), stamp_ns)
            turn = so3.rotation_vectors(rotations[-2].T @ rotations[-1])
            stated = JointAngles(stamp_ns, ("elbow_x",), turn[:1], unknown, np.array([_ANGLE_STDDEV]), unknown)
            both = angles_to_joint_states(stated, setup.BODY, "markers", BAG_MESSAGES)
            for suffix, message in zip(("", "_stddev"), both, strict=True):
                bag.write_message(f"{angle}{suffix}", message, stamp_ns)
