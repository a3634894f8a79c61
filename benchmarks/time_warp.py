"""Compare two recordings of one movement without a common clock.

Sensors that were not synchronised, and recordings that were cut separately, differ in their starts and, slightly, in
the rates of their clocks. Classical dynamic time warping (Sakoe and Chiba 1978) is unsuitable if errors are to be
measured afterwards: it moves every single sample to where the values agree best, and so takes noise, lag and
differences of amplitude for differences of time (its "singularities": Keogh and Pazzani 2001). The warp here is smooth
and has few degrees of freedom, as in curve registration (Ramsay and Li 1998). Its criterion is the share of variance
left after a regression of each feature with its own offset and gain. Hence it is blind to bias and scale, which the
comparison is to measure, and it has too few parameters to follow noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize

from body_tracking.core.skeleton import FloatArray
from body_tracking.evaluation.metrics import sample

INTERVALS = 4
"""Number of intervals with a linearly changing rate; the warp has one more rate than this, and an offset."""
RATES = (0.6, 1.7)
"""Smallest and largest overall rate (reference seconds per second) in the search."""
LEAST_OVERLAP = 0.6
"""Smallest share of the samples that must fall into the reference."""
BEND, DRIFT = 0.02, 0.02
"""Cost of a change of the log rate by 1 over one interval, and of a mean log rate of 1 (clocks are nominally right),
as shares of the variance."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeWarp:
    """A smooth, strictly increasing map from the times of one recording to those of another.

    Attributes:
        knots: (k,) s, in the recording's own time.
        values: (k,) s, the reference's time at the knots; with a ``period`` it may be in a later cycle.
        rates: (k,) > 0, derivative at the knots, linear in between.
        span: (first, last) time of the reference, s.
        period: of the reference, s, or None.
        explained: share of the features' variance explained by the aligned reference, 0 to 1.
    """

    knots: FloatArray
    values: FloatArray
    rates: FloatArray
    span: tuple[float, float]
    period: float | None
    explained: float = float("nan")

    def __call__(self, times: FloatArray) -> FloatArray:
        """(n,) times of the recording, s, to (n,) times of the reference; NaN outside the reference."""
        # a cubic with the values and slopes of a parabola equals that parabola
        at: FloatArray = CubicHermiteSpline(self.knots, self.values, self.rates)(times)
        first, last = self.span
        if self.period is not None:
            # if the cycle is a little longer than its recording, use the recording's end for the rest
            return np.minimum(first + np.mod(at - first, self.period), last)
        return np.where((at >= first) & (at <= last), at, np.nan)


@dataclass(frozen=True, slots=True)
class Agreement:
    """How one series agrees with another.

    Attributes:
        samples: number of compared samples.
        bias: mean of estimate minus reference, in the series' unit.
        rms: root mean square of the difference.
        debiased_rms: the same without the bias.
    """

    samples: int
    bias: float
    rms: float
    debiased_rms: float


def compare(estimate: FloatArray, reference: FloatArray) -> Agreement:
    """Statistics of ``estimate - reference``, (n,) each, over the samples where both are finite."""
    known = np.isfinite(estimate) & np.isfinite(reference)
    difference = estimate[known] - reference[known]
    return Agreement(
        samples=int(known.sum()),
        bias=float(difference.mean()),
        rms=float(np.sqrt((difference**2).mean())),
        debiased_rms=float(difference.std()),
    )


def estimate_warp(
    times: FloatArray,
    features: FloatArray,
    reference_times: FloatArray,
    reference_features: FloatArray,
    *,
    period: float | None = None,
) -> TimeWarp:
    """The warp under which the reference explains most of the features' variance.

    Minimises ``1 - R^2 + BEND * sum (change of log rate)^2 + DRIFT * (mean log rate)^2``. ``R^2`` is pooled over the
    features after a regression of each on its aligned reference (offset free, gain not negative). The search begins
    with a grid of straight lines; the best of these starts an optimisation of all parameters (Nelder and Mead 1965).

    Args:
        times: (n,) increasing, s.
        features: (n, f), in units that make the f comparable, such as the components of unit vectors.
        reference_times: (m,) increasing, s.
        reference_features: (m, f).
        period: length of the reference in s if it is one cycle of a periodic movement: it is continued periodically,
            and all samples overlap.

    Raises:
        ValueError: no shift gives enough overlap.
    """
    span = (float(reference_times[0]), float(reference_times[-1]))
    knots = np.linspace(times[0], times[-1], INTERVALS + 1)
    width = knots[1] - knots[0]

    def warp(x: FloatArray) -> TimeWarp:
        rates = np.exp(x[1:])
        steps = 0.5 * width * (rates[1:] + rates[:-1])
        return TimeWarp(knots, x[0] + np.concatenate([[0.0], np.cumsum(steps)]), rates, span, period)

    def unexplained(x: FloatArray) -> float:
        at = warp(x)(times)
        inside = np.isfinite(at)
        if inside.sum() < max(3.0, LEAST_OVERLAP * len(times)):
            return np.inf
        return _unexplained(features[inside], sample(at[inside], reference_times, reference_features))

    def cost(x: FloatArray) -> float:
        return unexplained(x) + BEND * float((np.diff(x[1:]) ** 2).sum()) + DRIFT * float(x[1:].mean() ** 2)

    length, reference_length = float(times[-1] - times[0]), span[1] - span[0]
    step = max(0.02 * max(length, reference_length), 1e-3)
    first, last = (0.0, period) if period is not None else (None, reference_length)
    starts = [
        np.concatenate([[offset], np.full(INTERVALS + 1, np.log(rate))])
        for rate in np.geomspace(*RATES, 27)
        for offset in np.arange(span[0] + (-rate * length if first is None else first), span[0] + last, step)
    ]
    start = min(starts, key=cost)
    if not np.isfinite(cost(start)):
        raise ValueError(f"warp: no shift lets {LEAST_OVERLAP:.0%} of the samples overlap")
    simplex = np.vstack([start, start + np.diag([5.0 * step, *[0.15] * (INTERVALS + 1)])])
    options = {"initial_simplex": simplex, "maxfev": 4000, "xatol": 1e-4, "fatol": 1e-7}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x
    found = warp(best)
    return TimeWarp(found.knots, found.values, found.rates, span, period, 1.0 - unexplained(best))


def _unexplained(features: FloatArray, reference: FloatArray) -> float:
    """1 - R^2, pooled over the features, of regressions with free offsets and gains that are not negative."""
    y, x = features - features.mean(axis=0), reference - reference.mean(axis=0)
    total, xx, xy = float((y**2).sum()), (x**2).sum(axis=0), np.maximum((x * y).sum(axis=0), 0.0)
    explained = np.divide(xy**2, xx, out=np.zeros_like(xx), where=xx > 0.0)
    return 1.0 - float(explained.sum()) / total
