"""Orientation from raw data: exact without errors, and with errors within its stated covariance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from body_tracking.core import so3
from body_tracking.core.imu import ImuSample
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.imu_csv import ImuCsvRecording
from body_tracking.inertial.imu_orientation import (
    ImuOrientation,
    ImuOrientationError,
    InertialErrors,
    OrientationEstimator,
)
from body_tracking.inertial.simulated import ImuSamples, Mounting, SimulatedImu
from body_tracking.inertial.simulated_errors import CONSUMER, ImuErrors
from body_tracking.inertial.surroundings import Iron, Surroundings
from draws import draws, some
from ideal_sensors import IDEAL

START_NS = 1_700_000_000 * NANOSECONDS
STILL_RADIO = {"lost": 0.0, "outages": 0.0}


def pivot(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Three axes turn by up to 57, 40 and 29 degrees at 0.3 to 0.8 Hz, about the sensor."""
    angles = np.stack([np.sin(5.0 * times), 0.7 * np.sin(3.1 * times), 0.5 * np.sin(2.0 * times)], axis=1)
    first, second, third = (so3.exp(angles[:, [k]] * np.eye(3)[k]) for k in range(3))
    quats = so3.quat_multiply(third, so3.quat_multiply(second, first))
    return so3.quat_to_matrix(quats), np.ones((len(times), 3))


def swing(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As :func:`pivot`, while the sensor goes to and fro by 10 cm, with up to 3 m/s2."""
    way = 0.1 * np.stack([np.sin(4.0 * times), np.sin(3.0 * times), np.sin(2.5 * times)], axis=1)
    return pivot(times)[0], 1.0 + way


def still(times: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.tile(so3.quat_to_matrix(so3.exp(np.array([0.4, 0.2, 0.1]))), (len(times), 1, 1)), np.ones((len(times), 3))


def measured(
    errors: ImuErrors = IDEAL,
    seconds: float = 20.0,
    seed: int = 0,
    *,
    rate_hz: float = 100.0,
    motion: object = swing,
    off: tuple[tuple[float, float], ...] = (),
    iron: tuple[Iron, ...] = (),
) -> ImuSamples:
    mounting = Mounting(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    imu = SimulatedImu("imu", "forearm_left", mounting, rate_hz, errors=errors, off=off)
    rng = np.random.default_rng(seed)
    return imu.samples(motion, seconds, START_NS, rng, surroundings=Surroundings(iron=iron))  # type: ignore[arg-type]


def sample(samples: ImuSamples, k: int, magnetic: bool = False) -> ImuSample:
    field = samples.magnetic_field[k] if magnetic and samples.magnetic_field is not None else None
    return ImuSample(
        int(samples.stamps_ns[k]),
        "imu_link",
        angular_velocity=samples.angular_velocity[k],
        acceleration=samples.linear_acceleration[k],
        magnetic_field=field,
    )


class Run:
    """An estimator's errors over samples, in degrees about the earth's axes.

    Tilt (n, 2), heading (n,), without magnetometer relative to its first error, and their standard deviations.
    """

    def __init__(self, samples: ImuSamples, magnetic: bool = False, errors: InertialErrors | None = None) -> None:
        self.estimator = OrientationEstimator(errors=errors)
        found: list[tuple[int, ImuOrientation]] = []
        self.disturbed: list[bool | None] = []
        for k in range(len(samples.stamps_ns)):
            orientation = self.estimator.update(sample(samples, k, magnetic))
            if orientation is not None:
                found.append((k, orientation))
                self.disturbed.append(self.estimator.magnetically_disturbed)
        self.which = np.array([k for k, _ in found])
        self.found = [orientation for _, orientation in found]
        self.times = samples.truth.times[self.which]
        quats = np.array([orientation.orientation for orientation in self.found])
        error = so3.quat_multiply(quats, so3.quat_inverse(samples.truth.quat_xyzw[self.which]))
        heading = 2.0 * np.arctan2(error[:, 2], error[:, 3])
        turn = so3.exp(heading[:, None] * np.array([0.0, 0.0, 1.0]))
        self.tilt = np.degrees(so3.log(so3.quat_multiply(so3.quat_inverse(turn), error))[:, :2])
        if not magnetic:
            heading = heading - heading[0]
        self.heading = np.degrees(np.angle(np.exp(1j * heading)))
        variances = np.array([orientation.covariance.diagonal() for orientation in self.found])
        stddev = np.degrees(np.sqrt(variances))
        self.tilt_stddev, self.heading_stddev = stddev[:, :2], stddev[:, 2]


@pytest.mark.parametrize(
    ("errors", "rate_hz", "seconds", "degrees"),
    [
        (IDEAL, 25.0, 6.0, 2.0),
        (IDEAL, 100.0, 6.0, 0.2),
        pytest.param(IDEAL, 400.0, 6.0, 0.1, marks=pytest.mark.slow),
        (replace(IDEAL, jitter=0.001, stamp_jitter=0.002, lost=0.1, packet=2), 100.0, 20.0, 2.0),
    ],
)
def test_without_errors_it_follows_and_jitter_and_losses_add_nothing_up(
    errors: ImuErrors, rate_hz: float, seconds: float, degrees: float
) -> None:
    run = Run(measured(errors, seconds, rate_hz=rate_hz, motion=pivot))
    settled = run.times > 4.0
    assert np.abs(run.tilt[settled]).max() < degrees
    heading = run.heading[settled]
    assert np.abs(heading - (heading[0] if errors is IDEAL else heading.mean())).max() < degrees
    assert run.estimator.restarts == 0
    assert run.estimator.magnetically_disturbed is None
    if errors is IDEAL:
        assert run.estimator.rate_hz == pytest.approx(rate_hz, rel=0.01)


def test_at_rest_the_bias_is_found_and_taken_off() -> None:
    samples = measured(replace(CONSUMER, **STILL_RADIO, gyro_bias=0.5), 15.0, 3, motion=still)
    run = Run(samples)
    last, true = run.found[-1], samples.truth.gyro_bias[run.which[-1]]
    assert np.degrees(np.abs(last.bias - true)).max() < 0.03
    rates = np.array([orientation.angular_velocity for orientation in run.found[-300:]])
    assert np.degrees(np.abs(rates.mean(axis=0))).max() < 0.03
    np.testing.assert_array_equal(last.angular_velocity, samples.angular_velocity[run.which[-1]] - last.bias)


def test_with_a_magnetometer_the_earth_is_east_north_up() -> None:
    run = Run(measured(seconds=15.0, motion=pivot), magnetic=True)
    assert np.abs(run.heading[run.times > 5.0]).max() < 2.0
    assert run.disturbed[0] and not run.disturbed[-1]


@pytest.mark.parametrize("magnetic", [True, False])
def test_deviations_cover_the_errors(magnetic: bool) -> None:
    """Of consumer sensors over 20 s, in a clean field or without magnetometer."""
    runs = [Run(measured(CONSUMER, 20.0, seed, rate_hz=50.0), magnetic) for seed in range(draws(2, 4))]
    tilt = np.concatenate([np.abs(run.tilt / run.tilt_stddev).ravel() for run in runs])
    heading = np.concatenate([np.abs(run.heading / np.maximum(run.heading_stddev, 0.1)) for run in runs])
    assert (tilt < 2.0).mean() > 0.95
    assert (heading < 2.0).mean() > 0.95
    # and are not needlessly large
    assert np.median(np.concatenate([run.tilt_stddev for run in runs])) < 4.0
    for run in runs:
        if run.estimator.restarts:
            continue
        if magnetic:
            assert run.heading_stddev[-1] < 10.0
        else:
            assert run.heading_stddev[-1] > 2.0 * run.heading_stddev[len(run.times) // 8]


def test_a_disturbed_field_is_detected_and_does_not_turn_the_heading() -> None:
    iron = Iron(np.array([1.25, 1.2, 0.9]), np.array([12.0, 4.0, 0.0]), 0.1, 20.0, 35.0)
    run = Run(measured(replace(CONSUMER, **STILL_RADIO), 40.0, rate_hz=50.0, iron=(iron,)), magnetic=True)
    there = (run.times > 21.0) & (run.times < 34.0)
    before = (run.times > 12.0) & (run.times < 19.0)
    disturbed = np.array([bool(each) for each in run.disturbed])
    assert disturbed[there].mean() > 0.8
    assert not disturbed[before].any()
    assert (np.abs(run.heading) < 2.0 * run.heading_stddev)[run.times > 12.0].mean() > 0.95
    assert np.abs(run.heading[there]).max() < 10.0


def test_after_an_outage_the_heading_goes_on_with_the_doubt_of_it() -> None:
    samples = measured(replace(CONSUMER, **STILL_RADIO), 30.0, rate_hz=50.0, off=((12.0, 14.0),), motion=still)
    run = Run(samples)
    assert run.estimator.restarts == 1
    after = int(np.searchsorted(run.times, 13.0))
    assert np.abs(run.heading[after] - run.heading[after - 1]) < 1.0
    assert run.heading_stddev[after] > 30.0 > run.heading_stddev[after - 1]
    assert np.abs(run.tilt[after:]).max() < 3.0


def test_after_lost_readings_the_accelerometer_levels_the_sooner() -> None:
    """0.6 s of the swings are lost, which no interpolation bridges; VQF's own low-pass would take six seconds."""
    samples = measured(IDEAL, 11.0, motion=pivot)
    lost = (samples.truth.times > 8.0) & (samples.truth.times < 8.6)
    estimator = OrientationEstimator()
    off: dict[float, float] = {}
    for k in np.flatnonzero(~lost):
        orientation = estimator.update(sample(samples, int(k)))
        if orientation is not None:
            up = so3.quat_to_matrix(np.stack([orientation.orientation, samples.truth.quat_xyzw[k]]))[:, 2]
            off[float(samples.truth.times[k])] = float(np.degrees(np.arccos(min(up[0] @ up[1], 1.0))))
    times, tilt = np.array(list(off)), np.array(list(off.values()))
    assert estimator.restarts == 0
    assert tilt[(times > 6.0) & (times < 8.0)].max() < 1.0 < 20.0 < tilt[np.searchsorted(times, 8.6)]
    assert tilt[times > 10.0].max() < 0.2 * tilt[np.searchsorted(times, 8.6)]


@pytest.mark.parametrize("stamp_jitter", some([0.004, 0.0]))
def test_the_rotation_hidden_by_clipping_is_estimated(stamp_jitter: float) -> None:
    """With the gyroscope range known: the swings have up to 286 degrees per second."""
    samples = measured(replace(IDEAL, gyro_range=250.0, stamp_jitter=stamp_jitter), 10.0, motion=pivot)
    assert (np.abs(samples.angular_velocity) > np.radians(249.9)).any(axis=1).mean() > 0.1
    limited, unlimited = (
        Run(samples, errors=errors) for errors in (InertialErrors(gyro_range=np.radians(250.0)), None)
    )
    settled = limited.times > 1.0
    assert np.square(limited.tilt[settled]).mean() < 0.25 * np.square(unlimited.tilt[settled]).mean()
    assert np.square(limited.heading).mean() < 0.1 * np.square(unlimited.heading).mean()
    assert (np.abs(limited.tilt) < 2.0 * limited.tilt_stddev).mean() > 0.95
    assert (np.abs(limited.heading) < 2.0 * np.maximum(limited.heading_stddev, 0.1)).mean() > 0.95


def test_a_rate_that_stays_at_its_stop_leaves_the_heading_unknown() -> None:
    still_here = np.array([0.0, 0.0, 9.8])
    estimator = OrientationEstimator()
    before = after = None
    for k in range(300):
        rate = np.array([0.0, 0.0, np.radians(2000.0) if 100 <= k < 200 else 0.0])
        orientation = estimator.update(
            ImuSample(k * NANOSECONDS // 100, "imu_link", angular_velocity=rate, acceleration=still_here)
        )
        before, after = (orientation if k == 99 else before), orientation
    assert before is not None and after is not None
    assert np.degrees(np.sqrt(before.covariance[2, 2])) < 5.0
    assert np.degrees(np.sqrt(after.covariance[2, 2])) > 100.0
    assert np.degrees(np.abs(so3.quat_to_matrix(after.orientation)[2, :2])).max() < 1.0


def test_another_rate_is_noticed() -> None:
    slow, fast = measured(seconds=10.0, rate_hz=50.0), measured(seconds=20.0)
    estimator = OrientationEstimator()
    for samples, begin_ns, rate_hz in ((slow, 0, 50.0), (fast, slow.stamps_ns[-1], 100.0)):
        for k in np.flatnonzero(samples.stamps_ns > begin_ns):
            estimator.update(sample(samples, int(k)))
        assert estimator.rate_hz == pytest.approx(rate_hz, rel=0.01)
    assert estimator.restarts == 1


def test_time_that_runs_backwards_begins_anew_and_a_stamp_that_repeats_is_left_out() -> None:
    samples = measured(seconds=5.0)
    estimator = OrientationEstimator()
    rounds: list[list[ImuOrientation | None]] = [[], []]
    for found in rounds:
        for k in range(len(samples.stamps_ns)):
            found.append(estimator.update(sample(samples, k)))
            assert estimator.update(sample(samples, k)) is None
    for first, second in zip(*rounds, strict=True):
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            np.testing.assert_array_equal(first.orientation, second.orientation)
            np.testing.assert_array_equal(first.covariance, second.covariance)
    assert rounds[0][-1] is not None


def test_orientation_alone_is_no_raw_data() -> None:
    estimator = OrientationEstimator()
    still_here = np.array([0.0, 0.0, 9.8])
    with pytest.raises(ImuOrientationError, match="imu_link: a reading without angular velocity"):
        estimator.update(ImuSample(0, "imu_link", acceleration=still_here))
    with pytest.raises(ImuOrientationError, match="without acceleration"):
        estimator.update(ImuSample(0, "imu_link", angular_velocity=still_here))


def test_a_real_pendulum(shared_data: Path) -> None:
    """The first link against Vicon: within 2 degrees, inclination within 1, after two constant rotations."""
    path = shared_data / "imu" / "pendulum_with_reference" / "Pendulum_Test02a_Trial1_Segment_1.csv.gz"
    estimator = OrientationEstimator()
    found = [orientation for item in ImuCsvRecording(path) if (orientation := estimator.update(item.sample))]
    columns = np.genfromtxt(path, delimiter=";", skip_header=2, usecols=range(5))
    course = Slerp(
        [each.stamp_ns / NANOSECONDS for each in found], Rotation.from_quat([each.orientation for each in found])
    )
    inside = (columns[:, 0] > 1.0) & (columns[:, 0] < 174.0)
    columns = columns[inside][::4]
    ours = course(columns[:, 0]).as_matrix()
    vicon = Rotation.from_quat(columns[:, [2, 3, 4, 1]]).as_matrix()
    # vicon = world @ ours @ mounting, both fitted in turn; the mounting starts from the first instant
    world, mounting = np.eye(3), ours[0].T @ vicon[0]
    products = np.tensordot(vicon, ours, (0, 0))  # all that the sums over the instants below need
    for _ in range(400):  # slowly: it turns mostly about one axis
        world = so3.nearest_rotation(np.einsum("ijkl,lj->ik", products, mounting))
        mounting = so3.nearest_rotation(np.einsum("jkli,jl->ik", products, world))
    error = Rotation.from_matrix(vicon @ (world @ ours @ mounting).swapaxes(1, 2)).as_rotvec(degrees=True)
    tilt = error - np.outer(error @ world[:, 2], world[:, 2])
    assert np.sqrt((error**2).sum(axis=1).mean()) < 2.0
    assert np.sqrt((tilt**2).sum(axis=1).mean()) < 1.0
