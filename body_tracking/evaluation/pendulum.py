"""Frequency of a pendulum from a sensor's signal (Schlagenhauf 2017, section 4.1.2; figures 4.9-4.10).

The thesis compares measured with theoretical frequencies without describing the measurement. Here a damped oscillation
is fitted to the signal at its true stamps, so that lost frames and irregular intervals do no harm. The period of a
pendulum grows with its amplitude, by 0.4 % at 15 degrees; the fitted frequency is that of small amplitudes, which
depends on the length alone: sqrt(g / L) / (2 pi).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import find_peaks, lombscargle

from body_tracking.core.csv_file import CsvFile
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import STANDARD_GRAVITY
from body_tracking.core.skeleton import FloatArray

Signal = Literal["sine", "angle", "rate"]
"""Kind of signal of the pendulum's angle to the vertical: its sine (the ball's displacement as a share of the length),
the angle (radians), or its rate (radians per second)."""
SLOWEST, FASTEST = 0.1, 5.0
"""Limits of the searched frequency, Hz: pendulums of 25 m and 10 mm."""
_PERIODS: Final = 3.0
"""Least number of periods in a signal."""
_LEAST: Final = 20
"""Least number of samples."""
_ROUNDS: Final = 5
"""Number of fits of the arc, each without the outliers of the previous one."""
_FAR: Final = 3.0
"""Largest distance, in median distances from the middle, of points used for the swing's direction; its ends are at
1.4."""
_OUTLIER: Final = 4.0
"""Standard deviations above which a point is an outlier of the arc."""
_NORMAL_MAD: Final = 1.4826
"""Standard deviation of a normal distribution in units of its median absolute deviation."""


class PendulumError(BodyTrackingError):
    """Raised for a signal that is not a swinging pendulum's, or an unusable file."""


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """A fitted oscillation.

    Attributes:
        frequency: Hz, for small amplitudes and without damping.
        stddev: standard deviation of the frequency from the scatter of the signal, Hz.
        amplitude: radians, at the first sample.
        damping: decay rate of the amplitude, 1/s.
        residual: root mean square of the signal's residual, in its unit.
        fitted: (n,) the oscillation at the times of the samples, in the signal's unit.
    """

    frequency: float
    stddev: float
    amplitude: float
    damping: float
    residual: float
    fitted: FloatArray


def natural_frequency(length: float, gravity: float = STANDARD_GRAVITY) -> float:
    """Natural frequency (Hz) for small amplitudes of a point on a string of this length (m)."""
    return float(np.sqrt(gravity / length) / (2.0 * np.pi))


def oscillation(times: FloatArray, parameters: FloatArray, signal: Signal) -> tuple[FloatArray, float]:
    """The signal at (n,) s after the start, and the initial amplitude, radians.

    The phase advances by the angular frequency at the present amplitude theta: omega (1 - theta^2 / 16 +
    theta^4 / 3072), the inverse of the period's series, 1 + theta^2 / 16 + 11 theta^4 / 3072. A test compares it with
    integrated equations of motion.

    Args:
        times: (n,) s.
        parameters: (5,) angular frequency rad/s, damping 1/s, amplitudes of cosine and minus sine at the start, offset.
        signal: kind of signal.
    """
    omega, damping, cosine, sine, offset = parameters
    amplitude = np.hypot(cosine, sine)
    if signal == "rate":
        theta = amplitude / omega
    elif signal == "angle":
        theta = amplitude
    else:
        # the first harmonic of sin(theta cos(phase)) is 2 J1(theta) = theta - theta^3 / 8
        share = min(float(amplitude), 1.0)
        theta = share + share**3 / 8.0
    mean_square, mean_fourth = (theta**power * _decayed(power * damping, times) for power in (2, 4))
    phase = np.sqrt(np.maximum(omega**2 - damping**2, 0.0)) * (times - mean_square / 16.0 + mean_fourth / 3072.0)
    turned = np.exp(-damping * times) * (cosine * np.cos(phase) - sine * np.sin(phase))
    return np.asarray(offset + turned), float(theta)


def _decayed(rate: float, times: FloatArray) -> FloatArray:
    """The integral of exp(-rate t) from 0 to (n,) s."""
    return times if abs(rate) < 1e-9 else np.asarray(-np.expm1(-rate * times) / rate)


def fit_swing(times: FloatArray, values: FloatArray, signal: Signal) -> Swing:
    """Fit a damped oscillation, robustly against single outliers (Schlagenhauf 2017, section 4.1.2; figure 4.10).

    Args:
        times: (n,) s, the capture times; any steps.
        values: (n,) the signal; NaN where unknown.
        signal: kind of signal, which determines the amplitude as an angle.

    Raises:
        PendulumError: too few samples or periods, or no oscillation.
    """
    known = np.isfinite(values)
    if np.count_nonzero(known) < _LEAST:
        raise PendulumError(f"{np.count_nonzero(known)} samples of the pendulum, at least {_LEAST} are needed")
    start = float(times[known][0])
    at, seen = times[known] - start, values[known]
    span = float(at[-1])
    centred = seen - seen.mean()
    if not (span * FASTEST > _PERIODS and centred.std() > 0.0):
        raise PendulumError(f"a signal of {span:.2f} s that {'stands still' if span else 'has one time'}")
    grid = np.arange(max(SLOWEST, 1.0 / span), FASTEST, 0.2 / span)
    omega = 2.0 * np.pi * float(grid[np.argmax(lombscargle(at, centred, 2.0 * np.pi * grid))])
    design = np.column_stack([np.cos(omega * at), -np.sin(omega * at), np.ones_like(at)])
    linear = np.linalg.lstsq(design, seen, rcond=None)[0]
    begin = np.array([omega, 0.0, *linear])
    size = float(np.hypot(linear[0], linear[1])) or 1.0
    scale = np.array([1.0 / span, 1.0 / span, size, size, size])

    def residuals(parameters: FloatArray) -> FloatArray:
        return oscillation(at, parameters, signal)[0] - seen

    def spread(residual: FloatArray) -> float:
        return max(_NORMAL_MAD * float(np.median(np.abs(residual))), 1e-9 * size)

    low = np.array([2.0 * np.pi * 0.5 * SLOWEST, -5.0 / span, *(-np.inf,) * 3])
    bounds = low, np.array([4.0 * np.pi * FASTEST, 50.0 / span, *(np.inf,) * 3])
    for _ in range(2):
        # the second fit uses an outlier scale from the residuals of the damped model
        found = least_squares(
            *(residuals, begin), bounds=bounds, x_scale=scale, loss="soft_l1", f_scale=spread(residuals(begin))
        )
        begin = found.x
    residual = residuals(found.x)
    fitted, theta = oscillation(at, found.x, signal)
    noise = spread(residual)
    frequency = float(found.x[0] / (2.0 * np.pi))
    if frequency * span < _PERIODS:
        raise PendulumError(f"{frequency * span:.1f} periods of the pendulum, at least {_PERIODS:.0f} are needed")
    if not np.ptp(fitted) > 2.0 * noise:
        raise PendulumError("nothing swings: no oscillation stands out of the scatter of the positions")
    covariance = noise**2 * np.linalg.pinv(found.jac.T @ found.jac)
    whole = np.full(len(times), np.nan)
    whole[known] = fitted
    return Swing(
        frequency,
        float(np.sqrt(covariance[0, 0]) / (2.0 * np.pi)),
        theta,
        float(found.x[1]),
        float(np.sqrt((residual**2).mean())),
        whole,
    )


def along(points: FloatArray) -> FloatArray:
    """(n, d) coordinates of (n, d) points relative to their median along their principal axes, the largest first.

    NaN where unknown.
    """
    known = np.isfinite(points).all(axis=1)
    if not known.any():
        return np.full(points.shape, np.nan)
    centred = points - np.median(points[known], axis=0)
    distances = np.linalg.norm(centred, axis=1)
    near = distances <= _FAR * np.median(distances[known])  # false for NaN
    _, vectors = np.linalg.eigh(centred[near].T @ centred[near])
    return np.asarray(centred @ vectors[:, ::-1])


def sines(points: FloatArray) -> FloatArray:
    """(n,) sines of the pendulum's angle from the arc of its ball in the image, up to a constant.

    The ball is at R (sin, 1 - cos) of the angle. The curvature of the arc gives R in the image, so that neither the
    camera's distance nor the length is needed. The swing is assumed to be perpendicular to the view.

    Args:
        points: (n, 2) undistorted image coordinates x/z and y/z; NaN where unknown.
    """
    u, v = along(points).T
    known = np.isfinite(u)
    # a distant outlier would bend the first arc
    near = known & (np.abs(u) <= _FAR * np.median(np.abs(u[known])))
    off = np.abs(v - np.median(v[known]))
    inside, curvature = near & (off <= _OUTLIER * _NORMAL_MAD * np.median(off[known])), 0.0
    for _ in range(_ROUNDS):
        # arc of curvature c: (1 - sqrt(1 - c^2 u^2)) / c = c u^2 / (1 + sqrt(1 - c^2 u^2))
        rise = u**2 / (1.0 + np.sqrt(np.maximum(1.0 - (curvature * u) ** 2, 0.0)))
        design = np.column_stack([np.ones_like(u), u, rise])
        line = np.linalg.lstsq(design[inside], v[inside], rcond=None)[0]
        curvature = abs(float(line[2]))
        residual = np.abs(design @ line - v)
        inside = near & (residual <= _OUTLIER * _NORMAL_MAD * np.median(residual[near]))
    return np.asarray(curvature * u)


# --- the data set of a pendulum with Vicon of Szczesna et al. (2016)

_HEADER: Final = "Time;Vicon Orientation;"
_WIDTH: Final = 14
_LARGEST, _SMALLEST = np.radians([20.0, 2.0])
"""Amplitudes between which a decay is used: three links swing together once the higher modes have died away."""
_SWINGS: Final = 7
"""Least number of half periods of a decay."""


@dataclass(frozen=True, slots=True, eq=False)
class Decay:
    """A released pendulum, measured by Vicon and by an inertial sensor on it.

    Attributes:
        start: s, on the file's clock.
        vicon: fit of the angle of Vicon's orientation.
        gyroscope: fit of the angular rate about the same axis.
    """

    start: float
    vicon: Swing
    gyroscope: Swing


def vicon_decays(path: Path) -> list[Decay]:
    """The decays of a link of the pendulum (RepoIMU; Szczesna et al. 2016), one per release.

    The angle is about the axis of most motion. Rows that repeat a reading of the gyroscope are ignored.

    Raises:
        CsvError: the file cannot be read.
        PendulumError: another layout, or no decay.
    """
    if not next(CsvFile(path).lines(), "").startswith(_HEADER):
        raise PendulumError(f"{path}: the header is not that of Szczesna et al. (2016), {_HEADER!r}...")
    try:
        rows = np.array(
            [  # some files have decimal commas
                [float(cell.replace(",", ".") or "nan") for cell in line.split(";")]
                for line in [*CsvFile(path).lines()][2:]
            ]
        )
    except ValueError as error:
        raise PendulumError(f"{path}: {error}") from error
    if rows.ndim != 2 or rows.shape[1] != _WIDTH:
        raise PendulumError(f"{path}: not {_WIDTH} columns in all rows")
    times, quats, rates = rows[:, 0], rows[:, 1:5], rows[:, 8:11]
    sound = np.abs(np.linalg.norm(quats, axis=1) - 1.0) < 0.01
    # small angles about one axis: about twice the vector part of the quaternion with positive w
    vectors = 2.0 * np.arcsin(np.clip(quats[:, 1:] * np.sign(quats[:, :1]), -1.0, 1.0))
    angle = along(np.where(sound[:, None], vectors, np.nan))[:, 0]
    moved = np.concatenate([[True], (np.diff(rates, axis=0) != 0.0).any(axis=1)])
    rate = along(np.where(moved[:, None], rates, np.nan))[:, 0]
    found = []
    for first, last in _decays(times, angle):
        part = slice(first, last + 1)
        found.append(
            Decay(
                float(times[first]),
                fit_swing(times[part], angle[part], "angle"),
                fit_swing(times[part], rate[part], "rate"),
            )
        )
    if not found:
        raise PendulumError(f"{path}: the pendulum never swings out freely from {np.degrees(_LARGEST):.0f} degrees")
    return found


def _decays(times: FloatArray, angle: FloatArray) -> list[tuple[int, int]]:
    """First and last row of each run of alternating extrema with decreasing size."""
    filled = np.interp(times, times[np.isfinite(angle)], angle[np.isfinite(angle)])
    step = float(np.median(np.diff(times)))
    apart = max(1, round(0.25 / step))
    peaks = np.sort(
        np.concatenate(
            # prominence: extrema of higher modes are ignored
            [
                find_peaks(sign * filled, height=_SMALLEST, distance=apart, prominence=2.0 * _SMALLEST)[0]
                for sign in (1, -1)
            ]
        )
    )
    runs: list[list[int]] = []
    before = 0.0
    for peak in peaks:
        height = abs(filled[peak])
        if not (height <= abs(before) and filled[peak] * before < 0.0):
            runs.append([])
        before = float(filled[peak])
        if height <= _LARGEST:
            runs[-1].append(int(peak))
    return [(run[0], run[-1]) for run in runs if len(run) > _SWINGS]
