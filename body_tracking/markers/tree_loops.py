"""Compiled loops of :mod:`body_tracking.markers.joint_tree` over frames and joints."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_linear import inverse_of
from body_tracking.core.compiled_so3 import turn_between, turned
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.joint_model import SIZE

Numbers = tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Arrays of j joints: (j,) parents, numbers of coordinates and first coordinates; parent_rotation (j, 3, 3),
parent_centre (j, 3), child_rotation (j, 3, 3), child_centre (j, 3)."""
_BALL, _UNIVERSAL = 3, 2
"""Numbers of coordinates."""


@compiled
def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 3) ``a @ b``."""
    result = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            result[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return result


@compiled
def _applied(rotation: FloatArray, x: FloatArray) -> FloatArray:
    """(3,) ``rotation @ x``."""
    result = np.empty(3)
    for i in range(3):
        result[i] = rotation[i, 0] * x[0] + rotation[i, 1] * x[1] + rotation[i, 2] * x[2]
    return result


@compiled
def place(
    numbers: Numbers,
    rotation: FloatArray,
    translation: FloatArray,
    turns: FloatArray,
    rotations: FloatArray,
    translations: FloatArray,
) -> None:
    """Write rotations (n, m, 3, 3) and translations (n, m, 3) of the targets of postures; turns: (j, n, 3, 3)."""
    parents, _, _, parent_rotation, parent_centre, child_rotation, child_centre = numbers
    rotations[:, 0], translations[:, 0] = rotation, translation
    for j in range(len(parents)):
        back = child_rotation[j].T.copy()
        for n in range(len(rotation)):
            before = rotations[n, parents[j]]
            after = _product(before, _product(_product(parent_rotation[j], turns[j, n]), back))
            parent_arm, child_arm = _applied(before, parent_centre[j]), _applied(after, child_centre[j])
            rotations[n, j + 1] = after
            for i in range(3):
                translations[n, j + 1, i] = translations[n, parents[j], i] + parent_arm[i] - child_arm[i]


@compiled
def moved(
    numbers: Numbers,
    steps: FloatArray,
    rotation: FloatArray,
    translation: FloatArray,
    turns: FloatArray,
) -> None:
    """Move postures by steps (n, size) of their coordinates, in place."""
    _, coordinates, starts = numbers[:3]
    for n in range(len(rotation)):
        for i in range(3):
            translation[n, i] += steps[n, i]
        rotation[n] = turned(steps[n, 3:6], rotation[n])
        for j in range(len(starts)):
            start, turn = starts[j], turns[j, n]
            if coordinates[j] == _BALL:
                turns[j, n] = turned(steps[n, start : start + 3], turn)
                continue
            c, s = math.cos(steps[n, start]), math.sin(steps[n, start])
            for k in range(3):
                turn[0, k], turn[1, k] = c * turn[0, k] - s * turn[1, k], s * turn[0, k] + c * turn[1, k]
            if coordinates[j] == _UNIVERSAL:
                c, s = math.cos(steps[n, start + 1]), math.sin(steps[n, start + 1])
                for k in range(3):
                    turn[k, 0], turn[k, 1] = c * turn[k, 0] + s * turn[k, 1], c * turn[k, 1] - s * turn[k, 0]


@compiled
def differentiate(
    numbers: Numbers, turns: FloatArray, rotations: FloatArray, size: int, parameters: bool, result: FloatArray
) -> None:
    """Write the derivatives (n, m, 6, size), with parameters (n, m, 6, size + 12 j), into zeros."""
    parents, coordinates, starts, parent_rotation, parent_centre, _, child_centre = numbers
    for n in range(len(rotations)):
        for i in range(6):
            result[n, 0, i, i] = 1.0
        for j in range(len(parents)):
            before, after = rotations[n, parents[j]], rotations[n, j + 1]
            by_parent, by_child = result[n, parents[j]], result[n, j + 1]
            frame, start = _product(before, parent_rotation[j]), size + SIZE * j
            second = _applied(frame, turns[j, n, :, 2])
            p, c = _applied(before, parent_centre[j]), _applied(after, child_centre[j])
            by_child[3:] = by_parent[3:]
            for i in range(3):
                if coordinates[j] == _BALL:
                    for k in range(3):
                        by_child[3 + i, starts[j] + k] = frame[i, k]
                else:
                    by_child[3 + i, starts[j]] = frame[i, 2]
                    if coordinates[j] == _UNIVERSAL:
                        by_child[3 + i, starts[j] + 1] = second[i]
                if parameters:
                    for k in range(3):
                        by_child[3 + i, start + 3 + k] = before[i, k]
                        by_child[3 + i, start + 9 + k] = -after[i, k]
            # the centre: parent's translation + parent's arm p = child's translation + child's arm c
            for k in range(result.shape[3]):
                u, v, w = by_parent[3, k], by_parent[4, k], by_parent[5, k]
                x, y, z = by_child[3, k], by_child[4, k], by_child[5, k]
                by_child[0, k] = by_parent[0, k] - (p[1] * w - p[2] * v) + (c[1] * z - c[2] * y)
                by_child[1, k] = by_parent[1, k] - (p[2] * u - p[0] * w) + (c[2] * x - c[0] * z)
                by_child[2, k] = by_parent[2, k] - (p[0] * v - p[1] * u) + (c[0] * y - c[1] * x)
            if parameters:
                for i in range(3):
                    for k in range(3):
                        by_child[i, start + k] += before[i, k]
                        by_child[i, start + 6 + k] -= after[i, k]


@compiled
def errors(
    measured_rotations: FloatArray,
    measured_translations: FloatArray,
    seen: BoolArray,
    rotations: FloatArray,
    translations: FloatArray,
    result: FloatArray,
) -> None:
    """Write (n, m, 6) translation and rotation from the tree's poses to the measured ones; zeros where unseen."""
    for n in range(len(seen)):
        for m in range(seen.shape[1]):
            if seen[n, m]:
                result[n, m, :3] = measured_translations[n, m] - translations[n, m]
                result[n, m, 3:] = turn_between(rotations[n, m], measured_rotations[n, m])
            else:
                result[n, m] = 0.0


@compiled
def adjusted(
    numbers: Numbers,
    posture: tuple[FloatArray, FloatArray, FloatArray],
    measured: tuple[FloatArray, FloatArray, BoolArray, FloatArray],
    size: int,
    loose: float,
    converged: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray, float]:
    """Fit the posture of one frame, in place, to measured poses by Gauss-Newton.

    Args:
        numbers: of m - 1 joints.
        posture: rotation (1, 3, 3), translation (1, 3), turns (j, 1, 3, 3), near the solution.
        measured: rotations (1, m, 3, 3), translations (1, m, 3), seen (1, m), whitening (1, m, 6, 6).
        size: number of coordinates.
        loose: prior information of a coordinate's step.
        converged: step in radians and metres below which the iteration ends.
        iterations: largest number.

    Returns:
        (6 m, size + 12 j) whitened derivatives, (size, size) covariance of the coordinates, and the sum of squared
        errors.
    """
    rotation, translation, turns = posture
    poses, places, seen, whitening = measured
    targets = seen.shape[1]
    rotations, translations = np.empty((1, targets, 3, 3)), np.empty((1, targets, 3))
    error, width = np.empty((1, targets, 6)), size + SIZE * len(turns)
    white, residual = np.empty((6 * targets, width)), np.empty(6 * targets)
    information, covariance, step = np.empty((size, size)), np.empty((size, size)), np.empty((1, size))
    for count in range(iterations):
        place(numbers, rotation, translation, turns, rotations, translations)
        # the first step is never the last one, so it needs no derivatives by the joints' parameters
        parameters = count > 0
        derivative = np.zeros((1, targets, 6, width))
        differentiate(numbers, turns, rotations, size, parameters, derivative)
        errors(poses, places, seen, rotations, translations, error)
        for m in range(targets):
            for i in range(6):
                row = white[6 * m + i]
                row[:], residual[6 * m + i] = 0.0, 0.0
                for k in range(i + 1):  # the whitening is lower triangular
                    weight = whitening[0, m, i, k]
                    residual[6 * m + i] += weight * error[0, m, k]
                    for column in range(width if parameters else size):
                        row[column] += weight * derivative[0, m, k, column]
        for i in range(size):
            for j in range(i + 1):
                value = loose if i == j else 0.0
                for n in range(6 * targets):
                    value += white[n, i] * white[n, j]
                information[i, j] = information[j, i] = value
        inverse_of(information, covariance)
        largest = 0.0
        for i in range(size):
            step[0, i] = 0.0
            for n in range(6 * targets):
                gain = 0.0
                for j in range(size):
                    gain += covariance[i, j] * white[n, j]
                step[0, i] += gain * residual[n]
            largest = max(largest, abs(step[0, i]))
        moved(numbers, step, rotation, translation, turns)
        if parameters and largest < converged:
            break
    # squared errors after the last step, by linearisation
    squares = 0.0
    for n in range(6 * targets):
        left = residual[n]
        for j in range(size):
            left -= white[n, j] * step[0, j]
        squares += left * left
    return white, covariance, squares
