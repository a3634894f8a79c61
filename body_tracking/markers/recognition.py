"""Recognition of targets among unlabelled points, without prior knowledge.

The task is that of Gaschler 2011, section 3.3: targets among many points that belong to none, hidden balls, real time.
His heuristic search is in :mod:`body_tracking.markers.depth_first`; this search is complete.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_linear import whitening_of
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.interpretation import MAX_CHANCE, Candidate, decide, expected_by_chance, fitted
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.search import Deadline, DeadlineError, Pairs, Shape, near_pairs
from body_tracking.markers.targets import Target

SURE: Final = 4
"""Balls that identify a target; three match too often by chance."""
_MISSED_THREE: Final = 0.05
"""Share of correct assignments that the stricter chi-square test of three balls of a larger target rejects."""
_MAX_THREES: Final = 20
"""Mean number of points in relation to an edge of a target, above which three balls are not searched: too many
match."""
_USELESS: Final = 0.25
"""Ratio of a point's standard deviation to the largest target's size, above which the point is ignored."""


class RecognitionError(BodyTrackingError):
    """Raised for targets or points that cannot be searched."""


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Targets recognised in a frame.

    Attributes:
        poses: of the certain targets.
        ambiguous: targets with two remaining interpretations.
        complete: whether the search finished in time; if not, missing targets may be present.
    """

    poses: tuple[TargetPose, ...]
    ambiguous: tuple[str, ...]
    complete: bool


class Recogniser:
    """Finds targets among points.

    Args:
        targets: with three or more balls each, not collinear, distinguishable
            (:func:`body_tracking.markers.distinct.check_distinct`).

    Raises:
        RecognitionError: no target, a duplicate name, a target with too few balls or numbers that are not finite.
    """

    def __init__(self, targets: Sequence[Target]) -> None:
        check_targets(targets)
        self.targets = {target.name: target for target in targets}
        self.shapes = {target.name: Shape(target) for target in targets}

    def recognise(
        self,
        points: Points,
        deadline: float | None = None,
        names: Collection[str] | None = None,
    ) -> Recognition:
        """Find targets in a frame.

        Args:
            points: with covariances.
            deadline: seconds after which the search gives up; None for no limit.
            names: the targets to search for; None for all.

        Raises:
            RecognitionError: points that are not finite, or without a valid covariance.
        """
        check_points(points)
        wanted = [name for name in self.targets if names is None or name in names]
        until = Deadline(deadline)
        candidates: dict[str, list[Candidate]] = {}
        complete = True
        try:
            pairs = self.pairs(points, wanted)
            for name in wanted:
                until.check()
                candidates[name] = self._candidates(name, points, pairs, until)
        except DeadlineError:
            complete = False
        chosen, unsure = decide(
            candidates, lambda name, each: expected_by_chance(self.targets[name], points, each) <= MAX_CHANCE
        )
        return Recognition(
            tuple(target_pose(name, points, candidate) for name, candidate in chosen.items()),
            tuple(name for name in wanted if name in unsure),
            complete,
        )

    def pairs(self, points: Points, names: Collection[str]) -> Pairs:
        """Pairs of points that may be two balls of one of these targets."""
        shapes = [self.shapes[name] for name in names]
        reach = max((float((shape.distances + shape.tolerance).max()) for shape in shapes), default=0.0)
        useful = np.flatnonzero(np.trace(points.covariance, axis1=1, axis2=2) < (_USELESS * reach) ** 2)
        pairs = near_pairs(points.positions[useful], points.covariance[useful], reach)
        return Pairs(useful[pairs.first], useful[pairs.second], pairs.low, pairs.high)

    def _candidates(self, name: str, points: Points, pairs: Pairs, deadline: Deadline) -> list[Candidate]:
        target, shape = self.targets[name], self.shapes[name]
        relations = shape.relations(pairs)
        fewest = min(SURE, shape.balls)
        candidates: list[Candidate] = []
        # two balls fewer cost so much more that such an interpretation cannot compete
        for balls in range(max(shape.balls - 1, fewest), fewest - 1, -1):
            found = shape.assignments(relations, balls, deadline)
            candidates = fitted(target, points, list(found), deadline)
            if candidates:
                return candidates
        if shape.balls > 3 and sum(map(len, relations)) <= _MAX_THREES * len(relations):
            found = shape.assignments(relations, 3, deadline)
            candidates = fitted(target, points, list(found), deadline, _MISSED_THREE)
        return candidates


def check_targets(targets: Sequence[Target]) -> None:
    """Reject targets whose pose is not determined.

    Raises:
        RecognitionError: no target, a duplicate name, fewer than three balls, wrong shapes, numbers that are not
            finite.
    """
    names = [target.name for target in targets]
    if not names or len(set(names)) < len(names):
        raise RecognitionError(f"targets {', '.join(names) or '(none)'}: each needs a name of its own")
    for target in targets:
        count = len(target.points)
        if count < 3 or target.points.shape != (count, 3) or target.covariance.shape != (3 * count, 3 * count):
            raise RecognitionError(
                f"target {target.name}: points {target.points.shape} with covariance {target.covariance.shape}, "
                "expected (k, 3) and (3k, 3k), k 3 or more"
            )
        if not (np.isfinite(target.points).all() and np.isfinite(target.covariance).all()):
            raise RecognitionError(f"target {target.name}: a number is not finite")


def check_points(points: Points) -> None:
    """Reject points that cannot be searched.

    Raises:
        RecognitionError: wrong shapes, numbers that are not finite, a covariance that is not positive definite.
    """
    count = len(points.positions)
    if points.positions.shape != (count, 3) or points.covariance.shape != (count, 3, 3):
        raise RecognitionError(
            f"points at {points.stamp_ns} ns: {points.positions.shape} with covariance {points.covariance.shape}, "
            "expected (n, 3) and (n, 3, 3)"
        )
    if not (np.isfinite(points.positions).all() and np.isfinite(points.covariance).all()):
        raise RecognitionError(f"points at {points.stamp_ns} ns: a number is not finite")
    if not _definite(np.ascontiguousarray(points.covariance)):
        raise RecognitionError(f"points at {points.stamp_ns} ns: a covariance is not positive definite")


@compiled
def _definite(matrices: FloatArray) -> bool:
    """Whether all matrices (n, 3, 3) are positive definite."""
    scratch, definite = np.empty((3, 3)), True
    for n in range(len(matrices)):
        definite &= whitening_of(matrices[n], scratch)
    return definite


def target_pose(name: str, points: Points, candidate: Candidate) -> TargetPose:
    """The pose of a candidate."""
    return TargetPose(
        name,
        points.stamp_ns,
        points.frame_id,
        candidate.rotation,
        candidate.translation,
        candidate.covariance,
        np.array(candidate.assignment, dtype=np.int64),
        candidate.residual,
    )
