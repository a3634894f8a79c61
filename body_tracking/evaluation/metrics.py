"""Errors of an estimated motion against the truth: pure functions on arrays.

There are two comparisons. *As it is*: each estimate against the truth at its own stamp and in its own frame, including
delay, calibration error and offset, as a robot would use it. *Aligned*: after one constant time shift and one rigid
transform over the whole recording, with the estimates interpolated linearly to 100 Hz, as in chapter 5.7 of
Schlagenhauf 2017 for a marker system (tables 5.3 and E.1).

Errors are also given without each joint's constant offset in the frame of its segment (``segments``).

Unknown values are NaN in every array; statistics are over values known in both, and NaN without any.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BONES, BoolArray, FloatArray, IntArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.segments import segment_frames

RATE = 100.0
"""Hz: rate of the marker system, to which the thesis interpolates (section 5.7.1)."""
MIN_SPEED = 0.02
"""m/s: RMS speed over joints, below which the delay is not observable."""

_LEVEL = 0.95
_NORMAL = float(np.sqrt(chdtri(1, 1.0 - _LEVEL)))
_ELLIPSOID = float(chdtri(3, 1.0 - _LEVEL))
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
_PARENTS, _CHILDREN = (np.array([bone[end] for bone in BONES], dtype=np.intp) for end in (0, 1))


class MetricsError(BodyTrackingError):
    """Raised when an estimate and a truth cannot be compared."""


class Curve:
    """Interpolation by cubic splines through samples, with separate splines on both sides of a gap."""

    def __init__(self, times: FloatArray, values: FloatArray, max_gap: float = np.inf) -> None:
        """Fit the splines.

        Args:
            times: (n,) s, increasing.
            values: (n, ...), NaN where unknown.
            max_gap: s; no interpolation between known samples farther apart.

        Raises:
            MetricsError: times that do not increase.
        """
        if not (np.diff(times) > 0.0).all():
            raise MetricsError(f"curve: {len(times)} times, which do not increase")
        self._shape = values.shape[1:]
        columns = values.reshape(len(times), -1)
        known = np.isfinite(columns)
        self._pieces: list[tuple[float, float, IntArray, CubicSpline]] = []
        patterns, members = np.unique(known, axis=1, return_inverse=True)
        for number, pattern in enumerate(patterns.T):
            own = np.flatnonzero(members.ravel() == number)
            knots = np.flatnonzero(pattern)
            for run in np.split(knots, np.flatnonzero(np.diff(times[knots]) > max_gap) + 1):
                if len(run) > 1:
                    spline = CubicSpline(times[run], columns[np.ix_(run, own)])
                    self._pieces.append((float(times[run[0]]), float(times[run[-1]]), own, spline))

    @property
    def span(self) -> tuple[float, float]:
        """First and last time with known values, s; NaN without any."""
        if not self._pieces:
            return float("nan"), float("nan")
        return min(piece[0] for piece in self._pieces), max(piece[1] for piece in self._pieces)

    def at(self, times: FloatArray) -> FloatArray:
        """(m, ...) values at (m,) s; NaN in gaps and beyond the ends."""
        values = np.full((len(times), int(np.prod(self._shape))), np.nan)
        for first, last, columns, spline in self._pieces:
            inside = np.flatnonzero((times >= first) & (times <= last))
            if len(inside):
                values[np.ix_(inside, columns)] = spline(times[inside])
        return values.reshape(len(times), *self._shape)


def sample(at: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    """(n, ...) values at (n,) times, linearly interpolated between (m, ...) values at (m,) increasing times.

    NaN where ``at`` is NaN or outside the times.
    """
    at = np.where((at >= times[0]) & (at <= times[-1]), at, np.nan)
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    share = ((at - times[after - 1]) / (times[after] - times[after - 1])).reshape(-1, *[1] * (values.ndim - 1))
    between: FloatArray = (1.0 - share) * values[after - 1] + share * values[after]
    return between


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Positions of joints over time.

    Attributes:
        times: (n,) s, increasing.
        positions: (n, 25, 3) metres, NaN where unknown.
        covariances: (n, 25, 3, 3) square metres, NaN or infinite where not stated; None if none are stated.
    """

    times: FloatArray
    positions: FloatArray
    covariances: FloatArray | None = None

    def at(self, times: FloatArray, max_gap: float) -> Trajectory:
        """Linear interpolation at (m,) s; unknown between samples more than ``max_gap`` s apart."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        unsure = (self.times[after] - self.times[after - 1] > max_gap) & ~np.isin(times, self.times)
        at = np.where(unsure, np.nan, times)
        covariances = self.covariances
        return Trajectory(
            times,
            sample(at, self.times, self.positions),
            None if covariances is None else sample(at, self.times, covariances),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Transform from estimate to truth: ``truth(t - delay) = rotation estimate(t) + translation`` (thesis, eq. 4.1).

    Attributes:
        delay: s by which the estimate lags the truth.
        rotation: (3, 3).
        translation: (3,) metres.
    """

    delay: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, estimate: Trajectory) -> Trajectory:
        """The estimate on the truth's clock and in its frame."""
        r = self.rotation
        covariances = None if estimate.covariances is None else r @ estimate.covariances @ r.T
        return Trajectory(estimate.times - self.delay, estimate.positions @ r.T + self.translation, covariances)


def find_delay(estimate: Trajectory, truth: Curve, window: float = 0.5, around: float = 0.0) -> float:
    """The constant delay of an estimate against the truth, by least squares (thesis, sections 4.3.2 and 5.7.1).

    Minimises the mean square of ``R e_j(t) + b_j - truth_j(t - delay)`` over times and joints. The rotation R and the
    joints' offsets b_j are free, with a closed form for each delay (Umeyama 1991, each joint about its own mean), so
    that neither frames nor joint centres have to agree. A grid search brackets the minimum for Brent's method.

    Args:
        estimate: at any times.
        truth: (..., 25, 3) metres.
        window: half width of the search, s.
        around: centre of the search, s.

    Returns:
        Seconds; NaN if the delay is not observable: RMS speed below 20 mm/s, overlap shorter than two windows, or the
        minimum at the edge of the search.
    """
    first, last = truth.span
    shown = estimate.times - around
    inside = (shown - window >= first) & (shown + window <= last)
    times, positions = estimate.times[inside], estimate.positions[inside]
    if len(times) < 4 or times[-1] - times[0] < 2.0 * window:
        return float("nan")

    def cost(delay: float) -> float:
        true = truth.at(times - delay)
        both = (known(positions) & known(true))[..., None]
        count = both.sum(axis=0)
        centred = []
        for each in (positions, true):
            there = np.where(both, each, 0.0)
            centred.append(np.where(both, each - there.sum(axis=0) / np.maximum(count, 1), 0.0).reshape(-1, 3))
        e, t = centred
        u, spread, vt = np.linalg.svd(t.T @ e)
        spread[2] *= np.sign(np.linalg.det(u @ vt))
        return float(((e**2).sum() + (t**2).sum() - 2.0 * spread.sum()) / max(int(count.sum()), 1))

    moved = (truth.at(times - around + 0.02) - truth.at(times - around - 0.02)).reshape(-1)
    if not np.sqrt(3.0 * _mean(moved**2)) / 0.04 > MIN_SPEED:
        return float("nan")
    grid = around + np.linspace(-window, window, 2 * int(np.ceil(window * 30.0)) + 1)
    costs = [cost(float(delay)) for delay in grid]
    best = int(np.argmin(costs))
    if not 0 < best < len(grid) - 1:
        return float("nan")
    found = minimize_scalar(
        cost, bounds=(grid[best - 1], grid[best + 1]), method="bounded", options={"xatol": 1e-5, "maxiter": 40}
    )
    return float(found.x)


def align(estimate: Trajectory, truth: Curve, delay: float) -> Alignment:
    """Least-squares rigid transform over all joints of the whole recording (thesis, section 5.7.1, eq. 5.1-5.7).

    Args:
        estimate: at its own times.
        truth: (..., 25, 3) metres.
        delay: s, from :func:`find_delay`.

    Raises:
        MetricsError: fewer than three common points, or collinear points.
    """
    true = truth.at(estimate.times - delay)
    both = known(estimate.positions) & known(true)
    try:
        rotation, translation = rigid_registration(true[both], estimate.positions[both])
    except CalibrationError as error:
        raise MetricsError(f"alignment in space: {error}") from error
    return Alignment(delay, rotation, translation)


def grid(first: float, last: float, rate: float = RATE) -> FloatArray:
    """(n,) s from first to last at a rate in Hz."""
    return first + np.arange(int(np.floor((last - first) * rate + 1e-6)) + 1) / rate


# --- joints


@dataclass(frozen=True, slots=True, eq=False)
class JointErrors:
    """Errors of k joints over time; metres. MAE and MAD as in the thesis's tables 5.2-5.3 and E.1.

    Attributes:
        frames: (k,) number of instants at which both are known.
        mae: (k, 3) mean absolute error along each axis.
        largest: (k, 3) largest absolute error (MAD).
        mean: (k,) mean distance.
        rms: (k,) root mean square distance.
        farthest: (k,) largest distance.
        offset: (k, 3) mean error in the frame of the joint's segment.
        fixed_mean: (k,) mean distance without the offset.
        fixed_rms: (k,) root mean square distance without the offset.
        covered: (k,) share of the frames with a stated covariance whose 95 % ellipsoid contains the truth.
    """

    frames: IntArray
    mae: FloatArray
    largest: FloatArray
    mean: FloatArray
    rms: FloatArray
    farthest: FloatArray
    offset: FloatArray
    fixed_mean: FloatArray
    fixed_rms: FloatArray
    covered: FloatArray


def joint_errors(found: FloatArray, true: FloatArray, covariances: FloatArray | None = None) -> JointErrors:
    """Compare joints at the same instants.

    Args:
        found: (n, 25, 3) metres.
        true: (n, 25, 3) metres.
        covariances: (n, 25, 3, 3) square metres, of ``found``; None if not stated.
    """
    error = np.where((known(found) & known(true))[..., None], found - true, np.nan)
    distance = np.linalg.norm(error, axis=-1)
    own = np.einsum("njba,njb->nja", segment_frames(true), error)
    offset = _mean(own)
    fixed = np.linalg.norm(own - offset, axis=-1)
    return JointErrors(
        frames=known(error).sum(axis=0),
        mae=_mean(np.abs(error)),
        largest=_max(np.abs(error)),
        mean=_mean(distance),
        rms=np.sqrt(_mean(distance**2)),
        farthest=_max(distance),
        offset=offset,
        fixed_mean=_mean(fixed),
        fixed_rms=np.sqrt(_mean(fixed**2)),
        covered=np.full(error.shape[1], np.nan) if covariances is None else position_coverage(error, covariances),
    )


def position_coverage(error: FloatArray, covariances: FloatArray) -> FloatArray:
    """Share of frames with the error inside the 95 % ellipsoid of its covariance (chi-square, 3 degrees of freedom).

    Args:
        error: (n, k, 3) metres.
        covariances: (n, k, 3, 3) square metres; ignored where not finite or not positive definite.

    Returns:
        (k,) from 0 to 1.
    """
    stated = known(error) & np.isfinite(covariances).all(axis=(-2, -1))
    safe = np.where(stated[..., None, None], covariances, np.eye(3))
    variances = np.linalg.eigvalsh(safe)
    stated &= variances[..., 0] > 1e-9 * variances[..., 2]
    safe[~stated] = np.eye(3)
    squared = (error * np.linalg.solve(safe, np.where(stated[..., None], error, 0.0)[..., None])[..., 0]).sum(axis=-1)
    return _mean(np.where(stated, squared <= _ELLIPSOID, np.nan))


def off_track(found: FloatArray, true: FloatArray, beyond: float) -> FloatArray:
    """Share of frames with a true joint in which the estimate is missing or farther away than ``beyond``.

    Args:
        found: (n, k, 3) metres.
        true: (n, k, 3) metres.
        beyond: metres.

    Returns:
        (k,) from 0 to 1.
    """
    tracked = np.linalg.norm(found - true, axis=-1) <= beyond
    return _mean(np.where(known(true), ~tracked, np.nan))


def jitter(times: FloatArray, found: FloatArray, true: FloatArray) -> FloatArray:
    """Jitter of each joint beyond the true motion, as the standard deviation of equivalent white noise.

    Excess of the estimate's mean squared third difference over the truth's at the same instants, divided by 20: the
    third difference of white noise with variance s^2 has the variance (1 + 9 + 9 + 1) s^2. Offsets, delay and slow
    errors have no influence.

    Args:
        times: (n,) s; only four consecutive frames with steps within a quarter of the median step are used.
        found: (n, k, 3) metres.
        true: (n, k, 3) metres at the same times.

    Returns:
        (k,) metres along one axis; 0 where the estimate is smoother than the truth.
    """
    if len(times) < len(_THIRD):
        return np.full(found.shape[1], np.nan)
    step = np.diff(times)
    even = np.lib.stride_tricks.sliding_window_view(np.abs(step / np.median(step) - 1.0) < 0.25, 3).all(axis=-1)
    both = (known(found) & known(true))[..., None]
    squares = []
    for positions in (found, true):
        windows = np.lib.stride_tricks.sliding_window_view(np.where(both, positions, np.nan), len(_THIRD), axis=0)
        squares.append(_mean((windows[even] @ _THIRD) ** 2))
    excess: FloatArray = np.sqrt(np.maximum(squares[0] - squares[1], 0.0).mean(axis=-1) / (_THIRD**2).sum())
    return excess


@dataclass(frozen=True, slots=True, eq=False)
class LengthErrors:
    """Errors of the lengths of the 24 bones of ``skeleton.BONES``; metres.

    Attributes:
        spread: (24,) standard deviation of the estimated length over time.
        true_spread: (24,) standard deviation of the true length.
        error: (24,) mean estimated minus mean true length, over common frames.
    """

    spread: FloatArray
    true_spread: FloatArray
    error: FloatArray


def length_errors(found: FloatArray, true: FloatArray) -> LengthErrors:
    """Compare segment lengths (thesis figure 5.14).

    Args:
        found: (n, 25, 3) metres.
        true: (n, 25, 3) metres.
    """
    lengths, right = (np.linalg.norm(each[:, _CHILDREN] - each[:, _PARENTS], axis=-1) for each in (found, true))
    both = np.isfinite(lengths) & np.isfinite(right)
    lengths, right = np.where(both, lengths, np.nan), np.where(both, right, np.nan)
    mean, true_mean = _mean(lengths), _mean(right)
    return LengthErrors(
        np.sqrt(_mean((lengths - mean) ** 2)), np.sqrt(_mean((right - true_mean) ** 2)), mean - true_mean
    )


# --- angles


@dataclass(frozen=True, slots=True, eq=False)
class AngleErrors:
    """Errors of m angles over time; radians.

    Attributes:
        frames: (m,) number of instants at which both are known.
        rmse: (m,) root mean square error.
        offset: (m,) mean error.
        fixed_rmse: (m,) root mean square error without the offset.
        mae: (m,) mean absolute error.
        largest: (m,) largest absolute error.
        covered: (m,) share of the frames with a stated standard deviation in which the error is within 1.96 of it.
    """

    frames: IntArray
    rmse: FloatArray
    offset: FloatArray
    fixed_rmse: FloatArray
    mae: FloatArray
    largest: FloatArray
    covered: FloatArray


def angle_errors(found: FloatArray, true: FloatArray, stddev: FloatArray | None = None) -> AngleErrors:
    """Compare angles at the same instants; differences wrap at 360 degrees. RMSE: thesis, eq. 4.2.

    Args:
        found: (n, m) radians.
        true: (n, m) radians.
        stddev: (n, m) radians; ignored where not finite or not positive. None if not stated.
    """
    error = wrapped(found - true)
    offset = _mean(error)
    covered = np.full(error.shape[1], np.nan)
    if stddev is not None:
        stated = np.isfinite(error) & np.isfinite(stddev) & (stddev > 0.0)
        covered = _mean(np.where(stated, np.abs(error) <= _NORMAL * stddev, np.nan))
    return AngleErrors(
        frames=np.isfinite(error).sum(axis=0),
        rmse=np.sqrt(_mean(error**2)),
        offset=offset,
        fixed_rmse=np.sqrt(_mean((error - offset) ** 2)),
        mae=_mean(np.abs(error)),
        largest=_max(np.abs(error)),
        covered=covered,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of n poses of one sensor.

    Attributes:
        rotation: (n,) radians.
        translation: (n,) metres, of the sensor.
        displacement: (n,) metres, of a point at the person's position.
    """

    rotation: FloatArray
    translation: FloatArray
    displacement: FloatArray


def pose_errors(
    rotations: FloatArray,
    translations: FloatArray,
    true_rotation: FloatArray,
    true_translation: FloatArray,
    place: FloatArray,
) -> PoseErrors:
    """Compare calibrated poses (sensor to world) with the true one.

    Args:
        rotations: (n, 3, 3).
        translations: (n, 3) metres.
        true_rotation: (3, 3).
        true_translation: (3,) metres.
        place: (3,) metres, the person's position in world.
    """
    turned = rotations @ true_rotation.T
    seen = true_rotation.T @ (place - true_translation)
    return PoseErrors(
        Rotation.from_matrix(turned).magnitude(),
        np.linalg.norm(translations - true_translation, axis=-1),
        np.linalg.norm(rotations @ seen + translations - place, axis=-1),
    )


def known(positions: FloatArray) -> BoolArray:
    """(...) mask of finite points (..., 3)."""
    return np.asarray(np.isfinite(positions).all(axis=-1))


def _mean(values: FloatArray) -> FloatArray:
    """Mean over the first axis, ignoring NaN and infinity."""
    there = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean: FloatArray = np.where(there, values, 0.0).sum(axis=0) / there.sum(axis=0)
    return mean


def _max(values: FloatArray) -> FloatArray:
    """Maximum over the first axis, ignoring NaN."""
    largest: FloatArray = np.fmax.reduce(values, axis=0, initial=np.nan)
    return largest
