"""Geometry of a target from many views (Gaschler 2011, section 4.2).

The origin of a target's frame is the centroid of its balls; x points from ball 0 to ball 1, and y from that line
towards the first further ball that is not near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import chi_square, so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.observations import Points
from body_tracking.markers.pose import FEWEST, umeyama
from body_tracking.markers.recognition import Recogniser
from body_tracking.markers.targets import Target

_MISSED: Final = 1e-4
"""Share of correct views rejected as outliers."""
_ITERATIONS: Final = 30
_CONVERGED: Final = 1e-8
"""Largest step at convergence, metres and radians."""
_RIGID: Final = 0.1
"""Noise of a coordinate as a share of the target's size, above which the views contradict each other."""
_BENT: Final = 3.0
"""Factor on the standard deviation of a flexible target's view, up to which it is no outlier; skin moves in each
step."""
_PROCRUSTES: Final = 10
"""Iterations of the initial Procrustes analysis."""
_ON_LINE: Final = 0.1
"""A ball is near a line if its distance from it is less than this share of the target's size."""


class TargetCalibrationError(BodyTrackingError):
    """Raised for views that do not determine the target."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetCalibration:
    """A calibrated target.

    Attributes:
        target: with the covariance of its points; the frame's six degrees of freedom have none.
        used: (f,) which views were used; the others have too few balls or are outliers.
        noise: standard deviation of a coordinate from the residuals, metres.
        reduced_chi_square: of the residuals by the given covariances, about 1 if these are correct; 1 without given
            covariances.
    """

    target: Target
    used: BoolArray
    noise: float
    reduced_chi_square: float


def calibrate_target(
    name: str,
    views: FloatArray,
    covariance: FloatArray | None = None,
    diameter: float = 0.0,
    flexible: bool = False,
) -> TargetCalibration:
    """Maximum likelihood points of a target, over its points and its poses in all views.

    Gaschler (2011): eq. 4.13, 4.18-4.19.

    A generalised Procrustes analysis initialises Gauss-Newton; each step eliminates the poses (Schur complement), so
    that time grows linearly with the number of views. Views that do not fit are rejected.

    Args:
        name: of the target.
        views: (f, k, 3) metres, balls in the same order in all views, NaN for an unseen ball.
        covariance: (f, k, 3, 3) of the views; None for equal noise of all coordinates, which is then estimated.
        diameter: of the balls, metres.
        flexible: add each ball's motion within the target to the target's covariance: the variance of its residuals
            beyond the noise; without covariances, beyond that of the stiffest ball.

    Raises:
        TargetCalibrationError: wrong shapes, fewer than 3 balls or than 2 views with 3 of them, rarely seen balls,
            collinear balls, or views most of which contradict each other.
    """
    views, seen, weights = _checked(name, views, covariance)
    count, balls = seen.shape
    enough = seen.sum(axis=1) >= FEWEST
    shape = _start(name, views, seen, enough)
    degrees = 3 * seen.sum(axis=1) - 6
    gates = np.array([chi_square.gate(int(degree), _MISSED) if degree > 0 else 0.0 for degree in degrees])
    costs, used = np.full(count, np.inf), np.zeros(count, dtype=bool)
    for _ in range(_ITERATIONS):
        costs[enough] = _costs(shape, views[enough], seen[enough], weights[enough])
        # scaled by the median cost, so that a slightly flexible target or underestimated noise makes no outliers
        medians = np.array([chi_square.gate(int(degree), 0.5) for degree in degrees[enough]])
        unit = float(np.median(costs[enough] / medians))
        unit = unit if covariance is None else max(unit, 1.0)
        fits = enough & (costs <= (_BENT**2 if flexible else 1.0) * unit * gates)
        if np.array_equal(fits, used):
            break
        used = fits
        if 2 * used.sum() < enough.sum() or (seen[used].sum(axis=0) < 2).any():
            raise TargetCalibrationError(
                f"target {name}: {int(used.sum())} of {int(enough.sum())} views agree; are the balls in the same order?"
            )
        fit = _maximise(name, shape, views[used], seen[used], weights[used])
        shape = fit.shape
    total = float(costs[used].sum())
    freedom = int((3 * seen[used].sum(axis=1) - 6).sum()) - (3 * balls - 6)
    if freedom <= 0:
        raise TargetCalibrationError(f"target {name}: {int(used.sum())} views are too few")
    reduced = total / freedom
    residuals = _residuals(shape, views[used], seen[used], weights[used])
    noise = float(np.sqrt((residuals**2).sum() / freedom))
    size = float(np.linalg.norm(shape[:, None] - shape, axis=2).max())
    if noise > _RIGID * size:
        raise TargetCalibrationError(
            f"target {name}: no views agree, balls are off by {1e3 * noise:.1f} mm in a target of {1e3 * size:.0f} mm; "
            "are they in the same order?"
        )
    covariance_of_shape = fit.covariance * (reduced if covariance is None else 1.0)
    if flexible:
        flex = _flexibility(residuals, seen[used], None if covariance is None else covariance[used])
        covariance_of_shape = covariance_of_shape + np.diag(np.repeat(flex, 3))
    axes = _axes(name, shape)
    turn = np.kron(np.eye(balls), axes)
    target = Target(name, shape @ axes.T, turn @ covariance_of_shape @ turn.T, diameter)
    return TargetCalibration(target, used, noise, 1.0 if covariance is None else reduced)


def ordered_views(frames: Sequence[Points], balls: IntArray, first: int = 0) -> tuple[FloatArray, FloatArray]:
    """Views of one target from unlabelled points: the balls chosen in one frame are recognised in all others.

    Gaschler 2011, section 4.2.1: frames without the target are left out.

    Args:
        frames: with the target and arbitrary other points.
        balls: (k,) index of the target's balls among the points of that frame.
        first: index of that frame.

    Returns:
        views (f, k, 3) and covariances (f, k, 3, 3) for :func:`calibrate_target`; NaN and zero for unseen balls.

    Raises:
        TargetCalibrationError: fewer than 3 balls, or an index out of range.
    """
    start, chosen = frames[first], np.asarray(balls)
    if len(set(chosen.tolist())) < FEWEST or chosen.min() < 0 or chosen.max() >= len(start.positions):
        raise TargetCalibrationError(f"balls {chosen.tolist()} among the {len(start.positions)} points of the frame")
    size = len(chosen)
    covariance = np.zeros((size, 3, size, 3))
    covariance[np.arange(size), :, np.arange(size)] = start.covariance[chosen]
    points = start.positions[chosen]
    draft = Target("draft", points - points.mean(axis=0), covariance.reshape(3 * size, 3 * size))
    recogniser = Recogniser([draft])
    views, noise = np.full((len(frames), size, 3), np.nan), np.zeros((len(frames), size, 3, 3))
    for index, frame in enumerate(frames):
        if index == first:
            assignment = chosen
        else:
            poses = recogniser.recognise(frame).poses
            if not poses:
                continue
            assignment = poses[0].points
        seen = assignment >= 0
        views[index, seen] = frame.positions[assignment[seen]]
        noise[index, seen] = frame.covariance[assignment[seen]]
    return views, noise


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    shape: FloatArray
    covariance: FloatArray


def _checked(name: str, views: FloatArray, covariance: FloatArray | None) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Views with zeros for unseen balls, seen (f, k), and weights (f, k, 3, 3), zeros for unseen balls."""
    views = np.array(views, dtype=np.float64)
    if views.ndim != 3 or views.shape[1] < FEWEST or views.shape[2] != 3 or np.isinf(views).any():
        raise TargetCalibrationError(
            f"target {name}: views {views.shape}, expected (f, k, 3), k 3 or more, not infinite"
        )
    seen: BoolArray = np.asarray(np.isfinite(views).all(axis=2))
    usable = seen.sum(axis=1) >= FEWEST
    if usable.sum() < 2:
        raise TargetCalibrationError(f"target {name}: {int(usable.sum())} views with 3 balls or more, 2 are needed")
    rare = np.flatnonzero(seen[usable].sum(axis=0) < 2)
    if len(rare):
        raise TargetCalibrationError(f"target {name}: ball {rare[0]} is seen in fewer than 2 views")
    weights = np.zeros((*seen.shape, 3, 3))
    if covariance is None:
        weights[seen] = np.eye(3)
    else:
        if covariance.shape != weights.shape:
            raise TargetCalibrationError(f"target {name}: covariances {covariance.shape}, expected {weights.shape}")
        noise = covariance[seen]
        if not np.isfinite(noise).all() or np.linalg.eigvalsh(noise)[:, 0].min() <= 0.0:
            raise TargetCalibrationError(f"target {name}: a covariance is not positive definite")
        weights[seen] = np.linalg.inv(noise)
    views[~seen] = 0.0
    return views, seen, weights


def _start(name: str, views: FloatArray, seen: BoolArray, enough: BoolArray) -> FloatArray:
    """Points by generalised Procrustes analysis, from the view nearest to the median distances."""
    balls = seen.shape[1]
    distances = np.linalg.norm(views[:, :, None] - views[:, None], axis=3)
    distances[~(seen[:, :, None] & seen[:, None])] = np.nan
    rows = np.flatnonzero(enough)
    with np.errstate(all="ignore"):
        middle = np.nanmedian(distances[rows], axis=0)
        off = np.nanmean(np.abs(distances[rows] - middle), axis=(1, 2))
    # the view with most balls, then the most typical one
    first = rows[np.lexsort((off, -seen[rows].sum(axis=1)))[0]]
    shape, known = np.where(seen[first][:, None], views[first], 0.0), seen[first].copy()
    for _ in range(_PROCRUSTES):
        common = seen & known
        aligned = np.full(views.shape, np.nan)
        for index in rows[(common[rows].sum(axis=1) >= FEWEST)]:
            both = common[index]
            rotation, translation = umeyama(views[index, both][None], shape[both][None], np.ones((1, both.sum())))
            aligned[index, seen[index]] = views[index, seen[index]] @ rotation[0].T + translation[0]
        found = np.isfinite(aligned[..., 0]).any(axis=0)
        shape[found] = np.nanmedian(aligned[:, found], axis=0)
        known |= found
    if not known.all():
        raise TargetCalibrationError(
            f"target {name}: ball {int(np.flatnonzero(~known)[0])} of {balls} is never seen with three of the others"
        )
    centred: FloatArray = shape - shape.mean(axis=0)
    widths = np.linalg.svd(centred, compute_uv=False)
    if not widths[1] > 1e-3 * widths[0]:
        raise TargetCalibrationError(f"target {name}: the balls lie on one line")
    return centred


def _poses(shape: FloatArray, views: FloatArray, seen: BoolArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Maximum likelihood poses of all views."""
    count = len(views)
    scalar = np.trace(weights, axis1=2, axis2=3)
    translation: FloatArray
    rotation, translation = umeyama(np.broadcast_to(shape, views.shape), views, scalar)
    jacobian = np.zeros((*seen.shape, 3, 6))
    jacobian[..., :3] = np.eye(3)
    for _ in range(_ITERATIONS):
        turned: FloatArray = shape @ rotation.swapaxes(1, 2)
        jacobian[..., 3:] = -so3.skew(turned)
        missing = (views - turned - translation[:, None])[..., None]
        weighted = (weights @ jacobian).reshape(count, -1, 6).swapaxes(1, 2)
        information = weighted @ jacobian.reshape(count, -1, 6)
        step = np.asarray(np.linalg.solve(information, weighted @ missing.reshape(count, -1, 1)))[..., 0]
        translation += step[:, :3]
        rotation = so3.quat_to_matrix(so3.exp(step[:, 3:])) @ rotation
        if np.abs(step).max() < _CONVERGED:
            break
    return rotation, translation


def _maximise(name: str, shape: FloatArray, views: FloatArray, seen: BoolArray, weights: FloatArray) -> _Fit:
    """Maximum likelihood points and their covariance, without the six degrees of freedom of the frame."""
    count, balls = seen.shape
    for _ in range(_ITERATIONS):
        rotation, translation = _poses(shape, views, seen, weights)
        turned = shape @ rotation.swapaxes(1, 2)
        missing = views - turned - translation[:, None]
        # all in the target's frame: R^T r = R^T y - R^T t - x, so the weights are R^T W R
        own = rotation[:, None].swapaxes(2, 3) @ weights @ rotation[:, None]
        residual = missing @ rotation
        motion = np.zeros((count, balls, 3, 6))
        motion[..., :3] = np.eye(3)
        motion[..., 3:] = -so3.skew(np.broadcast_to(shape, views.shape))
        mixed = (own @ motion).reshape(count, 3 * balls, 6)
        of_pose = mixed.swapaxes(1, 2) @ motion.reshape(count, 3 * balls, 6)
        gradient = (own @ residual[..., None]).reshape(count, 3 * balls, 1)
        of_gradient = motion.reshape(count, 3 * balls, 6).swapaxes(1, 2) @ gradient
        eliminated = mixed @ np.linalg.inv(of_pose)
        information = -(eliminated @ mixed.swapaxes(1, 2)).sum(axis=0)
        diagonal = own.sum(axis=0)
        for ball in range(balls):
            information[3 * ball : 3 * ball + 3, 3 * ball : 3 * ball + 3] += diagonal[ball]
        right = (gradient - eliminated @ of_gradient).sum(axis=0)[:, 0]
        free = _without_frame(shape)
        reduced = free.T @ information @ free
        if np.linalg.cond(reduced) > 1e12:
            raise TargetCalibrationError(f"target {name}: the views do not determine the places of all balls")
        covariance: FloatArray = free @ np.linalg.inv(reduced) @ free.T
        step = (covariance @ right).reshape(balls, 3)
        shape = shape + step - step.mean(axis=0)
        if np.abs(step).max() < _CONVERGED:
            break
    return _Fit(shape, covariance)


def _without_frame(shape: FloatArray) -> FloatArray:
    """(3k, 3k - 6) orthonormal basis of the changes of points without translation and rotation of the whole.

    Gaschler (2011): eq. 4.14-4.17 remove these six degrees of freedom by zeros.
    """
    balls = len(shape)
    motion = np.zeros((balls, 3, 6))
    motion[..., :3] = np.eye(3)
    motion[..., 3:] = -so3.skew(shape)
    basis: FloatArray = np.linalg.svd(motion.reshape(3 * balls, 6))[0][:, 6:]
    return basis


def _residuals(shape: FloatArray, views: FloatArray, seen: BoolArray, weights: FloatArray) -> FloatArray:
    """(f, k, 3) residuals in the target's frame, metres; zeros for unseen balls."""
    rotation, translation = _poses(shape, views, seen, weights)
    missing = (views - shape @ rotation.swapaxes(1, 2) - translation[:, None]) @ rotation
    result: FloatArray = np.asarray(np.where(seen[..., None], missing, 0.0))
    return result


def _costs(shape: FloatArray, views: FloatArray, seen: BoolArray, weights: FloatArray) -> FloatArray:
    """(f,) squared Mahalanobis distance of each view from the target."""
    rotation, translation = _poses(shape, views, seen, weights)
    missing = views - shape @ rotation.swapaxes(1, 2) - translation[:, None]
    costs: FloatArray = (missing[..., None, :] @ weights @ missing[..., None]).sum(axis=(1, 2, 3))
    return costs


def _flexibility(residuals: FloatArray, seen: BoolArray, covariance: FloatArray | None) -> FloatArray:
    """(k,) variance of a coordinate of each ball beyond its noise.

    The pose takes six of a view's degrees of freedom, spread evenly over its balls.
    """
    share = 1.0 - 2.0 / seen.sum(axis=1)
    squares = ((residuals**2).sum(axis=2)).sum(axis=0) / (3.0 * (share[:, None] * seen).sum(axis=0))
    if covariance is None:
        noise = np.full(len(squares), squares.min())
    else:
        noise = np.trace(covariance, axis1=2, axis2=3).sum(axis=0) / (3.0 * seen.sum(axis=0))
    extra: FloatArray = np.maximum(squares - noise, 0.0)
    return extra


def _axes(name: str, shape: FloatArray) -> FloatArray:
    """(3, 3) matrix whose rows are the axes of the target's frame.

    Gaschler (2011): eq. 4.14-4.17, the rotation of a QR decomposition with positive signs on R's diagonal.
    """
    x = shape[1] - shape[0]
    x = x / np.linalg.norm(x)
    across = shape[2:] - shape[0]
    across = across - (across @ x)[:, None] * x
    widths = np.linalg.norm(across, axis=1)
    size = np.linalg.norm(shape[:, None] - shape, axis=2).max()
    wide = np.flatnonzero(widths > _ON_LINE * size)
    third = int(wide[0]) if len(wide) else int(widths.argmax())
    y = across[third] / widths[third]
    return np.stack([x, y, np.cross(x, y)])
