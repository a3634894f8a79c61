"""The pruned depth-first search of Gaschler 2011, section 3.3.2: the baseline of :mod:`.recognition`.

As published: one threshold of 5 mm for all distances, whatever the noise of a point; an incomplete search of 30 edges;
one target at a time; no pose from fewer than four balls; no test whether a second place fits as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.pose import umeyama

THRESHOLD: Final = 0.005
"""Average distance between points and target, metres, above which a matching is rejected."""
QUEUE: Final = 30
"""Number of edge correspondences tried."""
_PENALTY: Final = 1.5
_FEWEST: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Matching:
    """A target among points.

    Attributes:
        assignment: (k,) index of the point of each ball, -1 for a ball without one.
        rotation: (3, 3) and
        translation: (3,) metres: a point x of the target is at ``rotation @ x + translation``.
        distance: average distance between the matched points and the target, metres.
        cost: of eq. 3.13.
    """

    assignment: IntArray
    rotation: FloatArray
    translation: FloatArray
    distance: float
    cost: float


def gaschler_depth_first(
    target: FloatArray, points: FloatArray, threshold: float = THRESHOLD, queue: int = QUEUE
) -> Matching | None:
    """The matching of least cost (eq. 3.13) that the search finds.

    Gaschler (2011): eq. 3.13-3.14; figure 3.5; section 3.3.2.

    Args:
        target: (k, 3) metres.
        points: (n, 3) metres, in no order.
        threshold: metres.
        queue: number of edge correspondences.

    Returns:
        None if fewer than four balls are found.
    """
    return _Search(target, points, threshold).best(queue)


class _Search:
    """One search; the threshold shrinks to the distance of the best complete matching."""

    def __init__(self, target: FloatArray, points: FloatArray, threshold: float) -> None:
        self._target = target
        self._points = points
        self._threshold = threshold
        self._best: Matching | None = None
        self._known: set[frozenset[tuple[int, int]]] = set()

    def best(self, queue: int) -> Matching | None:
        if len(self._points) < 2:
            return None
        own = np.array(list(combinations(range(len(self._target)), 2)))
        measured = np.array(list(combinations(range(len(self._points)), 2)))
        lengths = np.linalg.norm(self._target[own[:, 0]] - self._target[own[:, 1]], axis=1)
        distances = np.linalg.norm(self._points[measured[:, 0]] - self._points[measured[:, 1]], axis=1)
        # fitting two points to two points leaves each off by half the difference of the lengths
        off = 0.5 * np.abs(lengths[:, None] - distances)
        for place in np.argsort(off, axis=None)[:queue]:
            edge, pair = divmod(int(place), len(measured))
            if off[edge, pair] > self._threshold:
                break
            (i, j), (p, q) = own[edge].tolist(), measured[pair].tolist()
            self._extend({i: p, j: q})
            self._extend({i: q, j: p})
        return self._best

    def _extend(self, matches: dict[int, int]) -> None:
        key = frozenset(matches.items())
        if key in self._known:
            return
        self._known.add(key)
        for ball, point in self._inliers(matches):
            larger = {**matches, ball: point}
            if self._evaluate(larger) <= self._threshold:
                self._extend(larger)

    def _inliers(self, matches: dict[int, int]) -> list[tuple[int, int]]:
        """Further matches consistent with the present ones, the nearest first."""
        balls = [ball for ball in range(len(self._target)) if ball not in matches]
        seen, chosen = list(matches), list(matches.values())
        if len(matches) < 3:
            # no rotation yet: compare the distances to both ends of the edge
            wanted = np.linalg.norm(self._target[balls][:, None] - self._target[seen], axis=2)
            measured = np.linalg.norm(self._points[:, None] - self._points[chosen], axis=2)
            off = 0.5 * np.abs(wanted[:, None] - measured).max(axis=2)
        else:
            rotation, translation = self._fit(matches)
            off = np.linalg.norm((self._target[balls] @ rotation.T + translation)[:, None] - self._points, axis=2) / (
                len(matches) + 1
            )
        off[:, chosen] = np.inf
        rows, columns = np.nonzero(off <= self._threshold)
        order = np.argsort(off[rows, columns])
        return [(balls[rows[place]], int(columns[place])) for place in order]

    def _fit(self, matches: dict[int, int]) -> tuple[FloatArray, FloatArray]:
        model, measured = self._target[list(matches)], self._points[list(matches.values())]
        rotation, translation = umeyama(model[None], measured[None], np.ones((1, len(model))))
        return rotation[0], translation[0]

    def _evaluate(self, matches: dict[int, int]) -> float:
        """Average distance of a matching of three or more balls; keeps the matching if it is the best so far."""
        rotation, translation = self._fit(matches)
        model, measured = self._target[list(matches)], self._points[list(matches.values())]
        off = np.linalg.norm(measured - model @ rotation.T - translation, axis=1)
        count, distance = len(matches), float(off.mean())
        if count >= _FEWEST and distance <= self._threshold:
            cost = float(np.linalg.norm(off)) * _PENALTY ** (len(self._target) - count) / count
            if self._best is None or cost < self._best.cost:
                assignment = np.full(len(self._target), -1)
                assignment[list(matches)] = list(matches.values())
                self._best = Matching(assignment, rotation, translation, distance, cost)
            if count == len(self._target):
                self._threshold = min(self._threshold, distance)
        return distance
