"""Anatomical frames of the segments of a body model, joint angles and their ranges.

Every segment has a frame as in :mod:`body_tracking.kinematics.upper_body`: in the neutral-zero pose (upright, arms
hanging, thumbs forward) x is forward, y left and z up. A body model's rest pose differs (a T or an A pose); ``frames``
at rest are columns in the model's axes (SMPL's: x left, y up, z forward).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.ranges import RANGES, SHOULDER_SWING, SHOULDER_TWIST

SIDES: Final = ("left", "right")
UPRIGHT: Final[FloatArray] = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Frame of an upright trunk: forward, left and up as columns in a model's axes."""
_STRAIGHT = np.radians(10.0)
"""Radians: an elbow at rest that bends less does not show its axis."""


def segment_frames(
    names: Sequence[str], joints: FloatArray, thumbs: Mapping[str, FloatArray] | None = None
) -> FloatArray:
    """Frames (J, 3, 3) of the segments at rest, as columns in the model's axes.

    Args:
        names: of the joints, SMPL's; an unknown joint gets the frame of the trunk.
        joints: (J, 3) at rest.
        thumbs: per side, the direction (3,) from the little finger's to the index finger's knuckle at rest; None for
            forward, as in SMPL's T-pose with palms down.
    """
    place = {name: joints[number] for number, name in enumerate(names)}
    frames = np.tile(UPRIGHT, (len(names), 1, 1))
    forward = UPRIGHT[:, 0]
    for side in SIDES:
        for bone, end in (("hip", "knee"), ("knee", "ankle")):
            along = place[f"{side}_{end}"] - place[f"{side}_{bone}"]
            frames[list(names).index(f"{side}_{bone}")] = bone_frame(-along, forward)
        upper = place[f"{side}_elbow"] - place[f"{side}_shoulder"]
        fore = place[f"{side}_wrist"] - place[f"{side}_elbow"]
        axis = np.cross(upper, fore)
        if np.linalg.norm(axis) < np.sin(_STRAIGHT) * np.linalg.norm(upper) * np.linalg.norm(fore):
            axis = np.cross(upper, forward)
        # flexion turns about -y, and x completes the frame
        frames[list(names).index(f"{side}_shoulder")] = bone_frame(-upper, np.cross(-axis, -upper))
        thumb = forward if thumbs is None else thumbs[side]
        for bone in ("elbow", "wrist"):
            frames[list(names).index(f"{side}_{bone}")] = bone_frame(-fore, thumb)
    return frames


def bone_frame(up: FloatArray, forward: FloatArray) -> FloatArray:
    """(3, 3) columns x, y, z: z along ``up``, x as near ``forward`` as possible."""
    z = up / np.linalg.norm(up)
    y = np.cross(z, forward)
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


# Degrees about (y, x, z) of the frame, in this order: flexion, bend to the right, turn to the left. Lower and upper
# bounds, mean and standard deviation of ordinary postures. Bounds come from ranges.py where it has them; the spine's
# are shared between the model's joints, lumbar: spine1 and spine2, thoracic: spine3, the neck's between neck and head.
# Mean and deviation only matter for hidden joints: clinical zero (else _POSTURE) and a sixth of the range's width.
def _of(kind: str, share: float = 1.0, sign: float = 1.0) -> tuple[float, float]:
    low, high = (share * bound for bound in RANGES[kind])
    return (low, high) if sign > 0.0 else (-high, -low)


_NONE = (-5.0, 5.0)
"""Degrees: bounds of an axis without anatomical motion; allows for misalignment of the model's axes."""


def _bounds(name: str) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    side, _, joint = name.rpartition("_")
    left = 1.0 if side == "left" else -1.0
    if name in ("spine1", "spine2"):
        return _of("lumbar_flexion", 0.5), _of("lumbar_lateral", 0.5), _of("lumbar_axial", 0.5)
    if name == "spine3":
        return _of("thoracic_flexion"), _of("thoracic_lateral"), _of("thoracic_axial")
    if name in ("neck", "head"):
        return _of("neck_flexion", 0.5), _of("neck_lateral", 0.5), (-40.0, 40.0)
    if joint == "collar":
        return (-15.0, 15.0), _of("clavicle_elevation", sign=left), _of("clavicle_protraction", sign=-left)
    if joint == "elbow":
        return _of("elbow_flexion", sign=-1.0), (-15.0, 15.0), _of("forearm_pronation", sign=-left)
    if joint == "wrist":
        return _of("wrist_deviation", sign=-1.0), _of("wrist_flexion", sign=-left), _NONE
    # AAOS (1965), as in ranges.py, rounded outwards
    if joint == "hip":
        return (-125.0, 30.0), ((-30.0, 50.0) if left > 0.0 else (-50.0, 30.0)), (-45.0, 45.0)
    if joint == "knee":
        return (-5.0, 140.0), _NONE, _NONE
    if joint == "ankle":
        return (-30.0, 50.0), (-20.0, 20.0), (-20.0, 20.0)
    return (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)  # fingers, toes, jaw and eyes of SMPL's files stay fixed


_POSTURE: Final = {"elbow": (-30.0, 45.0), "hip": (-10.0, 30.0), "knee": (15.0, 30.0)}
"""Degrees: mean and deviation of the flexion of joints that are bent in ordinary postures."""
_TO_CENTRE: Final = {
    side: so3.quat_to_matrix(
        so3.quat_inverse(so3.exp(0.5 * np.pi * np.cross([0.0, 0.0, -1.0], [np.sqrt(0.5), sign * np.sqrt(0.5), 0.0])))
    )
    for side, sign in (("left", 1.0), ("right", -1.0))
}
"""Rotation to the centre of a shoulder's reach, as in :mod:`body_tracking.kinematics.ranges`."""


@dataclass(frozen=True, slots=True, eq=False)
class Angles:
    """Joint angles of one pose.

    Attributes:
        values: (J, 3) radians about (y, x, z) of the segment's frame, in this order; for a shoulder the rotation vector
            from the centre of its reach. Zero for the first joint.
        gradients: (J, 3, 3) derivative of the values by a small rotation of the segment about its frame's axes.
    """

    values: FloatArray
    gradients: FloatArray


class Anatomy:
    """Angles, ranges and ordinary postures of the joints of a body model.

    Args:
        names: of the joints, SMPL's.
        parents: (J,).
        frames: (J, 3, 3) at rest.

    Attributes:
        low, high: (J, 3) radians: soft limits of :attr:`Angles.values`; infinite for the first joint.
        mean, stddev: (J, 3) radians: of ordinary postures; infinite deviation for the first joint.
    """

    def __init__(self, names: Sequence[str], parents: IntArray, frames: FloatArray) -> None:
        self._frames = frames
        self._parent_frames = frames[np.maximum(parents, 0)]
        degrees = np.array([_bounds(name) for name in names])
        mean = np.zeros((len(names), 3))
        stddev = (degrees[..., 1] - degrees[..., 0]) / 6.0
        for number, name in enumerate(names):
            joint = name.rpartition("_")[2]
            if joint in _POSTURE:
                mean[number, 0], stddev[number, 0] = _POSTURE[joint]
        self._shoulders = np.array([names.index(f"{side}_shoulder") for side in SIDES], dtype=np.intp)
        reach = np.array([SHOULDER_SWING, SHOULDER_SWING, SHOULDER_TWIST])
        degrees[self._shoulders] = np.stack([-reach, reach], axis=-1)
        stddev[self._shoulders] = reach / 3.0
        self._to_centre = np.array([_TO_CENTRE[side] for side in SIDES])
        degrees[0] = -np.inf, np.inf
        stddev[0] = np.inf
        self.low: FloatArray = np.radians(degrees[..., 0])
        self.high: FloatArray = np.radians(degrees[..., 1])
        self.mean: FloatArray = np.radians(mean)
        self.stddev: FloatArray = np.radians(stddev)

    def angles(self, rotations: FloatArray) -> Angles:
        """The angles of rotations (J, 3, 3) of each joint relative to its parent."""
        q = self._parent_frames.mT @ rotations @ self._frames
        b = -np.arcsin(np.clip(q[:, 1, 2], -1.0, 1.0))
        c = np.arctan2(q[:, 1, 0], q[:, 1, 1])
        values = np.stack([np.arctan2(q[:, 0, 2], q[:, 2, 2]), b, c], axis=1)
        sin, cos = np.sin(c), np.cos(c)
        # q = Ry(a) Rx(b) Rz(c): angle rates by the angular velocity in the rotated frame, singular at b = 90 deg
        secant = 1.0 / np.maximum(np.cos(b), 0.1)
        gradients = np.zeros((len(q), 3, 3))
        gradients[:, 0, 0], gradients[:, 0, 1] = sin * secant, cos * secant
        gradients[:, 1, 0], gradients[:, 1, 1] = cos, -sin
        gradients[:, 2, 0], gradients[:, 2, 1], gradients[:, 2, 2] = (
            np.sin(b) * sin * secant,
            np.sin(b) * cos * secant,
            1.0,
        )
        turned = so3.log(so3.matrix_to_quat(self._to_centre @ q[self._shoulders]))
        values[self._shoulders] = turned
        gradients[self._shoulders] = so3.right_jacobian_inverse(turned)
        values[0], gradients[0] = 0.0, 0.0
        return Angles(values, gradients)

    def rotations(self, turned: FloatArray) -> FloatArray:
        """(J, 3, 3) rotations relative to the parents in the model's axes, from those between the segments' frames."""
        result: FloatArray = self._parent_frames @ turned @ self._frames.mT
        return result
