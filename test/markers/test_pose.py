"""The pose of a target from its balls: exact without noise, and with a true covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from target_points import TARGET_POINTS, fit_pose, measure, random_rotation, rotation_error

from body_tracking.markers import pose
from body_tracking.markers.observations import Points
from body_tracking.markers.pose import umeyama
from body_tracking.markers.targets import Target
from draws import draws

TARGET = Target("target", TARGET_POINTS, np.zeros((15, 15)))
ALL = np.arange(5)


def exact(positions: np.ndarray) -> Points:
    covariance = np.tile(1e-8 * np.eye(3), (len(positions), 1, 1))
    return Points(1, "rig", positions, covariance, np.zeros((len(positions), 0), dtype=np.int64))


@pytest.mark.parametrize("hidden", [0, 1, 2])
def test_exact_points_give_the_pose(hidden: int) -> None:
    rng = np.random.default_rng(hidden)
    for _ in range(20):
        rotation, place = random_rotation(rng), rng.normal(size=3)
        assignment = np.where(hidden > ALL, -1, ALL)
        fit = fit_pose(TARGET, exact(TARGET_POINTS @ rotation.T + place), assignment)
        assert np.allclose(fit.rotation, rotation, atol=1e-9)
        assert np.allclose(fit.translation, place, atol=1e-9)
        assert fit.residual < 1e-9
        assert np.linalg.det(fit.rotation) == pytest.approx(1.0)


def test_error_and_stated_covariance_at_one_metre() -> None:
    """0.19 mm and 0.155 degrees, a tenth above the floor of 0.172 and 0.141; NEES of 6 within chance."""
    rng = np.random.default_rng(5)
    count = draws(600, 3000)
    errors, nees = np.empty((count, 6)), np.empty(count)
    for number in range(count):
        rotation, place = random_rotation(rng), np.array([0.0, 0.0, 1.0])
        fit = fit_pose(TARGET, measure(TARGET_POINTS @ rotation.T + place, rng), ALL)
        errors[number] = np.r_[place - fit.translation, rotation_error(rotation, fit.rotation)]
        nees[number] = errors[number] @ np.linalg.solve(fit.covariance, errors[number])
    rms = np.sqrt((errors**2).mean(axis=0))
    assert 1e3 * np.linalg.norm(rms[:3]) < 0.19
    assert np.rad2deg(np.linalg.norm(rms[3:])) < 0.155
    assert nees.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / count))


def test_covariance_counts_the_targets_own() -> None:
    rng = np.random.default_rng(6)
    count = draws(400, 2000)
    root = 3e-4 * rng.normal(size=(15, 15))
    target = replace(TARGET, covariance=root @ root.T)
    nees = np.empty(count)
    for number in range(count):
        rotation, place = random_rotation(rng), np.array([0.1, 0.0, 1.5])
        built = TARGET_POINTS + (root @ rng.normal(size=15)).reshape(5, 3)
        fit = fit_pose(target, measure(built @ rotation.T + place, rng), ALL)
        error = np.r_[place - fit.translation, rotation_error(rotation, fit.rotation)]
        nees[number] = error @ np.linalg.solve(fit.covariance, error)
    assert nees.mean() == pytest.approx(6.0, abs=4.0 * np.sqrt(12.0 / count) + 0.1)


def test_nothing_turns_with_the_frame() -> None:
    """Turning all points and covariances turns the pose and its covariance, and nothing else."""
    rng = np.random.default_rng(7)
    points = measure(TARGET_POINTS @ random_rotation(rng).T + np.array([0.0, 0.0, 1.0]), rng)
    turn = random_rotation(rng)
    first = fit_pose(TARGET, points, ALL)
    turned = replace(points, positions=points.positions @ turn.T, covariance=turn @ points.covariance @ turn.T)
    second = fit_pose(TARGET, turned, ALL)
    both = np.kron(np.eye(2), turn)
    assert np.allclose(second.rotation, turn @ first.rotation, atol=1e-9)
    assert np.allclose(second.translation, turn @ first.translation, atol=1e-9)
    assert np.allclose(second.covariance, both @ first.covariance @ both.T, rtol=1e-6, atol=1e-14)


def test_points_in_any_layout_of_memory_need_no_other_machine_code() -> None:
    """Each type of array takes five seconds of compiling, in which a node would not answer."""
    rng = np.random.default_rng(4)
    points, weights = rng.normal(size=(2, 5, 3)), np.ones((2, 5))
    read_only, columns = points.copy(), np.asfortranarray(points)
    read_only.flags.writeable = False
    expected = umeyama(points, points, weights)
    compiled = len(pose._fitted.signatures)  # type: ignore[attr-defined]
    for other in (read_only, columns):
        for found, same in zip(umeyama(other, other, weights), expected, strict=True):
            assert np.allclose(found, same, rtol=0.0, atol=1e-15)
    assert len(pose._fitted.signatures) == compiled  # type: ignore[attr-defined]
