"""Inverse kinematics recovers the pose of given points, with a consistent covariance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from random_people import ARMS, RandomPerson

from bent_hands import hand_columns, turned_over
from body_tracking.core.body_model import ModelError
from body_tracking.core.skeleton import BONES as SKELETON_BONES
from body_tracking.core.skeleton import BoolArray, FloatArray, Joint
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.inverse import InverseKinematics
from body_tracking.kinematics.ranges import Ranges
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion
from draws import draws, some

INVERSE = InverseKinematics(CompiledUpperBody())
RANGES = Ranges(MODEL)
NAMES = MODEL.coordinate_names
MILLIMETRE = 1e-3
OF_ARMS_AND_TRUNK = [joint for joint in Joint if joint.name.split("_")[0] in ("SPINE", "SHOULDER", "ELBOW", "WRIST")]
BONES = [bone for bone in SKELETON_BONES if set(bone) <= {*OF_ARMS_AND_TRUNK, Joint.HAND_LEFT, Joint.HAND_RIGHT}]
EXACT = np.full(len(MODEL.joints), 1e-4)
"""Metres: so little noise that the ranges of motion have no influence."""


def people(count: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(count, 35) configurations, (count, 21) lengths and (count, 19, 3) points of people in the midst of a motion."""
    rng = np.random.default_rng(seed)
    q = np.empty((count, MODEL.nq))
    lengths = np.empty((count, len(MODEL.length_names)))
    for number in range(count):
        lengths[number] = RandomPerson.draw(rng).lengths
        q[number] = RandomMotion(rng, 10.0).configuration(rng.uniform(2.0, 10.0, 1))[0]
    return q, lengths, MODEL.forward(q, lengths).positions


def of(*joints: Joint) -> BoolArray:
    """(19,) which points of the model these joints are."""
    return np.isin(MODEL.joints, joints)


def with_bent_wrists(q: FloatArray, seed: int) -> FloatArray:
    """(count, 35) the same with forearms and wrists turned anew: flexion from half to nearly all of its range."""
    rng = np.random.default_rng(seed)
    bent = q.copy()
    for side in ("left", "right"):
        low, high = (limits[hand_columns(side) - 6] for limits in (RANGES.low, RANGES.high))
        angles = rng.uniform(low, high, (len(q), len(low)))
        forth = rng.random(len(q)) < 0.5
        angles[:, 1] = np.where(forth, high[1], low[1]) * rng.uniform(0.5, 0.95, len(q))
        tangent = np.zeros((len(q), MODEL.nv))
        tangent[:, hand_columns(side)] = angles - MODEL.difference(MODEL.neutral(), bent)[:, hand_columns(side)]
        bent = MODEL.integrate(bent, tangent)
    return bent


def upright(column: int, degrees: float) -> FloatArray:
    """(35,) the neutral pose with one coordinate of the tangent changed."""
    tangent = np.zeros(MODEL.nv)
    tangent[column] = np.radians(degrees)
    return MODEL.integrate(MODEL.neutral(), tangent)


def distances(q: FloatArray, lengths: FloatArray, points: FloatArray) -> FloatArray:
    """(19,) metres between the points and those of a configuration."""
    return np.linalg.norm(MODEL.forward(q, lengths).positions - points, axis=1)


def test_points_without_noise_are_reproduced_whatever_the_pose() -> None:
    _, lengths, points = people(draws(15, 60), 1)
    for length, point in zip(lengths, points, strict=True):
        fit = INVERSE.solve(point, EXACT, length, max_iterations=50)
        assert distances(fit.q, length, point).max() < MILLIMETRE
        assert_allclose(fit.residuals, point - MODEL.forward(fit.q, length).positions, atol=1e-12)
        assert np.abs(RANGES.excess(fit.q)).max() < np.radians(1.0)


def test_the_closed_form_needs_no_lengths_to_point_every_bone_the_right_way() -> None:
    """Exact, unless it had to keep an angle from leaving its range."""
    _, lengths, points = people(60, 2)
    starts, ends = (np.array([np.flatnonzero(of(bone[k]))[0] for bone in BONES]) for k in (0, 1))
    rows = MODEL.scalar_v - 6
    exact = 0
    for length, point in zip(lengths, points, strict=True):
        q = INVERSE.start(point)
        angles = q[MODEL.scalar_q]
        if ((angles <= RANGES.low[rows]) | (angles >= RANGES.high[rows])).any():
            continue
        found = MODEL.forward(q, length).positions
        a, b = found[ends] - found[starts], point[ends] - point[starts]
        sine, cosine = np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)
        assert np.arctan2(sine, cosine).max() < 1e-6
        exact += 1
    assert exact > 30


def test_starts_that_are_somewhat_wrong_lead_to_the_same_fit() -> None:
    """By up to 30 degrees in every angle, and half a metre."""
    rng = np.random.default_rng(3)
    _, lengths, points = people(draws(8, 40), 3)
    stddev = np.full(points.shape[1], 0.02)
    for length, point in zip(lengths, points, strict=True):
        known = INVERSE.solve(point, stddev, length, max_iterations=100)
        wrong = np.concatenate([rng.uniform(-0.5, 0.5, 3), np.radians(rng.uniform(-30.0, 30.0, MODEL.nv - 3))])
        fit = INVERSE.solve(point, stddev, length, MODEL.integrate(known.q, wrong), max_iterations=100)
        assert_allclose(MODEL.difference(known.q, fit.q), 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("missing", "unknown"),
    [
        (ARMS["LEFT"], ("elbow_flexion_left", "forearm_pronation_left", "wrist_flexion_left", "wrist_deviation_left")),
        ((Joint.SHOULDER_RIGHT, *ARMS["RIGHT"]), ("clavicle_elevation_right", "elbow_flexion_right")),
        ((Joint.HEAD,), ("neck_flexion", "neck_lateral")),
        ((Joint.HIP_LEFT,), ()),
        ((Joint.SPINE_MID,), ()),
    ],
)
def test_missing_points_keep_what_is_seen_right(missing: tuple[Joint, ...], unknown: tuple[str, ...]) -> None:
    """An angle on which no seen point depends keeps the deviation of its prior."""
    _, lengths, points = people(draws(3, 30), 4)
    gone = of(*missing)
    for length, point in zip(lengths, points, strict=True):
        fit = INVERSE.solve(np.where(gone[:, None], np.nan, point), EXACT, length, max_iterations=50)
        assert distances(fit.q, length, point)[~gone].max() < MILLIMETRE
        assert_array_equal(np.isnan(fit.residuals).all(axis=1), gone)
        stddev = np.sqrt(fit.covariance.diagonal())
        for name in unknown:
            column = NAMES.index(name)
            assert_allclose(stddev[column], INVERSE.prior.stddev[column - 6], rtol=0.01)


@pytest.mark.parametrize("degrees", [5.0, 30.0, 110.0, 140.0])
def test_an_elbow_is_fitted_where_its_points_are_however_far_it_bends(degrees: float) -> None:
    """It was fitted at 21 instead of 5 degrees, while points of 40 mm have a deviation of 13."""
    elbow, lengths = NAMES.index("elbow_flexion_left"), MODEL.default_lengths()
    q = upright(elbow, degrees)
    fit = INVERSE.solve(MODEL.forward(q, lengths).positions, np.full(len(MODEL.joints), 0.04), lengths)
    off = MODEL.difference(q, fit.q)[elbow]
    assert abs(off) < 0.5 * np.sqrt(fit.covariance[elbow, elbow])


@pytest.mark.parametrize("degrees", [-80.0, 0.0, 80.0])
def test_the_rotation_of_a_forearm_that_nothing_shows_is_stated_to_be_anywhere_in_its_range(degrees: float) -> None:
    """Its prior of 30 degrees counted as known, and 80 lay beyond its band."""
    column, lengths = NAMES.index("forearm_pronation_left"), MODEL.default_lengths()
    q = upright(column, degrees)
    unseen = of(Joint.HAND_LEFT, Joint.HAND_TIP_LEFT, Joint.THUMB_LEFT)
    points = np.where(unseen[:, None], np.nan, MODEL.forward(q, lengths).positions)
    fit = INVERSE.solve(points, np.full(len(MODEL.joints), 0.02), lengths)
    stddev = np.sqrt(fit.covariance[column, column])
    assert abs(MODEL.difference(q, fit.q)[column]) < 1.96 * stddev
    assert stddev > np.radians(40.0)


def test_the_covariance_is_that_of_many_noisy_fits() -> None:
    """Of the fitted points, which the noise affects; the ranges of motion determine the rest."""
    rng = np.random.default_rng(5)
    _, lengths, points = people(1, 6)
    count = draws(100, 300)
    wider = np.sqrt(300 / count)
    for length, point in zip(lengths, points, strict=True):
        stddev = rng.uniform(0.005, 0.015, len(point))
        exact = INVERSE.solve(point, stddev, length)
        fitted = np.array(
            [
                MODEL.forward(
                    INVERSE.solve(point + stddev[:, None] * rng.normal(size=point.shape), stddev, length, exact.q).q,
                    length,
                ).positions
                for _ in range(count)
            ]
        )
        jacobian = MODEL.linearise(exact.q, length).jacobian
        stated = np.sqrt(np.einsum("pij,jk,pik->pi", jacobian, exact.covariance, jacobian))
        assert_allclose(fitted.std(axis=0) / stated, 1.0, atol=0.25 * wider)
        assert_allclose((fitted.var(axis=0) / stated**2).mean(), 1.0, atol=0.1 * wider)


def test_limits_push_back_softly() -> None:
    """An elbow seen 40 degrees beyond straight: accurate points outweigh the range, poor ones do not."""
    column = NAMES.index("elbow_flexion_left")
    tangent = np.zeros(MODEL.nv)
    tangent[column] = np.radians(-40.0)
    q, lengths = MODEL.integrate(MODEL.neutral(), tangent), MODEL.default_lengths()
    points = MODEL.forward(q, lengths).positions
    flexion = [
        MODEL.difference(MODEL.neutral(), INVERSE.solve(points, np.full(len(points), noise), lengths, q).q)[column]
        for noise in (1e-4, 0.02, 0.1)
    ]
    low = RANGES.low[column - 6]
    assert_allclose(flexion[0], np.radians(-40.0), atol=np.radians(0.1))
    assert np.radians(-25.0) < flexion[1] < low
    assert flexion[1] < flexion[2]


def test_the_pull_of_an_outlier_does_not_grow_with_its_distance() -> None:
    """Huber: a point 1 m off bends the pose no more than one 0.5 m off; most poses stay within the noise."""
    rng = np.random.default_rng(7)
    _, lengths, points = people(draws(5, 40), 8)
    noise, count = 0.01, points.shape[1]
    stddev = np.full(count, noise)
    errors = []
    for number, (length, point) in enumerate(zip(lengths, points, strict=True)):
        noisy = point + noise * rng.normal(size=point.shape)
        clean = INVERSE.solve(noisy, stddev, length, max_iterations=100)
        off = np.zeros_like(point)
        direction = rng.normal(size=3)
        off[number % count] = direction / np.linalg.norm(direction)
        near, far = (
            INVERSE.solve(noisy + away * off, stddev, length, clean.q, max_iterations=100) for away in (0.5, 1.0)
        )
        others = np.arange(count) != number % count
        moved = [
            distances(fit.q, length, MODEL.forward(clean.q, length).positions)[others].max() for fit in (near, far)
        ]
        assert moved[1] < 1.3 * moved[0] + noise, Joint(MODEL.joints[number % count]).name
        errors.append(np.sqrt((distances(far.q, length, point)[others] ** 2).mean()))
    assert np.median(errors) < np.sqrt(3.0) * noise


def test_points_without_a_trunk_are_an_error() -> None:
    """One point of the trunk shows no trunk; a start that is given needs none."""
    _, lengths, points = people(1, 9)
    gone = of(Joint.SPINE_BASE, Joint.SPINE_SHOULDER, Joint.SHOULDER_RIGHT)
    points[0][gone] = np.nan
    with pytest.raises(ModelError, match="neither two of SpineBase, SpineMid and SpineShoulder nor both shoulders"):
        INVERSE.start(points[0])
    with pytest.raises(ModelError, match="neither two of"):
        INVERSE.solve(points[0], EXACT, lengths[0])
    fit = INVERSE.solve(points[0], EXACT, lengths[0], MODEL.neutral())
    assert np.isfinite(fit.q).all() and np.isfinite(fit.covariance).all()


def test_the_cost_is_that_of_the_fit() -> None:
    rng = np.random.default_rng(10)
    _, lengths, points = people(5, 10)
    stddev = np.full(points.shape[1], 0.02)
    for length, point in zip(lengths, points, strict=True):
        noisy = point + 0.02 * rng.normal(size=point.shape)
        fit = INVERSE.solve(noisy, stddev, length, max_iterations=50)
        assert_allclose(INVERSE.cost(fit.q[None], noisy, stddev, length), [fit.cost], rtol=1e-9)
        for _ in range(10):
            away = MODEL.integrate(fit.q, rng.normal(scale=0.05, size=MODEL.nv))
            assert INVERSE.cost(away[None], noisy, stddev, length)[0] > fit.cost


def test_a_hand_turned_over_moves_the_thumb_alone() -> None:
    """By twice its lever: this is why one pose is so easily taken for the other."""
    q, lengths, _ = people(20, 11)
    for one, length in zip(with_bent_wrists(q, 11), lengths, strict=True):
        points = MODEL.forward(one, length).positions
        for side in ("left", "right"):
            moved = distances(turned_over(one, side), length, points)
            thumb = of(Joint[f"THUMB_{side.upper()}"])
            assert_allclose(moved[~thumb], 0.0, atol=1e-12)
            assert_allclose(moved[thumb], 2.0 * length[MODEL.length_names.index(f"thumb_out_{side}")])
            assert INVERSE.is_turned(one, turned_over(one, side))
        assert not INVERSE.is_turned(one, MODEL.integrate(one, np.full(MODEL.nv, 0.1)))


@pytest.mark.parametrize("noise", some([0.02, 0.005]))
def test_a_bent_hand_is_found_in_the_likeliest_pose(noise: float) -> None:
    """Whether it is sought from the points alone or from the pose with the hand turned over."""
    rng = np.random.default_rng(12)
    q, lengths, _ = people(draws(5, 20), 12)
    right = 0
    stddev = np.full(len(MODEL.joints), noise)
    for number, (one, length) in enumerate(zip(with_bent_wrists(q, 12), lengths, strict=True)):
        points = MODEL.forward(one, length).positions
        noisy = points + noise * rng.normal(size=points.shape)
        least = INVERSE.solve(noisy, stddev, length, one, max_iterations=50).cost
        wrong = turned_over(one, ("left", "right")[number % 2])
        found = INVERSE.solve(noisy, stddev, length, max_iterations=50)
        assert found.cost < least + 0.1
        again = INVERSE.solve(noisy, stddev, length, wrong, max_iterations=50, alternatives=True)
        assert again.cost < least + 0.1
        right += not INVERSE.is_turned(one, found.q)
    assert right >= 0.95 * len(q)


def test_costs_of_many_poses_are_those_of_each() -> None:
    q, lengths, points = people(6, 13)
    stddev = np.full(points.shape[1], 0.02)
    missing = np.where(of(Joint.HEAD)[:, None], np.nan, points[0])
    together = INVERSE.cost(q, missing, stddev, lengths[0])
    assert together.shape == (len(q),)
    assert_allclose(together, [INVERSE.cost(each[None], missing, stddev, lengths[0])[0] for each in q])


def test_elbow_branch_flips_only_with_a_visible_hand() -> None:
    q, lengths, points = people(10, 14)
    stddev = np.full(points.shape[1], 0.02)
    for one, length, point in zip(q, lengths, points, strict=True):
        seen = np.where(of(Joint.THUMB_LEFT)[:, None], np.nan, point)
        for other in INVERSE.turned_about(one, seen, stddev, length):
            assert_allclose(other[:7], one[:7])
            # unchanged rotations go through quaternions and back: rounding only
            moved = np.abs(MODEL.difference(one, other)) > 1e-9
            assert INVERSE.is_turned(one, other)
            assert not any(moved[k] for k, name in enumerate(NAMES) if not name.endswith("_right"))
            assert np.abs(RANGES.excess(other))[hand_columns("right") - 6].max() < 1e-9
