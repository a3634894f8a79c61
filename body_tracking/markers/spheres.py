"""The image of a sphere: the cone of tangent rays, cut by the image plane, distorted by the lens."""

from __future__ import annotations

from typing import Final

import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray

_VERTICES: Final = 64
"""Number of vertices of the outline's polygon; the centroid error for a ball of 14 mm is below 1e-4 pixels."""
_ITERATIONS: Final = 3


class SphereError(BodyTrackingError):
    """Raised for parameters that describe no sphere in front of a camera."""


def outlines(camera: Camera, centres: FloatArray, radius: float, vertices: int = _VERTICES) -> FloatArray:
    """Pixels of the outlines of spheres.

    Args:
        camera: with its distortion.
        centres: (n, 3) metres, in the camera's frame.
        radius: of the spheres, metres.
        vertices: of each polygon.

    Returns:
        (n, vertices, 2) pixels; NaN if a ray points backwards, or the camera's centre is inside the sphere.
    """
    distance = np.linalg.norm(centres, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = centres / distance
        sine = radius / distance
        cosine = np.sqrt(1.0 - sine**2)
    # two directions perpendicular to the axis, the second in the plane of the axis and the optical axis
    across = np.cross(axis, [0.0, 0.0, 1.0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(length > 1e-9, across / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])
    along = np.cross(across, axis)
    angle = np.arange(vertices) * (2.0 * np.pi / vertices)
    around = np.cos(angle)[:, None] * along[:, None, :] + np.sin(angle)[:, None] * across[:, None, :]
    return camera.project(cosine[:, None, :] * axis[:, None, :] + sine[:, None, :] * around)


def polygon_centroids(polygons: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centroids (n, 2) and areas (n,) of polygons (n, vertices, 2), by Green's theorem."""
    middle = polygons.mean(axis=1)
    own = polygons - middle[:, None, :]
    following = np.roll(own, -1, axis=1)
    cross = own[..., 0] * following[..., 1] - own[..., 1] * following[..., 0]
    area = 0.5 * cross.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = ((own + following) * cross[..., None]).sum(axis=1) / (6.0 * area[:, None])
    return middle + shift, np.abs(area)


def sphere_centre_correction(camera: Camera, pixels: FloatArray, depths: FloatArray, radius: float) -> FloatArray:
    """Offset of the projection of a sphere's centre from the centroid of its image.

    The tangent rays form a cone around the ray of the centre. Without distortion the cone cuts the image plane in an
    ellipse whose centre is the projection of the sphere's centre moved away from the principal point by the factor
    1 / (1 - r^2 / z^2), z the depth: (tan(a + b) + tan(a - b)) / 2 for a centre at the angle a from the optical axis
    and sin b = r / distance. Lens distortion moves the centroid once more; therefore the outlines' centroids are
    computed, and the equation centre = pixel - shift(centre) is solved by fixed-point iteration.

    Args:
        camera: the camera.
        pixels: (n, 2) centroids of the spheres' images.
        depths: (n,) metres, z of the centres in the camera's frame; an error of 1 % changes the correction by 2 %.
        radius: of the spheres, metres.

    Returns:
        (n, 2) pixels to be added to the centroids; NaN for NaN pixels.

    Raises:
        SphereError: other shapes, a radius that is not positive, or depths that are not greater than it.
    """
    if pixels.ndim != 2 or pixels.shape[1] != 2 or depths.shape != pixels.shape[:1]:
        raise SphereError(f"pixels {pixels.shape} and depths {depths.shape}, expected (n, 2) and (n,)")
    if not (np.isfinite(radius) and radius > 0.0 and (depths > radius).all()):
        raise SphereError(f"spheres of radius {radius} m at depths of {depths} m: they must be in front of the camera")
    centres = np.array(pixels)
    for _ in range(_ITERATIONS):
        flat = camera.undistort(centres)
        points = depths[:, None] * np.concatenate([flat, np.ones_like(flat[:, :1])], axis=1)
        centres += pixels - polygon_centroids(outlines(camera, points, radius))[0]
    return centres - pixels
