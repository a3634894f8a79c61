"""A depth buffer: ideal depth image of a mesh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, SingleArray

FaceArray = NDArray[np.int32]


_BEYOND = 1.2
"""Factor on the image corners' tangent from the optical axis, up to which the distortion's polynomials are valid."""


class DepthBuffer(NamedTuple):
    """A rendered mesh.

    Attributes:
        depth: (height, width) float32 metres along the optical axis, 0 without a face.
        faces: (height, width) int32 index of the visible face; -1 for none.
    """

    depth: SingleArray
    faces: FaceArray


def render(vertices: FloatArray, faces: NDArray[np.integer], camera: Camera, scale: int = 1) -> DepthBuffer:
    """Render a mesh by a z-buffer, both sides of its faces.

    Lens distortion moves the vertices; the edges stay straight, which is exact enough for faces of centimetres. Faces
    with a vertex less than 1 cm in front of the camera are skipped, with distortion also faces with a vertex so far
    outside the image that the distortion is unknown there.

    Args:
        vertices: (n, 3) metres in the optical frame.
        faces: (m, 3) vertex indices.
        camera: the image's camera.
        scale: pixels of the camera per pixel of the buffer, along each axis; the centres of a buffer pixel and of its
            block of camera pixels coincide.
    """
    pixels = (camera.project(vertices) + 0.5) / scale - 0.5
    if camera.distortion.any():
        corners = np.array([[-0.5, -0.5], [camera.width, -0.5], [-0.5, camera.height], [camera.width, camera.height]])
        widest = _BEYOND * np.linalg.norm(camera.undistort(corners), axis=1).max()
        outside = np.linalg.norm(vertices[:, :2], axis=1) > widest * np.abs(vertices[:, 2])
        pixels[outside] = np.nan
    shape = camera.height // scale, camera.width // scale
    depth, seen = _fill(pixels, vertices[:, 2].copy(), np.ascontiguousarray(faces, dtype=np.int32), *shape)
    return DepthBuffer(depth, seen)


@compiled
def _fill(
    pixels: FloatArray, distances: FloatArray, faces: FaceArray, height: int, width: int
) -> tuple[SingleArray, FaceArray]:
    """Depth and visible faces; 1/z is linear in the image and interpolated by the signed areas opposite the
    vertices.
    """
    nearness = np.zeros((height, width), dtype=np.float64)
    seen = np.full((height, width), -1, dtype=np.int32)
    for k in range(len(faces)):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        # false for NaN too, the projection of a vertex behind the camera or beyond the distortion's range
        if not (distances[a] > 0.01 and distances[b] > 0.01 and distances[c] > 0.01):
            continue
        xa, ya, xb, yb, xc, yc = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if not abs(area) > 1e-12:
            continue
        left, right = max(np.ceil(min(xa, xb, xc)), 0.0), min(np.floor(max(xa, xb, xc)), width - 1.0)
        top, bottom = max(np.ceil(min(ya, yb, yc)), 0.0), min(np.floor(max(ya, yb, yc)), height - 1.0)
        wa, wb, wc = 1.0 / distances[a] / area, 1.0 / distances[b] / area, 1.0 / distances[c] / area
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                ea = (xb - column) * (yc - row) - (xc - column) * (yb - row)
                eb = (xc - column) * (ya - row) - (xa - column) * (yc - row)
                ec = area - ea - eb
                if ea * area < 0.0 or eb * area < 0.0 or ec * area < 0.0:
                    continue
                near = ea * wa + eb * wb + ec * wc
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    seen[row, column] = k
    depth = np.zeros((height, width), dtype=np.float32)
    for row in range(height):
        for column in range(width):
            if nearness[row, column] > 0.0:
                depth[row, column] = 1.0 / nearness[row, column]
    return depth, seen
