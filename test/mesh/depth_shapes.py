"""Simple meshes, a camera, and depth images of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray


def camera(width: int = 128, height: int = 106, k1: float = 0.0) -> Camera:
    """A Kinect v2's view with fewer pixels."""
    focal = 365.0 * width / 512.0
    matrix = np.array([[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera("kinect1_optical_frame", width, height, matrix, np.array([k1, -k1, 0.0, 0.0, 0.0]))


def sphere(centre: FloatArray, radius: float, rings: int = 40) -> tuple[FloatArray, NDArray[np.int32]]:
    """Vertices and faces of a sphere by its parallels and meridians."""
    polar, around = np.meshgrid(np.linspace(0.0, np.pi, rings), np.linspace(0.0, 2.0 * np.pi, rings), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], axis=-1)
    corner = np.arange(rings * rings).reshape(rings, rings)
    a, b, c, d = (corner[i : rings - 1 + i, j : rings - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])
    return centre + radius * points.reshape(-1, 3), faces.astype(np.int32)


def plane(normal: FloatArray, distance: float, size: float = 20.0) -> tuple[FloatArray, NDArray[np.int32]]:
    """Two triangles of the plane ``normal . x = distance``, around its point on the optical axis."""
    unit = normal / np.linalg.norm(normal)
    u = np.cross(unit, [0.0, 1.0, 0.1])
    u /= np.linalg.norm(u)
    v, middle = np.cross(unit, u), np.array([0.0, 0.0, distance / unit[2]])
    corners = np.array([middle + size * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def ellipsoid(centre: FloatArray, radii: FloatArray, rings: int = 24) -> tuple[FloatArray, NDArray[np.int32]]:
    """Vertices and faces of an ellipsoid with its axes along those of the camera."""
    vertices, faces = sphere(np.zeros(3), 1.0, rings)
    return centre + radii * vertices, faces


def joined(*parts: tuple[FloatArray, NDArray[np.int32]]) -> tuple[FloatArray, NDArray[np.int32]]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = [each + start for (_, each), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces).astype(np.int32)


def dummy(x: float, z: float, floor: float = 1.0) -> tuple[FloatArray, NDArray[np.int32]]:
    """A person of ellipsoids, 1.7 m tall, who stands at (x, z) metres, with the arms held out."""
    parts = ((0, 1.58, 0.09, 0.12), (0, 1.15, 0.17, 0.32), (0.1, 0.45, 0.08, 0.45), (-0.1, 0.45, 0.08, 0.45))
    trunk = [ellipsoid(np.array([x + a, floor - h, z]), np.array([r, t, r])) for a, h, r, t in parts]
    arms = [ellipsoid(np.array([x + s * 0.4, floor - 1.35, z]), np.array([0.3, 0.05, 0.05])) for s in (-1, 1)]
    return joined(*trunk, *arms)


def room(floor: float = 1.0, wall: float = 3.5) -> tuple[FloatArray, NDArray[np.int32]]:
    """A floor ``floor`` metres below the camera, and a wall."""
    corners = [[x, floor, z] for z in (0.3, wall) for x in (-4.0, 4.0)]
    back = [[x, y, wall] for y in (floor, -3.0) for x in (-4.0, 4.0)]
    return np.array(corners + back), np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]], dtype=np.int32)
