"""Hand-eye calibration of a reference system's targets on the segments of an estimated body: mountings, world, clock.

Each target t is fixed on one segment. The segment's estimated orientation A (segment to world), the target's measured
orientation B (target to rig), the mounting X (target to segment) and the rig's orientation Z (rig to world) satisfy

    A_t(s) X_t = Z B_t(s + offset + drift (s - middle))                                                             (1)

at every time s of the estimate: robot-world/hand-eye calibration (Dornaika and Horaud 1998) with one Z for all targets.
Only orientations are used: positions give no angles without the segment lengths and joint centres of the estimate,
which are themselves under test.

**Start.** In closed form (Shah, J. Mechanisms Robotics 5 (2013) 031007): ``tr(Z^T A X B^T)``, summed over all times,
is bilinear in vec Z and vec X, so that the largest singular vector of the stacked sums of Kronecker products gives Z.

**Fit.** Gauss-Newton on the residuals, in the segment's frame,

    r = log((Z B X^T)^T A)                                                                                          (2)

with the scatter S_t of the estimate's errors, estimated from the residuals, plus the target's own covariance. Outliers
are downweighted by a multivariate Student distribution (Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989) 881).
A tracker's errors are correlated over time, so the variance of a target's scores is multiplied by the number of samples
per independent sample: the integral of the autocorrelation of its residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from body_tracking.calibration.clock_correlation import DRIFT_PRIOR, correlation_time
from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.joints import ONE_AXIS, SMALL_MOTION

MAX_GAP: Final = 0.1
"""Longest time between a target's samples for interpolation of its orientation, seconds."""
MIN_SAMPLES: Final = 60
"""Least number of instants with both a segment and its target: 2 s of a camera at 30 Hz."""
_FREEDOM: Final = 5.0
"""Degrees of freedom of the Student distribution: 5 keeps 91 % of the efficiency for normal errors."""
_MEDIAN_3: Final = 2.366
"""Median of the chi squared distribution with three degrees of freedom."""
_LEAST_SCATTER: Final = np.radians(0.05) ** 2
_ITERATIONS, _CONVERGED = 60, 1e-6
_FARTHEST: Final = 0.15
"""Largest correction of the clock by the fit, seconds."""


class HandEyeError(BodyTrackingError):
    """Raised if the motion does not determine mountings and world."""


class Sampled(NamedTuple):
    """A track at n times.

    Attributes:
        rotations: (n, 3, 3); the identity where unknown.
        covariances: (n, 3, 3) square radians about the fixed axes.
        known: (n,).
    """

    rotations: FloatArray
    covariances: FloatArray
    known: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """An orientation over time.

    Attributes:
        times: (n,) s, strictly increasing.
        rotations: (n, 3, 3) from the own frame to a fixed one.
        covariances: (n, 3, 3) square radians of w such that the true rotation is ``exp(w) @ rotation``.
    """

    times: FloatArray
    rotations: FloatArray
    covariances: FloatArray

    def at(self, times: FloatArray, max_gap: float = MAX_GAP) -> Sampled:
        """Interpolation along the shortest rotation between two samples at most ``max_gap`` seconds apart."""
        if len(self.times) < 2:
            count = len(times)
            zeros = np.zeros((count, 3, 3))
            return Sampled(zeros + np.eye(3), zeros, np.zeros(count, dtype=np.bool_))
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        before = after - 1
        gap = self.times[after] - self.times[before]
        share = (times - self.times[before]) / gap
        known: BoolArray = (share >= 0.0) & (share <= 1.0) & (gap <= max_gap)
        share = np.where(known, share, 0.0)[:, None]
        start = self.rotations[before]
        turn = so3.rotation_vectors(start.swapaxes(-1, -2) @ self.rotations[after])
        rotations = np.where(known[:, None, None], start @ so3.quat_to_matrix(so3.exp(share * turn)), np.eye(3))
        # interpolating two samples with independent noise reduces the variance
        mixed = (1.0 - share[..., None]) ** 2 * self.covariances[before]
        mixed = mixed + share[..., None] ** 2 * self.covariances[after]
        return Sampled(rotations, mixed, known)

    def rates(self, times: FloatArray, span: float = 2.0 * MAX_GAP) -> FloatArray:
        """(n, 3) rad/s about the own axes, from the rotation over ``span`` seconds around each time; NaN if unknown."""
        start, end = self.at(times - 0.5 * span), self.at(times + 0.5 * span)
        turn = so3.rotation_vectors(start.rotations.swapaxes(-1, -2) @ end.rotations) / span
        result: FloatArray = np.where((start.known & end.known)[:, None], turn, np.nan)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """A target's orientation on its segment, known beforehand.

    Attributes:
        rotation: (3, 3) target to segment.
        covariance: (3, 3) square radians of w in the segment's frame: the true rotation is ``exp(w) @ rotation``.
    """

    rotation: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """The solution of eq. 1 for k targets.

    Attributes:
        world: (3, 3) Z, rig to world.
        mountings: (k, 3, 3) X, target to segment.
        clock: (2,) offset in seconds at ``middle``, and drift: targets' clock minus the estimate's.
        middle: s on the estimate's clock.
        covariance: (3 k + 5, 3 k + 5): per mounting of ``w`` in its segment's frame, the true one being
            ``exp(w) @ mounting``; of the world's ``w`` likewise, in the world's frame; of the clock. Rows and columns
            of parameters that are not fitted are zero.
        residuals: (n, k, 3) radians, eq. 2; NaN where a segment or its target is unknown.
        motion: (3,) RMS rotation of all targets about the principal axes of their motion in the rig, radians, the
            largest first.
    """

    world: FloatArray
    mountings: FloatArray
    clock: FloatArray
    middle: float
    covariance: FloatArray
    residuals: FloatArray
    motion: FloatArray

    def to_reference(self, times: FloatArray) -> FloatArray:
        """(n,) times on the estimate's clock converted to the targets' clock, s."""
        result: FloatArray = times + self.clock[0] + self.clock[1] * (times - self.middle)
        return result

    def mounting_stddev(self, target: int) -> float:
        """Standard deviation of a mounting per axis, radians: root of the mean of its variances."""
        return float(np.sqrt(self.covariance.diagonal()[3 * target : 3 * target + 3].mean()))

    @property
    def world_stddev(self) -> float:
        """Standard deviation of the world per axis, radians."""
        return float(np.sqrt(self.covariance.diagonal()[-5:-2].mean()))


def closed_form(segments: FloatArray, targets: FloatArray, known: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Z and X of eq. 1 for equal clocks (Shah 2013, section 3).

    Args:
        segments: (n, k, 3, 3) A.
        targets: (n, k, 3, 3) B.
        known: (n, k) whether both are known.

    Returns:
        (3, 3) world and (k, 3, 3) mountings.
    """
    weight = known.astype(np.float64)
    # vec Z^T K vec X, row by row: K[ab, cd] = A[a, c] B[b, d]
    sums = np.einsum("nk,nkac,nkbd->kabcd", weight, segments, targets, optimize=True).reshape(-1, 9, 9)
    left = np.linalg.svd(np.concatenate(sums / np.maximum(weight.sum(axis=0), 1.0)[:, None, None], axis=1))[0]
    world = left[:, 0].reshape(3, 3)
    world = so3.nearest_rotation(world * np.sign(np.linalg.det(world)))
    return world, mountings_in(world, segments, targets, known)


def mountings_in(world: FloatArray, segments: FloatArray, targets: FloatArray, known: BoolArray) -> FloatArray:
    """(k, 3, 3) X of eq. 1 for a given Z; other arguments as in :func:`closed_form`."""
    weight = known.astype(np.float64)
    return so3.nearest_rotation(np.einsum("nk,nkca,cd,nkdb->kab", weight, segments, world, targets, optimize=True))


def principal_motion(targets: FloatArray, known: BoolArray) -> FloatArray:
    """(3,) :attr:`HandEye.motion` of orientations (n, k, 3, 3) with mask (n, k)."""
    scatter, count = np.zeros((3, 3)), 0
    for number in range(targets.shape[1]):
        there = targets[known[:, number], number]
        if len(there):
            turns = so3.rotation_vectors(there @ so3.nearest_rotation(there.sum(axis=0)).T)
            scatter, count = scatter + turns.T @ turns, count + len(turns)
    motion: FloatArray = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter / max(count, 1))[::-1], 0.0))
    return motion


def fit_hand_eye(
    times: FloatArray,
    segments: FloatArray,
    targets: Sequence[Track],
    names: Sequence[str],
    clock: FloatArray,
    *,
    fit_clock: bool = True,
    middle: float | None = None,
    known_mountings: dict[str, Mounting] | None = None,
) -> HandEye:
    """Solve eq. 1.

    Args:
        times: (n,) s, increasing.
        segments: (n, k, 3, 3) A, NaN where unknown.
        targets: k tracks B.
        names: of the k targets.
        clock: (2,) initial offset at ``middle`` and drift, correct to within 0.15 s.
        fit_clock: whether to fit the clock too.
        middle: s of ``times`` at which the offset holds; None for the mean time.
        known_mountings: by target, fixed X. If they were fitted, the estimate's constant errors would be absorbed by
            them.

    Raises:
        HandEyeError: too few instants, or a motion that is small or about one axis only.
    """
    fit = _Fit(times, segments, targets, names, clock, middle, known_mountings or {})
    fit.start()
    fit.descend(fit_clock)
    return fit.result(fit_clock)


class _Normal(NamedTuple):
    """Normal equations.

    Attributes:
        scores: (n, k, p) gradient of the cost by instant and target.
        information: (k, p, p) by target.
        weights: (n, k) of the Student distribution; 0 where unknown.
        distance: (n, k) squared Mahalanobis distance of the residuals.
        known: (n, k).
    """

    scores: FloatArray
    information: FloatArray
    weights: FloatArray
    distance: FloatArray
    known: BoolArray


class _Fit:
    """State of the Gauss-Newton iteration; parameters as in :attr:`HandEye.covariance`."""

    def __init__(
        self,
        times: FloatArray,
        segments: FloatArray,
        targets: Sequence[Track],
        names: Sequence[str],
        clock: FloatArray,
        middle: float | None,
        known_mountings: dict[str, Mounting],
    ) -> None:
        self.times, self.targets, self.names = times, targets, tuple(names)
        self.seen: BoolArray = np.asarray(np.isfinite(segments).all(axis=(-1, -2)))
        self.segments = np.where(self.seen[..., None, None], segments, np.eye(3))
        self.middle = float(times.mean()) if middle is None else middle
        self.clock, self.begin = clock.copy(), clock.copy()
        self.size = 3 * len(targets) + 5
        self.fixed: BoolArray = np.array([name in known_mountings for name in names])
        self.given = np.zeros((self.size, self.size))
        self.mountings = np.broadcast_to(np.eye(3), (len(targets), 3, 3)).copy()
        for number, name in enumerate(names):
            if name in known_mountings:
                where = slice(3 * number, 3 * number + 3)
                self.given[where, where] = known_mountings[name].covariance
                self.mountings[number] = known_mountings[name].rotation

    def sample(self) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Targets' rotations and covariances at the present clock, and a mask of known instants, (n, k, ...)."""
        sampled = [target.at(self._at) for target in self.targets]
        rotations, covariances, known = (np.stack(each, axis=1) for each in zip(*sampled, strict=True))
        return rotations, covariances, known & self.seen

    @property
    def _at(self) -> FloatArray:
        """(n,) the estimate's times on the targets' clock, s."""
        at: FloatArray = self.times + self.clock[0] + self.clock[1] * (self.times - self.middle)
        return at

    def start(self) -> None:
        rotations, _, known = self.sample()
        for name, count in zip(self.names, known.sum(axis=0).tolist(), strict=True):
            if count < MIN_SAMPLES:
                raise HandEyeError(
                    f"target {name}: known together with its segment at {count} instants, {MIN_SAMPLES} are needed"
                )
        self.motion = principal_motion(rotations, known)
        first, second, _ = np.degrees(self.motion)
        least = np.degrees(SMALL_MOTION)
        moved = f"the targets turned by {first:.2g} deg RMS about one axis and by {second:.2g} about a second"
        if not self.fixed.any() and (second < least or second < ONE_AXIS * first):
            raise HandEyeError(
                f"{moved}; mountings and world are not determined unless the second is at least {least:.0f} deg and a "
                f"tenth of the first: every target on a segment that moves, or another motion"
            )
        if self.fixed.any():
            weight, there = known[:, self.fixed], (self.segments @ self.mountings)[:, self.fixed]
            self.world = so3.nearest_rotation(
                np.einsum("nk,nkac,nkbc->ab", weight, there, rotations[:, self.fixed], optimize=True)
            )
            found = mountings_in(self.world, self.segments, rotations, known)
            self.mountings = np.where(self.fixed[:, None, None], self.mountings, found)
        else:
            self.world, self.mountings = closed_form(self.segments, rotations, known)
        residuals = self.residuals(rotations)
        squares = (residuals**2).sum(axis=-1)
        self.scatter = np.stack(
            [np.eye(3) * np.median(squares[known[:, k], k]) / _MEDIAN_3 for k in range(len(self.names))]
        )

    def residuals(self, rotations: FloatArray) -> FloatArray:
        """(n, k, 3) eq. 2."""
        return so3.rotation_vectors(self.mountings @ rotations.swapaxes(-1, -2) @ self.world.T @ self.segments)

    def descend(self, fit_clock: bool) -> None:
        free = self._free(fit_clock)
        for _ in range(_ITERATIONS):
            normal = self._normal()
            information, gradient = normal.information.sum(axis=0), normal.scores.sum(axis=(0, 1))
            information[-1, -1] += DRIFT_PRIOR**-2
            gradient[-1] += self.clock[1] * DRIFT_PRIOR**-2
            step = np.zeros(self.size)
            step[free] = np.linalg.solve(information[np.ix_(free, free)], -gradient[free])
            step[-2] = np.clip(step[-2], -0.05, 0.05)
            self._move(step)
            if np.abs(step).max() < _CONVERGED:
                break
        if abs(self.clock[0] - self.begin[0]) > _FARTHEST:
            raise HandEyeError(
                f"the orientations fit best at an offset of the clocks {1e3 * (self.clock[0] - self.begin[0]):.0f} ms "
                "from that of the angular speeds: a target is on another segment than stated, or the estimate is not "
                "of this movement"
            )

    def _normal(self) -> _Normal:
        """Normal equations at the present state; updates the scatter."""
        rotations, covariances, known = self.sample()
        # rates exclude the sample at the instant itself, whose noise is in the residual too
        rates = np.stack([target.rates(self._at) for target in self.targets], axis=1)
        residuals = self.residuals(rotations)
        n, k = known.shape
        to_segment = self.mountings @ rotations.swapaxes(-1, -2)
        own = to_segment @ covariances @ to_segment.swapaxes(-1, -2)
        precision = np.linalg.inv(self.scatter + own + _LEAST_SCATTER * np.eye(3))
        distance = np.einsum("nki,nkij,nkj->nk", residuals, precision, residuals)
        weights = np.where(known, (_FREEDOM + 3.0) / (_FREEDOM + distance), 0.0)
        turning = np.nan_to_num((self.mountings @ rates[..., None])[..., 0])
        derivative = np.zeros((n, k, 3, self.size))
        for number in range(k):
            derivative[:, number, :, 3 * number : 3 * number + 3] = np.eye(3)
        derivative[..., -5:-2] = -self.segments.swapaxes(-1, -2)
        derivative[..., -2] = -turning
        derivative[..., -1] = -turning * (self.times - self.middle)[:, None, None]
        weighted = weights[..., None, None] * precision @ derivative
        scores = np.einsum("nkip,nki->nkp", weighted, residuals)
        information = np.einsum("nkip,nkiq->kpq", weighted, derivative, optimize=True)
        shares = weights / np.maximum(known.sum(axis=0), 1)
        scatter = np.einsum("nk,nki,nkj->kij", shares, residuals, residuals)
        scatter -= np.einsum("nk,nkij->kij", known / np.maximum(known.sum(axis=0), 1), own)
        values, axes = np.linalg.eigh(scatter)
        self.scatter = (axes * np.maximum(values, _LEAST_SCATTER)[:, None]) @ axes.swapaxes(-1, -2)
        return _Normal(scores, information, weights, distance, known)

    def _free(self, fit_clock: bool) -> IntArray:
        """Indices of the fitted parameters."""
        free = np.ones(self.size, dtype=np.bool_)
        free[:-5] = ~np.repeat(self.fixed, 3)
        free[-2:] = fit_clock
        return np.flatnonzero(free)

    def _move(self, step: FloatArray) -> None:
        turns = so3.quat_to_matrix(so3.exp(step[:-2].reshape(-1, 3)))
        self.mountings, self.world = turns[:-1] @ self.mountings, turns[-1] @ self.world
        self.clock = self.clock + step[-2:]

    def result(self, fit_clock: bool) -> HandEye:
        """The solution with the sandwich covariance (White 1980).

        The scatter of the scores includes common errors of the targets, e.g. of the pelvis, the root of all segments.
        """
        normal = self._normal()
        residuals = np.where(normal.known[..., None], self.residuals(self.sample()[0]), np.nan)
        free, given = self._free(fit_clock), np.flatnonzero(np.repeat(self.fixed, 3))
        bends, samples = np.array([self._factors(normal, residuals, k) for k in range(len(self.names))]).T
        information = np.tensordot(bends, normal.information, axes=1)
        scores = np.tensordot(normal.scores, np.sqrt(samples), axes=([1], [0]))
        middle = scores.T @ scores
        information[-1, -1] += DRIFT_PRIOR**-2
        middle[-1, -1] += DRIFT_PRIOR**-2
        inverse = np.linalg.inv(information[np.ix_(free, free)])
        # errors of the given mountings propagate to the fitted parameters
        moves = np.eye(self.size)
        moves[np.ix_(free, given)] = -inverse @ information[np.ix_(free, given)]
        covariance = moves @ self.given @ moves.T
        covariance[np.ix_(free, free)] += inverse @ middle[np.ix_(free, free)] @ inverse
        return HandEye(self.world, self.mountings, self.clock, self.middle, covariance, residuals, self.motion)

    def _factors(self, normal: _Normal, residuals: FloatArray, target: int) -> tuple[float, float]:
        """Second derivative of a target's cost relative to its information, and samples per independent sample.

        The weights fall with growing residuals, which subtracts 2/3 of ``w d / (freedom + d)`` from the second
        derivative.
        """
        known = normal.known[:, target]
        weights, distance = normal.weights[known, target], normal.distance[known, target]
        bend = float((weights - 2.0 / 3.0 * weights * distance / (_FREEDOM + distance)).mean())
        step = float(np.median(np.diff(self.times[known])))
        columns = (weights[:, None] * residuals[known, target]).T
        correlated = [correlation_time(column - column.mean(), step) / step for column in columns]
        return bend / float(weights.mean()), float(np.mean(correlated))
