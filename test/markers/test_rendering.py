"""The renderer makes the image whose truth it states."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_images import CAMERA, DIAMETER, HERE, NOISELESS, apart, at, half_hidden, overlapping

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.distinct import check_distinct
from body_tracking.markers.rendering import Capsule, RenderingError, Sensor, render, render_chessboard
from body_tracking.markers.spheres import SphereError, outlines, polygon_centroids, sphere_centre_correction
from body_tracking.simulation.marker_scene import EXTENT, make_targets
from draws import draws

RADIUS = 0.5 * DIAMETER


def centroid(image: np.ndarray) -> FloatArray:
    light = image.astype(np.float64)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("depth", [0.5, 1.0, 3.0])
def test_the_light_of_a_ball_has_the_centroid_of_its_outline(depth: float) -> None:
    sensor = replace(NOISELESS, brightness=0.8 * depth**2)
    for seed in range(draws(4, 20)):
        scene = apart(seed, depth, depth, sensor, 1)
        np.testing.assert_allclose(centroid(scene.image), scene.centroids[0], atol=0.005)
        assert scene.visible[0] == pytest.approx(1.0, abs=0.01)


def test_light_of_a_ball_falls_with_the_fourth_power_of_its_distance() -> None:
    # area and brightness each with the square
    near, far = (
        render(CAMERA, *HERE, np.array([[0.0, 0.0, z]]), DIAMETER, replace(NOISELESS, brightness=0.5), 0).image
        for z in (1.0, 2.0)
    )
    assert near.sum(dtype=float) / far.sum(dtype=float) == pytest.approx(16.0, rel=0.01)


def test_a_sphere_is_an_ellipse_whose_centre_is_off_that_of_the_sphere_by_the_cone() -> None:
    ideal = replace(CAMERA, distortion=np.zeros(5))
    centres = np.array([[0.2, -0.1, 0.6], [-0.3, 0.2, 1.0], [0.0, 0.0, 0.5]])
    middle, _ = polygon_centroids(outlines(ideal, centres, 0.05, 4096))
    principal = ideal.matrix[:2, 2]
    factor = 1.0 / (1.0 - (0.05 / centres[:, 2:]) ** 2)
    np.testing.assert_allclose(middle - principal, factor * (ideal.project(centres) - principal), atol=1e-5)


def test_correction_leads_from_the_centroid_to_the_projection_of_the_centre() -> None:
    for radius in (RADIUS, 0.05):
        random = np.random.default_rng(3)
        centres = at(random.uniform([60.0, 60.0], [580.0, 420.0], (50, 2)), random.uniform(0.5, 3.0, 50))
        middle, _ = polygon_centroids(outlines(CAMERA, centres, radius))
        made = sphere_centre_correction(CAMERA, middle, centres[:, 2], radius)
        np.testing.assert_allclose(middle + made, CAMERA.project(centres), atol=1e-5)
    assert sphere_centre_correction(CAMERA, np.zeros((0, 2)), np.zeros(0), RADIUS).shape == (0, 2)


@pytest.mark.parametrize(("depths", "radius"), [(np.array([0.001]), RADIUS), (np.ones(2), RADIUS), (np.ones(1), -1.0)])
def test_correction_of_an_impossible_sphere_is_an_error(depths: FloatArray, radius: float) -> None:
    with pytest.raises(SphereError):
        sphere_centre_correction(CAMERA, np.full((1, 2), 300.0), depths, radius)


def test_what_is_hidden_is_not_visible() -> None:
    assert overlapping(1, 1.5, 0.02, Sensor()).visible == pytest.approx([1.0, 0.5], abs=0.03)
    assert half_hidden(1, 1.0, Sensor()).visible == pytest.approx([0.5], abs=0.03)
    ball = np.array([[0.0, 0.0, 1.0]])
    behind = Capsule(np.array([-1.0, 0.0, 1.5]), np.array([1.0, 0.0, 1.5]), 0.1)
    assert render(CAMERA, *HERE, ball, DIAMETER, Sensor(), 0, limbs=[behind]).visible == pytest.approx([1.0], abs=0.01)
    backwards = render(CAMERA, *HERE, -ball, DIAMETER, Sensor(), 0)
    assert backwards.visible == [0.0] and np.isnan(backwards.centres).all()


def test_a_moving_ball_is_where_it_is_in_the_middle_of_the_exposure() -> None:
    ball, velocity = np.array([[0.05, 0.02, 1.0]]), np.array([[6.0, -3.0, 0.0]])
    still = replace(NOISELESS, brightness=0.8)
    scene = render(CAMERA, *HERE, ball, DIAMETER, still, 0, velocities=velocity)
    np.testing.assert_allclose(centroid(scene.image), scene.centroids[0], atol=0.01)
    assert (scene.image > 0).sum() > 1.2 * (render(CAMERA, *HERE, ball, DIAMETER, still, 0).image > 0).sum()


def test_the_same_seed_makes_the_same_image() -> None:
    first, again, other = (apart(seed, 1.0, 2.0, Sensor(), 3, glints=5).image for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).any()
    assert first.dtype == np.uint8 and apart(1, 1.0, 2.0, Sensor(bits=12), 3).image.max() <= 4095


def test_noise_is_as_stated() -> None:
    sensor = Sensor(bits=16, background=0.2, read_noise=0.01, full_well=1000.0)
    image = render(CAMERA, *HERE, np.zeros((0, 3)), DIAMETER, sensor, 0).image / 65535.0
    assert image.mean() == pytest.approx(0.2, abs=1e-3)
    assert image.std() == pytest.approx(np.sqrt(0.2 / 1000.0 + 0.01**2), rel=0.02)


@pytest.mark.parametrize("seed", range(draws(1, 10)))
def test_corners_of_a_chessboard_are_where_it_is(seed: int) -> None:
    random = np.random.default_rng(seed)
    rotation = cv2.Rodrigues(random.uniform(-0.4, 0.4, 3))[0]
    corners = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 0.03
    board = np.concatenate([corners, np.zeros((48, 1))], axis=1)
    translation = np.array([0.0, 0.0, 0.7]) - rotation @ board.mean(axis=0)
    image = render_chessboard(CAMERA, rotation, translation, 8, 6, 0.03, seed)
    truth = CAMERA.project(board @ rotation.T + translation)
    assert cv2.findChessboardCornersSB(image, (8, 6))[0]
    stop = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3
    start = truth.astype(np.float32).reshape(-1, 1, 2)
    difference = cv2.cornerSubPix(image, start, (5, 5), (-1, -1), stop).reshape(-1, 2) - truth
    assert np.sqrt((difference**2).mean()) < 0.1
    assert np.abs(difference.mean(axis=0)).max() < 0.02


def test_impossible_scenes_are_errors() -> None:
    with pytest.raises(RenderingError):
        render(CAMERA, *HERE, np.zeros((2, 2)), DIAMETER, Sensor(), 0)
    with pytest.raises(RenderingError):
        render(CAMERA, *HERE, np.full((1, 3), np.nan), DIAMETER, Sensor(), 0)
    with pytest.raises(RenderingError):
        render(CAMERA, *HERE, np.ones((1, 3)), DIAMETER, Sensor(), 0, velocities=np.ones((2, 3)))
    with pytest.raises(RenderingError):
        Sensor(bits=20)
    with pytest.raises(RenderingError):
        render_chessboard(CAMERA, *HERE, 0, 6, 0.03, 0)


def test_balls_of_the_scenes_targets_do_not_touch_and_the_targets_are_told_apart() -> None:
    targets = make_targets()
    for target in targets:
        apart = np.linalg.norm(target.points[:, None] - target.points, axis=2)[np.triu_indices(5, 1)]
        assert apart.min() >= 2.0 * DIAMETER and apart.max() == pytest.approx(EXTENT)
    check_distinct(targets, 3e-4)
