"""The body of ``upper_body`` as the peers describe bodies: a tree of rigid segments joined by successive rotations.

A ball joint of the model is three rotations here: flexion, abduction and inward rotation at a shoulder, singular at an
abduction of 90 deg; yaw, pitch and roll at the pelvis, singular at a pitch of 90 deg.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.kinematics.upper_body import PARENTS, SEGMENTS, UpperBody
from body_tracking.skeleton import JOINT_NAMES, FloatArray

_AXES: dict[str, str] = {
    "pelvis": "+z +y +x",
    "lower_trunk": "+y +x +z",
    "upper_trunk": "+y +x +z",
    "head": "+y +x",
    "clavicle_left": "-z +x",
    "clavicle_right": "+z -x",
    "upper_arm_left": "-y +x -z",
    "upper_arm_right": "-y -x +z",
    "forearm_left": "-y -z",
    "forearm_right": "-y +z",
    "hand_left": "-x -y",
    "hand_right": "+x -y",
}
"""The rotations of each segment against its parent: signed axes, intrinsic, in order."""

_CARRIERS = {
    "pelvis": ("SpineBase", "HipLeft", "HipRight"),
    "lower_trunk": ("SpineMid",),
    "upper_trunk": ("SpineShoulder", "Neck"),
    "head": ("Head",),
    **{
        f"{segment}_{side.lower()}": tuple(f"{point}{side}" for point in points)
        for side in ("Left", "Right")
        for segment, points in {
            "clavicle": ("Shoulder",),
            "upper_arm": ("Elbow",),
            "forearm": ("Wrist",),
            "hand": ("Hand", "HandTip", "Thumb"),
        }.items()
    },
}
"""The points that each segment carries."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A rigid segment at zero pose, where all frames are aligned with the world.

    Attributes:
        name: of the segment.
        parent: name of the parent; None for the base, which is free.
        origin: (3,) metres, in the parent's frame.
        names: k names of its two or three rotations.
        axes: k letters ``x``, ``y``, ``z``: their axes, intrinsic.
        signs: (k,) +1 or -1, the direction of each rotation in which the model counts its angle.
    """

    name: str
    parent: str | None
    origin: FloatArray
    names: tuple[str, ...]
    axes: str
    signs: FloatArray


@dataclass(frozen=True, slots=True)
class Marker:
    """A point that moves with a segment: its name, the segment's name and (3,) metres in the segment's frame."""

    name: str
    segment: str
    place: FloatArray


class Tree:
    """The body of one person.

    Its coordinates (32) are the base's position, its yaw, pitch and roll, and 26 angles, in the order and with the
    signs of the model's tangent; the three of each shoulder are flexion, abduction and inward rotation.

    Attributes:
        segments: 12 segments, parents first.
        markers: 19 points, in the order of ``UpperBody.joints``; those of the pelvis first.
        names: 32 names of the coordinates.
        signs: (29,) the signs of all rotations.
    """

    def __init__(self, model: UpperBody, lengths: FloatArray) -> None:
        """``lengths``: (nl,) the person's segment lengths, metres."""
        self._model = model
        names = list(model.coordinate_names)
        names[3:6] = "base_yaw", "base_pitch", "base_roll"
        for side in ("left", "right"):
            first = names.index(f"shoulder_x_{side}")
            names[first : first + 3] = (f"shoulder_{angle}_{side}" for angle in ("flexion", "abduction", "rotation"))
        self.names: tuple[str, ...] = tuple(names)

        zero = model.forward(model.neutral(), lengths)
        origins = dict(zip(SEGMENTS, zero.origins, strict=True))
        segments = []
        self._balls: list[tuple[slice, slice, Segment]] = []
        for name, parent, turned in zip(SEGMENTS, PARENTS, model.segment_coordinates, strict=True):
            axes = _AXES[name].split()
            segment = Segment(
                name,
                None if parent < 0 else SEGMENTS[parent],
                np.zeros(3) if parent < 0 else origins[name] - zero.origins[parent],
                self.names[turned],
                "".join(axis[1] for axis in axes),
                np.array([1.0 if axis[0] == "+" else -1.0 for axis in axes]),
            )
            segments.append(segment)
            if name in ("pelvis", "upper_arm_left", "upper_arm_right"):
                self._balls.append((model.quaternion_of(name), turned, segment))
        self.segments: tuple[Segment, ...] = tuple(segments)
        self.signs: FloatArray = np.concatenate([segment.signs for segment in segments])

        carrier = {point: name for name, points in _CARRIERS.items() for point in points}
        self.markers: tuple[Marker, ...] = tuple(
            Marker(name, carrier[name], position - origins[carrier[name]])
            for name, position in zip([JOINT_NAMES[joint] for joint in model.joints], zero.positions, strict=True)
        )

    def coordinates(self, q: FloatArray) -> FloatArray:
        """(n, 32) coordinates of the configurations (n, 35) of the model."""
        found = np.empty((len(q), self._model.nv))
        found[:, :3] = q[:, :3]
        found[:, self._model.scalar_v] = q[:, self._model.scalar_q]
        for quaternion, where, segment in self._balls:
            found[:, where] = segment.signs * Rotation.from_quat(q[:, quaternion]).as_euler(segment.axes.upper())
        return found

    def configurations(self, coordinates: FloatArray) -> FloatArray:
        """(n, 35) configurations of the model at the coordinates (n, 32)."""
        q = np.empty((len(coordinates), self._model.nq))
        q[:, :3] = coordinates[:, :3]
        q[:, self._model.scalar_q] = coordinates[:, self._model.scalar_v]
        for quaternion, where, segment in self._balls:
            q[:, quaternion] = Rotation.from_euler(
                segment.axes.upper(), segment.signs * coordinates[:, where]
            ).as_quat()
        return q
