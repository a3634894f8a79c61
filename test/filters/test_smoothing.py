"""Fixed-lag smoothing: its estimates are those of a least-squares fit of all frames, and every frame is published."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from random_people import MeasurementErrors, RandomPerson, capture_times, observe, truth_of
from scipy.stats import chi2

from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Joint, Skeleton
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.linear import CONSTANT_VELOCITY, LinearKalmanFilter
from body_tracking.filters.parameters import LinearKalmanParameters
from body_tracking.filters.smoothing import FixedLag, SmoothableFilter
from body_tracking.filters.stage import FilterStage
from body_tracking.kinematics.motion import joint_densities
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL
from body_tracking.pipeline.stage import Now, Output
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws
from walkers import TRACKED

FRAME_NS = NANOSECONDS // 30
LAG = 0.15
LATER = 5
"""Number of frames from one to the first that is later by at least LAG."""
BODY = np.random.default_rng(0).normal(size=(N_JOINTS, 3)) * 0.4 + [2.0, 0.0, 0.0]
NOISE = 0.01
"""Metres per axis."""
EXACT = LinearKalmanParameters(white_noise_share=1.0, adaptation=0.0, gate_probability=1.0 - 1e-12)
"""Settings with which the linear filter is a plain Kalman filter."""


def frame(stamp_ns: int, positions: FloatArray = BODY, **other: Any) -> Skeleton:
    covariances = np.broadcast_to(NOISE**2 * np.eye(3), (N_JOINTS, 3, 3))
    return replace(Skeleton(stamp_ns, "world", positions, TRACKED, 0, covariances), **other)


def walk(rng: np.random.Generator, frames: int) -> tuple[FloatArray, FloatArray]:
    """(frames, 25, 3) positions, and velocities, of white acceleration of the filter's density."""
    p, step = EXACT, FRAME_NS / NANOSECONDS
    densities = (p.acceleration_density_trunk, p.acceleration_density_limb, p.acceleration_density_extremity)
    block = np.linalg.cholesky([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    kicks = rng.normal(size=(frames, N_JOINTS, 3, 2)) @ block.T * np.sqrt(joint_densities(densities))[:, None, None]
    velocity = np.cumsum(kicks[..., 1], axis=0)
    return BODY + np.cumsum((velocity - kicks[..., 1]) * step + kicks[..., 0], axis=0), velocity


def smoothed(estimator: SmoothableFilter, frames: Sequence[Skeleton], lag: float) -> list[Any]:
    """The smoothed frames of a filter, those of the end too; the filtered ones where the lag is 0."""
    held = FixedLag(estimator, lag)
    found = []
    for each in frames:
        filtered = estimator.update(each)  # type: ignore[attr-defined]
        if filtered is not None:
            last = estimator.last_frame(filtered)
            found += held.take(last, each.stamp_ns) if lag else [last]
    return found + held.flush()


def least_squares(seen: FloatArray, density: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2) position and velocity of one coordinate by all n measurements, and their (2 n, 2 n) covariance."""
    n, step = len(seen), FRAME_NS / NANOSECONDS
    information, right = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
    information[1, 1] = EXACT.initial_velocity_stddev**-2
    process = np.linalg.inv(density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]))
    change = np.array([[-1.0, -step, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])
    for k in range(n):
        information[2 * k, 2 * k] += NOISE**-2
        right[2 * k] += seen[k] / NOISE**2
        if k:
            information[2 * k - 2 : 2 * k + 2, 2 * k - 2 : 2 * k + 2] += change.T @ process @ change
    covariance = np.linalg.inv(information)
    return (covariance @ right).reshape(n, 2), covariance


def test_a_smoothed_linear_motion_is_the_least_squares_fit_of_all_frames() -> None:
    rng = np.random.default_rng(1)
    truth, _ = walk(rng, 20)
    seen = truth + rng.normal(size=truth.shape) * NOISE
    frames = [frame(1 + k * FRAME_NS, each) for k, each in enumerate(seen)]
    estimator = LinearKalmanFilter(CONSTANT_VELOCITY, EXACT)
    results = [estimator.results_of(each)[0] for each in smoothed(estimator, frames, 10.0)]
    densities = joint_densities(
        (EXACT.acceleration_density_trunk, EXACT.acceleration_density_limb, EXACT.acceleration_density_extremity)
    )
    for joint in (Joint.SPINE_MID, Joint.ELBOW_LEFT, Joint.WRIST_RIGHT):
        for axis in range(3):
            fitted, covariance = least_squares(seen[:, joint, axis], float(densities[joint]))
            found = [[each.positions[joint, axis], each.velocities[joint, axis]] for each in results]  # type: ignore[index]
            assert_allclose(found, fitted, rtol=0.0, atol=1e-9)
            variances = [each.covariances[joint, axis, axis] for each in results]  # type: ignore[index]
            assert_allclose(variances, covariance.diagonal()[::2], rtol=1e-6)


def test_a_frame_that_waited_for_the_lag_is_smoothed_by_all_that_came_till_then() -> None:
    rng = np.random.default_rng(2)
    seen = walk(rng, 14)[0] + rng.normal(size=(14, N_JOINTS, 3)) * NOISE
    frames = [frame(1 + k * FRAME_NS, each) for k, each in enumerate(seen)]
    live = smoothed(LinearKalmanFilter(CONSTANT_VELOCITY), frames, LAG)
    for number in (0, 3, 8):
        until = smoothed(LinearKalmanFilter(CONSTANT_VELOCITY), frames[: number + LATER + 1], 10.0)
        assert_allclose(live[number].state, until[number].state, rtol=0.0, atol=1e-12)
        assert_allclose(live[number].covariance, until[number].covariance, rtol=0.0, atol=1e-12)


def test_smoothed_joints_err_less_and_as_much_as_they_state() -> None:
    """Normalised errors squared of position and velocity; frames a second apart are taken for independent."""
    rng = np.random.default_rng(3)
    squares: dict[float, list[FloatArray]] = {0.0: [], LAG: []}
    normalised = []
    for _ in range(4):
        truth, velocity = walk(rng, 70)
        frames = [frame(1 + k * FRAME_NS, each) for k, each in enumerate(truth + rng.normal(size=truth.shape) * NOISE)]
        for lag, found in squares.items():
            estimator = LinearKalmanFilter(CONSTANT_VELOCITY, EXACT)
            for k, each in enumerate(smoothed(estimator, frames, lag)):
                if k % 30 == 20:
                    error = each.state[..., 0] - np.concatenate([truth[k], velocity[k]], axis=1)
                    found.append(error**2)
                    if lag:
                        normalised.append((error[..., None] * np.linalg.solve(each.covariance, error[..., None])).sum())
    assert (np.mean(squares[LAG], axis=(0, 1)) < 0.7 * np.mean(squares[0.0], axis=(0, 1))).all()
    low, high = chi2.ppf([0.0005, 0.9995], 6 * N_JOINTS * len(normalised))
    assert low < sum(normalised) < high


def test_a_restarted_joint_does_not_change_earlier_frames() -> None:
    away = BODY.copy()
    away[Joint.HAND_LEFT] += [0.0, 3.0, 0.0]
    frames = [frame(1 + k * FRAME_NS, BODY if k < 10 else away) for k in range(40)]
    estimator = LinearKalmanFilter(CONSTANT_VELOCITY)
    results = [estimator.results_of(each)[0] for each in smoothed(estimator, frames, 10.0)]
    assert estimator.counters["reacquired"] == 1
    hand = np.array([each.positions[Joint.HAND_LEFT, 1] for each in results])
    assert_allclose(hand[:10], BODY[Joint.HAND_LEFT, 1], rtol=0.0, atol=1e-6)
    assert hand[-1] == pytest.approx(away[Joint.HAND_LEFT, 1])
    assert (np.abs(np.diff(hand)) > 1.0).sum() == 1


# --- the extended filter


def seen_person(seed: int, seconds: float = 2.5) -> tuple[list[Skeleton], Any]:
    rng = np.random.default_rng(seed)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, seconds)
    truth = truth_of(person, motion, capture_times(seconds, rng))
    return list(observe(truth, MeasurementErrors(NOISE), rng).skeletons), truth


def test_smoothed_people_err_less_and_by_no_more_than_they_state() -> None:
    """Observed joint angles and their rates; normalised errors are bounded from above, at instants half a second apart.

    A settled filter is not needed: while lengths are estimated, they are smoothed, too.
    """
    angles = np.array([k for k, name in enumerate(MODEL.coordinate_names) if k >= 6 and name not in UNOBSERVED])
    normalised = []
    means: dict[float, list[FloatArray]] = {0.0: [], LAG: []}
    for seed in range(draws(2, 8)):
        frames, truth = seen_person(seed)
        at = {each.stamp_ns: k for k, each in enumerate(frames)}
        squares: dict[float, list[FloatArray]] = {}
        for lag in (0.0, LAG):
            estimator = ExtendedKalmanFilter(EkfParameters(posture=False))
            for kept in smoothed(estimator, frames, lag):
                if kept.stamp_ns <= NANOSECONDS:
                    continue
                number, estimate = at[kept.stamp_ns], estimator.results_of(kept)[1]
                error = MODEL.difference(estimate.q, truth.q[number])[angles]
                rates = (estimate.velocity - truth.velocity[number])[angles]
                squares.setdefault(lag, []).append(np.array([error @ error, rates @ rates]))
                if lag and number % 15 == 0:
                    normalised.append(error @ np.linalg.solve(estimate.covariance[np.ix_(angles, angles)], error))
        assert len(squares[LAG]) == len(squares[0.0]) > 30
        for lag, found in squares.items():
            means[lag].append(np.mean(found, axis=0))
    assert (np.mean(means[LAG], axis=0) < np.mean(means[0.0], axis=0)).all()
    assert sum(normalised) < chi2.ppf(0.9995, len(angles) * len(normalised))


# --- the stage


class Bench:
    """The stage with a filter of fused skeletons, and its messages: topic, stamp and time of publication."""

    def __init__(self, name: str, **values: Any) -> None:
        self.published: list[tuple[str, int, int]] = []
        self.skeletons: list[Skeleton] = []
        self.now_ns = 0
        given = {"filter": name, "input": graph.FUSED_INPUT, "sensors": ("kinect1",), **values}
        self.stage = FilterStage(check_all(FilterStage.PARAMETERS, given))

    def _publish(self, outputs: Iterable[Output]) -> None:
        for each in outputs:
            if each.topic != graph.TRACKED:
                self.published.append((each.topic, each.stamp_ns or 0, self.now_ns))
            if each.topic == graph.FILTERED:
                self.skeletons.extend(each.payload)

    def feed(self, frames: Sequence[Sequence[Skeleton]], delay_ns: int = 20_000_000) -> None:
        for each in frames:
            self.now_ns = each[0].stamp_ns + delay_ns
            self._publish(self.stage.take(graph.FUSED, each, Now(self.now_ns, self.now_ns)))
            self._publish(self.stage.poll(self.now_ns))

    def reset(self) -> None:
        self.stage.reset(graph.FUSED)
        self._publish(self.stage.poll(self.now_ns))

    def end(self) -> None:
        while self.stage.deadline_ns is not None:
            self.now_ns = self.stage.deadline_ns
            self._publish(self.stage.poll(self.now_ns))

    def stamps(self, topic: str = graph.FILTERED) -> list[int]:
        return [stamp_ns for each, stamp_ns, _ in self.published if each == topic]


@pytest.mark.parametrize("name", ["lkf_constant_velocity", "ekf"])
def test_every_frame_is_published_once_in_order_and_when_it_is_old_enough(name: str) -> None:
    frames = [replace(each, body=1) for each in seen_person(5, 1.0)[0]]
    plain, late = Bench(name, predict_after=10.0), Bench(name, lag=LAG)
    for bench in (plain, late):
        bench.feed([[each] for each in frames])
    assert plain.stamps() == sorted(plain.stamps()) and len(plain.stamps()) > 20
    newest_ns = frames[-1].stamp_ns
    lag_ns = round(LAG * NANOSECONDS)
    assert late.stamps() == [stamp_ns for stamp_ns in plain.stamps() if stamp_ns <= newest_ns - lag_ns]
    arrivals = np.array([each.stamp_ns for each in frames])
    for _, stamp_ns, now_ns in late.published:
        if _ != graph.urdf_topic(graph.DEFAULT_BODY):
            assert now_ns == arrivals[arrivals >= stamp_ns + lag_ns][0] + 20_000_000
    before_ns = late.now_ns
    late.end()
    assert late.stamps() == plain.stamps()
    assert late.now_ns == before_ns + lag_ns  # of silence
    if name == "ekf":
        for topic in (graph.MODEL_STATE, graph.MODEL_STATE_STDDEV, graph.MODEL_COVARIANCE):
            assert late.stamps(topic) == plain.stamps(topic) == plain.stamps()
    assert not all(
        np.array_equal(one.positions, other.positions, equal_nan=True)
        for one, other in zip(plain.skeletons, late.skeletons, strict=True)
    )
    # the newest frame has none after it
    assert_allclose(late.skeletons[-1].positions, plain.skeletons[-1].positions, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", ["lkf_constant_velocity", "ekf"])
def test_smoothing_leaves_the_filter_itself_alone(name: str) -> None:
    """Bit for bit."""
    frames = seen_person(6, 0.7)[0]
    plain, beside = (Bench(name, lag=lag) for lag in (0.0, LAG))
    for bench in (plain, beside):
        bench.feed([[each] for each in frames])
    one, other = (bench.stage._persons[0]._filter for bench in (plain, beside))
    last = frames[-1].stamp_ns + FRAME_NS
    one, other = one.update(replace(frames[-1], stamp_ns=last)), other.update(replace(frames[-1], stamp_ns=last))
    assert one is not None and other is not None
    for part in ("positions", "covariances", "velocities", "states"):
        assert_array_equal(getattr(one, part), getattr(other, part))


@pytest.mark.parametrize("announced", [True, False])
def test_frames_before_a_jump_of_time_are_published_before_those_after_it(announced: bool) -> None:
    bench = Bench("lkf_constant_velocity", lag=LAG)
    first = [100 * NANOSECONDS + k * FRAME_NS for k in range(10)]
    second = [NANOSECONDS + k * FRAME_NS for k in range(10)]
    bench.feed([[frame(stamp_ns)] for stamp_ns in first])
    if announced:
        bench.reset()
        assert bench.stamps() == first
    bench.feed([[frame(stamp_ns)] for stamp_ns in second])
    bench.end()
    assert bench.stamps() == first + second


def test_one_who_is_hidden_does_not_come_after_the_others() -> None:
    bench = Bench("lkf_constant_velocity", lag=LAG, subject=ALL, people=2)
    one = [frame(1 + k * FRAME_NS, body=1) for k in range(30)]
    two = [frame(1 + k * FRAME_NS, BODY + 2.0, body=2) for k in range(30)]
    bench.feed([[a] if 10 <= k < 20 else [a, b] for k, (a, b) in enumerate(zip(one, two, strict=True))])
    bench.end()
    assert bench.stamps() == [each.stamp_ns for each in one]
    assert [each.stamp_ns for each in bench.skeletons if each.body == 2] == [
        each.stamp_ns for k, each in enumerate(two) if not 10 <= k < 20
    ]


def test_a_change_of_the_lag_publishes_what_is_held_back() -> None:
    values = check_all(FilterStage.PARAMETERS, {"lag": LAG})
    stage = FilterStage(values)
    outputs = []
    for k in range(20):
        if k == 10:
            stage.change({**values, "lag": 0.0})
        stamp_ns = 1 + k * FRAME_NS
        outputs += stage.take(graph.FUSED, [frame(stamp_ns)], Now(stamp_ns, stamp_ns))
    assert [each.stamp_ns for each in outputs if each.topic == graph.FILTERED] == [1 + k * FRAME_NS for k in range(20)]


@pytest.mark.parametrize("name", ["thesis_lkf1", "thesis_lkf2", "schlagenhauf_ekf"])
def test_the_thesis_filters_refuse_a_lag(name: str) -> None:
    with pytest.raises(graph.GraphError, match=f"filter {name} cannot smooth"):
        Bench(name, lag=LAG)
