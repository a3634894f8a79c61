"""A kinematic chain: targets that joints connect to a tree, fitted as a whole (Gaschler 2011, section 5.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.markers.chain_likelihood import maximise
from body_tracking.markers.joint_model import SIZE, Joint, JointKind
from body_tracking.markers.joint_tree import Tree, tree_of
from body_tracking.markers.joints import MISFIT_WARNING, JointFit, fit_joint
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.pose_table import PoseTable, pose_table


class ChainError(BodyTrackingError):
    """A chain whose parts do not go together."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Joints and targets of a tree, and how sure they are.

    Attributes:
        joints: each after that of its parent, as :func:`body_tracking.markers.joint_tree.tree_of` orders them.
        covariance: (12 j, 12 j) of the parameters of all joints, as :attr:`Joint.covariance`.
        sensitivity: (12 j, q) derivative of the parameters by the q parameters of the calibration of the cameras that
            measured the recording; (12 j, 0) where it is not known.
        scale: root of the reduced chi squared of the fit. From 1.3 on the targets move against the chain by more than
            the noise of their poses, and the standard deviations of angles grow by it.
        tree: made of the joints.

    Raises:
        ChainError: joints in another order, a covariance or sensitivity of another shape or with numbers that are not
            finite, a scale that is not positive.
        TreeError: as :func:`body_tracking.markers.joint_tree.tree_of`.
    """

    joints: tuple[Joint, ...]
    covariance: FloatArray
    sensitivity: FloatArray
    scale: float = 1.0
    tree: Tree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        tree = tree_of(self.joints)
        if tree.joints != self.joints:
            raise ChainError(f"chain: joints {', '.join(self.names)}, expected each after that of its parent")
        size = SIZE * len(self.joints)
        if self.covariance.shape != (size, size) or not np.isfinite(self.covariance).all():
            raise ChainError(f"chain: covariance {self.covariance.shape}, expected ({size}, {size}) finite numbers")
        shape = self.sensitivity.shape
        if len(shape) != 2 or shape[0] != size or not np.isfinite(self.sensitivity).all():
            raise ChainError(f"chain: sensitivity {shape}, expected ({size}, q) finite numbers")
        if not 0.0 < self.scale < np.inf:
            raise ChainError(f"chain: scale {self.scale}, expected a positive number")
        object.__setattr__(self, "tree", tree)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets, the root first."""
        return self.tree.targets

    @property
    def angle_names(self) -> tuple[str, ...]:
        """Names of all angles, joint by joint."""
        return tuple(name for joint in self.joints for name in joint.angle_names)


@dataclass(frozen=True, slots=True)
class JointDescription:
    """A joint that is to be fitted: its name, the targets before and behind it, its kind."""

    name: str
    parent: str
    child: str
    kind: JointKind


@dataclass(frozen=True, slots=True, eq=False)
class ChainFit:
    """A fitted chain and its quality.

    Attributes:
        chain: with its covariance.
        joints: what each joint by itself says, in the order of the chain's.
        warnings: a line for each thing that is wrong.
    """

    chain: Chain
    joints: tuple[JointFit, ...]
    warnings: tuple[str, ...]


def fit_chain(
    frames: Sequence[Sequence[TargetPose]],
    description: Sequence[JointDescription],
    sensitivities: Sequence[Mapping[str, FloatArray]] | None = None,
    shapes: Sequence[Mapping[str, FloatArray]] | None = None,
) -> ChainFit:
    """Fit all joints of a chain to a recording.

    Single joints start the adjustment of the whole; targets may be missing in any frame.

    Args:
        frames: of each instant the poses that were found; those of targets that the description does not name are left
            out.
        description: of the joints, in any order.
        sensitivities: for each frame, of each of its targets, (6, q) derivative of its pose (as in
            :attr:`TargetPose.covariance`) by q parameters of the cameras' calibration. None where these are known.
        shapes: for each frame, of each of its targets, (6, s) what the errors of its own geometry add to its pose
            (:func:`body_tracking.markers.corrections.shape_effects`). None where the targets are known.

    Raises:
        ChainError: sensitivities or shapes of another number of frames, not of all targets, or of other shapes.
        JointFitError: too few frames in which both targets of a joint are seen.
        TreeError: the joints are no tree.
        JointError: an invalid name.
        PoseTableError: as :func:`body_tracking.markers.pose_table.pose_table`.
    """
    zeros, ones = np.zeros(3), np.eye(3)
    tree = tree_of(
        [
            Joint(each.name, each.parent, each.child, each.kind, ones, zeros, ones, zeros, np.zeros((SIZE, SIZE)))
            for each in description
        ]
    )
    poses = pose_table(frames, tree.targets)
    known = 0
    shared = None if sensitivities is None else _shared(poses, sensitivities)
    if shared is not None:
        known = shared.shape[-1]
    if shapes is not None:
        own = _own(poses, shapes)
        shared = own if shared is None else np.concatenate([shared, own], axis=-1)
    rows: BoolArray = np.asarray(poses.seen.any(axis=1))
    poses, shared = poses.rows(rows), None if shared is None else shared[rows]
    fits = tuple(fit_joint(joint.name, joint.kind, poses, joint.parent, joint.child) for joint in tree.joints)
    warnings = [warning for fit in fits for warning in fit.warnings]
    found = maximise(tree.with_joints([fit.joint for fit in fits]), poses, MISFIT_WARNING, shared)
    if found.scale >= MISFIT_WARNING and not any(fit.scale >= MISFIT_WARNING for fit in fits):
        warnings.append(f"chain: errors are {found.scale:.2g} times the poses' noise, though each joint fits by itself")
    # the targets' errors, which are the same in all frames, have no parameters that others share
    of_shapes = found.sensitivity[:, known:]
    covariance = found.covariance + of_shapes @ of_shapes.T
    return ChainFit(
        Chain(found.tree.joints, covariance, found.sensitivity[:, :known], found.scale), fits, tuple(warnings)
    )


def _own(poses: PoseTable, shapes: Sequence[Mapping[str, FloatArray]]) -> FloatArray:
    """(n, m, 6, s) the effects of all targets' errors, which are each target's own: zeros for those of others."""
    parts = [_shared(poses, shapes, column) for column in range(len(poses.targets))]
    return np.concatenate(parts, axis=-1)


def _shared(poses: PoseTable, sensitivities: Sequence[Mapping[str, FloatArray]], only: int | None = None) -> FloatArray:
    """(n, m, 6, q) sensitivities of the poses of a table, of one target or all; zeros of those that are not seen."""
    if len(sensitivities) != len(poses):
        raise ChainError(f"sensitivities of {len(sensitivities)} frames, expected {len(poses)}")
    names = poses.targets if only is None else (poses.targets[only],)
    size = next((frame[name].shape[-1] for frame in sensitivities for name in names if name in frame), 0)
    result = np.zeros((*poses.seen.shape, 6, size))
    for row, index in np.argwhere(poses.seen):
        if only is not None and index != only:
            continue
        given = sensitivities[row].get(poses.targets[index])
        if given is None or given.shape != (6, size) or not np.isfinite(given).all():
            shape = "none" if given is None else str(given.shape)
            where = f"frame {row}, target {poses.targets[index]}"
            raise ChainError(f"{where}: sensitivities {shape}, expected (6, {size}) finite numbers")
        result[row, index] = given
    return result
