"""The optimal correction of a pair of corresponding pixels (Hartley and Sturm 1997; Gaschler 3.2.3).

Of all pairs that meet the epipolar constraint it is the nearest in the two images, the maximum likelihood for noise
that is equal in both and in all directions. It is global: all six roots of the polynomial are tried.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray

_POLISH: Final = 2
"""Newton steps on the roots: a leading coefficient near zero (an epipole far away) costs the eigenvalues digits."""
_LEADING: Final = 1e-10
_NEWTON: Final = 4
_ON_EPIPOLE: Final = 1e-9
"""Distance from the epipole, in units of the image's size, below which a pixel is on it."""
_PARABOLA: Final = 0.03
"""Relative size below which terms that bend the parabola are small enough for its minimum to be the only one."""


def fundamental(
    rotations: FloatArray, translations: FloatArray, focal: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The fundamental matrix of two cameras and their epipoles.

    Args:
        rotations: (2, 3, 3) and
        translations: (2, 3) of the rig.
        focal: (2, 2) and
        centre: (2, 2) pixels, of images without distortion.

    Returns:
        F (3, 3) with ``x2 @ F @ x1 = 0`` for homogeneous pixels, and the epipoles (3,) in the first and second image.
    """
    turn = rotations[1] @ rotations[0].T
    shift = translations[1] - turn @ translations[0]
    inverse, matrix = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
    for index in range(2):
        (fx, fy), (cx, cy) = focal[index], centre[index]
        matrix[index] = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        inverse[index] = [[1.0 / fx, 0.0, -cx / fx], [0.0, 1.0 / fy, -cy / fy], [0.0, 0.0, 1.0]]
    x, y, z = shift
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ turn
    return inverse[1].T @ essential @ inverse[0], matrix[0] @ (turn.T @ -shift), matrix[1] @ shift


def correct(
    matrix: FloatArray, epipoles: tuple[FloatArray, FloatArray], first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Move pairs of pixels least so that they correspond exactly.

    Gaschler (2011): figures 3.3-3.4; eq. 3.6-3.12.

    Args:
        matrix: (3, 3) the fundamental matrix.
        epipoles: (3,) homogeneous, in the first and in the second image.
        first: (n, 2) and
        second: (n, 2) pixels without distortion.

    Returns:
        (n, 2) and (n, 2) corrected pixels.
    """
    # a unit of the size of the image keeps the polynomial's coefficients near each other
    unit = 1.0 + max(np.abs(first).max(initial=0.0), np.abs(second).max(initial=0.0))
    scale = np.array([unit, unit, 1.0])
    matrix, a_epipole, b_epipole = matrix * scale * scale[:, None], epipoles[0] / scale, epipoles[1] / scale
    a_frame, f = _frame(first / unit, a_epipole)
    b_frame, g = _frame(second / unit, b_epipole)
    # eq. 3.8 to 3.10: F in frames with the pixels at the origin and the epipoles on the x axis
    moved = b_frame.transpose(0, 2, 1) @ matrix @ a_frame
    moved /= np.abs(moved).max(axis=(1, 2), keepdims=True)
    a, b, c, d = moved[:, 1, 1], moved[:, 1, 2], moved[:, 2, 1], moved[:, 2, 2]
    t, one = _minimum(a, b, c, d, f, g)
    # eq. 3.11; for an infinite t its direction
    p, q = a * t + b * one, c * t + d * one
    a_line, b_line = np.stack([t * f, one, -t], axis=-1), np.stack([-g * q, p, q], axis=-1)
    return unit * _nearest(a_line, a_frame), unit * _nearest(b_line, b_frame)


def _minimum(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, f: FloatArray, g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the cost C(t) is least: t and 1, or 1 and 0 for an infinite t; (n,) each.

    The cost is at most that of t = 0, the line through the first pixel, which bounds the size of t. Where the pixels
    are near their epipolar lines against the distance to the epipoles, the cost is a parabola within that bound, and
    Newton's method finds its one minimum; all roots are computed for the others.
    """
    coefficients = _polynomial(a, b, c, d, f, g)
    t, one = np.zeros_like(a), np.ones_like(a)
    with np.errstate(all="ignore"):
        start = d * d / (b * b + g * g * d * d)
        bound = np.sqrt(start / (1.0 - f * f * start))
        near = (bound * np.abs(f) < _PARABOLA) & (bound * np.abs(a) < _PARABOLA * np.abs(b))
        near &= np.abs(g) * (np.abs(c) * bound + np.abs(d)) < _PARABOLA * np.abs(b)
        for _ in range(_NEWTON):
            value, slope = _value(coefficients, t)
            step = value / slope
            t = t - step
        near &= (np.abs(step) <= 1e-9 * bound + 1e-15) & (np.abs(t) <= 1.001 * bound + 1e-15)
    others = np.flatnonzero(~near)
    if len(others):
        rest = [each[others] for each in (a, b, c, d, f, g)]
        t[others], one[others] = _global_minimum(coefficients[:, others], *rest)
    return t, one


def _global_minimum(
    coefficients: FloatArray,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    f: FloatArray,
    g: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """As :func:`_minimum`, from all roots of the polynomial and the limit of the cost for an infinite t."""
    roots = _roots(coefficients)
    f2, g2 = (f * f)[:, None], (g * g)[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        p, q = a[:, None] * roots + b[:, None], c[:, None] * roots + d[:, None]
        cost = roots**2 / (1.0 + f2 * roots**2) + q * q / (p * p + g2 * q * q)
        limit = 1.0 / (f * f) + c * c / (a * a + g * g * c * c)
    cost = np.where(np.isfinite(cost), cost, np.inf)
    rows = np.arange(len(a))
    best = cost.argmin(axis=1)
    far = limit < cost[rows, best]
    return np.where(far, 1.0, roots[rows, best]), np.where(far, 0.0, 1.0)


def _frame(pixels: FloatArray, epipole: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) from frames with a pixel at the origin and the epipole at (1, 0, f), and (n,) f (eq. 3.8, 3.9)."""
    moved = epipole[:2] - epipole[2] * pixels
    length = np.hypot(moved[:, 0], moved[:, 1])
    # a pixel on the epipole: any direction does
    at_epipole = length < _ON_EPIPOLE * np.abs(epipole[2])
    length = np.where(at_epipole, _ON_EPIPOLE * max(abs(float(epipole[2])), 1e-300), length)
    cosine, sine = np.where(at_epipole, [[1.0], [0.0]], moved.T / length)
    frame = np.zeros((len(pixels), 3, 3))
    frame[:, 0, 0], frame[:, 0, 1] = cosine, -sine
    frame[:, 1, 0], frame[:, 1, 1] = sine, cosine
    frame[:, :2, 2], frame[:, 2, 2] = pixels, 1.0
    return frame, epipole[2] / length


def _polynomial(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, f: FloatArray, g: FloatArray) -> FloatArray:
    """(7, n) coefficients of eq. 3.12, the highest first."""
    f2, g2 = f * f, g * g
    # (at+b)^2 + g^2 (ct+d)^2 = s2 t^2 + s1 t + s0, and (at+b)(ct+d) = m2 t^2 + m1 t + m0
    s2, s1, s0 = a * a + g2 * c * c, 2.0 * (a * b + g2 * c * d), b * b + g2 * d * d
    m2, m1, m0 = a * c, a * d + b * c, b * d
    k = a * d - b * c
    return np.stack(
        [
            -k * f2 * f2 * m2,
            s2 * s2 - k * f2 * f2 * m1,
            2.0 * s2 * s1 - k * (2.0 * f2 * m2 + f2 * f2 * m0),
            2.0 * s2 * s0 + s1 * s1 - 2.0 * k * f2 * m1,
            2.0 * s1 * s0 - k * (m2 + 2.0 * f2 * m0),
            s0 * s0 - k * m1,
            -k * m0,
        ]
    )


def _value(coefficients: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A polynomial's value and derivative, by Horner's rule."""
    value, slope = coefficients[0] + 0.0 * t, np.zeros_like(t)
    for coefficient in coefficients[1:]:
        slope = slope * t + value
        value = value * t + coefficient
    return value, slope


def _roots(coefficients: FloatArray) -> FloatArray:
    """(n, 6) real parts of the roots of polynomials (7, n)."""
    least = _LEADING * np.abs(coefficients).max(axis=0)
    leading = np.where(np.abs(coefficients[0]) > least, coefficients[0], least + 1e-300)
    companion = np.zeros((coefficients.shape[1], 6, 6))
    companion[:, 0] = np.nan_to_num((-coefficients[1:] / leading).T, posinf=0.0, neginf=0.0)
    companion[:, np.arange(1, 6), np.arange(5)] = 1.0
    roots: FloatArray = np.linalg.eigvals(companion).real.astype(np.float64)
    with np.errstate(all="ignore"):
        for _ in range(_POLISH):
            value, slope = _value(coefficients[:, :, None], roots)
            step = value / slope
            roots = roots - np.where(np.isfinite(step) & (np.abs(step) < 1e-2 * (1.0 + np.abs(roots))), step, 0.0)
    return roots


def _nearest(line: FloatArray, frame: FloatArray) -> FloatArray:
    """(n, 2) pixels of the points of lines (n, 3) that are nearest to the origin of their frames."""
    point = np.concatenate([-line[:, :2] * line[:, 2:], (line[:, :2] ** 2).sum(axis=-1, keepdims=True)], axis=-1)
    pixels = (frame @ point[:, :, None])[:, :, 0]
    result: FloatArray = pixels[:, :2] / pixels[:, 2:]
    return result
