"""Compares two estimates of one person by their joint angles, weighted by their stated standard deviations.

Joint angles are independent of the frame, so only the clocks are aligned, by the segments' angular speeds
(:mod:`body_tracking.evaluation.start_clock`). The difference of two angles with standard deviations a and b has the
standard deviation sqrt(a^2 + b^2); with one estimate as the reference,
:mod:`body_tracking.evaluation.reference_error` computes the other one's own error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.estimated_segments import EstimatedSegments
from body_tracking.evaluation.hand_eye import MAX_GAP
from body_tracking.evaluation.reading import AngleSeries, EvaluationError
from body_tracking.evaluation.reference_error import Differences, Judged, judge, notes_of
from body_tracking.evaluation.start_clock import STAMPS_AS_THEY_ARE, start_clock
from body_tracking.kinematics.labels import UNKNOWN

USABLE: Final = float(np.radians(UNKNOWN))
"""Radians: standard deviation above which an angle counts as unknown."""
LEAST_OVERLAP: Final = 2.0
"""Least overlap of both recordings, seconds."""
_NORMAL: Final = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class MutualComparison:
    """Two estimates of one person.

    Attributes:
        estimate: the evaluated estimate.
        reference: the other estimate.
        offset_s: the reference's clock minus the estimate's.
        clock_stddev: s, of ``offset_s``; NaN if the motion does not determine it and the stamps are used unchanged.
        seconds: covered by both.
        angles: of the common convention, where both know the angle.
        measured: RMS difference over all these angles, radians.
        covered: share of the differences within 1.96 standard deviations, combined from both.
        notes: one per line.
    """

    estimate: EstimatedSegments
    reference: EstimatedSegments
    offset_s: float
    clock_stddev: float
    seconds: float
    angles: tuple[Judged, ...]
    measured: float
    covered: float
    notes: tuple[str, ...]


def compare_estimates(estimate: EstimatedSegments, reference: EstimatedSegments) -> MutualComparison:
    """Evaluate an estimate against another one of the same person.

    Raises:
        EvaluationError: angles of different conventions, or too little overlap.
    """
    both = f"{estimate.source} and {reference.source}"
    if estimate.convention != reference.convention:
        raise EvaluationError(
            f"{both}: angles of the conventions {estimate.convention} and {reference.convention}; replay both with "
            "the same --convention"
        )
    offset, stddev, notes = _clock(estimate, reference, both)
    times = estimate.seconds
    at = times + offset - (int(reference.stamps_ns[0]) - int(estimate.stamps_ns[0])) / NANOSECONDS
    inside = (at >= 0.0) & (at <= reference.seconds[-1])
    seconds = float(np.ptp(times[inside])) if inside.any() else 0.0
    if seconds < LEAST_OVERLAP:
        raise EvaluationError(f"{both}: {seconds:.1f} s in common, {LEAST_OVERLAP:g} s are needed")
    stamps_ns = estimate.stamps_ns[inside]
    own = _at(estimate.angles, (stamps_ns - estimate.angles.stamps_ns[0]) / NANOSECONDS)
    lead = float(reference.stamps_ns[0] - reference.angles.stamps_ns[0]) / NANOSECONDS
    other = _at(reference.angles, at[inside] + lead)
    shared = [name for name in estimate.angles.names if name in reference.angles.names]
    mine, theirs = ([series.names.index(name) for name in shared] for series in (estimate.angles, reference.angles))
    errors = wrapped(own.position[:, mine] - other.position[:, theirs])
    variance = other.stddev[:, theirs] ** 2
    # a clock error causes an angle error in proportion to the angle's rate
    step = float(np.median(np.diff(times)))
    rates = np.gradient(np.unwrap(other.position[:, theirs], axis=0), step, axis=0)
    variance = variance + (np.nan_to_num(stddev) * rates) ** 2
    stated = own.stddev[:, mine]
    known = (stated < USABLE) & (other.stddev[:, theirs] < USABLE)
    half: BoolArray = times[inside] < times[inside].mean()
    judged = [
        judge(
            name,
            [_differences(errors, variance, stated, known[:, k] & part, k, step) for part in (half, ~half)],
            mountings_known=True,
        )
        for k, name in enumerate(shared)
    ]
    if not known.any():
        raise EvaluationError(f"{both}: there is no angle that both know to {np.degrees(USABLE):.0f} degrees")
    within = np.abs(errors) < _NORMAL * np.sqrt(variance + stated**2)
    return MutualComparison(
        estimate,
        reference,
        offset,
        stddev,
        seconds,
        tuple(each for each in judged if each is not None),
        float(np.sqrt((errors[known] ** 2).mean())),
        float(within[known].mean()),
        (*estimate.warnings, *reference.warnings, *notes, *notes_of(judged)),
    )


def _differences(
    errors: FloatArray, variance: FloatArray, stated: FloatArray, which: BoolArray, column: int, step: float
) -> Differences:
    count = int(which.sum())
    return Differences(
        step,
        errors[which, column, None],
        variance[which, column],
        np.zeros((count, 1, 1)),
        stated[which, column],
    )


def _clock(estimate: EstimatedSegments, reference: EstimatedSegments, both: str) -> tuple[float, float, list[str]]:
    """The reference's clock minus the estimate's, its standard deviation, both in seconds, and notes."""
    apart = float(int(estimate.stamps_ns[0]) - int(reference.stamps_ns[0])) / NANOSECONDS
    own, other = (
        {name: each.track(each.rotations[:, number]) for number, name in enumerate(SEGMENTS)}
        for each in (estimate, reference)
    )
    there = [name for name in SEGMENTS if min(len(own[name].times), len(other[name].times)) > 1]
    own, other = ({name: each[name] for name in there} for each in (own, other))
    try:
        clock, _ = start_clock(own, other, apart, both, {name: name for name in there})
    except (EvaluationError, ValueError) as error:
        if not -estimate.seconds[-1] < apart < reference.seconds[-1]:
            raise EvaluationError(f"{both}: their stamps do not overlap, and {error}") from error
        return 0.0, float("nan"), [STAMPS_AS_THEY_ARE]
    middle_ns = round(0.5 * float(estimate.seconds[-1]) * NANOSECONDS)
    return clock.offset_ns_at(middle_ns) / NANOSECONDS - apart, clock.stddev, []


def _at(series: AngleSeries, times: FloatArray) -> AngleSeries:
    """Angles at (n,) seconds since their first stamp, interpolated; infinite deviations in gaps."""
    stamps = (series.stamps_ns - series.stamps_ns[0]) / NANOSECONDS
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    before = after - 1
    gap = stamps[after] - stamps[before]
    share = np.clip((times - stamps[before]) / gap, 0.0, 1.0)[:, None]
    step = wrapped(series.position[after] - series.position[before])
    stddev = np.maximum(series.stddev[before], series.stddev[after])
    inside = (times >= stamps[0] - 1e-6) & (times <= stamps[-1] + 1e-6) & (gap <= MAX_GAP)
    stddev = np.where(inside[:, None] & np.isfinite(step), stddev, np.inf)
    position = np.nan_to_num(series.position[before] + share * step)
    return AngleSeries((times * NANOSECONDS).astype(np.int64), series.names, position, stddev)
