"""Levenberg-Marquardt fits of discs with blurred edges to the pixels of a bright region.

A ball is a disc of one brightness with a blurred edge, A N((r - distance) / s) with N the normal distribution function.
Another disc or a straight edge, blurred by the same s, hides a part of it: the share of a pixel inside both edges is
the bivariate normal distribution function. The derivatives are analytic.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray

OVERLAPPING: Final = 0
"""Discs, the larger (nearer) before the smaller; parameters x, y, radius, brightness of each."""
CUT: Final = 1
"""A disc hidden on one side of a line; x, y, radius, brightness, angle of the line's normal, its distance."""
MOVING: Final = 2
"""A disc that moves during the exposure; x, y, radius, brightness, displacement in x and y."""

_ITERATIONS: Final = 30
_ROUNDS: Final = 10
"""Rounds of Lloyd's method."""
_HOPELESS: Final = 200.0
"""Difference of weighted sums of squares at which the worse model has no chance."""
_EXPECTED_EDGE: Final = 0.8
"""Expected standard deviation of the edge's blur, pixels."""
_EDGE_RANGE: Final = 0.4
"""Standard deviation of the prior of that value, pixels."""
_LEAST_EDGE: Final = 0.2
_MOST_EDGE: Final = 4.0
_LEAST_RADIUS: Final = 0.7
_LEAST_BRIGHT: Final = 0.05
_MOST_BRIGHT: Final = 30.0
"""Largest brightness of a saturated ball, relative to the region's."""
_INSTANTS: Final = 7
"""Sampled instants of the exposure."""
_BLURRED: Final = 4.0
"""Distance in standard deviations of the blur at which discs do not hide each other."""
_FAR: Final = 4.0
"""Standard deviations beyond which the normal distribution function is 0 or 1, within 3e-5."""
_STRAIGHT: Final = 0.999
"""Largest correlation of two edges."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_B1, _B2, _B3, _B4, _B5 = 0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429
_ROOT_2PI: Final = math.sqrt(2.0 * math.pi)


@compiled
def normal(u: float) -> tuple[float, float]:
    """The normal distribution function, within 1e-7, and the density (Abramowitz and Stegun 1964, 26.2.17)."""
    density = math.exp(-0.5 * u * u) / _ROOT_2PI
    t = 1.0 / (1.0 + 0.2316419 * abs(u))
    tail = density * t * (_B1 + t * (_B2 + t * (_B3 + t * (_B4 + t * _B5))))
    return 1.0 - tail if u > 0.0 else tail, density


@compiled
def _clear(values: FloatArray) -> None:
    for i in range(len(values)):
        values[i] = 0.0


@compiled
def both(u: float, share_u: float, density_u: float, v: float, correlation: float) -> tuple[float, float, float, float]:
    """Share of a blurred point within two straight edges: the bivariate normal distribution function.

    Drezner and Wesolowsky's (1990) integral over the angle whose sine is the correlation.

    Args:
        u: distance within the first edge, in standard deviations of the blur.
        share_u: distribution function at u (:func:`normal`).
        density_u: density at u.
        v: distance within the second edge.
        correlation: of the two distances, the cosine between the edges' normals.

    Returns:
        The share, and its derivatives by u, v and the correlation.
    """
    share_v, density_v = normal(v)
    if abs(u) > _FAR or abs(v) > _FAR:
        return share_u * share_v, density_u * share_v, density_v * share_u, 0.0
    correlation = min(max(correlation, -_STRAIGHT), _STRAIGHT)
    angle = math.asin(correlation)
    squares, product = u * u + v * v, 2.0 * u * v
    total = 0.0
    for k in range(len(_NODES)):
        sine = math.sin(0.5 * (1.0 + _NODES[k]) * angle)
        total += _WEIGHTS[k] * math.exp(-0.5 * (squares - product * sine) / (1.0 - sine * sine))
    cosine = math.sqrt(1.0 - correlation * correlation)
    by_u = density_u * normal((v - correlation * u) / cosine)[0]
    by_v = density_v * normal((u - correlation * v) / cosine)[0]
    by_correlation = math.exp(-0.5 * (squares - product * correlation) / (cosine * cosine)) / (2.0 * math.pi * cosine)
    return share_u * share_v + angle / (4.0 * math.pi) * total, by_u, by_v, by_correlation


@compiled
def _by_edge(
    slope: float, disc: int, inside: float, normal_x: float, normal_y: float, edge: float, to: FloatArray
) -> None:
    """Add slope times the derivatives of the scaled distance within a disc's edge by its parameters and the edge's
    log.
    """
    by_distance = slope / edge
    to[4 * disc] += by_distance * normal_x
    to[4 * disc + 1] += by_distance * normal_y
    to[4 * disc + 2] += by_distance
    to[len(to) - 1] -= slope * inside


@compiled
def _by_cosine(
    slope: float,
    disc: int,
    distance: float,
    normal_x: float,
    normal_y: float,
    other_x: float,
    other_y: float,
    to: FloatArray,
) -> None:
    """Add slope times the derivatives of the cosine between a disc's normal and another one by the disc's centre."""
    cross = normal_x * other_y - normal_y * other_x
    to[4 * disc] += slope * normal_y * cross / distance
    to[4 * disc + 1] -= slope * normal_x * cross / distance


@compiled
def _overlapping(
    x: float,
    y: float,
    p: FloatArray,
    edge: float,
    order: IntArray,
    places: FloatArray,
    own: FloatArray,
    gradient: FloatArray,
) -> float:
    """Brightness at a pixel, and its gradient (p,); places (k, 4) and own (p,) are buffers."""
    total = 0.0
    _clear(gradient)
    for rank in range(len(order)):
        i = order[rank]
        dx, dy = x - p[4 * i], y - p[4 * i + 1]
        distance = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        inside, normal_x, normal_y = (p[4 * i + 2] - distance) / edge, dx / distance, dy / distance
        places[i, 0], places[i, 1], places[i, 2], places[i, 3] = inside, normal_x, normal_y, distance
        if inside < -_FAR:
            continue
        share, density = normal(inside)
        shown = share
        _clear(own)
        _by_edge(density, i, inside, normal_x, normal_y, edge, own)
        for before in range(rank):
            j = order[before]
            other, other_x, other_y = places[j, 0], places[j, 1], places[j, 2]
            gap_x, gap_y, radii = p[4 * i] - p[4 * j], p[4 * i + 1] - p[4 * j + 1], p[4 * i + 2] + p[4 * j + 2]
            if other < -_FAR or gap_x * gap_x + gap_y * gap_y > (radii + _BLURRED * edge) ** 2:
                continue
            if other > _FAR:
                shown = 0.0
                break
            hidden, by_inside, by_other, by_cosine = both(
                inside, share, density, other, normal_x * other_x + normal_y * other_y
            )
            left = 1.0 - hidden / share
            if left <= 0.0:
                shown = 0.0
                break
            # shown becomes shown * left
            for k in range(len(own)):
                own[k] *= left
            each = -shown / share
            _by_edge(each * (by_inside - hidden / share * density), i, inside, normal_x, normal_y, edge, own)
            _by_edge(each * by_other, j, other, other_x, other_y, edge, own)
            _by_cosine(each * by_cosine, i, distance, normal_x, normal_y, other_x, other_y, own)
            _by_cosine(each * by_cosine, j, places[j, 3], other_x, other_y, normal_x, normal_y, own)
            shown *= left
        if shown > 0.0:
            bright = p[4 * i + 3]
            total += bright * shown
            for k in range(len(own)):
                gradient[k] += bright * own[k]
            gradient[4 * i + 3] = shown
    return total


@compiled
def _cut(x: float, y: float, p: FloatArray, edge: float, gradient: FloatArray) -> float:
    """Brightness at a pixel, and its gradient (p,)."""
    bright = float(p[3])
    line_x, line_y = math.cos(p[4]), math.sin(p[4])
    dx, dy = x - p[0], y - p[1]
    distance = max(math.sqrt(dx * dx + dy * dy), 1e-9)
    normal_x, normal_y, inside = dx / distance, dy / distance, (p[2] - distance) / edge
    across = (p[5] - dx * line_x - dy * line_y) / edge
    _clear(gradient)
    if inside < -_FAR or across < -_FAR:
        return 0.0
    share, density = normal(inside)
    shown, by_inside, by_across, by_cosine = both(inside, share, density, across, normal_x * line_x + normal_y * line_y)
    _by_edge(bright * by_inside, 0, inside, normal_x, normal_y, edge, gradient)
    _by_cosine(bright * by_cosine, 0, distance, normal_x, normal_y, line_x, line_y, gradient)
    slope = bright * by_across / edge
    gradient[0] += slope * line_x
    gradient[1] += slope * line_y
    gradient[3] = shown
    gradient[4] = slope * (dx * line_y - dy * line_x) + bright * by_cosine * (normal_y * line_x - normal_x * line_y)
    gradient[5] = slope
    gradient[6] -= slope * edge * across
    return bright * shown


@compiled
def _moving(x: float, y: float, p: FloatArray, edge: float, gradient: FloatArray) -> float:
    """Brightness at a pixel, and its gradient (p,)."""
    total, bright = 0.0, float(p[3])
    _clear(gradient)
    for instant in range(_INSTANTS):
        when = instant / (_INSTANTS - 1.0) - 0.5
        dx, dy = x - p[0] - when * p[4], y - p[1] - when * p[5]
        distance = max(math.sqrt(dx * dx + dy * dy), 1e-9)
        inside = (p[2] - distance) / edge
        if inside < -_FAR:
            continue
        share, density = normal(inside)
        total += share / _INSTANTS
        slope = bright / _INSTANTS * density
        _by_edge(slope, 0, inside, dx / distance, dy / distance, edge, gradient)
        gradient[4] += slope * when * dx / (distance * edge)
        gradient[5] += slope * when * dy / (distance * edge)
    gradient[3] = total
    return bright * total


@compiled
def brightness(
    kind: int,
    x: float,
    y: float,
    p: FloatArray,
    edge: float,
    order: IntArray,
    places: FloatArray,
    own: FloatArray,
    gradient: FloatArray,
) -> float:
    """Brightness of a model at a pixel, and its gradient.

    Args:
        kind: of the model.
        x: of the pixel.
        y: of the pixel.
        p: (p,) parameters of the model; the last is the log of the edge.
        edge: standard deviation of the blur, ``exp(p[-1])``.
        order: (k,) discs of an overlapping model, the nearest first.
        places: (k, 4) and
        own: (p,) buffers for an overlapping model.
        gradient: (p,) derivatives by the parameters, written.
    """
    if kind == OVERLAPPING:
        return _overlapping(x, y, p, edge, order, places, own, gradient)
    return _cut(x, y, p, edge, gradient) if kind == CUT else _moving(x, y, p, edge, gradient)


@compiled
def _linear(
    kind: int,
    p: FloatArray,
    pixels: FloatArray,
    ceiling: float,
    information: FloatArray,
    pull: FloatArray,
) -> tuple[float, float]:
    """Weighted (with the prior) and plain sums of squares; writes information (p, p) and pull (p,)."""
    size = len(p)
    order = np.zeros(size // 4, dtype=np.int64)
    for i in range(1, len(order)):
        rank = i
        while rank > 0 and p[4 * order[rank - 1] + 2] < p[4 * i + 2]:
            order[rank] = order[rank - 1]
            rank -= 1
        order[rank] = i
    edge, places, own, gradient = math.exp(p[-1]), np.empty((len(order), 4)), np.empty(size), np.empty(size)
    for i in range(size):
        pull[i] = 0.0
        for j in range(size):
            information[i, j] = 0.0
    prior = (math.log(_EXPECTED_EDGE) - p[-1]) * (_EXPECTED_EDGE / _EDGE_RANGE)
    information[-1, -1] = (_EXPECTED_EDGE / _EDGE_RANGE) ** 2
    pull[-1] = prior * (_EXPECTED_EDGE / _EDGE_RANGE)
    squares, plain = prior * prior, 0.0
    for n in range(pixels.shape[1]):
        made = brightness(kind, pixels[0, n], pixels[1, n], p, edge, order, places, own, gradient)
        difference, weight = pixels[2, n] - min(made, ceiling), 1.0 / pixels[3, n]
        plain += difference * difference
        squares += difference * difference * weight
        if made > ceiling:
            continue
        for i in range(size):
            if gradient[i] != 0.0:
                slope = gradient[i] * weight
                pull[i] += slope * difference
                for j in range(i + 1):
                    information[i, j] += slope * gradient[j]
    for i in range(size):
        for j in range(i):
            information[j, i] = information[i, j]
    return squares, plain


@compiled
def _solve(information: FloatArray, damping: float, pull: FloatArray, lower: FloatArray, step: FloatArray) -> None:
    """Write the step of a damped Gauss-Newton method and the Cholesky factor it uses."""
    size = len(pull)
    for i in range(size):
        step[i] = pull[i]
        for j in range(i + 1):
            value = information[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = math.sqrt(max(value + damping * (information[i, i] + 1e-6), 1e-30))
            else:
                lower[i, j] = value / lower[j, j]
        for k in range(i):
            step[i] -= lower[i, k] * step[k]
        step[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            step[i] -= lower[k, i] * step[k]
        step[i] /= lower[i, i]


@compiled
def clusters(x: FloatArray, y: FloatArray, weights: FloatArray, count: int, along: FloatArray) -> FloatArray:
    """Centres (count, 2) of clusters by Lloyd's method, initially spread evenly along a direction.

    Args:
        x: (n,) of the pixels.
        y: (n,) of the pixels.
        weights: (n,) of the pixels.
        count: of clusters.
        along: (2,) the direction.
    """
    order = np.argsort(x * along[0] + y * along[1])
    centres, total = np.empty((count, 2)), weights.sum()
    rank, share = 0, weights[order[0]]
    for i in range(count):
        while share < (i + 0.5) / count * total and rank < len(order) - 1:
            rank += 1
            share += weights[order[rank]]
        centres[i, 0], centres[i, 1] = x[order[rank]], y[order[rank]]
    sums = np.empty((count, 3))
    for _ in range(_ROUNDS):
        sums[:] = 0.0
        for n in range(len(x)):
            nearest, least = 0, np.inf
            for i in range(count):
                distance = (x[n] - centres[i, 0]) ** 2 + (y[n] - centres[i, 1]) ** 2
                if distance < least:
                    nearest, least = i, distance
            sums[nearest, 0] += weights[n] * x[n]
            sums[nearest, 1] += weights[n] * y[n]
            sums[nearest, 2] += weights[n]
        for i in range(count):
            centres[i, 0] = sums[i, 0] / max(sums[i, 2], 1e-9)
            centres[i, 1] = sums[i, 1] / max(sums[i, 2], 1e-9)
    return centres


@compiled
def fit(
    kind: int, start: FloatArray, pixels: FloatArray, ceiling: float, rival: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Maximum likelihood parameters of a model.

    Args:
        kind: of the model.
        start: (p - 1,) initial parameters without the edge's.
        pixels: (4, n) x, y, brightness and its variance, of each pixel.
        ceiling: brightness at which the sensor saturates.
        rival: weighted sum of squares of another model of these pixels; infinite without one. The fit ends early if the
            rival would stay far better even if each further iteration gained as much as the last one.

    Returns:
        Parameters (p,), their information (p, p), weighted and plain sums of squared differences.
    """
    size = len(start) + 1
    found = np.empty(size)
    for i in range(size - 1):
        found[i] = start[i]
    found[-1] = math.log(_EXPECTED_EDGE)
    lower = np.empty((size, size))
    information, pull = np.empty((size, size)), np.empty(size)
    tried_information, tried_pull = np.empty((size, size)), np.empty(size)
    damping = 1e-3
    squares, plain = _linear(kind, found, pixels, ceiling, information, pull)
    for iteration in range(1, _ITERATIONS + 1):
        tried = np.empty(size)
        _solve(information, damping, pull, lower, tried)
        for i in range(size):
            tried[i] += found[i]
        tried[2] = max(tried[2], _LEAST_RADIUS)
        if kind == OVERLAPPING:
            for first in range(0, size - 1, 4):
                tried[first + 2] = max(tried[first + 2], _LEAST_RADIUS)
                tried[first + 3] = min(max(tried[first + 3], _LEAST_BRIGHT), _MOST_BRIGHT)
        tried[-1] = min(max(tried[-1], math.log(_LEAST_EDGE)), math.log(_MOST_EDGE))
        now, now_plain = _linear(kind, tried, pixels, ceiling, tried_information, tried_pull)
        if now < squares:
            gain = squares - now
            done = gain < 1e-3 * max(squares, 1.0) or now - (_ITERATIONS - iteration) * gain > rival + _HOPELESS
            found, squares, plain, damping = tried, now, now_plain, max(0.2 * damping, 1e-7)
            information, tried_information = tried_information, information
            pull, tried_pull = tried_pull, pull
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return found, information, squares, plain
