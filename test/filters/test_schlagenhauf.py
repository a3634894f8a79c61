"""The thesis's extended filter is algorithm 2 as published, but for the innovation, and survives faults of sensors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.filters.schlagenhauf import SchlagenhaufKalmanFilter, SchlagenhaufParameters
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from body_tracking.simulation.bags import SHIPPED
from draws import draws, some
from walkers import TRACKED, performed

FRAME_NS = NANOSECONDS // 30
LENGTHS = np.array([0.24, 0.26, 0.18, 0.32, 0.25, 0.17, 0.19, 0.33, 0.26, 0.16])
PLACE = np.array([2.0, -0.4, 0.2])
YAW = 2.5
MODEL = Schlagenhauf26(PLACE, Rotation.from_euler("z", YAW).as_matrix())
JOINTS = MODEL.joints
FRAMES = SchlagenhaufParameters().calibration_frames


def pose(theta: FloatArray, model: Schlagenhauf26 = MODEL, lengths: FloatArray = LENGTHS) -> FloatArray:
    """(25, 3) metres of a person who is as her model says; joints that it does not have are NaN, but for the hips."""
    positions = np.full((N_JOINTS, 3), np.nan)
    positions[JOINTS] = model.forward(theta, lengths).positions
    positions[Joint.SPINE_BASE] = model.base_position
    positions[[Joint.HIP_LEFT, Joint.HIP_RIGHT]] = model.base_position + [[0, 0.08, 0], [0, -0.08, 0]] @ (
        model.base_rotation.T
    )
    return positions


def skeleton(stamp_ns: int, positions: FloatArray, states: np.ndarray = TRACKED) -> Skeleton:
    return Skeleton(stamp_ns, "world", positions.copy(), states.copy())


def started(parameters: SchlagenhaufParameters | None = None) -> SchlagenhaufKalmanFilter:
    """A filter that has seen the T-pose; its last stamp is that of frame ``FRAMES``."""
    tracker = SchlagenhaufKalmanFilter(parameters)
    for k in range(1, FRAMES + 1):
        assert not tracker.calibrated
        assert tracker.update(skeleton(k * FRAME_NS, pose(np.zeros(26)))) is None
    assert tracker.calibrated
    return tracker


def moving(rng: np.random.Generator, frames: int) -> FloatArray:
    """(frames, 26) radians: slow swings of all angles, from zero on."""
    time = np.arange(1, frames + 1)[:, None] / 30.0
    return np.asarray(rng.uniform(0.1, 0.5, 26) * np.sin(rng.uniform(1.0, 3.0, 26) * time))


def test_every_frame_is_one_step_of_algorithm_2() -> None:
    """Line by line, with the gain and the innovation of missing joints set to zero (section 5.5.2).

    But for line 8: the innovation is z - h(s), not z - H s.
    """
    rng = np.random.default_rng(0)
    tracker, p = started(), SchlagenhaufParameters()
    s = np.zeros(52)
    P = np.diag([p.initial_angle_stddev**2] * 26 + [p.initial_rate_stddev**2] * 26)
    F = np.block([[np.eye(26), np.eye(26) / 30.0], [np.zeros((26, 26)), np.eye(26)]])
    Q, R = 0.0001 * np.eye(52), p.measurement_stddev**2 * np.eye(30)
    for k, theta in enumerate(moving(rng, 60), start=FRAMES + 1):
        seen = pose(theta) + rng.normal(size=(N_JOINTS, 3)) * 0.01
        states = np.where(rng.random(N_JOINTS) < 0.7, TrackingState.TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8)
        result = tracker.update(skeleton(k * FRAME_NS, seen, states))
        assert result is not None

        s, P = F @ s, F @ P @ F.T + Q
        prior = MODEL.linearise(s[:26], LENGTHS)
        H = np.hstack([prior.jacobian.reshape(30, 26), np.zeros((30, 26))])
        missing = np.repeat(states[JOINTS] == TrackingState.NOT_TRACKED, 3)
        H[missing] = 0.0
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        innovation = seen[JOINTS].ravel() - prior.posture.positions.ravel()
        innovation[missing] = 0.0
        assert_array_equal(K[:, missing], 0.0)
        s, P = s + K @ innovation, (np.eye(52) - K @ H) @ P

        assert_allclose(tracker.q, s[:26], rtol=0, atol=1e-9)
        assert_allclose(tracker.velocity, s[26:], rtol=0, atol=1e-8)
        assert_allclose(tracker.covariance, P, rtol=1e-7, atol=1e-9)
        assert_allclose(
            np.where(missing, np.nan, innovation), tracker.innovations.ravel(), rtol=0, atol=1e-9, equal_nan=True
        )
        assert_allclose(result.positions[JOINTS], MODEL.forward(s[:26], LENGTHS).positions, rtol=0, atol=1e-9)
        assert_array_equal(result.states[JOINTS] == TrackingState.INFERRED, missing[::3])


def test_without_any_joint_the_model_alone_goes_on() -> None:
    """Eq. 5.21 and 5.22, exactly; whatever the reason for which a joint is missing."""
    rng = np.random.default_rng(1)
    tracker = started()
    for k, theta in enumerate(moving(rng, 20), start=FRAMES + 1):
        tracker.update(skeleton(k * FRAME_NS, pose(theta)))
    F = np.eye(52) + np.eye(52, k=26) / 30.0
    seen, never = pose(np.zeros(26)), np.zeros(N_JOINTS, dtype=np.uint8)
    for j, missing in enumerate(
        (skeleton(0, seen, never), skeleton(0, seen * np.nan), skeleton(0, seen * np.inf), skeleton(0, seen + 1e6)),
    ):
        state, covariance = np.concatenate([tracker.q, tracker.velocity]), tracker.covariance
        stamp_ns = (FRAMES + 21 + j) * FRAME_NS
        result = tracker.update(skeleton(stamp_ns, missing.positions, missing.states))
        assert result is not None
        assert_array_equal(np.concatenate([tracker.q, tracker.velocity]), F @ state)
        assert_allclose(tracker.covariance, F @ covariance @ F.T + 1e-4 * np.eye(52), rtol=1e-14, atol=1e-18)
        assert (result.states[JOINTS] == TrackingState.INFERRED).all()
        assert np.isnan(tracker.innovations).all()


@given(yaw=st.floats(-3.1, 3.1), place=arrays(np.float64, 3, elements=st.floats(-5.0, 5.0)), seed=st.integers(0, 99))
@settings(max_examples=draws(10, 20))
def test_the_t_pose_gives_lengths_place_and_heading(yaw: float, place: FloatArray, seed: int) -> None:
    """Medians: a few frames that are far off change nothing."""
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(0.1, 0.4, 10)
    model = Schlagenhauf26(place, Rotation.from_euler("z", yaw).as_matrix())
    tracker = SchlagenhaufKalmanFilter(SchlagenhaufParameters(calibration_frames=20))
    for k in range(20):
        seen = pose(np.zeros(26), model, lengths)
        if k % 5 == 0:
            seen += rng.normal(size=seen.shape)
        assert tracker.update(skeleton(1 + k * FRAME_NS, seen)) is None
    assert_allclose(tracker.lengths, lengths, rtol=0, atol=1e-12)
    assert_allclose(tracker.model.base_position, place, rtol=0, atol=1e-12)
    assert_allclose(tracker.model.base_rotation, model.base_rotation, rtol=0, atol=1e-12)


def test_a_length_that_is_never_seen_is_the_other_sides_or_an_average_one() -> None:
    seen = pose(np.zeros(26))
    seen[[Joint.HAND_TIP_LEFT, Joint.WRIST_LEFT]] = np.nan
    one_side = SchlagenhaufKalmanFilter()
    seen_less = seen.copy()
    seen_less[Joint.HAND_TIP_RIGHT] = np.nan
    no_side = SchlagenhaufKalmanFilter()
    for k in range(FRAMES):
        one_side.update(skeleton(1 + k * FRAME_NS, seen))
        no_side.update(skeleton(1 + k * FRAME_NS, seen_less))
    assert_allclose(one_side.lengths, [*LENGTHS[:4], *LENGTHS[8:10], *LENGTHS[6:]], atol=1e-12)
    known = [*range(5), *range(6, 9)]
    ratio = np.median(no_side.lengths[known] / MODEL.default_lengths()[known])
    assert_allclose(no_side.lengths[[5, 9]], ratio * MODEL.default_lengths()[[5, 9]])


@pytest.mark.parametrize("hidden", [[Joint.SPINE_BASE], [Joint.HIP_LEFT, Joint.SHOULDER_LEFT]])
def test_nothing_starts_before_place_and_heading_are_seen(hidden: list[Joint]) -> None:
    """It starts as soon as the last frames show both."""
    tracker = SchlagenhaufKalmanFilter()
    seen = pose(np.zeros(26))
    seen[hidden] = np.nan
    for k in range(2 * FRAMES):
        assert tracker.update(skeleton(1 + k * FRAME_NS, seen)) is None
    assert not tracker.calibrated and tracker.counters["calibrating"] == 2 * FRAMES
    assert tracker.update(skeleton(1 + 2 * FRAMES * FRAME_NS, pose(np.zeros(26)))) is None
    assert tracker.calibrated


@pytest.mark.parametrize("motion", some(tuple(SHIPPED.values())))
def test_it_follows_the_thesis_motions(motion: str) -> None:
    """20 mm of white noise: on average nearer to the truth than the measurements, with constant lengths."""
    rng = np.random.default_rng(3)
    truth = performed(motion)
    seen = truth + rng.normal(size=truth.shape) * 0.02
    tracker = SchlagenhaufKalmanFilter()
    results = [tracker.update(skeleton(1 + k * FRAME_NS, frame)) for k, frame in enumerate(seen)]
    positions = np.array([result.positions for result in results[FRAMES:] if result is not None])
    assert len(positions) == len(truth) - FRAMES

    def rms(error: FloatArray) -> float:
        return float(np.sqrt((error[:, JOINTS] ** 2).sum(axis=2).mean()))

    assert rms(positions - truth[FRAMES:]) < 0.7 * rms(seen[FRAMES:] - truth[FRAMES:])
    starts = [Joint.SPINE_BASE, Joint.SPINE_MID]
    for side in ("LEFT", "RIGHT"):
        starts += [Joint.SPINE_SHOULDER, *(Joint[f"{part}_{side}"] for part in ("SHOULDER", "ELBOW", "WRIST"))]
    spans = np.linalg.norm(positions[:, JOINTS] - positions[:, starts], axis=2)
    assert_allclose(spans, np.broadcast_to(tracker.lengths, spans.shape), rtol=0, atol=1e-12)
    assert tracker.counters["diverged"] == 0


def test_velocities_and_covariances_are_those_of_the_state() -> None:
    rng = np.random.default_rng(4)
    tracker = started()
    for k, theta in enumerate(moving(rng, 30), start=FRAMES + 1):
        result = tracker.update(skeleton(k * FRAME_NS, pose(theta)))
    assert result is not None and result.velocities is not None and result.covariances is not None
    step = 1e-6

    def at(change: FloatArray) -> FloatArray:
        return MODEL.forward(tracker.q + change, tracker.lengths).positions

    rates = (at(step * tracker.velocity) - at(-step * tracker.velocity)) / (2 * step)
    assert_allclose(result.velocities[JOINTS], rates, rtol=0, atol=1e-8)
    slopes = (at(step * np.eye(26)) - at(-step * np.eye(26))) / (2 * step)  # (26, 10, 3)
    expected = np.einsum("ajx,ab,bjy->jxy", slopes, tracker.covariance[:26, :26], slopes)
    assert_allclose(result.covariances[JOINTS], expected, rtol=0, atol=1e-11)
    base = Joint.SPINE_BASE
    assert_allclose(result.positions[base], PLACE, atol=1e-12)
    assert result.states[base] == TrackingState.INFERRED
    assert_array_equal(result.covariances[base], 0.0)
    others = np.setdiff1d(np.arange(N_JOINTS), [base, *JOINTS])
    assert len(others) == 14 and (result.states[others] == TrackingState.NOT_TRACKED).all()
    assert np.isnan(result.positions[others]).all() and np.isnan(result.velocities[others]).all()
    assert np.isinf(np.diagonal(result.covariances[others], axis1=1, axis2=2)).all()


def test_unobserved_angles_grow_uncertain_without_bound() -> None:
    """Of her filter: 18 observed directions in the T-pose, the others wander."""
    tracker = started()
    still, largest = pose(np.zeros(26)), []
    for k in range(FRAMES + 1, FRAMES + 601):
        tracker.update(skeleton(k * FRAME_NS, still))
        if k in (FRAMES + 300, FRAMES + 600):
            largest.append(np.linalg.eigvalsh(tracker.covariance[:26, :26]))
    early, late = largest
    assert (late > 4.0 * early).sum() == 8
    assert late[17] < 0.05**2 < 1.0 < late[18]


def test_its_time_step_is_fixed() -> None:
    """As published: the stamps change nothing but their order, and a gap is one step."""
    rng = np.random.default_rng(5)
    regular, irregular = started(), started()
    stamp_ns = FRAMES * FRAME_NS
    for k, theta in enumerate(moving(rng, 30), start=1):
        stamp_ns += int(rng.integers(NANOSECONDS // 100, 3 * NANOSECONDS))
        regular.update(skeleton((FRAMES + k) * FRAME_NS, pose(theta)))
        irregular.update(skeleton(stamp_ns, pose(theta)))
    assert_array_equal(regular.q, irregular.q)
    assert irregular.counters["gaps"] > 0


@given(
    positions=arrays(np.float64, (3, N_JOINTS, 3), elements=st.floats(allow_nan=True, allow_infinity=True)),
    states=arrays(np.uint8, (3, N_JOINTS), elements=st.integers(0, 2)),
    before=st.integers(0, 8),
)
@settings(max_examples=draws(20, 60))
def test_no_number_whatever_makes_it_fail(positions: FloatArray, states: np.ndarray, before: int) -> None:
    """Garbage within the T-pose's frames or after them: no error, and every position that it states is a number."""
    tracker = SchlagenhaufKalmanFilter(SchlagenhaufParameters(calibration_frames=5))
    still = pose(np.zeros(26))
    for k in range(20):
        garbage = before <= k < before + 3
        seen, state = (positions[k - before], states[k - before]) if garbage else (still, TRACKED)
        result = tracker.update(skeleton(1 + k * FRAME_NS, seen, state))
    assert result is not None and result.covariances is not None
    known = result.states > TrackingState.NOT_TRACKED
    assert known.sum() == 11
    assert np.isfinite(result.positions[known]).all() and np.isfinite(result.covariances[known]).all()


@pytest.mark.parametrize("damage", [np.nan, np.inf, 1e308])
def test_a_broken_covariance_restarts_the_filter_without_nan(damage: float) -> None:
    tracker = started()
    tracker._kalman.P[:26, :26] += damage
    with np.errstate(all="ignore"):
        result = tracker.update(skeleton((FRAMES + 1) * FRAME_NS, pose(np.full(26, 0.1))))
    assert tracker.counters["diverged"] == 1
    assert result is not None and np.isfinite(result.positions[JOINTS]).all()
    assert_array_equal(tracker.q, 0.0)
    assert_allclose(tracker.lengths, LENGTHS, atol=1e-12)
