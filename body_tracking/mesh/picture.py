"""The fitted mesh over the depth image that it was fitted to."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.raster import render

_NEAR, _FAR = 0.5, 5.0
"""Metres between which the image goes from white to black."""
_SKIN: Final = np.array([255.0, 170.0, 90.0])
"""Red, green, blue of the mesh where it faces the camera."""
_OPAQUE: Final = 0.6


def overlay(depth: SingleArray, corners: FloatArray, camera: Camera) -> NDArray[np.uint8]:
    """The mesh, transparent and shaded, over the depth image in grey.

    Args:
        depth: (height, width) metres, 0 where missing, which is drawn dark blue.
        corners: (F, 3, 3) triangles, metres in the camera's optical frame.
        camera: whose image it is.

    Returns:
        (height, width, 3) red, green, blue.
    """
    if len(corners) == 0:
        corners = np.zeros((1, 3, 3))  # behind the camera: nothing of it is drawn
    grey = 255.0 * np.clip((_FAR - depth) / (_FAR - _NEAR), 0.0, 1.0)
    image = np.where((depth > 0.0)[..., None], grey[..., None], [20.0, 20.0, 60.0])
    count = len(corners)
    seen = render(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), camera).faces
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    sizes = np.linalg.norm(normals, axis=1) * np.linalg.norm(centres, axis=1)
    shades = 0.3 + 0.7 * np.abs((normals * centres).sum(axis=1)) / np.maximum(sizes, 1e-12)
    on = seen >= 0
    image[on] = (1.0 - _OPAQUE) * image[on] + _OPAQUE * shades[seen[on], None] * _SKIN
    return np.asarray(image, dtype=np.uint8)
