"""The thesis's linear filters are algorithm 1 with eq. 5.11 and 5.12 as published, and survive faults of sensors."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_discrete_are

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.filters import make_filter
from body_tracking.filters.thesis import THESIS_LKF1, THESIS_LKF2, ThesisLkf1, ThesisLkf2
from walkers import TRACKED

FRAME_NS = NANOSECONDS // 30
BODY = np.random.default_rng(0).normal(size=(N_JOINTS, 3)) * 0.4 + [2.0, 0.0, 0.0]

DT = 1.0 / 30.0
Q, R = 0.005, 0.001
# Eq. 5.11 and 5.12 as they are printed.
F1 = H1 = np.eye(3)
F2 = np.eye(6) + DT * np.eye(6, k=3)
H2 = np.eye(3, 6)
MODELS = {THESIS_LKF1: (F1, H1), THESIS_LKF2: (F2, H2)}

both = pytest.mark.parametrize("name", MODELS)


def made(name: str, **parameters: float) -> ThesisLkf1 | ThesisLkf2:
    result = make_filter(name, **parameters)
    assert isinstance(result, ThesisLkf1 | ThesisLkf2)
    return result


def skeleton(number: int, positions: FloatArray = BODY, states: np.ndarray = TRACKED) -> Skeleton:
    return Skeleton(number * FRAME_NS, "world", positions.copy(), states.copy())


def walk(rng: np.random.Generator, frames: int) -> FloatArray:
    """(frames, 25, 3) metres: a random walk with noise."""
    steps = rng.normal(size=(frames, N_JOINTS, 3))
    return BODY + 0.01 * steps.cumsum(axis=0) + 0.01 * rng.normal(size=steps.shape)


@both
def test_it_equals_25_filterpy_filters_with_the_matrices_of_the_thesis(name: str) -> None:
    """Joints that come and go; every state and covariance to 1e-11, and every frame is one step whatever its stamp."""
    rng = np.random.default_rng(1)
    tracker = made(name)
    F, H = MODELS[name]
    singles = [KalmanFilter(dim_x=len(F), dim_z=3) for _ in range(N_JOINTS)]
    begun = np.zeros(N_JOINTS, dtype=bool)
    stamps = rng.integers(1, 10 * NANOSECONDS, 60).cumsum().tolist()
    for stamp_ns, seen in zip(stamps, walk(rng, 60), strict=True):
        states = rng.choice(np.arange(3, dtype=np.uint8), N_JOINTS, p=[0.3, 0.2, 0.5])
        result = tracker.update(Skeleton(stamp_ns, "world", seen, states))
        assert result is not None and result.covariances is not None and result.velocities is not None
        for joint, single in enumerate(singles):
            if begun[joint]:
                single.predict()
                single.update(seen[joint] if states[joint] else None)
            elif states[joint]:
                single.F, single.H, single.Q, single.R = F, H, Q * np.eye(len(F)), R * np.eye(3)
                single.x = np.concatenate([seen[joint], np.zeros(len(F) - 3)])[:, None]
                single.P = 0.001 * np.eye(len(F))
                begun[joint] = True
        x, P = np.array([single.x[:, 0] for single in singles]), np.array([single.P for single in singles])
        assert_allclose(tracker.s[begun], x[begun], rtol=0, atol=1e-11)
        assert_allclose(tracker.P[begun], P[begun], rtol=0, atol=1e-11)
        assert_array_equal(result.positions[begun], tracker.s[begun, :3])
        assert_array_equal(result.covariances[begun], tracker.P[begun, :3, :3])
        if name == THESIS_LKF2:
            assert_array_equal(result.velocities[begun], tracker.s[begun, 3:])
        else:
            assert np.isnan(result.velocities).all()
        assert_array_equal(result.states, np.where(~begun, 0, np.where(states > 0, states, TrackingState.INFERRED)))
        assert np.isnan(result.positions[~begun]).all() and (result.covariances[~begun, 0, 0] == np.inf).all()
    assert begun.all()


@both
def test_the_gain_settles_where_the_riccati_equation_says(name: str) -> None:
    tracker = made(name)
    F, H = MODELS[name]
    prior = solve_discrete_are(F.T, H.T, Q * np.eye(len(F)), R * np.eye(3))
    gain = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R * np.eye(3))
    for k in range(1, 400):
        tracker.update(skeleton(k))
    assert_allclose(tracker.P, np.tile((np.eye(len(F)) - gain @ H) @ prior, (N_JOINTS, 1, 1)), rtol=1e-9, atol=1e-15)
    # the response to a unit step of the measurement is the gain
    before = tracker.s
    tracker.update(skeleton(400, BODY + [1.0, 0.0, 0.0]))
    assert_allclose(tracker.s - before @ F.T, np.tile(gain[:, 0], (N_JOINTS, 1)), atol=1e-9)
    if name == THESIS_LKF1:
        variance = 0.5 * (Q + np.sqrt(Q**2 + 4.0 * Q * R))
        assert_allclose(gain, variance / (variance + R) * np.eye(3), atol=1e-12)


@both
def test_without_a_measurement_the_model_alone_goes_on(name: str) -> None:
    """Eq. 5.21 and 5.22, exactly, for any time, and whatever the reason for which a joint is missing."""
    tracker = made(name)
    F, _ = MODELS[name]
    velocity = np.linspace(-1.0, 1.0, 3 * N_JOINTS).reshape(N_JOINTS, 3)
    for k in range(1, 60):
        tracker.update(skeleton(k, BODY + k * DT * velocity))
    last = s = tracker.s
    P = tracker.P
    never = np.zeros(N_JOINTS, dtype=np.uint8)
    missing = [skeleton(0, BODY, never), *(skeleton(0, seen) for seen in (BODY * np.nan, BODY * np.inf, BODY + 1e6))]
    for k in range(60, 360):
        frame = missing[k % len(missing)]
        result = tracker.update(skeleton(k, frame.positions, frame.states))
        s, P = s @ F.T, F @ P @ F.T + Q * np.eye(len(F))
        assert_allclose(tracker.s, s, rtol=1e-13, atol=1e-13)
        assert_allclose(tracker.P, P, rtol=1e-13, atol=1e-13)
        assert result is not None and (result.states == TrackingState.INFERRED).all()
    # ten seconds later LKF1 has each joint where it was, LKF2 as far away as it moves in that time
    moved = 10.0 * last[:, 3:] if name == THESIS_LKF2 else 0.0
    assert_allclose(tracker.s[:, :3], last[:, :3] + moved, atol=1e-9)


@both
def test_a_joint_that_was_hidden_for_long_is_known_as_well_as_its_measurement(name: str) -> None:
    """(I - K H) P as it is printed would lose its digits, and be wrong by orders of magnitude."""
    tracker = made(name, process_noise=1e4, measurement_noise=1e-8)
    hidden = np.where(np.arange(N_JOINTS) % 2, TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8)
    tracker.update(skeleton(1))
    for k in range(2, 500):
        tracker.update(skeleton(k, states=hidden))
    for k in range(500, 505):
        result = tracker.update(skeleton(k))
        assert result is not None and result.covariances is not None
        assert_allclose(result.covariances, np.tile(1e-8 * np.eye(3), (N_JOINTS, 1, 1)), rtol=1e-3, atol=1e-12)
        assert_allclose(result.positions, BODY, atol=1e-9)
