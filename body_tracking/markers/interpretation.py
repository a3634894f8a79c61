"""Selection among several interpretations of the points as targets, or the finding that they are ambiguous.

The cost of a candidate (assignment of points to a target's balls) is minus twice its log likelihood, up to a constant:
the squared Mahalanobis distance of its points, plus a fixed amount for each unseen ball. A point belongs to at most one
target, so targets that compete for points are judged together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from body_tracking.core import chi_square
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.observations import Points
from body_tracking.markers.pose import FEWEST, balls_covariance, maximum_likelihood
from body_tracking.markers.search import Deadline
from body_tracking.markers.targets import Target

HIDDEN_COST: Final = 20.0
"""Cost of an unseen ball: a point's squared Mahalanobis distance, 3 degrees of freedom, exceeds it with p = 1.7e-4."""
MARGIN: Final = 9.0
"""Least extra cost of a second interpretation: a likelihood ratio of 90."""
BELIEVED_MARGIN: Final = 40.0
"""Least extra cost of a second interpretation at another place with as many balls that chance does not explain: rarely
is one of the two the target and the other nothing, however well each fits."""
MISSED: Final = 1e-4
"""Share of correct assignments that the chi-square test rejects."""
MAX_CHANCE: Final = 1e-3
"""Number of candidates expected by chance, above which a candidate is rejected (number of false alarms, Desolneux,
Moisan and Morel 2000)."""
_SAME: Final = 0.1
"""Two poses are one interpretation if no ball differs by more than this share of the target's size."""
_BATCH: Final = 50
"""Fits between two checks of the deadline, half a millisecond."""
_MOST: Final = 6
"""Candidates of one target that are compared with those of the other targets."""
_MAX_COMBINATIONS: Final = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A candidate: an assignment of points to a target's balls, with its pose.

    Attributes:
        assignment: for each ball the index of its point, -1 if unseen.
        rotation: (3, 3).
        translation: (3,) metres.
        covariance: (6, 6) of the pose.
        residual: metres.
        chi_square: of the fit.
        cost: larger for a less likely candidate.
        balls: (k, 3) positions of all balls by the pose, metres.
    """

    assignment: tuple[int, ...]
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    residual: float
    chi_square: float
    cost: float
    balls: FloatArray


def fitted(
    target: Target,
    points: Points,
    assignments: Sequence[tuple[int, ...]],
    deadline: Deadline,
    missed: float = MISSED,
) -> list[Candidate]:
    """The assignments whose points fit the target, with their poses, the lowest cost first.

    A part of an assignment that fits is dropped. Balls nearly on one line determine no pose.
    """
    return fitted_together([(target, assignments)], points, deadline, missed)[0]


def fitted_together(
    wanted: Sequence[tuple[Target, Sequence[tuple[int, ...]]]],
    points: Points,
    deadline: Deadline,
    missed: float = MISSED,
) -> list[list[Candidate]]:
    """:func:`fitted` for several targets in one batch: a call costs more than its arithmetic."""
    by_size: dict[int, list[_Fitting]] = {}
    for place, (target, assignments) in enumerate(wanted):
        for assignment in dict.fromkeys(assignments):
            seen = tuple(ball for ball, point in enumerate(assignment) if point >= 0)
            by_size.setdefault(len(seen), []).append(_Fitting(place, target, seen, assignment))
    known: list[list[frozenset[tuple[int, int]]]] = [[] for _ in wanted]
    candidates: list[list[Candidate]] = [[] for _ in wanted]
    for size in sorted(by_size, reverse=True):
        fittings = [
            each
            for each in by_size[size]
            if _determined(each.target, each.seen) and not any(each.matches <= larger for larger in known[each.place])
        ]
        for known_shape in (True, False):
            some = [each for each in fittings if (not each.target.covariance.any()) is known_shape]
            for start in range(0, len(some), _BATCH):
                deadline.check()
                for each, candidate in _fit(points, some[start : start + _BATCH], known_shape, missed):
                    candidates[each.place].append(candidate)
                    known[each.place].append(each.matches)
    return [sorted(each, key=lambda candidate: candidate.cost) for each in candidates]


class _Fitting(NamedTuple):
    """An assignment to be fitted: index of its target, target, its visible balls, the point of each ball."""

    place: int
    target: Target
    seen: tuple[int, ...]
    assignment: tuple[int, ...]

    @property
    def matches(self) -> frozenset[tuple[int, int]]:
        """Pairs of ball and point."""
        return frozenset((ball, self.assignment[ball]) for ball in self.seen)


@lru_cache(maxsize=4096)
def _determined(target: Target, seen: tuple[int, ...]) -> bool:
    """Whether these balls of a target are not nearly collinear."""
    return spread(target.points[list(seen)])


def _fit(
    points: Points, fittings: Sequence[_Fitting], known_shape: bool, missed: float
) -> Iterator[tuple[_Fitting, Candidate]]:
    """The assignments that fit, among ones with equally many balls."""
    size = len(fittings[0].seen)
    chosen = np.array([[each.assignment[ball] for ball in each.seen] for each in fittings])
    fits = maximum_likelihood(
        np.stack([each.target.points[list(each.seen)] for each in fittings]),
        points.positions[chosen],
        points.covariance[chosen],
        None if known_shape else np.stack([balls_covariance(each.target, np.array(each.seen)) for each in fittings]),
    )
    gate = chi_square.gate(3 * size - 6, missed)
    for row in np.flatnonzero(fits.chi_square <= gate).tolist():
        each = fittings[row]
        yield (
            each,
            Candidate(
                each.assignment,
                fits.rotation[row],
                fits.translation[row],
                fits.covariance[row],
                float(fits.residual[row]),
                float(fits.chi_square[row]),
                float(fits.chi_square[row]) + HIDDEN_COST * (len(each.target.points) - size),
                each.target.points @ fits.rotation[row].T + fits.translation[row],
            ),
        )


def expected_by_chance(target: Target, points: Points, candidate: Candidate, poses: float | None = None) -> float:
    """Expected number of candidates that fit at least as well among points unrelated to the target.

    For independent points with a density of q per cubic metre, the expected number of sets of m points within a squared
    Mahalanobis distance c of a pose in a volume U of poses is ``q^m U V sqrt(det S / det P)``: V the volume of the ball
    of radius ``sqrt(c)`` in 3m - 6 dimensions, S the covariance of the points, and P that of the pose. The density is
    that of the other points within the target's size around it, plus one point.

    Args:
        target: of the candidate.
        points: of the frame.
        candidate: with three balls or more.
        poses: m^3 rad^3, volume of the target's possible poses; None for all rotations (8 pi^2) times the volume that
            the points fill at that density.
    """
    balls = [ball for ball, point in enumerate(candidate.assignment) if point >= 0]
    chosen = np.array(candidate.assignment)[balls]
    shape = target.covariance.reshape(len(target.points), 3, len(target.points), 3)[balls, :, balls]
    noise = points.covariance[chosen] + np.trace(shape, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    size = np.linalg.norm(target.points[:, None] - target.points, axis=2).max()
    centre = points.positions[chosen].mean(axis=0)
    near = int((((points.positions - centre) ** 2).sum(axis=1) < size**2).sum())
    density = (near - len(balls) + 1.0) / (4.0 / 3.0 * math.pi * size**3)
    volume = 8.0 * math.pi**2 * len(points.positions) / density
    degrees = 3 * len(balls) - 6
    logarithm = (
        math.log(math.comb(len(target.points), len(balls)))
        + len(balls) * math.log(density)
        + math.log(volume if poses is None else min(poses, volume))
        + 0.5 * degrees * math.log(math.pi * max(candidate.chi_square, 1e-9))
        - math.lgamma(0.5 * degrees + 1.0)
        + 0.5 * float(np.linalg.slogdet(noise)[1].sum())
        - 0.5 * float(np.linalg.slogdet(candidate.covariance)[1])
    )
    return math.exp(min(logarithm, 100.0))


def spread(points: FloatArray, least: float = 0.1) -> bool:
    """Whether the second principal width of points exceeds this share of the first."""
    widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(widths[1] > least * widths[0])


def decide(
    candidates: dict[str, list[Candidate]], believed: Callable[[str, Candidate], bool]
) -> tuple[dict[str, Candidate], set[str]]:
    """The likeliest combination of candidates, and the targets with a second, nearly as likely candidate.

    Args:
        candidates: by target, the likeliest first.
        believed: whether a target's candidate is too unlikely to arise by chance.

    Returns:
        The candidates of the certain targets, and the names of the uncertain ones.
    """
    chosen: dict[str, Candidate] = {}
    unsure: set[str] = set()
    for names in _competing(candidates):
        some = {name: candidates[name][:_MOST] for name in names}
        if math.prod(len(each) + 1 for each in some.values()) > _MAX_COMBINATIONS:
            unsure.update(names)
            continue
        combinations = _combinations(some)
        best, least = min(combinations, key=lambda combination: combination[1])
        for name in names:
            own = best[name]
            if own is None:
                # it has candidates, but the best combination uses none of them
                unsure.add(name)
                continue
            others = [(choice[name], cost) for choice, cost in combinations if cost < least + BELIEVED_MARGIN]
            if not believed(name, own) or any(
                _rivals(own, other, cost - least, name, believed) for other, cost in others
            ):
                unsure.add(name)
            else:
                chosen[name] = own
    return chosen, unsure


def _rivals(
    own: Candidate, other: Candidate | None, more: float, name: str, believed: Callable[[str, Candidate], bool]
) -> bool:
    """Whether another candidate, at this extra cost, makes the target uncertain."""
    if other is None:
        return more < MARGIN
    apart = np.abs(own.balls - other.balls).max()
    if other is own or apart <= _SAME * (own.balls.max(axis=0) - own.balls.min(axis=0)).max():
        return False
    # candidates of shared points compare by likelihood; a candidate of other points needs an explanation of its own
    shared = len(set(own.assignment) & set(other.assignment) - {-1})
    fewer = other.assignment.count(-1) > own.assignment.count(-1)
    return more < MARGIN or (shared < FEWEST and not fewer and believed(name, other))


def _competing(candidates: dict[str, list[Candidate]]) -> list[list[str]]:
    """Groups of targets that compete for points, directly or through other targets."""
    groups: list[tuple[list[str], set[int]]] = []
    for name, each in candidates.items():
        if not each:
            continue
        names, points = [name], {point for candidate in each for point in candidate.assignment if point >= 0}
        apart = []
        for group in groups:
            if group[1] & points:
                names, points = group[0] + names, group[1] | points
            else:
                apart.append(group)
        groups = [*apart, (names, points)]
    return [names for names, _ in groups]


def _combinations(candidates: dict[str, list[Candidate]]) -> list[tuple[dict[str, Candidate | None], float]]:
    """All combinations of candidates without shared points, with their costs; None for a target without a candidate."""
    results: list[tuple[dict[str, Candidate | None], set[int], float]] = [({}, set(), 0.0)]
    for name, each in candidates.items():
        nowhere = HIDDEN_COST * len(each[0].assignment)
        extended: list[tuple[dict[str, Candidate | None], set[int], float]] = []
        for choice, used, cost in results:
            extended.append(({**choice, name: None}, used, cost + nowhere))
            for candidate in each:
                points = {point for point in candidate.assignment if point >= 0}
                if not points & used:
                    extended.append(({**choice, name: candidate}, used | points, cost + candidate.cost))
        results = extended
    return [(choice, cost) for choice, _, cost in results]
