"""Simulated inertial sensors: exact physics without errors, and errors as in the data sheets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from random_people import RandomPerson
from scipy.integrate import cumulative_trapezoid

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.simulated import ImuSamples, Motion, Mounting, SimulatedImu, Slip, usual_mounting
from body_tracking.inertial.simulated_errors import (
    CONSUMER,
    STANDARD_GRAVITY,
    ImuErrors,
    ImuSimulationError,
)
from body_tracking.inertial.surroundings import Iron, Surroundings
from body_tracking.kinematics.trajectories import minimum_jerk
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws, some
from ideal_sensors import IDEAL

UP = np.array([0.0, 0.0, 1.0])
AT_ORIGIN = Mounting(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
START_NS = 1_700_000_000 * NANOSECONDS
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True, eq=False)
class Swing:
    """Two axes turn, one after the other, and the origin moves, in sinusoids; with its derivatives."""

    axes: FloatArray  # (2, 3) amplitudes, radians
    way: FloatArray  # (3,) amplitudes, metres
    frequencies: FloatArray  # (5,) rad/s
    phases: FloatArray  # (5,)

    @classmethod
    def draw(cls, seed: int, hertz: float = 1.5) -> Swing:
        rng = np.random.default_rng(seed)
        frequencies = 2.0 * np.pi * rng.uniform(0.1, hertz, 5)
        return cls(rng.normal(size=(2, 3)), 0.3 * rng.normal(size=3), frequencies, rng.uniform(0.0, 6.0, 5))

    def __call__(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        wave = np.sin(np.outer(times, self.frequencies) + self.phases)
        first, second = (so3.exp(wave[:, k : k + 1] * self.axes[k]) for k in range(2))
        return so3.quat_to_matrix(so3.quat_multiply(first, second)), 1.0 + wave[:, 2:] * self.way

    def rates(self, times: FloatArray) -> FloatArray:
        """(n, 3) rad/s in the own frame."""
        angle = np.outer(times, self.frequencies) + self.phases
        speed = self.frequencies * np.cos(angle)
        second = so3.quat_to_matrix(so3.exp(np.sin(angle[:, 1:2]) * self.axes[1]))
        result: FloatArray = (speed[:, :1] * self.axes[0])[:, None] @ second
        return result[:, 0] + speed[:, 1:2] * self.axes[1]

    def accelerations(self, times: FloatArray) -> FloatArray:
        """(n, 3) m/s2 in world."""
        angle = np.outer(times, self.frequencies) + self.phases
        result: FloatArray = -(self.frequencies[2:] ** 2) * np.sin(angle[:, 2:]) * self.way
        return result


def still(quat_xyzw: FloatArray | None = None, position: FloatArray | None = None) -> Motion:
    rotation = np.eye(3) if quat_xyzw is None else so3.quat_to_matrix(quat_xyzw)
    place = np.zeros(3) if position is None else position
    return lambda times: (np.tile(rotation, (len(times), 1, 1)), np.tile(place, (len(times), 1)))


def turning(axis: FloatArray, angle: float, begin: float, duration: float) -> Motion:
    """A rotation about the origin by an angle, as a minimum-jerk move."""

    def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = angle * minimum_jerk((times - begin) / duration)[:, None] * axis
        return so3.quat_to_matrix(so3.exp(turn)), np.zeros((len(times), 3))

    return motion


def measured(
    motion: Motion,
    errors: ImuErrors = IDEAL,
    duration: float = 5.0,
    seed: int = 0,
    *,
    mounting: Mounting = AT_ORIGIN,
    rate_hz: float = 100.0,
    oriented: bool = False,
    magnetometer: bool = True,
    surroundings: Surroundings | None = None,
    parent: Motion | None = None,
    slips: tuple[Slip, ...] = (),
    off: tuple[tuple[float, float], ...] = (),
) -> ImuSamples:
    imu = SimulatedImu(
        "imu", "forearm_left", mounting, rate_hz, oriented, magnetometer, errors=errors, slips=slips, off=off
    )
    rng = np.random.default_rng(seed)
    return imu.samples(motion, duration, START_NS, rng, surroundings=surroundings, parent=parent)


def rotated(rotations: FloatArray, vectors: FloatArray) -> FloatArray:
    result: FloatArray = np.einsum("nij,nj->ni", rotations, vectors)
    return result


def orientation_errors(samples: ImuSamples) -> FloatArray:
    """(n, 3) rotation vectors from the true to the reported orientation, in world."""
    assert samples.orientation is not None
    return so3.log(so3.quat_multiply(samples.orientation, so3.quat_inverse(samples.truth.quat_xyzw)))


def headings_of(samples: ImuSamples) -> FloatArray:
    """(n,) radians by which the reported frame is turned about the vertical, without jumps."""
    assert samples.orientation is not None
    error = so3.quat_multiply(samples.orientation, so3.quat_inverse(samples.truth.quat_xyzw))
    turned: FloatArray = np.unwrap(2.0 * np.arctan2(error[:, 2], error[:, 3]))
    return turned


def degrees(value: float) -> float:
    """In radians."""
    return float(np.radians(value))


# --- measurements without errors -------------------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=draws(4, 8), deadline=None)
def test_at_rest_it_measures_gravity_upwards_and_no_rotation(seed: int) -> None:
    quat = so3.exp(np.random.default_rng(seed).normal(size=3))
    samples = measured(still(quat, np.array([2.0, -1.0, 1.2])), duration=0.3)
    up = so3.quat_to_matrix(quat).T @ UP
    assert_allclose(samples.linear_acceleration, np.tile(STANDARD_GRAVITY * up, (len(samples.stamps_ns), 1)), atol=1e-9)
    assert_allclose(samples.angular_velocity, np.zeros_like(samples.angular_velocity), atol=1e-12)


@given(st.floats(0.2, 20.0), st.floats(0.0, 0.1))
@settings(max_examples=draws(4, 8), deadline=None)
def test_the_motion_is_asked_for_its_own_time_only(duration: float, phase: float) -> None:
    asked: list[float] = []

    def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        asked.extend((times.min(), times.max()))
        return still()(times)

    imu = SimulatedImu("imu", "head", usual_mounting("head"), phase=phase)
    imu.samples(motion, duration, START_NS, np.random.default_rng(0), parent=motion)
    assert min(asked) >= 0.0
    assert max(asked) <= duration


@given(SEEDS)
@settings(max_examples=draws(5, 12), deadline=None)
def test_rates_and_accelerations_are_the_derivatives_of_the_motion(seed: int) -> None:
    """Up to 5 Hz, off by no more than the next terms of the series over the step h = 0.1 ms.

    ``h^2 (w''/6 + w x w'/3)`` (Magnus 1954) and ``h^2 a''/12``, each of its own sign, and rounding.
    """
    motion, h, near = Swing.draw(seed, hertz=5.0), 1e-4, 2e-4
    samples = measured(motion, duration=2.0)
    times, world = samples.truth.times, so3.quat_to_matrix(samples.truth.quat_xyzw)
    before, rates, after = (motion.rates(times + step) for step in (-near, 0.0, near))
    first, second = (after - before) / (2.0 * near), (after - 2.0 * rates + before) / near**2
    bound = h**2 * np.linalg.norm(np.abs(second) / 6.0 + np.abs(np.cross(rates, first)) / 3.0, axis=1).max()
    assert_allclose(samples.angular_velocity, rates, rtol=0, atol=1.01 * bound + 1e-9)
    force = rotated(world, samples.linear_acceleration) - STANDARD_GRAVITY * UP
    bound = h**2 * np.max(motion.frequencies[2:] ** 4 * np.abs(motion.way)) / 12.0
    assert_allclose(force, motion.accelerations(times), rtol=0, atol=1.01 * bound + 2e-6)


@given(SEEDS)
@settings(max_examples=draws(4, 8), deadline=None)
def test_all_three_are_measured_in_the_frame_of_the_sensor(seed: int) -> None:
    """A rotated mounting rotates the measurements inversely."""
    motion, turn = Swing.draw(seed), so3.exp(np.random.default_rng(seed).normal(size=3))
    place = np.array([0.02, 0.03, -0.2])
    straight = measured(motion, duration=0.5, mounting=Mounting(place, AT_ORIGIN.quat_xyzw))
    turned = measured(motion, duration=0.5, mounting=Mounting(place, turn))
    back = so3.quat_to_matrix(turn)
    assert straight.magnetic_field is not None and turned.magnetic_field is not None
    assert_allclose(turned.angular_velocity @ back.T, straight.angular_velocity, atol=1e-9)
    assert_allclose(turned.linear_acceleration @ back.T, straight.linear_acceleration, atol=1e-9)
    assert_allclose(turned.magnetic_field @ back.T, straight.magnetic_field, atol=1e-15)


@given(SEEDS, st.floats(-3.0, 3.0), st.floats(-1.5, 1.5))
@settings(max_examples=draws(4, 8), deadline=None)
def test_turned_to_world_the_field_is_the_earths(seed: int, north: float, dip: float) -> None:
    where = Surroundings(dip=dip, north=north)
    samples = measured(Swing.draw(seed), duration=0.5, surroundings=where)
    assert samples.magnetic_field is not None
    world = rotated(so3.quat_to_matrix(samples.truth.quat_xyzw), samples.magnetic_field)
    assert_allclose(world, np.tile(where.earth, (len(world), 1)), atol=1e-15)
    level = where.strength * np.cos(dip)
    expected = [level * np.cos(north), level * np.sin(north), -where.strength * np.sin(dip)]
    assert_allclose(where.earth, expected, atol=1e-18)


# --- iron ------------------------------------------------------------------------------------------------------------


def test_the_field_of_iron_is_twice_as_strong_along_its_axis_and_falls_with_the_cube() -> None:
    iron = Iron(np.array([1.0, 0.0, 0.5]), np.array([0.0, 0.0, 3.0]))
    on_axis, off_axis, twice = iron.field(np.array([[1.0, 0.0, 1.0], [1.5, 0.0, 0.5], [1.0, 0.0, 1.5]]), np.zeros(3))
    assert_allclose(on_axis, 1e-7 * 2.0 * iron.moment / 0.5**3)
    assert_allclose(off_axis, -0.5 * on_axis, atol=1e-20)
    assert_allclose(twice, on_axis / 8.0, atol=1e-20)


def test_iron_that_comes_and_goes_is_there_in_between_only() -> None:
    iron = Iron(np.zeros(3), np.array([0.0, 0.0, 5.0]), since=10.0, until=40.0)
    times = np.array([0.0, 9.4, 10.0, 25.0, 40.0, 40.6])
    there = np.linalg.norm(iron.field(np.tile([0.3, 0.0, 0.0], (6, 1)), times), axis=1)
    assert_array_equal(there > 0.0, [False, False, True, True, True, False])
    assert_allclose(there[2:5], there[3])


# --- errors of the three sensors -------------------------------------------------------------------------------------


def allan_deviation(values: FloatArray, samples: int) -> float:
    means = values[: len(values) // samples * samples].reshape(-1, samples, values.shape[1]).mean(axis=1)
    return float(np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2)))


@pytest.mark.parametrize("rate_hz", [50.0, 200.0])
def test_white_noise_has_the_allan_deviation_of_its_density(rate_hz: float) -> None:
    errors = replace(IDEAL, gyro_noise=0.01, acc_noise=0.003, mag_noise=0.05)
    samples = measured(still(), errors, duration=300.0, rate_hz=rate_hz)
    assert samples.magnetic_field is not None
    kinds = (
        (samples.angular_velocity, np.radians(0.01), samples.angular_velocity_covariance),
        (samples.linear_acceleration, 0.003, samples.linear_acceleration_covariance),
        (samples.magnetic_field, 0.05e-6, samples.magnetic_field_covariance),
    )
    for values, density, covariance in kinds:
        for tau in (0.1, 1.0):
            assert allan_deviation(values, round(tau * rate_hz)) == pytest.approx(density / np.sqrt(tau), rel=0.08)
        assert_allclose(np.cov(values.T), covariance, atol=0.05 * covariance[0, 0])


def test_in_run_bias_keeps_its_size_and_fades_from_memory_in_its_time() -> None:
    errors = replace(IDEAL, gyro_instability=0.02, instability_time=1.0)
    bias = np.degrees(measured(still(), errors, duration=600.0, rate_hz=50.0).truth.gyro_bias)
    assert bias.std() == pytest.approx(0.02, rel=0.08)
    assert np.mean(bias[50:] * bias[:-50]) / bias.var() == pytest.approx(np.exp(-1.0), abs=0.08)


def test_turn_on_biases_are_spread_as_stated_and_stay() -> None:
    errors = replace(IDEAL, gyro_bias=0.5, acc_bias=0.1, mag_bias=2.0)
    runs = [measured(still(), errors, duration=0.2, seed=seed) for seed in range(150)]
    rates = np.array([run.angular_velocity for run in runs])
    forces = np.array([run.linear_acceleration for run in runs]) - STANDARD_GRAVITY * UP
    magnetic = np.array([run.magnetic_field for run in runs]) - Surroundings().earth
    for values, stddev in ((rates, degrees(0.5)), (forces, 0.1), (magnetic, 2e-6)):
        assert_allclose(values.std(axis=1), np.zeros((150, 3)), atol=1e-9)
        assert values[:, 0].std() == pytest.approx(stddev, rel=0.12)  # of 450 draws
    assert_allclose(rates[:, 0], [run.truth.gyro_bias[0] for run in runs], atol=1e-12)


def test_scale_and_axes_errors_are_linear() -> None:
    errors = replace(IDEAL, gyro_scale=0.03, gyro_axes=0.01)
    drawn = []
    for seed in range(60):
        samples = measured(Swing.draw(1), errors, duration=1.0, seed=seed)
        true = Swing.draw(1).rates(samples.truth.times)
        mixing, residuals, *_ = np.linalg.lstsq(true, samples.angular_velocity, rcond=None)
        assert residuals.max() < 1e-8
        drawn.append(mixing.T - np.eye(3))
    off_diagonal = ~np.eye(3, dtype=np.bool_)
    assert np.std(np.array(drawn)[:, ~off_diagonal]) == pytest.approx(0.03, rel=0.2)  # of 180 draws
    assert np.std(np.array(drawn)[:, off_diagonal]) == pytest.approx(0.01, rel=0.15)  # of 360


def test_measurements_are_clipped_to_the_range_and_quantised() -> None:
    errors = replace(IDEAL, gyro_range=100.0)
    motion = turning(UP, np.pi, 0.5, 1.0)
    rates = np.degrees(measured(motion, errors, duration=2.0).angular_velocity[:, 2])
    exact = np.degrees(measured(motion, duration=2.0).angular_velocity[:, 2])
    step = 100.0 / 2**15
    assert exact.max() > 300.0
    assert rates.max() == pytest.approx(100.0 - step)
    within = exact < 99.0
    assert_allclose(rates[within], exact[within], atol=0.501 * step)
    assert_allclose(rates / step, np.round(rates / step), atol=1e-6)


# --- the sensor on the segment ---------------------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=draws(4, 8), deadline=None)
def test_without_tissue_it_keeps_its_place_on_the_segment(seed: int) -> None:
    errors = replace(IDEAL, misalignment=5.0)
    motion, mounting = Swing.draw(seed), usual_mounting("forearm_right")
    samples = measured(motion, errors, duration=0.5, seed=seed, mounting=mounting)
    rotations, origins = motion(samples.truth.times)
    expected = so3.quat_multiply(so3.matrix_to_quat(rotations), samples.truth.mounting_xyzw)
    off = so3.log(so3.quat_multiply(so3.quat_inverse(expected), samples.truth.quat_xyzw))
    assert_allclose(off, np.zeros_like(off), atol=1e-12)
    assert_allclose(samples.truth.positions, origins + rotations @ mounting.position, atol=1e-14)


def test_misalignment_is_spread_as_stated() -> None:
    errors = replace(IDEAL, misalignment=5.0)
    mounting = usual_mounting("upper_arm_left")
    turns = [
        so3.log(
            so3.quat_multiply(
                measured(still(), errors, duration=0.1, seed=seed, mounting=mounting).truth.mounting_xyzw,
                so3.quat_inverse(mounting.quat_xyzw),
            )
        )
        for seed in range(150)
    ]
    assert np.degrees(np.std(turns)) == pytest.approx(5.0, rel=0.12)


@given(SEEDS)
@settings(max_examples=draws(4, 8), deadline=None)
def test_at_rest_tissue_sags_by_its_parameter_in_any_pose(seed: int) -> None:
    """The sag across the limb also rotates the sensor, by the sag over the limb's radius."""
    errors = replace(IDEAL, tissue_sag=0.001, tissue_turn=10.0)
    place, quat = np.array([0.0, 0.05, -0.1]), so3.exp(np.random.default_rng(seed).normal(size=3))
    samples = measured(still(quat), errors, duration=1.0, mounting=Mounting(place, AT_ORIGIN.quat_xyzw))
    rotation = so3.quat_to_matrix(quat)
    sagged = samples.truth.positions - rotation @ place
    assert_allclose(
        sagged, np.tile(-0.001 * UP, (len(sagged), 1)), atol=1e-5
    )  # the limit of the displacement reduces it a little
    turn = so3.log(so3.quat_multiply(so3.quat_inverse(quat), samples.truth.quat_xyzw))
    expected = 10.0 * np.cross([0.0, 1.0, 0.0], rotation.T @ (-0.001 * UP))
    assert_allclose(turn, np.tile(expected, (len(turn), 1)), atol=1e-4)


def test_tissue_resonates_at_its_frequency() -> None:
    """A damped oscillator: shaken at its frequency it swings by the static deflection over twice the damping ratio."""
    errors = replace(IDEAL, tissue_sag=0.001, tissue_frequency=8.0, tissue_damping=0.25, tissue_turn=0.0)
    acceleration = 2.0

    def amplitude(hertz: float) -> float:
        w = 2.0 * np.pi * hertz

        def shaken(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            way = np.zeros((len(times), 3))
            way[:, 0] = acceleration / w**2 * np.sin(w * times)
            return np.tile(np.eye(3), (len(times), 1, 1)), way

        samples = measured(shaken, errors, duration=6.0, rate_hz=200.0)
        slid = samples.truth.positions[:, 0] - shaken(samples.truth.times)[1][:, 0]
        return float(np.sqrt(2.0) * slid[samples.truth.times > 2.0].std())

    static = 0.001 * acceleration / STANDARD_GRAVITY
    assert amplitude(0.5) == pytest.approx(static, rel=0.02)
    assert amplitude(8.0) == pytest.approx(static / 0.5, rel=0.03)
    assert amplitude(16.0) == pytest.approx(static / np.hypot(3.0, 1.0), rel=0.1)


def test_tissue_never_gives_more_than_it_can() -> None:
    def flung(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.tile(np.eye(3), (len(times), 1, 1)), 0.2 * np.sin(25.0 * times)[:, None] * np.ones(3)

    samples = measured(flung, replace(IDEAL, tissue_sag=0.01), duration=3.0)
    slid = np.linalg.norm(samples.truth.positions - flung(samples.truth.times)[1], axis=1)
    assert 0.011 < slid.max() < 0.012


def test_the_skin_follows_a_twist_only_in_part_and_a_swing_whole() -> None:
    errors = replace(IDEAL, twist_share=0.25)
    mounting = usual_mounting("upper_arm_left")
    for axis, follows in ((UP, 0.75), (np.array([0.0, 1.0, 0.0]), 1.0)):
        samples = measured(turning(axis, 1.2, 0.5, 1.0), errors, duration=2.0, mounting=mounting, parent=still())
        turn = so3.log(so3.quat_multiply(samples.truth.quat_xyzw[-1], so3.quat_inverse(samples.truth.quat_xyzw[0])))
        assert_allclose(turn, follows * 1.2 * axis, atol=1e-9)
        rotation = cumulative_trapezoid(samples.angular_velocity, samples.truth.times, axis=0)[-1]
        assert np.linalg.norm(rotation) == pytest.approx(follows * 1.2, rel=1e-3)


@pytest.mark.parametrize("twist", [0.0, 1.0, -2.0])
def test_no_jerk_comes_of_the_twist_where_an_arm_points_straight_up(twist: float) -> None:
    def raised(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        swing = so3.exp(np.outer(np.pi - 0.3 * np.cos(times), [1.0, 0.1, 0.0]))
        return so3.quat_to_matrix(so3.quat_multiply(swing, so3.exp(twist * UP))), np.zeros((len(times), 3))

    rates = measured(raised, replace(IDEAL, twist_share=0.5), duration=6.0, parent=still()).angular_velocity
    assert np.abs(np.diff(rates, axis=0)).max() < 0.05


def test_a_slip_turns_the_sensor_once_and_is_measured() -> None:
    turn = np.array([0.0, 0.0, degrees(20.0)])
    mounting = usual_mounting("forearm_left")
    samples = measured(still(), mounting=mounting, duration=6.0, slips=(Slip(3.0, turn),))
    times = samples.truth.times
    off = so3.log(so3.quat_multiply(samples.truth.quat_xyzw, so3.quat_inverse(mounting.quat_xyzw)))
    assert_allclose(off[times < 3.0], np.zeros((np.count_nonzero(times < 3.0), 3)), atol=1e-12)
    assert_allclose(off[times > 3.2], np.tile(turn, (np.count_nonzero(times > 3.2), 1)), atol=1e-12)
    assert_allclose(
        so3.quat_to_matrix(mounting.quat_xyzw) @ samples.angular_velocity.sum(axis=0) * 0.01, turn, atol=1e-4
    )


@pytest.mark.parametrize("segment", SEGMENTS)
def test_usual_mountings_point_away_from_the_body_and_mirror_each_other(segment: str) -> None:
    mounting = usual_mounting(segment, 1.75)
    rotation = so3.quat_to_matrix(mounting.quat_xyzw)
    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation[:, 2] @ mounting.position > 0.01
    if segment.endswith("_left"):
        other = usual_mounting(segment.replace("left", "right"), 1.75)
        mirror = np.array([1.0, -1.0, 1.0])
        assert_allclose(other.position, mirror * mounting.position)
        assert_allclose(
            so3.quat_to_matrix(other.quat_xyzw)[:, [0, 2]], mirror[:, None] * rotation[:, [0, 2]], atol=1e-12
        )


# --- orientation as a driver reports it ------------------------------------------------------------------------------


@given(SEEDS, st.floats(-3.0, 3.0))
@settings(max_examples=draws(4, 8), deadline=None)
def test_at_rest_a_driver_with_magnetometer_knows_its_orientation_to_east_north_up(seed: int, north: float) -> None:
    quat = so3.exp(np.random.default_rng(seed).normal(size=3))
    samples = measured(still(quat), duration=0.5, oriented=True, surroundings=Surroundings(north=north))
    assert samples.orientation is not None
    orientations = so3.quat_to_matrix(samples.orientation)
    to_north = orientations @ so3.quat_to_matrix(quat).T @ np.array([np.cos(north), np.sin(north), 0.0])
    assert_allclose(to_north, np.tile([0.0, 1.0, 0.0], (len(orientations), 1)), atol=1e-9)
    assert_allclose(
        rotated(orientations, samples.linear_acceleration),
        np.tile(STANDARD_GRAVITY * UP, (len(orientations), 1)),
        atol=1e-8,
    )


def test_without_magnetometer_it_is_level_with_any_heading() -> None:
    headings = []
    for seed in range(40):
        samples = measured(still(), duration=0.2, seed=seed, oriented=True, magnetometer=False)
        error = orientation_errors(samples)
        assert_allclose(error[:, :2], np.zeros((len(error), 2)), atol=1e-9)
        assert_allclose(error[:, 2], error[0, 2])
        assert samples.magnetic_field is None
        headings.append(error[0, 2])
    assert min(headings) < -2.0 and max(headings) > 2.0
    assert abs(np.mean(np.exp(1j * np.array(headings)))) < 0.4


def test_raw_data_is_marked_as_without_orientation() -> None:
    samples = measured(still(), duration=0.2)
    assert samples.orientation is None
    assert_array_equal(samples.orientation_covariance[:, 0, 0], -1.0)


def complementary_filter(
    samples: ImuSamples, errors: ImuErrors, start: FloatArray, where: Surroundings | None
) -> FloatArray:
    """(n, 4) the filter itself, step by step; with the magnetic field where its direction is given."""
    quat, orientations = start, [start]
    steps = np.diff(samples.truth.times)
    for k, step in enumerate(steps.tolist(), start=1):
        mean_rate = 0.5 * (samples.angular_velocity[k - 1] + samples.angular_velocity[k])
        quat = so3.quat_multiply(quat, so3.exp(mean_rate * step))
        force = so3.quat_to_matrix(quat) @ samples.linear_acceleration[k] / STANDARD_GRAVITY
        correction = np.array([force[1], -force[0], 0.0]) * step / errors.tilt_time
        if where is not None:
            assert samples.magnetic_field is not None
            seen = so3.quat_to_matrix(quat) @ samples.magnetic_field[k]
            correction[2] = -np.angle((seen[0] + 1j * seen[1]) * np.exp(-1j * where.north)) * step / errors.heading_time
        quat = so3.quat_multiply(so3.exp(correction), quat)
        orientations.append(quat)
    return np.array(orientations)


def tilt_and_heading(orientation: FloatArray, samples: ImuSamples) -> FloatArray:
    """(n, 3) degrees by which an orientation errs: tilt about x and y in world, then heading since the start."""
    error = so3.quat_multiply(orientation, so3.quat_inverse(samples.truth.quat_xyzw))
    heading = np.unwrap(2.0 * np.arctan2(error[:, 2], error[:, 3]))
    tilt = so3.log(so3.quat_multiply(so3.exp(-heading[:, None] * UP), error))[:, :2]
    return np.degrees(np.concatenate([tilt, (heading - heading[0])[:, None]], axis=1))


@pytest.mark.parametrize("magnetometer", [False, True])
@pytest.mark.parametrize("seed", some([3, 5]))
def test_the_drivers_errors_are_those_of_a_complementary_filter_on_the_same_data(seed: int, magnetometer: bool) -> None:
    errors = replace(
        IDEAL,
        gyro_noise=0.02,
        gyro_instability=0.3,
        gyro_scale=0.01,
        gyro_axes=0.01,
        acc_noise=0.005,
        acc_bias=0.1,
        mag_noise=0.05,
        mag_bias=1.0,
    )
    where = Surroundings(iron=(Iron(np.array([1.4, 1.0, 1.0]), np.array([3.0, 2.0, 2.0])),))
    samples = measured(
        Swing.draw(seed, hertz=0.8),
        errors,
        duration=40.0,
        seed=3,
        oriented=True,
        magnetometer=magnetometer,
        surroundings=where,
    )
    assert samples.orientation is not None
    filtered = complementary_filter(samples, errors, samples.orientation[0], where if magnetometer else None)
    orientations, expected = (tilt_and_heading(values, samples) for values in (samples.orientation, filtered))
    size, apart = (np.sqrt(np.mean(values**2, axis=0)) for values in (expected, orientations - expected))
    assert size.min() > 0.5
    assert np.all(apart < 0.1 * size)


def test_iron_turns_the_heading_to_its_field_while_it_is_there() -> None:
    place = np.array([0.4, 0.2, 0.0])
    iron = Iron(np.zeros(3), np.array([4.0, 3.0, 0.0]), since=20.0, until=110.0)
    where = Surroundings(iron=(iron,))
    samples = measured(still(None, place), duration=180.0, oriented=True, surroundings=where, rate_hz=50.0)
    heading, times = orientation_errors(samples)[:, 2], samples.truth.times
    field = where.field(place[None], np.array([60.0]))[0]
    expected = 0.5 * np.pi - np.arctan2(field[1], field[0])
    assert abs(expected) > degrees(10.0)
    assert heading[times < 19.0] == pytest.approx(0.0, abs=1e-9)
    assert heading[np.searchsorted(times, 109.0)] == pytest.approx(expected, rel=0.01)
    assert heading[-1] == pytest.approx(0.0, abs=degrees(0.1))


def test_the_stated_heading_deviation_grows_with_the_drift_and_covers_it() -> None:
    errors = replace(CONSUMER, stated_heading=0.0, tissue_sag=0.0, lost=0.0, outages=0.0)
    normalised, stated = [], []
    for seed in range(draws(25, 60)):
        samples = measured(
            Swing.draw(seed, hertz=0.6), errors, 60.0, seed, oriented=True, magnetometer=False, rate_hz=25.0
        )
        turned = headings_of(samples)
        deviation = np.sqrt(samples.orientation_covariance[:, 2, 2])
        normalised.append((turned[-1] - turned[0]) / deviation[-1])
        stated.append(deviation[[len(deviation) // 6, -1]])
    early, late = np.mean(stated, axis=0)
    assert late > 1.3 * early
    # of 25 or 60 draws of unit variance
    assert 0.75 < np.std(normalised) < 1.3


def test_off_and_on_again_it_is_silent_in_between_and_starts_with_other_biases_and_another_heading() -> None:
    errors = replace(IDEAL, gyro_bias=0.5, mag_bias=2.0)
    samples = measured(still(), errors, duration=30.0, oriented=True, magnetometer=False, off=((10.0, 15.0),))
    times = samples.truth.times
    before, after = times < 10.0, times >= 15.0
    assert np.all(before | after) and np.count_nonzero(before) > 990 and np.count_nonzero(after) > 1490
    headings = headings_of(samples)
    for part in (before, after):
        assert_allclose(headings[part], headings[part][0], atol=1e-9)
        assert_allclose(samples.angular_velocity[part], samples.angular_velocity[part][:1].repeat(part.sum(), axis=0))
    assert abs(headings[before][0] - headings[after][0]) > 0.1
    assert np.abs(samples.angular_velocity[0] - samples.angular_velocity[-1]).min() > 1e-5
    with_field = measured(still(), errors, duration=30.0, off=((10.0, 15.0),)).magnetic_field
    assert with_field is not None
    assert_allclose(with_field[0], with_field[-1])  # iron on the board stays


# --- clock, order, loss ----------------------------------------------------------------------------------------------


@given(
    seed=SEEDS,
    rate_hz=st.sampled_from([25.0, 60.0, 100.0, 200.0, 400.0]),
    offset_ns=st.integers(-(10**18), 10**18),
    drift=st.floats(-500.0, 500.0),
    jitter=st.floats(0.0, 0.1),
    packet=st.integers(1, 12),
    delay_jitter=st.floats(0.0, 0.2),
)
@settings(max_examples=draws(5, 12), deadline=None)
def test_stamps_and_receipts_are_ordered_and_stamps_are_of_the_own_clock(
    seed: int, rate_hz: float, offset_ns: int, drift: float, jitter: float, packet: int, delay_jitter: float
) -> None:
    errors = replace(CONSUMER, jitter=jitter, stamp_jitter=jitter, packet=packet, delay_jitter=delay_jitter)
    clock = ClockModel(offset_ns, drift, START_NS)
    imu = SimulatedImu("imu", "head", AT_ORIGIN, rate_hz, clock=clock, errors=errors, phase=0.003)
    received_from = 77 * NANOSECONDS
    samples = imu.samples(still(), 3.0, START_NS, np.random.default_rng(seed), received_from_ns=received_from)
    assert np.all(np.diff(samples.stamps_ns) > 0)
    assert np.all(np.diff(samples.received_ns) >= 0)
    assert np.all(np.diff(samples.truth.times) > 0.0)
    taken = samples.received_ns - received_from - samples.truth.times * NANOSECONDS
    assert np.all(taken >= errors.delay * NANOSECONDS - 1.0)
    own = np.array([clock.to_reference(stamp) - START_NS for stamp in samples.stamps_ns.tolist()]) / NANOSECONDS
    assert_allclose(own, samples.truth.times, atol=0.2 / rate_hz + 1e-8)


def test_a_fast_clock_samples_more_often_and_its_stamps_run_ahead() -> None:
    clock = ClockModel(5 * NANOSECONDS, 1000.0, START_NS)
    imu = SimulatedImu("imu", "head", AT_ORIGIN, 100.0, clock=clock, errors=IDEAL)
    samples = imu.samples(still(), 100.0, START_NS, np.random.default_rng(0))
    assert len(samples.stamps_ns) == pytest.approx(10010, abs=2)
    assert_allclose(np.diff(samples.stamps_ns), 10_000_000, atol=2)  # by its own clock a hundred per second
    assert_allclose(np.diff(samples.truth.times), 0.01 / 1.001)


def test_packets_arrive_together_and_are_lost_together() -> None:
    errors = replace(IDEAL, packet=5, lost=0.1, delay=0.01, delay_jitter=0.001)
    samples = measured(still(), errors, duration=120.0)
    _, counts = np.unique(samples.received_ns, return_counts=True)
    assert np.count_nonzero(counts != 5) <= 1  # the last one may be short
    assert len(samples.stamps_ns) / 12000 == pytest.approx(0.9, abs=0.03)


def test_outages_leave_gaps_of_their_length() -> None:
    errors = replace(IDEAL, outages=6.0, outage_time=1.0)
    samples = measured(still(), errors, duration=600.0, rate_hz=50.0)
    gaps = np.diff(samples.truth.times)
    gaps = gaps[gaps > 0.03]
    assert 35 < len(gaps) < 85  # 60 by Poisson, a few of them too short to be seen, or merged
    assert 0.6 < gaps.mean() < 1.5


def test_jitter_and_delay_are_spread_as_stated() -> None:
    errors = replace(IDEAL, jitter=0.0005, stamp_jitter=0.001, delay=0.02, delay_jitter=0.004)
    samples = measured(still(), errors, duration=100.0, rate_hz=50.0)
    times = samples.truth.times
    steps = np.diff(times)
    assert steps.std() == pytest.approx(np.sqrt(2.0) * 0.0005, rel=0.05)
    own = (samples.stamps_ns - START_NS) / NANOSECONDS
    assert np.std(own - times) == pytest.approx(0.001, rel=0.05)
    delays = (samples.received_ns - START_NS) / NANOSECONDS - times
    assert delays.min() >= 0.02 - 1e-9
    assert delays.mean() == pytest.approx(0.024, abs=0.0005)


# --- chance, and bad input -------------------------------------------------------------------------------------------


def everything(samples: ImuSamples) -> list[FloatArray]:
    assert samples.magnetic_field is not None and samples.orientation is not None
    return [
        samples.stamps_ns,
        samples.received_ns,
        samples.angular_velocity,
        samples.linear_acceleration,
        samples.magnetic_field,
        samples.orientation,
        samples.orientation_covariance,
        samples.truth.quat_xyzw,
    ]


@given(SEEDS)
@settings(max_examples=5, deadline=None)
def test_a_seed_determines_everything(seed: int) -> None:
    motion = Swing.draw(1)
    first, again, other = (
        measured(motion, CONSUMER, 2.0, number, mounting=usual_mounting("hand_left"), oriented=True, off=((0.7, 0.9),))
        for number in (seed, seed, seed + 1)
    )
    for one, two in zip(everything(first), everything(again), strict=True):
        assert_array_equal(one, two)
    assert len(other.stamps_ns) != len(first.stamps_ns) or np.any(other.angular_velocity != first.angular_velocity)


def test_twice_the_noise_is_the_same_noise_twice() -> None:
    """Parameters can be compared on one seed."""
    once, twice = (
        measured(still(), replace(IDEAL, gyro_noise=noise, acc_bias=0.1), duration=1.0) for noise in (0.01, 0.02)
    )
    assert_allclose(twice.angular_velocity, 2.0 * once.angular_velocity, atol=1e-12)
    assert_array_equal(twice.linear_acceleration, once.linear_acceleration)


@pytest.mark.parametrize("oriented", [False, True])
def test_a_sensor_that_is_always_off_has_no_samples(oriented: bool) -> None:
    samples = measured(Swing.draw(0), CONSUMER, duration=1.0, oriented=oriented, off=((0.0, 2.0),))
    assert samples.stamps_ns.shape == (0,)
    assert samples.angular_velocity.shape == (0, 3)
    assert samples.orientation_covariance.shape == (0, 3, 3)


@pytest.mark.parametrize("segment", some(["hand_right", "upper_arm_left", "pelvis", "upper_trunk", "forearm_left"], 2))
def test_on_a_person_the_mean_specific_force_is_gravity(segment: str) -> None:
    """Over 20 s the mean specific force is gravity for any motion; soft tissue changes it by some degrees."""
    rng = np.random.default_rng(4)
    person, movement = RandomPerson.draw(rng), RandomMotion(rng, 20.0)

    def of(name: str) -> Motion:
        number = SEGMENTS.index(name)

        def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            posture = MODEL.forward(movement.configuration(times), person.lengths)
            return posture.rotations[:, number], posture.origins[:, number]

        return motion

    parent = MODEL.parents[SEGMENTS.index(segment)]
    imu = SimulatedImu("imu", segment, usual_mounting(segment, person.stature), errors=CONSUMER)
    samples = imu.samples(of(segment), 20.0, START_NS, rng, parent=of(SEGMENTS[parent]) if parent >= 0 else None)
    world = so3.quat_to_matrix(samples.truth.quat_xyzw)
    mean = rotated(world, samples.linear_acceleration).mean(axis=0)
    assert_allclose(mean, STANDARD_GRAVITY * UP, atol=0.6)
    bone = so3.matrix_to_quat(of(segment)(samples.truth.times)[0])
    on_bone = so3.quat_multiply(so3.quat_inverse(bone), samples.truth.quat_xyzw)
    off = np.degrees(
        np.linalg.norm(so3.log(so3.quat_multiply(on_bone, so3.quat_inverse(samples.truth.mounting_xyzw))), axis=1)
    )
    assert 0.3 < off.max() < 40.0


@pytest.mark.parametrize(
    "changes",
    [
        {"gyro_noise": -0.1},
        {"acc_bias": float("nan")},
        {"lost": 1.5},
        {"packet": 2.5},
        {"packet": True},
        {"tilt_time": "3"},
        {"tissue_frequency": 100.0},
    ],
)
def test_errors_out_of_range_are_named(changes: dict[str, object]) -> None:
    (name,) = changes
    with pytest.raises(ImuSimulationError, match=name):
        ImuErrors(**changes)  # type: ignore[arg-type]


def test_impossible_sensors_are_refused() -> None:
    mounting = usual_mounting("head")
    with pytest.raises(ImuSimulationError, match="segment 'tail'"):
        SimulatedImu("imu", "tail", mounting)
    with pytest.raises(ImuSimulationError, match="rate of 0"):
        SimulatedImu("imu", "head", mounting, rate_hz=0.0)
