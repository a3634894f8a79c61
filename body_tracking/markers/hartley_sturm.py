"""Optimal correction of a pair of corresponding pixels (Hartley and Sturm 1997; Gaschler 3.2.3).

The corrected pair is the nearest one in the two images that satisfies the epipolar constraint: the maximum likelihood
for equal isotropic noise. The solution is global: all six roots of the polynomial are tried.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray

_POLISH: Final = 2
"""Newton steps on the roots: a leading coefficient near zero (a distant epipole) makes the eigenvalues inaccurate."""
_LEADING: Final = 1e-10
_NEWTON: Final = 4
_ON_EPIPOLE: Final = 1e-9
"""Distance from the epipole, in units of the image's size, below which a pixel counts as on it."""
_PARABOLA: Final = 0.03
"""Relative size of the terms beyond the parabola, below which its minimum is the only one."""


def fundamental(
    rotations: FloatArray, translations: FloatArray, focal: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The fundamental matrix of two cameras and their epipoles.

    Args:
        rotations: (2, 3, 3) and
        translations: (2, 3) of the cameras in the rig.
        focal: (2, 2) focal lengths and
        centre: (2, 2) principal points, pixels, of undistorted images.

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
    """Move pairs of pixels by the least distance so that they satisfy the epipolar constraint.

    Gaschler (2011): figures 3.3-3.4; eq. 3.6-3.12.

    Args:
        matrix: (3, 3) the fundamental matrix.
        epipoles: (3,) homogeneous, in the first and in the second image.
        first: (n, 2) and
        second: (n, 2) pixels without distortion.

    Returns:
        (n, 2) and (n, 2) corrected pixels.
    """
    # scaled by the size of the image, the polynomial's coefficients have similar magnitudes
    unit = 1.0 + max(np.abs(first).max(initial=0.0), np.abs(second).max(initial=0.0))
    scale = np.array([unit, unit, 1.0])
    matrix, a_epipole, b_epipole = matrix * scale * scale[:, None], epipoles[0] / scale, epipoles[1] / scale
    one, other = _corrected(np.ascontiguousarray(matrix), a_epipole, b_epipole, first / unit, second / unit)
    return unit * one, unit * other


@compiled
def _corrected(
    matrix: FloatArray, a_epipole: FloatArray, b_epipole: FloatArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """:func:`correct` for pixels in units of the image's size."""
    one, other = np.empty_like(first), np.empty_like(second)
    for n in range(len(first)):
        (x1, y1), (x2, y2) = first[n], second[n]
        cos1, sin1, f = _frame(x1, y1, a_epipole)
        cos2, sin2, g = _frame(x2, y2, b_epipole)
        # eq. 3.8 to 3.10: F in frames with the pixels at the origin and the epipoles on the x axis
        u, v = np.empty(3), np.empty(3)
        for i in range(3):
            u[i] = cos1 * matrix[i, 1] - sin1 * matrix[i, 0]
            v[i] = x1 * matrix[i, 0] + y1 * matrix[i, 1] + matrix[i, 2]
        a, b = cos2 * u[1] - sin2 * u[0], cos2 * v[1] - sin2 * v[0]
        c, d = x2 * u[0] + y2 * u[1] + u[2], x2 * v[0] + y2 * v[1] + v[2]
        size = max(abs(a), abs(b), abs(c), abs(d))
        a, b, c, d = a / size, b / size, c / size, d / size
        t, finite = _minimum(a, b, c, d, f, g)
        # eq. 3.11; an infinite t has only a direction
        p, q = a * t + b * finite, c * t + d * finite
        one[n, 0], one[n, 1] = _nearest(t * f, finite, -t, cos1, sin1, x1, y1)
        other[n, 0], other[n, 1] = _nearest(-g * q, p, q, cos2, sin2, x2, y2)
    return one, other


@compiled
def _frame(x: float, y: float, epipole: FloatArray) -> tuple[float, float, float]:
    """Cosine and sine of the frame with a pixel at the origin and the epipole at (1, 0, f), and f (eq. 3.8, 3.9)."""
    across, along = epipole[0] - epipole[2] * x, epipole[1] - epipole[2] * y
    length = math.hypot(across, along)
    least = _ON_EPIPOLE * abs(epipole[2])
    if length < least:  # pixel on the epipole: the direction is arbitrary
        return 1.0, 0.0, epipole[2] / least
    length = max(length, 1e-300)
    return across / length, along / length, epipole[2] / length


@compiled
def _minimum(a: float, b: float, c: float, d: float, f: float, g: float) -> tuple[float, float]:
    """Minimum of the cost C(t): (t, 1), or (1, 0) for an infinite t.

    The cost is at most that of t = 0, the line through the first pixel, which bounds |t|. Where the pixels are near
    their epipolar lines compared with the distance to the epipoles, the cost is nearly a parabola within that bound,
    and Newton's method finds its one minimum; otherwise all roots are computed.
    """
    coefficients = _polynomial(a, b, c, d, f, g)
    start = d * d / (b * b + g * g * d * d)
    bound = math.sqrt(start / (1.0 - f * f * start)) if f * f * start < 1.0 else math.inf
    near = bound * abs(f) < _PARABOLA and bound * abs(a) < _PARABOLA * abs(b)
    if near and abs(g) * (abs(c) * bound + abs(d)) < _PARABOLA * abs(b):
        t, step = 0.0, 0.0
        for _ in range(_NEWTON):
            value, slope = _value(coefficients, t)
            step = value / slope
            t -= step
        if abs(step) <= 1e-9 * bound + 1e-15 and abs(t) <= 1.001 * bound + 1e-15:
            return t, 1.0
    best, least = 0.0, math.inf
    for t in _roots(coefficients):
        p, q = a * t + b, c * t + d
        cost = t * t / (1.0 + f * f * t * t) + q * q / (p * p + g * g * q * q)
        if cost < least:
            best, least = t, cost
    if 1.0 / (f * f) + c * c / (a * a + g * g * c * c) < least:
        return 1.0, 0.0
    return best, 1.0


@compiled
def _polynomial(a: float, b: float, c: float, d: float, f: float, g: float) -> FloatArray:
    """(7,) coefficients of eq. 3.12, the highest first."""
    f2, g2 = f * f, g * g
    # (at+b)^2 + g^2 (ct+d)^2 = s2 t^2 + s1 t + s0, and (at+b)(ct+d) = m2 t^2 + m1 t + m0
    s2, s1, s0 = a * a + g2 * c * c, 2.0 * (a * b + g2 * c * d), b * b + g2 * d * d
    m2, m1, m0 = a * c, a * d + b * c, b * d
    k = a * d - b * c
    return np.array(
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


@compiled
def _value(coefficients: FloatArray, t: float) -> tuple[float, float]:
    """A polynomial's value and derivative, by Horner's rule."""
    value, slope = coefficients[0], 0.0
    for index in range(1, len(coefficients)):
        slope = slope * t + value
        value = value * t + coefficients[index]
    return value, slope


@compiled
def _roots(coefficients: FloatArray) -> FloatArray:
    """(6,) real parts of the roots of a polynomial (7,)."""
    least = _LEADING * np.abs(coefficients).max()
    leading = coefficients[0] if abs(coefficients[0]) > least else least + 1e-300
    companion = np.zeros((6, 6), dtype=np.complex128)
    for index in range(6):
        companion[0, index] = -coefficients[index + 1] / leading
    for index in range(5):
        companion[index + 1, index] = 1.0
    if not np.isfinite(companion).all():  # pixels that are not finite
        return np.zeros(6)
    roots: FloatArray = np.linalg.eigvals(companion).real.astype(np.float64)
    for index in range(6):
        for _ in range(_POLISH):
            value, slope = _value(coefficients, roots[index])
            step = value / slope
            if abs(step) < 1e-2 * (1.0 + abs(roots[index])):
                roots[index] -= step
    return roots


@compiled
def _nearest(l0: float, l1: float, l2: float, cosine: float, sine: float, x: float, y: float) -> tuple[float, float]:
    """Point of a line nearest to the origin of a pixel's frame, as a pixel."""
    scale = l0 * l0 + l1 * l1
    across, along = -l0 * l2 / scale, -l1 * l2 / scale
    return cosine * across - sine * along + x, sine * across + cosine * along + y
