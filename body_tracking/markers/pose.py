"""The poses of targets from points assigned to their balls.

A closed form (Umeyama 1991; Gaschler 2011, section 3.3.3) initialises the maximum likelihood estimate by Gauss-Newton:
the standard deviation of a triangulated point is several times larger along the line of sight than across, which
unweighted least squares ignore.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_so3 import turned
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.targets import Target

FEWEST: Final = 3
"""Least number of points of a pose; they must not be collinear."""

_ITERATIONS: Final = 10
_CONVERGED: Final = 1e-7
"""Largest step at convergence, metres and radians."""


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Poses of b sets of points.

    Attributes:
        rotation: (b, 3, 3) and
        translation: (b, 3) metres: a point x of the target is at ``rotation @ x + translation``.
        covariance: (b, 6, 6) in the order of :class:`~body_tracking.markers.observations.TargetPose`.
        chi_square: (b,) squared Mahalanobis distances of the points from the target, 3m - 6 degrees of freedom.
        residual: (b,) root mean square distance, metres.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    chi_square: FloatArray
    residual: FloatArray


def umeyama(model: FloatArray, measured: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squares rotations and translations of many sets at once (Umeyama 1991, eq. 39-42).

    Args:
        model: (b, m, 3) points of targets, metres.
        measured: (b, m, 3) the same points as measured, metres.
        weights: (b, m) not negative.

    Returns:
        (b, 3, 3) and (b, 3) with ``measured = rotation @ model + translation``.
    """
    rotations, translations = np.empty((len(model), 3, 3)), np.empty((len(model), 3))
    # one type, compiled ahead: a read-only array is of another one
    model, measured, weights = (np.require(each, requirements=["C", "W"]) for each in (model, measured, weights))
    _fitted(model, measured, weights, rotations, translations)
    return rotations, translations


@compiled
def _fitted(
    model: FloatArray, measured: FloatArray, weights: FloatArray, rotations: FloatArray, translations: FloatArray
) -> None:
    """Write the results of :func:`umeyama`."""
    for n in range(len(model)):
        share = weights[n] / weights[n].sum()
        from_, to, cross = np.zeros(3), np.zeros(3), np.zeros((3, 3))
        for i in range(len(share)):
            for a in range(3):
                from_[a] += share[i] * model[n, i, a]
                to[a] += share[i] * measured[n, i, a]
        for i in range(len(share)):
            for a in range(3):
                for b in range(3):
                    cross[a, b] += share[i] * (measured[n, i, a] - to[a]) * (model[n, i, b] - from_[b])
        left, _, right = np.linalg.svd(cross)
        # no reflection: flip the least determined direction
        if np.linalg.det(left) * np.linalg.det(right) < 0.0:
            left[:, 2] *= -1.0
        for a in range(3):
            translations[n, a] = to[a]
            for b in range(3):
                rotations[n, a, b] = left[a, 0] * right[0, b] + left[a, 1] * right[1, b] + left[a, 2] * right[2, b]
                translations[n, a] -= rotations[n, a, b] * from_[b]


def maximum_likelihood(
    model: FloatArray, measured: FloatArray, noise: FloatArray, shape: FloatArray | None = None
) -> Fits:
    """Maximum likelihood poses of targets, for many sets of m points at once; the arguments are not checked.

    Gaschler (2011): eq. 6.1-6.3.

    Args:
        model: (b, m, 3) points of targets, metres, not collinear.
        measured: (b, m, 3) the same points as measured, metres.
        noise: (b, m, 3, 3) covariance of the measured points.
        shape: (b, 3m, 3m) covariance of the targets' points; None for exactly known targets.
    """
    rotation, translation = umeyama(model, measured, 3.0 / np.trace(noise, axis1=2, axis2=3))
    size = 3 * model.shape[1]
    known = np.zeros((len(model), size, size)) if shape is None else shape
    return Fits(*_maximised(model, measured, noise, known, rotation, translation))


@compiled
def _maximised(
    model: FloatArray,
    measured: FloatArray,
    noise: FloatArray,
    shape: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of :class:`Fits`, by Gauss-Newton from nearby rotations and translations."""
    count, balls = model.shape[:2]
    size = 3 * balls
    rotations, translations = rotations.copy(), translations.copy()
    covariances, chi_squares, residuals = np.empty((count, 6, 6)), np.empty(count), np.empty(count)
    # columns 0 to 5: derivatives of the points by the pose; column 6: measured minus predicted points
    system = np.zeros((size, 7))
    covariance = np.empty((size, size))
    for n in range(count):
        for _ in range(_ITERATIONS):
            turn = rotations[n].copy()
            for i in range(balls):
                x, y, z = turn @ model[n, i]
                row = system[3 * i : 3 * i + 3]
                row[0, 0] = row[1, 1] = row[2, 2] = 1.0
                row[0, 4], row[0, 5], row[1, 5] = z, -y, x
                row[1, 3], row[2, 3], row[2, 4] = -z, y, -x
                row[0, 6] = measured[n, i, 0] - x - translations[n, 0]
                row[1, 6] = measured[n, i, 1] - y - translations[n, 1]
                row[2, 6] = measured[n, i, 2] - z - translations[n, 2]
                # covariance of the target's points, rotated, plus that of the measured point
                for j in range(balls):
                    for a in range(3):
                        for b in range(3):
                            total = noise[n, i, a, b] if i == j else 0.0
                            for c in range(3):
                                for d in range(3):
                                    total += turn[a, c] * shape[n, 3 * i + c, 3 * j + d] * turn[b, d]
                            covariance[3 * i + a, 3 * j + b] = total
            normal = system.T.copy() @ np.linalg.solve(covariance, system)
            covariances[n] = np.linalg.inv(normal[:6, :6].copy())
            step = covariances[n] @ normal[:6, 6].copy()
            chi_squares[n] = normal[6, 6]
            residuals[n] = math.sqrt((system[:, 6] ** 2).sum() / balls)
            translations[n] += step[:3]
            rotations[n] = turned(step[3:], rotations[n])
            if np.abs(step).max() < _CONVERGED:
                break
    return rotations, translations, covariances, chi_squares, residuals


def balls_covariance(target: Target, balls: IntArray) -> FloatArray:
    """(3m, 3m) covariance of these balls of a target."""
    rows = (3 * balls[:, None] + np.arange(3)).ravel()
    part: FloatArray = target.covariance[np.ix_(rows, rows)]
    return part
