"""The rigid motion between two sets of corresponding points."""

from __future__ import annotations

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray


class CalibrationError(BodyTrackingError):
    """The data do not determine a calibration."""


def rigid_registration(
    target: FloatArray, source: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Weighted least-squares rotation and translation with ``target = R source + t``.

    The singular value decomposition of Schlagenhauf 2017 (eq. 5.1-5.7) with two corrections: the rotation of eq. 5.1
    (eq. 5.4-5.6 give its inverse), and the sign of the determinant, without which an almost flat T-pose may give a
    reflection (Umeyama 1991, eq. 39-43). The result equals Gaschler 2011, eq. 3.15-3.20.

    Args:
        target: (n, 3) metres.
        source: (n, 3) metres.
        weights: (n,) not negative; equal when None.

    Returns:
        R (3, 3) with determinant +1, t (3,) metres.

    Raises:
        CalibrationError: fewer than three points with weight, or all of them on one line.
    """
    if weights is None:
        weights = np.ones(len(target))
    total = float(weights.sum())
    if np.count_nonzero(weights) < 3 or not np.isfinite(total):
        raise CalibrationError(f"{np.count_nonzero(weights)} corresponding points, at least 3 are needed")
    share = weights / total
    centroid_target = share @ target  # eq. 5.2
    centroid_source = share @ source  # eq. 5.3
    cross = ((target - centroid_target) * share[:, None]).T @ (source - centroid_source)  # eq. 5.4, transposed
    u, spread, vt = np.linalg.svd(cross)  # eq. 5.5
    if spread[1] < 1e-9 * max(spread[0], 1e-12) or spread[0] < 1e-12:
        raise CalibrationError("the corresponding points lie on one line: the rotation about it is free")
    handedness = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation: FloatArray = (u * handedness) @ vt  # eq. 5.6, with Umeyama's sign
    return rotation, centroid_target - rotation @ centroid_source  # eq. 5.7
