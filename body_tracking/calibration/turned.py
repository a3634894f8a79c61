"""The pose of a sensor where one of the two sees the body reversed.

A registration by labels is half a turn off while a sensor mistakes the back for the front, or swaps left and right in a
side view. The body is not symmetric, though: feet, head and arms are in front of the spine, so that the wrong half turn
has larger residuals.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from body_tracking.calibration.pairwise import PairEstimate, Pairs, estimate, same_sense
from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from body_tracking.core.skeleton import MIRROR, BoolArray, FloatArray

Pose = tuple[FloatArray, FloatArray]
"""Rotation (3, 3) and translation (3,) metres, sensor to reference."""

MIN_SAME = 0.2
"""Least share of frames in which the sensors agree on left and right for an estimate from these alone."""

DISAGREEMENT = 2.3
"""Cost of a frame in which the sensors disagree on left and right, in nats: one frame in ten. Without it one of two
people with landmarks as wrong as in photographs (``arm_raises``) calibrates two cameras half a turn off, for a cost of
439.6 where the right pose costs 440.8. Where a Kinect sees a back as a front, the costs differ by hundreds."""


def with_sides_swapped(pairs: Pairs, frames: BoolArray) -> Pairs:
    """The pairs with left and right of the sensor swapped in the frames of a mask (n,)."""
    # The variance is a sum over both sensors: the larger of both sides is an upper bound.
    variance = np.maximum(pairs.variance, pairs.variance[:, MIRROR])
    return replace(
        pairs,
        sensor=np.where(frames[:, None, None], pairs.sensor[:, MIRROR], pairs.sensor),
        variance=np.where(frames[:, None], variance, pairs.variance),
    )


def registration(pairs: Pairs) -> Pose | None:
    """All joints of all frames registered by their labels; None where the pose is not determined."""
    known = np.isfinite(pairs.variance)
    try:
        return rigid_registration(pairs.reference[known], pairs.sensor[known])
    except CalibrationError:
        return None


def half_turn_from(pairs: Pairs, rotation: FloatArray) -> Pose | None:
    """The registration under which each frame's left and right are opposite to those under a given rotation."""
    return registration(with_sides_swapped(pairs, same_sense(pairs.reference, pairs.sensor @ rotation.T)))


def best_estimate(pairs: Pairs, starts: Iterable[Pose]) -> PairEstimate | None:
    """The best of the estimates from several starts, one of which should be half a turn from another.

    The cost of each is over all frames, with left and right swapped where the sensors disagree about them, plus
    :data:`DISAGREEMENT` for each such frame.

    Args:
        pairs: at least ten.
        starts: poses.

    Returns:
        The estimate of lowest cost; None where none could be made.
    """
    found: list[tuple[float, bool, PairEstimate]] = []
    for rotation, translation in starts:
        same = same_sense(pairs.reference, pairs.sensor @ rotation.T)
        try:
            judged = estimate(with_sides_swapped(pairs, ~same), rotation, translation)
        except CalibrationError:
            continue
        cost = judged.cost + DISAGREEMENT * float(np.count_nonzero(~same))
        found.append((cost, bool(same.mean() < MIN_SAME), judged))
    for _, turned, judged in sorted(found, key=lambda each: each[0]):
        try:
            return judged if turned else estimate(pairs, judged.rotation, judged.translation)
        except CalibrationError:
            continue
    return None
