"""A clock's offset is estimated from turning rates, with a consistent deviation, if the motion determines it."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.calibration.clock_correlation import Series
from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.clock import clock_offset, turning, turning_of_bone, turning_of_sensor
from draws import draws


def moved(times: FloatArray, seed: int) -> FloatArray:
    """(n, 3) rad/s of somebody who moves now and then: waves of 0.2 to 1.5 Hz, taken up and given back."""
    rng = np.random.default_rng(seed)
    frequencies, phases = rng.uniform(0.2, 1.5, (3, 4)), rng.uniform(0.0, 6.3, (3, 4))
    waves = np.sin(2.0 * np.pi * times[:, None, None] * frequencies + phases).sum(axis=-1)
    pace = np.interp(
        times, np.arange(0.0, times[-1] + 4.0, 2.0), rng.uniform(0.0, 1.0, len(np.arange(0.0, times[-1] + 4.0, 2.0)))
    )
    return pace[:, None] * waves


def both(seed: int, offset: float, seconds: float = 60.0, noise: float = 0.1, drift: float = 0.0) -> list[Series]:
    """The same turning in two clocks, in two frames, with white and with slowly varying errors."""
    rng = np.random.default_rng(seed)
    result = []
    for rate, own, pace in ((100.0, 0.0, 0.0), (50.0, offset, drift)):
        times = np.sort(np.arange(0.0, seconds, 1.0 / rate) + rng.uniform(0.0, 0.3 / rate, round(seconds * rate)))
        frame = so3.quat_to_matrix(so3.exp(rng.normal(size=3)))
        slow = np.stack(
            [
                np.interp(
                    times, np.arange(0.0, seconds + 1.0, 0.3), rng.normal(size=len(np.arange(0.0, seconds + 1.0, 0.3)))
                )
                for _ in range(3)
            ],
            axis=-1,
        )
        rates = moved(times, seed + 1) + noise * (slow + rng.normal(size=(len(times), 3)))
        result.append(turning_of_sensor(times * (1.0 + pace) + own, rates @ frame.T))
    return result


@settings(max_examples=draws(2, 8))
@given(st.floats(-55.0, 55.0), st.integers(0, 2**31))
def test_an_offset_of_up_to_a_minute_is_found_or_refused_but_never_wrong(offset: float, seed: int) -> None:
    found = clock_offset(*both(seed, offset, 90.0))
    if found is not None:
        assert found.offset == pytest.approx(offset, abs=0.02)


def test_the_deviation_is_that_of_the_errors_and_most_offsets_are_found() -> None:
    count = draws(5, 12)
    found = [clock_offset(*both(seed, 3.7, 60.0, 0.2)) for seed in range(count)]
    errors = np.array([(each.offset - 3.7) / each.stddev for each in found if each is not None])
    assert len(errors) >= 0.8 * count
    assert (np.abs(errors) < 1.96).mean() >= 0.85
    assert np.sqrt((errors**2).mean()) > 0.2


def test_a_drift_is_found_and_stamps_are_carried_back() -> None:
    found = clock_offset(*both(5, -2.0, 200.0, 0.05, 300e-6))
    assert found is not None
    assert abs(found.drift_ppm - 300.0) < 3.0 * found.drift_stddev_ppm
    assert found.drift_stddev_ppm < 100.0
    for time in (20.0, 180.0):
        shown_ns = round((time * (1.0 + 300e-6) - 2.0) * NANOSECONDS)
        assert found.to_reference(shown_ns) / NANOSECONDS == pytest.approx(time, abs=0.02)


def test_stillness_and_periodic_motion_determine_no_offset() -> None:
    times = np.arange(0.0, 40.0, 0.01)
    rng = np.random.default_rng(0)
    noise = [np.abs(0.01 * rng.normal(size=len(times))) for _ in range(2)]
    assert clock_offset(turning(times, noise[0]), turning(times, noise[1])) is None
    swing = 1.0 + np.sin(2.0 * np.pi * times / 1.5)
    assert clock_offset(turning(times, swing + noise[0]), turning(times + 0.4, swing + noise[1])) is None


def test_the_motions_of_two_people_determine_no_offset() -> None:
    times = np.arange(0.0, 60.0, 0.01)
    rates = [np.linalg.norm(moved(times, seed), axis=1) for seed in range(draws(5, 8))]
    pairs = [(a, b) for a in range(len(rates)) for b in range(a)]
    found = [clock_offset(turning(times, rates[a]), turning(times, rates[b])) for a, b in pairs]
    assert sum(each is not None for each in found) <= 1


def test_a_camera_sees_the_same_turning_of_a_bone() -> None:
    step = 0.001
    times = np.arange(0.0, 40.0, step)
    rates = moved(times, 3)
    quats = np.empty((len(times), 4))
    quats[0] = (0.0, 0.0, 0.0, 1.0)
    steps = so3.exp(step * rates)
    for n in range(1, len(times)):
        quats[n] = so3.quat_multiply(quats[n - 1], steps[n - 1])
    axis = np.array([0.0, 0.6, -0.8])
    bone = 0.28 * (so3.quat_to_matrix(quats[::33]) @ axis)
    bone += 0.005 * np.random.default_rng(1).normal(size=bone.shape)
    camera = turning_of_bone(times[::33] - 1.25, bone)
    found = clock_offset(turning_of_sensor(times[::10], rates[::10], axis), camera)
    assert found is not None
    assert found.offset == pytest.approx(-1.25, abs=0.02)
    assert abs(found.offset + 1.25) < 3.5 * found.stddev


def test_two_sensors_of_a_real_arm_are_11_03_s_apart(shared_data: Path) -> None:
    path = shared_data / "imu/two_arm_imus/data8_onArmAbductionFromTposeAndBack.csv.gz"
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    with gzip.open(path, "rt") as file:
        numbers = np.genfromtxt(file, delimiter=",", skip_header=1)
    one, two = (turning_of_sensor(numbers[:, n], np.radians(numbers[:, n + 1 : n + 4])) for n in (0, 20))
    found = clock_offset(one, two)
    assert found is not None
    assert found.offset == pytest.approx(11.03, abs=0.02)
    assert abs(found.offset - 11.03) < 2.0 * found.stddev
