"""The error of an estimate from its difference to a reference that errs itself.

The difference is e = (error of the estimate) - (error of the reference), and both are independent, so that

    mean |error of the estimate|^2 = mean |e|^2 - V                                                                 (1)

with the variance V that the reference states: noise of its poses, its clock, the mountings of its targets. The interval
is that of a variance (Satterthwaite 1946): chi squared with as many degrees of freedom as the scatter of |e|^2 gives,
where samples count by their autocorrelation and an error of a mounting is one draw for a whole half.

A mounting that is fitted to one half has the estimate's mean error there in it, whose variance the autocorrelation
within a half tells only of errors that change within it. Errors that last longer show as the change of the mean from
one half to the other: each half is compared by the mountings of the other, so that the change c is the difference of
both means, and c c^T / 2 what one draw says of the variance of each. What it exceeds the stated variance by is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2

from body_tracking.calibration.clock_correlation import correlation_time
from body_tracking.core.skeleton import BoolArray, FloatArray

TOO_POOR: Final = 0.5
"""Share of the reference's deviation in the measured difference from which on no error is stated. At half, eq. 1 takes
13 % off the difference; beyond, an error of the stated deviation by a fifth changes the result by more than 7 %."""
_LEVEL: Final = 0.95
_NORMAL: Final = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """Differences to the reference in one part of a recording.

    Attributes:
        step: seconds between samples.
        errors: (n, d) radians, estimate minus reference.
        variance: (n,) square radians, summed over d: of the reference's noise and clock.
        mounting: (n, d, d) square radians: covariance by the mountings; the same draw at all n.
        stated: (n,) radians that the estimate states; None for none.
    """

    step: float
    errors: FloatArray
    variance: FloatArray
    mounting: FloatArray
    stated: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Judged:
    """One quantity of the estimate against the reference; radians.

    Attributes:
        name: of it.
        samples: compared.
        measured: RMS difference.
        reference: RMS deviation of the reference, root of V.
        error: RMS error of the estimate by eq. 1; NaN where the reference is too poor.
        low, high: its 95 % interval; NaN and that of the difference where the reference is too poor.
        offset: mean difference, a length for orientations; NaN where mountings are fitted, which absorb it.
        offset_stddev: of the offset.
        change: mean difference in the second half less that in the first, half of it as each half is measured by the
            mountings of the other.
        covered: share of differences within 1.96 of the deviation that estimate and reference state; NaN for none.
    """

    name: str
    samples: int
    measured: float
    reference: float
    error: float
    low: float
    high: float
    offset: float
    offset_stddev: float
    change: float
    covered: float

    @property
    def too_poor(self) -> bool:
        """Whether the reference is too poor to state an error."""
        return not self.reference < TOO_POOR * self.measured


def judge(name: str, parts: Sequence[Differences], *, mountings_known: bool) -> Judged | None:
    """Judge a quantity by its differences in the parts of a recording.

    Args:
        name: of it.
        parts: the first half, by the mountings of the second, and the second by those of the first.
        mountings_known: the mountings are known from elsewhere: the same errors in all parts, and offsets show.

    Returns:
        None without samples in some part.
    """
    count = np.array([len(part.errors) for part in parts])
    if not count.min() > 1:
        return None
    share = count / count.sum()
    squares = np.array([float((part.errors**2).sum(axis=1).mean()) for part in parts])
    means = [part.errors.mean(axis=0) for part in parts]
    mountings = [part.mounting.mean(axis=0) for part in parts]
    change = 0.5 * (means[-1] - means[0])
    if not mountings_known:
        surplus = _lasting(change, parts, mountings)
        mountings = [mounting + surplus for mounting in mountings]
    variances = [
        float(part.variance.mean()) + float(np.trace(mounting)) for part, mounting in zip(parts, mountings, strict=True)
    ]
    measured, reference = float(share @ squares), float(share @ np.array(variances))
    sampling = np.array([_variance_of_mean((part.errors**2).sum(axis=1), part.step) for part in parts])
    drawn = np.array(
        [
            2.0 * float(np.trace(mounting @ mounting)) + 4.0 * float(mean @ mounting @ mean)
            for mean, mounting in zip(means, mountings, strict=True)
        ]
    )
    by_mounting = float(share @ np.sqrt(drawn)) ** 2 if mountings_known else float(share**2 @ drawn)
    poor = not np.sqrt(reference) < TOO_POOR * np.sqrt(measured)
    # for an upper bound without the reference: its errors only add to the difference
    scatter = float(share**2 @ sampling) + (0.0 if poor else by_mounting)
    freedom = max(2.0 * measured**2 / max(scatter, 1e-30), 1.0)
    tail = 0.5 * (1.0 - _LEVEL)
    low, high = (freedom * measured / chi2.ppf(each, freedom) for each in (1.0 - tail, tail))
    low, high = (low, high) if poor else (max(low - reference, 0.0), max(high - reference, 0.0))
    offset, offset_stddev = _offset(parts, share, means, mountings) if mountings_known else (np.nan, np.nan)
    return Judged(
        name,
        int(count.sum()),
        float(np.sqrt(measured)),
        float(np.sqrt(reference)),
        float("nan") if poor else float(np.sqrt(max(measured - reference, 0.0))),
        float("nan") if poor else float(np.sqrt(low)),
        float(np.sqrt(high)),
        offset,
        offset_stddev,
        _signed(change),
        _covered(parts),
    )


def _lasting(change: FloatArray, parts: Sequence[Differences], mountings: Sequence[FloatArray]) -> FloatArray:
    """(d, d) by how much the change (d,) of the mean exceeds what mountings and samples state, as variance of a mean.

    Args:
        change: of the mean, half of the difference of both halves' means.
        parts: both halves.
        mountings: (d, d) the stated covariance of each by its mountings.
    """
    size = float(np.linalg.norm(change))
    direction = change / max(size, 1e-12)
    stated = [
        float(direction @ mounting @ direction) + _variance_of_mean(part.errors @ direction, part.step)
        for part, mounting in zip(parts, mountings, strict=True)
    ]
    surplus = max(0.5 * size**2 - 0.5 * float(np.mean(stated)), 0.0)
    return np.asarray(surplus * np.outer(direction, direction))


def _signed(vector: FloatArray) -> float:
    """A difference of angles as it is, one of orientations as a length."""
    return float(vector[0]) if len(vector) == 1 else float(np.linalg.norm(vector))


def _variance_of_mean(values: FloatArray, step: float) -> float:
    centred = values - values.mean()
    independent = max(len(values) * step / max(correlation_time(centred, step), step), 1.0)
    return float(centred @ centred) / len(values) / independent


def _offset(
    parts: Sequence[Differences], share: FloatArray, means: Sequence[FloatArray], mountings: Sequence[FloatArray]
) -> tuple[float, float]:
    mean = np.sum([weight * each for weight, each in zip(share, means, strict=True)], axis=0)
    variance = float(share @ np.array([np.trace(each) for each in mountings]))
    for weight, part in zip(share, parts, strict=True):
        variance += weight**2 * sum(_variance_of_mean(column, part.step) for column in part.errors.T)
    return _signed(mean), float(np.sqrt(variance))


def _covered(parts: Sequence[Differences]) -> float:
    inside: list[BoolArray] = []
    for part in parts:
        if part.stated is None:
            return float("nan")
        known = np.isfinite(part.stated)
        total = np.sqrt(part.stated**2 + part.variance + np.trace(part.mounting, axis1=-2, axis2=-1))
        inside.append(np.abs(part.errors[known, 0]) < _NORMAL * total[known])
    all_inside = np.concatenate(inside)
    return float(all_inside.mean()) if len(all_inside) else float("nan")
