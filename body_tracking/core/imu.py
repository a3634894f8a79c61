"""One reading of an inertial sensor, and what is plainly wrong with one, or with many in a row.

As REP-145 has it: angular rate and specific force (+9.8 m/s2 upwards at rest) in the sensor's own frame, SI units,
orientation of the sensor in an earth frame with z up. What a driver gets wrong in one reading raises
:class:`ImuSampleError`; what only many readings tell, such as an acceleration without gravity, :class:`ImuWatch` says.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray

STANDARD_GRAVITY: Final = 9.80665
"""m/s2."""

MAX_RATE: Final = 75.0
"""rad/s, 4300 deg/s: beyond the range of every gyroscope that is worn."""
MAX_ACCELERATION: Final = 4000.0
"""m/s2, 400 g: beyond the range of every accelerometer that is worn."""
MAX_FIELD: Final = 1e-3
"""Tesla: ten times what a strong magnet close by adds to the earth's 25e-6 to 65e-6."""

_NORM_TOLERANCE: Final = 0.01
"""Of a quaternion; float32 on the way costs 1e-7, four digits of a text file 1e-4."""
_ASYMMETRY: Final = 1e-6
"""Of a covariance, as a share of its greatest element."""


class ImuSampleError(BodyTrackingError):
    """A reading that no inertial sensor can have made, or in other units than REP-145 says."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """What an inertial sensor said at one instant; None for what it did not say.

    A quaternion that is slightly off unit length is normalised, its length beyond 1 % off is an error.

    Attributes:
        stamp_ns: nanoseconds of the sensor's own clock.
        frame_id: the sensor's frame.
        orientation: (4,) unit quaternion xyzw, sensor to earth; the earth's z points up.
        orientation_covariance: (3, 3) rad2 about the axes of the earth frame; None where unknown.
        angular_velocity: (3,) rad/s in the sensor's frame.
        acceleration: (3,) m/s2, specific force in the sensor's frame.
        magnetic_field: (3,) tesla in the sensor's frame.

    Raises:
        ImuSampleError: a number that is not finite, a zero quaternion or one that is not normalised, a covariance that
            is none, rates, accelerations or fields beyond what can be measured (other units), no frame.
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
    """Whether (3,) can be a field in tesla.

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
"""Bounds of the median specific force of seconds: a body that falls half the time, and twice that of forearms that
punch without a rest; the nearest wrong unit makes it 9.81 times too much."""
_IN_G: Final = 0.15
"""How near to 1 g a median is, and how little half of the readings spread, that are in units of g."""
_CALM: Final = 3.0
"""m/s2 about gravity: nothing that turns as fast as :data:`_SPIN` is as calm 4 cm from its axis."""
_SPIN: Final = 9.0
"""rad/s, median of seconds; fast arm movements have more only for tenths of seconds."""

GRAVITY_MISSING: Final = "gravity is missing from the acceleration"
IN_G: Final = "the acceleration is in units of g, not m/s2"
WRONG_FORCE: Final = "the acceleration is not in m/s2"
IN_DEGREES: Final = "the angular velocity is in deg/s, not rad/s"
FRAME_CHANGED: Final = "readings of two frames come as one sensor's"


class ImuWatch:
    """Finds in the readings of one sensor what no single reading tells.

    Medians over 3 s, looked at twice a second: the size of the specific force tells whether gravity is in it and in
    which unit, fast turning without any acceleration tells degrees. Time that runs backwards begins anew.
    """

    def __init__(self) -> None:
        self._readings: deque[tuple[int, float, float]] = deque()
        self._frame: str | None = None
        self._due_ns = 0
        self._latest_ns: int | None = None
        self._said: dict[str, str] = {}

    @property
    def problems(self) -> tuple[str, ...]:
        """Everything that was found so far."""
        return tuple(self._said.values())

    def add(self, sample: ImuSample) -> tuple[str, ...]:
        """Look at the next reading.

        Returns:
            A line for each problem that has not been said before; one of a kind.
        """
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
            found |= self._look()
        new = {kind: text for kind, text in found.items() if kind not in self._said}
        self._said |= new
        return tuple(new.values())

    def _look(self) -> dict[str, str]:
        """What the window tells, by kind."""
        span = self._readings[-1][0] - self._readings[0][0]
        if len(self._readings) < _LEAST_SAMPLES or span < 0.5 * _WINDOW_S * NANOSECONDS:
            return {}
        _, forces, rates = np.array(self._readings).T
        found: dict[str, str] = {}
        known: BoolArray = np.isfinite(forces)
        if not known.all():
            return found
        low, median, high = np.percentile(forces, [25.0, 50.0, 75.0])
        says = f"its median is {median:.3g}, expected {STANDARD_GRAVITY:.2f} m/s2"
        if abs(median - 1.0) < _IN_G and high - low < _IN_G:
            found[IN_G] = f"{IN_G}: {says}"
        elif median < _LEAST_FORCE:
            found[GRAVITY_MISSING] = f"{GRAVITY_MISSING}: {says}"
        elif median > _MOST_FORCE:
            found[WRONG_FORCE] = f"{WRONG_FORCE}: {says}"
        # calm in whichever unit it is
        calm = high - low < _CALM * median / STANDARD_GRAVITY
        if calm and np.isfinite(rates).all() and np.median(rates) > _SPIN:
            found[IN_DEGREES] = f"{IN_DEGREES}: its median is {np.median(rates):.3g} while the acceleration is calm"
        return found


def _size(vector: FloatArray | None) -> float:
    return float("nan") if vector is None else float(np.sqrt(vector @ vector))


# --- recordings


@dataclass(frozen=True, slots=True, eq=False)
class RecordedImu:
    """What one inertial sensor said, in a recording.

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
    """Joint angles that a recording holds beside its sensors, as its own program computed them.

    Attributes:
        received_ns: of the receiver's clock; their stamp, too.
        names: n names, as in the file.
        angles: (n,) radians.
    """

    received_ns: int
    names: tuple[str, ...]
    angles: FloatArray


class ImuRecording(Protocol):
    """A file of inertial readings; its readers count what they meet while they are iterated.

    Attributes:
        problems: how often each kind of oddity was met.
        warnings: a line for each thing that is missing.
    """

    problems: dict[str, int]
    warnings: list[str]

    def __iter__(self) -> Iterator[RecordedImu | RecordedAngles]:
        """The readings, in the order of the file."""

    @property
    def progress(self) -> float:
        """How much of the file has been read, 0 to 1."""


def imu_frame(sensor: str) -> str:
    """The frame of an inertial sensor."""
    return f"{sensor}_link"
