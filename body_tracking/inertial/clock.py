"""The offset between the clocks of two inertial sensors, or of one and a camera, from the motion that both felt.

How fast something turns does not depend on where a sensor sits nor on which way it faces, so the magnitudes of angular
rates are compared: of two sensors, or of a sensor and of a bone that a camera sees. Coarsely by Pearson's correlation
at every offset of a wide window, finely by :class:`~body_tracking.calibration.clock.ClockFit` over windows of motion.

An offset is only told where the data decide. Turning is smooth, so that its samples are not independent; the variance
of the correlation of two series that have nothing to do with each other is (Bartlett 1946)

    var rho = 1 / n',  n' = T / sum_k rho_a(k) rho_b(k) dt                                                          (2)

with their autocorrelations rho_a, rho_b over lags k and the overlap T; a motion that repeats itself has few n'. And of
two offsets that leave shares s of the variance unexplained, the better one is told only if

    log(likelihood ratio) = T / (2 tau) log(s_worse / s_better)                                                     (3)

is large, with the correlation time tau of what is left. Of a motion that repeats itself exactly both leave the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve, find_peaks

from body_tracking.calibration.clock import FINE_RANGE, PEAK_WIDTH, SAMPLE_TIME, STEP, ClockFit
from body_tracking.errors import BodyTrackingError
from body_tracking.skeleton import BoolArray, FloatArray

WINDOW = 60.0
"""Seconds to either side in which an offset is looked for."""

LEAST_OVERLAP = 8.0
"""Seconds that both must have felt at an offset for it to count."""

LONGEST_GAP = 0.1
"""Seconds between samples over which a rate is interpolated."""

SIGNIFICANCE = 5.0
"""Standard deviations by which a correlation must exceed chance: among some thousand offsets that are looked at."""

DECISIVE = 5.0
"""Logarithm of the likelihood by which the best offset must exceed every other peak."""

LEAST_RATE = 0.05
"""rad/s, standard deviation of the rate from which there is motion: a person who stands sways by less."""

_AUTOCORRELATION = 20.0
"""Seconds up to which autocorrelations count in eq. 2."""
_RIVALS = 12
"""How many of the other peaks are looked at, the highest ones first."""
_CAUTION = 3.0
"""Correlation times that an independent sample of the fine fit takes: on simulated arms, flesh and camera together err
1.7 times as much as samples of one correlation time say."""
_WORST = 0.05
"""Seconds of standard deviation from which an offset is not told: the fine fit looks 0.15 s around the coarse one."""
_PART = 5.0
"""Seconds of a window of the fine fit."""
_SMOOTH = 0.17
"""Seconds over which a bone's directions are smoothed: five frames of a camera at 30 Hz."""


class ClockError(BodyTrackingError):
    """A series of turning that is none: shapes that do not belong together, stamps that do not ascend."""


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """How fast something turns, in one clock.

    Attributes:
        stamps: (n,) seconds, strictly ascending.
        rates: (n,) rad/s, not negative; NaN where unknown.

    Raises:
        ClockError: other shapes, stamps that do not ascend or are not finite.
    """

    stamps: FloatArray
    rates: FloatArray

    def __post_init__(self) -> None:
        if self.stamps.ndim != 1 or self.rates.shape != self.stamps.shape:
            raise ClockError(f"turning: stamps {self.stamps.shape} and rates {self.rates.shape}, expected (n,) both")
        if not np.isfinite(self.stamps).all() or (np.diff(self.stamps) <= 0.0).any():
            raise ClockError("turning: stamps must be finite and ascend")

    @classmethod
    def of_sensor(cls, stamps: FloatArray, rates: FloatArray, axis: FloatArray | None = None) -> Turning:
        """From angular rates (n, 3) rad/s; with an axis (3,) in the sensor's frame, only what turns the axis."""
        if axis is not None:
            rates = rates - (rates @ axis)[:, None] * axis / float(axis @ axis)
        return cls(stamps, np.linalg.norm(rates, axis=-1))

    @classmethod
    def of_bone(cls, stamps: FloatArray, vectors: FloatArray) -> Turning:
        """From the vectors (n, 3) between two joints of a skeleton; NaN where unknown.

        ``|u x u'|`` of the direction u: a camera does not see a bone turn about itself.
        """
        if vectors.shape != (len(stamps), 3):
            raise ClockError(f"bone: vectors {vectors.shape} at {len(stamps)} stamps, expected (n, 3)")
        n = len(stamps)
        with np.errstate(invalid="ignore", divide="ignore"):
            directions = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
        step = float(np.median(np.diff(stamps))) if n > 1 else 1.0
        length = 2 * max(round(0.5 * _SMOOTH / step), 1) + 1
        if n < length + 2:
            return cls(stamps, np.full(n, np.nan))
        # a straight line through some frames on either side, in their own times
        near = np.zeros((n, length), dtype=np.intp)
        near[:] = np.clip(np.arange(n)[:, None] + np.arange(length) - length // 2, 0, n - 1)
        t = stamps[near] - stamps[near].mean(axis=1, keepdims=True)
        slope = (t[..., None] * directions[near]).sum(axis=1) / np.maximum((t * t).sum(axis=1), 1e-12)[:, None]
        across = slope - (slope * directions).sum(axis=1, keepdims=True) * directions
        rates = np.linalg.norm(across, axis=1)
        rates[np.ptp(stamps[near], axis=1) > length * max(step, 1e-3) + LONGEST_GAP] = np.nan
        return cls(stamps, rates)


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Another clock minus the reference clock: ``offset + drift (t - anchor)`` at the reference time t.

    Attributes:
        offset: seconds.
        drift: seconds per second.
        anchor: reference time of the offset, seconds: the middle of the motion, where it is known best.
        offset_stddev: seconds, at the anchor.
        drift_stddev: seconds per second; the prior's 500 ppm where the motion is too short to tell.
        correlation: of the rates at this offset, -1 to 1.
        rival: the highest correlation of another peak; -1 without one.
    """

    offset: float
    drift: float
    anchor: float
    offset_stddev: float
    drift_stddev: float
    correlation: float
    rival: float

    def to_reference(self, stamps: FloatArray) -> FloatArray:
        """(n,) stamps of the other clock, seconds, in the reference clock."""
        result: FloatArray = (stamps - self.offset + self.drift * self.anchor) / (1.0 + self.drift)
        return result


def clock_offset(
    reference: Turning, other: Turning, guess: float = 0.0, window: float = WINDOW, *, parts: float = _PART
) -> ClockOffset | None:
    """The offset of a clock, where the motion decides it.

    Args:
        reference: turning in the reference clock.
        other: turning of the same limb, or of a neighbouring one, in the other clock.
        guess: other clock minus reference clock, seconds, known to within the window.
        window: half width of the search, seconds.
        parts: seconds of a window of the fine fit.

    Returns:
        None where nothing moves, too little overlaps, the correlation may be chance, or the motion repeats itself so
        that another offset is nearly as likely.
    """
    coarse = _coarse(reference, other, guess, window)
    if coarse is None:
        return None
    lag, correlation, rival = coarse
    return _fine(reference, other, lag, parts, correlation, rival)


def sampled(series: Turning, at: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(m,) rates at other times (m,), linear between samples, and where they are known: no gap of 0.1 s or more."""
    good = np.isfinite(series.rates)
    stamps, rates = series.stamps[good], series.rates[good]
    if len(stamps) < 2:
        return np.zeros(len(at)), np.zeros(len(at), dtype=np.bool_)
    index = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    known: BoolArray = (at >= stamps[0]) & (at <= stamps[-1]) & (stamps[index] - stamps[index - 1] <= LONGEST_GAP)
    return np.where(known, np.interp(at, stamps, rates), 0.0), known


def _autocorrelation(values: FloatArray, known: BoolArray) -> FloatArray:
    """(k,) at lags 0, STEP, 2 STEP, ...; of what is known."""
    centred = np.where(known, values - values[known].mean(), 0.0)
    n = len(values)
    lags = min(round(_AUTOCORRELATION / STEP), n - 1)
    sums = fftconvolve(centred, centred[::-1])[n - 1 : n + lags]
    result: FloatArray = sums / sums[0]
    return result


def _bartlett(a: FloatArray, known_a: BoolArray, b: FloatArray, known_b: BoolArray) -> float:
    """Seconds of an independent sample of two series on the grid (eq. 2)."""
    alike_a, alike_b = _autocorrelation(a, known_a), _autocorrelation(b, known_b)
    shared = min(len(alike_a), len(alike_b))
    return max(STEP * (1.0 + 2.0 * float((alike_a[1:shared] * alike_b[1:shared]).sum())), SAMPLE_TIME)


def independent_samples(a: FloatArray, b: FloatArray, known: BoolArray) -> float:
    """How many independent samples two series (n,) on a grid of STEP are, where both are known (eq. 2)."""
    return float(known.sum()) * STEP / _bartlett(a, known, b, known)


def _coarse(reference: Turning, other: Turning, guess: float, window: float) -> tuple[float, float, float] | None:
    """The best lag on the grid, seconds, its correlation and that of the best other peak."""
    if len(reference.stamps) < 2 or len(other.stamps) < 2:
        return None
    shifted = other.stamps - guess
    first = max(reference.stamps[0], shifted[0] - window)
    count = int((min(reference.stamps[-1], shifted[-1] + window) - first) / STEP)
    lags = int(window / STEP)
    if count * STEP < LEAST_OVERLAP:
        return None
    a, known_a = sampled(reference, first + STEP * np.arange(count))
    b, known_b = sampled(Turning(shifted, other.rates), first + STEP * np.arange(-lags, count + lags))
    if known_a.sum() * STEP < LEAST_OVERLAP or known_b.sum() * STEP < LEAST_OVERLAP:
        return None
    if min(float(a[known_a].std()), float(b[known_b].std())) < LEAST_RATE:
        return None

    def cross(x: FloatArray, y: FloatArray) -> FloatArray:
        """Sums over the grid of x(t) y(t + lag), for every lag of the window."""
        result: FloatArray = fftconvolve(y, x[::-1], mode="valid")
        return result

    mask_a, mask_b = known_a.astype(float), known_b.astype(float)
    n = np.maximum(cross(mask_a, mask_b), 1.0)
    mean_a, mean_b = cross(a, mask_b) / n, cross(mask_a, b) / n
    var_a = np.maximum(cross(a * a, mask_b) / n - mean_a**2, 0.0)
    var_b = np.maximum(cross(mask_a, b * b) / n - mean_b**2, 0.0)
    enough = (n * STEP >= LEAST_OVERLAP) & (np.minimum(var_a, var_b) > LEAST_RATE**2)
    if not enough.any():
        return None
    rho = np.where(enough, (cross(a, b) / n - mean_a * mean_b) / np.sqrt(np.maximum(var_a * var_b, 1e-12)), 0.0)
    rho = np.clip(rho, -0.999, 0.999)
    independent = n * STEP / _bartlett(a, known_a, b, known_b)
    chance = np.arctanh(rho) * np.sqrt(np.maximum(independent - 3.0, 0.0))
    best = int(np.argmax(chance))
    if chance[best] < SIGNIFICANCE or best in (0, len(rho) - 1):
        return None
    peaks, _ = find_peaks(rho)
    rivals = peaks[np.abs(peaks - best) * STEP > 0.3]
    rival = float(rho[rivals].max()) if len(rivals) else -1.0
    of_best, time_best = _unexplained(a, known_a, b, known_b, best)
    for peak in rivals[np.argsort(rho[rivals])[: -_RIVALS - 1 : -1]].tolist():
        of_peak, time_peak = _unexplained(a, known_a, b, known_b, peak)
        independent = min(n[best], n[peak]) * STEP / max(time_best, time_peak)
        if 0.5 * independent * np.log(of_peak / of_best) < DECISIVE:  # eq. 3
            return None
    return guess + STEP * (best - lags), float(rho[best]), rival


class _RateFit(ClockFit):
    """The fit of :class:`ClockFit` over angular rates in the place of joints' speeds."""

    LIKE = np.inf  # how fast something turns looks the same from everywhere

    def add_rates(self, elapsed: float, reference: Turning, other: Turning) -> None:
        """Take a window of the reference, and of the other series what surrounds it, nearly in the same clock."""
        at = reference.stamps[np.isfinite(reference.rates)]
        a = reference.rates[np.isfinite(reference.rates)]
        shifted = [sampled(other, at + lag) for lag in self._lags]
        both = np.logical_and.reduce([known for _, known in shifted])
        if both.sum() < 20:
            return
        at, a = at[both], a[both]
        own = a - a.mean()
        theirs = np.stack([values[both] for values, _ in shifted])
        theirs -= theirs.mean(axis=1, keepdims=True)
        if min(float(own.std()), float(theirs.std(axis=1).min())) < LEAST_RATE:
            return
        sums = np.empty((4, len(self._lags)))
        sums[0], sums[1], sums[2] = theirs @ own, own @ own, (theirs * theirs).sum(axis=1)
        # what one leaves unexplained of the other is correlated over time: an independent sample takes as long as that
        best = int(np.argmax(sums[0]))
        left = own - sums[0, best] / sums[2, best] * theirs[best]
        seconds = float(np.median(np.diff(at))) * len(at)
        independent = max(_CAUTION * _correlation_time(left, seconds / len(at)), SAMPLE_TIME)
        sums[3] = seconds * SAMPLE_TIME / independent
        self._elapsed.append(elapsed)
        self._sums.append(sums)


def _correlation_time(values: FloatArray, step: float) -> float:
    """Seconds: the integral of the autocorrelation up to where it first vanishes."""
    power = np.correlate(values, values, "full")[len(values) - 1 :]
    power = power / max(power[0], 1e-12)
    gone = np.flatnonzero(power <= 0.0)
    return step * float(1.0 + 2.0 * power[1 : gone[0] if len(gone) else len(power)].sum())


def _unexplained(a: FloatArray, known_a: BoolArray, b: FloatArray, known_b: BoolArray, lag: int) -> tuple[float, float]:
    """The share of a's variance that b leaves unexplained at a lag of the grid, and its correlation time, seconds."""
    both = known_a & known_b[lag : lag + len(a)]
    x, y = a[both], b[lag : lag + len(a)][both]
    x, y = x - x.mean(), y - y.mean()
    left = x - float(x @ y) / float(y @ y) * y
    return float(left @ left) / float(x @ x), max(_correlation_time(left, STEP), SAMPLE_TIME)


def _fine(
    reference: Turning, other: Turning, lag: float, parts: float, correlation: float, rival: float
) -> ClockOffset | None:
    begin, end = reference.stamps[[0, -1]]
    anchor = 0.5 * float(begin + end)
    fit = _RateFit(0.0)
    near = Turning(other.stamps - lag, other.rates)
    margin = FINE_RANGE + PEAK_WIDTH
    for start in np.arange(begin, end, parts):
        of_reference = slice(*np.searchsorted(reference.stamps, [start, start + parts]))
        of_other = slice(*np.searchsorted(near.stamps, [start - margin, start + parts + margin]))
        fit.add_rates(
            float(start + 0.5 * parts - anchor),
            Turning(reference.stamps[of_reference], reference.rates[of_reference]),
            Turning(near.stamps[of_other], near.rates[of_other]),
        )
    solved = fit.solve()
    if solved is None or solved.stddev > _WORST:
        return None
    return ClockOffset(
        lag + solved.offset,
        solved.drift,
        anchor + solved.at,
        solved.stddev,
        solved.drift_stddev,
        correlation,
        rival,
    )
