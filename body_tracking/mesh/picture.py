"""Overlay of the fitted mesh on its depth image: shaded over grey, or its outline over false colours."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.raster import render

_NEAR, _FAR = 0.5, 5.0
"""Metres: range of the colour scale, from white to black or from red to blue."""
_SKIN: Final = np.array([255.0, 170.0, 90.0])
"""Red, green, blue of the mesh where it faces the camera."""
_OPAQUE: Final = 0.6
_MISSING: Final = (30, 30, 30)
"""Red, green, blue of missing depth, in false colours."""
_OUTLINE: Final = (255, 255, 255)


def overlay(depth: SingleArray, corners: FloatArray, camera: Camera) -> NDArray[np.uint8]:
    """The mesh, transparent and shaded, over the depth image in grey.

    Args:
        depth: (height, width) metres, 0 where missing, drawn dark blue.
        corners: (F, 3, 3) triangles, metres in the camera's optical frame.
        camera: the image's camera.

    Returns:
        (height, width, 3) red, green, blue.
    """
    if len(corners) == 0:
        corners = np.zeros((1, 3, 3))  # a degenerate triangle at the camera, which is not drawn
    grey = 255.0 * np.clip((_FAR - depth) / (_FAR - _NEAR), 0.0, 1.0)
    image = np.where((depth > 0.0)[..., None], grey[..., None], [20.0, 20.0, 60.0])
    seen = _seen(corners, camera)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    sizes = np.linalg.norm(normals, axis=1) * np.linalg.norm(centres, axis=1)
    shades = 0.3 + 0.7 * np.abs((normals * centres).sum(axis=1)) / np.maximum(sizes, 1e-12)
    on = seen >= 0
    image[on] = (1.0 - _OPAQUE) * image[on] + _OPAQUE * shades[seen[on], None] * _SKIN
    return np.asarray(image, dtype=np.uint8)


def outlined(depth: SingleArray, corners: FloatArray, camera: Camera | None, width: int) -> NDArray[np.uint8]:
    """The depth image in false colours, red near and blue far, with the outline of the mesh.

    Args:
        depth: (height, width) metres, 0 where missing, drawn dark.
        corners: (F, 3, 3) triangles, metres in the camera's optical frame; none for the bare image.
        camera: the image's camera; None if its calibration is unknown, for the bare image.
        width: of the result, pixels.

    Returns:
        (height, width, 3) red, green, blue; the aspect ratio is kept.
    """
    nearness = np.asarray(255.0 * np.clip((_FAR - depth) / (_FAR - _NEAR), 0.0, 1.0), np.uint8)
    image = cv2.applyColorMap(nearness, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    image[depth <= 0.0] = _MISSING
    factor = width / depth.shape[1]
    size = width, max(1, round(factor * depth.shape[0]))
    image = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)
    if camera is not None and len(corners) and depth.shape == (camera.height, camera.width):
        silhouette = (_seen(corners, camera) >= 0).astype(np.uint8)
        enlarged = cv2.resize(silhouette, size, interpolation=cv2.INTER_NEAREST)
        outlines, _ = cv2.findContours(enlarged, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outlines, -1, _OUTLINE, 2, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def _seen(corners: FloatArray, camera: Camera) -> NDArray[np.int32]:
    """(height, width) index of the visible triangle; -1 for none."""
    return render(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), camera).faces
