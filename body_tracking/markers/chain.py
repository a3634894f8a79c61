"""A kinematic chain: a tree of targets connected by joints, fitted as a whole (Gaschler 2011, section 5.3)."""

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
    """Raised for a chain with inconsistent parts."""


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Joints and targets of a tree, with covariance.

    Attributes:
        joints: each after its parent, in the order of :func:`body_tracking.markers.joint_tree.tree_of`.
        covariance: (12 j, 12 j) of the parameters of all joints, as :attr:`Joint.covariance`.
        sensitivity: (12 j, q) derivative of the parameters by the q parameters of the calibration of the cameras that
            measured the recording; (12 j, 0) if unknown.
        scale: root of the reduced chi squared of the fit. From 1.3 on, the targets move against the chain by more than
            the noise of their poses, and the standard deviations of angles are multiplied by the scale.
        tree: derived from the joints.

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
    """A joint to be fitted: its name, parent and child targets, and kind."""

    name: str
    parent: str
    child: str
    kind: JointKind


@dataclass(frozen=True, slots=True, eq=False)
class ChainFit:
    """A fitted chain and its quality.

    Attributes:
        chain: with its covariance.
        joints: fit of each joint alone, in the chain's order.
        warnings: one line per problem.
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

    The fits of single joints initialise the joint adjustment; targets may be missing in any frame.

    Args:
        frames: per instant the poses found; targets that the description does not name are ignored.
        description: of the joints, in any order.
        sensitivities: per frame, by target, (6, q) derivative of its pose (as in :attr:`TargetPose.covariance`) by q
            parameters of the cameras' calibration. None where these are exactly known.
        shapes: per frame, by target, (6, s) effects of the errors of its own geometry on its pose
            (:func:`body_tracking.markers.corrections.shape_effects`). None where the targets are exactly known.

    Raises:
        ChainError: sensitivities or shapes for another number of frames, missing for a target, or of another shape.
        JointFitError: too few frames with both targets of a joint.
        TreeError: the joints form no tree.
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
        # each target has columns of its own
        own = np.concatenate([_shared(poses, shapes, column) for column in range(len(poses.targets))], axis=-1)
        shared = own if shared is None else np.concatenate([shared, own], axis=-1)
    rows: BoolArray = np.asarray(poses.seen.any(axis=1))
    poses, shared = poses.rows(rows), None if shared is None else shared[rows]
    fits = tuple(fit_joint(joint.name, joint.kind, poses, joint.parent, joint.child) for joint in tree.joints)
    warnings = [warning for fit in fits for warning in fit.warnings]
    found = maximise(tree.with_joints([fit.joint for fit in fits]), poses, MISFIT_WARNING, shared)
    if found.scale >= MISFIT_WARNING and not any(fit.scale >= MISFIT_WARNING for fit in fits):
        warnings.append(f"chain: errors are {found.scale:.2g} times the poses' noise, though each joint fits by itself")
    # shape errors are constant over the frames, and nothing else depends on them
    of_shapes = found.sensitivity[:, known:]
    covariance = found.covariance + of_shapes @ of_shapes.T
    return ChainFit(
        Chain(found.tree.joints, covariance, found.sensitivity[:, :known], found.scale), fits, tuple(warnings)
    )


def _shared(poses: PoseTable, sensitivities: Sequence[Mapping[str, FloatArray]], only: int | None = None) -> FloatArray:
    """(n, m, 6, q) sensitivities of the poses of a table, of one target or all; zero for poses not seen."""
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
