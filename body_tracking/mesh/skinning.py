"""Linear blend skinning and its analytic derivative.

A pose is a rotation per joint relative to its parent, and a translation. A small rotation v is applied on the right,
``R_j exp(v)``, as everywhere in the project. The derivative of a surface point x by a rotation w of joint j about the
camera's axes is ``w x S_j(x)``, ``S_j = sum over the joints k below j of w_k (x_k - p_j)``, w_k the skinning weight and
x_k the position of the point if rigidly attached to bone k, p_j the joint's position. Loper et al., "SMPL: a skinned
multi-person linear model" (2015), eq. 2-4.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray


@compiled
def forward_kinematics(
    parents: IntArray, joints: FloatArray, rotations: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Orientations (J, 3, 3) and positions (J, 3) of the joints, metres.

    Args:
        parents: (J,) index of each joint's parent, which comes before it; -1 for the first.
        joints: (J, 3) metres, at rest.
        rotations: (J, 3, 3) relative to the parent.
        translation: (3,) metres: displacement of the first joint from its position at rest.
    """
    count = len(parents)
    turned = np.empty((count, 3, 3))
    placed = np.empty((count, 3))
    turned[0] = rotations[0]
    placed[0] = joints[0] + translation
    for j in range(1, count):
        p = parents[j]
        for a in range(3):
            offset = 0.0
            for c in range(3):
                offset += turned[p, a, c] * (joints[j, c] - joints[p, c])
                turned[j, a, c] = (
                    turned[p, a, 0] * rotations[j, 0, c]
                    + turned[p, a, 1] * rotations[j, 1, c]
                    + turned[p, a, 2] * rotations[j, 2, c]
                )
            placed[j, a] = placed[p, a] + offset
    return turned, placed


@compiled
def skin(
    vertices: FloatArray,
    bones: IntArray,
    weights: FloatArray,
    joints: FloatArray,
    turned: FloatArray,
    placed: FloatArray,
) -> FloatArray:
    """Posed vertices (N, 3), metres.

    Args:
        vertices: (N, 3) at rest.
        bones: (N, K) joints that move each vertex.
        weights: (N, K) their weights, 0 in unused columns.
        joints: (J, 3) at rest.
        turned: (J, 3, 3) from :func:`forward_kinematics`.
        placed: (J, 3) from :func:`forward_kinematics`.
    """
    posed = np.zeros_like(vertices)
    for n in range(len(vertices)):
        for i in range(bones.shape[1]):
            w = weights[n, i]
            if w == 0.0:
                continue
            k = bones[n, i]
            x, y, z = vertices[n, 0] - joints[k, 0], vertices[n, 1] - joints[k, 1], vertices[n, 2] - joints[k, 2]
            for a in range(3):
                posed[n, a] += w * (turned[k, a, 0] * x + turned[k, a, 1] * y + turned[k, a, 2] * z + placed[k, a])
    return posed


@compiled
def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals (N, 3): area-weighted mean of the adjacent faces' normals; zero without faces."""
    normals = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for v in (a, b, c):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for n in range(len(normals)):
        size = np.sqrt(normals[n, 0] ** 2 + normals[n, 1] ** 2 + normals[n, 2] ** 2)
        if size > 0.0:
            normals[n] /= size
    return normals


@compiled
def lever_arms(
    corners: IntArray,
    shares: FloatArray,
    vertices: FloatArray,
    bones: IntArray,
    weights: FloatArray,
    parents: IntArray,
    joints: FloatArray,
    turned: FloatArray,
    placed: FloatArray,
) -> FloatArray:
    """(P, J, 3) metres: S_j of points on the surface, zero where joint j does not move the point.

    Args:
        corners: (P, C) vertices that define each point.
        shares: (P, C) their barycentric coordinates.
        vertices: (N, 3) at rest.
        bones: (N, K), with ``weights`` (N, K), as in :func:`skin`.
        weights: see ``bones``.
        parents: (J,).
        joints: (J, 3) at rest.
        turned: (J, 3, 3) from :func:`forward_kinematics`.
        placed: (J, 3) from :func:`forward_kinematics`.
    """
    arms = np.zeros((len(corners), len(parents), 3))
    for n in range(len(corners)):
        for c in range(corners.shape[1]):
            v = corners[n, c]
            for i in range(bones.shape[1]):
                w = weights[v, i] * shares[n, c]
                if w == 0.0:
                    continue
                k = bones[v, i]
                x, y, z = vertices[v, 0] - joints[k, 0], vertices[v, 1] - joints[k, 1], vertices[v, 2] - joints[k, 2]
                px = turned[k, 0, 0] * x + turned[k, 0, 1] * y + turned[k, 0, 2] * z + placed[k, 0]
                py = turned[k, 1, 0] * x + turned[k, 1, 1] * y + turned[k, 1, 2] * z + placed[k, 1]
                pz = turned[k, 2, 0] * x + turned[k, 2, 1] * y + turned[k, 2, 2] * z + placed[k, 2]
                j = k
                while j >= 0:
                    arms[n, j, 0] += w * (px - placed[j, 0])
                    arms[n, j, 1] += w * (py - placed[j, 1])
                    arms[n, j, 2] += w * (pz - placed[j, 2])
                    j = parents[j]
    return arms
