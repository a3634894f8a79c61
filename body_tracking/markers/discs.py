"""Bright regions that are not one whole ball: overlapping balls, a partly hidden ball, or a moving one.

The models of :mod:`body_tracking.markers.disc_fit` are fitted to the pixels of a region; Schwarz's information
criterion (1978) selects one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.disc_fit import CUT, MOVING, OVERLAPPING, clusters, fit

MOST_DISCS: Final = 4
"""Largest number of discs fitted together."""
_MISFIT: Final = 0.01
"""Model error, share of the brightness: a ball is not equally bright all over."""
_ROUND: Final = 0.01
"""Error of the centre of a disc cut by the border, in radii: near the border a ball's image is an ellipse, 7 % longer
than wide at 20 degrees off the axis."""
_LEAST_GAP: Final = 0.25
"""Smallest distance between two discs' centres, in radii."""
_CONVINCING: Final = 1.0
"""Weighted sum of squares per pixel below which no other model is tried."""
_COMPACT: Final = 1.1
"""Ratio of the axes below which a region counts as round; half overlapping balls have 1.3."""
_EXPLAINED: Final = 0.06
"""Misfit below which no more discs are tried."""


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """The balls of a region.

    Attributes:
        centres: (k, 2) pixels.
        radii: (k,) pixels.
        covariance: (k, 2, 2) of the centres, pixels squared.
        misfit: root mean square difference between the image and the model, share of the brightness.
        squares: weighted sum of squares per pixel.
        criterion: Schwarz's; among models of one region the least is best.
    """

    centres: FloatArray
    radii: FloatArray
    covariance: FloatArray
    misfit: float
    squares: float
    criterion: float


def explain(pixels: FloatArray, ceiling: float, starts: FloatArray) -> Discs:
    """The balls that explain a region of the image best.

    Args:
        pixels: (4, n) x, y, brightness above the background, and its variance by noise.
        ceiling: brightness above the background at which the sensor saturates.
        starts: (k, 2) pixels inside the balls if several are known, else their common centroid.
    """
    pixels, ceiling = _scaled(pixels, ceiling)
    x, y, values, _ = pixels
    weights = np.clip(values, 0.0, 1.0)
    area = max(float(weights.sum()), 1.0)
    if len(starts) > 1:
        radius = np.sqrt(area / np.pi / len(starts))
        return _several(starts, radius, pixels, ceiling)
    middle, (along, across), lengths, lopsided = _shape(x, y, weights)
    overlap: dict[int, Discs] = {}
    single: list[Discs] = []

    def least() -> float:
        # weighted sum of squares of the best model so far
        return min((discs.squares for discs in (*overlap.values(), *single)), default=np.inf) * len(x)

    def try_discs(count: int) -> Discs:
        # 1.5: overlapping discs have more area than the region
        radius = np.sqrt(1.5 * area / np.pi / count)
        overlap[count] = _several(clusters(x, y, weights, count, along), radius, pixels, ceiling, least())
        return overlap[count]

    # a round region is more likely three balls than two
    for count in (2,) if lengths[0] > _COMPACT * lengths[1] else (3, 2):
        if try_discs(count).squares < _CONVINCING:
            return overlap[count]
    way = np.sqrt(12.0 * (lengths[0] ** 2 - lengths[1] ** 2)) * along
    single.append(_single(MOVING, [*middle, 2.0 * lengths[1], 1.0, *way], pixels, ceiling, least()))
    # the flat side of a cut disc is opposite its tail; where the third moment is small, noise decides
    for hidden in (-np.copysign(1.0, lopsided) * across, np.copysign(1.0, lopsided) * across):
        whole = 2.0 * lengths[0]
        centre = middle + 0.3 * whole * hidden
        cut = [*centre, whole, 1.0, np.arctan2(hidden[1], hidden[0]), 0.0]
        single.append(_single(CUT, cut, pixels, ceiling, least()))
        if single[-1].squares < _CONVINCING:
            break
    for count in range(3, MOST_DISCS + 1):
        if min(discs.misfit for discs in (*overlap.values(), *single)) < _EXPLAINED:
            break
        if count not in overlap:
            try_discs(count)
    best = min((*overlap.values(), *single), key=lambda discs: discs.criterion)
    if best not in single:
        return best
    # uncertainty of the model: spread of the single models' centres, weighted by their probabilities
    odds = np.exp(-0.5 * np.array([min(discs.criterion - best.criterion, 100.0) for discs in single]))
    apart = np.stack([discs.centres[0] - best.centres[0] for discs in single])
    between = (odds[:, None] * apart).T @ apart / odds.sum()
    return replace(best, covariance=best.covariance + between)


def cut_by_border(pixels: FloatArray, ceiling: float) -> Discs:
    """The ball of a region cut by the image's border, at least half of it visible.

    Args:
        pixels: as in :func:`explain`.
        ceiling: brightness above the background at which the sensor saturates.
    """
    pixels, ceiling = _scaled(pixels, ceiling)
    lit = pixels[:2, pixels[2] > 0.5]
    low, high = lit.min(axis=1), lit.max(axis=1)
    disc = _several(0.5 * (low + high)[None], 0.5 * float((high - low).max()) + 0.5, pixels, ceiling)
    return replace(disc, covariance=disc.covariance + (_ROUND * disc.radii[:, None, None]) ** 2 * np.eye(2))


def _scaled(pixels: FloatArray, ceiling: float) -> tuple[FloatArray, float]:
    """Pixels and saturation in units of the region's brightness; the variance includes the model error."""
    x, y, values, variance = pixels
    bright = max(float(np.percentile(values, 95)), 1e-9)
    return np.stack([x, y, values / bright, variance / bright**2 + _MISFIT**2]), ceiling / bright


def _shape(x: FloatArray, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Centroid (2,), directions (2, 2) along and across, standard deviations (2,), third moment across."""
    total = weights.sum()
    middle = np.array([weights @ x, weights @ y]) / total
    offset = np.stack([x - middle[0], y - middle[1]])
    values, vectors = np.linalg.eigh((weights * offset) @ offset.T / total)
    directions = vectors.T[::-1]
    return middle, directions, np.sqrt(np.maximum(values[::-1], 0.01)), float(weights @ (directions[1] @ offset) ** 3)


def _several(starts: FloatArray, radius: float, pixels: FloatArray, ceiling: float, rival: float = np.inf) -> Discs:
    """Discs that overlap or are close together, from initial centres (k, 2) and a common radius."""
    count = len(starts)
    start = np.array([number for place in starts for number in (*place, radius, 1.0)])
    found, covariance, *quality = _fit(OVERLAPPING, start, pixels, ceiling, rival)
    discs = found[:-1].reshape(count, 4)
    blocks = np.stack([covariance[4 * i : 4 * i + 2, 4 * i : 4 * i + 2] for i in range(count)])
    centres, radii = discs[:, :2], discs[:, 2]
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2)[np.triu_indices(count, 1)]
    low, high = pixels[:2].min(axis=1), pixels[:2].max(axis=1)
    if not ((centres > low) & (centres < high)).all() or gaps.min(initial=np.inf) < _LEAST_GAP * radii.max():
        return Discs(centres, radii, blocks, np.inf, np.inf, np.inf)
    return Discs(centres, radii, blocks, *quality)


def _single(kind: int, start: list[float], pixels: FloatArray, ceiling: float, rival: float) -> Discs:
    """One disc; the first three parameters of the model are its centre and radius."""
    found, covariance, *quality = _fit(kind, np.array(start), pixels, ceiling, rival)
    return Discs(found[None, :2], found[2:3], covariance[None, :2, :2], *quality)


def _fit(
    kind: int, start: FloatArray, pixels: FloatArray, ceiling: float, rival: float
) -> tuple[FloatArray, FloatArray, float, float, float]:
    """Parameters (p,), their covariance (p, p), and misfit, squares and criterion of :class:`Discs`."""
    found, information, squares, plain = fit(kind, start, pixels, ceiling, rival)
    size, count = len(found), pixels.shape[1]
    inverse: FloatArray = np.asarray(np.linalg.pinv(information + 1e-9 * np.eye(size), hermitian=True), np.float64)
    covariance = max(1.0, squares / max(count - size, 1)) * inverse
    return found, covariance, float(np.sqrt(plain / count)), squares / count, squares + size * float(np.log(count))
