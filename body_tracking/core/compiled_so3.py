"""Rotations within compiled loops: one at a time, as :mod:`body_tracking.core.so3` does for many."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray

_SMALL = 1e-8


@compiled
def turned(vector: FloatArray, rotation: FloatArray) -> FloatArray:
    """(3, 3) ``exp(vector) @ rotation``, of a rotation vector (3,) in radians (Rodrigues' formula)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    first, second = 1.0, 0.5
    if angle > _SMALL:
        first, half = math.sin(angle) / angle, math.sin(0.5 * angle) / angle
        second = 2.0 * half * half
    turn = np.empty((3, 3))
    turn[0, 0] = 1.0 - second * (y * y + z * z)
    turn[1, 1] = 1.0 - second * (x * x + z * z)
    turn[2, 2] = 1.0 - second * (x * x + y * y)
    turn[0, 1], turn[1, 0] = second * x * y - first * z, second * x * y + first * z
    turn[0, 2], turn[2, 0] = second * x * z + first * y, second * x * z - first * y
    turn[1, 2], turn[2, 1] = second * y * z - first * x, second * y * z + first * x
    result = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                result[i, j] += turn[i, k] * rotation[k, j]
    return result


@compiled
def turn_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """(3,) radians: the shortest rotation vector v with ``exp(v) @ before == after``, both (3, 3)."""
    r = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                r[i, j] += after[i, k] * before[j, k]
    # four times the products of the quaternion's components with the largest one, the best conditioned choice
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    q = np.empty(4)
    if trace >= max(r[0, 0], r[1, 1], r[2, 2]):
        q[0], q[1], q[2], q[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1.0 + trace
    else:
        i = 0
        if r[1, 1] > r[i, i]:
            i = 1
        if r[2, 2] > r[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + r[i, i] - r[j, j] - r[k, k]
        q[j], q[k] = r[i, j] + r[j, i], r[i, k] + r[k, i]
        q[3] = r[k, j] - r[j, k]
    if q[3] < 0.0:
        q = -q
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    # for a vanishing vector part the rotation vector is twice the vector over the scalar
    scale = 2.0 * math.atan2(norm, q[3]) / norm if norm > _SMALL * q[3] else 2.0 / q[3]
    return scale * q[:3]
