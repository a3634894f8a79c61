"""The offset between two sensors' clocks, from the motion that both saw.

A first guess comes from the times of receipt; it can be wrong by a burst of the network. The speeds of the joints do
not depend on where a sensor stands, so their correlation over time finds the offset before any pose is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import correlate1d, minimum_filter1d
from scipy.signal import fftconvolve, savgol_filter

from body_tracking.skeleton import BoolArray, FloatArray, IntArray

STEP = 0.02
"""Grid of the correlation, seconds; the fine offset comes from the pose estimation."""

DRIFT_PRIOR = 500e-6
"""Standard deviation of the relative drift of two clocks, 1: the fastest that NTP slews a computer's clock; quartz
alone has 10-100 ppm."""

RECEIPT_PRIOR = 0.05
"""Standard deviation of what the times of receipt say of an offset, seconds: sensors deliver after different delays.
In nine recordings of two Kinects on two computers these are 15 to 40 ms apart."""

DRIFT_STEP = 100e-6

DRIFT_STEPS = 15

PEAK_WIDTH = 0.03
"""Half width of the parabolas that smooth the likelihood, seconds: a frame, so that it does not follow the jitter."""

MAX_WINDOWS = 240
"""Windows remembered: twenty minutes of five-second windows."""

SPAN = 4
"""Speeds are taken over this many frames: limbs move at up to about 5 Hz, what is faster is noise."""

SMOOTHING = (0.0625, 0.25, 0.375, 0.25, 0.0625)
"""Weights of neighbouring speeds."""

MIN_JOINTS = 8
"""Joints that must be seen in both of two frames for their speed to count."""

_LIMB_JOINTS: IntArray = np.array([0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 16, 17, 20], dtype=np.intp)


INDEPENDENT = 0.5
"""Joint speeds closer together than this are one observation where offsets far apart are compared, seconds: limbs go to
and fro about once a second, and a few swings look like a few others."""

UNLIKE = 0.05
"""Share of the joint speeds' variance in which two sensors differ at least: more than this, no correlation can tell."""

FINE_RANGE = 0.15
"""The fine search looks this far around the offset first found, seconds."""

FINE_STEP = 0.005

SAMPLE_TIME = 0.1
"""Joint speeds closer together than this are one observation, seconds."""

MIN_STDDEV = 0.002
"""No amount of motion tells the offset better than this, seconds: stamps jitter, and sensors smooth differently."""


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Sensor clock minus reference clock: ``offset + drift (t - at)``, t in seconds since some anchor.

    Attributes:
        offset: seconds.
        drift: seconds per second.
        at: the time at which the errors of offset and drift have nothing to do with each other.
        stddev: of the offset at that time, seconds; by default what times of receipt leave open.
        drift_stddev: of the drift.
    """

    offset: float
    drift: float = 0.0
    at: float = 0.0
    stddev: float = RECEIPT_PRIOR
    drift_stddev: float = DRIFT_PRIOR

    def offset_at(self, time: float) -> float:
        """The offset at a time, seconds."""
        return self.offset + self.drift * (time - self.at)

    def stddev_at(self, time: float) -> float:
        """And its standard deviation, seconds."""
        return float(np.hypot(self.stddev, self.drift_stddev * (time - self.at)))


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """Sensor clock minus reference clock.

    Attributes:
        offset: seconds.
        correlation: normalised correlation of the joint speeds at that offset, -1 to 1.
        likely: the correlation that would be as likely at the guess itself: the less, the farther it lies from there
            and the less motion there was.
        margin: by how much that exceeds the same of every offset more than 0.3 s away.
    """

    offset: float
    correlation: float
    likely: float
    margin: float


def _speeds(stamps: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Compressed joint speeds: stamps (n - SPAN,), values (n - SPAN, joints), and where they are good."""
    step = stamps[SPAN:] - stamps[:-SPAN]
    moved = positions[SPAN:, _LIMB_JOINTS] - positions[:-SPAN, _LIMB_JOINTS]
    speed = np.linalg.norm(moved, axis=-1) / np.maximum(step, 1e-3)[:, None]
    known = np.isfinite(speed)
    good: BoolArray = (known.sum(axis=1) >= MIN_JOINTS) & (step < SPAN * 0.07)
    # A label that jumps is faster than any limb; the logarithm keeps it from deciding alone.
    value = np.log1p(5.0 * np.minimum(np.where(known, speed, 0.0), 5.0))
    # A joint that is not seen moves as the rest does on average.
    mean = value.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    value = np.where(known, value, mean[:, None])
    # Between two samples noise is halved, and it would draw the offset to where all are taken half-way: neighbours that
    # have most of their noise in common do not.
    value = correlate1d(value, SMOOTHING, axis=0, mode="nearest")
    good = minimum_filter1d(good, len(SMOOTHING))
    return 0.5 * (stamps[SPAN:] + stamps[:-SPAN]), value, good


def _sample(series: tuple[FloatArray, FloatArray, BoolArray], at: FloatArray) -> tuple[FloatArray, BoolArray]:
    """A series of speeds interpolated linearly: (m, joints), and (m,) where it is known."""
    stamps, values, good = series
    index = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    known: BoolArray = good[index] & good[index - 1] & (at >= stamps[0]) & (at <= stamps[-1])
    fraction = (at - stamps[index - 1]) / np.maximum(stamps[index] - stamps[index - 1], 1e-6)
    value = values[index - 1] + (values[index] - values[index - 1]) * np.clip(fraction, 0.0, 1.0)[:, None]
    return np.where(known[:, None], value, 0.0), known


def _time_of_motion(speeds: FloatArray, known: BoolArray) -> float:
    """For how long somebody moved, seconds: of the squared deviations e from the mean, (sum e)^2 / sum e^2 samples."""
    moved = ((speeds - speeds.sum(axis=0) / max(known.sum(), 1)) ** 2).sum(axis=1) * known
    return STEP * max(float(moved.sum() ** 2 / np.maximum((moved**2).sum(), 1e-12)), 1.0)


def correlate_clocks(
    reference: tuple[FloatArray, FloatArray], sensor: tuple[FloatArray, FloatArray], guess: float, window: float
) -> OffsetEstimate | None:
    """Find the offset at which the joint speeds of two recordings of one person agree best.

    Args:
        reference: stamps (n,) seconds ascending, positions (n, 25, 3) metres.
        sensor: the same of the other sensor, in its own clock and frame.
        guess: sensor clock minus reference clock, seconds, known to within ``window``.
        window: half width of the search, seconds.

    Returns:
        The best offset, or None where the recordings do not overlap for at least two seconds.
    """
    stamps, other = reference[0], sensor[0] - guess
    if len(stamps) < 2 * SPAN or len(other) < 2 * SPAN:
        return None
    # The grid is a multiple of the step, so that a slightly different guess looks at the same lags.
    first = STEP * np.floor(max(stamps[0], other[0] - window) / STEP)
    last = min(stamps[-1], other[-1] + window)
    count = int((last - first) / STEP)
    lags = int(window / STEP)
    if count * STEP < 2.0:
        return None
    a, known_a = _sample(_speeds(stamps, reference[1]), first + STEP * np.arange(count))
    b, known_b = _sample(_speeds(other, sensor[1]), first + STEP * np.arange(-lags, count + lags))

    def cross(x: FloatArray, y: FloatArray) -> FloatArray:
        """Sums over the grid of x(t) y(t + lag), for every lag of the window."""
        result: FloatArray = fftconvolve(y, x[::-1], mode="valid", axes=0)
        return result

    # Pearson's correlation over the samples that both cover, per joint, for all lags at once.
    mask_a, mask_b = known_a[:, None].astype(float), known_b[:, None].astype(float)
    n = cross(mask_a, mask_b)
    n_safe = np.maximum(n, 1.0)
    mean_a, mean_b = cross(a, mask_b) / n_safe, cross(mask_a, b) / n_safe
    var_a = np.maximum(cross(a * a, mask_b) / n_safe - mean_a**2, 0.0)
    var_b = np.maximum(cross(mask_a, b * b) / n_safe - mean_b**2, 0.0)
    covariance = cross(a, b) / n_safe - mean_a * mean_b
    score = covariance.sum(axis=1) / np.sqrt(np.maximum(var_a.sum(axis=1) * var_b.sum(axis=1), 1e-12))
    score[n[:, 0] * STEP < 2.0] = -1.0
    lag = STEP * (np.arange(len(score)) - lags)
    # Someone who waves looks the same a period later, and of little motion much looks alike: a correlation rho of n
    # independent samples adds n / 2 log(1 / (1 - rho^2)) to the log-likelihood, and the guess a Cauchy prior, for it is
    # rarely far off, but may be by any burst. Both together are a correlation again.
    worse = (1.0 + (lag / RECEIPT_PRIOR) ** 2) ** (2.0 * INDEPENDENT / _time_of_motion(a, known_a))
    unlike = np.maximum(1.0 - score**2, UNLIKE) * worse
    likely = np.where(score > 0.0, np.sqrt(np.maximum(1.0 - unlike, 0.0)), score)
    best = int(np.argmax(likely))
    far = np.abs(lag - lag[best]) > 0.3
    margin = float(likely[best] - likely[far].max()) if far.any() else 0.0
    # The preference chooses the peak and must not move it.
    peak = int(np.argmax(np.where(np.abs(lag - lag[best]) <= 0.1, score, -np.inf)))
    return OffsetEstimate(guess + float(lag[peak]), float(score[peak]), float(likely[best]), margin)


class ClockFit:
    """Offset and drift of one clock, from all the motion so far.

    Every window of motion leaves the correlation rho of the joint speeds for each lag of a grid. The line
    ``offset + drift t`` with the highest likelihood wins: each window of n independent samples adds
    n / 2 log(1 / (1 - rho^2)) at its lag, the drift has a prior, and so has the offset where the times of receipt are
    known. No window has to decide alone, and one in which a sensor sees the body turned around, or nothing moves,
    correlates badly and says little.

    Attributes:
        LIKE: seconds of motion after which more of it says no more of the offset, though of the drift: what looks
            different from either side does so again whenever it is done again. A twist that is seen from its side
            moves an offset by up to 60 ms, for as long as somebody twists.
    """

    LIKE: ClassVar[float] = 60.0

    def __init__(self, centre: float) -> None:
        """Look around an offset.

        Args:
            centre: seconds; rounded to the grid, so that nearly equal centres look at the same lags.
        """
        self._centre = centre
        first = round((centre - FINE_RANGE) / FINE_STEP)
        self._lags = FINE_STEP * (first + np.arange(round(2 * FINE_RANGE / FINE_STEP) + 1))
        self._elapsed: list[float] = []
        self._sums: list[FloatArray] = []  # (4, lags) per window: a b, a a, b b, seconds

    def __len__(self) -> int:
        return len(self._elapsed)

    def add(
        self,
        elapsed: float,
        reference: tuple[FloatArray, FloatArray],
        sensor: tuple[FloatArray, FloatArray],
    ) -> bool:
        """Take a window of motion.

        Args:
            elapsed: reference time of its middle since the anchor, seconds.
            reference: stamps (n,) seconds ascending, positions (n, 25, 3) metres: the window.
            sensor: the same of the other sensor, in its own clock and frame, covering the window and its surroundings.

        Returns:
            Whether the two overlap enough to say anything.
        """
        if len(reference[0]) < 10 or len(sensor[0]) < 10:
            return False
        at, a, known_a = _speeds(*reference)
        series = _speeds(*sensor)
        sampled = [_sample(series, at + lag) for lag in self._lags]
        # The same frames at every lag, or their number would decide.
        both = known_a & np.logical_and.reduce([known for _, known in sampled])
        seconds = float(both.sum() * np.median(np.diff(at)))
        if seconds < 1.0:
            return False
        own = a[both] - a[both].mean(axis=0)
        theirs = np.stack([values[both] for values, _ in sampled])
        theirs -= theirs.mean(axis=1, keepdims=True)
        sums = np.empty((4, len(self._lags)))
        sums[0] = np.einsum("nj,lnj->l", own, theirs)
        sums[1] = (own**2).sum()
        sums[2] = np.einsum("lnj,lnj->l", theirs, theirs)
        sums[3] = seconds
        self._elapsed.append(elapsed)
        self._sums.append(sums)
        if len(self) > MAX_WINDOWS:
            del self._elapsed[0], self._sums[0]
        return True

    def solve(self, expected: ClockEstimate | None = None) -> ClockEstimate | None:
        """The clock so far.

        Args:
            expected: what is known of it without this motion, if anything. Not to be believed where its offset is
                farther than :data:`FINE_RANGE` from the centre.

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
        last = len(self._lags) - 1

        def places_on(offset: float, drift: float) -> tuple[IntArray, FloatArray]:
            """Where each window's lag on a line lies in the grid: the point before it, and how far after that."""
            place = np.clip(offset + drift * elapsed, self._lags[0], self._lags[-1])
            before = np.minimum(((place - self._lags[0]) / FINE_STEP).astype(np.intp), last - 1)
            return before, place - self._lags[before]

        # The prior: 1 / variance of the offset and its time from the middle, 1 / variance of the drift.
        trust, at, prior = 0.0, 0.0, ClockEstimate(0.0)
        if expected is not None and abs(expected.offset - self._centre) <= FINE_RANGE:
            trust, at, prior = expected.stddev**-2, expected.at - middle, expected
        drift_trust = prior.drift_stddev**-2
        drifts = DRIFT_STEP * np.arange(-DRIFT_STEPS, DRIFT_STEPS + 1)
        # Newton's method on the smoothed likelihood, from the best point of a coarse grid, on which each window is
        # shifted by whole lags.
        width = 2 * round(PEAK_WIDTH / FINE_STEP) + 1
        slope, bend = (savgol_filter(likelihood, width, 2, deriv=deriv, delta=FINE_STEP, axis=1) for deriv in (1, 2))
        uphill = CubicSpline(self._lags, slope, axis=1)
        smooth = uphill.antiderivative()(self._lags)
        shifts = np.rint(drifts[:, None] * elapsed / FINE_STEP).astype(np.intp)
        places = np.clip(np.arange(last + 1) + shifts[..., None], 0, last)
        total = smooth[rows[None, :, None], places].sum(axis=1)
        total -= 0.5 * drift_trust * (drifts[:, None] - prior.drift) ** 2
        total -= 0.5 * trust * (self._lags + drifts[:, None] * at - prior.offset) ** 2
        best = np.unravel_index(int(np.argmax(total)), total.shape)
        drift, offset = float(drifts[best[0]]), float(self._lags[best[1]])
        bounds = trust * np.array([[1.0, at], [at, at**2]]) + np.diag([0.0, drift_trust])  # what is expected
        told = np.zeros(2)
        for _ in range(20):
            piece, x = places_on(offset, drift)
            a, b, c, d = uphill.c[:, piece, rows]
            g, h = ((a * x + b) * x + c) * x + d, (3.0 * a * x + 2.0 * b) * x + c
            told = np.array([g.sum(), g @ elapsed])
            motion = -np.array([[h.sum(), h @ elapsed], [h @ elapsed, h @ elapsed**2]])
            off = trust * (offset + drift * at - prior.offset)
            draws = told - np.array([off, off * at + drift_trust * (drift - prior.drift)])
            # Between the points of the grid it can bend upwards: uphill even so.
            curvatures, axes = np.linalg.eigh(motion + bounds)
            step = axes @ ((axes.T @ draws) / np.maximum(np.abs(curvatures), 1e-9))
            step *= min(1.0, 0.5 * PEAK_WIDTH / max(abs(step[0]), 1e-12), DRIFT_STEP / max(abs(step[1]), 1e-12))
            offset, drift = offset + float(step[0]), drift + float(step[1])
            if abs(step[0]) < 1e-6:
                break
        if not self._lags[0] + PEAK_WIDTH < offset < self._lags[-1] - PEAK_WIDTH or abs(drift) > drifts[-1]:
            return None
        piece, x = places_on(offset, drift)
        h = bend[rows, piece] + x / FINE_STEP * (bend[rows, piece + 1] - bend[rows, piece])
        motion = -np.array([[h.sum(), h @ elapsed], [h @ elapsed, h @ elapsed**2]])
        # An error that all windows have in common, of the variance T / LIKE times that of the offset by the motion:
        # by the formula of Sherman and Morrison, and the estimate is drawn to what is expected by as much.
        share = np.zeros(2)
        if motion[0, 0] > 0.0:
            share = motion[0] / (motion[0, 0] * (1.0 + self.LIKE / float(sums[:, 3, 0].sum())))
        information = motion + bounds - np.outer(share, motion[0])
        if np.linalg.eigvalsh(information)[0] <= 0.0:
            return None
        offset, drift = np.array([offset, drift]) - np.linalg.solve(information, share * told[0])
        (variance, both), (_, drift_variance) = np.linalg.inv(information)
        apart = -both / drift_variance  # from the middle to where the two errors are independent
        variance -= both**2 / drift_variance
        # What the motion says of the drift counts as much less as it does of the offset for the jitter.
        jitter = variance / (variance + MIN_STDDEV**2)
        drift_trust += max(1.0 / drift_variance - drift_trust, 0.0) * jitter
        return ClockEstimate(
            float(offset + drift * apart),
            float(drift),
            float(middle + apart),
            float(np.hypot(np.sqrt(variance), MIN_STDDEV)),
            float(drift_trust**-0.5),
        )
