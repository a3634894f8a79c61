"""The body model frame by frame, for filters that do not estimate it."""

from __future__ import annotations

from collections import Counter

import numpy as np

from body_tracking.core.body_model import ModelError
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.inverse import Fit, InverseKinematics
from body_tracking.kinematics.lengths import SkeletonLengths
from body_tracking.kinematics.motion import joint_densities

_GAP_NS = NANOSECONDS // 2
"""Age from which the last pose is not used as a start."""
_POOR_FIT = 4.0
"""Cost per measured coordinate, where 0.5 is expected, from which the fit is repeated without a start."""
_STEPS, _TOLERANCE = 4, 2e-3
"""Largest number of steps of a fit that starts from the frame before, and the step size that ends it, rad and m."""
_MAX_RATE = 10.0
"""rad/s and m/s: prior standard deviation of a rate."""
_TRUNK = (Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER)


class SkeletonFit:
    """Inverse kinematics of one frame after the other, each started from the one before.

    The velocity is the least squares fit to the skeleton's velocities, whose standard deviations are the bounds of
    :mod:`body_tracking.kinematics.positional`.

    A new one has compiled its loops, or loaded them from the cache.

    Attributes:
        model: the body.
        lengths: the person's, from the frames so far.
        counters: event counts since the construction, for diagnostics.
    """

    def __init__(self) -> None:
        self.model = CompiledUpperBody()
        self.lengths = SkeletonLengths()
        self.counters: Counter[str] = Counter()
        self._inverse = InverseKinematics(self.model)
        self._densities = joint_densities()[self.model.joints]
        self._trunk: BoolArray = np.isin(self.model.joints, _TRUNK)
        self._last: ModelEstimate | None = None
        upright, lengths = self.model.neutral(), self.lengths.lengths
        self._inverse.solve(self.model.forward(upright, lengths).positions, np.ones(len(self._trunk)), lengths)

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
