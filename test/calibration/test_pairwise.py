"""The pose estimate is robust against the errors of Kinect skeletons, with a consistent covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.calibration.coverage import Coverage
from body_tracking.calibration.pairwise import Pairs, estimate, same_sense, start_from_midline
from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from body_tracking.core.skeleton import MIRROR, FloatArray
from draws import draws
from walkers import about_y, degrees_between, walk

ROTATION, TRANSLATION = about_y(-70.0), np.array([2.0, 0.1, 2.2])


def pairs_of(times: FloatArray, offsets: float = 0.0, noise: float = 0.01, seed: int = 0, places: int = 20) -> Pairs:
    """Pairs with white noise and, per joint, a constant distortion between the two sensors."""
    rng = np.random.default_rng(seed)
    reference = walk(times)
    distortion = rng.normal(scale=offsets, size=(25, 3)) if offsets else np.zeros((25, 3))
    sensor = (reference - TRANSLATION) @ ROTATION
    return Pairs(
        reference + distortion + rng.normal(scale=noise, size=reference.shape),
        sensor + rng.normal(scale=noise, size=reference.shape),
        np.full(reference.shape[:2], 2 * 0.03**2),
        places,
    )


def angle_to(rotation: FloatArray) -> float:
    return degrees_between(rotation, ROTATION)


STILL = np.linspace(0.0, 2.5, 25)
WALK = np.linspace(0.0, 25.0, 250)


@pytest.mark.parametrize("seed", range(5))
def test_movement_overcomes_a_constant_distortion(seed: int) -> None:
    """The error of the plain fit stays, that of the estimate vanishes; one still pose cannot achieve that."""
    still, moving = pairs_of(STILL, 0.06, seed=seed, places=1), pairs_of(WALK, 0.06, seed=seed)
    plain, _ = rigid_registration(still.reference.mean(axis=0), still.sensor.mean(axis=0))
    found = estimate(moving, plain, np.zeros(3))
    assert angle_to(found.rotation) < 1.0
    assert angle_to(found.rotation) < 0.5 * angle_to(plain)


def test_the_stated_uncertainty_covers_the_error() -> None:
    """Normalised errors of rotation and translation at the person's place, over distorted still poses and walks."""
    # A distortion that changes with place and heading averages out over many; the remaining part is drawn here.
    stated = []
    for times, places, distortion in ((STILL, 1, 0.05), (WALK, 20, 0.05 / np.sqrt(6.0))):
        normalised = []
        for seed in range(draws(8, 30)):
            pairs = pairs_of(times, distortion, seed=seed, places=places)
            found = estimate(pairs, ROTATION, TRANSLATION)
            turn = Rotation.from_matrix(ROTATION @ found.rotation.T).as_rotvec()
            own = found.rotation.T @ (found.centre - found.translation)
            shift = ROTATION @ own + TRANSLATION - found.centre
            error = np.concatenate([turn, shift])
            normalised.append(error @ np.linalg.solve(found.covariance, error))
        # Conservative, but not absurdly: 6 degrees of freedom.
        assert 0.3 < np.mean(normalised) < 9.0
        stated.append(found.rotation_stddev)
    assert stated[0] > 5.0 * stated[1]


def test_frames_with_a_turned_body_are_left_out() -> None:
    pairs = pairs_of(WALK)
    sensor = pairs.sensor.copy()
    sensor[::4] = sensor[::4][:, MIRROR]
    found = estimate(replace(pairs, sensor=sensor), ROTATION @ about_y(8.0), TRANSLATION)
    assert found.turned == pytest.approx(0.25, abs=0.01)
    assert angle_to(found.rotation) < 0.1


def test_outliers_and_unknown_joints_do_not_matter() -> None:
    pairs = pairs_of(WALK)
    found = estimate(pairs, np.eye(3), np.zeros(3))
    assert angle_to(found.rotation) < 0.1
    assert_allclose(found.translation, TRANSLATION, atol=0.005)
    assert found.turned == 0.0
    assert 0.005 < found.residual < 0.05
    rng = np.random.default_rng(5)
    sensor, variance = pairs.sensor.copy(), pairs.variance.copy()
    wrong = rng.random(sensor.shape[:2]) < 0.1
    sensor[wrong] += rng.normal(scale=0.7, size=(int(wrong.sum()), 3))
    missing = rng.random(sensor.shape[:2]) < 0.1
    sensor[missing], variance[missing] = np.nan, np.inf
    found = estimate(replace(pairs, sensor=sensor, variance=variance), ROTATION, TRANSLATION)
    assert angle_to(found.rotation) < 0.3


def test_moving_one_sensors_coordinates_moves_the_answer_along() -> None:
    pairs = pairs_of(WALK, 0.04)
    turn, shift = Rotation.from_euler("yxz", [25, 8, -5], degrees=True).as_matrix(), np.array([0.5, -0.2, 0.3])
    plain = estimate(pairs, ROTATION, TRANSLATION)
    moved = estimate(
        replace(pairs, sensor=pairs.sensor @ turn.T + shift), ROTATION @ turn.T, TRANSLATION - ROTATION @ turn.T @ shift
    )
    assert_allclose(moved.rotation, plain.rotation @ turn.T, atol=1e-9)
    assert_allclose(moved.translation, plain.translation - plain.rotation @ turn.T @ shift, atol=1e-9)
    assert_allclose(moved.covariance, plain.covariance, rtol=1e-6)


def test_the_spine_alone_gives_a_start_whatever_the_labels() -> None:
    pairs = pairs_of(WALK)
    start = start_from_midline(replace(pairs, sensor=pairs.sensor[:, MIRROR]))
    assert start is not None
    assert angle_to(start[0]) < 3.0
    assert start_from_midline(pairs_of(STILL)) is None


def test_agreement_is_about_the_sense_of_the_axis() -> None:
    body = walk(np.zeros(1))
    assert same_sense(body, body).all()
    assert not same_sense(body, body[:, MIRROR]).any()


def test_too_few_pairs_and_contradicting_ones_are_refused() -> None:
    few = pairs_of(STILL[:5])
    with pytest.raises(CalibrationError, match="5 pairs"):
        estimate(few, ROTATION, TRANSLATION)
    pairs = pairs_of(STILL)
    with pytest.raises(CalibrationError, match="left and right"):
        estimate(replace(pairs, sensor=pairs.sensor[:, MIRROR], places=1), ROTATION, TRANSLATION)


def test_memory_is_bounded_and_spread_over_places() -> None:
    coverage = Coverage(per_place=5, capacity=60)
    body = walk(np.zeros(1))[0]
    nothing = np.zeros((25, 3))
    for index in range(1000):  # a standing person
        coverage.add(index * 0.1, body, body, nothing, np.ones(25))
    assert len(coverage) == 5
    assert coverage.oldest == pytest.approx(99.5)
    for index, positions in enumerate(walk(np.linspace(3.0, 120.0, 1000))):
        coverage.add(100.0 + index * 0.1, positions, positions, nothing, np.ones(25))
    assert len(coverage) == 60
    assert coverage.pairs().places > 10


def test_a_corrected_clock_moves_the_remembered_frames() -> None:
    coverage = Coverage(per_place=5, capacity=10)
    body, velocity = walk(np.zeros(1))[0], np.ones((25, 3))
    coverage.add(10.0, body, body, velocity, np.ones(25))
    coverage.shift_clock(0.01, 1e-3)
    assert_allclose(coverage.pairs().sensor[0], body + 0.02, atol=1e-12)
