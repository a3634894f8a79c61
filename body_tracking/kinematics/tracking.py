"""The body model frame by frame, for filters that do not estimate it.

:class:`SkeletonFit` fits ``upper_body`` to filtered joint positions; :class:`AngleStream` computes joint angles in any
convention; :class:`LengthChanges` decides when to publish segment lengths.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import ModelError
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import BONE_CORRELATION
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton
from body_tracking.kinematics.conventions import CONVENTIONS, ConventionError, angles_of, convention
from body_tracking.kinematics.inverse import Fit, InverseKinematics
from body_tracking.kinematics.lengths import SkeletonLengths
from body_tracking.kinematics.motion import joint_densities
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from body_tracking.kinematics.upper_body import UpperBody

POSITIONAL = "positional"
"""The convention of :mod:`body_tracking.kinematics.positional`, which needs no model."""

ALL_CONVENTIONS: tuple[str, ...] = (*CONVENTIONS, POSITIONAL)


def angle_names(name: str) -> tuple[str, ...]:
    """The angles of one of ``ALL_CONVENTIONS``, in order.

    Raises:
        ConventionError: unknown convention.
    """
    return ANGLE_NAMES if name == POSITIONAL else convention(name, UpperBody()).names


_GAP_NS = NANOSECONDS // 2
"""Age from which the last pose is not used as a start."""
_POOR_FIT = 4.0
"""Cost per measured coordinate, where 0.5 is expected, from which the fit is repeated without a start."""
_STEPS, _TOLERANCE = 4, 2e-3
"""Largest number of steps of a fit that starts from the frame before, and the step size that ends it, rad and m."""
_MAX_RATE = 10.0
"""rad/s and m/s: prior standard deviation of a rate."""
_BAND = 1.96
"""Standard deviations of a 95 % band."""
_DOUBT_S = 0.2
"""Seconds in which the doubt about an angle that has jumped falls to 1 / e."""
_TRUNK = (Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER)


class SkeletonFit:
    """Inverse kinematics of one frame after the other, each started from the one before.

    The velocity is the least squares fit to the skeleton's velocities, whose standard deviations are the bounds of
    :mod:`body_tracking.kinematics.positional`.

    Attributes:
        model: the body.
        lengths: the person's, from the frames so far.
        counters: event counts since the construction, for diagnostics.
    """

    def __init__(self, model: UpperBody | None = None) -> None:
        self.model = model or UpperBody()
        self.lengths = SkeletonLengths()
        self.counters: Counter[str] = Counter()
        self._inverse = InverseKinematics(self.model)
        self._densities = joint_densities()[self.model.joints]
        self._trunk: BoolArray = np.isin(self.model.joints, _TRUNK)
        self._last: ModelEstimate | None = None

    def reset(self) -> None:
        """Forget the person; the counters stay."""
        self.lengths.reset()
        self._last = None

    def update(self, skeleton: Skeleton) -> ModelEstimate | None:
        """The model at one frame.

        Args:
            skeleton: in a frame with z up, with covariances; usually ``/filtered/skeleton``.

        Returns:
            The estimate, without covariance between coordinates and rates; without velocities in the skeleton the rates
            are NaN with an infinite variance. None where no trunk is seen.
        """
        if self._last is not None and not 0 <= skeleton.stamp_ns - self._last.stamp_ns <= _GAP_NS:
            self._last = None
        positions = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)[self.model.joints]
        variance = self._variance(skeleton)
        self.lengths.update(skeleton.stamp_ns, positions, variance)
        measured = np.isfinite(positions).all(axis=1) & np.isfinite(variance)
        fit = self._fit(skeleton.stamp_ns, positions, np.sqrt(variance), measured)
        if fit is None:
            self.counters["no trunk"] += 1
            self._last = None
            return None
        self.counters["frames"] += 1
        nv = self.model.nv
        covariance = np.zeros((2 * nv, 2 * nv))
        covariance[:nv, :nv] = fit.covariance
        velocity, covariance[nv:, nv:] = self._velocity(skeleton, fit.q, variance, measured)
        self._last = ModelEstimate(
            skeleton.stamp_ns,
            skeleton.frame_id,
            skeleton.body,
            fit.q,
            velocity,
            covariance,
            self.lengths.lengths,
            self.lengths.stddev,
        )
        return self._last

    def _variance(self, skeleton: Skeleton) -> FloatArray:
        """(19,) square metres per axis; infinity where the skeleton has no positive one."""
        if skeleton.covariances is None:
            return np.full(len(self.model.joints), np.inf)
        diagonal = skeleton.covariances[self.model.joints].diagonal(axis1=1, axis2=2)
        return np.where((diagonal > 0.0).all(axis=1), diagonal.mean(axis=1), np.inf)

    def _fit(self, stamp_ns: int, positions: FloatArray, stddev: FloatArray, measured: BoolArray) -> Fit | None:
        if np.count_nonzero(measured & self._trunk) < 2:
            return None
        lengths = self.lengths.lengths
        try:
            if self._last is None:
                return self._inverse.solve(positions, stddev, lengths)
            elapsed = (stamp_ns - self._last.stamp_ns) / NANOSECONDS
            moved = np.where(np.isfinite(self._last.velocity), elapsed * self._last.velocity, 0.0)
            start = self.model.integrate(self._last.q, moved)
            fit = self._inverse.solve(positions, stddev, lengths, start, max_iterations=_STEPS, tolerance=_TOLERANCE)
            if fit.cost > _POOR_FIT * 3.0 * np.count_nonzero(measured):
                self.counters["poor fits"] += 1
                anew = self._inverse.solve(positions, stddev, lengths)
                fit = anew if anew.cost < fit.cost else fit
        except ModelError:
            return None
        return fit

    def _velocity(
        self, skeleton: Skeleton, q: FloatArray, variance: FloatArray, measured: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """(nv,) tangent velocity and (nv, nv) its covariance."""
        nv = self.model.nv
        if skeleton.velocities is None:
            return np.full(nv, np.nan), np.diag(np.full(nv, np.inf))
        velocities = skeleton.velocities[self.model.joints]
        known = measured & np.isfinite(velocities).all(axis=1)
        bound = np.cbrt(3.0 * self._densities**2 * np.where(known, variance, 1.0))
        weights = np.repeat(np.where(known, 1.0 / bound, 0.0), 3)
        jacobian = self.model.linearise(q, self.lengths.lengths).jacobian.reshape(-1, nv)
        weighted = jacobian * weights[:, None]
        information = weighted.T @ jacobian
        information[np.arange(nv), np.arange(nv)] += _MAX_RATE**-2
        covariance = np.linalg.inv(information).astype(np.float64)
        velocity = covariance @ (weighted.T @ np.where(known[:, None], velocities, 0.0).reshape(-1))
        return velocity, covariance


class JumpDoubt:
    """Adds to the deviations of angles that have jumped.

    Where two successive estimates of an angle lie farther apart than both their 95 % bands allow, one of them was
    wrong, and nothing says which: sides were swapped, a limb was found again, or the convention's angles jumped back
    into their usual ranges. The deviation then covers the value before, and returns to the stated one within half a
    second or so.
    """

    def __init__(self) -> None:
        self._last: JointAngles | None = None
        self._doubt: FloatArray = np.zeros(0)

    def reset(self) -> None:
        """Forget the person."""
        self._last = None

    def __call__(self, angles: JointAngles) -> JointAngles:
        """The angles of the next instant, with their deviations, radians."""
        last, self._last = self._last, angles
        if last is None or last.names != angles.names:
            self._doubt = np.zeros(len(angles.names))
            return angles
        seconds = (angles.stamp_ns - last.stamp_ns) / NANOSECONDS
        moved = np.nan_to_num(0.5 * seconds * (last.velocity + angles.velocity))
        step = np.abs(so3.wrapped(angles.position - last.position - moved))
        jumped = step > _BAND * np.hypot(last.position_stddev, angles.position_stddev)  # never where one is NaN
        self._doubt *= math.exp(-max(seconds, 0.0) / _DOUBT_S)
        self._doubt = np.where(jumped, np.maximum(self._doubt, step / _BAND), self._doubt)
        return replace(angles, position_stddev=np.hypot(angles.position_stddev, self._doubt))


class AngleStream:
    """Joint angles in one convention, of skeletons or of states of ``upper_body``, one instant after the other.

    Args:
        convention: one of ``ALL_CONVENTIONS``.
        forget_after: seconds without the person after which the next frame is of another one.
        of_bones: correlation of the errors of the two joints of a bone, for positional angles.

    Raises:
        ConventionError: unknown convention.
    """

    def __init__(self, convention: str, forget_after: float = math.inf, of_bones: float = BONE_CORRELATION) -> None:
        if convention not in ALL_CONVENTIONS:
            raise ConventionError(f"angle convention {convention!r}: not one of {', '.join(ALL_CONVENTIONS)}")
        self.convention = convention
        self.model = UpperBody()
        self.fit = SkeletonFit(self.model)
        self._previous: JointAngles | None = None
        self._doubt = JumpDoubt()
        self._forget_after_ns, self._of_bones = forget_after * NANOSECONDS, of_bones

    def reset(self) -> None:
        """Forget the person."""
        self.fit.reset()
        self._doubt.reset()
        self._previous = None

    def of_skeleton(self, skeleton: Skeleton) -> JointAngles | None:
        """The angles of one frame; None if the convention needs a model and no trunk is seen."""
        self._reset_after_gap(skeleton.stamp_ns)
        if self.convention == POSITIONAL:
            self._previous = positional_angles(skeleton, self._of_bones)
            return self._doubt(self._previous)
        estimate = self.fit.update(skeleton)
        return None if estimate is None else self.of_estimate(estimate)

    def of_estimate(self, estimate: ModelEstimate) -> JointAngles:
        """The angles of one state of the model.

        Raises:
            ConventionError: the convention is :data:`POSITIONAL`.
        """
        self._reset_after_gap(estimate.stamp_ns)
        angles = angles_of(estimate, self.model, self.convention, self._previous)
        self._previous = angles
        return self._doubt(angles)

    def _reset_after_gap(self, stamp_ns: int) -> None:
        if self._previous is not None and stamp_ns - self._previous.stamp_ns > self._forget_after_ns:
            self.reset()


class LengthChanges:
    """Decides when to publish segment lengths: at first, when they change, and when they settle."""

    TOLERANCE = 0.002
    """Least difference of a length from the published one, metres."""
    PERIOD_NS = NANOSECONDS
    """Least time between two publications."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._published: FloatArray | None = None
        self._published_ns = 0
        self._before: FloatArray | None = None

    def due(self, stamp_ns: int, lengths: FloatArray) -> bool:
        """Whether to publish these (n,) lengths, metres, of this capture time; if so, they count as published."""
        settled = self._before is not None and np.array_equal(self._before, lengths)
        self._before = lengths
        if self._published is not None:
            if 0 <= stamp_ns - self._published_ns < self.PERIOD_NS:
                return False
            change = float(np.abs(lengths - self._published).max())
            if change <= self.TOLERANCE and not (settled and change > 0.0):
                return False
        self._published, self._published_ns = lengths, stamp_ns
        return True


def state_estimate(
    model: UpperBody, stamp_ns: int, frame_id: str, q: FloatArray, velocity: FloatArray, covariance: FloatArray
) -> ModelEstimate:
    """An estimate of the pose, with default lengths of infinite standard deviation.

    Args:
        model: the body.
        stamp_ns: capture time, nanoseconds.
        frame_id: of the base.
        q: (nq,) configuration.
        velocity: (nv,) tangent velocity.
        covariance: (2 nv, 2 nv) of both.
    """
    lengths = model.default_lengths()
    return ModelEstimate(stamp_ns, frame_id, 0, q, velocity, covariance, lengths, np.full(len(lengths), np.inf))


def segment_poses(estimate: ModelEstimate, model: UpperBody) -> tuple[FloatArray, FloatArray]:
    """(12, 3) origins and (12, 4) quaternions xyzw of the segments, in the estimate's frame."""
    posture = model.forward(estimate.q, estimate.lengths)
    return posture.origins, so3.matrix_to_quat(posture.rotations)
