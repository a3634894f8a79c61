"""Derivatives of projections by the camera's parameters, its pose and the points; and of rays by the parameters.

The parameters of a camera are those of :class:`body_tracking.markers.rig.Rig`: fx, fy, cx, cy, the distortion
coefficients, a rotation vector w (the true rotation is ``exp(w) @ rotation``) and an increment of its translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.markers.rig import LENS, POSE, Rig


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Projections of points into a camera.

    Attributes:
        pixels: (n, 2); NaN for points behind the camera.
        by_parameters: (n, 2, q) derivative by the camera's own q parameters.
        by_point: (n, 2, 3) derivative by the points, in the frame of the rig.
    """

    pixels: FloatArray
    by_parameters: FloatArray
    by_point: FloatArray


def size(camera: Camera) -> int:
    """Number of parameters of a camera in a rig."""
    return LENS + len(camera.distortion) + POSE


def offsets(rig: Rig) -> list[int]:
    """Index of the first parameter of each camera of a rig, then the total number."""
    ends = np.cumsum([size(camera) for camera in rig.cameras])
    return [0, *ends.tolist()]


def lenses_of(rig: Rig) -> BoolArray:
    """(p,) mask of the lens parameters of a rig."""
    lens = np.ones(rig.size, dtype=np.bool_)
    for end in offsets(rig)[1:]:
        lens[end - POSE : end] = False
    return lens


def parameters(rig: Rig) -> FloatArray:
    """(p,) lens parameters of a rig's cameras; zeros for their poses, whose parameters are increments."""
    return np.concatenate(
        [
            np.concatenate([camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion, np.zeros(POSE)])
            for camera in rig.cameras
        ]
    )


def by_lens(camera: Camera, flat: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of undistorted image coordinates, and their derivatives.

    Args:
        camera: the camera.
        flat: (n, 2) x/z and y/z.

    Returns:
        (n, 2) pixels, (n, 2, 2) their derivative by the coordinates, (n, 2, q - 6) by the lens parameters.
    """
    count = len(flat)
    pixels, by_flat = np.empty((count, 2)), np.empty((count, 2, 2))
    derivative = np.empty((count, 2, LENS + len(camera.distortion)))
    _by_lens(np.ascontiguousarray(camera.matrix), camera.distortion, flat, pixels, by_flat, derivative)
    return pixels, by_flat, derivative


@compiled
def _by_lens(
    matrix: FloatArray,
    distortion: FloatArray,
    flat: FloatArray,
    pixels: FloatArray,
    by_flat: FloatArray,
    derivative: FloatArray,
) -> None:
    """Write the results of :func:`by_lens`; conventions as in :meth:`Camera.distort`."""
    coefficients = np.zeros(8)
    coefficients[: len(distortion)] = distortion
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    for n in range(len(flat)):
        x, y = flat[n]
        xx, xy, yy = x * x, x * y, y * y
        r2 = xx + yy
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        slope = (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))) / below
        seen_x = x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * xx)
        seen_y = y * radial + p1 * (r2 + 2.0 * yy) + 2.0 * p2 * xy
        pixels[n, 0], pixels[n, 1] = fx * seen_x + cx, fy * seen_y + cy
        mixed = 2.0 * xy * slope + 2.0 * p1 * x + 2.0 * p2 * y
        by_flat[n, 0, 0] = fx * (radial + 2.0 * xx * slope + 2.0 * p1 * y + 6.0 * p2 * x)
        by_flat[n, 0, 1], by_flat[n, 1, 0] = fx * mixed, fy * mixed
        by_flat[n, 1, 1] = fy * (radial + 2.0 * yy * slope + 6.0 * p1 * y + 2.0 * p2 * x)
        row = derivative[n]
        row[0, 0], row[0, 1], row[0, 2], row[0, 3] = seen_x, 0.0, 1.0, 0.0
        row[1, 0], row[1, 1], row[1, 2], row[1, 3] = 0.0, seen_y, 0.0, 1.0
        for axis in range(2):
            scaled = (fx * x, fy * y)[axis]
            power = r2 / below
            row[axis, LENS], row[axis, LENS + 1], row[axis, LENS + 4] = (
                scaled * power,
                scaled * power * r2,
                scaled * power * r2 * r2,
            )
            if len(distortion) > 5:
                for order in range(3):
                    row[axis, LENS + 5 + order] = -scaled * radial * power
                    power *= r2
        row[0, LENS + 2], row[0, LENS + 3] = 2.0 * fx * xy, fx * (r2 + 2.0 * xx)
        row[1, LENS + 2], row[1, LENS + 3] = fy * (r2 + 2.0 * yy), 2.0 * fy * xy


def project(camera: Camera, rotation: FloatArray, translation: FloatArray, points: FloatArray) -> Projection:
    """Projections of points (n, 3) in the rig's frame into a camera of the rig, with derivatives."""
    count, lens = len(points), LENS + len(camera.distortion)
    turned = points @ rotation.T
    pixels, by_flat = np.empty((count, 2)), np.empty((count, 2, 2))
    by_parameters, by_point = np.empty((count, 2, lens + POSE)), np.empty((count, 2, 3))
    inside = turned + translation
    flat = inside[:, :2] / np.where(inside[:, 2:] > 0.0, inside[:, 2:], np.nan)
    matrix = np.ascontiguousarray(camera.matrix)
    _by_lens(matrix, camera.distortion, flat, pixels, by_flat, by_parameters)
    _by_pose(np.ascontiguousarray(rotation), turned, inside, flat, by_flat, by_parameters, by_point)
    return Projection(pixels, by_parameters, by_point)


@compiled
def _by_pose(
    rotation: FloatArray,
    turned: FloatArray,
    inside: FloatArray,
    flat: FloatArray,
    by_flat: FloatArray,
    by_parameters: FloatArray,
    by_point: FloatArray,
) -> None:
    """Write the derivatives of pixels by the pose, the last six of (n, 2, q), and by the points (n, 2, 3).

    Args:
        rotation: (3, 3) of the camera.
        turned: (n, 3) points rotated by it.
        inside: (n, 3) points in the camera's frame.
        flat: (n, 2) x/z and y/z.
        by_flat: (n, 2, 2) derivative of the pixels by ``flat``.
        by_parameters: written.
        by_point: written.
    """
    last = by_parameters.shape[2] - POSE
    for n in range(len(flat)):
        (x, y), (u, v, w) = flat[n], turned[n]
        depth = inside[n, 2] if inside[n, 2] > 0.0 else np.nan
        for axis in range(2):
            # eq. 4.3 of Gaschler: x/z, y/z
            a, b = by_flat[n, axis, 0] / depth, by_flat[n, axis, 1] / depth
            c = -(a * x + b * y)
            row = by_parameters[n, axis]
            row[last], row[last + 1], row[last + 2] = c * v - b * w, a * w - c * u, b * u - a * v
            row[last + 3], row[last + 4], row[last + 5] = a, b, c
            for k in range(3):
                by_point[n, axis, k] = a * rotation[0, k] + b * rotation[1, k] + c * rotation[2, k]
