"""Readings of an inertial sensor, and checks of single readings and of series.

Conventions of REP-145: angular rate and specific force (+9.8 m/s2 upwards at rest) in the sensor's own frame, SI units,
orientation of the sensor in an earth frame with z up. An invalid reading raises :class:`ImuSampleError`;
:class:`ImuWatch` reports errors that show only over many readings, such as an acceleration without gravity.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS, FloatArray

STANDARD_GRAVITY: Final = 9.80665
"""m/s2."""

MAX_RATE: Final = 75.0
"""rad/s, 4300 deg/s: beyond the range of every gyroscope that is worn."""
MAX_ACCELERATION: Final = 4000.0
"""m/s2, 400 g: beyond the range of every accelerometer that is worn."""
MAX_FIELD: Final = 1e-3
"""Tesla: ten times the field of a strong magnet nearby; the earth's is 25e-6 to 65e-6."""

_NORM_TOLERANCE: Final = 0.01
"""Of a quaternion's norm; float32 costs 1e-7, a text file with four digits 1e-4."""
_ASYMMETRY: Final = 1e-6
"""Of a covariance, relative to its greatest element."""


class ImuSampleError(BodyTrackingError):
    """A reading that no inertial sensor can have made, or in other units than REP-145's."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One reading of an inertial sensor; None for quantities that it does not measure.

    A quaternion is normalised; a norm that is off by more than 1 % is an error.

    Attributes:
        stamp_ns: nanoseconds of the sensor's own clock.
        frame_id: the sensor's frame.
        orientation: (4,) unit quaternion xyzw, sensor to earth; the earth's z points up.
        orientation_covariance: (3, 3) rad2 about the axes of the earth frame; None where unknown.
        angular_velocity: (3,) rad/s in the sensor's frame.
        acceleration: (3,) m/s2, specific force in the sensor's frame.
        magnetic_field: (3,) tesla in the sensor's frame.

    Raises:
        ImuSampleError: a number that is not finite, a zero quaternion or one that is not normalised, an invalid
            covariance, rates, accelerations or fields beyond the range of sensors (other units), no frame.
    """

    stamp_ns: int
    frame_id: str
    orientation: FloatArray | None = None
    orientation_covariance: FloatArray | None = None
    angular_velocity: FloatArray | None = None
    acceleration: FloatArray | None = None
    magnetic_field: FloatArray | None = None

    def __post_init__(self) -> None:
        if not self.frame_id:
            raise ImuSampleError("no frame_id: of which sensor?")
        if self.orientation is not None:
            object.__setattr__(self, "orientation", _unit_quaternion(self.orientation))
        if self.orientation_covariance is not None:
            _check_covariance(self.orientation_covariance)
        if self.angular_velocity is not None:
            _check_vector(self.angular_velocity, "angular velocity", "rad/s", MAX_RATE, "deg/s?")
        if self.acceleration is not None:
            _check_vector(self.acceleration, "acceleration", "m/s2", MAX_ACCELERATION, "mg?")
        if self.magnetic_field is not None:
            check_magnetic_field(self.magnetic_field)


def check_magnetic_field(field: FloatArray) -> None:
    """Check a field (3,) in tesla.

    Raises:
        ImuSampleError: not finite, or beyond 1e-3 T.
    """
    _check_vector(field, "magnetic field", "T", MAX_FIELD, "microtesla or gauss?")


def _check_vector(vector: FloatArray, name: str, unit: str, greatest: float, instead: str) -> None:
    if vector.shape != (3,):
        raise ImuSampleError(f"{name} of shape {vector.shape}, expected (3,)")
    size = float(np.sqrt(vector @ vector))
    if not np.isfinite(size):
        raise ImuSampleError(f"{name} {_listed(vector)}: not finite")
    if size > greatest:
        raise ImuSampleError(f"{name} of {size:.3g} {unit}, beyond {greatest:g}: {instead}")


def _unit_quaternion(quat_xyzw: FloatArray) -> FloatArray:
    if quat_xyzw.shape != (4,):
        raise ImuSampleError(f"orientation of shape {quat_xyzw.shape}, expected (4,)")
    norm = float(np.sqrt(quat_xyzw @ quat_xyzw))
    if not np.isfinite(norm):
        raise ImuSampleError(f"orientation {_listed(quat_xyzw)}: not finite")
    if norm == 0.0:
        raise ImuSampleError("orientation is the zero quaternion (none known: orientation_covariance[0] = -1, REP-145)")
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise ImuSampleError(f"orientation {_listed(quat_xyzw)} is not normalised: its norm is {norm:.4g}")
    unit: FloatArray = quat_xyzw / norm
    return unit


def _check_covariance(covariance: FloatArray) -> None:
    if covariance.shape != (3, 3):
        raise ImuSampleError(f"orientation covariance of shape {covariance.shape}, expected (3, 3)")
    if not np.isfinite(covariance).all():
        raise ImuSampleError("orientation covariance: not finite")
    if (covariance.diagonal() < 0.0).any():
        raise ImuSampleError(f"orientation covariance: a variance of {covariance.diagonal().min():.3g}")
    if abs(covariance - covariance.T).max() > _ASYMMETRY * abs(covariance).max():
        raise ImuSampleError("orientation covariance: not symmetric")


def _listed(values: FloatArray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


# --- over time

_WINDOW_S: Final = 3.0
_EVERY_S: Final = 0.5
_LEAST_SAMPLES: Final = 30
_LEAST_FORCE, _MOST_FORCE = 0.6 * STANDARD_GRAVITY, 5.0 * STANDARD_GRAVITY
"""Bounds of the median specific force over the window: that of a body that falls half the time, and twice that of
forearms punching without rest; the nearest wrong unit is off by a factor of 9.81."""
_IN_G: Final = 0.15
"""Readings in units of g: largest deviation of their median from 1, and largest interquartile range."""
_CALM: Final = 3.0
"""m/s2, interquartile range; a sensor that turns at :data:`_SPIN` 4 cm from the axis has a larger one."""
_SPIN: Final = 9.0
"""rad/s, median over the window; fast arm movements exceed it only for tenths of seconds."""

GRAVITY_MISSING: Final = "gravity is missing from the acceleration"
IN_G: Final = "the acceleration is in units of g, not m/s2"
WRONG_FORCE: Final = "the acceleration is not in m/s2"
IN_DEGREES: Final = "the angular velocity is in deg/s, not rad/s"
FRAME_CHANGED: Final = "readings of two frames come as one sensor's"


class ImuWatch:
    """Detects errors of a driver that show only over many readings of a sensor.

    Every 0.5 s, medians over 3 s: the norm of the specific force shows a missing gravity or a wrong unit, fast turning
    without acceleration shows deg/s. A backward jump of time clears the window.
    """

    def __init__(self) -> None:
        self._readings: deque[tuple[int, float, float]] = deque()
        self._frame: str | None = None
        self._due_ns = 0
        self._latest_ns: int | None = None
        self._reported: dict[str, str] = {}

    @property
    def problems(self) -> tuple[str, ...]:
        """All problems that were found so far."""
        return tuple(self._reported.values())

    def add(self, sample: ImuSample) -> tuple[str, ...]:
        """Check the next reading; returns a line for each kind of problem that is found for the first time."""
        if self._latest_ns is None or sample.stamp_ns < self._latest_ns:
            self._readings.clear()
            self._due_ns = sample.stamp_ns
        self._latest_ns = sample.stamp_ns
        found: dict[str, str] = {}
        if self._frame is not None and sample.frame_id != self._frame:
            found[FRAME_CHANGED] = f"{FRAME_CHANGED}: {self._frame!r} and {sample.frame_id!r}"
        self._frame = sample.frame_id
        self._readings.append((sample.stamp_ns, _size(sample.acceleration), _size(sample.angular_velocity)))
        while self._readings[0][0] < sample.stamp_ns - _WINDOW_S * NANOSECONDS:
            self._readings.popleft()
        if sample.stamp_ns >= self._due_ns:
            self._due_ns = sample.stamp_ns + round(_EVERY_S * NANOSECONDS)
            found |= self._check_window()
        new = {kind: text for kind, text in found.items() if kind not in self._reported}
        self._reported |= new
        return tuple(new.values())

    def _check_window(self) -> dict[str, str]:
        """A line for each kind of problem in the window."""
        span = self._readings[-1][0] - self._readings[0][0]
        if len(self._readings) < _LEAST_SAMPLES or span < 0.5 * _WINDOW_S * NANOSECONDS:
            return {}
        _, forces, rates = np.array(self._readings).T
        if not np.isfinite(forces).all():
            return {}
        found: dict[str, str] = {}
        low, median, high = np.percentile(forces, [25.0, 50.0, 75.0])
        kind = ""
        if abs(median - 1.0) < _IN_G and high - low < _IN_G:
            kind = IN_G
        elif median < _LEAST_FORCE:
            kind = GRAVITY_MISSING
        elif median > _MOST_FORCE:
            kind = WRONG_FORCE
        if kind:
            found[kind] = f"{kind}: its median is {median:.3g}, expected {STANDARD_GRAVITY:.2f} m/s2"
        calm = high - low < _CALM * median / STANDARD_GRAVITY  # relative to the median, which may be in another unit
        if calm and np.isfinite(rates).all() and np.median(rates) > _SPIN:
            found[IN_DEGREES] = f"{IN_DEGREES}: its median is {np.median(rates):.3g} while the acceleration is calm"
        return found


def _size(vector: FloatArray | None) -> float:
    return float("nan") if vector is None else float(np.sqrt(vector @ vector))


# --- recordings


@dataclass(frozen=True, slots=True, eq=False)
class RecordedImu:
    """One reading of an inertial sensor in a recording.

    Attributes:
        sensor: its name.
        received_ns: when it was received, by the receiver's clock.
        sample: the reading.
    """

    sensor: str
    received_ns: int
    sample: ImuSample


@dataclass(frozen=True, slots=True, eq=False)
class RecordedAngles:
    """Joint angles in a recording, computed by the program that made it.

    Attributes:
        received_ns: by the receiver's clock; also their stamp.
        names: n names, as in the file.
        angles: (n,) radians.
    """

    received_ns: int
    names: tuple[str, ...]
    angles: FloatArray


def imu_frame(sensor: str) -> str:
    """The frame of an inertial sensor."""
    return f"{sensor}_link"
