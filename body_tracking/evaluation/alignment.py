"""Compare two recordings of one movement that share no clock.

Sensors that were not synchronised, and recordings that were cut separately, differ in where they start and, a little,
in how fast their clocks ran. Classical dynamic time warping (Sakoe and Chiba 1978) is the wrong cure where errors are
to be measured afterwards: it moves every single sample to where the values agree best, and so takes noise, lag and
differences of amplitude for differences of time (its "singularities": Keogh and Pazzani 2001). The warp here is smooth
and has few degrees of freedom, as in curve registration (Ramsay and Li 1998), and its criterion is the share of
variance left over after each feature was given an offset and a gain of its own. Hence it is blind to bias and scale,
which are what the comparison is to measure, and it has too few parameters to follow noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize

from body_tracking.errors import BodyTrackingError
from body_tracking.skeleton import BoolArray, FloatArray


class AlignmentError(BodyTrackingError):
    """Two series cannot be aligned or compared."""


@dataclass(frozen=True, slots=True)
class WarpParameters:
    """What warps are thought possible.

    Attributes:
        intervals: of linearly changing rate; one more than this are the degrees of freedom besides the offset.
        rates: least and most overall rate (reference seconds per second) that the search tries.
        least_overlap: share of the samples that must fall into the reference, 0 to 1.
        bend: cost of a change of the logarithm of the rate by 1 over one interval, in shares of the variance.
        drift: cost of a mean logarithm of the rate of 1 (clocks are nominally right), in shares of the variance.
    """

    intervals: int = 4
    rates: tuple[float, float] = (0.6, 1.7)
    least_overlap: float = 0.6
    bend: float = 0.02
    drift: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class TimeWarp:
    """A smooth, strictly increasing map from the times of one recording to those of another.

    Attributes:
        knots: (k,) s, in the recording's own time.
        values: (k,) s, the reference's time at the knots; beyond its end in a later period where ``period`` is given.
        rates: (k,) > 0, derivative at the knots, linear in between.
        span: (first, last) time of the reference, s.
        period: s by which the reference repeats itself, or None.
        explained: share of the features' variance that the aligned reference explains, 0 to 1.
    """

    knots: FloatArray
    values: FloatArray
    rates: FloatArray
    span: tuple[float, float]
    period: float | None
    explained: float

    def __call__(self, times: FloatArray) -> FloatArray:
        """(n,) times of the recording, s, to (n,) times of the reference; NaN where it has none."""
        # a cubic with the values and slopes of a parabola is that parabola
        mapped: FloatArray = CubicHermiteSpline(self.knots, self.values, self.rates)(times)
        return _within(mapped, self.span, self.period)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How one series agrees with another.

    Attributes:
        samples: how many were compared.
        correlation: Pearson's, NaN where one of the series is constant.
        bias: mean of estimate minus reference, in the series' unit.
        rms: root mean square of the difference.
        debiased_rms: the same after the bias was taken off.
        gain: slope of the estimate over the reference (least squares), NaN where the reference is constant.
    """

    samples: int
    correlation: float
    bias: float
    rms: float
    debiased_rms: float
    gain: float


def compare(estimate: FloatArray, reference: FloatArray) -> Agreement:
    """Statistics of ``estimate - reference`` over the samples where both are finite.

    Args:
        estimate: (n,).
        reference: (n,), same unit.

    Raises:
        AlignmentError: shapes that differ, or fewer than two samples in common.
    """
    if estimate.shape != reference.shape or estimate.ndim != 1:
        raise AlignmentError(f"compare: shapes {estimate.shape} and {reference.shape}, expected (n,) twice")
    known = np.isfinite(estimate) & np.isfinite(reference)
    if known.sum() < 2:
        raise AlignmentError(f"compare: {known.sum()} samples in common, expected at least 2")
    a, b = estimate[known], reference[known]
    difference = a - b
    covariance = np.cov(a, b, bias=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
        gain = covariance[0, 1] / covariance[1, 1]
    return Agreement(
        samples=int(known.sum()),
        correlation=float(correlation),
        bias=float(difference.mean()),
        rms=float(np.sqrt((difference**2).mean())),
        debiased_rms=float(difference.std()),
        gain=float(gain),
    )


def estimate_warp(
    times: FloatArray,
    features: FloatArray,
    reference_times: FloatArray,
    reference_features: FloatArray,
    *,
    period: float | None = None,
    parameters: WarpParameters | None = None,
) -> TimeWarp:
    """The warp under which the reference explains most of the features' variance.

    Minimises ``1 - R^2 + bend * sum (change of log rate)^2 + drift * (mean log rate)^2``, with ``R^2`` pooled over the
    features after a regression of each on its aligned reference (offset free, gain not negative), first over a grid of
    straight lines, then from the best of these over all parameters (Nelder and Mead 1965).

    Args:
        times: (n,) increasing, s.
        features: (n, f), in units that make the f comparable, such as the components of unit vectors.
        reference_times: (m,) increasing, s.
        reference_features: (m, f).
        period: where the reference is one cycle of a movement that repeats, its length in s: it is continued
            periodically, and all samples overlap.
        parameters: the defaults where None.

    Raises:
        AlignmentError: shapes that do not fit, values that are not finite, times that do not increase, features
            that do not move, or no overlap that the parameters allow.
    """
    p = parameters or WarpParameters()
    _check(times, features, "features")
    _check(reference_times, reference_features, "reference features")
    if features.shape[1] != reference_features.shape[1]:
        raise AlignmentError(f"warp: {features.shape[1]} features and {reference_features.shape[1]} of the reference")
    if not features.std(axis=0).any() or not reference_features.std(axis=0).any():
        raise AlignmentError("warp: the features do not move, which leaves the time undetermined")
    span = (float(reference_times[0]), float(reference_times[-1]))
    knots = np.linspace(times[0], times[-1], p.intervals + 1)
    width = knots[1] - knots[0]

    def values_and_rates(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        rates = np.exp(x[1:])
        steps = 0.5 * width * (rates[1:] + rates[:-1])
        return x[0] + np.concatenate([[0.0], np.cumsum(steps)]), rates

    def mapped(x: FloatArray) -> FloatArray:
        values, rates = values_and_rates(x)
        return _within(CubicHermiteSpline(knots, values, rates)(times), span, period)

    def unexplained(at: FloatArray) -> float:
        inside = np.isfinite(at)
        if inside.sum() < max(3.0, p.least_overlap * len(times)):
            return np.inf
        return _unexplained(features[inside], _interpolate(at[inside], reference_times, reference_features))

    def cost(x: FloatArray) -> float:
        return unexplained(mapped(x)) + p.bend * float((np.diff(x[1:]) ** 2).sum()) + p.drift * float(x[1:].mean() ** 2)

    length, reference_length = float(times[-1] - times[0]), span[1] - span[0]
    step = max(0.02 * max(length, reference_length), 1e-3)
    starts: list[tuple[float, FloatArray]] = []
    for rate in np.geomspace(*p.rates, 27):
        first, last = (0.0, period) if period is not None else (-rate * length, reference_length)
        for offset in np.arange(span[0] + first, span[0] + last, step):
            x = np.concatenate([[offset], np.full(p.intervals + 1, np.log(rate))])
            at = _within(offset + rate * (times - times[0]), span, period)
            starts.append((unexplained(at) + p.drift * float(np.log(rate) ** 2), x))
    value, start = min(starts, key=lambda each: each[0])
    if not np.isfinite(value):
        raise AlignmentError(f"warp: no shift lets {p.least_overlap:.0%} of the samples overlap")
    simplex = np.vstack([start, start + np.diag([5.0 * step, *[0.15] * (p.intervals + 1)])])
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 4000, "xatol": 1e-4, "fatol": 1e-7},
    )
    best = found.x if found.fun < value else start
    values, rates = values_and_rates(best)
    return TimeWarp(knots, values, rates, span, period, 1.0 - unexplained(mapped(best)))


def sample(at: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    """Values at other times, linearly in between.

    Args:
        at: (n,) s, NaN where no value is wanted.
        times: (m,) increasing, s.
        values: (m,) or (m, f).

    Returns:
        (n,) or (n, f); NaN where ``at`` is NaN or outside of the times.
    """
    inside = (at >= times[0]) & (at <= times[-1])
    sampled = _interpolate(np.where(inside, at, times[0]), times, values)
    sampled[~inside] = np.nan
    return sampled


def _check(times: FloatArray, features: FloatArray, what: str) -> None:
    if features.ndim != 2 or times.shape != features.shape[:1] or len(times) < 3:
        raise AlignmentError(
            f"warp: {what} of shape {features.shape} at times of shape {times.shape}, expected (n, f), n > 2"
        )
    if not (np.isfinite(times).all() and np.isfinite(features).all()):
        raise AlignmentError(f"warp: {what} or their times are not finite")
    if (np.diff(times) <= 0.0).any():
        raise AlignmentError(f"warp: the times of the {what} do not increase")


def _within(at: FloatArray, span: tuple[float, float], period: float | None) -> FloatArray:
    """Times of the reference; NaN where it has none."""
    if period is not None:
        at = span[0] + np.mod(at - span[0], period)
        # where the cycle is a little longer than what was recorded of it, its end stands for the rest
        return np.minimum(at, span[1])
    inside: BoolArray = (at >= span[0]) & (at <= span[1])
    return np.where(inside, at, np.nan)


def _interpolate(at: FloatArray, times: FloatArray, values: FloatArray) -> FloatArray:
    """Linear interpolation of all columns at once."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    share = (at - times[after - 1]) / (times[after] - times[after - 1])
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    between: FloatArray = (1.0 - share) * values[after - 1] + share * values[after]
    return between


def _unexplained(features: FloatArray, reference: FloatArray) -> float:
    """1 - R^2, pooled over the features, of regressions with free offsets and gains that are not negative."""
    y, x = features - features.mean(axis=0), reference - reference.mean(axis=0)
    total, xx, xy = float((y**2).sum()), (x**2).sum(axis=0), np.maximum((x * y).sum(axis=0), 0.0)
    if total <= 0.0:
        return np.inf
    explained = np.divide(xy**2, xx, out=np.zeros_like(xx), where=xx > 0.0)
    return 1.0 - float(explained.sum()) / total
