"""Matching and triangulation of balls: laws of geometry, agreement with OpenCV, and rates over seeds."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rigs import images, rig, seen_boards

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import hartley_sturm, projection
from body_tracking.markers.camera_calibration import calibrate_cameras
from body_tracking.markers.observations import ImageBalls, Points
from body_tracking.markers.rays import TriangulationError, make_rays, rig_rays
from body_tracking.markers.rig import Rig
from body_tracking.markers.triangulation import TriangulationSettings, triangulate
from draws import draws, some


def places(rng: np.random.Generator, count: int = 15) -> FloatArray:
    return rng.uniform([0.0, -0.2, 0.9], [0.4, 0.2, 1.3], (count, 3))


def names(points: Points, numbers: list[FloatArray]) -> FloatArray:
    """(n, c) the number of each point's ball in each camera, -1 where it is not seen."""
    return np.stack(
        [
            np.where(points.balls[:, index] >= 0, number[points.balls[:, index]], -1)
            for index, number in enumerate(numbers)
        ],
        axis=-1,
    )


def true_points(points: Points, numbers: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Rows of points whose balls are all of one true point, and its number."""
    named = names(points, numbers)
    number = named.max(axis=1)
    right = ((named == number[:, None]) | (named < 0)).all(axis=1)
    return np.flatnonzero(right), number[right]


@pytest.mark.parametrize("noise", [0.1, 5.0, 60.0])
@pytest.mark.parametrize("parallel", [False, True])
def test_the_optimal_correction_meets_the_epipolar_constraint_at_no_more_cost_than_opencvs(
    noise: float, parallel: bool
) -> None:
    rng, truth = np.random.default_rng(0), rig()
    rotations, translations = truth.rotations, truth.translations
    if parallel:  # epipoles at infinity
        rotations, translations = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [-0.3, 0.0, 0.0]])
    focal, centre = np.full((2, 2), 834.0), np.full((2, 2), 240.0)
    matrix, *epipoles = hartley_sturm.fundamental(rotations, translations, focal, centre)
    points = places(rng, 200)
    pixels = []
    for index in range(2):
        inside = points @ rotations[index].T + translations[index]
        exact = inside[:, :2] / inside[:, 2:] * 834.0 + 240.0
        pixels.append(exact + noise * rng.normal(size=exact.shape))
    first, second = hartley_sturm.correct(matrix, (epipoles[0], epipoles[1]), *pixels)
    lines = np.column_stack([first, np.ones(200)]) @ matrix.T
    distance = (np.column_stack([second, np.ones(200)]) * lines).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    np.testing.assert_allclose(distance, 0.0, atol=1e-9)
    theirs = [each[0] for each in cv2.correctMatches(matrix, pixels[0][None], pixels[1][None])]
    cost = ((first - pixels[0]) ** 2).sum(axis=1) + ((second - pixels[1]) ** 2).sum(axis=1)
    other = ((theirs[0] - pixels[0]) ** 2).sum(axis=1) + ((theirs[1] - pixels[1]) ** 2).sum(axis=1)
    assert (cost <= other + 1e-9).all()


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial"])
def test_rays_are_those_of_the_camera(model: str) -> None:
    lens = {
        "plumb_bob": (-0.24, 0.3, 0.001, -0.002, 0.05),
        "rational_polynomial": (5.1, 3.2, 4e-4, -6e-4, 0.2, 5.4, 5, 0.9),
    }
    truth = rig()
    cameras = [replace(each, model=model, distortion=np.array(lens[model])) for each in truth.cameras]
    size = sum(10 + len(each.distortion) for each in cameras)
    truth = Rig(tuple(cameras), truth.rotations, truth.translations, np.zeros((size, size)))
    balls, _ = images(truth, [places(np.random.default_rng(0))] * 2, np.random.default_rng(1))
    rays = make_rays(rig_rays(truth), balls)
    expected = np.concatenate([cameras[index].undistort(balls[index].pixels) for index in range(2)])
    np.testing.assert_allclose(rays.flat, expected, atol=1e-10)


@pytest.mark.parametrize("count", some([3, 2, 4]))
def test_balls_without_noise_give_the_points(count: int) -> None:
    truth, rng = rig(count), np.random.default_rng(2)
    there = places(rng)
    balls, numbers = images(truth, [there] * count, rng, noise=0.0)
    points = triangulate(truth, balls)
    rows, number = true_points(points, numbers)
    assert len(set(number)) >= 14  # of 15, one may be seen by one camera only
    np.testing.assert_allclose(points.positions[rows], there[number], atol=1e-9)
    assert points.frame_id == "a" and points.balls.shape == (len(points.positions), count)


@pytest.mark.parametrize("count", [2, 4])
def test_the_covariance_of_points_is_that_of_their_errors(count: int) -> None:
    truth, squares = rig(count), []
    for seed in range(draws(40, 200)):
        rng = np.random.default_rng(seed)
        there = places(rng)
        balls, numbers = images(truth, [there] * count, rng, noise=0.2)
        points = triangulate(truth, balls)
        rows, number = true_points(points, numbers)
        error = points.positions[rows] - there[number]
        squares.append((error[:, None] @ np.linalg.solve(points.covariance[rows], error[..., None])).ravel())
    square = np.concatenate(squares)
    # chi squared of three degrees of freedom; matching cuts off errors beyond its gate
    assert 0.92 < square.mean() / 3.0 < 1.06
    assert 0.93 < (square < 7.815).mean() < 0.97


def test_two_cameras_match_every_ball_and_keep_the_alternatives() -> None:
    truth, expected, found, wrong = rig(), 0, 0, 0
    for seed in range(draws(40, 200)):
        rng = np.random.default_rng(seed)
        there = places(rng)
        balls, numbers = images(truth, [there] * 2, rng)
        points = triangulate(truth, balls)
        rows, number = true_points(points, numbers)
        expected += len(set(numbers[0]) & set(numbers[1]))
        found += len(set(number))
        wrong += len(points.positions) - len(rows)
    assert found > 0.995 * expected
    assert wrong < expected  # with another ball on its line, each ball has its alternatives


def test_a_third_camera_decides_between_alternatives() -> None:
    wrong, found, expected = 0, 0, 0
    for seed in range(draws(30, 200)):
        rng = np.random.default_rng(seed)
        truth, there = rig(3), places(rng)
        balls, numbers = images(truth, [there] * 3, rng)
        points = triangulate(truth, balls)
        rows, number = true_points(points, numbers)
        expected += sum(sum(each in number for number in numbers) >= 2 for each in range(15))
        found += len(set(number))
        wrong += len(points.positions) - len(rows)
    assert found > 0.99 * expected and wrong < 0.05 * expected


def sensitivity(cameras: Rig, positions: FloatArray) -> FloatArray:
    """(n, 3, p) derivative of triangulated points by the calibration at fixed pixels, by the implicit function theorem:
    ``-inv(J' J) J' D`` with J the derivative of the pixels by the point and D that by the parameters.
    """
    starts = projection.offsets(cameras)
    information, pulls = np.zeros((len(positions), 3, 3)), np.zeros((len(positions), 3, cameras.size))
    for index, camera in enumerate(cameras.cameras):
        made = projection.project(camera, cameras.rotations[index], cameras.translations[index], positions)
        turned = made.by_point.transpose(0, 2, 1)
        information += turned @ made.by_point
        pulls[:, :, starts[index] : starts[index + 1]] = turned @ made.by_parameters
    return -np.linalg.solve(information, pulls)


@pytest.mark.slow
def test_errors_of_points_are_within_what_noise_and_calibration_state() -> None:
    truth, inside = rig(), []
    for seed in range(draws(8, 40)):
        rng = np.random.default_rng(seed)
        calibrated = calibrate_cameras("ab", [(640, 480)] * 2, seen_boards(truth, rng)).rig
        there = places(rng)
        balls, numbers = images(truth, [there] * 2, rng)
        points = triangulate(calibrated, balls)
        rows, number = true_points(points, numbers)
        derivative = sensitivity(calibrated, points.positions[rows])
        covariance = points.covariance[rows] + derivative @ calibrated.covariance @ derivative.transpose(0, 2, 1)
        error = points.positions[rows] - there[number]
        inside.append(np.abs(error) < 1.96 * np.sqrt(np.einsum("nii->ni", covariance)))
        assert len(set(number)) >= len(set(numbers[0]) & set(numbers[1])) - 1
    assert 0.85 < np.concatenate(inside).mean() <= 1.0  # errors of one calibration go together: few draws vary much


def test_cameras_without_balls_and_missing_cameras_give_no_points() -> None:
    truth, rng = rig(3), np.random.default_rng(0)
    balls, _ = images(truth, [places(rng)] * 3, rng)
    nothing = ImageBalls(0, "b", np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))
    for given in ([balls[0]], [nothing], [balls[0], nothing]):
        points = triangulate(truth, given)
        assert (
            points.positions.shape == (0, 3) and points.covariance.shape == (0, 3, 3) and points.balls.shape == (0, 3)
        )
    assert len(triangulate(truth, [balls[2], balls[0]]).positions) >= 10


def test_bad_balls_are_named() -> None:
    truth, rng = rig(), np.random.default_rng(0)
    balls, _ = images(truth, [places(rng)] * 2, rng)
    broken = np.array(balls[1].pixels)
    broken[3, 0] = np.nan
    for given, text in (
        ([], "no images"),
        ([balls[0], balls[0]], "a: given twice"),
        ([replace(balls[0], camera="z")], "z: not in the rig"),
        ([balls[0], replace(balls[1], pixels=broken)], "ball 3 of camera b"),
        ([balls[0], replace(balls[1], covariance=0.0 * balls[1].covariance)], "ball 0 of camera b"),
        ([replace(balls[0], covariance=balls[0].covariance[:3])], "expected"),
    ):
        with pytest.raises(TriangulationError, match=text):
            triangulate(truth, given)
    with pytest.raises(TriangulationError, match="positive"):
        TriangulationSettings(gate=0.0)


@pytest.mark.filterwarnings("error")
def test_rays_that_do_not_meet_give_no_points() -> None:
    rng, truth = np.random.default_rng(0), rig()
    there = np.concatenate([places(rng), [[0.0, 0.0, 1.0]]])
    one_place = Rig(truth.cameras, truth.rotations, 0.0 * truth.translations, truth.covariance)
    assert len(triangulate(one_place, images(one_place, [there] * 2, rng)[0]).positions) == 0
    # one camera before the other, and a ball on the line that joins them: it has no depth
    shift = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]])
    behind = Rig(truth.cameras, np.tile(np.eye(3), (2, 1, 1)), shift, truth.covariance)
    balls, numbers = images(behind, [there] * 2, rng, noise=0.0)
    rows, number = true_points(points := triangulate(behind, balls), numbers)
    assert 15 not in number and len(rows) > 10 and np.isfinite(points.positions).all()
    # far outside the image, where the distortion has no inverse
    far = np.array([[900.0, 900.0], [-900.0, 3.0]])
    outside = [ImageBalls(0, each, far, np.ones(2), np.tile(np.eye(2), (2, 1, 1))) for each in "ab"]
    assert len(triangulate(truth, outside).positions) == 0
