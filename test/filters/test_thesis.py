"""The thesis's linear filters are algorithm 1 with eq. 5.11 and 5.12 as published, and survive what sensors do."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from body_tracking.filters import make_filter
from body_tracking.filters.linear import FilterError
from body_tracking.filters.thesis import THESIS_LKF1, THESIS_LKF2, ThesisLkf1, ThesisLkf2, ThesisLkfParameters
from body_tracking.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState

FRAME_NS = NANOSECONDS // 30
TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
BODY = np.random.default_rng(0).normal(size=(N_JOINTS, 3)) * 0.4 + [2.0, 0.0, 0.0]

DT = 1.0 / 30.0
Q, R = 0.005, 0.001
# Eq. 5.11 and 5.12 as they are printed.
F1 = H1 = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
F2 = np.array(
    [
        [1.0, 0.0, 0.0, DT, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, DT, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, DT],
        [0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    ]
)
H2 = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
MODELS = {THESIS_LKF1: (F1, H1), THESIS_LKF2: (F2, H2)}

both = pytest.mark.parametrize("name", MODELS)


def made(name: str, **parameters: float) -> ThesisLkf1 | ThesisLkf2:
    result = make_filter(name, **parameters)
    assert isinstance(result, ThesisLkf1 | ThesisLkf2)
    return result


def skeleton(
    number: int, positions: FloatArray = BODY, states: np.ndarray = TRACKED, frame_id: str = "world"
) -> Skeleton:
    return Skeleton(number * FRAME_NS, frame_id, positions.copy(), states.copy())


def walk(rng: np.random.Generator, frames: int) -> FloatArray:
    """(frames, 25, 3) metres: a random walk with noise."""
    steps = rng.normal(size=(frames, N_JOINTS, 3))
    return BODY + 0.01 * steps.cumsum(axis=0) + 0.01 * rng.normal(size=steps.shape)


@both
def test_it_equals_25_filterpy_filters_with_the_matrices_of_the_thesis(name: str) -> None:
    """Joints that come and go; every state and covariance to 1e-11."""
    rng = np.random.default_rng(1)
    tracker = made(name)
    F, H = MODELS[name]
    singles = [KalmanFilter(dim_x=len(F), dim_z=3) for _ in range(N_JOINTS)]
    begun = np.zeros(N_JOINTS, dtype=bool)
    for k, seen in enumerate(walk(rng, 60), start=1):
        states = rng.choice(np.arange(3, dtype=np.uint8), N_JOINTS, p=[0.3, 0.2, 0.5])
        result = tracker.update(skeleton(k, seen, states))
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
    # what a step of the measurement moves is the gain
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
def test_rigid_motions_commute_with_it(name: str) -> None:
    """The three axes are filtered alike, so the choice of the fixed frame does not matter."""
    rng = np.random.default_rng(2)
    turn, shift = Rotation.random(random_state=3).as_matrix(), np.array([1.0, -2.0, 0.5])
    here, there = made(name), made(name)
    for k, seen in enumerate(walk(rng, 30), start=1):
        first, second = here.update(skeleton(k, seen)), there.update(skeleton(k, seen @ turn.T + shift))
        assert first is not None and second is not None
        assert_allclose(second.positions, first.positions @ turn.T + shift, atol=1e-12)


@both
def test_every_frame_is_one_step_whatever_its_stamp_says(name: str) -> None:
    rng = np.random.default_rng(4)
    even, uneven = made(name), made(name)
    stamp = 1
    for k, seen in enumerate(walk(rng, 30), start=1):
        stamp += int(rng.integers(1, 10 * NANOSECONDS))
        even.update(skeleton(k, seen))
        uneven.update(Skeleton(stamp, "world", seen, TRACKED))
        assert_array_equal(uneven.s, even.s)
        assert_array_equal(uneven.P, even.P)


@both
def test_stamps_repeat_come_late_and_jump(name: str) -> None:
    tracker = made(name)
    for k in range(100, 110):
        assert tracker.update(skeleton(k)) is not None
    s = tracker.s
    assert tracker.update(skeleton(109, BODY + 1.0)) is None
    assert tracker.update(skeleton(107, BODY + 1.0)) is None
    assert_array_equal(tracker.s, s)
    for moved in (skeleton(1, BODY + 1.0), skeleton(2, BODY - 1.0, frame_id="map")):
        moved.states[Joint.HEAD] = TrackingState.NOT_TRACKED
        result = tracker.update(moved)
        assert result is not None and result.covariances is not None
        assert_array_equal(result.states, moved.states)  # nothing is left of before: the head is not predicted
        assert_array_equal(result.positions[moved.valid], moved.positions[moved.valid])
    assert tracker.counters == {
        "measured": 10 * N_JOINTS + 2 * (N_JOINTS - 1),
        "predicted": 0,
        "frames": 12,
        "repeated_stamps": 1,
        "late_frames": 1,
        "backward_jumps": 1,
        "gaps": 0,
        "frame_changes": 1,
    }


@both
def test_it_says_nothing_before_it_knows_a_joint_and_after_a_reset(name: str) -> None:
    nobody = np.zeros(N_JOINTS, dtype=np.uint8)
    tracker = made(name)
    assert tracker.update(skeleton(1, states=nobody)) is None
    assert tracker.update(skeleton(2)) is not None
    tracker.reset()
    assert tracker.update(skeleton(1, states=nobody)) is None
    assert tracker.counters["backward_jumps"] == 0


@both
def test_a_joint_that_was_hidden_for_long_is_known_as_well_as_its_measurement(name: str) -> None:
    """(I - K H) P as it is printed would lose its digits, and be wrong by orders of magnitude."""
    tracker = made(name, process_noise=1e4, measurement_noise=1e-8)
    hidden = np.where(np.arange(N_JOINTS) % 2, TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8)
    tracker.update(skeleton(1))
    for k in range(2, 2000):
        tracker.update(skeleton(k, states=hidden))
    for k in range(2000, 2005):
        result = tracker.update(skeleton(k))
        assert result is not None and result.covariances is not None
        assert_allclose(result.covariances, np.tile(1e-8 * np.eye(3), (N_JOINTS, 1, 1)), rtol=1e-3, atol=1e-12)
        assert_allclose(result.positions, BODY, atol=1e-9)


def test_unusable_parameters_are_refused() -> None:
    assert {item.name for item in fields(ThesisLkfParameters)} == {
        "process_noise",
        "measurement_noise",
        "initial_variance",
        "time_step",
        "reorder_window",
    }
    for item in fields(ThesisLkfParameters):
        for wrong in (-1.0, float("nan"), float("inf")):
            with pytest.raises(FilterError, match=item.name):
                ThesisLkfParameters(**{item.name: wrong})
