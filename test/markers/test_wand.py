"""Calibration by a waved wand: stated deviations over seeds, wrong sightings, and refused input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import rig

from body_tracking.core import so3
from body_tracking.markers.bundle_points import Sightings
from body_tracking.markers.rig import Rig
from body_tracking.markers.wand import Wand, WandError, calibrate_wand, intersect
from draws import draws

WAND = Wand((0.0, 0.15, 0.45))


def waved(truth: Rig, rng: np.random.Generator, views: int = 80, wrong: float = 0.01) -> Sightings:
    """A wand seen at so many places, with a share of wrong sightings."""
    middle = rng.uniform([-0.15, -0.3, 0.8], [0.5, 0.3, 1.6], (views, 3))
    along = rng.normal(size=(views, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    places = np.array(WAND.places) - 0.2
    pixels = truth.project(middle[:, None] + places[:, None] * along[:, None])
    pixels = pixels + 0.1 * rng.normal(size=pixels.shape)
    bad = rng.random(pixels.shape[:-1]) < wrong
    pixels[bad] = rng.uniform([0, 0], [640, 480], (bad.sum(), 2))
    seen = np.stack([camera.contains(pixels[index]) for index, camera in enumerate(truth.cameras)])
    cameras, numbers, points = np.nonzero(seen)
    return Sightings(cameras, numbers, points, pixels[seen])


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 4])
def test_errors_of_poses_are_within_their_stated_deviations(count: int) -> None:
    truth, standard = rig(count), []
    for seed in range(draws(4, 20)):
        rng = np.random.default_rng(seed)
        long = Wand(WAND.places, 2e-4)
        seen = waved(truth, rng)
        made = calibrate_wand(truth.cameras, seen, long)
        turn = so3.rotation_vectors(truth.rotations @ made.rig.rotations.transpose(0, 2, 1))[1:]
        error = np.concatenate([turn, (truth.translations - made.rig.translations)[1:]], axis=1)
        deviation = np.sqrt(np.diag(made.rig.covariance)).reshape(count, 15)[1:, 9:]
        standard.append(error / deviation)
        assert not np.diag(made.rig.covariance).reshape(count, 15)[:, :9].any()
        assert np.linalg.norm(error[:, 3:], axis=1).max() < 1.5e-3 and made.adjusted.rms() < 0.2
    assert np.mean(np.abs(standard) < 1.96) > 0.85
    assert np.mean(np.square(standard)) > 0.3


LENS = np.array([1.0, 1.0, 1.0, 1.0, 4e-3, 2e-2])
"""Standard deviations of fx, fy, cx, cy and the radial distortion: those of a calibration by few boards."""


def with_wrong_lenses(truth: Rig, rng: np.random.Generator) -> Rig:
    """The rig with errors of its lenses drawn from its covariance."""
    size = len(truth.cameras)
    error = np.zeros((size, 15))
    error[:, :6] = LENS * rng.normal(size=(size, 6))
    covariance = np.diag(np.tile(np.concatenate([LENS, np.zeros(9)]) ** 2, size))
    return replace(truth.changed(error.ravel()), covariance=covariance)


def test_errors_of_the_lenses_are_in_the_deviations_of_the_poses() -> None:
    truth, standard = rig(4), []
    for seed in range(draws(2, 12)):
        rng = np.random.default_rng(seed)
        wrong = with_wrong_lenses(truth, rng)
        made = calibrate_wand(wrong.cameras, waved(truth, rng), WAND, wrong.covariance)
        turn = so3.rotation_vectors(truth.rotations @ made.rig.rotations.transpose(0, 2, 1))[1:]
        error = np.concatenate([turn, (truth.translations - made.rig.translations)[1:]], axis=1)
        deviation = np.sqrt(np.diag(made.rig.covariance)).reshape(4, 15)
        standard.append(error / deviation[1:, 9:])
        # the wand adds information on the lenses to that of the boards
        assert (deviation[:, :4] < LENS[:4]).all()
    # 1 is expected; with fixed lenses it would be 10
    assert np.sqrt(np.mean(np.square(standard))) < 2.0


def test_a_pixel_without_a_direction_places_no_point() -> None:
    truth = rig(2)
    # barrel distortion reaches its largest radius within the image: beyond it no direction leads to a pixel
    bent = replace(truth.cameras[0], distortion=np.array([-1.2, 0.0, 0.0, 0.0, 0.0]))
    truth = replace(truth, cameras=(bent, truth.cameras[1]))
    places = np.array([[0.0, 0.0, 1.0], [0.05, 0.05, 1.1]])
    pixels = truth.project(places)
    pixels[0, 1] = [0.0, 0.0]
    assert not np.isfinite(bent.undistort(pixels[0, 1:])).any()
    seen = Sightings(np.array([0, 0, 1, 1]), np.zeros(4, dtype=np.intp), np.array([0, 1, 0, 1]), pixels.reshape(4, 2))
    points = intersect(truth, seen, 2)
    np.testing.assert_allclose(points[0], [places[0], np.zeros(3)], atol=1e-9)


def test_a_wand_is_found_among_other_balls_or_not_at_all() -> None:
    wand = np.array([200.0, 100.0]) + np.array([0.0, 1.0, 3.0])[:, None] * np.array([30.0, 40.0])
    others = np.array([[400.0, 60.0], [90.0, 300.0]])
    found = WAND.find(np.concatenate([others, wand[[2, 0, 1]]]))
    assert found is not None
    np.testing.assert_array_equal(found, [3, 4, 2])
    assert WAND.find(wand[:2]) is None
    assert WAND.find(np.concatenate([wand, wand + 100.0])) is None  # ambiguous
    assert WAND.find(np.random.default_rng(0).uniform(0.0, 480.0, (40, 2))) is None


def test_three_balls_are_put_in_the_order_of_the_wand() -> None:
    along = np.array([30.0, 40.0])
    pixels = np.array([200.0, 100.0]) + np.array([0.0, 1.0, 3.0])[:, None] * along
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 2, 1]):
        found = WAND.order(pixels[order])
        assert found is not None
        np.testing.assert_array_equal(pixels[order][found], pixels)
    assert WAND.order(np.array([[0.0, 0.0], [50.0, 0.0], [25.0, 30.0]])) is None
    with pytest.raises(WandError, match="no order"):
        Wand((0.0, 0.2, 0.4)).order(pixels)


def test_what_is_missing_is_named() -> None:
    truth, rng = rig(3), np.random.default_rng(0)
    seen = waved(truth, rng)
    alone = seen.where((seen.cameras != 2) | (seen.views < 3))
    with pytest.raises(WandError, match=r"cameras c share at most \d+ balls"):
        calibrate_wand(truth.cameras, alone, WAND)
    with pytest.raises(WandError, match="needs two cameras"):
        calibrate_wand(truth.cameras[:1], seen, WAND)
    with pytest.raises(WandError, match="not finite"):
        calibrate_wand(truth.cameras, Sightings(seen.cameras, seen.views, seen.points, seen.pixels * np.nan), WAND)
    with pytest.raises(WandError, match="ball 2 of 2"):
        calibrate_wand(truth.cameras, seen, Wand((0.0, 0.45)))
    for places in ((0.0,), (0.1, 0.3), (0.0, 0.3, 0.2)):
        with pytest.raises(WandError, match=r"^balls at [\d., ]+ m along the wand; .*rise from 0"):
            Wand(places)
