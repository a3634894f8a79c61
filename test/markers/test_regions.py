"""Bright regions of an image, against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from body_tracking.markers.regions import Components, histogram, regions_of, shapes_of


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.5, 0.95])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_the_components_are_those_of_opencv(share: float, kind: type) -> None:
    image = (100 * (np.random.default_rng(1).random((57, 83)) < share)).astype(kind)
    found = Components.of(image, 50)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((image > 50).astype(np.uint8), connectivity=8)
    own = np.zeros_like(labels)
    for row, first, stop, component in found.runs:
        own[row, first:stop] = component
    # one number of ours for each of OpenCV's, and the other way round
    assert len(np.unique(np.stack([own.ravel(), labels.ravel()]), axis=1).T) == count == len(found.areas)
    assert sorted(found.areas[1:]) == sorted(stats[1:, cv2.CC_STAT_AREA])
    border = np.unique(np.concatenate([own[0], own[-1], own[:, 0], own[:, -1]]))
    assert set(np.flatnonzero(~found.inside)) == set(border) - {0}


def test_the_histogram_is_that_of_every_so_many_rows() -> None:
    image = np.random.default_rng(2).integers(0, 256, (31, 17), dtype=np.uint8)
    assert histogram(image, 4, 256).tolist() == np.bincount(image[::4].ravel(), minlength=256).tolist()


def test_pixels_belong_to_one_region_and_shapes_are_those_of_discs() -> None:
    image = np.full((60, 80), 20, dtype=np.uint8)
    for place in ((20, 20), (33, 20), (60, 40)):  # the first two with 2 pixels between them: their margins meet
        cv2.circle(image, place, 5, 200, -1)
    components = Components.of(image, 100)
    regions = regions_of(image, components, np.array([1, 2, 3]), (0.0, 1.0), 255.0, 1e4)
    places = regions.pixels[:2].T
    assert len(np.unique(places, axis=0)) == len(places)
    assert set(regions.pixels[2]) == {0.0, 180.0}  # above the background in the ring
    shapes = shapes_of(regions, 0.005)
    assert shapes.pixels == pytest.approx(np.array([[20.0, 20.0], [33.0, 20.0], [60.0, 40.0]]), abs=1e-9)
    assert shapes.elongation == pytest.approx(1.0) and shapes.fill == pytest.approx(1.0, abs=0.05)
    assert shapes.areas == pytest.approx(int((image[30:50, 50:70] > 100).sum()))
