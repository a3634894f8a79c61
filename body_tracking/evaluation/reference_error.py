"""The error of an estimate from its difference to an imperfect reference.

The difference is e = (error of the estimate) - (error of the reference). Both are independent, so

    mean |error of the estimate|^2 = mean |e|^2 - V                                                                 (1)

with V the variance stated by the reference: noise of its poses, its clock, the mountings of its targets. The interval
is that of a variance (Satterthwaite 1946): chi squared with degrees of freedom from the scatter of |e|^2, where samples
count by their autocorrelation and a mounting error is one draw per half.

A mounting fitted to one half contains the estimate's mean error there. The autocorrelation within a half gives the
variance of only those errors that change within it. More persistent errors show as a change of the mean between the
halves: each half is compared by the mountings of the other, so that the change c is the difference of both means, and
c c^T / 2 a one-draw estimate of the variance of each. Its excess over the stated variance is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import gammaincinv  # scipy.stats takes 0.6 s more to import

from body_tracking.calibration.clock_correlation import correlation_time
from body_tracking.core.skeleton import BoolArray, FloatArray

TOO_POOR: Final = 0.5
"""Ratio of the reference's deviation to the measured difference, above which no error is stated. At one half, eq. 1
reduces the difference by 13 %; above, an error of the stated deviation by a fifth changes the result by more than 7
%."""
_LEVEL: Final = 0.95
_NORMAL: Final = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """Differences to the reference in one part of a recording.

    Attributes:
        step: seconds between samples.
        errors: (n, d) radians, estimate minus reference.
        variance: (n,) square radians, summed over d: of the reference's noise and clock.
        mounting: (n, d, d) square radians: covariance by the mountings; one draw for all n.
        stated: (n,) standard deviation stated by the estimate, radians; None if there is none.
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
        name: of the quantity.
        samples: number compared.
        measured: RMS difference.
        reference: RMS standard deviation of the reference, root of V.
        error: RMS error of the estimate by eq. 1; NaN if the reference is too poor.
        low, high: 95 % interval of the error; NaN and the difference's upper bound if the reference is too poor.
        offset: mean difference, a length for orientations; NaN if the mountings are fitted, which absorb it.
        offset_stddev: of the offset.
        change: half of the mean difference in the second half minus that in the first; half, because each half is
            measured by the mountings of the other.
        covered: share of differences within 1.96 combined standard deviations of estimate and reference; NaN if none.
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
    """Evaluate a quantity by its differences in the parts of a recording.

    Args:
        name: of the quantity.
        parts: the first half, by the mountings of the second, and the second by those of the first.
        mountings_known: whether the mountings are known beforehand: then their errors are equal in all parts, and
            offsets are observable.

    Returns:
        The result; None if some part has fewer than two samples.
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
    # the upper bound ignores the reference, whose errors only increase the difference
    scatter = float(share**2 @ sampling) + (0.0 if poor else by_mounting)
    freedom = max(2.0 * measured**2 / max(scatter, 1e-30), 1.0)
    tail = 0.5 * (1.0 - _LEVEL)
    low, high = (0.5 * freedom * measured / gammaincinv(0.5 * freedom, each) for each in (1.0 - tail, tail))
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


def notes_of(judged: Iterable[Judged | None]) -> list[str]:
    """A note on the quantities for which the reference is too poor; none if there are none."""
    poor = ", ".join(each.name for each in judged if each is not None and each.too_poor)
    if not poor:
        return []
    return [
        f"the reference is too poor for {poor}: its own deviation is not below half of the difference, so that only an "
        "upper bound of the error is given"
    ]


def _lasting(change: FloatArray, parts: Sequence[Differences], mountings: Sequence[FloatArray]) -> FloatArray:
    """(d, d) excess of the change (d,) over the stated variances of mountings and samples, as variance of a mean.

    Args:
        change: of the mean: half the difference of both halves' means.
        parts: both halves.
        mountings: (d, d) covariance of each half by its mountings.
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
    """A difference of angles with its sign, one of orientations as a length."""
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
