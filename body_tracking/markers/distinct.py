"""Check that targets can be distinguished from each other, and each from a rotated copy of itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.pose import umeyama
from body_tracking.markers.recognition import SURE, check_targets
from body_tracking.markers.targets import Target

SEPARATION: Final = 6.0
"""Separation of two interpretations in standard deviations of the noise: the wrong one is likelier in 1.3e-3 of the
frames, and within recognition's margin in 1 %."""


class TargetsAlikeError(BodyTrackingError):
    """Raised when two targets, or a target and a rotated copy of itself, cannot be distinguished."""


def check_distinct(targets: Sequence[Target], noise: float) -> None:
    """Reject targets that recognition would confuse.

    Two targets are too alike when balls of one coincide, after the best rigid alignment, with balls of the other within
    the noise. A target is too much like itself when its balls coincide with themselves in another order: an equilateral
    triangle, a square, a flat target that is its own mirror image. The noise and the mean variances of both targets add
    up for each ball.

    Args:
        targets: all that are used together.
        noise: standard deviation of a measured point in its worst direction, the line of sight, metres.

    Raises:
        TargetsAlikeError: the message names the pair, the balls and the distance.
        RecognitionError: invalid targets.
    """
    check_targets(targets)
    if not (np.isfinite(noise) and noise > 0.0):
        raise TargetsAlikeError(f"noise of {noise} m, expected a positive number")
    for target in targets:
        for other in targets:
            _check(target, other, noise)


def _check(target: Target, other: Target, noise: float) -> None:
    count = len(target.points)
    fewest = max(min(count, SURE), count - 1)  # one ball may be hidden
    spread = [np.trace(each.covariance) / len(each.points) / 3.0 for each in (target, other)]
    deviation = float(np.sqrt(noise**2 + sum(spread)))
    limit = SEPARATION * deviation
    for balls in combinations(range(count), fewest):
        model = target.points[list(balls)]
        maps = np.array(
            [each for each in _maps(model, other.points, limit) if target is not other or each != balls], dtype=np.int64
        ).reshape(-1, fewest)
        if not len(maps):
            continue
        models = np.broadcast_to(model, (len(maps), fewest, 3))
        there = other.points[maps]
        rotation, translation = umeyama(models, there, np.ones((len(maps), fewest)))
        off = there - models @ rotation.swapaxes(1, 2) - translation[:, None]
        distances = np.sqrt((off**2).sum(axis=(1, 2)))
        least = int(distances.argmin())
        if distances[least] < limit:
            names = (
                f"target {target.name} and itself turned round"
                if target is other
                else f"targets {target.name} and {other.name}"
            )
            raise TargetsAlikeError(
                f"{names} are too alike: balls {list(balls)} lie on balls {maps[least].tolist()} within "
                f"{1e3 * distances[least] / np.sqrt(fewest):.2f} mm; points that are off by {1e3 * deviation:.2f} mm "
                f"can tell {1e3 * limit / np.sqrt(fewest):.2f} mm apart"
            )


def _maps(model: FloatArray, points: FloatArray, limit: float) -> Iterator[tuple[int, ...]]:
    """All injective maps of the balls to points whose distances differ by no more than the limit allows.

    If the root of the sum of the points' squared errors is e, a distance changes by at most sqrt(2) e.
    """
    wanted = np.linalg.norm(model[:, None] - model, axis=2)
    given = np.linalg.norm(points[:, None] - points, axis=2)
    reach = np.sqrt(2.0) * limit

    def extend(chosen: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        ball = len(chosen)
        if ball == len(model):
            yield chosen
            return
        for point in range(len(points)):
            if point not in chosen and np.all(np.abs(wanted[ball, :ball] - given[point, list(chosen)]) <= reach):
                yield from extend((*chosen, point))

    return extend(())
