"""Balls are found at their true places, with errors as stated."""

from __future__ import annotations

import numpy as np
import pytest
from ball_images import (
    CAMERA,
    DIAMETER,
    HERE,
    apart,
    at,
    cut_by_border,
    found,
    half_hidden,
    overlapping,
    three_touching,
)

from body_tracking.core.compiled import LOOPS
from body_tracking.markers.detection import DetectionSettings, ImageError, detect, prepare
from body_tracking.markers.rendering import Sensor, render
from draws import draws, some


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


def inside(errors: np.ndarray, deviations: np.ndarray) -> float:
    return float((np.abs(errors) < 1.96 * deviations).mean())


def test_no_image_after_the_preparation_waits_for_the_compiler() -> None:
    prepare()
    before = [len(loop.signatures) for loop in LOOPS]
    assert any(before)
    for bits in (8, 16):
        image = overlapping(1, 1.0, 0.02, Sensor(bits=bits)).image
        assert len(detect(image).pixels) == 2
        image.flags.writeable = False  # as in a message
        assert len(detect(image).pixels) == 2
    assert [len(loop.signatures) for loop in LOOPS] == before


@pytest.mark.parametrize(
    ("low", "high", "sensor"),
    some(
        [
            (0.5, 0.8, Sensor()),
            (0.8, 1.5, Sensor()),
            (2.5, 3.0, Sensor()),
            (1.5, 2.5, Sensor()),
            (0.5, 2.5, Sensor(blur=1.0)),
            (0.5, 3.0, Sensor(bits=16)),
            (0.8, 1.2, Sensor(brightness=5.0)),
            (0.8, 1.2, Sensor(brightness=0.5)),
        ],
        4,
    ),
)
def test_centroids_of_balls_that_nothing_hides(low: float, high: float, sensor: Sensor) -> None:
    errors, deviations, missed, extra = found([apart(seed, low, high, sensor) for seed in range(draws(8, 40))])
    assert missed + extra <= 0.005 * len(errors) + 1
    assert rms(errors) < 0.03
    assert 0.88 < inside(errors, deviations) < 0.998


@pytest.mark.slow
def test_half_overlapping_balls_are_two() -> None:
    pooled = []
    for depth, behind in ((0.6, 0.1), (1.0, 0.02), (1.5, 0.2), (2.2, 0.05), (2.9, 0.1)):
        scenes = [overlapping(seed, depth, behind, Sensor()) for seed in range(draws(8, 40))]
        errors, deviations, missed, extra = found(scenes)
        assert missed + extra <= 1
        assert rms(errors) < 0.15
        pooled.append(errors / deviations)
    assert inside(np.concatenate(pooled), np.ones(1)) > 0.88


def test_balls_that_nearly_touch_do_not_disturb_each_other() -> None:
    offsets = np.linspace(1.8, 5.0, 8)
    scenes = [overlapping(seed, 1.5, 0.05, Sensor(), offset) for seed in range(draws(3, 20)) for offset in offsets]
    errors, _, missed, extra = found(scenes)
    assert missed + extra <= 0.02 * len(errors)
    assert rms(errors) < 0.03


def test_three_balls_that_touch_are_three() -> None:
    for seed in range(draws(3, 15)):
        for depth in (0.8, 1.2, 1.8):
            errors, _, missed, extra = found([three_touching(seed, depth, Sensor())])
            assert missed == extra == 0
            assert np.abs(errors).max() < 0.1


def test_the_centre_of_a_ball_that_a_limb_half_hides() -> None:
    scenes = [half_hidden(seed, depth, Sensor()) for seed in range(draws(5, 30)) for depth in (0.7, 1.0, 1.5)]
    errors, deviations, missed, extra = found(scenes)
    assert missed + extra <= 1
    assert rms(errors) < 0.15
    assert inside(errors, deviations) > 0.85


def test_a_ball_that_moves_is_one() -> None:
    for seed in range(draws(5, 30)):
        random = np.random.default_rng(seed)
        ball = at(random.uniform(100.0, 380.0, (1, 2)), random.uniform(1.0, 1.5, 1))
        velocity = 5.0 * random.standard_normal((1, 3))
        scene = render(CAMERA, *HERE, ball, DIAMETER, Sensor(exposure=0.002), seed, velocities=velocity)
        balls = detect(scene.image)
        assert len(balls.pixels) == 1
        assert np.abs(balls.pixels - scene.centroids).max() < 0.15


def test_the_area_of_a_ball_is_that_of_its_outline() -> None:
    balls = detect(apart(1, 1.3, 1.4, Sensor()).image)
    assert balls.areas == pytest.approx(np.pi * (834.0 * 0.5 * DIAMETER / 1.35) ** 2, rel=0.15)


def test_no_balls_are_found_where_there_are_none() -> None:
    dark = render(CAMERA, *HERE, np.zeros((0, 3)), DIAMETER, Sensor(), 0).image
    for image in (dark, np.zeros_like(dark), np.full_like(dark, 255), np.full((3, 2), 65535, dtype=np.uint16)):
        balls = detect(image, 5, "left")
        assert (balls.stamp_ns, balls.camera) == (5, "left")
        assert balls.pixels.shape == (0, 2) and balls.areas.shape == (0,) and balls.covariance.shape == (0, 2, 2)


def test_broken_pixels_and_large_lights_are_dropped_and_counted() -> None:
    image = np.array(apart(1, 1.0, 2.0, Sensor(), 5).image)
    image[5:7, 300] = 255
    image[470, 20] = 255
    image[400:470, 560:630] = 255
    balls = detect(image)
    assert balls.dropped == 3
    assert len(balls.pixels) == 5


def test_a_ball_cut_by_the_border_is_found_with_errors_as_stated_if_half_of_it_is_seen() -> None:
    scenes = [cut_by_border(seed, depth, Sensor()) for seed in range(draws(6, 40)) for depth in (0.6, 1.0, 1.5, 2.5)]
    errors, deviations, missed, extra = found(scenes)
    assert extra == 0 and missed <= 0.05 * len(scenes)  # with the centre on the border it may seem beyond
    assert rms(errors) < 0.1
    assert inside(errors, deviations) > 0.88
    for x in (-6.0, -3.0):  # of a ball of 5.8 pixels
        scene = render(CAMERA, *HERE, at(np.array([[x, 200.0]]), np.array([1.0])), DIAMETER, Sensor(), 0)
        balls = detect(scene.image)
        assert len(balls.pixels) == 0 and balls.dropped <= 1


@pytest.mark.slow
def test_hostile_images_take_no_long_time_and_no_other_error() -> None:
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, (480, 640), dtype=np.uint8)
    salt = np.where(random.random((480, 640)) < 0.01, 255, 3).astype(np.uint8)
    blocks = np.kron(random.random((60, 80)) < 0.01, np.full((8, 8), 200)).astype(np.uint8)
    stripes = np.zeros((480, 640), dtype=np.uint16)
    stripes[::40, 5:100] = 60000
    for image in (noise, salt, blocks, stripes, noise.T, noise[::2, ::-3], noise[:1], noise[:, :1]):
        balls = detect(image)
        assert np.isfinite(balls.pixels).all() and (np.linalg.eigvalsh(balls.covariance) > 0.0).all()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640, 3), dtype=np.uint8),
        np.zeros((480, 640)),
        np.full((480, 640), np.nan),
        np.zeros((480, 640), dtype=np.int16),
        np.zeros((0, 640), dtype=np.uint8),
        np.zeros(640, dtype=np.uint8),
        None,
    ],
)
def test_what_is_no_grey_image_is_an_error(image: np.ndarray) -> None:
    with pytest.raises(ImageError, match="left"):
        detect(image, 0, "left")


def test_settings_out_of_range_are_an_error() -> None:
    with pytest.raises(ImageError, match="dark"):
        DetectionSettings(dark=1.5)
