"""The offset between the clocks of two inertial sensors, or of one and a camera, by the motion that both measured.

The magnitude of an angular rate depends neither on a sensor's place nor on its orientation, so magnitudes are compared:
of two sensors, or of a sensor and of a bone that a camera sees. A coarse search uses Pearson's correlation at every
offset of a wide window; :class:`~body_tracking.calibration.clock_correlation.ClockFit` refines it over windows of
motion.

An offset is returned only where the data determine it. Rates are smooth, so their samples are not independent; the
variance of the correlation of two independent series is (Bartlett 1946)

    var rho = 1 / n',  n' = T / sum_k rho_a(k) rho_b(k) dt                                                          (2)

with their autocorrelations rho_a, rho_b over lags k and the overlap T; a periodic motion has a small n'. Of two offsets
that leave shares s of the variance unexplained, the better one is returned only if

    log(likelihood ratio) = T / (2 tau) log(s_worse / s_better)                                                     (3)

is large, with the correlation time tau of the residuals. For an exactly periodic motion both shares are equal.
"""

from __future__ import annotations

import numpy as np

from body_tracking.calibration.clock_correlation import (
    FINE_RANGE,
    PEAK_WIDTH,
    SAMPLE_TIME,
    STEP,
    ClockFit,
    Correlation,
    Series,
    correlate,
    correlation_time,
)
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray

WINDOW = 60.0
"""Half width of the search, seconds."""

LEAST_OVERLAP = 8.0
"""Least overlap of both series at an offset, seconds."""

LONGEST_GAP = 0.1
"""Seconds between samples over which a rate is interpolated."""

SIGNIFICANCE = 5.0
"""Standard deviations by which a correlation must exceed chance, among some thousand offsets."""

DECISIVE = 5.0
"""Logarithm of the likelihood by which the best offset must exceed every other peak."""

LEAST_RATE = 0.05
"""rad/s, standard deviation of the rate from which there is motion: a person who stands sways by less."""

_AUTOCORRELATION = 20.0
"""Seconds up to which autocorrelations count in eq. 2."""
_RIVALS = 12
"""Number of other peaks that are compared, the highest ones first."""
_CAUTION = 3.0
"""Correlation times per independent sample of the fine fit: on simulated arms, the errors of soft tissue and camera are
1.7 times as large as with one correlation time per sample."""
_WORST = 0.05
"""Greatest standard deviation of an offset, seconds: the fine fit searches 0.15 s around the coarse one."""
_PART = 5.0
"""Seconds of a window of the fine fit."""
_SMOOTH = 0.17
"""Seconds over which a bone's directions are smoothed: five frames of a camera at 30 Hz."""


def turning(stamps: FloatArray, rates: FloatArray) -> Series:
    """A series of turning rates: stamps (n,) seconds, strictly ascending, and rates (n,) rad/s, NaN where unknown."""
    good = np.isfinite(rates)
    return Series(stamps[good], rates[good, None], np.ones(int(good.sum()), dtype=np.bool_), LONGEST_GAP)


def turning_of_sensor(stamps: FloatArray, rates: FloatArray, axis: FloatArray | None = None) -> Series:
    """The series of angular rates (n, 3) rad/s; with an axis (3,) in the sensor's frame, without the part about it."""
    if axis is not None:
        rates = rates - (rates @ axis)[:, None] * axis / float(axis @ axis)
    return turning(stamps, np.linalg.norm(rates, axis=-1))


def turning_of_bone(stamps: FloatArray, vectors: FloatArray) -> Series:
    """The series of the vectors (n, 3) between two joints of a skeleton; NaN where unknown.

    ``|u x u'|`` of the direction u: a camera does not see a bone's rotation about its axis.
    """
    n = len(stamps)
    with np.errstate(invalid="ignore", divide="ignore"):
        directions = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    step = float(np.median(np.diff(stamps))) if n > 1 else 1.0
    length = 2 * max(round(0.5 * _SMOOTH / step), 1) + 1
    if n < length + 2:
        return turning(stamps, np.full(n, np.nan))
    # the slope of a line through the neighbouring frames
    near = np.zeros((n, length), dtype=np.intp)
    near[:] = np.clip(np.arange(n)[:, None] + np.arange(length) - length // 2, 0, n - 1)
    t = stamps[near] - stamps[near].mean(axis=1, keepdims=True)
    slope = (t[..., None] * directions[near]).sum(axis=1) / np.maximum((t * t).sum(axis=1), 1e-12)[:, None]
    across = slope - (slope * directions).sum(axis=1, keepdims=True) * directions
    rates = np.linalg.norm(across, axis=1)
    rates[np.ptp(stamps[near], axis=1) > length * max(step, 1e-3) + LONGEST_GAP] = np.nan
    return turning(stamps, rates)


def clock_offset(reference: Series, other: Series, guess: float = 0.0, window: float = WINDOW) -> ClockModel | None:
    """The offset of another clock from the reference clock, where the motion determines it.

    Args:
        reference: turning in the reference clock.
        other: turning of the same limb, or of a neighbouring one, in the other clock.
        guess: other clock minus reference clock, seconds, known to within the window.
        window: half width of the search, seconds.

    Returns:
        None without motion or enough overlap, where the correlation may be chance, and where a periodic motion makes
        another offset nearly as likely.
    """
    lag = _coarse(reference, other, guess, window)
    return None if lag is None else _fine(reference, other, lag)


def _autocorrelation(values: FloatArray, known: BoolArray) -> FloatArray:
    """(k,) at lags 0, STEP, 2 STEP, ..., of the known samples."""
    centred = np.where(known, values - values[known].mean(), 0.0)
    n = len(values)
    lags = min(round(_AUTOCORRELATION / STEP), n - 1)
    sums = np.fft.irfft(np.abs(np.fft.rfft(centred, 2 * n)) ** 2)[: lags + 1]
    result: FloatArray = sums / sums[0]
    return result


def _bartlett(a: FloatArray, known_a: BoolArray, b: FloatArray, known_b: BoolArray) -> float:
    """Seconds per independent sample of two series on the grid (eq. 2)."""
    alike_a, alike_b = _autocorrelation(a, known_a), _autocorrelation(b, known_b)
    shared = min(len(alike_a), len(alike_b))
    return max(STEP * (1.0 + 2.0 * float((alike_a[1:shared] * alike_b[1:shared]).sum())), SAMPLE_TIME)


def independent_samples(a: FloatArray, b: FloatArray, known: BoolArray) -> float:
    """Number of independent samples of two series (n,) on a grid of STEP, where both are known (eq. 2)."""
    return float(known.sum()) * STEP / _bartlett(a, known, b, known)


def _coarse(reference: Series, other: Series, guess: float, window: float) -> float | None:
    """The best offset on the grid, seconds."""
    found = correlate(reference, other.earlier(guess), window, LEAST_OVERLAP)
    if found is None:
        return None
    (a, known_a), (b, known_b) = found.reference, found.sensor
    if min(known_a.sum(), known_b.sum()) * STEP < LEAST_OVERLAP or min(a[known_a].std(), b[known_b].std()) < LEAST_RATE:
        return None
    enough = (found.overlap >= LEAST_OVERLAP) & (found.variance > LEAST_RATE**2)
    if not enough.any():
        return None
    rho = np.clip(np.where(enough, found.rho, 0.0), -0.999, 0.999)
    independent = found.overlap / _bartlett(a[:, 0], known_a, b[:, 0], known_b)
    chance = np.arctanh(rho) * np.sqrt(np.maximum(independent - 3.0, 0.0))
    best = int(np.argmax(chance))
    if chance[best] < SIGNIFICANCE or best in (0, len(rho) - 1):
        return None
    # scipy.signal finds peaks too, but takes a node 0.7 s to import
    peaks = 1 + np.flatnonzero((rho[1:-1] > rho[:-2]) & (rho[1:-1] > rho[2:]))
    rivals = peaks[np.abs(peaks - best) * STEP > 0.3]
    of_best, time_best = _unexplained(found, best)
    for peak in rivals[np.argsort(rho[rivals])[: -_RIVALS - 1 : -1]].tolist():
        of_peak, time_peak = _unexplained(found, peak)
        samples = min(found.overlap[best], found.overlap[peak]) / max(time_best, time_peak)
        if 0.5 * samples * np.log(of_peak / max(of_best, 1e-12)) < DECISIVE:  # eq. 3
            return None
    return guess + float(found.lags[best])


def _unexplained(found: Correlation, lag: int) -> tuple[float, float]:
    """Share of the reference's variance unexplained at a lag, and the residuals' correlation time in seconds."""
    (a, known_a), (b, known_b) = found.reference, found.sensor
    shifted = slice(lag, lag + len(a))
    both = known_a & known_b[shifted]
    x, y = a[both, 0], b[shifted][both, 0]
    x, y = x - x.mean(), y - y.mean()
    residuals = x - float(x @ y) / float(y @ y) * y
    return float(residuals @ residuals) / float(x @ x), max(correlation_time(residuals, STEP), SAMPLE_TIME)


def _fine(reference: Series, other: Series, lag: float) -> ClockModel | None:
    begin, end = reference.stamps[[0, -1]]
    base, zero = ClockModel(round(lag * NANOSECONDS)), 0.5 * float(begin + end)
    fit = ClockFit(base, round(zero * NANOSECONDS), caution=_CAUTION, least_stddev=LEAST_RATE)
    near, margin = other.earlier(lag), FINE_RANGE + PEAK_WIDTH
    for start in np.arange(begin, end, _PART):
        around = near.between(start - margin, start + _PART + margin)
        fit.add(float(start + 0.5 * _PART - zero), reference.between(start, start + _PART), around)
    found = fit.solve()
    return None if found is None or found.stddev > _WORST else found
