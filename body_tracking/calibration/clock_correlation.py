"""Offset and drift of a clock from a motion measured in it and in a reference clock.

Two series of speeds are compared at every offset of a window (:func:`correlate`), and windows of motion around a known
offset are fitted with a line, offset plus drift (:class:`ClockFit`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from body_tracking.calibration import moving
from body_tracking.core.clocks import ClockModel, clock_of_line, line_information
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray

STEP = 0.02
"""Grid of the correlation, seconds."""

DRIFT_PRIOR = 500e-6
"""Standard deviation of the relative drift of two clocks, 1: the fastest that NTP slews a computer's clock; quartz
alone has 10-100 ppm."""

_DRIFT_STEP, _DRIFT_STEPS = 100e-6, 15

PEAK_WIDTH = 0.03
"""Half width of the parabolas that smooth the likelihood, seconds: a frame, to suppress the jitter."""

_MAX_WINDOWS = 240
"""Windows stored: twenty minutes of five-second windows."""

FINE_RANGE = 0.15
"""Half width of the fit's search around its base, seconds."""

_FINE_STEP = 0.005
_LAGS = _FINE_STEP * (round(-FINE_RANGE / _FINE_STEP) + np.arange(round(2 * FINE_RANGE / _FINE_STEP) + 1))

_HALF_WIDTH = round(PEAK_WIDTH / _FINE_STEP)
_LOCAL_QUADRATIC = np.linalg.pinv(np.vander(_FINE_STEP * np.arange(-_HALF_WIDTH, _HALF_WIDTH + 1), 3, increasing=True))
_LOCAL_QUADRATIC *= np.array([[1.0], [1.0], [2.0]])
"""(3, n) weights of the value and the first two derivatives of a parabola fitted about a lag (Savitzky and Golay 1964);
SciPy's own filter is not used since importing it doubles the time that the node takes to start."""

SAMPLE_TIME = 0.1
"""Samples closer together than this are one observation, seconds."""

MIN_STDDEV = 0.002
"""Least standard deviation of an offset, seconds: stamps jitter, and sensors smooth differently."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Speeds in one clock.

    Attributes:
        stamps: (n,) seconds, ascending.
        values: (n, k) of k signals, such as joints.
        good: (n,) where they are known.
        longest_gap: seconds between samples over which values are interpolated.
    """

    stamps: FloatArray
    values: FloatArray
    good: BoolArray
    longest_gap: float = float("inf")

    def at(self, times: FloatArray) -> tuple[FloatArray, BoolArray]:
        """(m, k) values at times (m,), linear between two good samples, 0 where unknown; (m,) where they are known."""
        if len(self.stamps) < 2:
            return np.zeros((len(times), self.values.shape[1])), np.zeros(len(times), dtype=np.bool_)
        index = np.clip(np.searchsorted(self.stamps, times), 1, len(self.stamps) - 1)
        before, gap = self.stamps[index - 1], self.stamps[index] - self.stamps[index - 1]
        known: BoolArray = self.good[index] & self.good[index - 1] & (gap <= self.longest_gap)
        known &= (times >= self.stamps[0]) & (times <= self.stamps[-1])
        fraction = np.clip((times - before) / np.maximum(gap, 1e-6), 0.0, 1.0)[:, None]
        value = self.values[index - 1] + (self.values[index] - self.values[index - 1]) * fraction
        return np.where(known[:, None], value, 0.0), known

    def earlier(self, offset: float) -> Series:
        """The series with stamps reduced by an offset, seconds."""
        return replace(self, stamps=self.stamps - offset)

    def between(self, begin: float, end: float) -> Series:
        """The samples in [begin, end)."""
        part = slice(*np.searchsorted(self.stamps, [begin, end]))
        return replace(self, stamps=self.stamps[part], values=self.values[part], good=self.good[part])


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """Two series compared at the lags of a window; count and window are multiples of :data:`STEP`.

    Attributes:
        lags: (l,) seconds by which the sensor's motion comes later than the reference's.
        overlap: (l,) seconds that both cover.
        rho: (l,) Pearson's correlation, over all values of a series together.
        variance: (l,) the smaller of the two series' variances.
        reference: (m, k) and (m,) values on the grid, and where they are known.
        sensor: (m + l - 1, k) and (m + l - 1,) values, and where known; the lag n compares its samples from n on.
    """

    lags: FloatArray
    overlap: FloatArray
    rho: FloatArray
    variance: FloatArray
    reference: tuple[FloatArray, BoolArray]
    sensor: tuple[FloatArray, BoolArray]


def correlate(reference: Series, sensor: Series, window: float, least_overlap: float) -> Correlation | None:
    """Compare two series at all lags up to ``window`` seconds either way.

    Returns:
        None where they overlap for less than ``least_overlap`` seconds.
    """
    if len(reference.stamps) < 2 or len(sensor.stamps) < 2:
        return None
    # The grid is a multiple of the step, so that slightly different stamps get the same lags.
    first = STEP * np.floor(max(reference.stamps[0], sensor.stamps[0] - window) / STEP)
    count = int((min(reference.stamps[-1], sensor.stamps[-1] + window) - first) / STEP)
    lags = int(window / STEP)
    if count * STEP < least_overlap:
        return None
    a, known_a = reference.at(first + STEP * np.arange(count))
    b, known_b = sensor.at(first + STEP * np.arange(-lags, count + lags))

    def cross(x: FloatArray, y: FloatArray) -> FloatArray:
        """Sums over the grid of x(t) y(t + lag), for every lag of the window."""
        # By the Fourier transform; x ends 2 * lags samples before y, so that no lag of the window wraps round.
        spectrum = np.fft.rfft(y, axis=0) * np.fft.rfft(x, len(y), axis=0).conj()
        result: FloatArray = np.fft.irfft(spectrum, len(y), axis=0)[: 2 * lags + 1]
        return result

    # Over the samples that both cover, for all lags at once.
    mask_a, mask_b = known_a[:, None].astype(float), known_b[:, None].astype(float)
    n = np.maximum(cross(mask_a, mask_b), 1.0)
    mean_a, mean_b = cross(a, mask_b) / n, cross(mask_a, b) / n
    var_a = np.maximum(cross(a * a, mask_b) / n - mean_a**2, 0.0).sum(axis=1)
    var_b = np.maximum(cross(mask_a, b * b) / n - mean_b**2, 0.0).sum(axis=1)
    covariance = (cross(a, b) / n - mean_a * mean_b).sum(axis=1)
    rho = covariance / np.sqrt(np.maximum(var_a * var_b, 1e-12))
    lag = STEP * np.arange(-lags, len(rho) - lags, dtype=np.float64)
    variance: FloatArray = np.minimum(var_a, var_b)
    return Correlation(lag, n[:, 0] * STEP, rho, variance, (a, known_a), (b, known_b))


def correlation_time(values: FloatArray, step: float) -> float:
    """Seconds: the integral of the autocorrelation of (n,) centred values up to where it first vanishes."""
    power = np.correlate(values, values, "full")[len(values) - 1 :]
    power = power / max(power[0], 1e-12)
    gone = np.flatnonzero(power <= 0.0)
    return step * float(1.0 + 2.0 * power[1 : gone[0] if len(gone) else len(power)].sum())


class ClockFit:
    """Offset and drift of one clock, from all the motion so far.

    The maximum likelihood line ``offset + drift t`` over all windows: a window of n independent samples with the
    correlation rho at its lag adds n / 2 log(1 / (1 - rho^2)), and drift and offset have priors. Windows with little
    motion, or with the body seen reversed, correlate badly and have little weight.

    Args:
        base: the clock so far; the search covers offsets within :data:`FINE_RANGE` of it.
        zero_ns: reference time from which ``elapsed`` counts.
        like: seconds of motion whose variance of the offset equals that of an error common to all windows, such as the
            different views of a repeated motion; the drift is not affected.
        caution: correlation times of the residual between the series per independent sample; 0 for
            :data:`SAMPLE_TIME`.
        least_stddev: least standard deviation of the values in a window with motion.
    """

    def __init__(
        self,
        base: ClockModel | None = None,
        zero_ns: int = 0,
        like: float = np.inf,
        caution: float = 0.0,
        least_stddev: float = 0.0,
    ) -> None:
        self._base, self._zero_ns = base or ClockModel(), zero_ns
        self._like, self._caution, self._least_stddev = like, caution, least_stddev
        self._elapsed: list[float] = []
        self._sums: list[FloatArray] = []  # (4, lags) per window: a b, a a, b b, seconds

    def add(self, elapsed: float, reference: Series, sensor: Series) -> bool:
        """Add a window of motion.

        Args:
            elapsed: reference time of its middle since ``zero_ns``, seconds.
            reference: the window.
            sensor: the other series over the window and its surroundings, converted by the base's clock.

        Returns:
            Whether the window was used: enough overlap and motion.
        """
        if len(reference.stamps) < 2 or len(sensor.stamps) < 2:
            return False
        sampled = [sensor.at(reference.stamps + lag) for lag in _LAGS]
        # The same frames at every lag, so that their number does not change the likelihood.
        both = reference.good & np.logical_and.reduce([known for _, known in sampled])
        step = float(np.median(np.diff(reference.stamps)))
        seconds = float(both.sum() * step)
        if seconds < 1.0:
            return False
        own = reference.values[both] - reference.values[both].mean(axis=0)
        theirs = np.stack([values[both] for values, _ in sampled])
        theirs -= theirs.mean(axis=1, keepdims=True)
        if min(float(own.std()), float(theirs.std(axis=(1, 2)).min())) < self._least_stddev:
            return False
        sums = np.empty((4, len(_LAGS)))
        sums[0] = np.einsum("nj,lnj->l", own, theirs)
        sums[1] = (own**2).sum()
        sums[2] = np.einsum("lnj,lnj->l", theirs, theirs)
        sums[3] = seconds
        if self._caution:
            best = int(np.argmax(sums[0]))
            left = (own - sums[0, best] / sums[2, best] * theirs[best]).ravel()
            sums[3] *= SAMPLE_TIME / max(self._caution * correlation_time(left, step), SAMPLE_TIME)
        self._elapsed.append(elapsed)
        self._sums.append(sums)
        del self._elapsed[:-_MAX_WINDOWS], self._sums[:-_MAX_WINDOWS]
        return True

    def solve(self, expected: ClockModel | None = None) -> ClockModel | None:
        """The clock so far.

        Args:
            expected: prior without this motion; ignored where its offset is farther than :data:`FINE_RANGE` from the
                base's.

        Returns:
            The clock; None while there is no motion or the best offset is at the grid's edge.
        """
        if not self._elapsed:
            return None
        sums = np.stack(self._sums)
        middle = float(np.average(self._elapsed, weights=sums[:, 1, 0] + 1e-9))
        elapsed = np.array(self._elapsed) - middle
        rho = np.clip(sums[:, 0] / np.sqrt(np.maximum(sums[:, 1] * sums[:, 2], 1e-12)), 0.0, 0.999999)
        likelihood = -0.5 * sums[:, 3] / SAMPLE_TIME * np.log1p(-(rho**2))
        rows = np.arange(len(elapsed))
        last = len(_LAGS) - 1

        def on(line: FloatArray, table: FloatArray) -> FloatArray:
            """(windows,) a table (windows, lags) at each window's lag on a line, linear between the grid's points."""
            place = (np.clip(line[0] + line[1] * elapsed, _LAGS[0], _LAGS[-1]) - _LAGS[0]) / _FINE_STEP
            before = np.minimum(place.astype(np.intp), last - 1)
            value: FloatArray = table[rows, before] + (place - before) * (table[rows, before + 1] - table[rows, before])
            return value

        # The prior: 1 / variance of the offset and its time from the middle, 1 / variance of the drift.
        trust, at, line0, drift_trust = 0.0, 0.0, np.zeros(2), DRIFT_PRIOR**-2
        prior = None if expected is None else expected.minus(self._base)
        if prior is not None and abs(prior.offset) <= FINE_RANGE:
            trust, at = prior.stddev**-2, (prior.anchor_ns - self._zero_ns) / NANOSECONDS - middle
            line0, drift_trust = np.array([prior.offset, 1e-6 * prior.drift_ppm]), (1e-6 * prior.drift_stddev_ppm) ** -2
        drifts = _DRIFT_STEP * np.arange(-_DRIFT_STEPS, _DRIFT_STEPS + 1)
        # Newton's method on the smoothed likelihood, from the best point of a coarse grid, on which each window is
        # shifted by whole lags.
        smooth, slope, bend = (moving.weighted(likelihood, row) for row in _LOCAL_QUADRATIC)
        shifts = np.rint(drifts[:, None] * elapsed / _FINE_STEP).astype(np.intp)
        places = np.clip(np.arange(last + 1) + shifts[..., None], 0, last)
        total = smooth[rows[None, :, None], places].sum(axis=1)
        total -= 0.5 * drift_trust * (drifts[:, None] - line0[1]) ** 2
        total -= 0.5 * trust * (_LAGS + drifts[:, None] * at - line0[0]) ** 2
        best = np.unravel_index(int(np.argmax(total)), total.shape)
        line = np.array([_LAGS[best[1]], drifts[best[0]]])
        bounds = line_information(np.array([at]), np.array([trust])) + np.diag([0.0, drift_trust])
        gradient = np.zeros(2)
        for _ in range(20):
            g, h = on(line, slope), on(line, bend)
            gradient = np.array([g.sum(), g @ elapsed])
            off = trust * (line[0] + line[1] * at - line0[0])
            draws = gradient - np.array([off, off * at + drift_trust * (line[1] - line0[1])])
            # Between the grid's points the likelihood can be convex: absolute curvatures make the step go uphill.
            curvatures, axes = np.linalg.eigh(line_information(elapsed, -h) + bounds)
            step = axes @ ((axes.T @ draws) / np.maximum(np.abs(curvatures), 1e-9))
            step *= min(1.0, 0.5 * PEAK_WIDTH / max(abs(step[0]), 1e-12), _DRIFT_STEP / max(abs(step[1]), 1e-12))
            line = line + step
            if abs(step[0]) < 1e-6:
                break
        if abs(line[0]) >= FINE_RANGE - PEAK_WIDTH or abs(line[1]) > drifts[-1]:
            return None
        motion = line_information(elapsed, -on(line, bend))
        # An error common to all windows has T / like times the variance of the offset by the motion. It is added by the
        # Sherman-Morrison formula; the prior gains the weight that the motion loses.
        share = np.zeros(2)
        if motion[0, 0] > 0.0:
            share = motion[0] / (motion[0, 0] * (1.0 + self._like / float(sums[:, 3, 0].sum())))
        information = motion + bounds - np.outer(share, motion[0])
        if np.linalg.eigvalsh(information)[0] <= 0.0:
            return None
        line = line - np.linalg.solve(information, share * gradient[0])
        found = clock_of_line(line, information, self._zero_ns + round(middle * NANOSECONDS), MIN_STDDEV)
        # The information on the drift is reduced for the jitter by the same share as that on the offset.
        jitter = 1.0 - (MIN_STDDEV / found.stddev) ** 2
        drift_trust += max((1e-6 * found.drift_stddev_ppm) ** -2 - drift_trust, 0.0) * jitter
        return replace(found, drift_stddev_ppm=1e6 * drift_trust**-0.5).plus(self._base)
