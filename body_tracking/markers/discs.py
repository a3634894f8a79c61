"""Bright regions that are not one whole ball: balls that overlap, a ball that something hides in part or that moved.

A ball is a disc of one brightness with a blurred edge, A N((r - distance) / s) with N the normal distribution function.
Models of a region are fitted to its pixels by the method of Levenberg and Marquardt, and the one with the least
information criterion (Schwarz 1978) is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.special import ndtr

from body_tracking.core.skeleton import FloatArray

MOST_DISCS: Final = 4
"""That are fitted together."""
_ITERATIONS: Final = 30
_STEP: Final = 1e-5
"""Of the derivatives' differences, pixels or shares of the brightness."""
_EDGE: Final = 0.8, 0.4
"""Standard deviation of the edge's blur, pixels: the expected value and what it may differ by."""
_MOST_BRIGHT: Final = 30.0
"""Brightness of a ball, in that of the region, which saturates."""
_LEAST_RADIUS: Final = 0.7
_MISFIT: Final = 0.01
"""Of the models, share of the brightness: a ball is not equally bright all over."""
_GAUSS: Final = np.polynomial.legendre.leggauss(5)
_BLURRED: Final = 4.0
"""Standard deviations of the blur by which discs must be apart not to hide each other."""
_LEAST_GAP: Final = 0.25
"""Radii between the centres of discs that are two."""
_CONVINCING: Final = 1.0
"""Weighted sum of squares over the number of pixels of a model that needs no rival."""
_EXPLAINED: Final = 0.06
"""Misfit from which on no more discs are tried."""
_INSTANTS: Final = np.linspace(-0.5, 0.5, 7)[:, None, None]

Model = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Brightness (m, n) at pixels x (n,) and y (n,) by parameters (m, p), the last of which is the log of the edge."""


@dataclass(frozen=True, slots=True, eq=False)
class Discs:
    """The balls of a region.

    Attributes:
        centres: (k, 2) pixels.
        radii: (k,) pixels.
        covariance: (k, 2, 2) of the centres, pixels squared.
        misfit: root of the mean squared difference between the image and the model, share of the brightness.
        squares: weighted sum of squares over the number of pixels.
        criterion: Schwarz's, of models of the same region the least is the best.
    """

    centres: FloatArray
    radii: FloatArray
    covariance: FloatArray
    misfit: float
    squares: float
    criterion: float


class _Pixels(NamedTuple):
    """The pixels of a region: places (n,), brightness (n,) in that of the region, its variance (n,), saturation."""

    x: FloatArray
    y: FloatArray
    values: FloatArray
    variance: FloatArray
    ceiling: float


def _inside(x: FloatArray, y: FloatArray, p: FloatArray, edge: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance within a disc's edge in units of its blur (m, n), by centre and radius (m, 3 or more); direction."""
    dx, dy = x - p[..., 0:1], y - p[..., 1:2]
    distance = np.maximum(np.hypot(dx, dy), 1e-9)
    return (p[..., 2:3] - distance) / edge, np.stack([dx, dy]) / distance


def _both(u: FloatArray, v: FloatArray, correlation: FloatArray) -> FloatArray:
    """Share of a blurred point that is within two straight edges: the bivariate normal distribution.

    By the integral of Drezner and Wesolowsky (1990) over the angle whose sine is the correlation.
    """
    angle = np.arcsin(np.clip(correlation, -0.999, 0.999))
    squares, product = u * u + v * v, 2.0 * u * v
    total = np.zeros_like(u)
    for node, weight in zip(*_GAUSS, strict=True):
        at = (0.5 * (1.0 + node)) * angle
        sine = np.sin(at)
        total += weight * np.exp(-0.5 * (squares - product * sine) / (1.0 - sine * sine))
    shared: FloatArray = ndtr(u) * ndtr(v) + angle / (4.0 * np.pi) * total
    return shared


def overlapping(x: FloatArray, y: FloatArray, p: FloatArray) -> FloatArray:
    """Discs, the larger, which are nearer, before the smaller; parameters x, y, radius, brightness of each."""
    edge, count = np.exp(p[:, -1:]), (p.shape[1] - 1) // 4
    result = np.zeros((len(p), len(x)))
    discs = p[:, :-1].reshape(len(p), count, 4)
    before: list[tuple[int, FloatArray, FloatArray]] = []
    # the order of the first set of parameters, so that its derivatives see no jump
    for index in np.argsort(-discs[0, :, 2]).tolist():
        inside, normal = _inside(x, y, discs[:, index], edge)
        share = ndtr(inside)
        shown = share
        for nearer, other, other_normal in before:
            gap = np.hypot(*(discs[0, index, :2] - discs[0, nearer, :2])) - discs[0, index, 2] - discs[0, nearer, 2]
            if gap > _BLURRED * edge[0, 0]:
                continue
            hidden = _both(inside, other, (normal * other_normal).sum(axis=0))
            shown = shown * (1.0 - np.minimum(hidden / np.maximum(share, 1e-12), 1.0))
        result += discs[:, index, 3:] * shown
        before.append((index, inside, normal))
    return result


def cut(x: FloatArray, y: FloatArray, p: FloatArray) -> FloatArray:
    """A disc hidden on one side of a line; x, y, radius, brightness, angle of the line's normal, its distance."""
    edge = np.exp(p[:, -1:])
    line = np.stack([np.cos(p[:, 4:5]), np.sin(p[:, 4:5])])
    inside, normal = _inside(x, y, p, edge)
    across = (x - p[:, 0:1]) * line[0] + (y - p[:, 1:2]) * line[1]
    shown: FloatArray = p[:, 3:4] * _both(inside, (p[:, 5:6] - across) / edge, (normal * line).sum(axis=0))
    return shown


def moving(x: FloatArray, y: FloatArray, p: FloatArray) -> FloatArray:
    """A disc that moves while the shutter is open; x, y, radius, brightness, and the way in x and y."""
    edge = np.exp(p[:, -1:])
    moved = np.stack([p[:, 0] + _INSTANTS[..., 0] * p[:, 4], p[:, 1] + _INSTANTS[..., 0] * p[:, 5]], axis=-1)
    radius = np.broadcast_to(p[:, 2:3], (*moved.shape[:2], 1))
    inside, _ = _inside(x, y, np.concatenate([moved, radius], axis=-1), edge)
    shown: FloatArray = p[:, 3:4] * ndtr(inside).mean(axis=0)
    return shown


def explain(
    x: FloatArray, y: FloatArray, values: FloatArray, variance: FloatArray, ceiling: float, starts: FloatArray
) -> Discs:
    """The balls that explain a region of the image best.

    Args:
        x: (n,) and
        y: (n,) of its pixels.
        values: (n,) brightness above the background.
        variance: (n,) of the values by noise.
        ceiling: brightness above the background at which the sensor saturates.
        starts: (k, 2) pixels inside the balls where so many are known to be, or their common centroid.
    """
    bright = max(float(np.percentile(values, 95)), 1e-9)
    values, variance, ceiling = values / bright, variance / bright**2 + _MISFIT**2, ceiling / bright
    pixels = _Pixels(x, y, values, variance, ceiling)
    weights = np.clip(values, 0.0, 1.0)
    area = max(float(weights.sum()), 1.0)
    if len(starts) > 1:
        radius = np.sqrt(area / np.pi / len(starts))
        return _several(starts, radius, pixels)
    middle, (along, across), lengths, lopsided = _shape(x, y, weights)
    overlap = [_several(_cluster(x, y, weights, 2, along), np.sqrt(0.75 * area / np.pi), pixels)]
    if overlap[0].squares < _CONVINCING:
        return overlap[0]
    way = np.sqrt(12.0 * (lengths[0] ** 2 - lengths[1] ** 2)) * along
    single = [_single(moving, [*middle, 2.0 * lengths[1], 1.0, *way], pixels)]
    # the flat side of a disc that is cut is opposite to its tail; where it is small noise decides
    for hidden in (-np.copysign(1.0, lopsided) * across, np.copysign(1.0, lopsided) * across):
        whole = 2.0 * lengths[0]
        centre = middle + 0.3 * whole * hidden
        single.append(_single(cut, [*centre, whole, 1.0, np.arctan2(hidden[1], hidden[0]), 0.0], pixels))
        if single[-1].squares < _CONVINCING:
            break
    for count in range(3, MOST_DISCS + 1):
        if min(discs.misfit for discs in overlap + single) < _EXPLAINED:
            break
        # discs that share a part of their area
        overlap.append(_several(_cluster(x, y, weights, count, along), np.sqrt(1.5 * area / np.pi / count), pixels))
    best = min(overlap + single, key=lambda discs: discs.criterion)
    if best not in single:
        return best
    # what the model may be wrong by: the centres by the others, each by its probability
    odds = np.exp(-0.5 * np.array([min(discs.criterion - best.criterion, 100.0) for discs in single]))
    apart = np.stack([discs.centres[0] - best.centres[0] for discs in single])
    between = (odds[:, None] * apart).T @ apart / odds.sum()
    return replace(best, covariance=best.covariance + between)


def _shape(x: FloatArray, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Centroid (2,), directions (2, 2) along and across, standard deviations (2,), third moment across."""
    total = weights.sum()
    middle = np.array([weights @ x, weights @ y]) / total
    offset = np.stack([x - middle[0], y - middle[1]])
    values, vectors = np.linalg.eigh((weights * offset) @ offset.T / total)
    directions = vectors.T[::-1]
    return middle, directions, np.sqrt(np.maximum(values[::-1], 0.01)), float(weights @ (directions[1] @ offset) ** 3)


def _cluster(x: FloatArray, y: FloatArray, weights: FloatArray, count: int, along: FloatArray) -> FloatArray:
    """Centres (count, 2) of clusters by Lloyd's method, from an even spread along the longest direction."""
    points = np.stack([x, y], axis=1)
    place = points @ along
    order = np.argsort(place)
    share = np.cumsum(weights[order]) / weights.sum()
    centres = points[order[np.searchsorted(share, (np.arange(count) + 0.5) / count)]]
    for _ in range(10):
        owner = np.linalg.norm(points[:, None] - centres, axis=2).argmin(axis=1)
        total = np.maximum(np.bincount(owner, weights, count), 1e-9)
        centres = np.stack([np.bincount(owner, weights * axis, count) / total for axis in (x, y)], axis=1)
    return centres


def _several(
    starts: FloatArray,
    radius: float,
    pixels: _Pixels,
) -> Discs:
    """Discs that overlap or are near to each other, from centres (k, 2) and a common radius."""
    count = len(starts)
    start = [number for place in starts for number in (*place, radius, 1.0)]
    found, covariance, *quality = _fit(overlapping, start, pixels)
    discs = found[:-1].reshape(count, 4)
    blocks = np.stack([covariance[4 * i : 4 * i + 2, 4 * i : 4 * i + 2] for i in range(count)])
    centres, radii = discs[:, :2], discs[:, 2]
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2)[np.triu_indices(count, 1)]
    inside = (centres > [pixels.x.min(), pixels.y.min()]) & (centres < [pixels.x.max(), pixels.y.max()])
    if not inside.all() or gaps.min() < _LEAST_GAP * radii.max():
        return Discs(centres, radii, blocks, np.inf, np.inf, np.inf)
    return Discs(centres, radii, blocks, *quality)


def _single(
    model: Model,
    start: list[float],
    pixels: _Pixels,
) -> Discs:
    """One disc, whose centre and radius are the first three parameters of the model."""
    found, covariance, *quality = _fit(model, start, pixels)
    return Discs(found[None, :2], found[2:3], covariance[None, :2, :2], *quality)


def _fit(
    model: Model,
    start: list[float],
    pixels: _Pixels,
) -> tuple[FloatArray, FloatArray, float, float, float]:
    """Parameters (p,), their covariance (p, p), and the qualities of :class:`Discs`."""
    x, y, values, variance, ceiling = pixels
    size, weight = len(start) + 1, 1.0 / np.sqrt(variance)
    steps = np.concatenate([np.zeros((1, size)), _STEP * np.eye(size)])
    expected, tightness = np.log(_EDGE[0]), _EDGE[0] / _EDGE[1]

    def linear(parameters: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        made = np.minimum(model(x, y, parameters + steps), ceiling)
        residual = np.append((values - made[0]) * weight, (expected - parameters[-1]) * tightness)
        jacobian = np.zeros((len(residual), size))
        jacobian[:-1] = ((made[1:] - made[0]) / _STEP * weight).T
        jacobian[-1, -1] = tightness
        return residual, jacobian, float(residual @ residual)

    found: FloatArray = np.array([*start, expected], dtype=np.float64)
    damping = 1e-3
    residual, jacobian, squares = linear(found)
    for _ in range(_ITERATIONS):
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-6), jacobian.T @ residual)
        tried = found + step
        tried[2] = max(tried[2], _LEAST_RADIUS)
        if model is overlapping:
            tried[2:-1:4] = np.maximum(tried[2:-1:4], _LEAST_RADIUS)
            tried[3:-1:4] = np.clip(tried[3:-1:4], 0.05, _MOST_BRIGHT)
        tried[-1] = np.clip(tried[-1], np.log(0.2), np.log(4.0))
        update = linear(tried)
        if update[2] < squares:
            done = squares - update[2] < 1e-3 * max(squares, 1.0)
            found, (residual, jacobian, squares), damping = tried, update, max(0.2 * damping, 1e-7)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    freedom = max(len(values) - size, 1)
    inverse: FloatArray = np.asarray(np.linalg.pinv(jacobian.T @ jacobian + 1e-9 * np.eye(size)), dtype=np.float64)
    covariance = max(1.0, squares / freedom) * inverse
    misfit = float(np.sqrt(np.mean((residual[:-1] / weight) ** 2)))
    return found, covariance, misfit, squares / len(values), squares + size * float(np.log(len(values)))
