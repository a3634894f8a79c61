"""The posture prior and the ranges of motion of one configuration at a time, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UpperBody

_VERTICAL = 1e-9
"""Horizontal part of the left-right axis of a pelvis that lies on its side."""
_SMALL, _SERIES = 1e-8, 1e-4
"""Radians below which the first terms of a series are exact."""
_BASE = 6
"""First coordinate of the tangent after the base."""


class PriorTable(NamedTuple):
    """The posture prior and the ranges of motion as arrays.

    Attributes:
        angles_q, angles: (20,) where the configuration, and the 26 coordinates, have the angles.
        quaternions, rotations: (2,) where they have the shoulders' rotations.
        to_centre: (2, 4) quaternions from the centre of a shoulder's reach.
        mean: (26,) radians.
        twist: (26,) coefficients of the sharing of the axial twist.
    """

    angles_q: IntArray
    angles: IntArray
    quaternions: IntArray
    rotations: IntArray
    to_centre: FloatArray
    mean: FloatArray
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
def prior_rows(
    q: FloatArray, rotation: FloatArray, turning: FloatArray, table: PriorTable
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations from the prior's mean: 26 coordinates, the sharing of the axial twist, the pelvis's tilt.

    Args:
        q: (35,) configuration.
        rotation: (3, 3) of the pelvis.
        turning: (3, 32) its angular velocity per tangent velocity.
        table: of the prior.

    Returns:
        (26,) values of ``SoftCoordinates``, (29,) residuals, (29, 32) their derivatives by the tangent.
    """
    values = soft_values(q, table)
    count = len(values)
    residuals = np.zeros(count + 3)
    gradients = np.zeros((count + 3, turning.shape[1]))
    for row in range(count):
        residuals[row] = values[row] - table.mean[row]
        residuals[count] += table.twist[row] * values[row]
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
    # of the tilt: sines of the vertical's angles with the horizontal axes forward and to the left
    size = max(math.sqrt(rotation[0, 1] ** 2 + rotation[1, 1] ** 2), _VERTICAL)
    x, y = rotation[0, 1] / size, rotation[1, 1] / size
    up = rotation[:, 2]
    forward, left = y * up[0] - x * up[1], x * up[0] + y * up[1]
    residuals[count + 1], residuals[count + 2] = forward, left
    # both axes turn with the heading: (forward axis x left-right axis) / size
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
