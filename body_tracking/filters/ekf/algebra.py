"""Small matrices, and how far a linearisation reaches."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from body_tracking.core.skeleton import FloatArray

LINEARISATIONS = 4
FAR, CLOSE = 0.2, 0.05
"""Radians: a correction farther than the first is linearised anew, until it changes by less than the second."""


def cholesky(matrix: FloatArray) -> FloatArray:
    """The lower factor; numpy's takes three times as long on one so small.

    Raises:
        LinAlgError: the matrix is not positive definite, or not finite.
    """
    factor: FloatArray
    # the transpose of a symmetric matrix need not be brought into Fortran's order
    factor, failed = dpotrf(matrix.T, lower=1)
    if failed or not math.isfinite(float(factor.trace())):
        raise np.linalg.LinAlgError("not positive definite")
    return factor


def whitening_of(covariance: FloatArray) -> FloatArray:
    """(k, k) inverse of the lower factor. Products with it take a fraction of what solving takes for each.

    Raises:
        LinAlgError: as of :func:`cholesky`.
    """
    inverse: FloatArray
    inverse, _ = dtrtri(cholesky(covariance), lower=1, overwrite_c=1)  # above the diagonal it stays 0
    return inverse
