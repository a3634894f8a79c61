"""Clocks convert back and forth; the reference pose has the axes that REP-103 asks for."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from body_tracking.calibration.result import ClockModel, KnownClock, level_pose
from body_tracking.skeleton import NANOSECONDS

STAMPS = st.integers(0, 2_000_000_000 * NANOSECONDS)


@given(
    STAMPS,
    st.integers(-2_000_000_000, 2_000_000_000),
    st.floats(-500, 500),
    st.integers(0, 3600 * NANOSECONDS),
)
def test_a_clock_converts_back_and_forth_to_a_nanosecond(anchor: int, offset: int, drift: float, elapsed: int) -> None:
    """Without drift exactly, even since an epoch."""
    clock = ClockModel(offset, drift, anchor)
    assert abs(clock.to_reference(clock.to_sensor(anchor + elapsed)) - (anchor + elapsed)) <= 1
    assert ClockModel(offset, 0.0, 0).to_reference(anchor + offset) == anchor


def test_a_fast_clock_runs_ahead() -> None:
    clock = ClockModel(2 * NANOSECONDS, 100.0, 0)
    assert clock.to_sensor(10 * NANOSECONDS) == 12 * NANOSECONDS + 1_000_000
    assert clock.offset == 2.0


@given(STAMPS, STAMPS, STAMPS, st.integers(-2_000_000_000, 2_000_000_000), st.floats(-500, 500))
def test_a_clock_is_the_same_by_its_offset_at_another_time(
    anchor: int, other: int, at: int, offset: int, drift: float
) -> None:
    clock = ClockModel(offset, drift, anchor)
    moved = clock.anchored_at(other)
    assert moved.anchor_ns == other
    # of the product of drift and some decades a float keeps a microsecond
    assert abs(moved.to_sensor(at) - clock.to_sensor(at)) <= 1000


def test_a_clock_is_known_the_worse_the_longer_ago_it_was() -> None:
    known = KnownClock(ClockModel(10**9, 20.0, 0), 0.003, 4.0)
    later_ns = 1000 * NANOSECONDS
    assert known.stddev_at(later_ns) == np.hypot(0.003, 0.004)
    carried = known.carried_to(later_ns, 3.0)
    assert carried.model == known.model.anchored_at(later_ns)
    assert carried.drift_stddev_ppm == 5.0
    assert carried.stddev == np.hypot(0.003, 0.005)
    assert KnownClock().stddev_at(later_ns) == np.inf


def test_the_reference_sensor_looks_along_x_with_z_up() -> None:
    pose = level_pose("kinect1", height=0.9)
    assert_allclose(pose.apply(np.array([0.0, 0.0, 2.0])), [2.0, 0.0, 0.9], atol=1e-12)  # forward
    assert_allclose(pose.apply(np.array([1.0, 0.0, 0.0])), [0.0, -1.0, 0.9], atol=1e-12)  # right
    assert_allclose(pose.apply(np.array([0.0, 1.0, 0.0])), [0.0, 0.0, -0.1], atol=1e-12)  # down
    ahead = level_pose("kinect1", pitch=0.3).apply(np.array([0.0, 0.0, 2.0]))  # looks down: at the floor ahead
    assert_allclose(ahead, [2.0 * np.cos(0.3), 0.0, -2.0 * np.sin(0.3)], atol=1e-12)
    assert level_pose("kinect1", roll=0.2).apply(np.array([1.0, 0.0, 0.0]))[2] < 0.0  # clockwise: its right is lower
