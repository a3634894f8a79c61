"""Pictures of the people whom the network finds."""

from __future__ import annotations

import numpy as np

from body_tracking.camera.pictures import drawn_in
from body_tracking.camera.pose_model import Landmark, Landmarks, Region


def test_the_left_side_is_blue_the_right_one_orange_and_what_is_guessed_grey() -> None:
    pixels, sure, hidden = np.full((33, 2), 20.0), np.ones(33), Landmark.ANKLE_LEFT
    at = {Landmark.WRIST_LEFT: (80, 20), Landmark.WRIST_RIGHT: (20, 80), hidden: (80, 80)}
    for landmark, place in at.items():
        pixels[landmark] = place
    visible = np.where(np.arange(33) == hidden, 0.0, 1.0)
    region = Region(np.array([50.0, 50.0]), 100.0, 0.0)
    found = Landmarks(pixels, visible, sure, np.zeros((33, 3)), 1.0, region, region)
    image = drawn_in(np.zeros((100, 100, 3), np.uint8), [found], 100)
    (left, right, guessed) = (image[y, x].astype(int) for x, y in at.values())
    assert left[2] > left[0] + 100 and right[0] > right[2] + 100 and np.ptp(guessed) == 0 < guessed[0]
