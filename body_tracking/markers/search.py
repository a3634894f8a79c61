"""Complete search for a target's balls among points by pairwise distances.

The distance between two measured points bounds the true one. Two balls may be at two points only if their distance lies
within these bounds; a target matches where all its visible balls are pairwise compatible (a clique; Pintaric and
Kaufmann 2007, Gaschler 2011, section 3.3). Sets of points are bits of integers, so that a search step is a few bitwise
ands.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.targets import Target

GATE: Final = 4.5
"""Standard deviations of the noise of a distance; 1.7e-4 of three-dimensional noise lies outside."""
MAX_PAIRS: Final = 60_000
"""Largest number of pairs of points within the reach of a target; more exceed a frame's time."""

_MOST_GROUPINGS: Final = 60

Relation = dict[int, int]
"""For one edge of a target: by the point of one ball, the points compatible with the other ball, as bits."""


class DeadlineError(Exception):
    """Raised when the search cannot finish in time."""


class Deadline:
    """A time limit."""

    def __init__(self, seconds: float | None) -> None:
        self._end = None if seconds is None else time.perf_counter() + seconds

    def check(self) -> None:
        """Raise :class:`DeadlineError` if the time is over."""
        if self._end is not None and time.perf_counter() > self._end:
            raise DeadlineError

    def remaining(self) -> float | None:
        """Remaining seconds, at least 0; None without a limit."""
        return None if self._end is None else max(self._end - time.perf_counter(), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of points and bounds of the true distances between them.

    Attributes:
        first: (p,) and
        second: (p,) index of the points.
        low: (p,) and
        high: (p,) metres.
    """

    first: IntArray
    second: IntArray
    low: FloatArray
    high: FloatArray


def near_pairs(positions: FloatArray, covariance: FloatArray, reach: float) -> Pairs:
    """All pairs of points whose true distance may be below ``reach``.

    The noise e of the difference v of two points lies in the ellipsoid of :data:`GATE` standard deviations. With u the
    direction of v and s the standard deviation along it, the true difference v - e is at least ``|v| - GATE s`` long,
    its component along u. It is at most the root of ``(|v| + GATE s)^2 + GATE^2 t`` long, t the variance across u: the
    second-order term exceeds the first for a short edge across the line of sight.

    Args:
        positions: (n, 3) metres.
        covariance: (n, 3, 3) of the positions.
        reach: metres.

    Raises:
        DeadlineError: more than :data:`MAX_PAIRS` pairs.
    """
    if len(positions) < 2:
        return Pairs(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))
    widest = GATE * float(np.sqrt(2.0 * np.trace(covariance, axis1=1, axis2=2).max()))
    tree = cKDTree(positions)
    if len(positions) ** 2 > 2 * MAX_PAIRS and tree.count_neighbors(tree, reach + widest) > 2 * MAX_PAIRS:
        raise DeadlineError
    first, second = tree.query_pairs(reach + widest, output_type="ndarray").T
    difference, noise = positions[first] - positions[second], covariance[first] + covariance[second]
    length = np.sqrt((difference**2).sum(axis=1))
    direction = difference / np.maximum(length, 1e-9)[:, None]
    along = (direction[:, None] @ noise @ direction[:, :, None])[:, 0, 0]
    across = np.maximum(np.trace(noise, axis1=1, axis2=2) - along, 0.0)
    width = GATE * np.sqrt(along)
    return Pairs(
        first.astype(np.int64),
        second.astype(np.int64),
        length - width,
        np.sqrt((length + width) ** 2 + GATE**2 * across),
    )


class Shape:
    """Distances of a target, prepared for the search.

    Attributes:
        balls: number of balls.
        distances: (e,) metres, of all pairs of balls in the order of :func:`itertools.combinations`.
        tolerance: (e,) metres, :data:`GATE` standard deviations of the distances by the target's own covariance.
        edge: (k, k) index of each pair of balls.
    """

    def __init__(self, target: Target) -> None:
        points = target.points
        self.balls = len(points)
        first, second = np.array(list(combinations(range(self.balls), 2)), dtype=np.int64).reshape(-1, 2).T
        difference = points[first] - points[second]
        self.distances: FloatArray = np.linalg.norm(difference, axis=1)
        blocks = target.covariance.reshape(self.balls, 3, self.balls, 3).swapaxes(1, 2)
        noise = blocks[first, first] + blocks[second, second] - blocks[first, second] - blocks[second, first]
        direction = difference / np.maximum(self.distances, 1e-9)[:, None]
        along = (direction[:, None] @ noise @ direction[:, :, None])[:, 0, 0]
        self.tolerance: FloatArray = GATE * np.sqrt(np.maximum(along, 0.0))
        edge = np.zeros((self.balls, self.balls), dtype=np.int64)
        edge[first, second] = edge[second, first] = np.arange(len(first))
        self.edge: list[list[int]] = edge.tolist()

    def relations(self, pairs: Pairs) -> list[Relation]:
        """For each edge, the pairs of points compatible with it."""
        wanted = self.distances[:, None]
        low, high = self.distances + self.tolerance, self.distances - self.tolerance
        fits = (pairs.low <= low[:, None]) & (pairs.high >= high[:, None])
        edges, chosen = np.nonzero(fits)
        relations: list[Relation] = [{} for _ in range(len(wanted))]
        for edge, first, second in zip(
            edges.tolist(), pairs.first[chosen].tolist(), pairs.second[chosen].tolist(), strict=True
        ):
            relation = relations[edge]
            relation[first] = relation.get(first, 0) | 1 << second
            relation[second] = relation.get(second, 0) | 1 << first
        return relations

    def assignments(
        self,
        relations: Sequence[Relation],
        fewest: int,
        deadline: Deadline,
        allowed: Sequence[int] | None = None,
    ) -> Iterator[tuple[int, ...]]:
        """All assignments of points to at least ``fewest`` balls with pairwise compatible distances.

        Includes the parts of an assignment with fewer balls. Some assignments occur twice.

        Args:
            relations: of the edges.
            fewest: 2 or more.
            deadline: checked in every step.
            allowed: for each ball its allowed points, as bits; None for all.

        Yields:
            For each ball its point, -1 if unseen.

        Raises:
            DeadlineError: the time is over.
        """
        edge = self.edge
        chosen = [-1] * self.balls

        def extend(rest: list[tuple[int, int]], found: int) -> Iterator[tuple[int, ...]]:
            deadline.check()
            if found + len(rest) < fewest:
                return
            if not rest:
                yield tuple(chosen)
                return
            (ball, points), others = rest[0], rest[1:]
            row = edge[ball]
            for point in bits(points):
                chosen[ball] = point
                left = []
                for other, candidates in others:
                    both = candidates & relations[row[other]].get(point, 0)
                    if both:
                        left.append((other, both))
                yield from extend(left, found + 1)
            chosen[ball] = -1
            yield from extend(others, found)

        counts = np.array([len(relation) for relation in relations])
        for i, j in self._bases(fewest, counts):
            row_i, row_j = edge[i], edge[j]
            others = [ball for ball in range(self.balls) if ball not in (i, j)]
            for first, seconds in relations[row_i[j]].items():
                if allowed is not None:
                    if not allowed[i] >> first & 1:
                        continue
                    seconds &= allowed[j]
                for second in bits(seconds):
                    rest = []
                    for ball in others:
                        points = relations[row_i[ball]].get(first, 0)
                        if points:
                            points &= relations[row_j[ball]].get(second, 0)
                            if allowed is not None:
                                points &= allowed[ball]
                            if points:
                                rest.append((ball, points))
                    if len(rest) + 2 >= fewest:
                        chosen[i], chosen[j] = first, second
                        yield from extend(rest, 2)
                        chosen[i] = chosen[j] = -1
                deadline.check()

    def _bases(self, fewest: int, counts: IntArray) -> list[tuple[int, int]]:
        """Edges such that any ``fewest`` balls contain one of them, chosen for the fewest candidates.

        With the balls in ``fewest - 1`` groups, two of ``fewest`` balls are in one group (pigeonhole principle).
        """
        best: list[tuple[int, int]] = []
        least = np.inf
        for edges in _groupings(self.balls, fewest - 1):
            cost = sum(int(counts[self.edge[i][j]]) for i, j in edges)
            if cost < least:
                best, least = edges, cost
        return best


def bits(number: int) -> Iterator[int]:
    """Indices of the set bits of a number."""
    while number:
        lowest = number & -number
        yield lowest.bit_length() - 1
        number ^= lowest


@lru_cache(maxsize=64)
def _groupings(balls: int, groups: int) -> list[list[tuple[int, int]]]:
    """Edges within the groups, for the partitions into groups of nearly equal sizes; at most ``_MOST_GROUPINGS``."""
    sizes = [balls // groups + (number < balls % groups) for number in range(groups)]
    results: list[list[tuple[int, int]]] = []

    def divide(rest: tuple[int, ...], sizes: list[int], edges: list[tuple[int, int]]) -> None:
        if len(results) == _MOST_GROUPINGS:
            return
        if not rest:
            results.append(edges)
            return
        for size in set(sizes):
            left = list(sizes)
            left.remove(size)
            for others in combinations(rest[1:], size - 1):
                group = (rest[0], *others)
                divide(tuple(ball for ball in rest if ball not in group), left, edges + list(combinations(group, 2)))

    divide(tuple(range(balls)), [size for size in sizes if size], [])
    return results
