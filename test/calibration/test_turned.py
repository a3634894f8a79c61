"""Of two poses half a turn apart the right one is found, whichever sensor sees the body reversed, and for how long."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from body_tracking.calibration.pairwise import Pairs
from body_tracking.calibration.turned import best_estimate, half_turn_from, registration, with_sides_swapped
from body_tracking.core.skeleton import MIRROR, FloatArray, Joint
from walkers import about_y, degrees_between, performed

ROTATION, TRANSLATION = about_y(-45.0), np.array([1.5, 0.1, 0.6])
TO_OPTICAL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""From the level axes of a person who faces a sensor to its optical axes."""


def pairs_of(motion: str, turned: float, seed: int = 0) -> Pairs:
    """Somebody on the spot; the sensor exchanges left and right in the first share of the frames."""
    rng = np.random.default_rng(seed)
    reference = performed(motion)[::5] @ TO_OPTICAL.T + [0.0, 0.0, 2.5]
    sensor = (reference - TRANSLATION) @ ROTATION
    early = np.arange(len(sensor)) < turned * len(sensor)
    sensor[early] = sensor[early][:, MIRROR]
    return Pairs(
        reference + rng.normal(scale=0.03, size=reference.shape),
        sensor + rng.normal(scale=0.03, size=reference.shape),
        np.full(reference.shape[:2], 2 * 0.03**2),
        3,
    )


def angle_to(rotation: FloatArray) -> float:
    return degrees_between(rotation, ROTATION)


@pytest.mark.parametrize("motion", ["shoulder_lifts", "hair_combing", "standing_still"])
@pytest.mark.parametrize("turned", [0.0, 0.4, 0.9, 1.0])
def test_the_half_turn_is_found_from_either_start(motion: str, turned: float) -> None:
    pairs = pairs_of(motion, turned)
    labels = registration(pairs)
    assert labels is not None
    if turned in {0.0, 1.0}:  # where labels alone lead
        assert (angle_to(labels[0]) > 90.0) == (turned == 1.0)
    opposite = half_turn_from(pairs, labels[0])
    assert opposite is not None
    assert angle_to(labels[0] @ opposite[0].T @ ROTATION) > 90.0
    found = best_estimate(pairs, [labels, opposite])
    assert found is not None
    assert angle_to(found.rotation) < 3.0


def test_where_residuals_hardly_differ_the_sensors_agree_on_left_and_right() -> None:
    """A symmetric body as flat as a picture looks alike from both sides, but for noise."""
    for seed in range(10):
        pairs = pairs_of("standing_still", 0.0, seed)
        reference = pairs.reference.copy()
        reference[..., 2] = 2.5
        reference[..., 0] = 0.5 * (reference[..., 0] - reference[:, MIRROR, 0])
        reference[..., 1] = 0.5 * (reference[..., 1] + reference[:, MIRROR, 1])
        noise = np.random.default_rng([seed, 1]).normal(scale=0.03, size=reference.shape)
        pairs = replace(pairs, reference=reference, sensor=(reference + noise - TRANSLATION) @ ROTATION)
        labels = registration(pairs)
        assert labels is not None
        opposite = half_turn_from(pairs, labels[0])
        assert opposite is not None
        found = best_estimate(pairs, [opposite, labels])
        assert found is not None
        assert angle_to(found.rotation) < 10.0


def test_swapped_frames_have_mirrored_joints_and_unknown_hands() -> None:
    pairs = pairs_of("hair_combing", 0.0)
    pairs.variance[:, Joint.HAND_LEFT] = np.inf
    frames = np.arange(len(pairs)) % 2 == 0
    other = with_sides_swapped(pairs, frames)
    assert_array_equal(other.sensor[frames], pairs.sensor[frames][:, MIRROR])
    assert_array_equal(other.sensor[~frames], pairs.sensor[~frames])
    assert_array_equal(other.variance[~frames], pairs.variance[~frames])
    # a hand that one of them does not see is in no pair, whichever it is
    assert np.isinf(other.variance[frames][:, [Joint.HAND_LEFT, Joint.HAND_RIGHT]]).all()
    assert_array_equal(with_sides_swapped(with_sides_swapped(pairs, frames), frames).sensor, pairs.sensor)


def test_without_known_joints_there_is_no_estimate() -> None:
    pairs = pairs_of("standing_still", 0.0)
    nothing = replace(pairs, variance=np.full_like(pairs.variance, np.inf))
    assert registration(nothing) is None
    assert best_estimate(nothing, [(ROTATION, TRANSLATION)]) is None
    assert best_estimate(pairs, []) is None
