"""A tree of targets connected by joints: postures, and their derivatives by coordinates and parameters.

The coordinates of a posture are the root target's pose (translation, then a rotation w: ``exp(w) @ rotation``), then
each joint's, in the order of the joints: rotations about :func:`body_tracking.markers.joint_model.turn_axes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import tree_loops
from body_tracking.markers.joint_model import (
    SIZE,
    Joint,
    JointKind,
    nearest_turns,
)
from body_tracking.markers.pose_table import PoseTable

ROOT: Final = 6
"""Number of coordinates of the root target's pose."""


class TreeError(BodyTrackingError):
    """Raised for joints that do not connect the targets to one tree."""


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Structure of a tree.

    Attributes:
        targets: names, the root first.
        joints: each after its parent.
        parents: for each joint the index of its parent target; the index of its child target is the joint's plus one.
        slices: for each joint the slice of its coordinates.
        size: number of coordinates.
    """

    targets: tuple[str, ...]
    joints: tuple[Joint, ...]
    parents: tuple[int, ...]
    slices: tuple[slice, ...]
    size: int

    def with_joints(self, joints: Sequence[Joint]) -> Tree:
        """The tree with other values of its joints."""
        return replace(self, joints=tuple(joints))


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """n postures of a tree.

    Attributes:
        rotation: (n, 3, 3) and
        translation: (n, 3) metres: the root target's pose.
        turns: for each joint (n, 3, 3) joint rotations.
    """

    rotation: FloatArray
    translation: FloatArray
    turns: tuple[FloatArray, ...]

    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Copies of rotation, translation and turns, the turns as (j, n, 3, 3)."""
        return np.array(self.rotation, order="C"), np.array(self.translation, order="C"), np.stack(self.turns)


def tree_of(joints: Sequence[Joint]) -> Tree:
    """The tree of the joints, given in any order.

    Raises:
        TreeError: no joint, a duplicate name, a target with two parents, a cycle, or several trees.
    """
    names = [joint.name for joint in joints]
    angle_names = [name for joint in joints for name in joint.angle_names]
    if not joints or len(set(names)) < len(names) or len(set(angle_names)) < len(angle_names):
        raise TreeError(f"joints {', '.join(names) or 'none'}: each needs a name of its own")
    children = [joint.child for joint in joints]
    if len(set(children)) < len(children):
        raise TreeError(f"targets {', '.join(children)}: one has two parents")
    roots = sorted({joint.parent for joint in joints} - set(children))
    if len(roots) != 1:
        raise TreeError(f"joints {', '.join(names)}: {len(roots)} targets without a parent, expected one")
    targets, ordered = [roots[0]], list[Joint]()
    while True:
        ready = [joint for joint in joints if joint.parent in targets and joint.child not in targets]
        if not ready:
            break
        ordered.append(ready[0])
        targets.append(ready[0].child)
    if len(ordered) < len(joints):
        raise TreeError(f"joints {', '.join(names)}: some make a circle")
    slices, size = [], ROOT
    for joint in ordered:
        slices.append(slice(size, size + joint.kind.coordinates))
        size += joint.kind.coordinates
    parents = tuple(targets.index(joint.parent) for joint in ordered)
    return Tree(tuple(targets), tuple(ordered), parents, tuple(slices), size)


def first_posture(tree: Tree, poses: PoseTable, previous: Posture | None = None) -> Posture:
    """Postures near measured poses: the first visible target of each frame keeps its pose.

    Joints of a hidden target keep their rotations from the nearest frame with both targets visible, else from the
    previous posture, else zero.
    """
    n = len(poses)
    seen = poses.seen
    turns = []
    for index, (joint, parent) in enumerate(zip(tree.joints, tree.parents, strict=True)):
        relative = poses.rotations[:, parent].swapaxes(-1, -2) @ poses.rotations[:, index + 1]
        measured = nearest_turns(joint.kind, joint.parent_rotation.T @ relative @ joint.child_rotation)
        both = seen[:, parent] & seen[:, index + 1]
        if not both.any():
            measured[:] = nearest_turns(joint.kind, _zero(joint.kind)) if previous is None else previous.turns[index]
        elif not both.all():
            known = np.flatnonzero(both)
            after = np.minimum(np.searchsorted(known, np.arange(n)), len(known) - 1)
            before = np.maximum(after - 1, 0)
            later = np.abs(known[after] - np.arange(n)) < np.abs(known[before] - np.arange(n))
            measured = measured[known[np.where(later, after, before)]]
        turns.append(measured)
    posture = Posture(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), tuple(turns))
    if seen[:, 0].all():
        return replace(posture, rotation=poses.rotations[:, 0], translation=poses.translations[:, 0])
    # move the whole tree so that the first visible target is at its measured pose
    rotations, translations = place(tree, posture)
    frames, anchor = np.arange(n), seen.argmax(axis=1)
    rotation = poses.rotations[frames, anchor] @ rotations[frames, anchor].swapaxes(-1, -2)
    translation = poses.translations[frames, anchor] - (rotation @ translations[frames, anchor][..., None])[..., 0]
    return replace(posture, rotation=rotation, translation=translation)


def _zero(kind: JointKind) -> FloatArray:
    if kind is JointKind.UNIVERSAL:
        return np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]])
    return np.eye(3)[None]


@lru_cache(maxsize=8)
def numbers_of(tree: Tree) -> tree_loops.Numbers:
    """Parameters of a tree as arrays for the compiled loops."""
    joints = tree.joints
    return (
        np.array(tree.parents),
        np.array([joint.kind.coordinates for joint in joints]),
        np.array([where.start for where in tree.slices]),
        np.stack([joint.parent_rotation for joint in joints]),
        np.stack([joint.parent_centre for joint in joints]),
        np.stack([joint.child_rotation for joint in joints]),
        np.stack([joint.child_centre for joint in joints]),
    )


def place(tree: Tree, posture: Posture) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, m, 3, 3) and translations (n, m, 3) of the targets of postures (Gaschler eq. 5.20)."""
    n, m = len(posture.rotation), len(tree.targets)
    rotations, translations = np.empty((n, m, 3, 3)), np.empty((n, m, 3))
    tree_loops.place(numbers_of(tree), *posture.arrays(), rotations, translations)
    return rotations, translations


def moved(tree: Tree, posture: Posture, steps: FloatArray) -> Posture:
    """Postures after (n, size) steps of their coordinates."""
    rotation, translation, turns = posture.arrays()
    tree_loops.moved(numbers_of(tree), np.ascontiguousarray(steps), rotation, translation, turns)
    return Posture(rotation, translation, tuple(turns))


def reseated(tree: Tree, posture: Posture, joints: Sequence[Joint]) -> tuple[Tree, Posture]:
    """The same motion with joint frames turned about z, shifted along z, or with z flipped."""
    turns = tuple(
        nearest_turns(
            new.kind, new.parent_rotation.T @ old.parent_rotation @ turns @ old.child_rotation.T @ new.child_rotation
        )
        for old, new, turns in zip(tree.joints, joints, posture.turns, strict=True)
    )
    return tree.with_joints(joints), replace(posture, turns=turns)


def differentiate(tree: Tree, posture: Posture, rotations: FloatArray, parameters: bool) -> FloatArray:
    """Derivatives of the targets' poses.

    Args:
        tree: with j joints.
        posture: n postures.
        rotations: from :func:`place`.
        parameters: whether to differentiate by the joints' parameters, too.

    Returns:
        (n, m, 6, size + 12 j) of translation and rotation (w of ``exp(w) @ rotation``) by the coordinates, then by the
        parameters of each joint as in :attr:`Joint.covariance`; (n, m, 6, size) without parameters.
    """
    width = tree.size + (SIZE * len(tree.joints) if parameters else 0)
    result = np.zeros((*rotations.shape[:2], 6, width))
    turns = posture.arrays()[2]
    tree_loops.differentiate(numbers_of(tree), turns, rotations, tree.size, parameters, result)
    return result


def errors(poses: PoseTable, rotations: FloatArray, translations: FloatArray) -> FloatArray:
    """(n, m, 6) translation and rotation (w of ``exp(w) @ rotation``) from the tree's poses to the measured ones."""
    result = np.empty((*rotations.shape[:2], 6))
    # contiguous: the type compiled ahead
    measured = np.ascontiguousarray(poses.rotations), np.ascontiguousarray(poses.translations)
    tree_loops.errors(*measured, np.ascontiguousarray(poses.seen), rotations, translations, result)
    return result
