"""Angles of all joints of a chain from the poses of its targets at one instant (Gaschler 2011, 5.1.3 and 5.2.4).

One weighted least squares fit of the chain's coordinates to all target poses: positions and orientations both count,
each weighted by its covariance; targets that are not seen are left out. A ball joint has three angles, intrinsic
rotations about the x, y and z axes of the parent target, continuous over time (:mod:`body_tracking.kinematics.euler`);
a hinge has one angle, a universal joint two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.kinematics.euler import EulerAngles, EulerSequences
from body_tracking.markers.chain import Chain
from body_tracking.markers.joint_model import SIZE, Joint, JointKind, turn_angles, turn_axes
from body_tracking.markers.joint_tree import ROOT, Posture, first_posture, numbers_of
from body_tracking.markers.joints import MISFIT_WARNING
from body_tracking.markers.observations import TargetPose
from body_tracking.markers.pose_table import PoseTable, PoseTableError, pose_table
from body_tracking.markers.tree_loops import adjusted

UNKNOWN: Final = 1.0
"""Radians: a coordinate with a larger standard deviation counts as unknown, because its target is not seen."""
_LOOSE: Final = 1e-2
"""Prior information of a coordinate's step, 1/rad^2 and 1/m^2; the poses give 1e6 and more. The matrix stays
invertible where the root target is not seen, and visible targets are not biased."""
_ITERATIONS: Final = 20
_CONVERGED: Final = 1e-5
"""Radians and metres: the iteration ends at a smaller step; the remaining error is about the step's square."""
_TURN: Final = 2.0 * np.pi
_EVER: Final = 360e3
"""Degrees: ranges so wide that no angle is ever moved by a full turn to fit its range."""
_XYZ: Final = EulerAngles(
    (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])),
    ((-_EVER, _EVER), (-_EVER, _EVER), (-_EVER, _EVER)),
)
_SINGULAR: Final = np.pi / np.sqrt(3.0)
"""Radians: standard deviation of a uniformly distributed angle, as of the outer angles where their axes coincide."""


class AngleError(BodyTrackingError):
    """Raised for sensitivities that do not match the chain's targets or the covariance of the calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainAngles:
    """Angles of a chain at one time: k angles of j joints.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        names: of the angles.
        angles: (k,) radians, continuous over time; NaN where the joint's target is not seen.
        stddev: (k,) radians, total of the three parts below; infinity where the angle is NaN.
        noise: (k,) radians, part by the noise of the poses.
        model: (k,) radians, part by the chain's covariance.
        calibration: (k,) radians, part by the calibration of the cameras, correlated with the chain's own dependence on
            it where the chain's sensitivity is known. ``model`` and ``calibration`` are constant errors in all frames.
        rotations: (j, 3, 3) each joint's turn (:mod:`body_tracking.markers.joint_model`), NaN likewise.
        rotation_covariance: (j, 3, 3) square radians, of w such that the true turn is ``exp(w) @ rotation``.
        scale: root of the reduced chi squared of the fit; NaN where there are no more poses than coordinates.
        gaps: (j,) metres between each joint's centre by its parent's pose and by its child's (Gaschler's residual,
            section 5.1.3); NaN where parent or child is not seen.
    """

    stamp_ns: int
    names: tuple[str, ...]
    angles: FloatArray
    stddev: FloatArray
    noise: FloatArray
    model: FloatArray
    calibration: FloatArray
    rotations: FloatArray
    rotation_covariance: FloatArray
    scale: float
    gaps: FloatArray


class AngleEstimator:
    """Estimates the angles of a chain frame by frame; its only state is the last posture and angles, for continuity."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self._tree = chain.tree
        self._posture: Posture | None = None
        self._previous = np.full(len(chain.angle_names), np.nan)
        self._balls = [index for index, joint in enumerate(chain.joints) if joint.kind is JointKind.BALL]
        self._euler = EulerSequences([_XYZ] * len(self._balls)) if self._balls else None
        self._misfit = chain.scale**2 if chain.scale >= MISFIT_WARNING else 1.0

    def reset(self) -> None:
        """Forget the last angles; the next ones are the solution nearest to zero."""
        self._posture = None
        self._previous[:] = np.nan

    def estimate(
        self,
        poses: Sequence[TargetPose],
        sensitivities: Mapping[str, FloatArray] | None = None,
        calibration: FloatArray | None = None,
    ) -> ChainAngles:
        """The angles at one instant.

        Gaschler (2011): eq. 5.6; eq. 5.7; eq. 5.18.

        Args:
            poses: of the targets found; targets outside the chain are ignored.
            sensitivities: by target, (6, p) derivative of its pose (as in :attr:`TargetPose.covariance`) by the p
                parameters of the cameras' calibration.
            calibration: (p, p) covariance of these parameters.

        Raises:
            PoseTableError: no pose of the chain's targets, or as :func:`body_tracking.markers.pose_table.pose_table`.
            AngleError: sensitivities missing for a target, of another shape, or without a covariance.
        """
        table = pose_table([poses], self._tree.targets)
        if not table.seen.any():
            raise PoseTableError(f"poses: none of a target of the chain ({', '.join(self._tree.targets)})")
        systematic = self._systematic(table, sensitivities, calibration)
        start = first_posture(self._tree, table, self._posture).arrays()
        measured = table.rotations, table.translations, table.seen, table.whitening
        limits = _LOOSE, _CONVERGED, _ITERATIONS
        solution = adjusted(numbers_of(self._tree), start, measured, self._tree.size, *limits)
        self._posture = Posture(start[0], start[1], tuple(start[2]))
        return self._stated(poses[0].stamp_ns, table, self._posture, solution, systematic)

    def _systematic(
        self, table: PoseTable, sensitivities: Mapping[str, FloatArray] | None, calibration: FloatArray | None
    ) -> tuple[FloatArray, FloatArray] | None:
        """Sensitivities (m, 6, p) of all targets, zero where not seen, and the (p, p) covariance of the calibration."""
        if sensitivities is None:
            return None
        size = 0 if calibration is None else len(calibration)
        result = np.zeros((len(self._tree.targets), 6, size))
        for index, target in enumerate(self._tree.targets):
            if table.seen[0, index]:
                given = sensitivities.get(target)
                if calibration is None or given is None or given.shape != (6, size):
                    shape = "none" if given is None else str(given.shape)
                    raise AngleError(f"target {target}: sensitivities {shape}, expected (6, {size}) as the calibration")
                result[index] = given
        assert calibration is not None
        if self.chain.sensitivity.shape[1] not in (0, size):
            raise AngleError(
                f"calibration of {size} parameters, expected {self.chain.sensitivity.shape[1]} as the chain's"
            )
        return result, calibration

    def _stated(
        self,
        stamp_ns: int,
        table: PoseTable,
        posture: Posture,
        solution: tuple[FloatArray, FloatArray, float],
        systematic: tuple[FloatArray, FloatArray] | None,
    ) -> ChainAngles:
        """Angles of a posture; ``solution``: whitened derivatives, covariance, sum of squared residuals."""
        tree, size = self._tree, self._tree.size
        white, covariance, squares = solution
        gain = covariance @ white[:, :size].T
        by_joints = gain @ white[:, size:]
        parts = np.zeros((3, size, size))
        parts[0] = self._misfit * covariance
        parts[1] = by_joints @ self.chain.covariance @ by_joints.T
        if systematic is not None:
            by_poses = gain.reshape(size, len(tree.targets), 6).swapaxes(0, 1) @ table.whitening[0]
            by_calibration = (by_poses @ systematic[0]).sum(axis=0)
            if self.chain.sensitivity.shape[1]:
                by_calibration = by_calibration - by_joints @ self.chain.sensitivity
            parts[2] = by_calibration @ systematic[1] @ by_calibration.T
        known = covariance.diagonal() < UNKNOWN**2
        angles, gradient, unknown = self._angles(posture, parts.sum(axis=0), known)
        variances = np.minimum(((gradient @ parts) * gradient).sum(axis=-1), _SINGULAR**2)
        variances[:, unknown] = np.inf
        total = np.minimum(variances.sum(axis=0), np.where(unknown, np.inf, _SINGULAR**2))

        freedom = 6 * int(table.seen.sum()) - int(known.sum())
        turns, turn_covariance = self._turns(posture, parts.sum(axis=0), known)
        return ChainAngles(
            stamp_ns,
            self.chain.angle_names,
            angles,
            np.sqrt(total),
            np.sqrt(variances[0]),
            np.sqrt(variances[1]),
            np.sqrt(variances[2]),
            turns,
            turn_covariance,
            float(np.sqrt(squares / freedom)) if freedom > 0 else float("nan"),
            self._gaps(table),
        )

    def _angles(
        self, posture: Posture, covariance: FloatArray, known: BoolArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Angles (k,), their (k, size) derivative by the coordinates, and (k,) whether each angle is unknown."""
        tree, count = self._tree, len(self._previous)
        angles, gradient, unknown = np.empty(count), np.zeros((count, tree.size)), np.zeros(count, dtype=bool)
        split = None
        if self._euler is not None:
            turns = np.concatenate([posture.turns[index] for index in self._balls])
            variances = np.stack([covariance.diagonal()[tree.slices[index]] for index in self._balls])
            split = self._euler.split(turns, variances, self._near())
        ball = 0
        for joint, where, turns in zip(tree.joints, tree.slices, posture.turns, strict=True):
            rows = slice(where.start - ROOT, where.stop - ROOT)
            unknown[rows] = not known[where].all()
            if joint.kind is JointKind.BALL:
                assert split is not None
                angles[rows], gradient[rows, where] = split.angles[ball], split.gradients[ball]
                ball += 1
                continue
            near = np.where(np.isnan(self._previous[rows]), 0.0, self._previous[rows])
            found = turn_angles(joint.kind, turns)[0]
            angles[rows] = found + _TURN * np.rint((near - found) / _TURN)
            gradient[rows, where] = np.eye(len(found))
        self._previous = np.where(unknown, self._previous, angles)
        return np.where(unknown, np.nan, angles), gradient, unknown

    def _near(self) -> FloatArray | None:
        """(b, 3) last angles of all ball joints; None before the first frame."""
        starts = [self._tree.slices[index].start - ROOT for index in self._balls]
        near = np.stack([self._previous[start : start + 3] for start in starts])
        unknown = np.isnan(near)
        return None if unknown.all() else np.where(unknown, 0.0, near)

    def _turns(self, posture: Posture, covariance: FloatArray, known: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Turns (j, 3, 3) and their covariance, NaN where unknown."""
        tree = self._tree
        turns = np.concatenate(posture.turns)
        result = np.empty((len(turns), 3, 3))
        for index, (joint, where) in enumerate(zip(tree.joints, tree.slices, strict=True)):
            axes = turn_axes(joint.kind, turns[index : index + 1])[0]
            result[index] = axes @ covariance[where, where] @ axes.T
            if not known[where].all():
                turns[index] = result[index] = np.nan
        return turns, result

    def _gaps(self, table: PoseTable) -> FloatArray:
        rotations, translations, seen = table.rotations[0], table.translations[0], table.seen[0]
        gaps = np.full(len(self._tree.joints), np.nan)
        for index, (joint, parent) in enumerate(zip(self._tree.joints, self._tree.parents, strict=True)):
            if seen[parent] and seen[index + 1]:
                apart = translations[parent] + rotations[parent] @ joint.parent_centre - translations[index + 1]
                apart = apart - rotations[index + 1] @ joint.child_centre
                gaps[index] = np.sqrt(apart @ apart)
        return gaps


def prepare() -> None:
    """Compile the loops, or load them, before the first poses: two targets and a hinge."""
    place, turn = np.zeros(3), np.eye(3)
    joint = Joint("hinge", "parent", "child", JointKind.HINGE, turn, place, turn, place, np.zeros((SIZE, SIZE)))
    poses = [TargetPose(name, 0, "", turn, place, 1e-6 * np.eye(6), np.arange(3), 0.0) for name in ("parent", "child")]
    AngleEstimator(Chain((joint,), joint.covariance, np.zeros((SIZE, 0)))).estimate(poses)
