"""Compiled routines for small matrices (Cholesky factors), and the limits of a linearisation."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray

LINEARISATIONS = 4
"""Greatest number of linearisations in one update."""
FAR, CLOSE = 0.2, 0.05
"""Radians: an update with a correction of ``FAR`` or more is linearised anew, until the correction changes by less than
``CLOSE``."""


@compiled
def factored(matrix: FloatArray) -> bool:
    """Write the Cholesky factor U of a matrix U^T U into its upper triangle; False if it is not positive definite."""
    size = len(matrix)
    for k in range(size):
        pivot = matrix[k, k]
        if not 0.0 < pivot < math.inf:
            return False
        pivot = 1.0 / math.sqrt(pivot)
        for j in range(k, size):
            matrix[k, j] *= pivot
        for i in range(k + 1, size):
            factor = matrix[k, i]
            for j in range(i, size):
                matrix[i, j] -= factor * matrix[k, j]
    return True


@compiled
def forward_substituted(factor: FloatArray, right: FloatArray) -> None:
    """Solve U^T X = B in place, with U of :func:`factored` and (k, n) B."""
    size, columns = right.shape
    for k in range(size):
        pivot = 1.0 / factor[k, k]
        for j in range(columns):
            right[k, j] *= pivot
        for i in range(k + 1, size):
            times = factor[k, i]
            for j in range(columns):
                right[i, j] -= times * right[k, j]


@compiled
def invert(factor: FloatArray, inverse: FloatArray) -> None:
    """Write (k, k) U^-T into ``inverse``, with U of :func:`factored`: with it, U^-T B is a product."""
    size = len(factor)
    inverse[:] = 0.0
    for k in range(size):
        inverse[k, k] = 1.0
    for k in range(size):
        pivot = 1.0 / factor[k, k]
        for j in range(k + 1):
            inverse[k, j] *= pivot
        for i in range(k + 1, size):
            times = factor[k, i]
            for j in range(k + 1):
                inverse[i, j] -= times * inverse[k, j]


@compiled
def squared_distance(block: FloatArray, vector: FloatArray, added: float) -> float:
    """Squared Mahalanobis distance of ``vector`` (3,) with the covariance ``block`` (3, 3) plus ``added`` times I."""
    x, y, z = vector
    # C = L D L^T, and L w = v
    xx = block[0, 0] + added
    l10, l20 = block[1, 0] / xx, block[2, 0] / xx
    d1 = block[1, 1] + added - l10 * block[1, 0]
    rest = block[2, 1] - l20 * block[1, 0]
    l21 = rest / d1
    d2 = block[2, 2] + added - l20 * block[2, 0] - l21 * rest
    y -= l10 * x
    z -= l20 * x + l21 * y
    distance: float = x * x / xx + y * y / d1 + z * z / d2
    return distance


def whitening_of(covariance: FloatArray) -> FloatArray:
    """(k, k) inverse of the lower Cholesky factor; overwrites the covariance.

    Raises:
        LinAlgError: the matrix is not positive definite, or not finite.
    """
    if not factored(covariance):
        raise np.linalg.LinAlgError("not positive definite")
    inverse = np.empty_like(covariance)
    invert(covariance, inverse)
    return inverse
