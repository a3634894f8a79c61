"""Orientation of an inertial sensor from its raw data, with a consistent covariance.

The orientation is that of VQF (Laidig and Seel, "VQF: Highly accurate IMU orientation estimation with bias estimation
and magnetic disturbance rejection", Information Fusion 91, 2023), which needs a constant rate and has no covariance.
This module adds both: readings with jitter, losses and outages, and an error budget of tilt and heading.

Over 500 lines: the orientation filter and its measured constants, in one place.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation
from vqf import VQF

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import STANDARD_GRAVITY, ImuSample
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.core.so3 import wrapped

OUTAGE_S: Final = 1.0
"""A longer gap restarts the tilt, and the heading is nearly unknown afterwards."""
_STARTING: Final = 16
"""Number of readings for the initial rate, before the first orientation."""
_RATE_OVER: Final = 256
"""Number of intervals whose mean is compared with the initial rate."""
_RATE_CHANGED: Final = 1.3
_FORGET_BIAS_S: Final = 10.0
"""A longer gap resets the bias: the sensor may have been switched off."""
_UNIT_OF_BIAS: Final = np.radians(0.01)
"""rad/s: VQF's covariance of the bias is in (0.01 deg/s)^2."""
_VQF_WANDER: Final = np.radians(0.1) / np.sqrt(100.0)
"""rad/s/sqrt(s): VQF's bias walks 0.1 deg/s within its ``biasForgettingTime``."""
_CLIPPED: Final = 0.95
"""Share of the range from which a rate counts as clipped: calibration shifts the limit by scale and bias."""
_UNIFORM: Final = np.pi / np.sqrt(3.0)
"""Standard deviation of an angle that is uniform over a turn."""


class ImuOrientationError(BodyTrackingError):
    """Raised when a reading lacks angular velocity or acceleration."""


@dataclass(frozen=True, slots=True)
class InertialErrors:
    """Assumed errors of an inertial sensor, standard deviations per axis.

    The defaults are those of consumer chips that were calibrated once; ``simulated_errors`` has the sources.

    Attributes:
        gyro_noise: rad/s/sqrt(Hz).
        gyro_bias: rad/s, turn-on.
        gyro_wander: rad/s/sqrt(s), random walk of the bias.
        gyro_scale: 1.
        gyro_axes: 1, cross-axis sensitivity.
        gyro_range: rad/s, limit at which an axis is clipped.
        acc_bias: m/s2.
        acc_scale: 1, scale and cross-axis sensitivity.
        mag_bias: tesla, hard iron after calibration.
        mag_scale: 1, soft iron after calibration.
    """

    gyro_noise: float = float(np.radians(0.01))
    gyro_bias: float = float(np.radians(0.3))
    gyro_wander: float = float(np.radians(0.002))
    gyro_scale: float = 0.01
    gyro_axes: float = 0.005
    gyro_range: float = float(np.radians(2000.0))
    acc_bias: float = 0.1
    acc_scale: float = 0.005
    mag_bias: float = 1e-6
    mag_scale: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ImuOrientation:
    """Orientation of an inertial sensor at one instant.

    Attributes:
        stamp_ns: of the reading.
        orientation: (4,) unit quaternion xyzw, sensor to earth (z up).
        covariance: (3, 3) rad2 about the earth's axes.
        angular_velocity: (3,) rad/s in the sensor's frame, bias subtracted.
        bias: (3,) rad/s in the sensor's frame.
    """

    stamp_ns: int
    orientation: FloatArray
    covariance: FloatArray
    angular_velocity: FloatArray
    bias: FloatArray


class OrientationEstimator:
    """The orientation of one sensor, reading by reading.

    Earth: z up. With a magnetometer x is magnetic east and y north, from the first field on. Without one, x and y are
    such that the first orientation is the shortest rotation that makes z vertical; they turn with the heading's drift.

    Time: VQF runs at the rate of the first 16 readings (0.04 s at 400 Hz, 0.64 s at 25 Hz), for which there is no
    orientation. Between two readings, rate and acceleration are interpolated linearly over the nearest number of VQF's
    steps, and the angle is scaled to the interval of the stamps: the error by jitter of the stamps depends on the
    change of the rate, and does not accumulate. This bridges lost readings for up to 1 s; the covariance includes the
    angle that may have been missed. A longer gap or a changed rate restarts the tilt and increases the heading's
    variance. Time that runs backwards restarts everything. Repeated stamps are ignored.

    Range: a clipped rate understates the rotation. The hidden angle, for up to half a second, is added at the second
    reading after clipping, by the cubic through the rates before and after; until then the covariance does not include
    it. After that, as after lost readings, the accelerometer corrects the tilt with a larger weight: VQF's low-pass
    restarts as the mean of as many readings as the remaining accuracy of the tilt is worth.

    Args:
        magnetometer: use the magnetic field where readings have it.
        errors: assumed errors of the sensor.
    """

    def __init__(self, *, magnetometer: bool = True, errors: InertialErrors | None = None) -> None:
        self._magnetometer = magnetometer
        self._errors = InertialErrors() if errors is None else errors
        self.restarts = 0
        self._begin()

    def _begin(self) -> None:
        self._starting: list[ImuSample] = []
        self._latest: ImuSample | None = None
        self._filter: Any = None
        self._step = 0.0
        self._intervals: deque[float] = deque(maxlen=_RATE_OVER)
        self._budget = _Budget(self._errors)
        self._stretch = _ClippedRate(self._errors.gyro_range)
        self._before: tuple[FloatArray, Any] | None = None
        self._field_seen = False

    @property
    def rate_hz(self) -> float | None:
        """Rate at which VQF runs; None before the first orientation."""
        return 1.0 / self._step if self._step else None

    @property
    def magnetically_disturbed(self) -> bool | None:
        """Whether the field differs from the reference, or no reference exists yet; None without a field."""
        return bool(self._filter.getMagDistDetected()) if self._field_seen and self._filter is not None else None

    def update(self, sample: ImuSample) -> ImuOrientation | None:
        """The orientation at a reading; None while the estimator starts, and for a repeated stamp.

        Raises:
            ImuOrientationError: no angular velocity or no acceleration; the state stays.
        """
        if sample.angular_velocity is None or sample.acceleration is None:
            missing = "angular velocity" if sample.angular_velocity is None else "acceleration"
            raise ImuOrientationError(f"{sample.frame_id}: a reading without {missing}")
        if self._latest is not None:
            interval = (sample.stamp_ns - self._latest.stamp_ns) / NANOSECONDS
            if interval == 0.0:
                return None
            if interval < 0.0:
                self._begin()
            elif interval > OUTAGE_S:
                self._restart(interval)
            else:
                self._intervals.append(interval)
                if self._filter is not None and self._has_another_rate():
                    self._restart(0.0)
        if self._filter is not None:
            return self._go_on(sample)
        self._starting.append(sample)
        self._latest = sample
        if len(self._starting) < _STARTING:
            return None
        return self._start()

    # --- time

    def _has_another_rate(self) -> bool:
        if len(self._intervals) < _RATE_OVER:
            return False
        ratio = sum(self._intervals) / len(self._intervals) / self._step  # numpy would copy them at each reading
        return not 1.0 / _RATE_CHANGED < ratio < _RATE_CHANGED

    def _restart(self, gap: float) -> None:
        """Restart rate and tilt; keep heading, bias, field and their variances."""
        if self._filter is not None and self._latest is not None:
            self.restarts += 1
            self._before = self._filter.getQuat9D(), self._filter.state
            self._budget.lose(gap)
        if gap > _FORGET_BIAS_S and self._before is not None:
            self._before = self._before[0], {**self._before[1], "bias": None}
            self._budget.forget_bias()
        self._filter = None
        self._stretch = _ClippedRate(self._errors.gyro_range)
        self._starting.clear()
        self._intervals.clear()

    def _start(self) -> ImuOrientation:
        """Run VQF over the first readings."""
        intervals = np.array(self._intervals)
        # without gaps, which would bias the mean of so few intervals
        self._step = float(intervals[intervals <= 3.0 * np.median(intervals)].mean())
        fields = sum(sample.magnetic_field is not None for sample in self._starting)
        spacing = self._step * len(self._starting) / fields if fields and self._magnetometer else self._step
        self._filter = VQF(self._step, self._step, spacing)
        before = self._before
        if before is not None:
            known = self._filter.state
            for name in ("magRefNorm", "magRefDip", *(("bias", "biasP") if before[1]["bias"] is not None else ())):
                known[name] = before[1][name]
            self._filter.state = known
        first, *others = self._starting
        self._latest = None
        result = self._go_on(first)
        if before is not None and (first.magnetic_field is None or not self._magnetometer):
            # the rotation about the vertical that brings the new orientation nearest to the last
            turn = VQF.quatMultiply(before[0], VQF.quatConj(self._filter.getQuat9D()))
            state = self._filter.state
            state["delta"] += 2.0 * float(np.arctan2(turn[3], turn[0]))
            self._filter.state = state
        for sample in others:
            result = self._go_on(sample)
        self._starting.clear()
        self._before = None
        return result

    # --- one reading

    def _go_on(self, sample: ImuSample) -> ImuOrientation:
        rate, force = sample.angular_velocity, sample.acceleration
        assert rate is not None and force is not None
        vqf = self._filter
        bias, _ = vqf.getBiasEstimate()
        before = vqf.state
        if self._latest is None:
            interval, steps = self._step, 1
            vqf.updateGyr(rate)
            vqf.updateAcc(force)
            middle = rate
        else:
            interval = (sample.stamp_ns - self._latest.stamp_ns) / NANOSECONDS
            steps = max(1, round(interval / self._step))
            old_rate, old_force = self._latest.angular_velocity, self._latest.acceleration
            assert old_rate is not None and old_force is not None
            stretch = interval / (steps * self._step)
            for k in range(steps):
                share = (k + 0.5) / steps
                # the angle without the bias is scaled to the interval of the stamps
                vqf.updateGyr(bias + (old_rate + share * (rate - old_rate) - bias) * stretch)
                vqf.updateAcc(old_force + (k + 1) / steps * (force - old_force))
            middle = 0.5 * (old_rate + rate)
        after = vqf.state
        up = _up(vqf.getQuat6D())
        self._budget.predict(interval, steps, self._step, up, middle - bias, before, after)
        hidden = self._stretch.update(steps * self._step, rate)
        if hidden is not None:
            self._budget.doubt(hidden.doubt**2)
            self._turn_by(hidden.angle)
        if hidden is not None or steps > 2:
            self._level_anew()
        if self._magnetometer and sample.magnetic_field is not None:
            self._turn_to(sample.magnetic_field)
        self._latest = sample
        w, x, y, z = vqf.getQuat9D()
        bias, _ = vqf.getBiasEstimate()
        return ImuOrientation(
            sample.stamp_ns,
            np.array([x, y, z, w]),
            self._budget.covariance(),
            rate - bias,
            bias,
        )

    def _turn_by(self, angle: FloatArray) -> None:
        """Rotate VQF's orientation by a rotation vector (3,) in the sensor's frame."""
        state = self._filter.state
        half = 0.5 * angle
        turn = np.concatenate([[np.cos(np.linalg.norm(half))], np.sinc(np.linalg.norm(half) / np.pi) * half])
        state["gyrQuat"] = VQF.quatMultiply(np.array(state["gyrQuat"]), turn)
        self._filter.state = state

    def _level_anew(self) -> None:
        """Restart VQF's low-pass of the acceleration with the weight of the remaining accuracy of the tilt."""
        state, params = self._filter.state, self._filter.params
        worth = max(params["tauAcc"] * self._budget.known_tilt(), _LEAST_WORTH_S) / self._step
        low_pass = np.array(state["accLpState"])
        if worth >= (low_pass[1] if np.isnan(low_pass[0]) else 0.5 * params["tauAcc"] / self._step):
            return
        low_pass[:2] = np.nan, worth
        low_pass[2:5] = worth * np.asarray(state["lastAccLp"])
        state["accLpState"] = low_pass
        self._filter.state = state

    def _turn_to(self, field: FloatArray) -> None:
        """Let VQF correct the heading by a magnetic field, and pass its gain to the error budget."""
        vqf = self._filter
        self._field_seen = True
        east, north, up = VQF.quatRotate(vqf.getQuat6D(), field)
        before = vqf.getDelta()
        vqf.updateMag(field)
        off = wrapped(np.arctan2(east, north) - before)
        gain = wrapped(vqf.getDelta() - before) / off if abs(off) > 1e-9 else 0.0
        strength = float(np.sqrt(field @ field))
        self._budget.correct(
            float(np.clip(gain, 0.0, 1.0)),
            strength,
            -float(np.arcsin(np.clip(up / max(strength, 1e-12), -1.0, 1.0))),
            vqf.getMagRefNorm(),
            vqf.getMagRefDip(),
            bool(vqf.getMagDistDetected()),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Hidden:
    """The rotation hidden by clipping: a rotation vector (3,) in the sensor's frame, and its deviation, radians."""

    angle: FloatArray
    doubt: float


class _ClippedRate:
    """Detects clipped rates, and estimates the rotation meanwhile.

    The rate of a clipped axis is the Hermite cubic with the rates and slopes just outside the clipped period: with
    rates a, b, slopes a', b' and duration T the angle is ``T (a + b) / 2 + T^2 (a' - b') / 12``. Slopes are computed
    with the even steps of the sensor's own clock, as the jitter of stamps does not average out in them.
    """

    def __init__(self, stop: float) -> None:
        self._stop = stop
        self._readings: list[tuple[float, FloatArray]] = []
        self._open = False
        self._free = 0

    def update(self, interval: float, rate: FloatArray) -> _Hidden | None:
        """The hidden rotation, at the second reading after clipping; None at all others.

        Args:
            interval: seconds since the reading before, whole steps of the sensor.
            rate: (3,) rad/s.
        """
        time = (self._readings[-1][0] if self._readings else 0.0) + interval
        self._readings.append((time, rate))
        if self._at_stop(rate).any():
            # without two readings before there is no slope
            self._open = self._open or len(self._readings) > 2
            self._free = 0
            if not self._open:
                self._readings.clear()
            elif time - self._readings[1][0] > _JOINED_S:
                del self._readings[2:-1]
            return None
        self._free += 1
        if self._open and self._free < 2:
            return None
        result = self._joined() if self._open else None
        self._open = False
        del self._readings[:-2]
        return result

    def _at_stop(self, rate: FloatArray) -> BoolArray:
        return np.abs(rate) >= _CLIPPED * self._stop

    def _joined(self) -> _Hidden:
        times, rates = np.array([time for time, _ in self._readings]), np.array([rate for _, rate in self._readings])
        slopes = (rates[[1, -1]] - rates[[0, -2]]) / (times[[1, -1]] - times[[0, -2]])[:, None]
        times, rates = times[1:-1], rates[1:-1]
        length = float(times[-1] - times[0])
        if length > _JOINED_S:
            return _Hidden(np.zeros(3), self._stop * length)
        turned = 0.5 * (rates[1:] + rates[:-1]) * np.diff(times)[:, None]
        cubic = np.diff(CubicHermiteSpline(times[[0, -1]], rates[[0, -1]], slopes).antiderivative()(times), axis=0)
        total = turned.sum(axis=0)
        # clipping hides only rotation beyond the limit
        beyond = self._at_stop(rates).any(axis=0) & ((cubic.sum(axis=0) - total) * total > 0.0)
        true = np.where(beyond, cubic, turned)
        hidden = np.where(beyond, cubic.sum(axis=0) - total, 0.0)
        share = _HIDDEN * max(1.0, length / _COHERENT_S) ** 2
        doubt = max(_LEAST_HIDDEN * self._stop * length, share * float(np.linalg.norm(hidden)))
        # the rates of the other axes apply in the corrected orientation
        angle = (_product(turned).inv() * _product(true)).as_rotvec()
        return _Hidden(angle, doubt)


def _product(turns: FloatArray) -> Rotation:
    """Rotation vectors (n, 3), one after the other, each in the sensor's frame."""
    result = Rotation.identity()
    for turn in turns:
        result = result * Rotation.from_rotvec(turn)
    return result


def _up(quat_wxyz: FloatArray) -> FloatArray:
    """(3,) the earth's z in the sensor's frame."""
    w, x, y, z = quat_wxyz
    return np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])


# --- error budget

_TILT_S: Final = 3.0
"""VQF's ``tauAcc``."""
_CORRECTION_S: Final = 6.0
"""Seconds over which the square of the tilt's corrections is averaged."""
_CORRECTED: Final = 0.1
"""Standard deviation of the tilt by the motion's acceleration, as a multiple of ``tauAcc`` times the RMS correction."""
_TURNING: Final = 0.5
"""rad/s: least rate that is assumed over a gap."""
_TURNING_S: Final = 5.0
_COHERENT_S: Final = 0.3
"""Seconds for which a rate persists: over longer gaps, linear interpolation has no value."""
_HIDDEN: Final = 0.2
"""Standard deviation of the angle hidden by clipping, as a share of this angle: twice that of swings at 1.2 Hz."""
_JOINED_S: Final = 0.5
"""Seconds of clipping after which the angle is unknown."""
_LEAST_HIDDEN: Final = 0.03
"""Least standard deviation of the hidden angle, as a share of range times duration."""
_LEAST_WORTH_S: Final = 0.3
"""Least duration in seconds of the restarted low-pass: over less, a motion's acceleration does not average out."""
_UNKNOWN_FIELD: Final = np.radians(10.0)
"""Standard deviation of a heading by the first field."""
_DISTURBED_FIELD: Final = np.radians(60.0)
"""Standard deviation of a heading by a disturbed field."""


_UNIT: Final = np.eye(3)


class _Budget:
    """The variances of tilt and heading.

    Tilt: the accelerometer's errors, the shift of VQF's low-passed vertical by the motion's acceleration, and rotation
    missed in gaps.

    Heading: the integral of the rate's error. With e the error of the bias, S that of the scales, u the vertical and w
    the rate in the sensor's frame: ``h' = u . e + u . S w + noise``. VQF's covariance of the bias is P; c is that of h
    and e. A magnetic update of gain k scales all of that by 1 - k and adds k times its own error.
    """

    def __init__(self, errors: InertialErrors) -> None:
        self._errors = errors
        self._steady = (errors.acc_bias / STANDARD_GRAVITY) ** 2 + errors.acc_scale**2
        self._corrections = 0.0
        self._missed_tilt = 0.0
        self._noise = 0.0
        self._by_bias = 0.0
        self._cross = np.zeros(3)
        self._swept = np.zeros((3, 3))
        self._scales = np.where(np.eye(3, dtype=np.bool_), errors.gyro_scale, errors.gyro_axes) ** 2
        self._turning = _TURNING**2
        self._bias = errors.gyro_bias**2 * np.eye(3)
        self._of_field = 0.0
        self._static_field = 0.0

    def predict(
        self,
        interval: float,
        steps: int,
        step: float,
        up: FloatArray,
        rate: FloatArray,
        before: dict[str, Any],
        after: dict[str, Any],
    ) -> None:
        """From one reading to the next.

        Args:
            interval: seconds.
            steps: of VQF over them.
            step: seconds of one.
            up: (3,) the vertical in the sensor's frame.
            rate: (3,) rad/s, bias subtracted.
            before: VQF's state before these.
            after: VQF's state after these.
        """
        spread = self._bias @ up * interval
        self._by_bias += 2.0 * float(up @ self._cross) * interval + float(up @ spread) * interval
        self._cross += spread
        # VQF's covariance of the bias gives its gain: P+ = (I - K H) P-; its updates reduce e, but not h
        p_before = np.reshape(before["biasP"], (3, 3)) * _UNIT_OF_BIAS**2
        p_before = p_before + steps * step * _VQF_WANDER**2 * _UNIT
        p_after = np.reshape(after["biasP"], (3, 3)) * _UNIT_OF_BIAS**2
        kept = np.linalg.solve(p_before, p_after).T
        self._cross = kept @ self._cross
        self._bias = self._bias + self._errors.gyro_wander**2 * interval * _UNIT
        self._bias = kept @ self._bias @ kept.T + p_after - kept @ p_before @ kept.T
        self._swept += up[:, None] * rate * interval
        self._noise += self._errors.gyro_noise**2 * interval
        squared = float(rate @ rate)
        fades = float(np.exp(-interval / _TURNING_S))
        self._turning = max(_TURNING**2, fades * self._turning + (1.0 - fades) * squared)
        fades = float(np.exp(-interval / _CORRECTION_S))
        correction = min(float(after["lastAccCorrAngularRate"]), 1.0)
        self._corrections = fades * self._corrections + (1.0 - fades) * correction**2
        self._missed_tilt *= float(np.exp(-2.0 * interval / _TILT_S))
        if steps > 2:
            self.lose(interval)

    def forget_bias(self) -> None:
        """Reset the covariance of the bias."""
        self._bias = self._errors.gyro_bias**2 * np.eye(3)
        self._cross = np.zeros(3)

    def lose(self, gap: float) -> None:
        """Add the variance of the interpolated rotation over a gap, seconds."""
        self.doubt(self._turning * gap**2 * min(1.0, gap / _COHERENT_S) ** 2 / 3.0)

    def doubt(self, missed: float) -> None:
        """Add the variance of a missed rotation, rad2 per axis."""
        self._missed_tilt += missed
        self._noise = min(self._noise + missed, _UNIFORM**2)

    def known_tilt(self) -> float:
        """Share of the tilt's variance that is not by missed rotation."""
        moved = self._steady + self._moved()
        return 1.0 - self._missed_tilt / moved

    def correct(
        self, gain: float, strength: float, dip: float, known: float, known_dip: float, disturbed: bool
    ) -> None:
        """Apply VQF's magnetic update of the heading; strengths in tesla, dips in radians."""
        level = max(strength * np.cos(dip), 0.05 * strength, 1e-9)
        errors = self._errors
        if known > 0.0:
            # strength and dip show two components of a disturbance; the third changes the heading
            seen = ((strength - known) ** 2 + (known * wrapped(np.array(dip - known_dip))) ** 2) / 2.0
            off = _DISTURBED_FIELD if disturbed else float(np.sqrt(seen)) / level
        else:
            off = _UNKNOWN_FIELD
        self._noise *= (1.0 - gain) ** 2
        self._by_bias *= (1.0 - gain) ** 2
        self._cross *= 1.0 - gain
        self._swept *= 1.0 - gain
        self._of_field = (1.0 - gain) * self._of_field + gain * off
        static = (errors.mag_bias**2 + (errors.mag_scale * strength) ** 2) / level**2
        # a lasting tilt error rotates the field's level part; the heading's time constant halves a passing one
        static += (self._steady + 0.25 * self._moved()) * (strength * np.sin(dip) / level) ** 2
        self._static_field = (1.0 - gain) * self._static_field + gain * float(np.sqrt(static))

    def _moved(self) -> float:
        """Passing part of the tilt's variance per axis, rad2."""
        moved = (_CORRECTED * _TILT_S) ** 2 * self._corrections + self._errors.gyro_scale**2 * self._turning
        return moved + _TILT_S**2 * float(np.trace(self._bias)) / 3.0 + self._missed_tilt

    def covariance(self) -> FloatArray:
        """(3, 3) rad2 about the earth's axes."""
        by_gyro = max(self._by_bias, 0.0) + self._noise + float((self._scales * self._swept**2).sum())
        heading = by_gyro + self._of_field**2 + self._static_field**2
        tilt = min(self._steady + self._moved(), _UNIFORM**2)
        return np.diag([tilt, tilt, min(heading, _UNIFORM**2)])
