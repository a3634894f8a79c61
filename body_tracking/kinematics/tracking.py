"""Joint angles and segment lengths, one instant after the other.

:class:`AngleStream` computes joint angles in any convention; :class:`LengthChanges` decides when to publish segment
lengths.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import BONE_CORRELATION
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.kinematics.conventions import CONVENTIONS, ConventionError, angles_of, convention
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from body_tracking.kinematics.upper_body import UpperBody

if TYPE_CHECKING:
    from body_tracking.kinematics.skeleton_fit import SkeletonFit

POSITIONAL = "positional"
"""The convention of :mod:`body_tracking.kinematics.positional`, which needs no model."""

ALL_CONVENTIONS: tuple[str, ...] = (*CONVENTIONS, POSITIONAL)


def angle_names(name: str) -> tuple[str, ...]:
    """The angles of one of ``ALL_CONVENTIONS``, in order.

    Raises:
        ConventionError: unknown convention.
    """
    return ANGLE_NAMES if name == POSITIONAL else convention(name, UpperBody()).names


_BAND = 1.96
"""Standard deviations of a 95 % band."""
_DOUBT_S = 0.2
"""Seconds in which the doubt about an angle that has jumped falls to 1 / e."""


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
        self._fit: SkeletonFit | None = None
        self._previous: JointAngles | None = None
        self._doubt = JumpDoubt()
        self._forget_after_ns, self._of_bones = forget_after * NANOSECONDS, of_bones

    def reset(self) -> None:
        """Forget the person."""
        if self._fit is not None:
            self._fit.reset()
        self._doubt.reset()
        self._previous = None

    @property
    def counters(self) -> Counter[str]:
        """Events of the fits of the model to skeletons."""
        return Counter() if self._fit is None else self._fit.counters

    def prepare(self) -> SkeletonFit:
        """The fit of the model to skeletons; the first call compiles its loops, or loads them from the cache."""
        if self._fit is None:
            from body_tracking.kinematics.skeleton_fit import SkeletonFit  # imports numba: half a second

            self._fit = SkeletonFit()
        return self._fit

    def of_skeleton(self, skeleton: Skeleton) -> JointAngles | None:
        """The angles of one frame; None if the convention needs a model and no trunk is seen."""
        self._reset_after_gap(skeleton.stamp_ns)
        if self.convention == POSITIONAL:
            self._previous = positional_angles(skeleton, self._of_bones)
            return self._doubt(self._previous)
        estimate = self.prepare().update(skeleton)
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
