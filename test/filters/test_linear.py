"""The linear Kalman filters obey Kalman's equations, and survive faults of sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm
from scipy.stats import chi2

from body_tracking.core.skeleton import BONES, N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.filters.linear import (
    CONSTANT_VELOCITY,
    LINEAR_MODELS,
    ZERO_VELOCITY,
    LinearKalmanFilter,
)
from body_tracking.filters.parameters import LinearKalmanParameters
from body_tracking.kinematics.motion import joint_densities
from draws import draws
from walkers import TRACKED

FRAME_NS = NANOSECONDS // 30
BODY = np.random.default_rng(0).normal(size=(N_JOINTS, 3)) * 0.4 + [2.0, 0.0, 0.0]


def skeleton(
    stamp_ns: int,
    positions: FloatArray = BODY,
    states: np.ndarray = TRACKED,
    covariances: FloatArray | None = None,
    **other: object,
) -> Skeleton:
    return replace(Skeleton(stamp_ns, "world", positions.copy(), states.copy(), 0, covariances), **other)


def covariances_of(rng: np.random.Generator, scale: float = 0.01) -> FloatArray:
    factor = rng.normal(size=(N_JOINTS, 3, 3)) * scale
    return factor @ factor.swapaxes(1, 2) + scale**2 * np.eye(3)


INWARDS = {int(child): int(parent) for parent, child in BONES}


def white_noise_through(feedback: float, density: float, step: float) -> FloatArray:
    """(6, 6) covariance of position and velocity after white acceleration on v' = feedback v (Van Loan 1978)."""
    drift = np.array([[0.0, 1.0], [0.0, feedback]])
    both = np.block([[-drift, np.diag([0.0, density])], [np.zeros((2, 2)), drift.T]])
    grown = expm(both * step)
    return np.asarray(np.kron(grown[2:, 2:].T @ grown[:2, 2:], np.eye(3)))


def run(
    filtered: LinearKalmanFilter, positions: FloatArray, step_ns: int = FRAME_NS, start_ns: int = 1
) -> list[Skeleton]:
    """The filter over (n, 25, 3) positions."""
    results = [filtered.update(skeleton(start_ns + k * step_ns, frame)) for k, frame in enumerate(positions)]
    assert all(result is not None for result in results)
    return [result for result in results if result is not None]


@pytest.mark.parametrize("model", LINEAR_MODELS)
def test_it_equals_25_independent_filterpy_filters(model: str) -> None:
    """Random covariances, uneven time steps, joints that come and go; every state and covariance to 1e-11."""
    rng = np.random.default_rng(1)
    parameters = LinearKalmanParameters(white_noise_share=1.0, gate_probability=1.0, predict_for=60.0, adaptation=0.0)
    stacked = LinearKalmanFilter(model, parameters)
    order = 2 if model == CONSTANT_VELOCITY else 1
    names = ("trunk", "limb", "extremity")
    kind = "acceleration" if order == 2 else "velocity"
    densities = joint_densities(tuple(getattr(parameters, f"{kind}_density_{name}") for name in names))

    singles = [KalmanFilter(dim_x=3 * order, dim_z=3) for _ in range(N_JOINTS)]
    stamp_ns, position = 1, BODY.copy()
    seen_before = np.ones(N_JOINTS, dtype=bool)
    for frame in range(draws(20, 120)):
        step = 0.0 if frame == 0 else float(rng.uniform(0.01, 0.2))
        stamp_ns += round(step * NANOSECONDS)
        step = round(step * NANOSECONDS) / NANOSECONDS
        position = position + rng.normal(size=position.shape) * 0.02
        noise = covariances_of(rng)
        states = np.where(rng.random(N_JOINTS) < 0.8, TrackingState.TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8)
        if frame == 0:
            states = TRACKED
        seen = np.where(states[:, None] > 0, position, np.nan)
        result = stacked.update(skeleton(stamp_ns, seen, states, noise))
        assert result is not None and result.covariances is not None and result.velocities is not None
        sure = (states > 0) & seen_before  # neither missing now nor before
        seen_before = states > 0
        last = np.stack([single.x[-3:] for single in singles])
        carriers = list(range(N_JOINTS))
        for joint, single in enumerate(singles):
            if frame == 0:
                single.x = np.zeros((3 * order, 1))
                single.x[:3, 0] = seen[joint]
                single.P = np.diag([0.0] * 3 + [parameters.initial_velocity_stddev**2] * (3 * order - 3))
                single.P[:3, :3] = noise[joint]
                single.H = np.eye(3, 3 * order)
            else:
                single.F = np.eye(3 * order)
                single.Q = densities[joint] * step * np.eye(3)
                if order == 2:
                    single.F[:3, 3:] = step * np.eye(3)
                    single.Q = Q_continuous_white_noise(2, step, densities[joint], 3, order_by_dim=False)
                while order == 2 and not sure[carriers[joint]] and carriers[joint] in INWARDS:
                    carriers[joint] = INWARDS[carriers[joint]]
                control = None
                if carriers[joint] != joint:
                    rate = densities[joint] / (2.0 * parameters.initial_velocity_stddev**2)
                    single.F = expm(np.kron([[0.0, 1.0], [0.0, -rate]], np.eye(3)) * step)
                    control = np.eye(6, 3) * step + (np.eye(6) - single.F)[:, 3:]
                    single.Q = white_noise_through(-rate, densities[joint], step)
                single.predict(u=last[carriers[joint]], B=control)
                single.update(seen[joint] if states[joint] else None, R=noise[joint])
        carried = [joint for joint in range(N_JOINTS) if carriers[joint] != joint and not states[joint]]
        for joint, by in [(joint, singles[carriers[joint]]) for joint in carried]:
            singles[joint].x = singles[joint].x + (by.x - by.x_prior)
        for joint, single in enumerate(singles):
            assert_allclose(result.positions[joint], single.x[:3, 0], rtol=0, atol=1e-11)
            assert_allclose(result.covariances[joint], single.P[:3, :3], rtol=0, atol=1e-11)
            velocity = single.x[3:, 0] if order == 2 else np.full(3, np.nan)
            assert_allclose(result.velocities[joint], velocity, rtol=0, atol=1e-11, equal_nan=True)


@pytest.mark.parametrize("model", LINEAR_MODELS)
@given(split=st.floats(0.05, 0.95), step_ms=st.integers(10, 400))
@settings(max_examples=draws(10, 25))
def test_two_part_steps_of_prediction_equal_the_whole(model: str, split: float, step_ms: int) -> None:
    whole, parts = (LinearKalmanFilter(model, LinearKalmanParameters(predict_for=10.0)) for _ in range(2))
    missing = np.zeros(N_JOINTS, dtype=np.uint8)
    velocity = np.linspace(-1.0, 1.0, 75).reshape(N_JOINTS, 3)
    for tracker in (whole, parts):
        run(tracker, np.stack([BODY + velocity * k / 30 for k in range(5)]))
    now = 1 + 4 * FRAME_NS
    end = now + step_ms * 1_000_000
    once = whole.update(skeleton(end, states=missing))
    parts.update(skeleton(now + round(split * (end - now)), states=missing))
    twice = parts.update(skeleton(end, states=missing))
    assert once is not None and twice is not None
    assert_allclose(once.positions, twice.positions, rtol=0, atol=1e-12)
    assert_allclose(once.covariances, twice.covariances, rtol=1e-9, atol=1e-15)


def random_motion(tracker: LinearKalmanFilter, rng: np.random.Generator, frames: int) -> FloatArray:
    """(frames, 25, 3) positions drawn from the filter's own model of motion."""
    p, step = tracker.parameters, FRAME_NS / NANOSECONDS
    if tracker.model == ZERO_VELOCITY:
        densities = (p.velocity_density_trunk, p.velocity_density_limb, p.velocity_density_extremity)
        steps = rng.normal(size=(frames, N_JOINTS, 3)) * np.sqrt(joint_densities(densities) * step)[:, None]
        return np.asarray(BODY + np.cumsum(steps, axis=0))
    densities = (p.acceleration_density_trunk, p.acceleration_density_limb, p.acceleration_density_extremity)
    block = np.linalg.cholesky(np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]))
    kicks = rng.normal(size=(frames, N_JOINTS, 3, 2)) @ block.T * np.sqrt(joint_densities(densities))[:, None, None]
    velocity = np.cumsum(kicks[..., 1], axis=0) - kicks[..., 1]
    return np.asarray(BODY + np.cumsum(velocity * step + kicks[..., 0], axis=0))


@pytest.mark.parametrize("model", LINEAR_MODELS)
def test_innovations_of_data_that_fits_the_model_are_chi_square(model: str) -> None:
    """NIS of white noise on a motion of the assumed density: the mean within its 99.9 % band, few beyond the gate."""
    rng = np.random.default_rng(2)
    share, noise = 0.25, 0.012**2
    tracker = LinearKalmanFilter(model, LinearKalmanParameters(white_noise_share=share))
    covariance = np.broadcast_to(np.eye(3) * noise, (N_JOINTS, 3, 3))
    distances, errors = [], []
    for _ in range(6):
        truth = random_motion(tracker, rng, 75)
        seen = truth + rng.normal(size=truth.shape) * np.sqrt(share * noise)
        tracker.reset()
        for k, frame in enumerate(seen):
            result = tracker.update(skeleton(1 + k * FRAME_NS, frame, covariances=covariance))
            assert result is not None and result.covariances is not None
            if k >= 15:
                distances.append(tracker.innovation_distances)
                white = result.covariances - (1.0 - share) * covariance
                error = (result.positions - truth[k])[:, :, None]
                errors.append((error * np.linalg.solve(white, error)).sum(axis=(1, 2)))
    count = len(distances) * N_JOINTS
    low, high = chi2.ppf([0.0005, 0.9995], 3 * count) / count
    assert low < np.mean(distances) < high
    # errors of successive frames are correlated: a wider band
    assert 2.7 < np.mean(errors) < 3.3
    assert np.mean(np.array(distances) > chi2.ppf(0.99, 3)) == pytest.approx(0.01, abs=0.005)


def without(*joints: Joint) -> np.ndarray:
    """(25,) the states of a frame in which all others are tracked."""
    states = TRACKED.copy()
    states[list(joints)] = TrackingState.NOT_TRACKED
    return states


@pytest.mark.parametrize("hidden", [[Joint.WRIST_LEFT], list(Joint)], ids=["a wrist", "all"])
def test_missing_joints_are_pure_prediction(hidden: list[Joint]) -> None:
    """If the body moves as a whole, its hidden joints move with it, without a kink."""
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY)
    velocity = np.array([0.6, -0.3, 0.1])
    last = run(tracker, np.stack([BODY + velocity * k / 30 for k in range(90)]))[-1]
    for k in range(90, 100):
        seen = BODY + velocity * k / 30
        expected, seen[hidden] = seen[hidden], np.nan
        result = tracker.update(skeleton(1 + k * FRAME_NS, seen, without(*hidden)))
        assert result is not None and result.covariances is not None and result.velocities is not None
        assert last.covariances is not None
        assert_allclose(result.positions[hidden], expected, rtol=0, atol=2e-4 if k == 90 else 2e-3)
        assert_allclose(result.velocities[hidden], np.broadcast_to(velocity, expected.shape), rtol=0, atol=2e-3)
        assert (result.states[hidden] == TrackingState.INFERRED).all()
        assert (np.delete(result.states, hidden) == TrackingState.TRACKED).all()
        before, now = (np.diagonal(each.covariances[hidden], axis1=1, axis2=2) for each in (last, result))
        assert (now > before).all()
        last = result


def test_a_hidden_hand_is_carried_by_the_arm() -> None:
    """Its motion relative to the wrist fades, and it follows the wrist."""
    p = LinearKalmanParameters()
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY, p)
    hand, tip, wrist = Joint.HAND_LEFT, Joint.HAND_TIP_LEFT, Joint.WRIST_LEFT
    speed = np.zeros((N_JOINTS, 3))
    speed[[hand, tip]] = [1.2, 0.0, 0.0]
    last = run(tracker, np.stack([BODY + speed * k / 30 for k in range(60)]))[-1]
    fading_time = 2.0 * p.initial_velocity_stddev**2 / p.acceleration_density_extremity
    raised = np.zeros((N_JOINTS, 3))
    for k in range(1, 15):
        raised[[Joint.ELBOW_LEFT, wrist], 2] = max(0, k - 5) * 0.02
        result = tracker.update(skeleton(1 + (59 + k) * FRAME_NS, last.positions + raised, without(hand, tip)))
        assert result is not None and result.velocities is not None
    shifted = result.positions - last.positions
    swing = 1.2 * fading_time * (1.0 - np.exp(-14 * FRAME_NS / NANOSECONDS / fading_time))
    assert swing < 0.31  # at constant velocity 0.56 m
    assert_allclose(shifted[[hand, tip], 0], swing, rtol=0, atol=2e-3)
    assert_allclose(shifted[[hand, tip], 2], shifted[wrist, 2], rtol=0, atol=0.04)  # as far behind as velocities lag
    assert shifted[wrist, 2] > 0.15


def test_a_joint_unseen_for_long_is_lost_and_comes_back_on_its_measurement() -> None:
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY)
    run(tracker, np.stack([BODY] * 10))
    states = without(Joint.HEAD)
    seen_states = []
    for k in range(10, 40):
        result = tracker.update(skeleton(1 + k * FRAME_NS, states=states))
        assert result is not None
        seen_states.append(result.states[Joint.HEAD])
    predicted_frames = int(tracker.parameters.predict_for * 30)
    assert seen_states == [TrackingState.INFERRED] * predicted_frames + [TrackingState.NOT_TRACKED] * (
        30 - predicted_frames
    )
    assert result is not None and result.covariances is not None
    assert np.isnan(result.positions[Joint.HEAD]).all() and np.isinf(np.diag(result.covariances[Joint.HEAD])).all()
    moved = BODY.copy()
    moved[Joint.HEAD] += 1.0
    back = tracker.update(skeleton(1 + 40 * FRAME_NS, moved))
    assert back is not None
    assert_allclose(back.positions[Joint.HEAD], moved[Joint.HEAD])
    assert tracker.counters["lost"] == 1


def test_an_outlier_is_rejected_and_a_move_for_good_is_followed() -> None:
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY)
    run(tracker, np.stack([BODY] * 10))
    moved = BODY.copy()
    moved[Joint.WRIST_RIGHT] += [0.0, 0.5, 0.0]
    frames = [tracker.update(skeleton(1 + k * FRAME_NS, moved)) for k in range(10, 20)]
    offsets = np.array(
        [frame.positions[Joint.WRIST_RIGHT, 1] - BODY[Joint.WRIST_RIGHT, 1] for frame in frames if frame]
    )
    waits = int(tracker.parameters.reacquire_after * 30)
    assert_allclose(offsets[:waits], 0.0, atol=1e-6)
    assert_allclose(offsets[waits + 1 :], 0.5, atol=1e-6)
    assert tracker.counters["reacquired"] == 1
    first = frames[0]
    assert first is not None and first.states[Joint.WRIST_RIGHT] == TrackingState.INFERRED
    assert_array_equal(np.delete(first.states, Joint.WRIST_RIGHT), np.delete(TRACKED, Joint.WRIST_RIGHT))


@pytest.mark.parametrize("jump", [0.2, 0.5])
def test_after_a_jump_the_deviation_includes_it_and_fades(jump: float) -> None:
    """One jump is accepted as a sudden movement, the other is rejected until the joint restarts."""
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY)
    before = run(tracker, np.stack([BODY] * 10))[-1]
    moved = BODY.copy()
    moved[Joint.ELBOW_RIGHT] += [0.0, jump, 0.0]
    frames = run(tracker, np.stack([moved] * 30), start_ns=1 + 10 * FRAME_NS)
    steps, stddev = (
        np.array([read(each) for each in [before, *frames]])
        for read in (
            lambda each: each.positions[Joint.ELBOW_RIGHT, 1],
            lambda each: np.sqrt(each.covariances[Joint.ELBOW_RIGHT, 1, 1]),
        )
    )
    largest = int(np.abs(np.diff(steps)).argmax()) + 1
    assert tracker.counters["reacquired"] == (jump > 0.4)
    assert stddev[largest] > 0.9 * abs(steps[largest] - steps[largest - 1])
    assert stddev[-1] < 1.02 * stddev[0]


def test_a_punch_is_followed() -> None:
    """An elbow thrust forward at 45 m/s2 and stopped as hard; without adaptation the error reaches half a metre."""
    elbow = Joint.ELBOW_RIGHT
    times = np.arange(45) / 30.0
    path = np.repeat(BODY[None], len(times), axis=0)
    path[:, elbow, 0] += 0.22 * (1.0 - np.cos(2.0 * np.pi * np.clip(times - 1.0, 0.0, 0.44) / 0.44))

    def worst(**parameters: float) -> float:
        tracker = LinearKalmanFilter(CONSTANT_VELOCITY, LinearKalmanParameters(**parameters))
        off = np.array([result.positions[elbow] for result in run(tracker, path)]) - path[:, elbow]
        return float(np.linalg.norm(off, axis=1).max())

    assert worst() < 0.08
    assert worst(adaptation=0.0) > 0.3


def test_the_slow_part_of_the_noise_opens_the_gate_and_stays_in_the_covariance() -> None:
    """A jump by 1.5 stated standard deviations is no outlier, though far beyond the white part of the noise."""
    tracker = LinearKalmanFilter(CONSTANT_VELOCITY, LinearKalmanParameters(white_noise_share=0.01))
    noise = np.broadcast_to(np.eye(3) * 0.03**2, (N_JOINTS, 3, 3))
    for k in range(60):
        result = tracker.update(skeleton(1 + k * FRAME_NS, covariances=noise))
    assert result is not None and result.covariances is not None
    stddev = np.sqrt(np.diagonal(result.covariances, axis1=1, axis2=2))
    assert ((stddev > 0.029) & (stddev <= 0.03)).all()
    tracker.update(skeleton(1 + 60 * FRAME_NS, BODY + 0.045, covariances=noise))
    assert np.nanmin(tracker.innovation_distances) > chi2.ppf(tracker.parameters.gate_probability, 3)
    assert tracker.counters["rejected"] == 0


@pytest.mark.parametrize("model", LINEAR_MODELS)
@given(
    positions=arrays(np.float64, (N_JOINTS, 3), elements=st.floats(allow_nan=True, allow_infinity=True)),
    states=arrays(np.uint8, (N_JOINTS,), elements=st.integers(0, 2)),
    covariance=arrays(np.float64, (3, 3), elements=st.floats(allow_nan=True, allow_infinity=True)),
)
@example(np.zeros((N_JOINTS, 3)), np.ones(N_JOINTS, dtype=np.uint8), np.full((3, 3), 1.28326561e-16))
@settings(max_examples=draws(12, 60))
def test_no_number_whatever_gets_into_the_state(
    model: str, positions: FloatArray, states: np.ndarray, covariance: FloatArray
) -> None:
    tracker = LinearKalmanFilter(model)
    covariances = np.broadcast_to(np.eye(3) * 1e-4, (N_JOINTS, 3, 3)).copy()
    covariances[::2] = np.triu(covariance) + np.triu(covariance, 1).T
    tracker.update(skeleton(1, positions, states, covariances))
    for k in range(1, 30):
        result = tracker.update(skeleton(1 + k * FRAME_NS))
    assert result is not None and result.covariances is not None
    assert_allclose(result.positions, BODY, atol=1e-3)
    assert (np.linalg.eigvalsh(result.covariances) > 0).all()
    assert (result.states == TrackingState.TRACKED).all()
