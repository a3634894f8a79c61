"""Points that move over the surface of a posed mesh, as correspondences that are variables of a fit.

Jatesiktat, Anopas and Ang (2018): parameterisation (eq. 1-3), mesh walk (section II-I) and discrete update (eq. 17;
section II-J). A point is a face and two barycentric coordinates u and v; the third one is w = 1 - u - v.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray

_MOST_FACES = 50
"""Largest number of faces crossed in one walk; the body's faces are 3 cm wide."""


class SurfacePoints(NamedTuple):
    """Points on a mesh (Jatesiktat 2018, eq. 1).

    Attributes:
        faces: (n,) face indices.
        shares: (n, 2) u and v, of the first and the second corner.
    """

    faces: IntArray
    shares: FloatArray

    def weights(self) -> FloatArray:
        """(n, 3) u, v and w."""
        return np.concatenate([self.shares, 1.0 - self.shares.sum(axis=1, keepdims=True)], axis=1)

    def places(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """(n, 3) positions, metres (Jatesiktat 2018, eq. 2), on vertices (N, 3) and faces (F, 3)."""
        return np.asarray(np.einsum("nc,nca->na", self.weights(), vertices[faces[self.faces]]))

    def normals(self, vertex_normals: FloatArray, faces: IntArray) -> FloatArray:
        """(n, 3) unit normals (Jatesiktat 2018, eq. 3) from the vertices' normals (N, 3) and faces (F, 3)."""
        found = np.einsum("nc,nca->na", self.weights(), vertex_normals[faces[self.faces]])
        return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))


def neighbours(faces: IntArray) -> IntArray:
    """(F, 3) the face across the edge opposite to each corner of faces (F, 3); -1 where the mesh ends."""
    count = len(faces)
    edges = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1).reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = np.flatnonzero((edges[order][1:] == edges[order][:-1]).all(axis=1))
    found = np.full(3 * count, -1, dtype=np.intp)
    one, other = order[same], order[same + 1]
    found[one], found[other] = other // 3, one // 3
    return found.reshape(count, 3)


def random_points(
    vertices: FloatArray, faces: IntArray, density: FloatArray, count: int, rng: np.random.Generator
) -> SurfacePoints:
    """Random candidates (Jatesiktat 2018, section II-J), denser where ``density`` (F,) is greater."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * density
    chosen = rng.choice(len(faces), size=count, p=area / area.sum())
    return SurfacePoints(chosen.astype(np.intp), rng.dirichlet([1.0, 1.0, 1.0], size=count)[:, :2])


@compiled
def walk(
    faces: IntArray, across: IntArray, vertices: FloatArray, at: IntArray, shares: FloatArray, steps: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Move points over the mesh (Jatesiktat 2018, section II-I).

    A step that leaves its face continues in the next one, in the direction it has when both are unfolded into one
    plane. It ends at the mesh's border.

    Args:
        faces: (F, 3).
        across: (F, 3) from :func:`neighbours`.
        vertices: (N, 3) posed.
        at: (n,) faces of the points.
        shares: (n, 2) u and v of the points.
        steps: (n, 2) changes of u and v in the first face.

    Returns:
        (n,) faces and (n, 2) u and v.
    """
    moved_at, moved = at.copy(), shares.copy()
    b, rate, vector = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(at)):
        f = at[n]
        b[0], b[1], b[2] = shares[n, 0], shares[n, 1], 1.0 - shares[n, 0] - shares[n, 1]
        rate[0], rate[1], rate[2] = steps[n, 0], steps[n, 1], -steps[n, 0] - steps[n, 1]
        for _ in range(_MOST_FACES):
            share, side = 1.0, -1
            for k in range(3):
                if rate[k] < 0.0 and b[k] + share * rate[k] < 0.0:
                    share, side = max(b[k], 0.0) / -rate[k], k
            for k in range(3):
                b[k] += share * rate[k]
            if side < 0:
                break
            b[side] = 0.0
            g = across[f, side]
            if g < 0:
                break
            p, q = faces[f, (side + 1) % 3], faces[f, (side + 2) % 3]
            length = size = along = 0.0
            for a in range(3):
                vector[a] = 0.0
                for k in range(3):
                    vector[a] += (1.0 - share) * rate[k] * vertices[faces[f, k], a]
                edge = vertices[q, a] - vertices[p, a]
                length += edge * edge
                size += vector[a] * vector[a]
                along += vector[a] * edge
            # the rest's component along the edge, as a share of the edge, and perpendicular to it, metres
            onward = along / length
            inward = np.sqrt(max(size - along * along / length, 0.0))
            third = 0
            for k in range(3):
                if faces[g, k] != p and faces[g, k] != q:
                    third = k
            # height of the third corner over the edge, and position of its foot as a share of the edge
            foot = reach = 0.0
            for a in range(3):
                rise = vertices[faces[g, third], a] - vertices[p, a]
                foot += rise * (vertices[q, a] - vertices[p, a]) / length
                reach += rise * rise
            height = np.sqrt(max(reach - foot * foot * length, 1e-18))
            towards = inward / height
            at_p, at_q = b[(side + 1) % 3], b[(side + 2) % 3]
            for k in range(3):
                if k == third:
                    b[k], rate[k] = 0.0, towards
                elif faces[g, k] == p:
                    b[k], rate[k] = at_p, -onward - towards * (1.0 - foot)
                else:
                    b[k], rate[k] = at_q, onward - towards * foot
            f = g
        moved_at[n] = f
        total = b[0] + b[1] + b[2]
        moved[n, 0], moved[n, 1] = b[0] / total, b[1] / total
    return moved_at, moved


@compiled
def rematched(
    faces: IntArray,
    across: IntArray,
    vertices: FloatArray,
    vertex_normals: FloatArray,
    points: FloatArray,
    normals: FloatArray,
    at: IntArray,
    shares: FloatArray,
    candidates_at: IntArray,
    candidates: FloatArray,
    per_metre: float,
    per_normal: float,
) -> tuple[IntArray, FloatArray]:
    """Best of each correspondence and all candidates (Jatesiktat 2018, eq. 17), then repeatedly of the centroids of the
    adjacent faces until none is better (section II-J).

    Args:
        faces: (F, 3).
        across: (F, 3) of :func:`neighbours`.
        vertices: (N, 3) posed.
        vertex_normals: (N, 3).
        points: (n, 3) measured.
        normals: (n, 3) measured.
        at: (n,) faces of the correspondences.
        shares: (n, 2) u and v of the correspondences.
        candidates_at: (m,) faces of the candidates.
        candidates: (m, 2) u and v of the candidates.
        per_metre: inverse standard deviation of positions, 1/m.
        per_normal: inverse standard deviation of unit normals.

    Returns:
        (n,) faces and (n, 2) u and v.
    """
    count = len(candidates_at)
    own = np.empty((count, 6))
    for m in range(count):
        _described(faces, vertices, vertex_normals, candidates_at[m], candidates[m, 0], candidates[m, 1], own[m])
    moved_at, moved = at.copy(), shares.copy()
    here = np.empty(6)
    for n in range(len(at)):
        _described(faces, vertices, vertex_normals, at[n], shares[n, 0], shares[n, 1], here)
        least = _cost(here, points[n], normals[n], per_metre, per_normal)
        best = -1
        for m in range(count):
            cost = _cost(own[m], points[n], normals[n], per_metre, per_normal)
            if cost < least:
                least, best = cost, m
        if best >= 0:
            moved_at[n], moved[n, 0], moved[n, 1] = candidates_at[best], candidates[best, 0], candidates[best, 1]
        better = True
        while better:
            better, f = False, moved_at[n]
            for k in range(3):
                g = across[f, k]
                if g < 0:
                    continue
                _described(faces, vertices, vertex_normals, g, 1.0 / 3.0, 1.0 / 3.0, here)
                cost = _cost(here, points[n], normals[n], per_metre, per_normal)
                if cost < least:
                    least, better = cost, True
                    moved_at[n], moved[n, 0], moved[n, 1] = g, 1.0 / 3.0, 1.0 / 3.0
    return moved_at, moved


@compiled
def _described(
    faces: IntArray, vertices: FloatArray, vertex_normals: FloatArray, f: int, u: float, v: float, found: FloatArray
) -> None:
    """Write position and unit normal of a point into ``found`` (6,)."""
    size = 0.0
    for a in range(3):
        found[a] = found[3 + a] = 0.0
        for k in range(3):
            share = u if k == 0 else v if k == 1 else 1.0 - u - v
            found[a] += share * vertices[faces[f, k], a]
            found[3 + a] += share * vertex_normals[faces[f, k], a]
        size += found[3 + a] ** 2
    for a in range(3):
        found[3 + a] /= np.sqrt(size) + 1e-12


@compiled
def _cost(here: FloatArray, point: FloatArray, normal: FloatArray, per_metre: float, per_normal: float) -> float:
    """Squared distances of positions and normals, in standard deviations."""
    cost = 0.0
    for a in range(3):
        cost += ((here[a] - point[a]) * per_metre) ** 2 + ((here[3 + a] - normal[a]) * per_normal) ** 2
    return cost
