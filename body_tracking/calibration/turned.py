"""The pose of a sensor where one of the two sees the body turned around: which of two half turns is the right one.

Labels lead a registration half a turn off while a sensor takes the back for the front, or has left and right exchanged
in a side view. A body is not the same from behind, though: feet, head and arms are before the spine, so that the joints
fit worse the wrong way round.
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
"""Where the sensors agree on left and right in fewer frames than this share, the others have to do."""


def with_sides_swapped(pairs: Pairs, frames: BoolArray) -> Pairs:
    """The same pairs, left and right of the sensor exchanged in some frames.

    Args:
        pairs: n of them.
        frames: (n,) in which.
    """
    # Which sensor's variance it was is not remembered: the larger of both sides is safe.
    variance = np.maximum(pairs.variance, pairs.variance[:, MIRROR])
    return replace(
        pairs,
        sensor=np.where(frames[:, None, None], pairs.sensor[:, MIRROR], pairs.sensor),
        variance=np.where(frames[:, None], variance, pairs.variance),
    )


def registration(pairs: Pairs) -> Pose | None:
    """All joints of all frames registered by their labels; None where that determines nothing."""
    known = np.isfinite(pairs.variance)
    try:
        return rigid_registration(pairs.reference[known], pairs.sensor[known])
    except CalibrationError:
        return None


def half_turn_from(pairs: Pairs, rotation: FloatArray) -> Pose | None:
    """The pose with which each frame says the opposite of left and right than with a given one."""
    return registration(with_sides_swapped(pairs, same_sense(pairs.reference, pairs.sensor @ rotation.T)))


def best_estimate(pairs: Pairs, starts: Iterable[Pose]) -> PairEstimate | None:
    """The best of the estimates from several starts, one of which should be half a turn from another.

    Each is judged by all frames, the sides exchanged in those in which it makes the sensors disagree about them: a body
    seen turned around is then evidence like any other.

    Args:
        pairs: at least ten.
        starts: poses.

    Returns:
        The estimate of lowest cost; None where none could be made.
    """
    found: list[tuple[float, PairEstimate]] = []
    for rotation, translation in starts:
        same = same_sense(pairs.reference, pairs.sensor @ rotation.T)
        try:
            judged = estimate(with_sides_swapped(pairs, ~same), rotation, translation)
            kept = judged if same.mean() < MIN_SAME else estimate(pairs, judged.rotation, judged.translation)
        except CalibrationError:
            continue
        found.append((judged.cost, kept))
    return min(found, key=lambda each: each[0])[1] if found else None
