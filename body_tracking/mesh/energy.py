"""Energy terms of a pose: scalar residuals and their analytic Jacobians.

Jatesiktat, Anopas and Ang (2018), eq. 4: data (5), background (6), model in front of the measured surface (12), limits
(8) and inertial sensors (9-11). The data residual is the distance of a measured point from the tangent plane of the
nearest surface point that faces the same way. The inertial residual compares whole orientations, where the paper's
compares only the forearm's direction. All terms are sums of squares of ``(direction . x - target) / deviation`` of
points x on the body, or of angles.

A change of the pose has 6 + 3 (J - 1) numbers: a shift of the first joint, metres, then for every joint a rotation of
its segment about the axes of its anatomical frame, radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray
from body_tracking.mesh.depth import DepthCamera

QUARTER: Final = 4
"""Pixels of the depth image per pixel of the distance transform, along each axis."""
MARGIN: Final = 0.05
"""Metres in front of the measured surface, up to which a model point is tolerated: clothes and shape."""
GRAZING: Final = 0.3
"""Cosine between a surface's outward normal and the viewing ray, below which the surface counts as visible."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Observation of a person in one depth image.

    Attributes:
        points: (n, 3) metres in the camera's frame.
        normals: (n, 3) unit, towards the camera; zero where unknown.
        depth: (height, width) metres, 0 where missing.
        mask: (height, width) the person's pixels.
        outside: (height / 4, width / 4) distance to the person's nearest pixel, in pixels of the depth image; 0 on it.
        slope: (height / 4, width / 4, 2) change of ``outside`` per pixel to the right and down.
        camera: the image's camera.
    """

    points: FloatArray
    normals: FloatArray
    depth: SingleArray
    mask: BoolArray
    outside: SingleArray
    slope: SingleArray
    camera: Camera


def observe(camera: DepthCamera, depth: SingleArray, mask: BoolArray, count: int = 600) -> Observation:
    """Sample points and compute the silhouette's distance transform.

    Args:
        camera: the depth camera.
        depth: (height, width) metres, 0 where missing.
        mask: (height, width) the person's pixels.
        count: number of points to sample.

    Raises:
        DepthError: another size than the camera's.
    """
    cloud = camera.sample(depth, mask, count)
    height, width = (QUARTER * (n // QUARTER) for n in mask.shape)
    # the mean of a block is above 0 if any of its pixels is the person's
    whole = 255 * mask[:height, :width].astype(np.uint8)
    blocks = np.asarray(cv2.resize(whole, (width // QUARTER, height // QUARTER), interpolation=cv2.INTER_AREA)) > 0
    outside = QUARTER * cv2.distanceTransform(np.asarray(~blocks, dtype=np.uint8), cv2.DIST_L2, 3).astype(np.float32)
    down, right = np.gradient(outside / np.float32(QUARTER))
    return Observation(
        cloud.points,
        np.nan_to_num(cloud.normals),
        depth,
        mask,
        outside,
        np.stack([right, down], axis=-1).astype(np.float32),
        camera.camera,
    )


class Matches(NamedTuple):
    """Correspondences of measured points on the model's surface.

    Attributes:
        corners: (n, 3) vertices of the face.
        shares: (n, 3) barycentric coordinates.
        places: (n, 3) points on the surface.
        normals: (n, 3) unit normals there.
        agreements: (n,) cosine between the measured normal and the surface's.
    """

    corners: IntArray
    shares: FloatArray
    places: FloatArray
    normals: FloatArray
    agreements: FloatArray


class Pulls(NamedTuple):
    """Model points outside the silhouette or in front of the measured surface.

    Attributes:
        vertices: (m,) vertex indices.
        directions: (m, 3) gradient of the residual by the vertex.
        residuals: (m,) metres.
        kinds: (m,) 0 for background (6), 1 for in front of the measured surface (12).
    """

    vertices: IntArray
    directions: FloatArray
    residuals: FloatArray
    kinds: IntArray


def faces_around(faces: IntArray, vertices: int) -> tuple[IntArray, IntArray]:
    """Faces around each vertex: (N + 1,) start indices into (3 F,) face indices."""
    order = np.argsort(faces.ravel(), kind="stable")
    starts = np.searchsorted(faces.ravel()[order], np.arange(vertices + 1))
    return starts.astype(np.intp), (order // 3).astype(np.intp)


def match(
    points: FloatArray,
    normals: FloatArray,
    vertices: FloatArray,
    vertex_normals: FloatArray,
    faces: IntArray,
    starts: IntArray,
    around: IntArray,
    turn_cost: float,
) -> Matches:
    """Match each measured point with the nearest surface that faces the same way.

    Jatesiktat (2018), eq. 17 and section II-J.

    Args:
        points: (n, 3) measured.
        normals: (n, 3) measured; zero where unknown.
        vertices: (N, 3) posed.
        vertex_normals: (N, 3).
        faces: (F, 3).
        starts: (N + 1,), with ``around``, of :func:`faces_around`.
        around: see ``starts``.
        turn_cost: distance in metres equivalent to a difference of 1 between unit normals.
    """
    # surfaces that face away are invisible; the tolerance keeps grazing edges, because clothes are wider
    views = (vertices * vertex_normals).sum(axis=1)
    facing = np.flatnonzero(views < GRAZING * np.sqrt((vertices * vertices).sum(axis=1)))
    # |p - v|^2 + turn_cost^2 |n - m|^2 up to terms of the point alone: one matrix product for all pairs
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    seen = (vertices[facing] - middle).astype(np.float32)
    pairs = np.concatenate([seen, vertex_normals[facing].astype(np.float32)], axis=1)
    mine = np.concatenate([points - middle, turn_cost**2 * normals], axis=1).astype(np.float32)
    scores = mine @ pairs.T
    scores -= 0.5 * (seen * seen).sum(axis=1)
    nearest = facing[scores.argmax(axis=1)] if len(facing) else np.zeros(len(points), dtype=np.intp)
    return Matches(*_refined(points, normals, nearest, vertices, vertex_normals, faces, starts, around))


@compiled
def _refined(
    points: FloatArray,
    normals: FloatArray,
    nearest: IntArray,
    vertices: FloatArray,
    vertex_normals: FloatArray,
    faces: IntArray,
    starts: IntArray,
    around: IntArray,
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Nearest points on the faces around the nearest vertices (n,), as the fields of :class:`Matches`."""
    corners = np.zeros((len(points), 3), dtype=np.intp)
    shares = np.zeros((len(points), 3))
    places = np.zeros((len(points), 3))
    found = np.zeros((len(points), 3))
    agreements = np.zeros(len(points))
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        least = np.inf
        for i in range(starts[nearest[n]], starts[nearest[n] + 1]):
            a, b, c = faces[around[i], 0], faces[around[i], 1], faces[around[i], 2]
            u, v, w = _nearest_in_triangle(points[n], vertices[a], vertices[b], vertices[c])
            x = u * vertices[a, 0] + v * vertices[b, 0] + w * vertices[c, 0]
            y = u * vertices[a, 1] + v * vertices[b, 1] + w * vertices[c, 1]
            z = u * vertices[a, 2] + v * vertices[b, 2] + w * vertices[c, 2]
            distance = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2
            if distance < least:
                least = distance
                corners[n, 0], corners[n, 1], corners[n, 2] = a, b, c
                shares[n, 0], shares[n, 1], shares[n, 2] = u, v, w
                places[n, 0], places[n, 1], places[n, 2] = x, y, z
        size = 0.0
        for k in range(3):
            for i in range(3):
                found[n, k] += shares[n, i] * vertex_normals[corners[n, i], k]
            size += found[n, k] ** 2
        size = np.sqrt(size) + 1e-12
        for k in range(3):
            found[n, k] /= size
            agreements[n] += normals[n, k] * found[n, k]
    return corners, shares, places, found, agreements


@compiled
def _nearest_in_triangle(p: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> tuple[float, float, float]:
    """Barycentric coordinates of the nearest point. Ericson, "Real-time collision detection" (2005), section 5.1.5."""
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for i in range(3):
        ab, ac = b[i] - a[i], c[i] - a[i]
        d1 += ab * (p[i] - a[i])
        d2 += ac * (p[i] - a[i])
        d3 += ab * (p[i] - b[i])
        d4 += ac * (p[i] - b[i])
        d5 += ab * (p[i] - c[i])
        d6 += ac * (p[i] - c[i])
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    total = va + vb + vc
    return va / total, vb / total, vc / total


@compiled
def find_pulls(
    vertices: FloatArray,
    pixels: FloatArray,
    depth: SingleArray,
    mask: BoolArray,
    outside: SingleArray,
    slope: SingleArray,
    fx: float,
    fy: float,
    margin: float,
) -> Pulls:
    """Find vertices outside the silhouette, and vertices in front of the surface measured on the person.

    Jatesiktat (2018), eq. 6 and 12. Pixels without a measurement, and pixels where something nearer hides the model,
    give no residual.

    Args:
        vertices: (N, 3) posed.
        pixels: (N, 2) their projections; NaN behind the camera.
        depth: (height, width) of :class:`Observation`, as ``mask``, ``outside`` and ``slope``.
        mask: see ``depth``.
        outside: see ``depth``.
        slope: see ``depth``.
        fx: focal length, pixels, with ``fy``.
        fy: see ``fx``.
        margin: metres.
    """
    height, width = depth.shape
    numbers = np.empty(len(vertices), dtype=np.intp)
    directions = np.zeros((len(vertices), 3))
    residuals = np.empty(len(vertices))
    kinds = np.empty(len(vertices), dtype=np.intp)
    count = 0
    for v in range(len(vertices)):
        if not (pixels[v, 0] > -0.5 and pixels[v, 1] > -0.5):
            continue
        column, row = int(pixels[v, 0] + 0.5), int(pixels[v, 1] + 0.5)
        if column >= width or row >= height:
            continue
        measured = depth[row, column]
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        if measured <= 0.0 or measured - z < margin:
            continue
        i, j = min(row // 4, outside.shape[0] - 1), min(column // 4, outside.shape[1] - 1)
        numbers[count] = v
        if outside[i, j] > 0.0:
            sx, sy = slope[i, j, 0] * fx / z, slope[i, j, 1] * fy / z
            # pixels to metres at the vertex
            scale = 2.0 * z / (fx + fy)
            residuals[count] = outside[i, j] * scale
            directions[count, 0] = sx * scale
            directions[count, 1] = sy * scale
            directions[count, 2] = -(sx * x + sy * y) / z * scale
            kinds[count] = 0
        elif mask[row, column]:
            # moves the vertex behind the surface: the residual falls as z grows
            residuals[count] = measured - margin - z
            directions[count, 2] = -1.0
            kinds[count] = 1
        else:  # outside the mask, but within the distance transform's resolution
            continue
        count += 1
    return Pulls(numbers[:count], directions[:count], residuals[:count], kinds[:count])


@compiled
def behind_others(
    vertices: FloatArray, pixels: FloatArray, depth: SingleArray, mask: BoolArray, margin: float
) -> FloatArray:
    """(N,) 1 for vertices hidden behind a surface that is not the person's, else 0; arguments as in
    :func:`find_pulls`.
    """
    height, width = depth.shape
    found = np.zeros(len(vertices))
    for v in range(len(vertices)):
        if not (pixels[v, 0] > -0.5 and pixels[v, 1] > -0.5):
            continue
        column, row = int(pixels[v, 0] + 0.5), int(pixels[v, 1] + 0.5)
        if column < width and row < height and not mask[row, column]:
            found[v] = 0.0 < depth[row, column] < vertices[v, 2] - margin
    return found


@compiled
def accumulate(
    arms: FloatArray,
    frames: FloatArray,
    directions: FloatArray,
    residuals: FloatArray,
    weights: FloatArray,
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the normal equations of residuals of points on the body, in place.

    Args:
        arms: (n, J, 3) of :func:`body_tracking.mesh.skinning.lever_arms`.
        frames: (J, 3, 3) anatomical frames of the posed segments, columns in the camera's axes.
        directions: (n, 3) gradient of each residual by its point.
        residuals: (n,).
        weights: (n,) inverse variances.
        information: (3 + 3 J, 3 + 3 J) the sum of w j^T j; its lower triangle is filled.
        gradient: (3 + 3 J,) the sum of w j^T r.
    """
    joints = arms.shape[1]
    columns = np.empty(3 + 3 * joints, dtype=np.intp)
    row = np.empty(3 + 3 * joints)
    for n in range(len(arms)):
        w = weights[n]
        if w == 0.0:
            continue
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        row[0], row[1], row[2] = dx, dy, dz
        columns[0], columns[1], columns[2] = 0, 1, 2
        count = 3
        for j in range(joints):
            sx, sy, sz = arms[n, j, 0], arms[n, j, 1], arms[n, j, 2]
            if sx == 0.0 and sy == 0.0 and sz == 0.0:
                continue
            # d (w x s) = w (s x d)
            cx, cy, cz = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
            for a in range(3):
                row[count] = frames[j, 0, a] * cx + frames[j, 1, a] * cy + frames[j, 2, a] * cz
                columns[count] = 3 + 3 * j + a
                count += 1
        for a in range(count):
            scaled = w * row[a]
            gradient[columns[a]] += scaled * residuals[n]
            for b in range(a + 1):
                information[columns[a], columns[b]] += scaled * row[b]
