"""Posture prior, ranges of motion and least squares of inverse kinematics, one configuration at a time, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.compiled_body import Tree, integrated, linearised, placed
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import TWIST_SHARING_STDDEV, Ranges
from body_tracking.kinematics.upper_body import UpperBody

_VERTICAL = 1e-9
"""Least horizontal part of the pelvis's left-right axis, for a pelvis that lies on its side."""
_SMALL, _SERIES = 1e-8, 1e-4
"""Radians below which the first terms of a series are exact."""
_ANYWHERE = 1e-4
"""Prior information on each coordinate of the base, 1/m2 and 1/rad2."""
_BASE = 6
"""First coordinate of the tangent after the base."""
_HUBER = 2.5
"""Standard deviations beyond which a point's residual counts linearly (Huber 1964)."""
_LIMIT_STDDEV = math.radians(4.0)
"""Standard deviation of the soft limits of the ranges of motion."""


class PriorTable(NamedTuple):
    """The posture prior and the ranges of motion as arrays.

    Attributes:
        angles_q, angles: (20,) indices of the angles in the configuration, and among the 26 coordinates.
        quaternions, rotations: (2,) first indices of the shoulders' rotations in both.
        to_centre: (2, 4) quaternions from the centre of a shoulder's reach.
        mean: (26,) radians.
        stddev: (29,) of the rows of :func:`prior_rows`.
        low: (26,) radians: lower limits.
        high: (26,) radians: upper limits.
        twist: (26,) coefficients of the sharing of the axial twist.
    """

    angles_q: IntArray
    angles: IntArray
    quaternions: IntArray
    rotations: IntArray
    to_centre: FloatArray
    mean: FloatArray
    stddev: FloatArray
    low: FloatArray
    high: FloatArray
    twist: FloatArray


def prior_table(model: UpperBody, ranges: Ranges, prior: PosturePrior) -> PriorTable:
    """The table of one model."""
    return PriorTable(
        model.scalar_q,
        model.scalar_v - _BASE,
        np.array([model.quaternion_of(f"upper_arm_{side}").start for side in ("left", "right")], dtype=np.intp),
        np.array([model.coordinate_names.index(f"shoulder_x_{side}") - _BASE for side in ("left", "right")]),
        ranges.to_centre,
        prior.mean,
        np.concatenate([prior.stddev, [math.radians(TWIST_SHARING_STDDEV)], prior.tilt_stddev]),
        ranges.low,
        ranges.high,
        ranges.twist,
    )


@compiled
def soft_values(q: FloatArray, table: PriorTable) -> FloatArray:
    """(26,) the values of ``SoftCoordinates`` at one configuration."""
    values = np.empty(len(table.mean))
    for number in range(len(table.angles)):
        values[table.angles[number]] = q[table.angles_q[number]]
    for side in range(len(table.quaternions)):
        place, row = table.quaternions[side], table.rotations[side]
        ax, ay, az, aw = table.to_centre[side]
        bx, by, bz, bw = q[place], q[place + 1], q[place + 2], q[place + 3]
        x = aw * bx + bw * ax + ay * bz - az * by
        y = aw * by + bw * ay + az * bx - ax * bz
        z = aw * bz + bw * az + ax * by - ay * bx
        w = aw * bw - ax * bx - ay * by - az * bz
        norm = math.sqrt(x * x + y * y + z * z)
        scale = 2.0 * (math.atan2(norm, abs(w)) / norm if norm > _SMALL else 1.0)
        if w < 0.0:
            scale = -scale
        values[row], values[row + 1], values[row + 2] = scale * x, scale * y, scale * z
    return values


@compiled
def _level(rotation: FloatArray) -> tuple[float, float, float]:
    """Direction x, y of a pelvis's left-right axis in the horizontal plane, and the length of its projection there."""
    size = max(math.sqrt(rotation[0, 1] ** 2 + rotation[1, 1] ** 2), _VERTICAL)
    return rotation[0, 1] / size, rotation[1, 1] / size, size


@compiled
def prior_residuals(q: FloatArray, rotation: FloatArray, table: PriorTable) -> tuple[FloatArray, FloatArray]:
    """Deviations from the prior's mean: 26 coordinates, the sharing of the axial twist, the pelvis's tilt.

    The tilt, forward and to the left, is measured by the sines of the vertical's angles with the horizontal axes.

    Args:
        q: (35,) configuration.
        rotation: (3, 3) of the pelvis.
        table: of the prior.

    Returns:
        (26,) values of ``SoftCoordinates``, (29,) residuals.
    """
    values = soft_values(q, table)
    count = len(values)
    residuals = np.zeros(count + 3)
    for row in range(count):
        residuals[row] = values[row] - table.mean[row]
        residuals[count] += table.twist[row] * values[row]
    x, y, _ = _level(rotation)
    up = rotation[:, 2]
    residuals[count + 1], residuals[count + 2] = y * up[0] - x * up[1], x * up[0] + y * up[1]
    return values, residuals


@compiled
def prior_rows(
    q: FloatArray, rotation: FloatArray, turning: FloatArray, table: PriorTable
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """:func:`prior_residuals` and their derivatives.

    Args:
        q: (35,) configuration.
        rotation: (3, 3) of the pelvis.
        turning: (3, 32) its angular velocity per tangent velocity.
        table: of the prior.

    Returns:
        (26,) values of ``SoftCoordinates``, (29,) residuals, (29, 32) their derivatives by the tangent.
    """
    values, residuals = prior_residuals(q, rotation, table)
    count = len(values)
    gradients = np.zeros((count + 3, turning.shape[1]))
    for row in range(count):
        gradients[row, _BASE + row] = 1.0
    for side in range(len(table.rotations)):
        row = table.rotations[side]
        v = values[row : row + 3]
        square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        angle = math.sqrt(square)
        # inverse of the right Jacobian (Sola eq. 144)
        factor = 1.0 / 12.0 if angle < _SERIES else (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
        for i in range(3):
            for j in range(3):
                gradients[row + i, _BASE + row + j] = factor * v[i] * v[j]
            gradients[row + i, _BASE + row + i] += 1.0 - factor * square
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            gradients[row + j, _BASE + row + k] -= 0.5 * v[i]
            gradients[row + k, _BASE + row + j] += 0.5 * v[i]
    for row in range(count):
        if table.twist[row] != 0.0:
            for column in range(turning.shape[1]):
                gradients[count, column] += table.twist[row] * gradients[row, column]
    x, y, size = _level(rotation)
    up, forward, left = rotation[:, 2], residuals[count + 1], residuals[count + 2]
    # both horizontal axes turn with the heading: (forward axis x left-right axis) / size
    r = rotation[:, 1]
    heading = np.array([-x * r[2], -y * r[2], y * r[1] + x * r[0]]) / size
    by_forward = np.array([x * up[2], y * up[2], -(x * up[0] + y * up[1])])
    by_left = np.array([-y * up[2], x * up[2], y * up[0] - x * up[1]])
    for i in range(3):
        by_forward[i] += left * heading[i]
        by_left[i] -= forward * heading[i]
    for column in range(turning.shape[1]):
        for i in range(3):
            gradients[count + 1, column] += by_forward[i] * turning[i, column]
            gradients[count + 2, column] += by_left[i] * turning[i, column]
    return values, residuals, gradients


@compiled
def excess_of(values: FloatArray, table: PriorTable) -> FloatArray:
    """(26,) radians by which values of ``SoftCoordinates`` leave the ranges; as of ``Ranges.excess_of``."""
    excess = np.zeros(len(values))
    for row in range(len(values)):
        excess[row] = max(values[row] - table.high[row], 0.0) + min(values[row] - table.low[row], 0.0)
    for side in range(len(table.rotations)):
        row = table.rotations[side]
        size = math.sqrt(values[row] ** 2 + values[row + 1] ** 2)
        share = max(size - table.high[row], 0.0) / max(size, _SMALL)  # the swing is bounded as a whole
        excess[row], excess[row + 1] = share * values[row], share * values[row + 1]
    return excess


@compiled
def _away(points: FloatArray, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(19, 3) normalised residuals of the points, and (19,) their norms."""
    residuals, sizes = np.empty(points.shape), np.empty(len(points))
    for point in range(len(points)):
        square = 0.0
        for i in range(3):
            residuals[point, i] = weights[point] * (target[point, i] - points[point, i])
            square += residuals[point, i] ** 2
        sizes[point] = math.sqrt(square)
    return residuals, sizes


@compiled
def _cost(sizes: FloatArray, residuals: FloatArray, excess: FloatArray, table: PriorTable) -> float:
    """Cost by norms of normalised residuals of points, residuals of the prior and the excess over the ranges."""
    cost = 0.0
    for size in sizes:
        cost += 0.5 * size * size if size <= _HUBER else _HUBER * (size - 0.5 * _HUBER)
    for row in range(len(residuals)):
        cost += 0.5 * (residuals[row] / table.stddev[row]) ** 2
    for over in excess:
        cost += 0.5 * (over / _LIMIT_STDDEV) ** 2
    return cost


@compiled
def costs(
    q: FloatArray, target: FloatArray, weights: FloatArray, lengths: FloatArray, tree: Tree, table: PriorTable
) -> FloatArray:
    """(n,) costs of configurations (n, 35); other arguments as of :func:`normal_equations`."""
    result = np.empty(len(q))
    for number in range(len(q)):
        points, rotations, _ = placed(q[number], lengths, tree)
        values, residuals = prior_residuals(q[number], rotations[0], table)
        result[number] = _cost(_away(points, target, weights)[1], residuals, excess_of(values, table), table)
    return result


@compiled
def normal_equations(
    q: FloatArray, target: FloatArray, weights: FloatArray, lengths: FloatArray, tree: Tree, table: PriorTable
) -> tuple[FloatArray, FloatArray, float]:
    """One Gauss-Newton step towards points, with ranges of motion and posture as priors.

    Args:
        q: (35,) configuration.
        target: (19, 3) points; anything where their weight is 0.
        weights: (19,) inverse standard deviations.
        lengths: (21,) metres.
        tree: of the model.
        table: of the prior.

    Returns:
        (32, 32) matrix and (32,) right-hand side of the step's normal equations, and the cost at ``q``.
    """
    points, rotations, _, observation, turning = linearised(q, lengths, tree)
    values, residuals, rows = prior_rows(q, rotations[0], turning[0], table)
    excess, (away, sizes) = excess_of(values, table), _away(points, target, weights)
    size = turning.shape[2]
    jacobian, error = np.empty((3 * len(points), size)), np.empty((3 * len(points), 1))
    for point in range(len(points)):
        root = math.sqrt(min(1.0, _HUBER / max(sizes[point], _SMALL)))
        for i in range(3):
            error[3 * point + i, 0] = root * away[point, i]
            for k in range(size):
                jacobian[3 * point + i, k] = weights[point] * root * observation[3 * point + i, k]
    off = np.empty((len(rows), 1))
    for row in range(len(rows)):
        precision = 1.0 / table.stddev[row] ** 2
        pull = precision * residuals[row]
        if row < len(excess) and excess[row] != 0.0:
            precision += 1.0 / _LIMIT_STDDEV**2
            pull += excess[row] / _LIMIT_STDDEV**2
        root = math.sqrt(precision)
        off[row, 0] = pull / root
        for k in range(size):
            rows[row, k] *= root
    normal = np.dot(jacobian.T, jacobian) + np.dot(rows.T, rows)
    gradient = np.dot(jacobian.T, error) - np.dot(rows.T, off)
    for k in range(_BASE):
        normal[k, k] += _ANYWHERE  # determines the base with too few points
    return normal, gradient.reshape(-1), _cost(sizes, residuals, excess, table)


@compiled
def descended(
    q: FloatArray,
    target: FloatArray,
    weights: FloatArray,
    lengths: FloatArray,
    iterations: int,
    tolerance: float,
    tree: Tree,
    table: PriorTable,
) -> tuple[FloatArray, FloatArray, float]:
    """(35,) the nearest minimum (Levenberg and Marquardt), (32, 32) the normal equations and the cost there.

    Arguments as of :func:`normal_equations`; it ends after ``iterations``, or when no coordinate of a step reaches the
    tolerance.
    """
    damping = 1e-3
    normal, gradient, cost = normal_equations(q, target, weights, lengths, tree, table)
    for _ in range(iterations):
        damped = normal.copy()
        for k in range(len(damped)):
            damped[k, k] *= 1.0 + damping
        step: FloatArray = np.linalg.solve(damped, gradient).astype(np.float64)
        moved = integrated(q, step, tree)
        new_normal, new_gradient, new_cost = normal_equations(moved, target, weights, lengths, tree, table)
        if new_cost < cost:
            q, normal, gradient, cost = moved, new_normal, new_gradient, new_cost
            damping = max(0.1 * damping, 1e-7)
            if np.abs(step).max() < tolerance:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return q, normal, cost
