"""The geometry of targets: from views with a true covariance, from drawings, and which of them are too alike."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from target_points import TARGET_POINTS, measure, random_rotation, random_targets, scene

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.distinct import TargetsAlikeError, check_distinct
from body_tracking.markers.pose import umeyama
from body_tracking.markers.target_calibration import (
    TargetCalibrationError,
    calibrate_target,
    ordered_views,
)
from body_tracking.markers.targets import Target
from body_tracking.markers.targets_file import TargetsFileError, load_targets, save_targets
from draws import draws


def views_of(points: FloatArray, rng: np.random.Generator, count: int = 60) -> tuple[FloatArray, FloatArray]:
    views, covariances = np.empty((count, *points.shape)), np.empty((count, len(points), 3, 3))
    for number in range(count):
        place = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.2, 0.2, 3)
        seen = measure(points @ random_rotation(rng).T + place, rng)
        views[number], covariances[number] = seen.positions, seen.covariance
    return views, covariances


def error(target: Target, true: FloatArray) -> FloatArray:
    rotation, translation = umeyama(true[None], target.points[None], np.ones((1, len(true))))
    difference: FloatArray = (target.points - true @ rotation[0].T - translation[0]).ravel()
    return difference


@pytest.mark.parametrize("stated", [True, False])
def test_covariance_of_a_calibrated_target_is_true(stated: bool) -> None:
    """With hidden balls, and outlier views, which are dropped."""
    count = draws(5, 100)
    nees = np.empty(count)
    for seed in range(count):
        rng = np.random.default_rng([seed, 41])
        views, covariance = views_of(TARGET_POINTS, rng)
        if not stated:
            views = views + rng.normal(0.0, 3e-3, views.shape)
        views[::3, rng.integers(5)] = np.nan
        views[5:10] = views[5:10, [1, 0, 2, 3, 4]]
        result = calibrate_target("target", views, covariance if stated else None)
        assert not result.used[5:10].any()
        assert result.used.sum() >= 53
        difference = error(result.target, TARGET_POINTS)
        # nine degrees of freedom besides those of the frame
        nees[seed] = difference @ np.linalg.pinv(result.target.covariance, rcond=1e-9) @ difference
        if stated:
            assert result.reduced_chi_square == pytest.approx(1.0, abs=0.3)
            assert np.sqrt((difference**2).mean()) < 1e-4
    assert nees.mean() == pytest.approx(9.0, abs=4.0 * np.sqrt(18.0 / count) + 0.4)


def test_frame_of_a_calibrated_target() -> None:
    """Origin at the centroid, x from ball 0 to ball 1, ball 2 on the side of y."""
    result = calibrate_target("target", *views_of(TARGET_POINTS, np.random.default_rng(42)))
    points = result.target.points
    assert np.allclose(points.mean(axis=0), 0.0, atol=1e-12)
    edge = points[1] - points[0]
    assert edge[0] > 0.0
    assert np.allclose(edge[1:], 0.0, atol=1e-12)
    assert points[2, 1] > points[0, 1]
    assert points[2, 2] == pytest.approx(points[0, 2])


def test_flexible_target_states_how_much_its_balls_move() -> None:
    rng = np.random.default_rng(43)
    views, covariance = views_of(TARGET_POINTS, rng, 200)
    views[:, 3] += rng.normal(0.0, 2e-3, (200, 3))
    stddev = np.sqrt(np.diag(calibrate_target("target", views, covariance, flexible=True).target.covariance))
    assert stddev.reshape(5, 3)[3].mean() == pytest.approx(1.8e-3, abs=6e-4)
    assert stddev.reshape(5, 3)[[0, 1, 2, 4]].mean() < 1e-3


def test_views_are_found_in_unlabelled_frames() -> None:
    rng = np.random.default_rng(44)
    (target,) = random_targets(rng, 1)
    frames, assignments = [], []
    for number in range(30):
        true, _, _, (assignment,) = scene([target], 1.0, rng, spurious=20, hidden=min(number, 1))
        frames.append(measure(true, rng))
        assignments.append(assignment)
    views, covariance = ordered_views(frames, assignments[0])
    found = np.isfinite(views).all(axis=2).any(axis=1)
    assert found.mean() >= 0.9
    for number in np.flatnonzero(found):
        seen = np.isfinite(views[number]).all(axis=1)
        assert np.array_equal(views[number, seen], frames[number].positions[assignments[number][seen]])
    result = calibrate_target(target.name, views, covariance)
    assert np.sqrt((error(result.target, target.points) ** 2).mean()) < 2e-4


def test_calibration_refuses_what_determines_no_target() -> None:
    rng = np.random.default_rng(45)
    views, covariance = views_of(TARGET_POINTS, rng, 20)
    line = np.linspace(0.0, 0.1, 4)[:, None] * np.array([1.0, 0.5, 0.2])
    unseen = views.copy()
    unseen[:, 2] = np.nan
    for given, noise, text in (
        (views[:1], covariance[:1], "2 are needed"),
        (views[:, :2], covariance[:, :2], "expected"),
        (unseen, covariance, "ball 2"),
        (views, 0.0 * covariance, "positive definite"),
        (views, covariance[:5], "expected"),
        (np.stack([line + 0.01 * number for number in range(9)]), None, "line"),
        (rng.normal(0.0, 0.1, (20, 5, 3)), covariance, "agree"),
    ):
        with pytest.raises(TargetCalibrationError, match=text):
            calibrate_target("target", given, noise)


def exact_target(name: str, points: FloatArray) -> Target:
    return Target(name, points, np.zeros((points.size, points.size)))


def test_targets_too_alike_are_named() -> None:
    rng = np.random.default_rng(46)
    first, second = random_targets(rng, 2)
    turn = random_rotation(rng)
    check_distinct([first, second], 3e-4)
    triangle = 0.03 * np.array([[0.0, 1.0, 0.0], [np.sqrt(0.75), -0.5, 0.0], [-np.sqrt(0.75), -0.5, 0.0]])
    isosceles = np.array([[0.0, 0.06, 0.0], [0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
    flat = TARGET_POINTS * np.array([1.0, 1.0, 0.0])
    part = replace(first, name="part", points=first.points[:4], covariance=np.zeros((12, 12)))
    for targets, text in (
        ([first, replace(first, name="copy", points=first.points[::-1] @ turn.T + 1.0)], "target0 and copy"),
        ([first, part], "target0 and part"),
        ([exact_target("equilateral", triangle)], "equilateral and itself"),
        ([exact_target("isosceles", isosceles)], "isosceles and itself"),
        ([exact_target("flat", flat), exact_target("mirror", flat * np.array([-1.0, 1.0, 1.0]))], "flat and mirror"),
    ):
        with pytest.raises(TargetsAlikeError, match=text):
            check_distinct(targets, 3e-4)
    mirror = replace(first, name="mirror", points=first.points * np.array([1.0, 1.0, -1.0]))
    check_distinct([first, mirror], 3e-4)
    with pytest.raises(TargetsAlikeError):
        check_distinct([first, mirror], 2e-2)


def test_file_of_targets_keeps_every_number(tmp_path: Path) -> None:
    views = views_of(TARGET_POINTS, np.random.default_rng(47))
    targets = [calibrate_target("one", *views, 0.012).target, exact_target("two", TARGET_POINTS)]
    save_targets(targets, tmp_path / "new" / "targets.yaml")
    for before, after in zip(targets, load_targets(tmp_path / "new" / "targets.yaml"), strict=True):
        assert (before.name, before.diameter) == (after.name, after.diameter)
        assert np.array_equal(before.points, after.points)
        assert np.array_equal(before.covariance, after.covariance)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[", "YAML"),
        ("a: 1", "targets"),
        ("targets: {}", "none"),
        ("targets: {one: 3}", "one"),
        ("targets: {one: {diameter: 1}}", "points"),
        ("targets: {one: {points: [[0, 0, 0], [1, 0, 0]]}}", "points"),
        ("targets: {one: {points: [[0, 0, 0], [1, 0, 0], [0, 1, .nan]]}}", "finite"),
        ("targets: {one: {points: [[0, 0, 0], [1, 0, 0], [0, 1, 0]], covariance: [[1]]}}", "covariance"),
        ("targets: {one: {points: [[0, 0, 0], [1, 0, 0], [0, 1, 0]], diameter: -1}}", "diameter"),
        ("targets: {one: {points: [[0, 0, 0], [1, 0], [0, 1, 0]]}}", "one"),
    ],
)
def test_invalid_files_are_refused_by_name(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "targets.yaml"
    path.write_text(text)
    with pytest.raises(TargetsFileError, match=named):
        load_targets(path)
    with pytest.raises(TargetsFileError, match="missing"):
        load_targets(tmp_path / "missing.yaml")
