"""Rays to balls of all cameras in the rig's frame, with their covariance by pixel noise and calibration.

All balls of all cameras are in one array, so that one compiled loop does what :class:`Camera` does for one camera: with
fifteen balls per camera, a call costs more than its arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.compiled import compiled
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers import hartley_sturm, projection
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.rig import POSE, Rig

_NEWTON: Final = 20
_CONVERGED: Final = 1e-10
"""Convergence limit in image coordinates, 1e-7 px; each Newton step squares the error."""
_CELLS: Final = 16
"""Cells across and down a camera's image, within which the calibration's effect on a ray is taken as constant."""


class TriangulationError(BodyTrackingError):
    """Raised for balls that do not match the rig: unknown cameras, wrong shapes, numbers that are not finite."""


@dataclass(frozen=True, slots=True, eq=False)
class RigRays:
    """Quantities of a rig that are constant over images.

    Attributes:
        index: of each camera, by its frame.
        focal: (c, 2) and
        centre: (c, 2) pixels.
        distortion: (8, c) coefficients, zeros where a model has fewer.
        rotations: (c, 3, 3) and
        translations: (c, 3) of the rig.
        positions: (c, 3) camera centres in the rig's frame, metres.
        translation_factor: (c, 3, r) effect on each translation of r independent unknowns of variance 1, into which the
            calibration's covariance is decomposed.
        flat_factor: (c, cells, cells, 2, r) effect of these unknowns on the image coordinates x/z, y/z of a far point
            relative to those of its pixel, per cell of the image.
        cell: (c, 2) size of a cell, pixels.
        epipolar: fundamental matrix and epipoles of the first two cameras (:func:`hartley_sturm.fundamental`).
    """

    index: dict[str, int]
    focal: FloatArray
    centre: FloatArray
    distortion: FloatArray
    rotations: FloatArray
    translations: FloatArray
    positions: FloatArray
    translation_factor: FloatArray
    flat_factor: FloatArray
    cell: FloatArray
    epipolar: tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The balls of all cameras.

    Attributes:
        cameras: (m,) index of the camera of each ball.
        balls: (m,) index of each ball among the balls of its camera.
        flat: (m, 2) undistorted x/z and y/z; NaN where a pixel has no direction.
        spread: (m, 2, 2) a square root of the covariance of ``flat`` by the noise of the centroids.
        weight: (m, 2, 2) the inverse of that covariance.
        directions: (m, 3) in the rig's frame, with the length of (x/z, y/z, 1).
        flat_factor: (m, 2, r) see :class:`RigRays`.
        first: (c + 1,) index of the first ball of each camera.
    """

    cameras: IntArray
    balls: IntArray
    flat: FloatArray
    spread: FloatArray
    weight: FloatArray
    directions: FloatArray
    flat_factor: FloatArray
    first: list[int]


@lru_cache(maxsize=8)
def rig_rays(rig: Rig) -> RigRays:
    """Quantities of a rig that are constant over images."""
    cameras = rig.cameras
    coefficients = np.zeros((8, len(cameras)))
    for index, camera in enumerate(cameras):
        coefficients[: len(camera.distortion), index] = camera.distortion
    factor = _square_root(rig.covariance)
    starts, count = projection.offsets(rig), factor.shape[1]
    translation_factor = np.zeros((len(cameras), 3, count))
    flat_factor = np.zeros((len(cameras), _CELLS, _CELLS, 2, count))
    cell = np.array([[camera.width / _CELLS, camera.height / _CELLS] for camera in cameras])
    for index, camera in enumerate(cameras):
        part = factor[starts[index] : starts[index + 1]]
        lens, turn, shift = np.split(part, [len(part) - POSE, len(part) - 3])
        translation_factor[index] = shift + so3.skew(rig.translations[index]) @ turn
        grid = np.stack(np.meshgrid(*[np.arange(_CELLS) + 0.5] * 2), axis=-1).reshape(-1, 2) * cell[index] - 0.5
        flat = camera.undistort(grid)
        _, by_flat, by_lens = projection.by_lens(camera, np.where(np.isfinite(flat), flat, 0.0))
        x, y = flat.T
        by_turn = np.stack([-x * y, 1.0 + x * x, -y, -1.0 - y * y, x * y, x], axis=-1).reshape(-1, 2, 3)
        added = np.linalg.solve(by_flat, by_lens @ lens) + by_turn @ turn
        flat_factor[index] = np.nan_to_num(added).reshape(_CELLS, _CELLS, 2, count)
    focal = np.array([camera.matrix[[0, 1], [0, 1]] for camera in cameras])
    centre = np.array([camera.matrix[:2, 2] for camera in cameras])
    return RigRays(
        {camera.frame_id: index for index, camera in enumerate(cameras)},
        focal,
        centre,
        coefficients,
        rig.rotations,
        rig.translations,
        -np.einsum("cji,cj->ci", rig.rotations, rig.translations),
        translation_factor,
        flat_factor,
        cell,
        hartley_sturm.fundamental(rig.rotations[:2], rig.translations[:2], focal[:2], centre[:2]),
    )


def _square_root(covariance: FloatArray) -> FloatArray:
    """(p, r) square root: ``root @ root.T`` is the covariance; directions without variance are dropped."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    kept = values > 1e-12
    root: FloatArray = scale[:, None] * vectors[:, kept] * np.sqrt(values[kept])
    return root


def make_rays(geometry: RigRays, images: Sequence[ImageBalls]) -> Rays:
    """Rays to the balls of one time.

    Raises:
        TriangulationError: a camera unknown or given twice, other shapes, invalid numbers or covariance.
    """
    sorted_images: list[ImageBalls | None] = [None] * len(geometry.index)
    for image in images:
        index = geometry.index.get(image.camera)
        if index is None or sorted_images[index] is not None:
            raise TriangulationError(
                f"balls of camera {image.camera}: {'not in the rig' if index is None else 'given twice'}"
            )
        count = len(image.pixels)
        if image.pixels.shape != (count, 2) or image.covariance.shape != (count, 2, 2):
            raise TriangulationError(
                f"balls of camera {image.camera}: pixels {image.pixels.shape}, covariance {image.covariance.shape}, "
                "expected (n, 2) and (n, 2, 2)"
            )
        sorted_images[index] = image
    present = [image for image in sorted_images if image is not None]
    counts = [0 if image is None else len(image.pixels) for image in sorted_images]
    first = [0, *np.cumsum(counts).tolist()]
    # contiguous, because numba compiles the loop again for each memory layout
    pixels = np.ascontiguousarray(np.concatenate([np.zeros((0, 2)), *(image.pixels for image in present)]))
    covariance = np.ascontiguousarray(np.concatenate([np.zeros((0, 2, 2)), *(image.covariance for image in present)]))
    cameras = np.repeat(np.arange(len(counts)), counts)
    size, unknowns = len(pixels), geometry.flat_factor.shape[-1]
    flat, directions, flat_factor = np.empty((size, 2)), np.empty((size, 3)), np.empty((size, 2, unknowns))
    spread, weight = np.empty((size, 2, 2)), np.empty((size, 2, 2))
    optics = geometry.focal, geometry.centre, geometry.distortion, geometry.rotations
    cells = geometry.cell, geometry.flat_factor
    bad = _rays(pixels, covariance, cameras, optics, cells, flat, spread, weight, directions, flat_factor)
    if bad >= 0:
        camera = int(cameras[bad])
        raise TriangulationError(
            f"ball {bad - first[camera]} of camera {list(geometry.index)[camera]}: pixels {pixels[bad].tolist()}, "
            f"covariance {covariance[bad].tolist()}; expected finite numbers and a positive definite covariance"
        )
    balls = np.arange(size) - np.asarray(first)[cameras]
    return Rays(cameras, balls, flat, spread, weight, directions, flat_factor, first)


@compiled
def _rays(
    pixels: FloatArray,
    covariance: FloatArray,
    cameras: IntArray,
    optics: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    cells: tuple[FloatArray, FloatArray],
    flat: FloatArray,
    spread: FloatArray,
    weight: FloatArray,
    directions: FloatArray,
    flat_factor: FloatArray,
) -> int:
    """Write the fields of :class:`Rays`; returns the index of the first ball with invalid numbers, or -1."""
    focal, centre, distortion, rotations = optics
    cell, table = cells
    for n in range(len(pixels)):
        u, v = pixels[n]
        xx, xy, yy = covariance[n, 0, 0], covariance[n, 0, 1], covariance[n, 1, 1]
        finite = math.isfinite(u + v) and math.isfinite(xx + xy + yy + covariance[n, 1, 0])
        if not (finite and xx > 0.0 and xx * yy > xy * xy):
            return n
        camera = cameras[n]
        fx, fy = focal[camera]
        x, y, jxx, jxy, jyy = _undistorted(
            (u - centre[camera, 0]) / fx, (v - centre[camera, 1]) / fy, distortion[:, camera]
        )
        flat[n, 0], flat[n, 1] = x, y
        # Cholesky factor of the centroid's covariance, transformed to image coordinates
        root = math.sqrt(xx)
        a, c = root / fx, xy / root / fy
        d = math.sqrt(yy - (xy / root) ** 2) / fy
        determinant = jxx * jyy - jxy * jxy
        s00, s01 = (jyy * a - jxy * c) / determinant, -jxy * d / determinant
        s10, s11 = (jxx * c - jxy * a) / determinant, jxx * d / determinant
        spread[n, 0, 0], spread[n, 0, 1], spread[n, 1, 0], spread[n, 1, 1] = s00, s01, s10, s11
        square = (s00 * s11 - s01 * s10) ** 2
        weight[n, 0, 0], weight[n, 1, 1] = (s10 * s10 + s11 * s11) / square, (s00 * s00 + s01 * s01) / square
        weight[n, 0, 1] = weight[n, 1, 0] = -(s00 * s10 + s01 * s11) / square
        for k in range(3):
            directions[n, k] = x * rotations[camera, 0, k] + y * rotations[camera, 1, k] + rotations[camera, 2, k]
        column = min(max(int((u + 0.5) / cell[camera, 0]), 0), _CELLS - 1)
        row = min(max(int((v + 0.5) / cell[camera, 1]), 0), _CELLS - 1)
        for axis in range(2):
            for k in range(table.shape[4]):
                flat_factor[n, axis, k] = table[camera, row, column, axis, k]
    return -1


@compiled
def _undistorted(u: float, v: float, distortion: FloatArray) -> tuple[float, float, float, float, float]:
    """Undistorted image coordinates, NaN if there are none, and the derivative of the distortion: xx, xy, yy.

    Conventions as in :meth:`Camera.undistort`.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    x, y = u, v
    moved, jxx, jxy, jyy, determinant = math.inf, 1.0, 0.0, 1.0, 1.0
    for _ in range(_NEWTON):
        r2 = x * x + y * y
        below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
        # twice the derivative by r2
        slope = 2.0 * k1 + r2 * (4.0 * k2 + 6.0 * r2 * k3)
        slope = (slope - radial * (2.0 * k4 + r2 * (4.0 * k5 + 6.0 * r2 * k6))) / below
        du = u - x * radial - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)
        dv = v - y * radial - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y
        jxx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        jyy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        jxy = x * y * slope + 2.0 * (p1 * x + p2 * y)
        determinant = jxx * jyy - jxy * jxy
        dx, dy = (jyy * du - jxy * dv) / determinant, (jxx * dv - jxy * du) / determinant
        x, y = x + dx, y + dy
        moved = abs(dx) + abs(dy)
        if not moved > 1e3 * _CONVERGED:  # convergence is quadratic
            break
    # these conditions hold within the range where the polynomials are monotonic
    if not (moved < 1e4 * _CONVERGED and determinant > 0.0 and x * u + y * v >= 0.0):
        x = y = math.nan
    return x, y, jxx, jxy, jyy
