"""Random people stay within their ranges of motion, and their ground truth is consistent."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from random_people import (
    ARMS,
    EVERYTHING,
    START_NS,
    Dropout,
    MeasurementErrors,
    RandomPerson,
    Truth,
    capture_times,
    draw_dropouts,
    observe,
    truth_of,
)

from body_tracking.core.skeleton import NANOSECONDS, Joint, TrackingState
from body_tracking.kinematics.ranges import Ranges
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import POSTURES, RandomMotion
from draws import draws

POINT = {Joint(joint): number for number, joint in enumerate(MODEL.joints)}


@cache
def someone(seed: int, duration: float = 8.0) -> Truth:
    rng = np.random.default_rng(seed)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, duration)
    return truth_of(person, motion, capture_times(duration, rng))


@pytest.mark.parametrize("seed", range(12))
def test_every_angle_stays_inside_its_range(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = RandomMotion(rng, 12.0, postures=POSTURES[seed % 4 :], full_turns=seed % 2)
    times = np.arange(0.0, 14.0, 0.01)
    assert Ranges(MODEL).excess(motion.configuration(times)).max() == 0.0


def test_together_people_use_most_of_every_range() -> None:
    ranges = Ranges(MODEL)
    values = np.concatenate([ranges.values(someone(seed, 20.0).q) for seed in range(20)])
    used = (values.max(axis=0) - values.min(axis=0)) / (ranges.high - ranges.low)
    assert used.min() > 0.6


@pytest.mark.parametrize("seed", range(draws(1, 4)))
def test_the_points_are_those_of_the_model_and_move_at_their_speeds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    person, motion = RandomPerson.draw(rng), RandomMotion(rng, 6.0)
    times = np.arange(0.0, draws(2, 6), 1e-3)
    truth = truth_of(person, motion, times)
    assert_array_equal(truth.positions, MODEL.forward(truth.q, truth.lengths).positions)
    moved = np.linalg.norm(truth.positions[2:] - truth.positions[:-2], axis=-1) / 2e-3
    assert_allclose(moved, truth.speeds[1:-1], atol=2e-3)


def test_people_move_like_people_and_rest_between() -> None:
    people = [someone(seed, 10.0) for seed in range(draws(12, 40))]
    fastest = np.array([truth.speeds.max() for truth in people])
    assert 0.5 < np.median(fastest) < 4.0 and fastest.max() < 9.0
    still = np.array([(truth.speeds.max(axis=1) < 0.1).mean() for truth in people])
    assert 0.1 < still.mean() < 0.6
    step = 1.0 / 30.0
    for truth in people:
        jumps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=-1)
        assert (jumps < np.maximum(truth.speeds[1:], truth.speeds[:-1]) * 1.3 * step + 0.02).all()


def test_the_twist_is_shared_by_both_joints_of_the_trunk() -> None:
    scalars = [MODEL.coordinate_names[v] for v in MODEL.scalar_v]
    lumbar, thoracic = (MODEL.scalar_q[scalars.index(name)] for name in ("lumbar_axial", "thoracic_axial"))
    q = np.concatenate([someone(seed, 20.0).q for seed in range(20)])
    assert np.corrcoef(q[:, lumbar], q[:, thoracic])[0, 1] > 0.7
    assert q[:, thoracic].std() > 1.5 * q[:, lumbar].std()


def test_proportions_vary_by_six_percent_and_sides_by_one_or_two() -> None:
    rng = np.random.default_rng(1)
    people = [RandomPerson.draw(rng) for _ in range(400)]
    assert all(1.5 <= person.stature <= 2.0 for person in people)
    relative = np.array([person.lengths / MODEL.default_lengths(person.stature) for person in people])
    assert_allclose(relative.std(axis=0), 0.06, atol=0.012)
    assert_allclose(relative.mean(axis=0), 1.0, atol=0.015)
    names = MODEL.length_names
    for left, name in enumerate(names):
        if name.endswith("_left"):
            right = names.index(name.replace("_left", "_right"))
            apart = np.abs(relative[:, left] / relative[:, right] - 1.0)
            assert apart.min() > 0.0095 and apart.max() < 0.0205


@pytest.mark.parametrize("posture", POSTURES)
def test_special_postures_are_taken_and_held(posture: str) -> None:
    direction = {"arms_up": (0, 0, 1), "arms_down": (0, 0, -1), "arms_forward": (1, 0, 0), "t_pose": (0, 1, 0)}[posture]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        motion = RandomMotion(rng, 6.0, postures=[posture])
        posed = MODEL.forward(motion.configuration(np.arange(0.0, 12.0, 1 / 30)), MODEL.default_lengths())
        trunk = posed.rotations[:, MODEL.segment_names.index("upper_trunk")]
        held = np.ones(len(trunk), dtype=bool)
        for side, mirror in (("LEFT", 1.0), ("RIGHT", -1.0)):
            arm = (
                posed.positions[:, POINT[Joint[f"WRIST_{side}"]]] - posed.positions[:, POINT[Joint[f"SHOULDER_{side}"]]]
            )
            wanted = trunk @ (np.array(direction) * [1.0, mirror, 1.0])
            cosine = (arm * wanted).sum(axis=-1) / np.linalg.norm(arm, axis=-1)
            held &= cosine > np.cos(np.radians(15.0))
        assert held.sum() >= 25


def test_a_full_turn_is_a_full_turn() -> None:
    base = MODEL.quaternion_of("pelvis")
    for seed in range(5):
        motion = RandomMotion(np.random.default_rng(seed), 4.0, full_turns=1)
        x, y, z, w = motion.configuration(np.arange(0.0, 12.0, 1 / 30))[:, base].T
        yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        assert np.ptp(yaw) > np.radians(350.0)


@pytest.mark.parametrize("noise", [0.002, 0.06])
def test_the_noise_is_as_asked(noise: float) -> None:
    truth = someone(3)
    factors = np.ones(len(Joint))
    factors[Joint.HAND_LEFT] = 2.0
    seen = observe(truth, MeasurementErrors(noise, factors), np.random.default_rng(5))
    measured = np.stack([skeleton.positions for skeleton in seen.skeletons])
    error = measured[:, MODEL.joints] - truth.positions
    stddev = error.std(axis=(0, 2))
    assert_allclose(stddev, noise * factors[MODEL.joints], rtol=0.12)
    # white: nothing carries over from one frame, point or axis to the next
    flat = (error / stddev[:, None]).reshape(len(error), -1)
    assert abs((flat[1:] * flat[:-1]).mean()) < 0.03
    assert np.abs(np.corrcoef(flat.T) - np.eye(57)).mean() < 0.08


def test_skeletons_hold_measurements_and_stamps_and_no_legs() -> None:
    truth = someone(7)
    seen = observe(truth, MeasurementErrors(0.01), np.random.default_rng(0))
    legs = np.setdiff1d(np.arange(len(Joint)), MODEL.joints)
    assert len(legs) == 6 and len(seen.skeletons) == len(truth.times)
    for skeleton, time in zip(seen.skeletons, truth.times, strict=True):
        assert skeleton.stamp_ns - START_NS == pytest.approx(time * NANOSECONDS, abs=1)
        assert skeleton.frame_id == "world" and skeleton.covariances is None
        assert (skeleton.states[legs] == TrackingState.NOT_TRACKED).all() and np.isnan(skeleton.positions[legs]).all()
        assert (skeleton.states[MODEL.joints] == TrackingState.TRACKED).all()
    periods = np.diff([skeleton.stamp_ns for skeleton in seen.skeletons]) / NANOSECONDS
    assert periods.mean() == pytest.approx(1 / 30, rel=1e-3) and 0.0005 < periods.std() < 0.003 and periods.min() > 0.01


def test_dropouts_and_gaps_affect_only_their_joints_and_frames() -> None:
    truth = someone(2)
    errors = MeasurementErrors(0.01, dropouts=(Dropout(1.0, 2.5, ARMS["LEFT"]),), gaps=((4.0, 5.0),))
    seen = observe(truth, errors, np.random.default_rng(0))
    in_gap = (truth.times >= 4.0) & (truth.times < 5.0)
    assert_array_equal(seen.frames, np.flatnonzero(~in_gap))
    lost = (truth.times >= 1.0) & (truth.times < 2.5)
    arm = np.isin(MODEL.joints, ARMS["LEFT"])
    assert_array_equal(seen.seen, ~in_gap[:, None] & ~(lost[:, None] & arm))
    valid = np.stack([skeleton.valid for skeleton in seen.skeletons])
    assert_array_equal(valid[:, MODEL.joints], seen.seen[~in_gap])


def test_outliers_are_as_many_and_as_far_as_asked() -> None:
    truth = someone(2, 20.0)
    errors = MeasurementErrors(0.002, outliers=0.05, outlier_size=1.0, outliers_between=(0.0, 15.0))
    seen = observe(truth, errors, np.random.default_rng(0))
    measured = np.stack([skeleton.positions for skeleton in seen.skeletons])[:, MODEL.joints]
    error = np.linalg.norm(measured - truth.positions, axis=-1)
    assert not seen.outlier[truth.times >= 15.0].any()
    assert seen.outlier[truth.times < 15.0].mean() == pytest.approx(0.05, abs=0.005)
    assert error[~seen.outlier].max() < 0.012
    assert error[seen.outlier].max() == pytest.approx(1.0, abs=0.02)
    assert error[seen.outlier].mean() == pytest.approx(0.5, abs=0.04)


def test_drawn_dropouts_lie_where_they_should() -> None:
    dropouts = draw_dropouts(np.random.default_rng(0), 300, (2.0, 6.0), longest=2.0, everything=0.2)
    lengths = np.array([dropout.end - dropout.begin for dropout in dropouts])
    assert min(dropout.begin for dropout in dropouts) >= 2.0 and max(dropout.end for dropout in dropouts) <= 6.0
    assert 0.1 <= lengths.min() < 0.2 and 1.9 < lengths.max() <= 2.0
    share = np.mean([dropout.joints == EVERYTHING for dropout in dropouts])
    assert share == pytest.approx(0.2, abs=0.08)
