"""Mesh decimation by quadric errors: edges are contracted to one of their ends, the cheapest first.

Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997. The remaining vertex keeps
its place, so that the original's blend shapes and skinning weights stay exact at the remaining vertices.
"""

from __future__ import annotations

import heapq

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray

_LENGTH_COST = 1e-3
"""Weight of a squared edge length against the squared distance from planes; keeps triangles in flat regions similar."""


def decimate(vertices: FloatArray, faces: IntArray, wanted: int) -> IntArray:
    """Decimated faces (M, 3) that refer to at most ``wanted`` vertices, by their original numbers (Jatesiktat 2018,
    figure 1 and section II-B: to 1000 vertices).

    Args:
        vertices: (N, 3).
        faces: (F, 3) triangles.
        wanted: number of vertices to keep; more remain where no edge can be contracted without damage to the surface.
    """
    around: list[set[int]] = [set() for _ in vertices]
    corners = [list(map(int, face)) for face in faces]
    for number, face in enumerate(corners):
        for v in face:
            around[v].add(number)
    planes = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    areas = np.linalg.norm(planes, axis=1)
    planes /= np.maximum(areas, 1e-12)[:, None]
    planes = np.column_stack([planes, -(planes * vertices[faces[:, 0]]).sum(axis=1)])
    quadrics = np.zeros((len(vertices), 4, 4))
    for c in range(3):
        np.add.at(quadrics, faces[:, c], areas[:, None, None] * planes[:, :, None] * planes[:, None, :])
    weights = np.zeros(len(vertices))
    for c in range(3):
        np.add.at(weights, faces[:, c], areas)
    version = [0] * len(vertices)
    heap: list[tuple[float, int, int, int, int]] = []

    def neighbours(v: int) -> set[int]:
        return {u for number in around[v] for u in corners[number]} - {v}

    def push(gone: int, kept: int) -> None:
        at = np.append(vertices[kept], 1.0)
        step = vertices[gone] - vertices[kept]
        cost = float(at @ (quadrics[gone] + quadrics[kept]) @ at)
        cost += _LENGTH_COST * float(step @ step) * (weights[gone] + weights[kept])
        heapq.heappush(heap, (cost, gone, kept, version[gone], version[kept]))

    def flips(gone: int, kept: int) -> bool:
        for number in around[gone]:
            face = corners[number]
            if kept in face:
                continue
            old = vertices[face]
            new = vertices[[kept if v == gone else v for v in face]]
            before = np.cross(old[1] - old[0], old[2] - old[0])
            after = np.cross(new[1] - new[0], new[2] - new[0])
            if before @ after < 0.2 * np.linalg.norm(before) * np.linalg.norm(after):
                return True
        return False

    left = sum(1 for each in around if each)
    progress = True
    # a rejected edge may become valid once its neighbours are contracted, so all edges are tried again
    while left > wanted and progress:
        progress = False
        heap.clear()
        for v in range(len(vertices)):
            for u in neighbours(v):
                push(v, u)
        while left > wanted and heap:
            _, gone, kept, old_gone, old_kept = heapq.heappop(heap)
            if not (around[gone] and around[kept]) or (version[gone], version[kept]) != (old_gone, old_kept):
                continue
            shared = around[gone] & around[kept]
            # the surface stays a manifold if the ends have no other common neighbours than the vanishing faces' corners
            if len(neighbours(gone) & neighbours(kept)) != len(shared) or flips(gone, kept):
                continue
            for number in shared:
                for v in corners[number]:
                    around[v].discard(number)
            for number in around[gone]:
                corners[number] = [kept if v == gone else v for v in corners[number]]
                around[kept].add(number)
            around[gone] = set()
            quadrics[kept] += quadrics[gone]
            weights[kept] += weights[gone]
            left -= 1
            progress = True
            version[kept] += 1
            for u in neighbours(kept):
                push(kept, u)
                push(u, kept)
    used = sorted({number for each in around for number in each})
    return np.array([corners[number] for number in used], dtype=np.intp)
