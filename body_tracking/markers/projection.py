"""Derivatives of projection by a camera's parameters, its pose and the points; and of rays by the same.

The parameters of a camera are those of :class:`body_tracking.markers.rig.Rig`: fx, fy, cx, cy, the coefficients of its
distortion, a rotation vector w (the true rotation is ``exp(w) @ rotation``) and what is added to its translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.markers.rig import LENS, POSE, Rig


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Points seen by a camera.

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
    """Index of the first parameter of each camera of a rig, and the number of all."""
    ends = np.cumsum([size(camera) for camera in rig.cameras])
    return [0, *ends.tolist()]


def lenses_of(rig: Rig) -> BoolArray:
    """(p,) which parameters of a rig are those of its cameras' lenses."""
    lens = np.ones(rig.size, dtype=np.bool_)
    for end in offsets(rig)[1:]:
        lens[end - POSE : end] = False
    return lens


def parameters(rig: Rig) -> FloatArray:
    """(p,) the lenses of a rig's cameras; zeros in place of their poses, which are changes."""
    return np.concatenate(
        [
            np.concatenate([camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion, np.zeros(POSE)])
            for camera in rig.cameras
        ]
    )


def by_lens(camera: Camera, flat: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels of ideal image coordinates, and their derivatives.

    Args:
        camera: the camera.
        flat: (n, 2) x/z and y/z.

    Returns:
        (n, 2) pixels, (n, 2, 2) their derivative by the coordinates, (n, 2, q - 6) by the parameters of the lens.
    """
    count = len(camera.distortion)
    distorted, jacobian = camera.distort(flat)
    focal = camera.matrix[[0, 1], [0, 1]]
    x, y = flat[:, 0], flat[:, 1]
    r2 = x * x + y * y
    derivative = np.zeros((len(flat), 2, LENS + count))
    derivative[:, 0, 0], derivative[:, 1, 1] = distorted[:, 0], distorted[:, 1]
    derivative[:, 0, 2] = derivative[:, 1, 3] = 1.0
    below = np.ones_like(r2)
    if count > 5:
        k4, k5, k6 = camera.distortion[5:8]
        below += r2 * (k4 + r2 * (k5 + r2 * k6))
    powers = np.stack([r2, r2 * r2, r2 * r2 * r2], axis=-1) / below[:, None]  # k1, k2, k3
    scaled = focal * flat
    derivative[:, :, LENS : LENS + 2] = scaled[:, :, None] * powers[:, None, :2]
    derivative[:, :, LENS + 4] = scaled * powers[:, 2:]
    cross, square = 2.0 * x * y, 2.0 * flat * flat + r2[:, None]
    derivative[:, 0, LENS + 2], derivative[:, 1, LENS + 2] = focal[0] * cross, focal[1] * square[:, 1]
    derivative[:, 0, LENS + 3], derivative[:, 1, LENS + 3] = focal[0] * square[:, 0], focal[1] * cross
    if count > 5:
        k1, k2, _, _, k3 = camera.distortion[:5]
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        derivative[:, :, LENS + 5 :] = -(scaled * radial[:, None])[:, :, None] * powers[:, None, :]
    return camera.to_pixels(distorted), focal[:, None] * jacobian, derivative


def project(camera: Camera, rotation: FloatArray, translation: FloatArray, points: FloatArray) -> Projection:
    """Points (n, 3) of the rig's frame as a camera of the rig sees them, with derivatives."""
    turned = points @ rotation.T
    inside = turned + translation
    depth = np.where(inside[:, 2] > 0.0, inside[:, 2], np.nan)
    flat = inside[:, :2] / depth[:, None]
    pixels, by_flat, lens = by_lens(camera, flat)
    # eq. 4.3 of Gaschler: x/z, y/z
    by_inside = np.empty((len(points), 2, 3))
    by_inside[:, :, :2] = by_flat / depth[:, None, None]
    by_inside[:, :, 2] = -(by_flat @ flat[:, :, None])[:, :, 0] / depth[:, None]
    pose = np.concatenate([-(by_inside @ so3.skew(turned)), by_inside], axis=-1)
    return Projection(pixels, np.concatenate([lens, pose], axis=-1), by_inside @ rotation)
