"""Small linear algebra within compiled loops, where the overhead of a LAPACK call exceeds its arithmetic."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray


@compiled
def whitening_of(covariance: FloatArray, whitening: FloatArray) -> bool:
    """Write the inverse of Cholesky's factor of a matrix (n, n); False where it is not positive definite.

    For the result W, ``W.T @ W`` is the inverse of the matrix. The zeros above its diagonal are written, too.
    """
    size = len(covariance)
    lower = np.empty((size, size))
    for i in range(size):
        for j in range(i + 1):
            value = covariance[i, j]
            for k in range(j):
                value -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = value / lower[j, j]
            elif value > 0.0:
                lower[i, i] = math.sqrt(value)
            else:
                return False
    for j in range(size):
        for i in range(j):
            whitening[i, j] = 0.0
        whitening[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, size):
            value = 0.0
            for k in range(j, i):
                value -= lower[i, k] * whitening[k, j]
            whitening[i, j] = value / lower[i, i]
    return True


@compiled
def inverse_of(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Write the inverse of a symmetric matrix (n, n); False where it is not positive definite."""
    size = len(matrix)
    whitening = np.empty((size, size))
    if not whitening_of(matrix, whitening):
        return False
    for i in range(size):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, size):
                value += whitening[k, i] * whitening[k, j]
            inverse[i, j] = inverse[j, i] = value
    return True
