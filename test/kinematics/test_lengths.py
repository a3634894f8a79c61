"""Segment lengths from distances between points: exact, robust, and with a covariance for correlated errors."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from random_people import RandomPerson, capture_times, truth_of
from scipy.spatial.transform import Rotation

from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint
from body_tracking.kinematics.lengths import LengthEstimate, SegmentLengths, SkeletonLengths, proportions
from body_tracking.kinematics.upper_body import LENGTHS
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline.graph import FUSED
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rosbag2 import BagReader
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws

POINTS = MODEL.joints
EVERY = np.ones(len(POINTS), dtype=bool)
BASE = BASE_STDDEV[POINTS] ** 2
ARM = [LENGTHS.index(name) for name in ("upper_arm_left", "forearm_left", "hand_left")]


@cache
def moving_person(seed: int, seconds: float, rate: float = 30.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), points (n, 19, 3) and lengths (21,)."""
    rng = np.random.default_rng(seed)
    truth = truth_of(RandomPerson.draw(rng), RandomMotion(rng, seconds), capture_times(seconds, rng, rate))
    return truth.times, truth.positions, truth.lengths


def gathered(
    times: FloatArray,
    points: FloatArray,
    white: float = 0.0,
    *,
    tracked: BoolArray = EVERY,
    model: FloatArray | None = None,
    slow: float = 0.0,
) -> SegmentLengths:
    """The measurements of one sensor's frames; ``white`` is a standard deviation, ``model`` (n, 19)."""
    seen = SegmentLengths()
    for k, (time, frame) in enumerate(zip(times, points, strict=True)):
        variance = BASE if model is None else model[k]
        seen = seen.with_frame(
            "", round(time * NANOSECONDS), frame, tracked, np.full(len(POINTS), white**2), variance, slow
        )
    return seen


def estimated(*args: FloatArray, **kwargs: float) -> LengthEstimate:
    return gathered(*args, **kwargs).estimate()  # type: ignore[arg-type]


def stddev(estimate: LengthEstimate) -> FloatArray:
    return np.sqrt(estimate.covariance.diagonal())


def correlated_noise(times: FloatArray, rng: np.random.Generator, persistence: float, size: int) -> FloatArray:
    """(n, size) samples of unit variance of an Ornstein-Uhlenbeck process."""
    kept = np.exp(-np.diff(times) / persistence)
    found = np.empty((len(times), size))
    found[0] = rng.normal(size=size)
    for k, share in enumerate(kept, 1):
        found[k] = share * found[k - 1] + np.sqrt(1.0 - share**2) * rng.normal(size=size)
    return found


def test_lengths_of_noiseless_points_are_exact() -> None:
    for seed in range(5):
        times, points, lengths = moving_person(seed, 4.0)
        assert_allclose(estimated(times, points).lengths, lengths, rtol=0.0, atol=1e-6)


@settings(max_examples=draws(8, 20), deadline=None)
@given(seed=st.integers(0, 10_000))
def test_lengths_are_invariant_under_rigid_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times, points, _ = moving_person(3, 4.0, rate=10.0)
    points = points + rng.normal(scale=0.01, size=points.shape)
    turned = Rotation.random(random_state=rng).apply(points.reshape(-1, 3)).reshape(points.shape) + rng.normal(size=3)
    one, two = estimated(times, points, 0.01), estimated(times, turned, 0.01)
    assert_allclose(one.lengths, two.lengths, rtol=0.0, atol=1e-9)
    assert_allclose(one.covariance, two.covariance, rtol=0.0, atol=1e-9)


def test_without_measurements_the_estimate_is_the_prior() -> None:
    for seen in (SegmentLengths(), gathered(*moving_person(0, 4.0)[:2], tracked=~EVERY)):
        estimate = seen.estimate()
        assert_allclose(estimate.lengths, MODEL.default_lengths())
        assert_allclose(estimate.covariance, proportions())
        left, right = (LENGTHS.index(f"forearm_{side}") for side in ("left", "right"))
        between = np.array([1.0, -1.0]) @ estimate.covariance[np.ix_([left, right], [left, right])] @ [1.0, -1.0]
        assert between < 0.1 * estimate.covariance[left, left]


def test_an_unseen_arm_has_the_lengths_of_the_other_one() -> None:
    times, points, lengths = moving_person(4, 10.0)
    hidden = np.isin(POINTS, [Joint[f"{name}_LEFT"] for name in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")])
    estimate = estimated(times, points, tracked=~hidden)
    assert (np.abs(estimate.lengths - lengths)[ARM] < 3.0 * stddev(estimate)[ARM]).all()
    right = estimate.lengths[[column + 1 for column in ARM]]
    assert_allclose(estimate.lengths[ARM], right, rtol=0.05)
    whole = stddev(estimated(times, points))
    assert (stddev(estimate)[ARM] > whole[ARM]).all()


@pytest.mark.parametrize("noise", [0.005, 0.04])
def test_white_noise_biases_no_length_and_is_in_the_covariance(noise: float) -> None:
    off, normalised = [], []
    for seed in range(12):
        times, points, lengths = moving_person(seed, 12.0)
        rng = np.random.default_rng(seed)
        estimate = estimated(times, points + rng.normal(scale=noise, size=points.shape), noise)
        off.append(estimate.lengths - lengths)
        normalised.append(off[-1] / stddev(estimate))
    assert np.abs(np.mean(off, axis=0)).max() < 0.2 * noise
    assert 0.3 < np.square(normalised).mean() < 2.0


def test_stddev_falls_with_the_square_root_of_time_under_white_noise() -> None:
    times, points, _ = moving_person(5, 32.0)
    points = points + np.random.default_rng(5).normal(scale=0.02, size=points.shape)
    short, long = (stddev(estimated(times[times < end], points[times < end], 0.02)) for end in (8.0, 32.0))
    assert np.median(long / short) < 0.7  # half, as variances fall with the time


def test_correlated_errors_do_not_average_out_as_white_noise() -> None:
    """Two halves of a minute differ as stated, by far more than with independent frames."""
    normalised, as_if_new = [], []
    for seed in range(draws(5, 10)):
        rng = np.random.default_rng(seed)
        times, points, _ = moving_person(seed, 60.0, rate=15.0)
        wrong = 0.02 * correlated_noise(times, rng, 3.0, points[0].size).reshape(points.shape)
        points = points + wrong + rng.normal(scale=0.003, size=points.shape)
        first = times < 30.0
        halves = [estimated(times[part], points[part], 0.003) for part in (first, ~first)]
        difference = halves[0].lengths - halves[1].lengths
        normalised.append(difference / np.hypot(*(stddev(half) for half in halves)))
        as_if_new.append(difference / (0.02 * 2.0 / np.sqrt(first.sum())))
    assert 0.3 < np.square(normalised).mean() < 1.5
    assert np.square(as_if_new).mean() > 5.0


def test_outlier_frames_and_blocks_do_not_move_the_estimate() -> None:
    times, points, lengths = moving_person(6, 20.0)
    rng = np.random.default_rng(6)
    points = points + rng.normal(scale=0.01, size=points.shape)
    good = estimated(times, points, 0.01)
    wild = points.copy()
    outliers = rng.random(points.shape[:2]) < 0.05
    wild[outliers] += rng.normal(scale=0.5, size=(int(outliers.sum()), 3))
    elbow = list(POINTS).index(Joint.ELBOW_LEFT)
    wild[(times > 4.0) & (times < 6.0), elbow] += 0.3
    bad = estimated(times, wild, 0.01)
    assert np.abs(bad.lengths - lengths).max() < 0.02
    assert np.abs(bad.lengths - good.lengths).max() < 0.015


def test_blocks_of_large_variance_have_less_weight() -> None:
    times, points, lengths = moving_person(7, 20.0)
    late = times >= 10.0
    points = points + np.random.default_rng(7).normal(scale=0.003, size=points.shape)
    points[late] *= 1.1
    badly = np.where(late[:, None], 10.0, 1.0) * BASE
    off_badly, off_alike = (
        np.linalg.norm(estimated(times, points, 0.003, model=model).lengths - lengths)
        for model in (badly, np.broadcast_to(BASE, badly.shape))
    )
    assert off_badly < 0.5 * off_alike


def test_stated_slow_errors_increase_the_stddev() -> None:
    times, points, _ = moving_person(8, 6.0)
    without, with_slow = (stddev(estimated(times, points, slow=slow)) for slow in (0.0, 0.3))
    assert (with_slow > 2.0 * without).all()


def test_each_sensor_has_its_own_blocks() -> None:
    times, points, lengths = moving_person(9, 6.0)
    seen = SegmentLengths()
    zero = np.zeros(len(POINTS))
    for time, frame in zip(times, points, strict=True):
        for number, sensor in enumerate(("one", "other")):
            seen = seen.with_frame(sensor, round(time * NANOSECONDS) + number, frame + number, EVERY, zero, BASE)
    assert len(seen.blocks) >= 8
    assert_allclose(seen.estimate().lengths, lengths, rtol=0.0, atol=1e-6)


def test_a_slow_sensor_gives_blocks() -> None:
    times, points, lengths = moving_person(10, 12.0, rate=2.0)
    seen = gathered(times, points)
    assert len(seen.blocks) >= 4
    assert_allclose(seen.estimate().lengths, lengths, rtol=0.0, atol=1e-6)


def test_old_blocks_are_dropped() -> None:
    times, points, lengths = moving_person(11, 12.0)
    seen = SegmentLengths(memory=3)
    taller = np.where((times < 6.0)[:, None, None], points, 1.1 * points)
    for time, frame in zip(times, taller, strict=True):
        seen = seen.with_frame("", round(time * NANOSECONDS), frame, EVERY, np.zeros(len(POINTS)), BASE)
    assert len(seen.blocks) == 3
    assert_allclose(seen.estimate().lengths, 1.1 * lengths, rtol=0.0, atol=1e-6)


def test_an_unfinished_block_can_be_used_from_the_first_frame() -> None:
    times, points, lengths = moving_person(12, 0.9)
    for count in (1, 2, 3, 4, len(times)):
        seen = gathered(times[:count], points[:count])
        assert not seen.blocks
        assert not seen.estimate().seen.any()
        estimate = seen.with_unfinished_block(np.zeros(len(POINTS))).estimate()
        assert estimate.seen.all()
        assert_allclose(estimate.lengths, lengths, rtol=0.0, atol=1e-6)


# --- of filtered skeletons


def test_lengths_of_skeletons_start_at_once_and_never_jump() -> None:
    times, points, lengths = moving_person(13, 12.0)
    tracker = SkeletonLengths()
    course = []
    for time, frame in zip(times, np.where((times < 3.5)[:, None, None], 0.9 * points, points), strict=True):
        tracker.update(round(time * NANOSECONDS), frame, BASE)
        course.append(tracker.lengths)
    assert_allclose(course[0], 0.9 * lengths, rtol=0.0, atol=1e-6)
    assert_allclose(course[-1], lengths, rtol=0.02)  # the blocks of the later pose are the more
    assert (np.abs(np.diff(course, axis=0)) < 0.01 * lengths).all()  # of the tenth that was to be gone
    tracker.reset()
    assert np.isinf(tracker.stddev).all()
    assert_allclose(tracker.lengths, MODEL.default_lengths())


def test_lengths_adapt_to_another_person_within_a_minute() -> None:
    times, points, lengths = moving_person(14, 140.0, rate=10.0)
    tracker = SkeletonLengths()
    for time, frame in zip(times, np.where((times < 80.0)[:, None, None], 0.85 * points, points), strict=True):
        tracker.update(round(time * NANOSECONDS), frame, BASE)
    assert_allclose(tracker.lengths, lengths, rtol=0.005)


@pytest.mark.slow
def test_both_halves_of_a_real_recording_give_the_same_lengths(shared_data: Path, tmp_path: Path) -> None:
    import_files([shared_data / "kinect_pairs" / "p02_45deg.csv.gz"], tmp_path / "in")
    replay(tmp_path / "in", tmp_path / "out", ReplaySettings(()))
    with BagReader(tmp_path / "out") as reader:
        frames = [each[0] for raw in reader.messages([FUSED]) if (each := decode_skeletons(raw.cdr))]
    middle = (frames[0].stamp_ns + frames[-1].stamp_ns) // 2
    halves = []
    for part in (True, False):
        seen = SegmentLengths()
        for frame in frames:
            if (frame.stamp_ns < middle) is part:
                assert frame.covariances is not None
                variance = frame.covariances[POINTS].diagonal(axis1=1, axis2=2).mean(axis=1)
                model = np.where(frame.valid[POINTS], variance, BASE)
                seen = seen.with_frame(
                    "", frame.stamp_ns, frame.positions[POINTS], frame.valid[POINTS], np.full(19, 9e-6), model, 0.1
                )
        halves.append(seen.estimate())
    difference = halves[0].lengths - halves[1].lengths
    assert np.abs(difference).max() < 0.010
    normalised = difference / np.hypot(*(stddev(half) for half in halves))
    assert np.sqrt(np.square(normalised).mean()) < 1.5
