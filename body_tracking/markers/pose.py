"""The pose of a target from points that are known to be its balls.

A closed-form start (Umeyama 1991; Gaschler 2011, section 3.3.3), then the maximum of the likelihood by Gauss-Newton:
a triangulated point is several times less sure along the line of sight than across, which least squares ignores.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import gammainccinv

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.targets import Target

FEWEST: Final = 3
"""Points that a pose needs, not on one line."""

_FLAT: Final = 1e-4
"""Ratio of the widths of a set of points below which they lie on one line, whatever their noise."""
_MAX_ANGLE_STDDEV: Final = 0.5
"""Radians; a rotation that is less sure is not determined, and its covariance, a linearisation, not true."""
_ITERATIONS: Final = 10
_CONVERGED: Final = 1e-7
"""Metres and radians."""


class PoseError(BodyTrackingError):
    """The points do not determine the pose of the target."""


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Poses of b sets of points.

    Attributes:
        rotation: (b, 3, 3) and
        translation: (b, 3) metres: a point x of the target is at ``rotation @ x + translation``.
        covariance: (b, 6, 6) in the order of :class:`~body_tracking.markers.observations.TargetPose`.
        chi_square: (b,) squared Mahalanobis distances of the points from the target, 3m - 6 degrees of freedom.
        residual: (b,) root of the mean squared distance, metres.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    chi_square: FloatArray
    residual: FloatArray


@lru_cache(maxsize=256)
def chi_square_gate(degrees: int, missed: float) -> float:
    """The value that a chi-square variable of so many degrees of freedom exceeds with this probability."""
    return 2.0 * float(gammainccinv(0.5 * degrees, missed))


def umeyama(model: FloatArray, measured: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations and translations of least squares, for many sets at once (Umeyama 1991, eq. 39-42).

    Args:
        model: (b, m, 3) points of targets, metres.
        measured: (b, m, 3) the same points as measured, metres.
        weights: (b, m) not negative.

    Returns:
        (b, 3, 3) and (b, 3), so that ``measured = rotation @ model + translation``.
    """
    share = (weights / weights.sum(axis=1, keepdims=True))[:, None, :]
    from_, to = share @ model, share @ measured
    cross = (measured - to).swapaxes(1, 2) @ ((model - from_) * share.swapaxes(1, 2))
    rotation = so3.nearest_rotation(cross)
    return rotation, to[:, 0] - (rotation @ from_.swapaxes(1, 2))[:, :, 0]


def maximum_likelihood(
    model: FloatArray, measured: FloatArray, noise: FloatArray, shape: FloatArray | None = None
) -> Fits:
    """The most likely poses of targets, for many sets of m points at once; the arguments are not checked.

    Gaschler (2011): eq. 6.1-6.3.

    Args:
        model: (b, m, 3) points of targets, metres, not on one line.
        measured: (b, m, 3) the same points as measured, metres.
        noise: (b, m, 3, 3) covariance of the measured points.
        shape: (b, 3m, 3m) covariance of the targets' points; None for targets that are known.
    """
    count, balls = model.shape[:2]
    weights = np.linalg.inv(noise)
    rotation: FloatArray
    translation: FloatArray
    rotation, translation = umeyama(model, measured, 3.0 / np.trace(noise, axis1=2, axis2=3))
    jacobian = np.zeros((count, balls, 3, 6))
    jacobian[..., :3] = np.eye(3)
    flat = jacobian.reshape(count, 3 * balls, 6)
    dense = np.zeros((count, balls, 3, balls, 3))
    if shape is not None:
        each = np.arange(balls)
        dense[:, each, :, each, :] = noise.swapaxes(0, 1)
    for _ in range(_ITERATIONS):
        turned = model @ rotation.swapaxes(1, 2)
        missing = measured - turned - translation[:, None]
        jacobian[..., 3:] = -so3.skew(turned)
        if shape is None:
            weighted = (weights @ jacobian).reshape(count, 3 * balls, 6)
            weighted_missing = (weights @ missing[..., None]).reshape(count, 3 * balls, 1)
        else:
            information = np.linalg.inv(dense.reshape(count, 3 * balls, 3 * balls) + _turned(shape, rotation))
            weighted = information @ flat
            weighted_missing = information @ missing.reshape(count, 3 * balls, 1)
        covariance = np.asarray(np.linalg.inv(flat.swapaxes(1, 2) @ weighted), dtype=np.float64)
        step = np.asarray(covariance @ (weighted.swapaxes(1, 2) @ missing.reshape(count, 3 * balls, 1)))[..., 0]
        translation += step[:, :3]
        rotation = so3.quat_to_matrix(so3.exp(step[:, 3:])) @ rotation
        if (np.abs(step) < _CONVERGED).all():
            break
    chi_square: FloatArray = (missing.reshape(count, 1, 3 * balls) @ weighted_missing)[:, 0, 0]
    residual = np.asarray(np.sqrt((missing**2).sum(axis=(1, 2)) / balls), dtype=np.float64)
    return Fits(rotation, translation, covariance, chi_square, residual)


def fit_pose(target: Target, points: Points, assignment: IntArray) -> TargetPose:
    """The most likely pose of a target whose balls are known among the points.

    The weights are the points' covariances plus that of the target's own points.

    Args:
        target: with k balls.
        points: one frame.
        assignment: (k,) index of each ball among the points, -1 for one that is not seen.

    Raises:
        PoseError: fewer than 3 balls, a ball or a point that there is not or that is given twice, numbers that are not
            finite, a covariance that is not positive definite, or balls so near one line that the rotation about it
            is not determined.
    """
    assignment = np.asarray(assignment)
    where = f"target {target.name} at {points.stamp_ns} ns"
    if assignment.shape != (len(target.points),) or not np.issubdtype(assignment.dtype, np.integer):
        raise PoseError(f"{where}: assignment {assignment.shape} of {len(target.points)} balls")
    seen = np.flatnonzero(assignment >= 0)
    chosen = assignment[seen]
    if len(seen) < FEWEST:
        raise PoseError(f"{where}: {len(seen)} balls, at least {FEWEST} are needed")
    if assignment.min() < -1 or chosen.max() >= len(points.positions) or len(set(chosen.tolist())) < len(chosen):
        raise PoseError(f"{where}: points {assignment.tolist()} of {len(points.positions)}, each once at most")
    model, measured, noise = target.points[seen], points.positions[chosen], points.covariance[chosen]
    if not (np.isfinite(model).all() and np.isfinite(measured).all() and np.isfinite(noise).all()):
        raise PoseError(f"{where}: a point or a covariance is not finite")
    if np.linalg.eigvalsh(noise)[:, 0].min() <= 0.0:
        raise PoseError(f"{where}: a point's covariance is not positive definite")
    if _on_one_line(model) or _on_one_line(measured):
        raise PoseError(f"{where}: the balls lie on one line, the rotation about it is free")
    fits = maximum_likelihood(model[None], measured[None], noise[None], shape_covariance(target, seen))
    if not np.isfinite(fits.covariance).all() or fits.covariance[0, 3:, 3:].trace() > _MAX_ANGLE_STDDEV**2:
        raise PoseError(f"{where}: the balls lie on one line within their noise, the rotation about it is free")
    return TargetPose(
        target.name,
        points.stamp_ns,
        points.frame_id,
        fits.rotation[0],
        fits.translation[0],
        fits.covariance[0],
        assignment.astype(np.int64),
        float(fits.residual[0]),
    )


def shape_covariance(target: Target, balls: IntArray) -> FloatArray | None:
    """(1, 3m, 3m) of these balls of a target; None where the target is known exactly."""
    return balls_covariance(target, balls)[None] if target.covariance.any() else None


def balls_covariance(target: Target, balls: IntArray) -> FloatArray:
    """(3m, 3m) of these balls of a target."""
    rows = (3 * balls[:, None] + np.arange(3)).ravel()
    part: FloatArray = target.covariance[np.ix_(rows, rows)]
    return part


def _turned(shape: FloatArray, rotation: FloatArray) -> FloatArray:
    """``rotation @ block @ rotation.T`` for every (3, 3) block of (b, 3m, 3m)."""
    count, size = shape.shape[:2]
    columns = (shape.reshape(count, size * size // 3, 3) @ rotation.swapaxes(1, 2)).reshape(count, size, size)
    rows = columns.swapaxes(1, 2).reshape(count, size * size // 3, 3) @ rotation.swapaxes(1, 2)
    result: FloatArray = rows.reshape(count, size, size).swapaxes(1, 2)
    return result


def _on_one_line(points: FloatArray) -> bool:
    widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(widths[1] <= _FLAT * widths[0])
