"""The smoothers are the one of Rauch, Tung and Striebel, know more than the filter, and mix no two stretches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.filters import smoother
from body_tracking.filters.ekf import EkfParameters, ExtendedKalmanFilter, sensor_errors
from body_tracking.filters.linear import FilterError
from body_tracking.filters.smoother import FixedLagSmoother, Smoothed, smooth
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.random_people import (
    ARMS,
    MODEL,
    START_NS,
    Dropout,
    MeasurementErrors,
    RandomMotion,
    RandomPerson,
    Truth,
    capture_times,
    observe,
    truth_of,
)
from draws import draws

Recording = list[tuple[str, Skeleton]]
NV, NL = MODEL.nv, len(MODEL.length_names)
LONG = 1e4
"""Seconds; a lag longer than any recording."""


def recorded(
    seed: int, duration: float, noise: float, errors: MeasurementErrors | None = None
) -> tuple[Truth, Recording]:
    """A random person who moves at random, and every frame of one sensor."""
    rng = np.random.default_rng(seed)
    motion = RandomMotion(rng, duration)
    truth = truth_of(RandomPerson.draw(rng), motion, capture_times(duration, rng))
    seen = observe(truth, replace(errors or MeasurementErrors(noise), noise=noise), rng)
    return truth, [("", skeleton) for skeleton in seen.skeletons]


def lagged(
    frames: Recording, lag_s: float, parameters: EkfParameters | None = None
) -> list[tuple[Skeleton, ModelEstimate]]:
    """All outputs of a fixed-lag smoother for a recording."""
    live = FixedLagSmoother(lag_s, parameters)
    return live_outputs(live, frames) + live.flush()


def filtered(frames: Recording, parameters: EkfParameters | None = None) -> list[tuple[Skeleton, ModelEstimate]]:
    """All outputs of the filter for a recording."""
    return live_outputs(ExtendedKalmanFilter(parameters), frames)


def live_outputs(
    live: FixedLagSmoother | ExtendedKalmanFilter, frames: Recording
) -> list[tuple[Skeleton, ModelEstimate]]:
    outputs = []
    for sensor, skeleton in frames:
        result = live.update(skeleton, sensor)
        if result is not None:
            assert live.estimate is not None
            outputs.append((result, live.estimate))
    return outputs


def outputs_of(smoothed: Smoothed) -> list[tuple[Skeleton, ModelEstimate]]:
    return [
        (skeleton, estimate)
        for skeleton, estimate in zip(smoothed.skeletons, smoothed.estimates, strict=True)
        if skeleton is not None and estimate is not None
    ]


def assert_same(
    some: list[tuple[Skeleton, ModelEstimate]], others: list[tuple[Skeleton, ModelEstimate]], tolerance: float
) -> None:
    assert [skeleton.stamp_ns for skeleton, _ in some] == [skeleton.stamp_ns for skeleton, _ in others]
    for (skeleton, estimate), (other_skeleton, other) in zip(some, others, strict=True):
        assert estimate.stamp_ns == other.stamp_ns == skeleton.stamp_ns
        assert_array_equal(skeleton.states, other_skeleton.states)
        assert_allclose(skeleton.positions, other_skeleton.positions, atol=tolerance)
        assert_allclose(MODEL.difference(estimate.q, other.q), 0.0, atol=tolerance)
        assert_allclose(estimate.velocity, other.velocity, atol=10 * tolerance)
        assert_allclose(estimate.lengths, other.lengths, atol=tolerance)
        assert_allclose(estimate.covariance, other.covariance, atol=10 * tolerance)


def instant(truth: Truth, skeleton: Skeleton) -> int:
    """The nearest one of which the truth is known."""
    return int(np.abs(truth.times - (skeleton.stamp_ns - START_NS) / NANOSECONDS).argmin())


def rest(rng: np.random.Generator, frames: int, size: float) -> Recording:
    """A person who all but stands still in a pose that shows every angle, wherever the pose is seen from."""
    q = MODEL.neutral()
    bent = np.zeros(NV)
    names = list(MODEL.coordinate_names)
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        bent[names.index(f"elbow_flexion_{side}")] = 1.0
        bent[names.index(f"shoulder_y_{side}")] = -0.7
        bent[names.index(f"shoulder_x_{side}")] = 0.5 * outwards
    times = np.arange(frames) / 30.0
    swing = np.sin(rng.uniform(1.0, 6.0, NV) * times[:, None] + rng.uniform(0.0, 6.0, NV))
    poses = MODEL.integrate(MODEL.integrate(q, bent), size * swing)
    positions = np.full((frames, N_JOINTS, 3), np.nan)
    positions[:, MODEL.joints] = MODEL.forward(poses, MODEL.default_lengths()).positions
    states = np.zeros(N_JOINTS, dtype=np.uint8)
    states[MODEL.joints] = TrackingState.TRACKED
    return [
        ("", Skeleton(START_NS + round(t * NANOSECONDS), "world", p, states))
        for t, p in zip(times, positions, strict=True)
    ]


# --- the recursion


def test_equals_the_rts_smoother_of_filterpy_where_the_filter_is_linear() -> None:
    """Motions so small that the manifold is flat: the same states through filterpy's textbook recursion."""
    parameters = EkfParameters(density_rate=0.0, posture=False)
    live = FixedLagSmoother(LONG, parameters)
    ekf = live.filter
    states = []
    for _, skeleton in rest(np.random.default_rng(1), 40, 1e-4):
        live.update(skeleton)
        if ekf._state is not None:
            states.append(ekf._state)
    # the first of them were not returned, as the filter waited to know the noise
    outputs = live.flush()
    assert len(outputs) == len(states) > 30

    origin = states[0]
    slow_sizes = [s.crosses.shape[1] for s in states]
    size = 2 * NV + NL
    full = size + max(slow_sizes)
    means, covariances, transitions, noises = [], [], [np.eye(full)], [np.zeros((full, full))]
    for state, after in zip(states, [*states[1:], None], strict=True):
        means.append(np.zeros(full))
        means[-1][:size] = np.concatenate(
            [MODEL.difference(origin.q, state.q), state.lengths - origin.lengths, state.velocity]
        )
        covariances.append(np.eye(full))
        covariances[-1][:size, :size] = state.covariance
        cross = state.cross("")
        if cross is not None:
            covariances[-1][:size, size:] = cross
            covariances[-1][size:, :size] = cross.T
        if after is None:
            break
        dt = (after.stamp_ns - state.stamp_ns) / NANOSECONDS
        fade = np.exp(-dt / parameters.velocity_time)
        slow_fade = np.exp(-dt / parameters.slow_time)
        transition = np.eye(full)
        reach = parameters.velocity_time * (1.0 - fade)
        transition[:NV, NV + NL : size] = reach * np.eye(NV)
        for rows in MODEL.ball_v:
            transition[np.ix_(rows, rows)] = Rotation.from_rotvec(-reach * state.velocity[rows]).as_matrix()
        transition[NV + NL : size, NV + NL : size] *= fade
        transition[size:, size:] *= slow_fade
        noise = (1.0 - slow_fade**2) * np.eye(full)
        noise[:size, :size] = (
            ekf._motion.predicted(state, after.stamp_ns).covariance
            - transition[:size, :size] @ state.covariance @ transition[:size, :size].T
        )
        transitions.append(transition)
        noises.append(noise)
    expected, expected_covariances, _, _ = KalmanFilter(dim_x=full, dim_z=1).rts_smoother(
        np.array(means), np.array(covariances), transitions, noises
    )
    corrected = np.abs(expected - means).max(axis=0)[:NV].max()
    for number, (_, estimate) in enumerate(outputs):
        assert_allclose(MODEL.difference(origin.q, estimate.q), expected[number, :NV], atol=1e-2 * corrected)
        keep = np.r_[0:NV, NV + NL : size]
        scale = np.sqrt(np.diag(expected_covariances[number])[keep])
        assert_allclose(
            estimate.covariance / np.outer(scale, scale),
            expected_covariances[number][np.ix_(keep, keep)] / np.outer(scale, scale),
            atol=1e-6,
        )


def test_moves_errors_as_the_filter_does() -> None:
    """What the filter's prediction adds to the errors that are moved is the white noise of each coordinate alone."""
    _, frames = recorded(3, 1.5, 0.01)
    ekf = ExtendedKalmanFilter()
    for sensor, skeleton in frames:
        ekf.update(skeleton, sensor)
    state = ekf._state
    assert state is not None
    # a fast turn, so that the tangent turns with it
    state = replace(state, velocity=np.random.default_rng(0).normal(scale=5.0, size=NV))
    later = state.stamp_ns + NANOSECONDS // 10
    backward = smoother._Backward(ekf)
    moved = backward._moved(state, later, backward._moved(state, later, state.covariance).T)
    added = ekf._motion.predicted(state, later).covariance - moved
    blocks = np.zeros_like(added)
    for first in (0, NV + NL):
        for second in (0, NV + NL):
            blocks[np.arange(NV) + first, np.arange(NV) + second] = 1.0
    assert_allclose(added * (1.0 - blocks), 0.0, atol=1e-12)
    assert np.linalg.eigvalsh(added).min() > -1e-12
    assert np.diag(added)[:NV].min() > 0.0


def test_a_lag_as_long_as_the_recording_is_the_full_smoother_and_none_the_filter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So is what the full one keeps of the forward pass, section by section; it has the same lengths in all frames."""
    _, frames = recorded(4, 2.0, 0.01)
    shares: list[float] = []
    monkeypatch.setattr(smoother, "_SECTION", 13)
    full = outputs_of(smooth(frames, learn=False, progress=shares.append))
    assert_same(full, lagged(frames, LONG), 1e-9)
    assert_same(lagged(frames, 0.0), filtered(frames), 1e-12)
    assert np.ptp([estimate.lengths for _, estimate in outputs_of(smooth(frames))], axis=0).max() < 1e-9
    assert shares == sorted(shares)
    assert len(shares) >= len(frames) // 13
    assert shares[-1] == 1.0


def gained(before: list[tuple[Skeleton, ModelEstimate]], after: list[tuple[Skeleton, ModelEstimate]]) -> FloatArray:
    """(n, 64, 64) by how much the covariances are smaller, as shares of the variances before."""
    old, new = (np.array([estimate.covariance for _, estimate in outputs]) for outputs in (before, after))
    scale = np.sqrt(np.diagonal(old, axis1=1, axis2=2))
    return np.asarray((old - new) / (scale[:, :, None] * scale[:, None, :]))


def test_is_never_less_certain_than_a_filter_that_estimates_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the positive semidefinite sense, of the tangent and the velocities."""
    monkeypatch.setattr(sensor_errors, "_LEAST_ERROR", 0.0)  # slow errors are not estimated
    parameters = EkfParameters(posture=False, slow_scale=0.0, settle_stddev=1e-5, settle_time=1e5)
    frames = rest(np.random.default_rng(2), 60, 1e-3)
    shares = np.linalg.eigvalsh(gained(filtered(frames, parameters), lagged(frames, LONG, parameters)))
    assert shares.min() > -1e-9
    assert shares[0].max() > 0.5


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_is_never_less_certain_of_an_angle_than_the_filter(noise: float) -> None:
    """With errors that are only considered the filter's gains are not the best: that may cost a tenth of a variance."""
    _, frames = recorded(6, 3.0, noise)
    after = lagged(frames, LONG)
    shares = np.diagonal(gained(filtered(frames), after), axis1=1, axis2=2)
    assert shares.min() > -0.1
    assert shares[:-15].mean() > 0.4
    assert np.linalg.eigvalsh(np.array([estimate.covariance for _, estimate in after])).min() > 0.0


# --- against the truth


@pytest.mark.parametrize("noise", [0.005, pytest.param(0.02, marks=pytest.mark.slow)])
def test_is_nearer_to_the_truth_than_the_filter_and_says_by_how_much(noise: float) -> None:
    # The pitch of the pelvis, and lumbar flexion with it, hang on a lever of 3 cm: with 20 mm of noise they are far
    # from linear, and the smoother is too sure of them (truth in its band in 68 %); its docstring says so.
    weak = (*UNOBSERVED, "base_ry", "lumbar_flexion")
    observed = np.array([name not in weak for name in MODEL.coordinate_names])
    errors: dict[str, list[FloatArray]] = {"filter": [], "lag": [], "full": []}
    inside = []
    for seed in range(11, 11 + draws(1, 4)):  # of ten recordings at 5 mm: 0.69-0.75, 0.68-0.74 and 0.97-0.99
        truth, frames = recorded(seed, 4.0, noise)
        for name, outputs in (
            ("filter", filtered(frames)),
            ("lag", lagged(frames, 0.2)),
            ("full", outputs_of(smooth(frames))),
        ):
            # the first second finds the person, the last 0.2 s of the live one have no later frames
            for skeleton, estimate in outputs:
                at = instant(truth, skeleton)
                if 1.0 < truth.times[at] < 3.8:
                    errors[name].append(skeleton.positions[MODEL.joints] - truth.positions[at])
                    if name == "full":
                        off = MODEL.difference(estimate.q, truth.q[at])[observed]
                        inside.append(np.abs(off) < 1.96 * np.sqrt(np.diag(estimate.covariance)[:NV][observed]))
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in errors.items()}
    assert rms["lag"] < 0.8 * rms["filter"]
    assert rms["full"] < 0.8 * rms["filter"]
    assert rms["full"] < 1.05 * rms["lag"]
    # honest would be 0.95: at 20 mm the full smoother is too sure of forearms and wrists, too, as its docstring says
    assert np.mean(inside) > (0.88 if noise < 0.01 else 0.83)


def test_bridges_a_dropout_from_both_sides() -> None:
    """Where an arm is out of sight, later frames show where it was."""
    arm = ARMS["LEFT"]
    dropout = Dropout(2.0, 2.5, arm)
    errors: dict[str, list[FloatArray]] = {"filter": [], "full": []}
    for seed in range(20, 20 + draws(1, 5)):
        truth, frames = recorded(seed, 3.5, 0.005, MeasurementErrors(0.005, dropouts=(dropout,)))
        for name, outputs in (("filter", filtered(frames)), ("full", lagged(frames, LONG))):
            for skeleton, _ in outputs:
                at = instant(truth, skeleton)
                if 2.0 <= truth.times[at] < 2.5:
                    errors[name].append(
                        (skeleton.positions[MODEL.joints] - truth.positions[at])[np.isin(MODEL.joints, arm)]
                    )
    assert np.mean(np.square(errors["full"])) < 0.5**2 * np.mean(np.square(errors["filter"]))


# --- what breaks the chain


def test_a_gap_splits() -> None:
    """What lies before it is smoothed as if nothing came after."""
    _, frames = recorded(8, 3.4, 0.01, MeasurementErrors(0.01, gaps=((0.7, 2.7),)))
    result = smooth(frames, learn=False)
    before = [pair for pair in frames if pair[1].stamp_ns < START_NS + 0.7 * NANOSECONDS]
    assert_array_equal(np.unique(result.stretches[: len(before)]), [-1, 0])
    assert_array_equal(np.unique(result.stretches[len(before) :]), [1])
    assert result.counters["gaps"] == 1
    alone = outputs_of(smooth(before, learn=False))
    assert_same(outputs_of(result)[: len(alone)], alone, 1e-9)
    assert_same(lagged(frames, LONG), outputs_of(result), 1e-9)
    assert set(smooth(frames).stretches) == {0, 1}


def test_a_restart_splits() -> None:
    """A person who is elsewhere of a sudden was not on the way there."""
    truth, frames = recorded(9, 3.0, 0.01)
    jump = len(frames) // 2
    away = np.array([1.5, 0.0, 0.0])
    moved = frames[:jump] + [(s, replace(k, positions=k.positions + away)) for s, k in frames[jump:]]
    result = smooth(moved, learn=False)
    assert result.counters["restarts"] >= 1
    assert result.stretches.max() >= 1
    outputs = outputs_of(result)
    first = [pair for pair in outputs if pair[0].stamp_ns < moved[jump][1].stamp_ns]
    errors = [
        s.positions[MODEL.joints] - truth.positions[k + len(moved) - len(outputs)] for k, (s, _) in enumerate(first)
    ]
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_a_jump_of_time_and_another_frame_of_reference_split() -> None:
    _, frames = recorded(10, 1.0, 0.01)
    earlier = [(s, replace(k, stamp_ns=k.stamp_ns - 100 * NANOSECONDS)) for s, k in frames]
    elsewhere = [(s, replace(k, stamp_ns=k.stamp_ns + 2 * NANOSECONDS, frame_id="map")) for s, k in frames]
    once = lagged(frames, LONG)
    thrice = lagged(frames + earlier + elsewhere, LONG)
    assert len(thrice) == 3 * len(once)
    for number, frame_id in enumerate(("world", "world", "map")):
        part = thrice[number * len(once) : (number + 1) * len(once)]
        assert {estimate.frame_id for _, estimate in part} == {frame_id}
        assert_allclose([s.positions for s, _ in part], [s.positions for s, _ in once], atol=1e-9)


# --- live


def test_tells_every_frame_once_and_about_a_lag_ago() -> None:
    _, frames = recorded(14, 4.0, 0.01, MeasurementErrors(0.01, gaps=((1.0, 1.3), (2.0, 2.2))))
    live = FixedLagSmoother(0.2)
    stamps = []
    for sensor, skeleton in frames:
        result = live.update(skeleton, sensor)
        assert len(live._frames) <= 9  # frames in 0.2 s, and what jitter and gaps leave over
        if result is not None:
            stamps.append(result.stamp_ns)
            assert 0.2 <= (skeleton.stamp_ns - result.stamp_ns) / NANOSECONDS < 0.2 + 0.4
    stamps += [skeleton.stamp_ns for skeleton, _ in live.flush()]
    assert stamps == [skeleton.stamp_ns for skeleton, _ in filtered(frames)]
    assert live.flush() == []
    # and goes on
    sensor, skeleton = frames[-1]
    following = replace(skeleton, stamp_ns=skeleton.stamp_ns + NANOSECONDS // 30)
    assert live.update(following, sensor) is None
    assert [s.stamp_ns for s, _ in live.flush()] == [following.stamp_ns]


def test_a_late_frame_takes_its_place() -> None:
    """Two sensors, the frames of one of which arrive 100 ms late: the same as if they had come in time."""
    _, frames = recorded(15, 1.5, 0.01)
    two = [("ab"[k % 2], skeleton) for k, (_, skeleton) in enumerate(frames)]
    arrival = [skeleton.stamp_ns + (sensor == "b") * NANOSECONDS // 10 for sensor, skeleton in two]
    start = 12  # the person is found before it gets difficult
    late = two[:start] + [two[k] for k in sorted(range(start, len(two)), key=arrival.__getitem__)]
    assert late != two
    in_time = lagged(two, LONG)
    for lag_s in (0.15, LONG):
        outputs = lagged(late, lag_s)
        assert [skeleton.stamp_ns for skeleton, _ in outputs] == [skeleton.stamp_ns for skeleton, _ in in_time]
    assert_same(outputs, in_time, 1e-9)


def test_reset_forgets() -> None:
    _, frames = recorded(16, 1.0, 0.01)
    live = FixedLagSmoother(0.1)
    outputs = live_outputs(live, frames)
    live.reset()
    assert live.estimate is None
    assert live.flush() == []
    assert_same(live_outputs(live, frames), outputs, 0.0)


# --- borders


def test_takes_frames_in_any_order_and_answers_in_that() -> None:
    _, frames = recorded(17, 1.0, 0.01)
    order = np.random.default_rng(0).permutation(len(frames))
    straight = smooth(frames)
    shuffled = smooth([frames[k] for k in order])
    for one, k in zip(shuffled.skeletons, order, strict=True):
        other = straight.skeletons[k]
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            assert one.stamp_ns == frames[k][1].stamp_ns
            assert_array_equal(one.positions, other.positions)
    assert_array_equal(shuffled.stretches, straight.stretches[order])


def test_a_recording_of_nobody_says_nothing() -> None:
    empty = smooth([])
    assert (empty.skeletons, empty.estimates, len(empty.stretches)) == ((), (), 0)
    nothing = np.full((N_JOINTS, 3), np.nan)
    empty = [("", Skeleton(k * NANOSECONDS // 30, "world", nothing, np.zeros(N_JOINTS, np.uint8))) for k in range(9)]
    result = smooth(empty)
    assert set(result.skeletons) == set(result.estimates) == {None}
    assert_array_equal(result.stretches, -1)
    live = FixedLagSmoother(0.1)
    assert [live.update(skeleton) for _, skeleton in empty] == [None] * 9
    assert live.estimate is None
    assert live.flush() == []


@pytest.mark.parametrize("lag_s", [-0.1, np.nan, np.inf])
def test_refuses_lags_that_are_none(lag_s: float) -> None:
    with pytest.raises(FilterError, match="smoother lag"):
        FixedLagSmoother(lag_s)
