"""A joint between two targets: kind, frames in both targets, covariance.

A joint has a frame in its parent target and one in its child target, with the same origin, the joint's centre. A child
target's rotation for a joint rotation Q is ``R_child = R_parent @ parent_rotation @ Q @ child_rotation.T``
(Gaschler 2011, eq. 5.1 and 5.15; his C_1 and C_2 are the two frames). Q depends on the kind:

- ball: any rotation. Both frames are parallel to those of the targets (Gaschler section 5.1).
- hinge: ``Rz(a)``, about the z axis of both frames.
- universal: ``Rz(a) @ Rx(-90 deg) @ Rz(b)``: a about the z axis of the frame in the parent, then b about the z axis of
  the frame in the child; the two axes are perpendicular and meet.

Conventions fix what the motion does not determine (Gaschler section 5.2.2): the x axis of each frame lies in the plane
of its z axis and the target's origin and points away from that origin, which defines the zero position; the centre of a
hinge minimises the sum of the squared distances to both origins.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray

SIZE: Final = 12
"""Parameters of a joint: centre and rotation in the parent, centre and rotation in the child, three numbers each."""
_CENTRES: Final = [0, 1, 2, 6, 7, 8]
_NEAR_AXIS: Final = 0.01
"""Metres: if the target's origin is nearer to the axis, the target's own axes define the x axis."""
_AXES: FloatArray = np.eye(3)[None]
_STEP: Final = 1e-6
_QUARTER: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rx(-90 deg)."""
_HALF: FloatArray = np.diag([1.0, -1.0, -1.0])
"""Rx(180 deg)."""


class JointError(BodyTrackingError):
    """Raised for an invalid joint, name or number."""


class JointKind(StrEnum):
    """The joint's degrees of freedom."""

    BALL = "ball"
    HINGE = "hinge"
    UNIVERSAL = "universal"

    @property
    def coordinates(self) -> int:
        """Number of angles."""
        return {JointKind.BALL: 3, JointKind.HINGE: 1, JointKind.UNIVERSAL: 2}[self]


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """A joint and its covariance.

    Attributes:
        name: of letters, digits and underscores.
        parent: name of the target before the joint.
        child: name of the target behind the joint.
        kind: see the module's docstring.
        parent_rotation: (3, 3) the joint's axes in the parent target.
        parent_centre: (3,) metres, in the parent target.
        child_rotation: (3, 3) the joint's axes in the child target.
        child_centre: (3,) metres, in the child target.
        covariance: (12, 12) of parent centre, parent rotation, child centre, child rotation; a rotation's three entries
            are w such that the true rotation is ``exp(w) @ rotation``. It includes the conventions: fixed quantities
            have no variance, derived ones (the zero position) inherit that of their sources.

    Raises:
        JointError: an invalid name, wrong shapes, numbers that are not finite, matrices that are not rotations.
    """

    name: str
    parent: str
    child: str
    kind: JointKind
    parent_rotation: FloatArray
    parent_centre: FloatArray
    child_rotation: FloatArray
    child_centre: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        if not re.fullmatch(r"\w+", self.name, re.ASCII):
            raise JointError(f"joint {self.name!r}: a name needs letters, digits and underscores only")
        if not self.parent or not self.child or self.parent == self.child:
            raise JointError(f"joint {self.name}: between {self.parent!r} and {self.child!r}; two targets are needed")
        for what, value, shape in (
            ("parent_rotation", self.parent_rotation, (3, 3)),
            ("parent_centre", self.parent_centre, (3,)),
            ("child_rotation", self.child_rotation, (3, 3)),
            ("child_centre", self.child_centre, (3,)),
            ("covariance", self.covariance, (SIZE, SIZE)),
        ):
            if value.shape != shape or not np.isfinite(value).all():
                raise JointError(f"joint {self.name}: {what} {value.tolist()}, expected {shape} finite numbers")
        for what, value in (("parent_rotation", self.parent_rotation), ("child_rotation", self.child_rotation)):
            if not is_rotation(value):
                raise JointError(f"joint {self.name}: {what} {value.tolist()} is no rotation")

    @property
    def angle_names(self) -> tuple[str, ...]:
        """Names of the angles; a ball joint's are intrinsic rotations about x, y and z."""
        endings = {JointKind.BALL: ("_x", "_y", "_z"), JointKind.HINGE: ("",), JointKind.UNIVERSAL: ("_1", "_2")}
        return tuple(self.name + ending for ending in endings[self.kind])

    @property
    def parent_axis(self) -> FloatArray:
        """(3,) the z axis in the parent target: a hinge's axis, the first axis of a universal joint."""
        return self.parent_rotation[:, 2]

    @property
    def child_axis(self) -> FloatArray:
        """(3,) the z axis in the child target: a hinge's axis, the second axis of a universal joint."""
        return self.child_rotation[:, 2]

    def changed(self, step: FloatArray) -> Joint:
        """The joint with a step (12,) added to its parameters, in the order of :attr:`covariance`."""
        return replace(
            self,
            parent_centre=self.parent_centre + step[:3],
            parent_rotation=so3.quat_to_matrix(so3.exp(step[3:6])) @ self.parent_rotation,
            child_centre=self.child_centre + step[6:9],
            child_rotation=so3.quat_to_matrix(so3.exp(step[9:])) @ self.child_rotation,
        )

    def difference(self, other: Joint) -> FloatArray:
        """(12,) step such that ``other.changed(step)`` is this joint."""
        turns = np.stack([self.parent_rotation @ other.parent_rotation.T, self.child_rotation @ other.child_rotation.T])
        parent, child = so3.rotation_vectors(turns)
        return np.concatenate(
            [self.parent_centre - other.parent_centre, parent, self.child_centre - other.child_centre, child]
        )


def is_rotation(matrix: FloatArray) -> bool:
    """Whether (3, 3) is a rotation matrix, to six digits."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6 and np.linalg.det(matrix) > 0.0)


# --- joint rotations: Q of the module's docstring, for n frames


def turn_axes(kind: JointKind, turns: FloatArray) -> FloatArray:
    """(n, 3, d) axes of the coordinates in the parent's joint frame, for (n, 3, 3) turns; (1, 3, 3) for a ball
    joint.
    """
    if kind is JointKind.BALL:
        return _AXES
    axes = np.zeros((len(turns), 3, kind.coordinates))
    axes[:, 2, 0] = 1.0
    if kind is JointKind.UNIVERSAL:
        axes[:, :, 1] = turns[:, :, 2]
    return axes


def turn_angles(kind: JointKind, turns: FloatArray) -> FloatArray:
    """(n, d) angles of a hinge or universal joint, radians, nearest to (n, 3, 3) turns (Gaschler eq. 5.15-5.17)."""
    if kind is JointKind.HINGE:
        return np.arctan2(turns[:, 1, 0] - turns[:, 0, 1], turns[:, 0, 0] + turns[:, 1, 1])[:, None]
    first = np.arctan2(-turns[:, 0, 2], turns[:, 1, 2])
    return np.stack([first, np.arctan2(-turns[:, 2, 0], -turns[:, 2, 1])], axis=-1)


def nearest_turns(kind: JointKind, rotations: FloatArray) -> FloatArray:
    """(n, 3, 3) turns possible for the joint, nearest to (n, 3, 3) rotations of the child's frame in the parent's."""
    if kind is JointKind.BALL:
        return rotations
    angles = turn_angles(kind, rotations)
    if kind is JointKind.HINGE:
        return about_z(angles[:, 0])
    return about_z(angles[:, 0]) @ _QUARTER @ about_z(angles[:, 1])


def about_z(angles: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations about z by (n,) radians."""
    result = np.zeros((len(angles), 3, 3))
    result[:, 0, 0] = result[:, 1, 1] = np.cos(angles)
    result[:, 1, 0] = np.sin(angles)
    result[:, 0, 1] = -result[:, 1, 0]
    result[:, 2, 2] = 1.0
    return result


# --- parameters that the motion determines, and those fixed by convention


def free_directions(joint: Joint) -> FloatArray:
    """(12, p) directions of the parameters that a motion can determine; p is 6 (ball), 9 (hinge), 10 (universal).

    Undetermined are a shift of a hinge's centre along its axis, in both targets together, and a turn of a frame about
    z.
    """
    if joint.kind is JointKind.BALL:
        return np.eye(SIZE)[:, _CENTRES]
    centres: FloatArray = np.eye(6)
    if joint.kind is JointKind.HINGE:
        along = np.concatenate([joint.parent_axis, joint.child_axis])
        centres = np.linalg.svd(along[None])[2][1:].T
    result = np.zeros((SIZE, centres.shape[1] + 4))
    result[_CENTRES, :-4] = centres
    result[3:6, -4:-2] = joint.parent_rotation[:, :2]
    result[9:12, -2:] = joint.child_rotation[:, :2]
    return result


def conventional(joint: Joint) -> tuple[Joint, FloatArray]:
    """The joint in its conventional form, and the derivative of its parameters by its free directions.

    The sign of the axis makes its largest component positive, in the parent, or for the second axis of a universal
    joint in the child.

    Returns:
        The joint, with unchanged covariance.
        (12, p) derivative of its parameters by steps along its :func:`free_directions`.
    """
    if joint.kind is JointKind.BALL:
        return joint, free_directions(joint)
    flip_parent, flip_child = (
        bool(axis[np.abs(axis).argmax()] < 0.0) for axis in (joint.parent_axis, joint.child_axis)
    )
    if joint.kind is JointKind.HINGE:
        flip_child = flip_parent
    joint = replace(
        joint,
        parent_rotation=joint.parent_rotation @ _HALF if flip_parent else joint.parent_rotation,
        child_rotation=joint.child_rotation @ _HALF if flip_child else joint.child_rotation,
    )
    joint = _shifted(joint)
    near = np.array([_across(joint.parent_axis, joint.parent_centre), _across(joint.child_axis, joint.child_centre)])
    near_axis: BoolArray = near < _NEAR_AXIS
    base = _zeroed(joint, near_axis)
    directions = free_directions(base)
    columns = [
        _zeroed(_shifted(base.changed(_STEP * step)), near_axis).difference(
            _zeroed(_shifted(base.changed(-_STEP * step)), near_axis)
        )
        / (2.0 * _STEP)
        for step in directions.T
    ]
    return base, np.stack(columns, axis=1)


def _across(axis: FloatArray, centre: FloatArray) -> float:
    return float(np.linalg.norm(centre - axis * (axis @ centre)))


def _shifted(joint: Joint) -> Joint:
    """Move a hinge's centre to the least sum of squared distances to both origins."""
    if joint.kind is not JointKind.HINGE:
        return joint
    shift = -0.5 * (joint.parent_centre @ joint.parent_axis + joint.child_centre @ joint.child_axis)
    return replace(
        joint,
        parent_centre=joint.parent_centre + shift * joint.parent_axis,
        child_centre=joint.child_centre + shift * joint.child_axis,
    )


def _zeroed(joint: Joint, near_axis: BoolArray) -> Joint:
    return replace(
        joint,
        parent_rotation=axis_frame(joint.parent_axis, joint.parent_centre, bool(near_axis[0])),
        child_rotation=axis_frame(joint.child_axis, joint.child_centre, bool(near_axis[1])),
    )


def axis_frame(axis: FloatArray, centre: FloatArray, near_axis: bool = False) -> FloatArray:
    """(3, 3) the frame of a z axis (Gaschler eq. 5.12-5.14).

    Args:
        axis: (3,) unit vector.
        centre: (3,) a point on it, relative to the target's origin.
        near_axis: whether the target's origin lies on the axis: then the x axis lies in the plane of the z axis and
            that target axis that is farthest from it.
    """
    towards = np.eye(3)[np.abs(axis).argmin()] if near_axis else centre
    y = np.cross(axis, towards)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, axis), y, axis], axis=-1)
