"""A simulated Kinect v2: depth images with realistic errors from a scene's true depth.

Errors as measured on real frames (``../shared/data/kinect_depth``): axial noise that grows with the distance and at
grazing angles, steps of 1 mm, missing pixels where little light returns (image corners, grazing and dark surfaces,
outlines), flying pixels between foreground and background, and multipath in the corner above the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtri

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera, axial_noise
from body_tracking.mesh.person import Floor


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Sizes of the errors of a simulated depth camera.

    Attributes:
        noise: factor on the axial noise, :func:`~body_tracking.mesh.depth.axial_noise`.
        grazing: growth of the noise with the slope of a surface: 1 + grazing tan(angle of incidence).
        dark: factor on the noise on dark cloth.
        dark_bias: positive bias of the depth of dark cloth, metres.
        dark_holes: share of missing dark pixels.
        outline_holes: share of missing pixels within 2 pixels of an outline.
        corner_holes: share of missing pixels in the corners of the image, where the lamp is weak.
        lit: distance from the image's centre, in halves of its sides, up to which the lamp is strong enough.
        flying: share of the pixels beside an outline that lie between foreground and background.
        jump: least depth difference between neighbours across an outline, metres.
        multipath: positive bias of the depth of a surface in the corner above the floor, metres.
        multipath_height: height above the floor in which this bias falls to 1/e, metres.
        step: resolution of the depth, metres.
        farthest: largest measured distance, metres.
    """

    noise: float = 1.0
    grazing: float = 0.25
    dark: float = 2.0
    dark_bias: float = 0.006
    dark_holes: float = 0.1
    outline_holes: float = 0.37
    corner_holes: float = 0.9
    lit: float = 0.9
    flying: float = 0.3
    jump: float = 0.08
    multipath: float = 0.02
    multipath_height: float = 0.12
    step: float = 0.001
    farthest: float = 8.0


def measured(
    depth: SingleArray,
    view: DepthCamera,
    rng: np.random.Generator,
    errors: DepthErrors | None = None,
    *,
    dark: BoolArray | None = None,
    floor: Floor | None = None,
) -> NDArray[np.uint16]:
    """Simulate the sensor's depth image.

    Args:
        depth: (height, width) true distances along the optical axis, metres; 0 where empty.
        view: the camera.
        rng: for the errors.
        errors: sizes of the errors.
        dark: (height, width) mask of dark cloth.
        floor: for multipath; None for no multipath.

    Returns:
        (height, width) millimetres, 0 where missing, as ``16UC1``.

    Raises:
        DepthError: another size than the camera's.
    """
    view.check(depth)
    own = DepthErrors() if errors is None else errors
    shape, dark = depth.shape, np.zeros(depth.shape, np.bool_) if dark is None else dark
    true = depth.astype(np.float64)
    there = (true > 0.0) & (true < own.farthest)
    empty = np.where(there, true, own.farthest)
    block = np.ones((3, 3), np.uint8)
    near, far = (np.asarray(of(empty, block)) for of in (cv2.erode, cv2.dilate))
    # depth changes by up to 2 * 5.7 pixel widths across a 3 x 3 block of a surface at 80 degrees
    edge = far - near > np.maximum(own.jump, 2.0 * 5.7 / view.camera.matrix[0, 0] * near)
    slope = np.where(edge, 0.0, _slopes(np.log(empty), view.rays, *np.diagonal(view.camera.matrix)[:2]))
    sigma = own.noise * axial_noise(true) * (1.0 + own.grazing * slope) * np.where(dark, own.dark, 1.0)
    seen = true + own.dark_bias * dark + sigma * rng.standard_normal(shape)
    if floor is not None:
        above = np.maximum(true * (view.rays @ floor.up[:2] + floor.up[2]) + floor.height, 0.0)
        # light from the floor reaches surfaces above it, not the floor itself
        seen += own.multipath * np.exp(-above / own.multipath_height) * (above > 0.02)
    flies = edge & there & (rng.random(shape) < own.flying) & (far < own.farthest)
    seen = np.where(flies, near + rng.random(shape) * (far - near), seen)
    # holes are patches of neighbouring pixels: a smoothed standard normal field is thresholded
    patches = gaussian_filter(rng.standard_normal(shape), 1.0)
    patches /= patches.std()
    missing = (cv2.dilate(edge.astype(np.uint8), block) > 0) & (patches < ndtri(own.outline_holes))
    missing |= dark & (patches > ndtri(1.0 - own.dark_holes))
    across, down = (np.square(np.linspace(-1.0, 1.0, count)) for count in reversed(shape))
    weak = np.clip((np.sqrt(down[:, None] + across) - own.lit) / 0.35, 0.0, 1.0)
    corners = np.nonzero(weak)
    missing[corners] |= patches[corners] > ndtri(1.0 - own.corner_holes * weak[corners])
    # beyond 85 degrees hardly any light returns
    missing |= slope > 11.0
    seen = np.where(there & ~missing, seen, 0.0)
    return np.round(np.clip(seen / own.step, 0.0, 65535.0)).astype(np.uint16)


@compiled
def _slopes(logs: FloatArray, rays: SingleArray, fx: float, fy: float) -> FloatArray:
    """(height, width) tangent of the angle between a surface's normal and the ray, by the image gradient of ln z.

    With z(x, y) over image coordinates x = X/Z, y = Y/Z the normal is along (-dz/dx, -dz/dy, z + x dz/dx + y dz/dy).

    Args:
        logs: (height, width) of the distances.
        rays: (height, width, 2) x and y; where they are NaN, the result is 0, as for a surface facing the camera.
        fx: focal length, pixels, with ``fy``.
        fy: see ``fx``.
    """
    rows, columns = logs.shape
    found = np.zeros((rows, columns))
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            x, y = float(rays[i, j, 0]), float(rays[i, j, 1])
            gx = fx * (logs[i, right] - logs[i, left]) / (right - left)
            gy = fy * (logs[below, j] - logs[above, j]) / (below - above)
            forward = 1.0 + x * gx + y * gy
            # the normal times the ray is 1
            cosine = 1.0 / np.sqrt((gx * gx + gy * gy + forward * forward) * (x * x + y * y + 1.0))
            if cosine == cosine:
                cosine = min(max(cosine, 1e-3), 1.0)
                found[i, j] = np.sqrt(1.0 - cosine * cosine) / cosine
    return found
