"""The extended filter follows unknown people with consistent covariances, and survives bad input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from estimates import assert_same, known
from numpy.testing import assert_allclose, assert_array_equal
from random_people import (
    ARMS,
    EVERYTHING,
    START_NS,
    Dropout,
    MeasurementErrors,
    Observation,
    RandomPerson,
    Truth,
    capture_times,
    observe,
    truth_of,
)
from scipy.stats import chi2

from body_tracking.core.measurement import BASE_STDDEV, joint_correlation
from body_tracking.core.skeleton import (
    MIRROR,
    N_JOINTS,
    NANOSECONDS,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)
from body_tracking.core.so3 import wrapped
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.kinematics.compiled_posture import prior_rows, prior_table
from body_tracking.kinematics.conventions import angles_of
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws, some
from walkers import TRACKED

POINTS = MODEL.joints
OBSERVED = np.array([number for number, name in enumerate(MODEL.coordinate_names) if name not in UNOBSERVED])
NOISE = 0.02
START_FRAMES = 4
"""The first output comes with this frame of a sensor."""
SETTLED = 1.0
"""Seconds after which the filter knows noise, pose and velocities."""


def random_truth(seed: int, seconds: float, rate: float = 30.0, tempo: float | None = None) -> Truth:
    rng = np.random.default_rng(seed)
    person = RandomPerson.draw(rng)
    return truth_of(person, RandomMotion(rng, seconds, tempo), capture_times(seconds, rng, rate))


def measured(truth: Truth, noise: float = NOISE, seed: int = 0, **errors: object) -> Observation:
    return observe(truth, MeasurementErrors(noise, **errors), np.random.default_rng(seed))  # type: ignore[arg-type]


def run(estimator: ExtendedKalmanFilter, skeletons: Sequence[Skeleton], first: int = 0) -> list[Skeleton | None]:
    """The outputs, from the frame of that number on: each takes a third of the time."""
    feed(estimator, skeletons[:first])
    return [None] * first + [estimator.update(skeleton) for skeleton in skeletons[first:]]


def feed(estimator: ExtendedKalmanFilter, skeletons: Iterable[Skeleton]) -> None:
    for skeleton in skeletons:
        estimator.take(skeleton)


def errors_of(outputs: Sequence[Skeleton | None], truth: Truth, after: float = SETTLED) -> FloatArray:
    """(n, 19) metres between the output and the truth, of the frames with an output after so many seconds."""
    frames = [k for k, output in enumerate(outputs) if output is not None and truth.times[k] >= after]
    positions = np.stack([output.positions[POINTS] for k in frames if (output := outputs[k]) is not None])
    errors: FloatArray = np.linalg.norm(positions - truth.positions[frames], axis=-1)
    return errors


def rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).mean()))


def stddevs(skeleton: Skeleton) -> FloatArray:
    """(19,) metres: greatest standard deviation over the axes."""
    assert skeleton.covariances is not None
    result: FloatArray = np.sqrt(np.linalg.eigvalsh(skeleton.covariances[POINTS])[:, -1])
    return result


def assert_sound(outputs: Iterable[Skeleton | None], estimator: ExtendedKalmanFilter) -> None:
    """No NaN, no infinity, no variance below zero."""
    for output in outputs:
        if output is not None:
            assert output.covariances is not None and output.velocities is not None
            assert np.isfinite(output.positions[POINTS]).all() and np.isfinite(output.velocities[POINTS]).all()
            assert np.isfinite(output.covariances[POINTS]).all()
            assert (np.linalg.eigvalsh(output.covariances[POINTS]) > 0.0).all()
    estimate = estimator.estimate
    if estimate is not None:
        for name in ("q", "velocity", "covariance", "lengths", "lengths_stddev"):
            assert np.isfinite(getattr(estimate, name)).all(), name
        assert (estimate.covariance.diagonal() > 0.0).all() and (estimate.lengths > 0.0).all()


# --- following


@pytest.mark.parametrize("noise", some([0.05, 0.005]))
def test_it_follows_a_moving_person_closer_than_the_measurements(noise: float) -> None:
    truth = random_truth(1, 2.0)
    estimator = ExtendedKalmanFilter()
    outputs = run(estimator, measured(truth, noise).skeletons)
    assert [output is None for output in outputs] == [k < START_FRAMES - 1 for k in range(len(outputs))]
    raw = np.sqrt(3.0) * noise
    assert rms(errors_of(outputs, truth)) < 0.9 * raw
    last = outputs[-1]
    assert last is not None and last.velocities is not None
    assert_array_equal(last.states[POINTS], TrackingState.TRACKED)
    others = np.setdiff1d(np.arange(N_JOINTS), POINTS)
    assert_array_equal(last.states[others], TrackingState.NOT_TRACKED)
    assert_sound(outputs, estimator)


OFFSETS_COVERED = 0.87
"""Share of the coordinates within their 95 % bands, of 120 people whose joint centres are seen displaced as stated. A
defect of the filter, which should reach 0.90."""


def test_joint_centre_offsets_are_in_the_published_covariance() -> None:
    """Constant offsets of the deviation and correlation that the measurement model states, in random poses."""
    root = np.linalg.cholesky(joint_correlation())
    rng = np.random.default_rng(5)
    stated = np.broadcast_to(np.diag([0.03**2] * 3), (N_JOINTS, 3, 3))
    # for forearms and hands the covariance holds to first order only
    near = np.array([k for k in OBSERVED if not MODEL.coordinate_names[k].startswith(("forearm", "wrist"))])
    considered, ignored = [], []
    count = draws(5, 60)
    for seed in range(count):
        truth = random_truth(100 + seed, 1.0, rate=15.0)
        offsets = BASE_STDDEV[:, None] * (root @ rng.normal(size=(N_JOINTS, 3)))
        frames = [
            replace(frame, positions=frame.positions + offsets, covariances=stated)
            for frame in measured(truth, 0.004, seed).skeletons
        ]
        estimates = []
        for parameters in (EkfParameters(posture=False), EkfParameters(posture=False, offset_scale=0.0)):
            estimator = ExtendedKalmanFilter(parameters)
            feed(estimator, frames)
            estimates.append(known(estimator))
        assert_array_equal(estimates[0].q, estimates[1].q)
        for estimate, found in zip(estimates, (considered, ignored), strict=True):
            error = MODEL.difference(estimate.q, truth.q[-1])[near]
            found.append(np.mean(error**2 / estimate.covariance.diagonal()[near] < chi2.ppf(0.95, 1)))
    # people are independent, the coordinates of one are not
    spread = np.std(considered, ddof=1) / np.sqrt(count)
    assert OFFSETS_COVERED - 3.3 * spread < np.mean(considered) < 0.99
    gain = np.subtract(considered, ignored)
    assert gain.mean() > 3.3 * gain.std(ddof=1) / np.sqrt(count)


def test_offsets_of_a_sensor_that_states_to_see_poorly_are_larger() -> None:
    """From the side a Kinect displaces joints three times as far, which it states, and no innovation shows.

    Beside another sensor that sees them well, hardly anything changes.
    """
    truth = random_truth(100, 1.5)
    near = [k for k in OBSERVED if MODEL.coordinate_names[k].startswith(("shoulder", "elbow"))]
    good = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
    deviations = []
    for factors in ((1.0,), (9.0,), (1.0, 1.0), (1.0, 9.0)):
        estimator = ExtendedKalmanFilter(EkfParameters(posture=False))
        for frame in measured(truth, 0.004).skeletons:
            for place, factor in enumerate(factors):
                seen = replace(frame, stamp_ns=frame.stamp_ns + place * 5_000_000, covariances=factor * good)
                estimator.take(seen, f"sensor {place}")
        deviations.append(np.sqrt(known(estimator).covariance.diagonal()[near]))
        later = estimator.predict(known(estimator).stamp_ns + NANOSECONDS // 2)
        assert later is not None  # what nobody sees is known no better
        assert (np.sqrt(later[1].covariance.diagonal()[near]) > 0.99 * deviations[-1]).all()
    front, side, two, beside = deviations
    assert (side > 2.0 * front).all(), side / front
    assert (beside < 1.6 * two).all(), beside / two


def test_contradicting_sensors_cause_no_repeated_restarts() -> None:
    """Four sensors with different constant errors of 4 cm: no pose fits them all, and a search for one is in vain."""
    rng = np.random.default_rng(3)
    truth = random_truth(3, 1.5)
    stated = np.broadcast_to(np.diag([0.03**2] * 3), (N_JOINTS, 3, 3))
    offsets = {name: 0.04 * rng.normal(size=(N_JOINTS, 3)) for name in "abcd"}
    estimator = ExtendedKalmanFilter()
    for frame in measured(truth, 0.004, 3).skeletons:
        for place, (name, offset) in enumerate(offsets.items()):
            stamp_ns = frame.stamp_ns + place * 8_000_000
            moved = replace(frame, stamp_ns=stamp_ns, positions=frame.positions + offset, covariances=stated)
            estimator.take(moved, name)
    assert estimator.counters["restarts"] <= 1  # with a search every quarter of a second: one in 0.4 s


def test_its_uncertainty_is_true() -> None:
    """The normalised estimation error squared of the observed coordinates is chi-square with as many degrees.

    So are normalised innovations.
    """
    for_angles, for_points, for_lengths = [], [], []
    distance, dimension, frames = 0.0, 0, 0
    for seed in range(draws(1, 10)):
        truth = random_truth(20 + seed, 4.0)
        observation = measured(truth, 0.01 + 0.005 * (seed % 5), seed)
        estimator = ExtendedKalmanFilter()
        for skeleton, k in zip(observation.skeletons, observation.frames, strict=True):
            output = estimator.update(skeleton)
            if output is None or truth.times[k] < SETTLED:
                continue
            distance += estimator.innovation_distance
            dimension += estimator.innovation_dimension
            frames += 1
            estimate = known(estimator)
            error = MODEL.difference(estimate.q, truth.q[k])[OBSERVED]
            for_angles.append(error @ np.linalg.solve(estimate.covariance[np.ix_(OBSERVED, OBSERVED)], error))
            assert output.covariances is not None
            off = truth.positions[k] - output.positions[POINTS]
            for_points.append(np.einsum("pi,pij,pj->p", off, np.linalg.inv(output.covariances[POINTS]), off).mean())
        estimate = known(estimator)
        for_lengths.append((((truth.lengths - estimate.lengths) / estimate.lengths_stddev) ** 2).mean())
    assert 0.5 < np.mean(for_angles) / len(OBSERVED) < 1.6, np.mean(for_angles) / len(OBSERVED)
    assert 0.5 < np.mean(for_points) / 3.0 < 1.6, np.mean(for_points) / 3.0
    assert 0.3 < np.mean(for_lengths) < 2.5, for_lengths
    assert dimension > 0.95 * 57 * frames
    assert 0.8 < distance / dimension < 1.25


def test_lengths_stay_once_they_are_known_and_the_output_has_them() -> None:
    truth = random_truth(2, 5.0)
    estimator = ExtendedKalmanFilter(EkfParameters(settle_time=3.0))
    found = []
    for skeleton in measured(truth).skeletons:
        output = estimator.update(skeleton)
        if output is None:
            continue
        estimate = known(estimator)
        assert_allclose(
            output.positions[POINTS], MODEL.forward(estimate.q, estimate.lengths).positions, rtol=0.0, atol=1e-12
        )
        found.append((skeleton.stamp_ns, estimate.lengths))
    settled = np.stack([lengths for stamp_ns, lengths in found if stamp_ns > START_NS + 3.2 * NANOSECONDS])
    assert len(settled) > 50
    assert np.abs(settled - settled[0]).max() < 1e-9
    assert np.abs(settled[0] - found[0][1]).max() > 1e-3  # they had been learnt before
    assert np.abs(settled[0] - truth.lengths).max() < 0.5 * np.abs(found[0][1] - truth.lengths).max()


@pytest.mark.parametrize("seed", range(draws(3, 8)))
def test_hips_level_with_the_spine_give_lengths_that_a_body_may_have(seed: int) -> None:
    """Noise must not make the drop of the hips negative, which nothing that draws the body takes."""
    lengths = MODEL.default_lengths()
    lengths[MODEL.length_names.index("hip_drop")] = 0.0
    positions = np.zeros((N_JOINTS, 3))
    positions[POINTS] = MODEL.forward(MODEL.neutral(), lengths).positions + [2.5, 0.0, 1.0]
    rng = np.random.default_rng(seed)
    estimator = ExtendedKalmanFilter()
    least = np.inf
    for number in range(60):
        noisy = positions + rng.normal(scale=0.004, size=positions.shape)
        estimator.update(Skeleton(START_NS + number * NANOSECONDS // 30, "world", noisy, TRACKED))
        if estimator.estimate is not None:
            least = min(least, estimator.estimate.lengths.min())
    assert 0.004 < least < np.inf


def test_lengths_come_from_many_poses_once_there_are_some() -> None:
    """After some seconds the lengths change once a second at most, and the rest of the state follows them."""
    truth = random_truth(14, 10.0)
    observation = measured(truth)
    estimator = ExtendedKalmanFilter()
    both = np.append(OBSERVED, np.arange(MODEL.nv, MODEL.nv + len(MODEL.length_names)))
    changes, normalised = [], []
    before = None
    for skeleton, k in zip(observation.skeletons, observation.frames, strict=True):
        estimator.take(skeleton)
        state = estimator._state
        if state is None or not state.settled:
            continue
        error = np.concatenate([MODEL.difference(state.q, truth.q[k]), truth.lengths - state.lengths])[both]
        normalised.append(error @ np.linalg.solve(state.covariance[np.ix_(both, both)], error))
        if before is not None and np.abs(state.lengths - before).max() > 0.0:
            changes.append(truth.times[k])
        before = state.lengths
    assert 2 <= len(changes) <= 6 and np.diff(changes).min() > 0.9
    assert np.abs(known(estimator).lengths - truth.lengths).max() < 0.02
    # errors of pose and lengths agree with their joint covariance
    assert 0.4 < np.mean(normalised) / len(both) < 1.6, np.mean(normalised) / len(both)


def test_a_person_who_seems_turned_around_keeps_the_lengths() -> None:
    truth = random_truth(16, 8.5)
    skeletons = list(measured(truth).skeletons)
    # as a Kinect does with a person seen from behind: left and right change places for some seconds
    turned = [
        replace(each, positions=each.positions[MIRROR]) if 5.0 < time < 7.0 else each
        for each, time in zip(skeletons, truth.times, strict=True)
    ]
    estimator = ExtendedKalmanFilter()
    feed(estimator, turned)
    assert estimator.counters["restarts"] >= 1
    assert np.abs(known(estimator).lengths - truth.lengths).max() < 0.02


def test_another_person_of_another_size_is_learnt_anew() -> None:
    truth = random_truth(18, 10.0)
    skeletons = [
        replace(each, positions=0.65 * each.positions) if time > 5.0 else each
        for each, time in zip(measured(truth).skeletons, truth.times, strict=True)
    ]
    estimator = ExtendedKalmanFilter()
    feed(estimator, skeletons)
    assert_allclose(known(estimator).lengths, 0.65 * truth.lengths, rtol=0.0, atol=0.02)


def arm_elsewhere(rng: np.random.Generator) -> tuple[list[Joint], FloatArray]:
    """The joints of an arm from the elbow on, and by how much a camera moves them, 0.35 m."""
    offset = rng.normal(size=3)
    side = rng.choice(["LEFT", "RIGHT"])
    arm = [Joint[f"{joint}_{side}"] for joint in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")]
    return arm, 0.35 * offset / np.linalg.norm(offset)


def test_a_pose_that_jumps_states_how_far() -> None:
    """After a jump the deviations say that either pose may be wrong: a camera moves an arm elsewhere for 0.6 s."""
    jumps, misleading = 0, 0
    for seed in range(draws(3, 60)):
        truth = random_truth(seed, 3.2)
        arm, offset = arm_elsewhere(np.random.default_rng([seed, 7]))
        estimator, angles = ExtendedKalmanFilter(), None
        found = []
        for skeleton, time in zip(measured(truth).skeletons, truth.times, strict=True):
            if 2.0 < time < 2.6:
                positions = skeleton.positions.copy()
                positions[arm] += offset
                skeleton = replace(skeleton, positions=positions)
            if estimator.take(skeleton) and time > 1.9:
                angles = angles_of(known(estimator), MODEL, "model", angles)
                found.append((angles.position, angles.position_stddev))
        position, stddev = np.array(found).swapaxes(0, 1)
        far = np.abs(wrapped(np.diff(position, axis=0))) > np.radians(60.0)
        jumps += int(far.sum())
        misleading += int((far & (np.maximum(stddev[1:], stddev[:-1]) < np.radians(15.0))).sum())
    # 2 of 188 over 60 people: a shoulder's angles switch to the equivalent triple
    assert jumps >= draws(6, 120) and misleading <= 0.02 * jumps, (jumps, misleading)


def test_one_sensor_that_sees_an_arm_elsewhere_does_not_move_it_there() -> None:
    """A camera at the side guesses a hidden arm; only that camera sees the hand, so that a new pose is searched for."""
    away, restarts = [], 0
    for seed in range(draws(2, 20)):
        truth = random_truth(seed, 4.0)
        arm, offset = arm_elsewhere(np.random.default_rng([seed, 8]))
        estimator = ExtendedKalmanFilter()
        frames = zip(measured(truth).skeletons, measured(truth, seed=1).skeletons, truth.times, strict=True)
        for number, (front, beside, time) in enumerate(frames):
            for name, skeleton in (("front", front), ("beside", beside)):
                positions, states = skeleton.positions.copy(), skeleton.states.copy()
                if time > 2.0 and name == "beside":
                    positions[arm] += offset
                if time > 1.9 and name == "front":
                    states[arm[2:]] = TrackingState.NOT_TRACKED
                    positions[arm[2:]] = np.nan
                stamp_ns = skeleton.stamp_ns + (NANOSECONDS // 100 if name == "beside" else 0)
                estimator.take(replace(skeleton, stamp_ns=stamp_ns, positions=positions, states=states), name)
            if time > 2.1:
                found = MODEL.forward(known(estimator).q, known(estimator).lengths).positions
                elbow = list(POINTS).index(arm[0])
                away.append(float(np.linalg.norm(found[elbow] - truth.positions[number][elbow])))
        restarts += estimator.counters["restarts"]
    # 93 % over 20 people; 44 % over 2 where the frame of one sensor alone decides
    assert np.mean(np.array(away) < 0.15) > 0.88, (np.mean(np.array(away) < 0.15), restarts)


def test_deviations_do_not_alternate_where_one_of_two_sensors_sees_an_arm_elsewhere() -> None:
    """After a frame of either sensor they are nearly those after the other's."""
    ratios: list[float] = []
    for seed in range(draws(2, 20)):
        truth = random_truth(seed, 3.0)
        arm, offset = arm_elsewhere(np.random.default_rng([seed, 9]))
        estimator, angles = ExtendedKalmanFilter(), None
        after: dict[str, FloatArray] = {}
        frames = zip(measured(truth).skeletons, measured(truth, seed=1).skeletons, truth.times, strict=True)
        for front, beside, time in frames:
            for name, skeleton in (("front", front), ("beside", beside)):
                if time > 2.0 and name == "beside":
                    positions = skeleton.positions.copy()
                    positions[arm] += offset
                    skeleton = replace(skeleton, positions=positions)
                stamp_ns = skeleton.stamp_ns + (NANOSECONDS // 100 if name == "beside" else 0)
                if estimator.take(replace(skeleton, stamp_ns=stamp_ns), name) and time > 1.9:
                    angles = angles_of(known(estimator), MODEL, "model", angles)
                    after[name] = angles.position_stddev
            if time > 2.1:
                ratios.append(float((after["beside"] / after["front"]).max()))
    # 99.6 % over 20 people, median 1.04; if a single rejected frame counted, none, median 9.4
    assert np.mean(np.array(ratios) < 1.5) > 0.9, np.quantile(ratios, [0.5, 0.9])


ORIGIN = np.array([-3.0, 5.0, 0.7])


@pytest.mark.parametrize(
    ("signs", "order", "origin"),
    [([1.0, 1.0, 1.0], np.arange(N_JOINTS), ORIGIN), ([1.0, -1.0, 1.0], MIRROR, np.zeros(3))],
    ids=["another origin of world", "mirrored"],
)
def test_it_depends_neither_on_the_origin_of_world_nor_on_the_side(
    signs: list[float], order: IntArray, origin: FloatArray
) -> None:
    here, there = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    for skeleton in measured(random_truth(3, 1.5), outliers=0.02).skeletons:
        one = here.update(skeleton)
        moved = skeleton.positions[order] * signs + origin
        other = there.update(replace(skeleton, positions=moved, states=skeleton.states[order]))
        if one is not None and other is not None:
            back = (other.positions[order] - origin) * signs
            assert_allclose(back[POINTS], one.positions[POINTS], rtol=0.0, atol=1e-6)
    assert here.counters == there.counters


def test_a_shoulder_that_rises_is_followed_although_its_joint_centre_is_offset() -> None:
    """Posture tells where a clavicle is on average; how far it moves, the sensor shows. Shares of the true motion."""
    times = np.arange(0.0, 12.0, 1.0 / 15.0)
    raised = np.radians(12.0) * np.sin(2.0 * np.pi * 0.25 * times)
    sides = ("LEFT", "RIGHT")
    names = [MODEL.coordinate_names[column] for column in MODEL.scalar_v]
    clavicles = [MODEL.scalar_q[names.index(f"clavicle_elevation_{side.lower()}")] for side in sides]
    q = np.tile(MODEL.neutral(), (len(times), 1))
    q[:, clavicles] = raised[:, None]
    stated = np.broadcast_to(np.eye(3), (N_JOINTS, 3, 3)) * BASE_STDDEV[:, None, None] ** 2
    followed = []
    for seed in range(draws(1, 16)):
        rng = np.random.default_rng(70 + seed)
        points = np.full((len(times), N_JOINTS, 3), np.nan)
        points[:, POINTS] = MODEL.linearise(q, RandomPerson.draw(rng).lengths).posture.positions
        for side in sides:
            points[:, [Joint[f"SHOULDER_{side}"], *ARMS[side]]] += rng.normal(scale=0.02, size=3)
        points += rng.normal(scale=0.005, size=points.shape)
        states = np.where(np.isfinite(points[0, :, 0]), TrackingState.TRACKED, 0).astype(np.uint8)
        estimator = ExtendedKalmanFilter()
        found = np.full((len(times), 2), np.nan)
        for frame, (time, each) in enumerate(zip(times, points, strict=True)):
            estimator.update(Skeleton(START_NS + round(time * NANOSECONDS), "world", each, states, covariances=stated))
            if estimator.estimate is not None:
                found[frame] = estimator.estimate.q[clavicles]
        late = times > 4.0
        followed += np.polyfit(raised[late], found[late], 1)[0].tolist()
    assert 0.9 < np.median(followed) < 1.15
    assert np.min(followed) > 0.75


# --- two sensors


def test_two_sensors_are_better_than_either_and_the_better_one_counts_more() -> None:
    """At 20 and 40 mm the plain mean of both would be worse than the better one alone.

    Both are compared with the better one at its stamps: between them the estimate is predicted, and errs by more.
    """
    results = []
    for seed in range(draws(1, 4)):
        rng = np.random.default_rng(40 + seed)
        person, motion = RandomPerson.draw(rng), RandomMotion(rng, 5.0)
        times = capture_times(3.0, rng, 25.0)
        sensors: dict[str, tuple[Skeleton, ...]] = {}
        true: dict[int, FloatArray] = {}
        for name, delay, noise in (("good", 0.0, 0.02), ("poor", 0.013, 0.04)):
            truth = truth_of(person, motion, times + delay)
            sensors[name] = observe(truth, MeasurementErrors(noise), rng).skeletons
            true |= {each.stamp_ns: at for each, at in zip(sensors[name], truth.positions, strict=True)}
        row = []
        for used in (("good",), ("poor",), ("good", "poor")):
            frames = sorted(
                ((skeleton, name) for name in used for skeleton in sensors[name]), key=lambda each: each[0].stamp_ns
            )
            estimator = ExtendedKalmanFilter()
            squares = []
            for skeleton, name in frames:
                output = estimator.update(skeleton, name)
                judged = name == used[0] and skeleton.stamp_ns > START_NS + SETTLED * NANOSECONDS
                if output is not None and judged:
                    off = output.positions[POINTS] - true[skeleton.stamp_ns]
                    squares.append((off**2).sum(axis=1).mean())
            row.append(np.mean(squares))
        results.append(row)
    good, poor, both = np.sqrt(np.mean(results, axis=0))
    assert both < good < poor


@pytest.mark.slow
def test_what_a_sensor_states_to_be_poor_does_not_count_as_good_because_it_was_good_before() -> None:
    """Two sensors err by less than they state, which the filter learns; then one states three times the deviation.

    From then on its left elbow, wrist and hand are beside the arm by 8 cm, as those of a Kinect v2 that sees a person
    from the side. The filter is hardly worse than with the other sensor alone.
    """
    arm = [Joint[f"{name}_LEFT"] for name in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")]
    elbow = list(POINTS).index(Joint.ELBOW_LEFT)
    good = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
    away: tuple[list[float], list[float]] = [], []
    for seed in range(draws(4, 12)):
        truth = random_truth(seed, 4.0)
        rng = np.random.default_rng([seed, 9])
        offsets, direction = rng.normal(0.0, 0.015, (2, N_JOINTS, 3)), rng.normal(size=3)
        alone, both = ExtendedKalmanFilter(), ExtendedKalmanFilter()
        pairs = zip(measured(truth, 0.005).skeletons, measured(truth, 0.005, seed=1).skeletons, strict=True)
        for number, (front, beside) in enumerate(pairs):
            turned = float(np.clip((truth.times[number] - 2.0) / 0.5, 0.0, 1.0))
            seen = replace(front, positions=front.positions + offsets[0], covariances=good)
            alone.take(seen, "front")
            both.take(seen, "front")
            positions = beside.positions + offsets[1]
            positions[arm] += turned * 0.08 * direction / np.linalg.norm(direction)
            poor = good * (1.0 + 8.0 * turned)
            stamp_ns = beside.stamp_ns + NANOSECONDS // 100
            both.take(replace(beside, stamp_ns=stamp_ns, positions=positions, covariances=poor), "beside")
            if turned == 1.0:
                for off, estimator in zip(away, (alone, both), strict=True):
                    found = MODEL.forward(known(estimator).q, known(estimator).lengths).positions
                    off.append(float(np.linalg.norm(found[elbow] - truth.positions[number][elbow])))
    assert np.median(away[1]) < 1.15 * np.median(away[0]), np.median(away, axis=1)


# --- time


def delayed(skeletons: Sequence[Skeleton], longest: float, seed: int, after: int = 15) -> list[Skeleton]:
    """As they arrive, each late by up to so many seconds; the first few in order."""
    late = np.random.default_rng(seed).uniform(0.0, longest, len(skeletons))
    late[:after] = 0.0
    arrival = [skeleton.stamp_ns + delay * NANOSECONDS for skeleton, delay in zip(skeletons, late, strict=True)]
    return [skeletons[k] for k in np.argsort(arrival, kind="stable")]


def test_late_frames_count_as_if_they_had_come_in_order() -> None:
    rng = np.random.default_rng(6)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, 3.0)
    frames = []
    for number, noise in enumerate((0.01, 0.03)):
        truth = truth_of(person, motion, capture_times(2.0, rng, 20.0) + 0.017 * number)
        seen = measured(truth, noise, number, outliers=0.03).skeletons
        frames += [(skeleton, f"kinect{number}") for skeleton in seen]
    frames.sort(key=lambda each: each[0].stamp_ns)
    in_order, late = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    for skeleton, name in frames:
        in_order.take(skeleton, name)
    name_of = {skeleton.stamp_ns: name for skeleton, name in frames}
    outputs = [
        late.update(skeleton, name_of[skeleton.stamp_ns])
        for skeleton in delayed([skeleton for skeleton, _ in frames], 0.19, 2)
    ]
    assert late.counters["late_frames"] > 20 and late.counters["too_late"] == 0
    assert sum(output is None for output in outputs[15:]) == late.counters["late_frames"]
    assert_same(known(in_order), known(late), 1e-9)


def stalled(seed: int, held: int = 6) -> tuple[list[tuple[Skeleton, str]], int]:
    """Frames of two sensors as they arrive, the last of the second one in a burst, and how many arrive before that."""
    rng = np.random.default_rng(seed)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, 2.0)
    frames = []
    for number in range(2):
        truth = truth_of(person, motion, capture_times(1.0, rng) + 0.017 * number)
        frames += [(skeleton, f"kinect{number}") for skeleton in measured(truth, seed=number).skeletons]
    frames.sort(key=lambda each: each[0].stamp_ns)
    if frames[-1][1] == "kinect1":
        frames.pop()  # the other one's comes last
    burst = [each for each in frames if each[1] == "kinect1"][-held:]
    in_time = [each for each in frames if each not in burst]
    return in_time + burst, len(in_time)


@pytest.mark.parametrize("seed", range(1, 1 + draws(1, 3)))
def test_a_burst_of_late_frames_counts_as_each_alone_and_goes_back_once(seed: int) -> None:
    """Also if each of them is repeated before it is inserted."""
    frames, in_time = stalled(seed)
    together, one_by_one, in_order = ExtendedKalmanFilter(), ExtendedKalmanFilter(), ExtendedKalmanFilter()
    for number, (skeleton, sensor) in enumerate(frames):
        assert together.take(skeleton, sensor) == one_by_one.take(skeleton, sensor)
        if number >= in_time:
            assert not together.take(skeleton, sensor)
        asked = one_by_one.estimate  # includes the frame
    assert asked is not None
    for skeleton, sensor in sorted(frames, key=lambda each: each[0].stamp_ns):
        in_order.take(skeleton, sensor)
    late = frames[in_time:]
    first_ns = late[0][0].stamp_ns
    newer = [skeleton for skeleton, _ in frames[:in_time] if skeleton.stamp_ns > first_ns]
    assert_same(known(together), known(one_by_one), 1e-12)
    assert_same(known(together), known(in_order), 1e-12)
    assert together.counters["late_frames"] == one_by_one.counters["late_frames"] == len(late)
    assert together.counters["repeated_stamps"] == len(late)
    assert together.counters["taken_again"] == len(newer) < one_by_one.counters["taken_again"]
    assert in_order.counters["taken_again"] == 0


def test_late_frames_change_predictions_and_the_next_frame() -> None:
    frames, in_time = stalled(5)
    (last, its_sensor), others = frames[in_time - 1], frames[: in_time - 1]
    before, late = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    for skeleton, sensor in sorted(others + frames[in_time:], key=lambda each: each[0].stamp_ns):
        before.take(skeleton, sensor)
    for skeleton, sensor in others + frames[in_time:]:
        late.take(skeleton, sensor)
    expected, predicted = before.predict(last.stamp_ns), late.predict(last.stamp_ns)
    assert expected is not None and predicted is not None
    assert_same(expected[1], predicted[1], 1e-12)
    for estimator in (before, late):
        assert estimator.take(last, its_sensor)
    assert_same(known(before), known(late), 1e-12)


def test_frames_that_are_too_late_are_dropped_and_counted() -> None:
    skeletons = measured(random_truth(7, 2.0)).skeletons
    held, others = skeletons[40], [*skeletons[:40], *skeletons[41:50]]
    estimator = ExtendedKalmanFilter()
    feed(estimator, others)
    before = known(estimator)
    assert estimator.update(held) is None  # 0.3 s after its time
    assert estimator.counters["too_late"] == 1
    assert_same(before, known(estimator), 0.0)


def test_an_older_frame_that_is_repeated_counts_once() -> None:
    """Also those by which the filter was started, before the start and for as long as they are remembered."""
    skeletons = measured(random_truth(8, 0.4)).skeletons
    once = ExtendedKalmanFilter()
    feed(once, skeletons)
    for repeated, after in some([(0, 4), (0, 5), (0, 8), (2, 5), (5, 8), (9, 12)], 3):
        twice = ExtendedKalmanFilter()
        feed(twice, skeletons[:after])
        assert twice.update(skeletons[repeated]) is None
        feed(twice, skeletons[after:])
        assert twice.counters["repeated_stamps"] == 1
        assert_same(known(once), known(twice), 1e-12)


def test_a_start_in_another_order_is_the_same_start() -> None:
    skeletons = measured(random_truth(8, 1.0)).skeletons
    in_order, shuffled = ExtendedKalmanFilter(), ExtendedKalmanFilter()
    feed(in_order, skeletons)
    feed(shuffled, [skeletons[k] for k in (1, 0, 3, 2)] + list(skeletons[4:]))
    assert_same(known(in_order), known(shuffled), 1e-9)


def test_after_a_gap_it_goes_on_with_the_lengths_it_knew() -> None:
    truth = random_truth(10, 7.0)
    observation = measured(truth, gaps=((2.0, 6.0),))
    estimator = ExtendedKalmanFilter()
    outputs: list[Skeleton | None] = [None] * len(truth.times)
    lengths = []
    for skeleton, k in zip(observation.skeletons, observation.frames, strict=True):
        outputs[k] = estimator.update(skeleton)
        if estimator.estimate is not None:
            lengths.append((truth.times[k], known(estimator).lengths))
    assert estimator.counters["gaps"] == 1
    before = [each for time, each in lengths if time < 2.0][-1]
    after = next(each for time, each in lengths if time > 6.0)
    assert_allclose(after, before, rtol=0.0, atol=1e-12)
    assert rms(errors_of(outputs, truth, 6.3)) < np.sqrt(3.0) * NOISE


# --- prediction


def test_a_prediction_grows_uncertain_ends_and_changes_nothing() -> None:
    skeletons = measured(random_truth(14, 2.0)).skeletons
    estimator = ExtendedKalmanFilter()
    assert estimator.predict(START_NS) is None
    outputs = run(estimator, skeletons)
    before, last = known(estimator), outputs[-1]
    assert last is not None
    spread = [stddevs(last)]
    limit = estimator.parameters.predict_for
    for ahead in (0.05, 0.1, 0.3, 1.0, 0.99 * limit):
        stamp_ns = before.stamp_ns + round(ahead * NANOSECONDS)
        predicted = estimator.predict(stamp_ns)
        assert predicted is not None
        skeleton, estimate = predicted
        assert skeleton.stamp_ns == estimate.stamp_ns == stamp_ns
        assert_array_equal(skeleton.states[POINTS], TrackingState.INFERRED)
        spread.append(stddevs(skeleton))
    assert (np.diff(np.stack(spread), axis=0) > 0.0).all()
    assert estimator.predict(before.stamp_ns + round(1.01 * limit * NANOSECONDS)) is None
    assert_same(before, known(estimator), 0.0)


def test_a_prediction_continues_the_movement() -> None:
    """Of a person in smooth motion: better than the last pose."""
    rng = np.random.default_rng(15)
    lengths = RandomPerson.draw(rng).lengths
    rate = np.zeros(MODEL.nv)
    rate[[0, 5]] = 0.5, 0.8  # m/s forward, rad/s about the vertical
    times = capture_times(2.5, rng)
    q = MODEL.integrate(MODEL.neutral(), times[:, None] * rate)
    positions = MODEL.forward(q, lengths).positions
    truth = Truth(times, q, np.tile(rate, (len(times), 1)), lengths, positions, np.zeros(positions.shape[:2]))
    estimator = ExtendedKalmanFilter()
    outputs = run(estimator, measured(truth, 0.01).skeletons[:60])
    last, predicted = outputs[-1], estimator.predict(START_NS + round(times[66] * NANOSECONDS))
    assert last is not None and predicted is not None
    stay, go_on = (rms(each.positions[POINTS] - truth.positions[66]) for each in (last, predicted[0]))
    assert go_on < 0.5 * stay


@pytest.mark.parametrize("missing", [ARMS["LEFT"], EVERYTHING], ids=["an arm", "everybody"])
def test_missing_joints_are_predicted_and_come_back(missing: tuple[Joint, ...]) -> None:
    truth = random_truth(16, 3.2, tempo=0.6)
    lost = np.isin(POINTS, missing)
    during = (truth.times >= 2.0) & (truth.times < 2.5)
    estimator = ExtendedKalmanFilter()
    outputs = run(estimator, measured(truth, dropouts=(Dropout(2.0, 2.5, missing),)).skeletons)
    spread = []
    for k, output in enumerate(outputs[START_FRAMES:], START_FRAMES):
        assert output is not None
        expected = np.where(lost & during[k], TrackingState.INFERRED, TrackingState.TRACKED)
        if truth.times[k] < 3.0:
            assert_array_equal(output.states[POINTS], expected)
        if during[k]:
            spread.append(stddevs(output)[lost])
    before = outputs[int(np.flatnonzero(during)[0]) - 1]
    assert before is not None
    grown = np.stack([stddevs(before)[lost], *spread])
    assert (np.diff(grown, axis=0) > 0.0).all()
    assert len(missing) == len(EVERYTHING) or (grown[-1] > 3.0 * grown[0]).all()
    assert rms(errors_of(outputs, truth, 2.7)) < np.sqrt(3.0) * NOISE
    assert_sound(outputs, estimator)


def test_an_elbow_that_swings_twice_a_second_does_not_lag() -> None:
    """With the same density of the acceleration at every speed it erred by 11.8 degrees RMS, at speed by 15.3."""
    elbow = MODEL.coordinate_names.index("elbow_flexion_right")
    times = capture_times(4.0, np.random.default_rng(17))
    rate, tangent = np.zeros((2, len(times), MODEL.nv))
    tangent[:, elbow] = np.radians(60.0 - 50.0 * np.cos(4.0 * np.pi * times))
    rate[:, elbow] = np.radians(50.0) * 4.0 * np.pi * np.sin(4.0 * np.pi * times)
    q, lengths = MODEL.integrate(MODEL.neutral(), tangent), MODEL.default_lengths()
    positions = MODEL.forward(q, lengths).positions
    truth = Truth(times, q, rate, lengths, positions, np.zeros(positions.shape[:2]))
    place = elbow + 3  # in the configuration, where three rotations before it are quaternions
    estimator = ExtendedKalmanFilter()
    flexion = []
    for skeleton in measured(truth, 0.005).skeletons:
        estimator.take(skeleton)
        flexion.append(np.nan if estimator.estimate is None else estimator.estimate.q[place])
    off = np.degrees(np.array(flexion) - q[:, place])[times > SETTLED]
    fast = np.abs(rate[times > SETTLED, elbow]) > np.radians(400.0)
    assert rms(off) < 4.0 and rms(off[fast]) < 4.0


# --- bad data


@pytest.mark.parametrize("seed", range(draws(2, 12)))
def test_a_start_that_is_60_degrees_wrong_is_right_within_a_second(seed: int) -> None:
    truth = random_truth(50 + seed, 1.5)
    rng = np.random.default_rng(seed)
    wrong = np.zeros(MODEL.nv)
    wrong[6:] = np.radians(rng.uniform(-60.0, 60.0, MODEL.nv - 6))
    estimator = ExtendedKalmanFilter()
    estimator.start(MODEL.integrate(truth.q[0], wrong), stamp_ns=START_NS)
    outputs = run(estimator, measured(truth, seed=seed).skeletons)
    assert outputs[1] is not None  # a start that is given needs no frames
    assert rms(errors_of(outputs, truth, 1.0)) < np.sqrt(3.0) * NOISE + 0.01


def test_the_first_frame_is_met_although_the_pose_is_far_from_where_it_is_linearised() -> None:
    """A single linearisation would leave the forearm's points 12 mm off, by the terms of second order in the turn."""
    elbow = MODEL.coordinate_names.index("elbow_flexion_right")
    turn = np.zeros(MODEL.nv)
    turn[elbow] = 0.8
    began = MODEL.integrate(MODEL.neutral(), turn)
    turn[elbow] = 0.35
    points = MODEL.forward(MODEL.integrate(began, turn), MODEL.default_lengths()).positions
    positions, states = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, dtype=np.uint8)
    positions[MODEL.joints], states[MODEL.joints] = points, TrackingState.TRACKED
    estimator = ExtendedKalmanFilter()
    estimator.start(began)
    assert estimator.take(Skeleton(NANOSECONDS // 100, "world", positions, states))
    estimate = known(estimator)
    found = MODEL.forward(estimate.q, estimate.lengths).positions
    assert np.linalg.norm(found - points, axis=1).max() < 0.006


def test_an_arm_that_comes_back_elsewhere_is_found_within_two_frames() -> None:
    """After a second of fast motion unseen: an update linearised at the old pose can end anywhere."""
    for seed in range(320, 320 + draws(1, 12)):
        truth = random_truth(seed, 2.3, tempo=1.6)
        for arm in ARMS.values():
            estimator = ExtendedKalmanFilter()
            outputs = run(estimator, measured(truth, 0.008, dropouts=(Dropout(1.0, 2.0, arm),)).skeletons, 60)
            assert errors_of(outputs, truth, 2.05)[:, np.isin(POINTS, arm)].max() < 0.15, (seed, arm)


def test_an_elbow_that_jumps_is_stated_as_uncertain_while_it_is_rejected() -> None:
    """No step of more than 60 degrees between outputs of which both have a deviation below 15."""
    elbow = MODEL.coordinate_names.index("elbow_flexion_right")
    turn = np.zeros(MODEL.nv)
    estimator, rng = ExtendedKalmanFilter(), np.random.default_rng(5)
    found: list[tuple[float, float]] = []
    for number in range(36):
        turn[elbow] = 1.9 if number in (20, 21) or number >= 27 else 0.1
        points = MODEL.forward(MODEL.integrate(MODEL.neutral(), turn), MODEL.default_lengths()).positions
        positions, states = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, dtype=np.uint8)
        positions[POINTS] = points + rng.normal(scale=0.004, size=points.shape)
        states[POINTS] = TrackingState.TRACKED
        if estimator.take(Skeleton(START_NS + number * NANOSECONDS // 30, "world", positions, states)):
            estimate = known(estimator)
            stddev = float(np.sqrt(estimate.covariance[elbow, elbow]))
            found.append((float(estimate.q[MODEL.scalar_q[MODEL.scalar_v == elbow][0]]), stddev))
    angles, stddevs = np.degrees(np.array(found)).T
    steps = np.abs(np.diff(angles)) > 60.0
    assert estimator.counters["rejected"] > 4 and angles.max() > 90.0
    assert (np.maximum(stddevs[1:], stddevs[:-1])[steps] > 15.0).all()
    assert stddevs[10:15].max() < 10.0


def test_outliers_hardly_matter() -> None:
    """5 % of the points are off by up to 1 m."""
    clean: list[float] = []
    bad: list[float] = []
    for seed in range(draws(1, 2)):
        truth = random_truth(60 + seed, 3.0)
        for errors, share in ((clean, 0.0), (bad, 0.05)):
            estimator = ExtendedKalmanFilter()
            outputs = run(estimator, measured(truth, seed=seed, outliers=share).skeletons)
            errors.append(rms(errors_of(outputs, truth)))
            if share:
                assert estimator.counters["rejected"] > 0.7 * share * 19 * len(outputs)
    assert np.mean(bad) < 1.4 * np.mean(clean)
    assert max(bad) < np.sqrt(3.0) * NOISE


def damaged(skeleton: Skeleton, field: str, value: float, rng: np.random.Generator) -> Skeleton:
    hit = rng.random(N_JOINTS) < 0.3
    if field == "covariances":
        covariances = np.tile(NOISE**2 * np.eye(3), (N_JOINTS, 1, 1))
        covariances[hit] *= value / NOISE**2
        return replace(skeleton, covariances=covariances)
    positions = skeleton.positions.copy()
    positions[hit, rng.integers(3)] = value
    return replace(skeleton, positions=positions)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize(
    ("field", "values"),
    some(
        [
            ("positions", (np.nan, 150.0, 1e300)),
            ("positions", (-np.inf, -1e6)),
            ("covariances", (np.nan, 0.0, 1e12)),
            ("covariances", (-1e-3, np.inf, 1e-15)),
            ("all positions", (np.nan,)),
            ("all states", (TrackingState.NOT_TRACKED,)),
        ],
        3,
    ),
)
def test_damaged_numbers_do_no_harm(field: str, values: tuple[float, ...]) -> None:
    """In every third frame, from the first one on; the frames between are enough."""
    truth = random_truth(70, 1.6)
    rng = np.random.default_rng(1)
    skeletons = list(measured(truth).skeletons)
    for k in range(0, len(skeletons), 3):
        value = values[k // 3 % len(values)]
        whole = field.removeprefix("all ")
        if whole == field:
            skeletons[k] = damaged(skeletons[k], field, value, rng)
        else:
            skeletons[k] = replace(skeletons[k], **{whole: np.full_like(getattr(skeletons[k], whole), value)})
    estimator = ExtendedKalmanFilter()
    outputs = run(estimator, skeletons)
    assert_sound(outputs, estimator)
    assert rms(errors_of(outputs, truth)) < np.sqrt(3.0) * NOISE


def test_a_person_behind_a_table_is_tracked_by_shoulders_and_arms() -> None:
    """Hips and spine are out of the image: the trunk is upright until it is seen, what is seen is right at once."""
    truth = random_truth(71, 2.5, tempo=0.5)
    hidden = tuple(joint for joint in Joint if joint.name.startswith(("SPINE", "NECK", "HIP", "KNEE", "ANKLE", "FOOT")))
    outputs = run(ExtendedKalmanFilter(), measured(truth, dropouts=(Dropout(0.0, 1.5, hidden),)).skeletons)
    assert all(output is not None for output in outputs[START_FRAMES - 1 :])
    arms = [k for k, joint in enumerate(POINTS) if Joint(joint).name.startswith(("SHOULDER", "ELBOW", "WRIST"))]
    until = int(np.sum(truth.times < 1.5))
    assert rms(errors_of(outputs[:until], truth, SETTLED)[:, arms]) < np.sqrt(3.0) * NOISE
    assert rms(errors_of(outputs, truth, 2.0)) < np.sqrt(3.0) * NOISE


@pytest.mark.parametrize("seed", range(draws(2, 8)))
def test_a_pelvis_behind_a_table_is_not_turned_by_the_noise_of_the_shoulders(seed: int) -> None:
    """Nobody sees whether it is turned: it stays under the shoulders, with a deviation of 9 degrees or more."""
    rng = np.random.default_rng(seed)
    times = capture_times(12.0, rng, 30.0)
    q = np.tile(MODEL.neutral(), (len(times), 1))
    lengths = RandomPerson.draw(rng).lengths
    positions = MODEL.forward(q, lengths).positions
    truth = Truth(times, q, np.zeros((len(times), MODEL.nv)), lengths, positions, np.zeros(positions.shape[:2]))
    hidden = tuple(joint for joint in Joint if joint.name.startswith(("SPINE_BASE", "HIP", "KNEE", "ANKLE", "FOOT")))
    estimator, twists = ExtendedKalmanFilter(), []
    for skeleton in measured(truth, seed=seed, dropouts=(Dropout(0.0, 20.0, hidden),)).skeletons:
        if not estimator.take(skeleton) or skeleton.stamp_ns < 6 * NANOSECONDS:
            continue
        angles = angles_of(known(estimator), MODEL, "isb")
        twist = angles.names.index("thorax_axial_left")
        twists.append(angles.position[twist])
        assert np.degrees(angles.position_stddev[twist]) > 9.0
    assert np.degrees(rms(np.array(twists))) < 5.0  # 14 to 23 with unseen hips among the seen points


def test_without_a_trunk_there_is_no_start() -> None:
    truth = random_truth(71, 1.5)
    trunk = (Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.SHOULDER_LEFT)
    estimator = ExtendedKalmanFilter()
    outputs = run(estimator, measured(truth, dropouts=(Dropout(0.0, 0.7, trunk),)).skeletons)
    early = [output for k, output in enumerate(outputs) if truth.times[k] < 0.7]
    assert all(output is None for output in early)
    assert estimator.counters["no_trunk"] > 0
    assert outputs[-1] is not None
    assert rms(errors_of(outputs, truth, 1.2)) < np.sqrt(3.0) * NOISE


# --- parameters


def test_unobserved_angles_of_a_standing_person_neither_drift_nor_gain_certainty() -> None:
    """Unobserved angles stay where they are, and keep the deviation of the posture prior, which alone determines them.

    Points that are known exactly leave two directions, along which the prior decides. The filter applies it to its
    state and once more to its output, so the stated deviation is at least that of a prior that counts twice, less 5 %
    as it is evaluated at the estimate. It is never more than the prior's deviation before any measurement.
    Ten minutes take too long here; ``benchmarks/robustness.py --standing 10`` has them.
    """
    seed = 0
    rng = np.random.default_rng(seed)
    lengths = RandomPerson.draw(rng).lengths
    times = capture_times(float(draws(3, 40)), rng, 30.0)
    tangent = np.zeros(MODEL.nv)
    tangent[[MODEL.coordinate_names.index(f"elbow_flexion_{side}") for side in ("left", "right")]] = np.radians(25.0)
    tangent[6:12] = np.radians(rng.normal(scale=4.0, size=6))
    q = np.tile(MODEL.integrate(MODEL.neutral(), tangent), (len(times), 1))
    positions = MODEL.forward(q, lengths).positions
    truth = Truth(times, q, np.zeros((len(times), MODEL.nv)), lengths, positions, np.zeros(positions.shape[:2]))
    least, most = posture_stddev(q[0], lengths)
    estimator = ExtendedKalmanFilter()
    angles, learnt = [], []
    for skeleton in measured(truth, seed=seed).skeletons:
        if not estimator.take(skeleton):
            continue
        estimate = known(estimator)
        joint_angles = angles_of(estimate, MODEL, "model")
        columns = [joint_angles.names.index(name) for name in UNOBSERVED]
        angles.append(joint_angles.position[columns])
        learnt.append(estimate.lengths)
        assert (joint_angles.position_stddev[columns] > 0.95 * least).all()
        assert (joint_angles.position_stddev[columns] < most).all()
    # averages over a second: the noise of one frame is no drift
    averages = np.stack(angles)[: len(angles) // 30 * 30].reshape(-1, 30, len(UNOBSERVED)).mean(axis=1)
    assert np.degrees(np.abs(averages - averages[0]).max()) < 10.0
    if times[-1] > 35.0:  # of perfectly white noise the lengths are known well enough to be settled after 30 s
        assert np.abs(np.stack(learnt[910:]) - learnt[-1]).max() < 1e-9


def posture_stddev(q: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(4,) radians: deviations of the unobserved angles by the posture prior.

    First where it counts twice and all points are known exactly, then by the prior alone.
    """
    ranges, lines = Ranges(MODEL), MODEL.linearise(q, lengths)
    prior = PosturePrior(MODEL, ranges)
    table = prior_table(MODEL, ranges, prior)
    _, _, rows = prior_rows(q, lines.posture.rotations[0], lines.rotation_jacobian[0], table)
    used = np.append(prior.postural, [True] * 3)
    rows = rows[used] / table.stddev[used, None]
    _, singular, axes = np.linalg.svd(lines.jacobian.reshape(-1, MODEL.nv), full_matrices=False)
    free = axes[singular < 1e-6 * singular[0]].T
    assert free.shape[1] == 2
    covariance = free @ np.linalg.inv(2.0 * (rows @ free).T @ (rows @ free)) @ free.T
    columns = np.array([MODEL.coordinate_names.index(name) for name in UNOBSERVED])
    return np.sqrt(covariance.diagonal()[columns]), prior.stddev[columns - 6]


def test_an_invalid_covariance_restarts_the_pose() -> None:
    skeletons = measured(random_truth(8, 2.0)).skeletons
    estimator = ExtendedKalmanFilter()
    feed(estimator, skeletons[:20])
    assert estimator._state is not None
    estimator._state = replace(estimator._state, covariance=-estimator._state.covariance)
    outputs = run(estimator, skeletons[20:])
    assert estimator.counters["broken_covariances"] == 1
    assert all(output is not None and np.isfinite(output.positions[POINTS]).all() for output in outputs)
    assert (known(estimator).covariance.diagonal() > 0.0).all()
