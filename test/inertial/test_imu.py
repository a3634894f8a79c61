"""Readings of inertial sensors: an invalid one raises an error, problems of many readings are reported once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from body_tracking.core.imu import (
    FRAME_CHANGED,
    GRAVITY_MISSING,
    IN_DEGREES,
    IN_G,
    STANDARD_GRAVITY,
    WRONG_FORCE,
    ImuSample,
    ImuSampleError,
    ImuWatch,
    check_magnetic_field,
)
from body_tracking.core.skeleton import NANOSECONDS, FloatArray

UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def of(**quantities: FloatArray) -> ImuSample:
    return ImuSample(0, "imu_link", **quantities)


@given(arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)), st.floats(-0.009, 0.009))
def test_a_quaternion_that_is_slightly_off_is_normalised(quat_xyzw: FloatArray, off: float) -> None:
    norm = np.linalg.norm(quat_xyzw)
    if norm < 0.1:
        return
    sample = of(orientation=(1.0 + off) * quat_xyzw / norm)
    assert sample.orientation is not None
    np.testing.assert_allclose(sample.orientation, quat_xyzw / norm, atol=1e-12)


@pytest.mark.parametrize(
    ("quantities", "text"),
    [
        ({"orientation": np.zeros(4)}, "zero quaternion"),
        ({"orientation": np.array([0.0, 0.0, 0.0, 1.5])}, r"not normalised: its norm is 1\.5"),
        ({"orientation": np.array([0.0, np.nan, 0.0, 1.0])}, r"orientation \(0, nan, 0, 1\): not finite"),
        ({"orientation": np.zeros(3)}, r"shape \(3,\)"),
        ({"orientation_covariance": np.diag([1.0, -0.5, 1.0])}, "variance of -0.5"),
        ({"orientation_covariance": np.full((3, 3), np.inf)}, "covariance: not finite"),
        ({"orientation_covariance": np.eye(3) + np.eye(3, k=1)}, "not symmetric"),
        ({"orientation_covariance": np.eye(2)}, r"shape \(2, 2\)"),
        ({"angular_velocity": np.array([0.0, np.inf, 0.0])}, "angular velocity .*: not finite"),
        ({"angular_velocity": np.array([200.0, 0.0, 0.0])}, "200 rad/s, beyond 75: deg/s?"),
        ({"acceleration": np.array([np.nan, 0.0, 0.0])}, "acceleration .*: not finite"),
        ({"acceleration": np.array([0.0, 0.0, 9806.65])}, "mg?"),
        ({"magnetic_field": np.array([20.0, 0.0, -40.0])}, "microtesla or gauss?"),
        ({"magnetic_field": np.array([0.2, 0.0, -0.4])}, "microtesla or gauss?"),
    ],
)
def test_impossible_readings_are_errors(quantities: dict[str, FloatArray], text: str) -> None:
    with pytest.raises(ImuSampleError, match=text) as error:
        of(**quantities)
    assert "\n" not in str(error.value)


def test_a_sample_needs_a_frame_and_nothing_else_and_the_earths_field_is_allowed() -> None:
    assert ImuSample(5, "imu_link").orientation is None
    with pytest.raises(ImuSampleError, match="frame_id"):
        ImuSample(5, "")
    check_magnetic_field(np.array([20e-6, 0.0, -45e-6]))


# --- over time


def arm(
    seconds: float = 12.0, gravity: float = STANDARD_GRAVITY, force: float = 1.0, rate: float = 1.0, hertz: float = 50.0
) -> Iterator[ImuSample]:
    """An arm swings to and fro by 60 degrees about a horizontal axis, in whichever units."""
    for k in range(round(seconds * hertz)):
        t = k / hertz
        angle = np.radians(60.0) * np.sin(2.0 * t)
        speed = np.radians(60.0) * 2.0 * np.cos(2.0 * t)
        specific_force = np.array([gravity * np.sin(angle), 0.3 * speed**2, gravity * np.cos(angle)])
        yield ImuSample(
            round(t * NANOSECONDS),
            "imu_link",
            angular_velocity=rate * np.array([0.0, -speed, 0.0]),
            acceleration=force * specific_force,
        )


def said(samples: Iterator[ImuSample]) -> list[str]:
    watch = ImuWatch()
    lines = [line for sample in samples for line in watch.add(sample)]
    assert tuple(lines) == watch.problems
    return lines


@pytest.mark.parametrize("hertz", [25.0, 100.0, 400.0])
def test_a_sensor_in_order_has_no_problems(hertz: float) -> None:
    assert said(arm(hertz=hertz)) == []


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        ({"gravity": 0.0}, GRAVITY_MISSING),
        ({"force": 1.0 / STANDARD_GRAVITY}, IN_G),
        ({"force": 100.0}, WRONG_FORCE),
        ({"rate": 180.0 / np.pi / 3.0, "force": 1.0}, IN_DEGREES),
    ],
)
def test_problems_of_many_readings_are_reported_once_also_when_a_replay_restarts(
    wrong: dict[str, float], kind: str
) -> None:
    (line,) = said(each for _ in range(2) for each in arm(**wrong))
    assert line.startswith(kind)


def test_two_sensors_under_one_name_are_told_apart() -> None:
    watch = ImuWatch()
    lines = [line for k in range(6) for line in watch.add(ImuSample(k, f"imu{k % 2}_link", acceleration=UP))]
    assert lines == [f"{FRAME_CHANGED}: 'imu0_link' and 'imu1_link'"]
