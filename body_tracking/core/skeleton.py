"""Sets of joints, the Kinect v2's among them, tracking states, and one body seen at one instant."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.times import MAX_STAMP_NS as MAX_STAMP_NS
from body_tracking.core.times import NANOSECONDS as NANOSECONDS

FloatArray = NDArray[np.float64]
SingleArray = NDArray[np.float32]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

MAX_RANGE = 100.0
"""Metres; a larger coordinate is corrupt."""


class SkeletonError(BodyTrackingError):
    """Raised for arrays of the wrong shape for a skeleton, and for inconsistent joint sets."""


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
    """The tracking state of a joint (Kinect v2 SDK ``TrackingState``)."""

    NOT_TRACKED = 0
    INFERRED = 1
    TRACKED = 2


@dataclass(frozen=True, slots=True, eq=False)
class JointSet:
    """The points of a body that a kind of sensor sees.

    Attributes:
        name: of the set.
        names: of each joint, in upper case; the two sides of a pair differ by a part ``LEFT`` or ``RIGHT``.
        parents: the number of each joint's parent; -1 at the root.

    Raises:
        SkeletonError: a repeated name, or an invalid parent.
    """

    name: str
    names: tuple[str, ...]
    parents: tuple[int, ...]

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(set(self.names)) < count or len(self.parents) != count:
            raise SkeletonError(f"joint set {self.name}: {count} names, {len(self.parents)} parents, or a name twice")
        if not all(-1 <= parent < count and parent != joint for joint, parent in enumerate(self.parents)):
            raise SkeletonError(f"joint set {self.name}: a parent is none of its {count} joints")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """(parent, child) of every segment."""
        return tuple((parent, joint) for joint, parent in enumerate(self.parents) if parent >= 0)

    @property
    def mirror(self) -> IntArray:
        """(n,) ``positions[mirror]`` swaps left and right.

        Raises:
            SkeletonError: a joint of one side without one of the other.
        """
        other = {"LEFT": "RIGHT", "RIGHT": "LEFT"}
        twins = ["_".join(other.get(word, word) for word in name.split("_")) for name in self.names]
        missing = set(twins) - set(self.names)
        if missing:
            raise SkeletonError(f"joint set {self.name}: no joint {', '.join(sorted(missing))}")
        return np.array([self.names.index(twin) for twin in twins], dtype=np.intp)


_PARENTS = {
    Joint.SPINE_MID: Joint.SPINE_BASE,
    Joint.SPINE_SHOULDER: Joint.SPINE_MID,
    Joint.NECK: Joint.SPINE_SHOULDER,
    Joint.HEAD: Joint.NECK,
    Joint.SHOULDER_LEFT: Joint.SPINE_SHOULDER,
    Joint.ELBOW_LEFT: Joint.SHOULDER_LEFT,
    Joint.WRIST_LEFT: Joint.ELBOW_LEFT,
    Joint.HAND_LEFT: Joint.WRIST_LEFT,
    Joint.HAND_TIP_LEFT: Joint.HAND_LEFT,
    Joint.THUMB_LEFT: Joint.HAND_LEFT,
    Joint.SHOULDER_RIGHT: Joint.SPINE_SHOULDER,
    Joint.ELBOW_RIGHT: Joint.SHOULDER_RIGHT,
    Joint.WRIST_RIGHT: Joint.ELBOW_RIGHT,
    Joint.HAND_RIGHT: Joint.WRIST_RIGHT,
    Joint.HAND_TIP_RIGHT: Joint.HAND_RIGHT,
    Joint.THUMB_RIGHT: Joint.HAND_RIGHT,
    Joint.HIP_LEFT: Joint.SPINE_BASE,
    Joint.KNEE_LEFT: Joint.HIP_LEFT,
    Joint.ANKLE_LEFT: Joint.KNEE_LEFT,
    Joint.FOOT_LEFT: Joint.ANKLE_LEFT,
    Joint.HIP_RIGHT: Joint.SPINE_BASE,
    Joint.KNEE_RIGHT: Joint.HIP_RIGHT,
    Joint.ANKLE_RIGHT: Joint.KNEE_RIGHT,
    Joint.FOOT_RIGHT: Joint.ANKLE_RIGHT,
}
KINECT = JointSet(
    "kinect", tuple(joint.name for joint in Joint), tuple(int(_PARENTS.get(joint, -1)) for joint in Joint)
)
"""The joints of a Kinect v2."""

N_JOINTS = len(KINECT)

JOINT_NAMES: tuple[str, ...] = tuple(name.title().replace("_", "") for name in KINECT.names)
"""The SDK's own names, in SDK order: ``SpineBase``, ``SpineMid``, ..."""

BONES: tuple[tuple[Joint, Joint], ...] = tuple((parent, child) for child, parent in _PARENTS.items())
"""(parent, child) of every segment, from the base of the spine outwards."""

MIRROR: IntArray = KINECT.mirror
"""``positions[MIRROR]`` swaps left and right."""


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """One body at one instant.

    Attributes:
        stamp_ns: capture time in ROS time, nanoseconds: by the clock of its sensor, or of the reference sensor for a
            fused or filtered skeleton. In imported files, by the sensor's own clock.
        frame_id: the frame of the positions, such as ``kinect1_optical_frame`` or ``world``.
        positions: (n, 3) metres; NaN where unknown.
        states: (n,) uint8 of :class:`TrackingState`.
        body: the sensor's number of this body.
        covariances: (n, 3, 3) square metres, or None where the source states none (raw sensors).
        velocities: (n, 3) metres per second, or None.
        joints: which joints these are, n of them.
    """

    stamp_ns: int
    frame_id: str
    positions: FloatArray
    states: NDArray[np.uint8]
    body: int = 0
    covariances: FloatArray | None = None
    velocities: FloatArray | None = None
    joints: JointSet = KINECT

    def __post_init__(self) -> None:
        count = len(self.joints)
        for name, shape in (
            ("positions", (count, 3)),
            ("states", (count,)),
            ("covariances", (count, 3, 3)),
            ("velocities", (count, 3)),
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
        """(n,) joints that have a position within :data:`MAX_RANGE` and are not NOT_TRACKED."""
        known: BoolArray = (self.states > 0) & (np.abs(self.positions) < MAX_RANGE).all(axis=1)
        return known

    def mirrored(self) -> Skeleton:
        """The same points with the labels left and right swapped."""
        mirror = MIRROR if self.joints is KINECT else self.joints.mirror
        return replace(
            self,
            positions=self.positions[mirror],
            states=self.states[mirror],
            covariances=None if self.covariances is None else self.covariances[mirror],
            velocities=None if self.velocities is None else self.velocities[mirror],
        )
