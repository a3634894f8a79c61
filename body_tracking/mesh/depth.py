"""Depth images: back-projection, surface normals, and rejection of edges and flying pixels.

A depth image is a (height, width) float32 array of distances along the optical axis, metres; 0 where missing. Points
are in the camera's optical frame (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray

FARTHEST: Final = 12.0
"""Metres: the range of depth cameras for tracking people is smaller."""
_NOISE: Final = (1.13e-3, 0.129e-3)
"""Axial noise of a Kinect v2, standard deviation: constant part in metres, and part per square metre of distance
squared; 1.5 mm at 1.7 m and 4.1 mm at 4.8 m, measured on a real frame (benchmarks/depth_images.py)."""
_JUMP: Final = 0.015
"""Largest depth difference between neighbours on one surface, as a share of the distance: 30 mm at 2 m, a surface at 80
degrees of grazing (6 mm between pixels)."""
_LEAST: Final = 6
"""Least number of the 8 neighbours on the surface of a pixel that is neither on its edge nor flying."""


class DepthError(BodyTrackingError):
    """Raised for an invalid depth image, or one whose size differs from its camera's."""


def to_metres(pixels: NDArray[Any]) -> SingleArray:
    """Depth in metres from (height, width) pixels: unsigned integers are millimetres (16UC1), floats metres (32FC1).

    Zero, NaN, infinite and negative distances and those beyond 12 m become 0, missing (REP-118).

    Raises:
        DepthError: not a two-dimensional array of ``uint16`` or floats.
    """
    if pixels.ndim != 2 or not (pixels.dtype == np.uint16 or pixels.dtype.kind == "f"):
        raise DepthError(f"depth image of {pixels.dtype} {pixels.shape}, expected (height, width) uint16 or float32")
    depth = pixels.astype(np.float32)
    if pixels.dtype == np.uint16:
        depth /= np.float32(1e3)
    with np.errstate(invalid="ignore"):
        depth[~((depth > 0.0) & (depth <= FARTHEST))] = 0.0
    return depth


def axial_noise(distance: FloatArray) -> FloatArray:
    """Standard deviation of a Kinect v2's depth on a surface facing it, metres; argument: distance in metres."""
    return np.asarray(_NOISE[0] + _NOISE[1] * np.square(distance))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points sampled from a depth image.

    Attributes:
        points: (n, 3) metres in the optical frame.
        normals: (n, 3) unit vectors towards the camera; NaN where too few neighbours lie on one surface.
        pixels: (n, 2) row and column.
    """

    points: FloatArray
    normals: FloatArray
    pixels: IntArray


def check_size(image: NDArray[Any], camera: Camera, kind: str = "depth") -> None:
    """Check that a (height, width) image of this kind has the size of a calibrated camera.

    Raises:
        DepthError: another size.
    """
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise DepthError(
            f"{kind} image of {width} x {height} pixels, but the calibration of {camera.frame_id} says "
            f"{camera.width} x {camera.height}"
        )


class DepthCamera:
    """A depth camera with precomputed viewing directions of its pixels.

    Args:
        camera: intrinsics including distortion.

    Attributes:
        rays: (height, width, 2) x/z and y/z of each pixel; NaN where the distortion has no inverse.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([columns, rows], axis=-1).astype(np.float64)
        self.rays: SingleArray = camera.undistort(pixels).astype(np.float32)

    def check(self, depth: SingleArray) -> None:
        """Check that an image has this camera's size.

        Raises:
            DepthError: another size.
        """
        check_size(depth, self.camera)

    def points(self, depth: SingleArray) -> SingleArray:
        """(height, width, 3) points of all pixels, metres; NaN where missing.

        Raises:
            DepthError: another size than the camera's.
        """
        self.check(depth)
        z = np.where(depth > 0.0, depth, np.float32(np.nan))[..., None]
        return np.concatenate([self.rays * z, z], axis=-1)

    def sample(self, depth: SingleArray, mask: BoolArray, count: int, radius: int = 5, reach: float = 0.05) -> Cloud:
        """At most ``count`` points of a mask, spread evenly over its pixels, with normals.

        A normal is the direction of least variance of the neighbours within ``radius`` pixels (Chebyshev) and
        ``reach`` metres (Jatesiktat 2018, section II-H). Pixels are taken at even intervals in row order, so that equal
        images give equal samples.

        Raises:
            DepthError: another size than the camera's, or than the mask's.
        """
        self.check(depth)
        if mask.shape != depth.shape:
            raise DepthError(f"mask of {mask.shape} for a depth image of {depth.shape}")
        flat = np.flatnonzero(mask & (depth > 0.0))
        if len(flat) > count:
            flat = flat[np.linspace(0, len(flat) - 1, count).astype(np.intp)]
        rows, columns = np.divmod(flat, depth.shape[1])
        normals = normals_at(depth, self.rays, rows, columns, radius, reach)
        z = depth[rows, columns].astype(np.float64)
        points = np.column_stack([self.rays[rows, columns] * z[:, None], z])
        return Cloud(points, normals, np.column_stack([rows, columns]))


@compiled
def normals_at(
    depth: SingleArray, rays: SingleArray, rows: IntArray, columns: IntArray, radius: int, reach: float
) -> FloatArray:
    """(n, 3) unit normals towards the camera at n pixels, by principal component analysis of their neighbours.

    Jatesiktat (2018): section II-H. Inverse iteration finds the least eigenvector of the (3, 3) scatter matrix.

    Args:
        depth: (height, width) metres.
        rays: (height, width, 2) x/z and y/z.
        rows: (n,) pixels.
        columns: (n,) pixels.
        radius: greatest Chebyshev distance of a neighbour, pixels.
        reach: greatest distance of a neighbour, metres.

    Returns:
        Normals; NaN with fewer than 6 neighbours, or with collinear neighbours.
    """
    height, width = depth.shape
    normals = np.full((len(rows), 3), np.nan)
    for k in range(len(rows)):
        row, column = rows[k], columns[k]
        z0 = float(depth[row, column])
        x0, y0 = rays[row, column, 0] * z0, rays[row, column, 1] * z0
        n = 0
        mx = my = mz = xx = xy = xz = yy = yz = zz = 0.0
        for i in range(max(row - radius, 0), min(row + radius + 1, height)):
            for j in range(max(column - radius, 0), min(column + radius + 1, width)):
                z = float(depth[i, j])
                if z <= 0.0:
                    continue
                dx, dy, dz = rays[i, j, 0] * z - x0, rays[i, j, 1] * z - y0, z - z0
                if dx * dx + dy * dy + dz * dz > reach * reach:
                    continue
                n += 1
                mx += dx
                my += dy
                mz += dz
                xx += dx * dx
                xy += dx * dy
                xz += dx * dz
                yy += dy * dy
                yz += dy * dz
                zz += dz * dz
        if n < 6:
            continue
        xx, yy, zz = xx / n - mx * mx / n / n, yy / n - my * my / n / n, zz / n - mz * mz / n / n
        xy, xz, yz = xy / n - mx * my / n / n, xz / n - mx * mz / n / n, yz / n - my * mz / n / n
        # the shift keeps the inverse finite on a perfect plane and does not change the eigenvectors
        shift = 1e-6 * (xx + yy + zz) + 1e-15
        a, b, c = xx + shift, yy + shift, zz + shift
        # adjugate: the inverse up to its scale
        i00, i11, i22 = b * c - yz * yz, a * c - xz * xz, a * b - xy * xy
        i01, i02, i12 = xz * yz - xy * c, xy * yz - xz * b, xy * xz - a * yz
        u, v, w = -x0, -y0, -z0
        for _ in range(12):
            u, v, w = i00 * u + i01 * v + i02 * w, i01 * u + i11 * v + i12 * w, i02 * u + i12 * v + i22 * w
            size = np.sqrt(u * u + v * v + w * w)
            if size <= 0.0:
                break
            u, v, w = u / size, v / size, w / size
        # collinear neighbours leave two directions of least variance
        middle = (
            i00
            + i11
            + i22
            - (u * (i00 * u + i01 * v + i02 * w) + v * (i01 * u + i11 * v + i12 * w))
            - w * (i02 * u + i12 * v + i22 * w)
        )
        largest = i00 + i11 + i22 - middle
        if size <= 0.0 or middle > 0.5 * largest:
            continue
        if u * x0 + v * y0 + w * z0 > 0.0:
            u, v, w = -u, -v, -w
        normals[k, 0], normals[k, 1], normals[k, 2] = u, v, w
    return normals


@compiled
def supported(depth: SingleArray) -> BoolArray:
    """Mask of pixels on a surface: neither flying pixels nor on a surface's edge.

    A flying pixel of a time-of-flight camera averages foreground and background; few neighbours share its distance.

    Args:
        depth: (height, width) metres, 0 where missing.

    Returns:
        (height, width); False where depth is missing.
    """
    height, width = depth.shape
    good = np.zeros((height, width), dtype=np.bool_)
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            z = depth[i, j]
            if z <= 0.0:
                continue
            limit, count = _JUMP * z, 0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    other = depth[a, b]
                    if other > 0.0 and abs(other - z) <= limit:
                        count += 1
            # count includes the pixel itself
            good[i, j] = count > _LEAST
    return good
