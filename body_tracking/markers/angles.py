"""Angles of all joints of a chain from the poses of its targets at one instant (Gaschler 2011, 5.1.3 and 5.2.4).

One weighted least squares fit of the chain's coordinates to all poses: the position of a target says as much of a
joint's angle as its orientation does, each by its covariance, and a target that is not seen is left out. A ball joint
has three angles, turns about the x, y and z axes of the parent target one after the other (intrinsic), which are
continuous over time (:mod:`body_tracking.kinematics.euler`); a hinge has one, a universal joint two.
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
"""Radians: a coordinate with a larger standard deviation is not known: its target is not seen."""
_LOOSE: Final = 1e-2
"""Information of a coordinate's step, 1/rad^2 and 1/m^2, beside that of the poses, 1e6 and more: the matrix can
be inverted where the root target is not seen, and what is seen does not move."""
_ITERATIONS: Final = 20
_CONVERGED: Final = 1e-5
"""Radians and metres of a step after which there is none; the error left is about its square."""
_TURN: Final = 2.0 * np.pi
_EVER: Final = 360e3
"""Degrees: no range is more usual than another, so that no angle ever jumps by a turn."""
_XYZ: Final = EulerAngles(
    (np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])),
    ((-_EVER, _EVER), (-_EVER, _EVER), (-_EVER, _EVER)),
)
_SINGULAR: Final = np.pi / np.sqrt(3.0)
"""Radians: the standard deviation of an angle that may be anything, as the outer ones where their axes coincide."""


class AngleError(BodyTrackingError):
    """Sensitivities that do not go with the chain's targets or with the covariance of the calibration."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainAngles:
    """Angles of a chain at one time; k angles of j joints.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        names: of the angles.
        angles: (k,) radians, continuous over time; NaN where the target that would show them is not seen.
        stddev: (k,) radians, of all below together; infinity where the angle is NaN.
        noise: (k,) radians, what of it is from the noise of the poses,
        model: (k,) radians, from the chain's covariance, and
        calibration: (k,) radians, from the calibration of the cameras, which the chain was measured by too where its
            sensitivity is known. The last two are the same errors in all frames.
        rotations: (j, 3, 3) each joint's turn (:mod:`body_tracking.markers.joint_model`), NaN likewise.
        rotation_covariance: (j, 3, 3) square radians, of w such that the true turn is ``exp(w) @ rotation``.
        scale: root of the reduced chi squared of the fit; NaN where there are no more poses than coordinates.
        gaps: (j,) metres between each joint's centre as its parent has it and as its child has it (Gaschler's residual,
            section 5.1.3); NaN where one of both is not seen.
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
    """The angles of a chain, frame by frame; keeps nothing but the last posture and angles, to be continuous."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self._tree = chain.tree
        self._posture: Posture | None = None
        self._previous = np.full(len(chain.angle_names), np.nan)
        self._balls = [index for index, joint in enumerate(chain.joints) if joint.kind is JointKind.BALL]
        self._euler = EulerSequences([_XYZ] * len(self._balls)) if self._balls else None
        self._misfit = chain.scale**2 if chain.scale >= MISFIT_WARNING else 1.0

    def reset(self) -> None:
        """Forget the last angles: the next ones are those nearest to zero."""
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
            poses: of the targets that were found; those of targets of no joint are left out.
            sensitivities: of each target (6, p) derivative of its pose (as in :attr:`TargetPose.covariance`) by p
                parameters of the cameras' calibration.
            calibration: (p, p) covariance of these.

        Raises:
            PoseTableError: no pose of the chain's targets, or as :func:`body_tracking.markers.pose_table.pose_table`.
            AngleError: sensitivities of other shapes, of not all the targets, or without a covariance.
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
        """(m, 6, p) sensitivities of all targets, zeros of those that are not seen, and (p, p)."""
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
        """The angles of a posture; the solution is its whitened derivatives, its covariance and the squared errors."""
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
        """(k,) angles, their (k, size) derivative by the coordinates, and (k,) whether each is not known."""
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
        """(b, 3) the last angles of all ball joints, or None at the beginning."""
        near = np.stack([self._previous[self._rows(index)] for index in self._balls])
        unknown = np.isnan(near)
        return None if unknown.all() else np.where(unknown, 0.0, near)

    def _rows(self, index: int) -> slice:
        where = self._tree.slices[index]
        return slice(where.start - ROOT, where.stop - ROOT)

    def _turns(self, posture: Posture, covariance: FloatArray, known: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(j, 3, 3) turns and their covariance, NaN where they are not known."""
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
