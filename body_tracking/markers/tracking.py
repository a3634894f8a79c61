"""Tracking of targets: prediction, matching within gates, recognition of lost targets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core import chi_square
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.markers.interpretation import MAX_CHANCE, Candidate, decide, expected_by_chance, fitted_together
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.pose import FEWEST
from body_tracking.markers.recognition import Recogniser, check_points, target_pose
from body_tracking.markers.search import Deadline, DeadlineError, Pairs, near_pairs
from body_tracking.markers.targets import Target
from body_tracking.markers.track import Motion as Motion
from body_tracking.markers.track import Track

_INNOVATION_GATE: Final = chi_square.gate(6, 1e-6)
"""Largest squared Mahalanobis distance of a pose from its prediction."""


class TrackingError(BodyTrackingError):
    """Raised for invalid parameters."""


@dataclass(slots=True)
class Counters:
    """Counts since the start.

    Attributes:
        frames: processed frames.
        tracked: poses found by prediction.
        recognised: poses found by recognition.
        ambiguous: targets left out of a frame because two interpretations remained.
        missed: targets not found in a frame, without the ambiguous ones.
        given_up: frames whose search exceeded the deadline.
        repeated: frames with the stamp of the previous one, which are ignored.
        resets: backward jumps of the stamps, or changes of the points' frame.
    """

    frames: int = 0
    tracked: int = 0
    recognised: int = 0
    ambiguous: int = 0
    missed: int = 0
    given_up: int = 0
    repeated: int = 0
    resets: int = 0


class TargetTracker:
    """Tracks the poses of targets, frame by frame.

    The Kalman filter with constant velocity only predicts where to search: the pose returned is the maximum likelihood
    pose for the points of its own frame.

    Args:
        targets: see :class:`~body_tracking.markers.recognition.Recogniser`.
        motion: process noise.
        deadline: seconds per frame after which the search gives up; None for no limit.

    Raises:
        RecognitionError: invalid targets.
        TrackingError: a parameter that is not positive.
    """

    def __init__(self, targets: Sequence[Target], motion: Motion | None = None, deadline: float | None = None) -> None:
        self._recogniser = Recogniser(targets)
        self._targets = self._recogniser.targets
        self._motion = motion or Motion()
        self._deadline = deadline
        positive = {name: getattr(self._motion, name) for name in Motion.__dataclass_fields__}
        for name, value in [*positive.items(), ("deadline", 1.0 if deadline is None else deadline)]:
            if not (math.isfinite(value) and value > 0.0):
                raise TrackingError(f"{name} is {value:g}, expected a positive number")
        self.counters = Counters()
        self._tracks: dict[str, Track] = {}
        self._stamp_ns: int | None = None
        self._frame_id = ""

    def reset(self) -> None:
        """Forget all targets; the counters stay."""
        self._tracks.clear()
        self._stamp_ns = None

    def update(self, points: Points) -> tuple[TargetPose, ...]:
        """The poses of the certain targets in a frame.

        Raises:
            RecognitionError: points that are not finite, or without a valid covariance.
        """
        check_points(points)
        until = Deadline(self._deadline)
        last = self._stamp_ns
        if last is not None and (points.stamp_ns < last or points.frame_id != self._frame_id):
            self.reset()
            self.counters.resets += 1
        elif points.stamp_ns == last:
            self.counters.repeated += 1
            return ()
        self._frame_id = points.frame_id
        self.counters.frames += 1
        self._predict(points.stamp_ns)

        chosen: dict[str, Candidate] = {}
        unsure: set[str] = set()
        recognised: tuple[TargetPose, ...] = ()
        try:
            chosen, unsure = decide(
                self._candidates(points, until),
                lambda name, each: _believed(self._targets[name], points, each, self._tracks[name]),
            )
            for name, candidate in chosen.items():
                self._tracks[name] = self._tracks[name].updated(_pose(candidate), points.stamp_ns)
            recognised, others = self._recognise(points, chosen, unsure, until)
            unsure |= others
        except DeadlineError:
            self.counters.given_up += 1
        self.counters.tracked += len(chosen)
        self.counters.recognised += len(recognised)
        self.counters.ambiguous += len(unsure)
        self.counters.missed += len(self._targets) - len(chosen) - len(recognised) - len(unsure)
        return (*(target_pose(name, points, candidate) for name, candidate in chosen.items()), *recognised)

    def _predict(self, stamp_ns: int) -> None:
        """Predict all tracks to a time; drop those unseen for too long."""
        elapsed_ns = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        for name, track in list(self._tracks.items()):
            if stamp_ns - track.seen_ns > self._motion.coast * NANOSECONDS:
                del self._tracks[name]
            else:
                self._tracks[name] = track.predicted(elapsed_ns, self._motion)

    def _candidates(self, points: Points, until: Deadline) -> dict[str, list[Candidate]]:
        """Candidates of the tracked targets near their predictions."""
        gates = {name: track.gates(self._targets[name], points) for name, track in self._tracks.items()}
        candidates = self._obvious(points, gates, until)
        gates = {name: gate for name, gate in gates.items() if name not in candidates}
        near = np.zeros(len(points.positions), dtype=bool)
        for gate in gates.values():
            near |= gate.any(axis=0)
        if not near.any():
            return candidates
        rows = np.flatnonzero(near)
        reach = max(float(shape.distances.max() + shape.tolerance.max()) for shape in self._recogniser.shapes.values())
        pairs = near_pairs(points.positions[rows], points.covariance[rows], reach)
        pairs = Pairs(rows[pairs.first], rows[pairs.second], pairs.low, pairs.high)
        searches = {name: self._search(name, pairs, gate, until) for name, gate in gates.items()}
        # one ball of each target may be hidden; if none is found, allow one more hidden ball each time
        fewest = {name: max(FEWEST, len(self._targets[name].points) - 1) for name in searches}
        left = list(searches)
        while left:
            found = [(self._targets[name], list(searches[name](fewest[name]))) for name in left]
            for name, fits in zip(left, fitted_together(found, points, until), strict=True):
                candidates[name] = self._expected(name, fits)
                fewest[name] -= 1
            left = [name for name in left if not candidates[name] and fewest[name] >= FEWEST]
        return candidates

    def _obvious(self, points: Points, gates: dict[str, BoolArray], until: Deadline) -> dict[str, list[Candidate]]:
        """Targets with at most one hidden ball and exactly one point in the gate of every other ball.

        If these points fit, the candidate is unique and no search is needed.
        """
        found = {}
        for name, gate in gates.items():
            balls = gate.sum(axis=1)
            if balls.max(initial=0) == 1 and balls.sum() >= max(FEWEST, len(gate) - 1) and gate.sum(axis=0).max() == 1:
                found[name] = tuple(np.where(balls == 1, gate.argmax(axis=1), -1).tolist())
        fits = fitted_together([(self._targets[name], [each]) for name, each in found.items()], points, until)
        expected = {name: self._expected(name, each) for name, each in zip(found, fits, strict=True)}
        return {name: each for name, each in expected.items() if each}

    def _expected(self, name: str, fits: list[Candidate]) -> list[Candidate]:
        """Candidates within the gate of the prediction, their cost increased by the distance, the likeliest first."""
        distances = [self._tracks[name].distance(_pose(fit)) for fit in fits]
        expected = [
            replace(fit, cost=fit.cost + distance)
            for fit, distance in zip(fits, distances, strict=True)
            if distance <= _INNOVATION_GATE
        ]
        return sorted(expected, key=lambda candidate: candidate.cost)

    def _search(
        self, name: str, pairs: Pairs, gate: BoolArray, until: Deadline
    ) -> Callable[[int], Iterator[tuple[int, ...]]]:
        """Search for assignments of points within a target's gates, as a function of the least number of balls."""
        shape = self._recogniser.shapes[name]
        inside: BoolArray = np.asarray(gate.any(axis=0))
        both: BoolArray = inside[pairs.first] & inside[pairs.second]
        relations = shape.relations(Pairs(pairs.first[both], pairs.second[both], pairs.low[both], pairs.high[both]))
        allowed = [sum(1 << point for point in np.flatnonzero(row).tolist()) for row in gate]
        return lambda fewest: shape.assignments(relations, fewest, until, allowed)

    def _recognise(
        self, points: Points, chosen: dict[str, Candidate], unsure: set[str], until: Deadline
    ) -> tuple[tuple[TargetPose, ...], set[str]]:
        """Search for the lost targets among the unused points."""
        lost = [name for name in self._targets if name not in chosen and name not in unsure]
        used = [point for candidate in chosen.values() for point in candidate.assignment if point >= 0]
        rows = np.delete(np.arange(len(points.positions)), used)
        if not lost or len(rows) < FEWEST:
            return (), set()
        left = replace(
            points, positions=points.positions[rows], covariance=points.covariance[rows], balls=points.balls[rows]
        )
        result = self._recogniser.recognise(left, until.remaining(), lost)
        poses = tuple(replace(pose, points=np.where(pose.points >= 0, rows[pose.points], -1)) for pose in result.poses)
        for pose in poses:
            self._tracks[pose.name] = Track.begun(pose, self._motion)
        self.counters.given_up += not result.complete
        return poses, set(result.ambiguous)


def prepare() -> None:
    """Compile the loops, or load them, before the first points: a target seen twice."""
    balls = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.07, 0.0], [0.02, 0.03, 0.05]])
    tracker = TargetTracker([Target("", balls, np.zeros((12, 12)))])
    noise = np.tile(1e-6 * np.eye(3), (4, 1, 1))
    for stamp_ns in (0, 1):
        tracker.update(Points(stamp_ns, "", balls, noise, np.zeros((4, 0), dtype=np.intp)))


def _pose(candidate: Candidate) -> tuple[FloatArray, FloatArray, FloatArray]:
    return candidate.rotation, candidate.translation, candidate.covariance


def _believed(target: Target, points: Points, candidate: Candidate, track: Track) -> bool:
    """Whether a candidate with hidden balls is too unlikely to arise by chance among the poses within the gate."""
    if min(candidate.assignment) >= 0:
        return True
    prior = track.covariance[:6, :6]
    poses = math.pi**3 / 6.0 * _INNOVATION_GATE**3 * math.sqrt(max(np.linalg.det(prior + candidate.covariance), 0.0))
    return expected_by_chance(target, points, candidate, poses) < MAX_CHANCE
