"""The 25 Kinect v2 joints, their tracking states, and one body seen at one instant.

The one place for the joint list: every other part indexes joints through :class:`Joint`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from body_tracking.errors import BodyTrackingError

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

NANOSECONDS = 1_000_000_000

MAX_STAMP_NS = 2**31 * NANOSECONDS - 1
"""The last stamp that a ROS message can hold (``builtin_interfaces/Time``, January 2038); the first one is 0."""

MAX_RANGE = 100.0
"""A coordinate beyond this many metres is no measurement of a person but a damaged number."""


class SkeletonError(BodyTrackingError):
    """An array that should be a skeleton is not one."""


class Joint(IntEnum):
    """The joints of the Kinect v2 SDK (``JointType``), in its order; Schlagenhauf (2017), table 4.2, counts from 1."""

    SPINE_BASE = 0
    SPINE_MID = 1
    NECK = 2
    HEAD = 3
    SHOULDER_LEFT = 4
    ELBOW_LEFT = 5
    WRIST_LEFT = 6
    HAND_LEFT = 7
    SHOULDER_RIGHT = 8
    ELBOW_RIGHT = 9
    WRIST_RIGHT = 10
    HAND_RIGHT = 11
    HIP_LEFT = 12
    KNEE_LEFT = 13
    ANKLE_LEFT = 14
    FOOT_LEFT = 15
    HIP_RIGHT = 16
    KNEE_RIGHT = 17
    ANKLE_RIGHT = 18
    FOOT_RIGHT = 19
    SPINE_SHOULDER = 20
    HAND_TIP_LEFT = 21
    THUMB_LEFT = 22
    HAND_TIP_RIGHT = 23
    THUMB_RIGHT = 24


class TrackingState(IntEnum):
    """What the sensor says of a joint (Kinect v2 SDK ``TrackingState``)."""

    NOT_TRACKED = 0
    INFERRED = 1
    TRACKED = 2


N_JOINTS = len(Joint)

JOINT_NAMES: tuple[str, ...] = tuple(joint.name.title().replace("_", "") for joint in Joint)
"""The SDK's own names, in SDK order: ``SpineBase``, ``SpineMid``, ..."""

BONES: tuple[tuple[Joint, Joint], ...] = (
    (Joint.SPINE_BASE, Joint.SPINE_MID),
    (Joint.SPINE_MID, Joint.SPINE_SHOULDER),
    (Joint.SPINE_SHOULDER, Joint.NECK),
    (Joint.NECK, Joint.HEAD),
    (Joint.SPINE_SHOULDER, Joint.SHOULDER_LEFT),
    (Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT),
    (Joint.ELBOW_LEFT, Joint.WRIST_LEFT),
    (Joint.WRIST_LEFT, Joint.HAND_LEFT),
    (Joint.HAND_LEFT, Joint.HAND_TIP_LEFT),
    (Joint.HAND_LEFT, Joint.THUMB_LEFT),
    (Joint.SPINE_SHOULDER, Joint.SHOULDER_RIGHT),
    (Joint.SHOULDER_RIGHT, Joint.ELBOW_RIGHT),
    (Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT),
    (Joint.WRIST_RIGHT, Joint.HAND_RIGHT),
    (Joint.HAND_RIGHT, Joint.HAND_TIP_RIGHT),
    (Joint.HAND_RIGHT, Joint.THUMB_RIGHT),
    (Joint.SPINE_BASE, Joint.HIP_LEFT),
    (Joint.HIP_LEFT, Joint.KNEE_LEFT),
    (Joint.KNEE_LEFT, Joint.ANKLE_LEFT),
    (Joint.ANKLE_LEFT, Joint.FOOT_LEFT),
    (Joint.SPINE_BASE, Joint.HIP_RIGHT),
    (Joint.HIP_RIGHT, Joint.KNEE_RIGHT),
    (Joint.KNEE_RIGHT, Joint.ANKLE_RIGHT),
    (Joint.ANKLE_RIGHT, Joint.FOOT_RIGHT),
)
"""(parent, child) of every segment, from the base of the spine outwards."""


def _mirror() -> IntArray:
    other = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
    return np.array(
        [Joint["_".join(other.get(word, word) for word in joint.name.split("_"))] for joint in Joint], dtype=np.intp
    )


MIRROR: IntArray = _mirror()
"""``positions[MIRROR]`` exchanges left and right."""


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """One body at one instant.

    Attributes:
        stamp_ns: capture time in ROS time, nanoseconds: as its sensor stamps, or as the reference sensor does where it
            is fused or filtered. In files that are imported, by the sensor's own clock.
        frame_id: the frame of the positions, such as ``kinect1_optical_frame`` or ``world``.
        positions: (25, 3) metres, SDK order; NaN where nothing is known.
        states: (25,) uint8 of :class:`TrackingState`.
        body: the sensor's number of this body.
        covariances: (25, 3, 3) square metres, or None where the source states none (raw sensors).
        velocities: (25, 3) metres per second, or None.
    """

    stamp_ns: int
    frame_id: str
    positions: FloatArray
    states: NDArray[np.uint8]
    body: int = 0
    covariances: FloatArray | None = None
    velocities: FloatArray | None = None

    def __post_init__(self) -> None:
        for name, shape in (
            ("positions", (N_JOINTS, 3)),
            ("states", (N_JOINTS,)),
            ("covariances", (N_JOINTS, 3, 3)),
            ("velocities", (N_JOINTS, 3)),
        ):
            value: NDArray[Any] | None = getattr(self, name)
            if value is not None and value.shape != shape:
                raise SkeletonError(f"skeleton {name}: shape {value.shape}, expected {shape}")

    @property
    def stamp(self) -> float:
        """Capture time in seconds; for display and differences of seconds, not for comparing stamps."""
        return self.stamp_ns / NANOSECONDS

    @property
    def valid(self) -> BoolArray:
        """(25,) joints that have a position within :data:`MAX_RANGE` and are not NOT_TRACKED."""
        known: BoolArray = (self.states > 0) & (np.abs(self.positions) < MAX_RANGE).all(axis=1)
        return known

    def mirrored(self) -> Skeleton:
        """The same points with the labels left and right exchanged."""
        return Skeleton(
            self.stamp_ns,
            self.frame_id,
            self.positions[MIRROR],
            self.states[MIRROR],
            self.body,
            None if self.covariances is None else self.covariances[MIRROR],
            None if self.velocities is None else self.velocities[MIRROR],
        )
