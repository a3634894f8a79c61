"""Simulated readings of an inertial sensor on a body segment, with errors and transport.

The segment's motion is a function of time; the sensor is mounted on it over soft tissue, and reports raw or oriented
data:

- Gyroscope, accelerometer (specific force: +g upwards at rest, REP-145) and magnetometer, in the sensor's own frame:
  white noise, turn-on bias, in-run bias as a Gauss-Markov process, scale and axes, range and resolution.
- The earth's magnetic field, and iron as dipoles.
- A mounting with errors, soft tissue that sags, oscillates and follows its segment's twist only in part, slips, and
  periods in which the sensor is switched off.
- Orientation by a driver's own fusion: a complementary filter of the errors of the same raw data, to first order in the
  tilt. Acceleration tilts it, iron turns it, and without magnetometer its heading drifts.
- A clock of its own, jitter, radio packets, lost ones, outages, a transport delay.

Not modelled: the earth's rotation (0.004 deg/s), the sensor's own low-pass filter, g-sensitivity of the gyroscope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.clocks import ClockModel
from body_tracking.core.errors import one_of
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.inertial.mounting import mounting
from body_tracking.inertial.simulated_driver import Z, fuse, rotate, stated_covariance
from body_tracking.inertial.simulated_errors import CONSUMER, STANDARD_GRAVITY, ImuErrors, ImuSimulationError
from body_tracking.inertial.surroundings import Surroundings
from body_tracking.kinematics.trajectories import minimum_jerk

StampArray = NDArray[np.int64]

Motion = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""(n,) seconds to rotations (n, 3, 3), segment to world, and origins (n, 3) of the segment, metres in world."""

_MICRO = 1e-6
_STEP = 1e-4
"""Seconds h of the central differences, whose errors are h^2 (w''/6 + w x w'/3) of the angular rate, h^2 a''/12 of the
acceleration, and 1e-6 m/s2 by rounding: with 35 rad/s at 5 Hz 1e-4 rad/s, with 100 m/s2 at 5 Hz 1e-4 m/s2. A jump of
the jerk is smoothed over this time."""
_AT_ONCE = 8192
"""Instants per call of a motion: a body model takes a kilobyte for each."""
_GRID = 0.01
"""Seconds between the points of the tissue's displacement, which a cubic spline interpolates."""
_TISSUE_LIMIT = 0.012
"""Greatest displacement over soft tissue, metres; the displacement saturates towards it."""
_SLIP_S = 0.2
_MOST_JITTER = 0.2
"""Greatest jitter as a share of the sampling period, which keeps the order of samples."""
_TWIST_FADES = 0.25
"""Square of the cosine of half the swing (120 degrees) beyond which the twist, undefined at 180 degrees, fades."""


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Where a sensor sits on its segment, as intended.

    Attributes:
        position: (3,) metres in the segment's frame.
        quat_xyzw: (4,) unit quaternion, sensor to segment.
        flesh: factor on the tissue's displacement and on the twist that the skin does not follow; 0 on bare bone.
    """

    position: FloatArray
    quat_xyzw: FloatArray
    flesh: float = 1.0


# segment: position as shares of the stature (forward, outward or left, up), flesh
_PLACES: dict[str, tuple[tuple[float, float, float], float]] = {
    "pelvis": ((-0.060, 0.0, 0.020), 0.4),
    "lower_trunk": ((-0.060, 0.0, 0.070), 0.5),
    "upper_trunk": ((0.065, 0.0, 0.090), 0.3),
    "head": ((-0.055, 0.0, 0.080), 0.2),
    "clavicle": ((-0.050, 0.060, -0.010), 1.0),
    "upper_arm": ((0.0, 0.028, -0.100), 1.0),
    "forearm": ((0.0, 0.016, -0.125), 0.4),
    "hand": ((0.0, 0.012, -0.035), 0.3),
}


def usual_mounting(segment: str, stature: float = 1.75) -> Mounting:
    """The usual mounting (:mod:`~body_tracking.inertial.mounting`) of a person of a stature in metres.

    Raises:
        MountingError: no such segment.
    """
    rotation = mounting(segment).T
    place, flesh = _PLACES[segment.removesuffix("_left").removesuffix("_right")]
    mirror = np.array([1.0, -1.0 if segment.endswith("_right") else 1.0, 1.0])
    return Mounting(stature * mirror * place, so3.matrix_to_quat(rotation), flesh)


@dataclass(frozen=True, slots=True, eq=False)
class Slip:
    """A slip of the strap, within 0.2 s.

    Attributes:
        at: seconds, its beginning.
        turn: (3,) rotation vector of the sensor in the segment's frame, radians.
    """

    at: float
    turn: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ImuTruth:
    """The true state at each sample.

    Attributes:
        times: (n,) seconds after the start.
        quat_xyzw: (n, 4) sensor to world, with mounting, tissue and slips.
        positions: (n, 3) metres, the sensor in world.
        mounting_xyzw: (4,) sensor to segment: the true mounting, without tissue and slips.
        gyro_bias: (n, 3) rad/s, turn-on and in-run.
    """

    times: FloatArray
    quat_xyzw: FloatArray
    positions: FloatArray
    mounting_xyzw: FloatArray
    gyro_bias: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """The n received samples of one sensor, in order: the fields of ``sensor_msgs/Imu`` by REP-145.

    Attributes:
        name: of the sensor.
        stamps_ns: (n,) in its own clock.
        received_ns: (n,) in the receiver's clock.
        angular_velocity: (n, 3) rad/s in the sensor's frame.
        linear_acceleration: (n, 3) m/s2, specific force in the sensor's frame.
        magnetic_field: (n, 3) tesla in the sensor's frame, or None without magnetometer.
        orientation: (n, 4) quaternions xyzw, sensor to (magnetic) east-north-up, or without magnetometer to a level
            frame with another heading after each switching on; None for raw data.
        orientation_covariance: (n, 3, 3) rad2 about the axes of that frame; without magnetometer, of the heading's
            drift since the sensor was switched on. For raw data -1 in [0, 0], and 0 elsewhere.
        angular_velocity_covariance: (3, 3) rad2/s2.
        linear_acceleration_covariance: (3, 3) m2/s4.
        magnetic_field_covariance: (3, 3) T2.
        truth: the true states.
    """

    name: str
    stamps_ns: StampArray
    received_ns: StampArray
    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    magnetic_field: FloatArray | None
    orientation: FloatArray | None
    orientation_covariance: FloatArray
    angular_velocity_covariance: FloatArray
    linear_acceleration_covariance: FloatArray
    magnetic_field_covariance: FloatArray
    truth: ImuTruth


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedImu:
    """An inertial sensor on a segment, with its clock and its errors.

    Attributes:
        name: of the sensor.
        segment: of ``UpperBody.segment_names``, its true place.
        mounting: intended mounting there.
        rate_hz: samples per second of its own clock, usually 50 to 200.
        oriented: the driver reports orientation; otherwise only raw data.
        magnetometer: the sensor has one, and the driver uses it.
        clock: its clock against the reference clock.
        phase: seconds of its first sample after the start.
        errors: of the sensor.
        slips: of its strap.
        off: (begin, end) seconds in which it is switched off; it restarts with other biases and another heading.

    Raises:
        ImuSimulationError: a rate out of range, or no such segment.
    """

    name: str
    segment: str
    mounting: Mounting
    rate_hz: float = 100.0
    oriented: bool = False
    magnetometer: bool = True
    clock: ClockModel = field(default_factory=ClockModel)
    phase: float = 0.0
    errors: ImuErrors = CONSUMER
    slips: tuple[Slip, ...] = ()
    off: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if self.segment not in SEGMENTS:
            raise ImuSimulationError(f"{self.name}: segment {self.segment!r}, {one_of(self.segment, SEGMENTS)}")
        if not 1.0 <= self.rate_hz <= 1000.0:
            raise ImuSimulationError(f"{self.name}: a rate of {self.rate_hz} Hz, expected 1 to 1000")

    def capture_times(self, duration: float, rng: np.random.Generator) -> FloatArray:
        """(n,) seconds of its samples: its rate by its own clock, with jitter, while it is switched on."""
        period = 1.0 / (self.rate_hz * (1.0 + self.clock.drift_ppm * 1e-6))
        times = np.arange(self.phase, duration, period)
        times = times + _jitter(self.errors.jitter, period, len(times), rng)
        times = times[
            (times >= 2.0 * _STEP) & (times <= duration - 2.0 * _STEP)
        ]  # the differences need the motion before and after
        for begin, end in self.off:
            times = times[(times < begin) | (times >= end)]
        return times

    def samples(
        self,
        motion: Motion,
        duration: float,
        start_ns: int,
        rng: np.random.Generator,
        *,
        parent: Motion | None = None,
        surroundings: Surroundings | None = None,
        received_from_ns: int | None = None,
    ) -> ImuSamples:
        """The received samples.

        Args:
            motion: of the segment, for times from 0 to the duration; twice continuously differentiable.
            duration: seconds.
            start_ns: time 0 in the reference clock.
            rng: for all random numbers.
            parent: motion of the segment's parent, for the twist about the segment's z axis; without it the skin
                follows every twist.
            surroundings: the magnetic field.
            received_from_ns: time 0 in the receiver's clock; None for the reference clock.
        """
        where = Surroundings() if surroundings is None else surroundings
        errors = self.errors
        off_axis = so3.exp(np.radians(errors.misalignment) * rng.normal(size=3))
        mounting_xyzw = so3.quat_multiply(off_axis, self.mounting.quat_xyzw)
        times = self.capture_times(duration, rng)
        sensor = self._sensor_motion(motion, parent, duration, mounting_xyzw)
        rotations, positions, rates, accelerations = _kinematics(sensor, times)

        to_sensor = rotations.swapaxes(-1, -2)
        forces = rotate(to_sensor, accelerations + STANDARD_GRAVITY * Z)
        magnetic = rotate(to_sensor, where.field(positions, times))
        session = np.searchsorted(np.sort([end for _, end in self.off]), times, side="right").astype(np.intp)
        of_gyro = _Channel.of(errors, "gyro", np.pi / 180.0)
        of_acc, of_mag = _Channel.of(errors, "acc", 1.0), _Channel.of(errors, "mag", _MICRO)
        gyro, turn_on, in_run = self._measure(rates, of_gyro, session, rng)
        acc, _, _ = self._measure(forces, of_acc, session, rng)
        mag, _, _ = self._measure(magnetic, of_mag, np.zeros_like(session), rng)  # hard iron persists over sessions

        # turn-on bias after the driver's own estimate
        left = np.radians(errors.driver_bias) * rng.normal(size=(len(self.off) + 1, 3))
        headings = rng.uniform(-np.pi, np.pi, len(self.off) + 1)
        orientation, covariance = None, np.zeros((len(times), 3, 3))
        covariance[:, 0, 0] = -1.0
        quats = so3.matrix_to_quat(rotations)
        if self.oriented:
            drift = rotate(rotations, gyro - rates - turn_on + left[session])
            orientation = np.empty((len(times), 4))
            for number in np.unique(session):
                these = session == number
                error = fuse(
                    errors,
                    self.rate_hz,
                    times[these],
                    drift[these],
                    rotate(rotations[these], acc[these]),
                    rotate(rotations[these], mag[these]) if self.magnetometer else None,
                    where,
                    headings[number],
                )
                orientation[these] = so3.quat_multiply(error, quats[these])
                covariance[these] = stated_covariance(
                    errors, self.magnetometer, times[these], rotations[these], gyro[these]
                )

        stamps, received, arrived = self._transmit(times, session, start_ns, received_from_ns, rng)
        truth = ImuTruth(times[arrived], quats[arrived], positions[arrived], mounting_xyzw, (turn_on + in_run)[arrived])
        return ImuSamples(
            self.name,
            stamps[arrived],
            received[arrived],
            gyro[arrived],
            acc[arrived],
            mag[arrived] if self.magnetometer else None,
            None if orientation is None else orientation[arrived],
            covariance[arrived],
            of_gyro.density * self.rate_hz * np.eye(3),
            of_acc.density * self.rate_hz * np.eye(3),
            of_mag.density * self.rate_hz * np.eye(3),
            truth,
        )

    def _sensor_motion(
        self, motion: Motion, parent: Motion | None, duration: float, mounting_xyzw: FloatArray
    ) -> Motion:
        """The motion of the sensor from that of the bone under it."""
        place, errors = self.mounting.position, self.errors
        mounted = so3.quat_to_matrix(mounting_xyzw)
        flesh = errors.tissue_sag * self.mounting.flesh
        bone = _in_parts(motion)
        beneath = None if parent is None else _in_parts(parent)
        slid = None if flesh == 0.0 else self._tissue(bone, duration, flesh)
        share = errors.twist_share * self.mounting.flesh
        # the skin lies across the line from the segment's axis to the sensor
        outward = place * [1.0, 1.0, 0.0]
        outward = outward / max(float(np.linalg.norm(outward)), 1e-9)

        def of_sensor(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            rotations, origins = bone(times)
            turned, local = np.tile(mounted, (len(times), 1, 1)), np.tile(place, (len(times), 1))
            for slip in self.slips:
                turn = minimum_jerk((times - slip.at) / _SLIP_S)[:, None] * slip.turn
                turned = so3.quat_to_matrix(so3.exp(turn)) @ turned
            if slid is not None:
                way = slid(times)
                turned = so3.quat_to_matrix(so3.exp(errors.tissue_turn * np.cross(outward, way))) @ turned
                local = local + way
            if beneath is not None and share > 0.0:
                between = beneath(times)[0].swapaxes(-1, -2) @ rotations
                back = so3.quat_to_matrix(so3.exp(-share * _twist(between)[:, None] * Z))
                turned, local = back @ turned, rotate(back, local)
            return rotations @ turned, origins + rotate(rotations, local)

        return of_sensor

    def _tissue(self, motion: Motion, duration: float, sag: float) -> Callable[[FloatArray], FloatArray]:
        """Times to (n, 3) metres of the sensor's displacement in the segment's frame, a damped oscillation.

        ``x'' + 2 zeta w x' + w^2 x = -w^2 sag f / g`` with the specific force f of the place, saturated.
        """
        grid = np.linspace(_STEP, duration - _STEP, max(round(duration / _GRID), 4))

        def at(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            rotations, origins = motion(times)
            return rotations, origins + rotations @ self.mounting.position

        rotations, _, _, accelerations = _kinematics(at, grid)
        force = rotate(rotations.swapaxes(-1, -2), accelerations + STANDARD_GRAVITY * Z)
        w = 2.0 * np.pi * self.errors.tissue_frequency
        system = ([w**2], [1.0, 2.0 * self.errors.tissue_damping * w, w**2])
        numerator, denominator, _ = cont2discrete(system, grid[1] - grid[0], method="foh")
        settled = lfilter_zi(numerator[0], denominator)[:, None] * force[0]
        way, _ = lfilter(numerator[0], denominator, force, axis=0, zi=settled)
        free = CubicSpline(grid, -sag / STANDARD_GRAVITY * way)

        def slid(times: FloatArray) -> FloatArray:
            way = free(times)
            result: FloatArray = way / np.sqrt(1.0 + (way**2).sum(axis=1, keepdims=True) / _TISSUE_LIMIT**2)
            return result

        return slid

    def _measure(
        self, true: FloatArray, channel: _Channel, session: IntArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Measured values of true (n, 3) in the sensor's frame; turn-on and in-run bias, (n, 3) each."""
        n = len(true)
        sensitivity = np.where(np.eye(3, dtype=np.bool_), channel.scale, channel.axes) * rng.normal(size=(3, 3))
        turn_on = channel.bias * rng.normal(size=(len(self.off) + 1, 3))[session]
        in_run = channel.instability * _gauss_markov(n, self.rate_hz * self.errors.instability_time, rng)
        white = np.sqrt(channel.density * self.rate_hz) * rng.normal(size=(n, 3))
        measured = true + true @ sensitivity.T + turn_on + in_run + white
        if np.isfinite(channel.range):
            step = channel.range / 2.0**15
            measured = step * np.clip(np.round(measured / step), -(2.0**15), 2.0**15 - 1.0)
        return measured, turn_on, in_run

    def _transmit(
        self,
        times: FloatArray,
        session: IntArray,
        start_ns: int,
        received_from_ns: int | None,
        rng: np.random.Generator,
    ) -> tuple[StampArray, StampArray, BoolArray]:
        """(n,) stamps in the sensor's clock, (n,) in the receiver's, and whether the samples arrive."""
        errors, n = self.errors, len(times)
        stamped = times + _jitter(errors.stamp_jitter, 1.0 / self.rate_hz, n, rng)
        stamps = [self.clock.to_sensor(start_ns + round(time * NANOSECONDS)) for time in stamped.tolist()]
        # a packet has samples of one session only
        first = np.searchsorted(session, session)
        _, packet = np.unique(np.stack([session, (np.arange(n) - first) // errors.packet]), axis=1, return_inverse=True)
        packet = packet.reshape(-1)
        count = int(packet.max(initial=-1)) + 1
        full = np.zeros(count)
        np.maximum.at(full, packet, times)
        lost = rng.random(count) < errors.lost
        span = float(np.ptp(times)) if n else 0.0
        for begin in times[:1] + span * rng.random(rng.poisson(errors.outages * span / 60.0)):
            lost |= (full >= begin) & (full < begin + rng.exponential(errors.outage_time))
        arrival = full + errors.delay + errors.delay_jitter * rng.gamma(1.0, size=count)
        # a connection keeps the order: a delayed packet delays the following ones
        arrival = np.maximum.accumulate(arrival)[packet]
        base = start_ns if received_from_ns is None else received_from_ns
        received = base + np.round(arrival * NANOSECONDS).astype(np.int64)
        return np.array(stamps, dtype=np.int64), received, ~lost[packet]


class _Channel(NamedTuple):
    """The errors of one of the three sensors, in SI units; ``density`` is the square of the noise density."""

    density: float
    bias: float
    instability: float
    scale: float
    axes: float
    range: float

    @classmethod
    def of(cls, errors: ImuErrors, name: str, unit: float) -> _Channel:
        """The channel ``gyro``, ``acc`` or ``mag``, whose errors have this unit in SI."""
        noise, bias, in_run, most = (
            unit * getattr(errors, f"{name}_{kind}", 0.0) for kind in ("noise", "bias", "instability", "range")
        )
        scale = getattr(errors, f"{name}_scale")
        return cls(noise**2, bias, in_run, scale, getattr(errors, f"{name}_axes", scale), most)


def _in_parts(motion: Motion) -> Motion:
    """The motion, evaluated in parts of bounded size."""

    def parts(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        answers = [motion(part) for part in np.array_split(times, max(-(-len(times) // _AT_ONCE), 1))]
        return np.concatenate([each[0] for each in answers]), np.concatenate([each[1] for each in answers])

    return parts


def _kinematics(motion: Motion, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rotations (n, 3, 3), positions (n, 3), angular rates in the own frame (n, 3) and accelerations in world (n, 3),
    by central differences of the motion.
    """
    n = len(times)
    rotations, positions = motion(np.concatenate([times - _STEP, times, times + _STEP]))
    before, after = so3.matrix_to_quat(rotations[:n]), so3.matrix_to_quat(rotations[2 * n :])
    rates = so3.log(so3.quat_multiply(so3.quat_inverse(before), after)) / (2.0 * _STEP)
    accelerations = (positions[2 * n :] - 2.0 * positions[n : 2 * n] + positions[:n]) / _STEP**2
    return rotations[n : 2 * n], positions[n : 2 * n], rates, accelerations


def _twist(rotations: FloatArray) -> FloatArray:
    """(n,) radians: twist of (n, 3, 3) rotations about z (swing-twist), faded near a swing of 180 degrees."""
    quats = so3.matrix_to_quat(rotations)
    z, w = quats[:, 2], quats[:, 3]
    result: FloatArray = 2.0 * np.arctan2(z, w) * minimum_jerk((z**2 + w**2) / _TWIST_FADES)
    return result


def _jitter(stddev: float, period: float, n: int, rng: np.random.Generator) -> FloatArray:
    return np.clip(stddev * rng.normal(size=n), -_MOST_JITTER * period, _MOST_JITTER * period)


def _gauss_markov(n: int, correlated: float, rng: np.random.Generator) -> FloatArray:
    """(n, 3) stationary Gauss-Markov process of unit variance; ``correlated`` is its time constant in samples."""
    keep = np.exp(-1.0 / correlated)
    drive = rng.normal(size=(n, 3))
    drive[1:] *= np.sqrt(1.0 - keep**2)
    result: FloatArray = lfilter([1.0], [1.0, -keep], drive, axis=0)
    return result
