"""Laws of limited motion, for any targets and any steps of time."""

from __future__ import annotations

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from body_tracking.robot.limiter import Limiter
from draws import draws

LOWER, UPPER = np.array([-1.0, 0.0, -0.1]), np.array([2.0, 1.0, 0.1])
RATE, ACCELERATION = np.array([1.5, 3.0, 10.0]), np.array([8.0, np.inf, 4.0])
HOME = np.array([0.0, 0.5, 0.0])

BRIEFLY = settings(max_examples=draws(12, 40), deadline=None, suppress_health_check=[HealthCheck.too_slow])
times = st.floats(1e-4, 0.05)
targets = st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3).map(np.array)
moves = st.lists(st.tuples(targets, times, st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=60)


def limiter() -> Limiter:
    return Limiter(LOWER, UPPER, RATE, ACCELERATION, HOME)


@BRIEFLY
@given(moves)
def test_never_beyond_a_limit_of_position_rate_or_acceleration(
    steps: list[tuple[np.ndarray, float, float, bool]],
) -> None:
    joints = limiter()
    before, speed = HOME, np.zeros(3)
    for target, dt, share, brake in steps:
        after = (joints.brake(dt) if brake else joints.step(target, dt, share)).copy()
        assert (after >= LOWER).all()
        assert (after <= UPPER).all()
        now = (after - before) / dt
        assert (np.abs(now) <= RATE * (1.0 + 1e-9) + 1e-9).all()
        assert (np.abs(now - speed) <= ACCELERATION * dt * (1.0 + 1e-6) + 1e-9).all()
        before, speed = after, now


@BRIEFLY
@given(targets, st.lists(st.floats(0.01, 0.05), min_size=1, max_size=5))
def test_it_gets_where_it_may_without_overshooting(target: np.ndarray, pattern: list[float]) -> None:
    joints = limiter()
    reached = np.clip(target, LOWER, UPPER)
    direction = np.sign(reached - HOME)
    elapsed = 0.0
    while elapsed < 4.0:
        for dt in pattern:
            joints.step(target, dt)
            elapsed += dt
            assert (direction * (reached - joints.position) >= -1e-9).all()
    np.testing.assert_allclose(joints.position, reached, atol=1e-3)


@BRIEFLY
@given(moves)
def test_it_comes_to_rest_within_the_rate_over_the_acceleration(
    steps: list[tuple[np.ndarray, float, float, bool]],
) -> None:
    joints = limiter()
    for target, dt, _, _ in steps:
        joints.step(target, dt)
    joints.brake(float((RATE / ACCELERATION).max()))
    np.testing.assert_allclose(joints.velocity, 0.0, atol=1e-9)


def test_no_time_no_motion() -> None:
    joints = limiter()
    np.testing.assert_array_equal(joints.step(UPPER, 0.0), HOME)


def test_a_start_beyond_a_limit_is_clipped_to_it() -> None:
    joints = limiter()
    joints.step(UPPER, 0.01)
    joints.reset(UPPER + 0.2)
    np.testing.assert_array_equal(joints.position, UPPER)
    np.testing.assert_array_equal(joints.velocity, 0.0)
