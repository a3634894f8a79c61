"""Targets from frame to frame: predicted, matched within gates, recognised anew where they are lost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.markers.interpretation import MAX_CHANCE, Candidate, decide, expected_by_chance, fitted_together
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.pose import FEWEST, chi_square_gate
from body_tracking.markers.recognition import Recogniser, check_points, target_pose
from body_tracking.markers.search import GATE, Deadline, DeadlineError, Pairs, near_pairs
from body_tracking.markers.targets import Target

_INNOVATION_GATE: Final = chi_square_gate(6, 1e-6)
"""Squared Mahalanobis distance of a pose from its prediction."""


class TrackingError(BodyTrackingError):
    """Parameters are invalid."""


@dataclass(frozen=True, slots=True)
class Motion:
    """How targets move.

    Attributes:
        acceleration: m/s^2, standard deviation of what is constant between two frames.
        angular_acceleration: rad/s^2.
        speed: m/s, standard deviation when a target is recognised.
        angular_speed: rad/s.
        coast: seconds for which a target that is not seen is predicted.
    """

    acceleration: float = 15.0
    angular_acceleration: float = 150.0
    speed: float = 1.5
    angular_speed: float = 6.0
    coast: float = 0.4


@dataclass(slots=True)
class Counters:
    """What happened so far.

    Attributes:
        frames: taken.
        tracked: poses found by prediction.
        recognised: poses found by recognition.
        ambiguous: targets in a frame that were left out because two interpretations remained.
        missed: targets in a frame that were not found, without the ambiguous ones.
        given_up: frames whose search did not end in time.
        repeated: frames with the stamp of the one before, which are left out.
        resets: times that the stamps ran backwards, or the points' frame became another.
    """

    frames: int = 0
    tracked: int = 0
    recognised: int = 0
    ambiguous: int = 0
    missed: int = 0
    given_up: int = 0
    repeated: int = 0
    resets: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """The motion of a target: its pose, velocity (m/s, rad/s about fixed axes), covariance (12, 12), when last seen."""

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    seen_ns: int


class TargetTracker:
    """Poses of targets, frame by frame.

    The Kalman filter of a constant velocity only predicts where to look: a pose that is given is the most likely one
    for the points of its own frame.

    Args:
        targets: see :class:`~body_tracking.markers.recognition.Recogniser`.
        motion: how they move.
        deadline: seconds of a frame after which to give up; never when None.

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
        self._tracks: dict[str, _Track] = {}
        self._stamp_ns: int | None = None
        self._frame_id = ""

    def reset(self) -> None:
        """Forget all targets; the counters stay."""
        self._tracks.clear()
        self._stamp_ns = None

    def update(self, points: Points) -> tuple[TargetPose, ...]:
        """The poses of the targets that are certain in a frame.

        Raises:
            RecognitionError: points that are not finite, or without a covariance each.
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
                self._tracks[name] = _updated(self._tracks[name], candidate, points.stamp_ns)
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
        """Move all tracks to a time; those that were not seen for too long are lost."""
        elapsed = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / NANOSECONDS
        self._stamp_ns = stamp_ns
        motion = self._motion
        transition = np.eye(12)
        transition[:6, 6:] = elapsed * np.eye(6)
        gain = np.concatenate([0.5 * elapsed**2 * np.eye(6), elapsed * np.eye(6)])
        noise = (gain * np.repeat([motion.acceleration**2, motion.angular_acceleration**2], 3)) @ gain.T
        for name, track in list(self._tracks.items()):
            if (stamp_ns - track.seen_ns) / NANOSECONDS > motion.coast:
                del self._tracks[name]
                continue
            self._tracks[name] = replace(
                track,
                rotation=so3.quat_to_matrix(so3.exp(elapsed * track.velocity[3:])) @ track.rotation,
                translation=track.translation + elapsed * track.velocity[:3],
                covariance=transition @ track.covariance @ transition.T + noise,
            )

    def _candidates(self, points: Points, until: Deadline) -> dict[str, list[Candidate]]:
        """Ways to see the tracked targets near where they are expected."""
        gates = {name: _gates(self._targets[name], track, points) for name, track in self._tracks.items()}
        near = np.zeros(len(points.positions), dtype=bool)
        for gate in gates.values():
            near |= gate.any(axis=0)
        if not near.any():
            return {}
        rows = np.flatnonzero(near)
        reach = max(float(shape.distances.max() + shape.tolerance.max()) for shape in self._recogniser.shapes.values())
        pairs = near_pairs(points.positions[rows], points.covariance[rows], reach)
        pairs = Pairs(rows[pairs.first], rows[pairs.second], pairs.low, pairs.high)
        searches = {name: self._search(name, pairs, gate, until) for name, gate in gates.items()}
        candidates: dict[str, list[Candidate]] = {name: [] for name in searches}
        # one ball of each may be hidden; of targets that are not found so, one more each time
        fewest = {name: max(FEWEST, len(self._targets[name].points) - 1) for name in searches}
        left = list(searches)
        while left:
            found = [(self._targets[name], list(searches[name](fewest[name]))) for name in left]
            for name, fits in zip(left, fitted_together(found, points, until), strict=True):
                expected = [each for fit in fits if (each := _expected(self._tracks[name], fit)) is not None]
                candidates[name] = sorted(expected, key=lambda candidate: candidate.cost)
                fewest[name] -= 1
            left = [name for name in left if not candidates[name] and fewest[name] >= FEWEST]
        return candidates

    def _search(
        self, name: str, pairs: Pairs, gate: BoolArray, until: Deadline
    ) -> Callable[[int], Iterator[tuple[int, ...]]]:
        """Assignments of points within a target's gates to at least so many of its balls."""
        shape = self._recogniser.shapes[name]
        inside: BoolArray = np.asarray(gate.any(axis=0))
        both: BoolArray = inside[pairs.first] & inside[pairs.second]
        relations = shape.relations(Pairs(pairs.first[both], pairs.second[both], pairs.low[both], pairs.high[both]))
        allowed = [sum(1 << point for point in np.flatnonzero(row).tolist()) for row in gate]
        return lambda fewest: shape.assignments(relations, fewest, until, allowed)

    def _recognise(
        self, points: Points, chosen: dict[str, Candidate], unsure: set[str], until: Deadline
    ) -> tuple[tuple[TargetPose, ...], set[str]]:
        """Search for the targets that are lost among the points that are left."""
        lost = [name for name in self._targets if name not in chosen and name not in unsure]
        used = [point for candidate in chosen.values() for point in candidate.assignment if point >= 0]
        rows = np.delete(np.arange(len(points.positions)), used)
        if not lost or len(rows) < FEWEST:
            return (), set()
        left = replace(
            points, positions=points.positions[rows], covariance=points.covariance[rows], balls=points.balls[rows]
        )
        result = self._recogniser.recognise(left, until.remaining(), lost)
        poses = tuple(replace(pose, points=_renumbered(pose.points, rows)) for pose in result.poses)
        for pose in poses:
            self._tracks[pose.name] = self._begun(pose)
        self.counters.given_up += not result.complete
        return poses, set(result.ambiguous)

    def _begun(self, pose: TargetPose) -> _Track:
        covariance = np.diag(np.repeat([0.0, 0.0, self._motion.speed**2, self._motion.angular_speed**2], 3))
        covariance[:6, :6] = pose.covariance
        return _Track(pose.rotation, pose.translation, np.zeros(6), covariance, pose.stamp_ns)


def _gates(target: Target, track: _Track, points: Points) -> BoolArray:
    """(k, n) whether a point may be a ball of a target, by where the ball is expected."""
    arms = target.points @ track.rotation.T
    jacobian = np.zeros((len(arms), 3, 6))
    jacobian[..., :3] = np.eye(3)
    jacobian[..., 3:] = -so3.skew(arms)
    own = target.covariance.reshape(len(arms), 3, len(arms), 3)[np.arange(len(arms)), :, np.arange(len(arms))]
    # turned with the target, which its trace bounds
    expected = jacobian @ track.covariance[:6, :6] @ jacobian.swapaxes(1, 2)
    expected += np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    difference = points.positions - (arms + track.translation)[:, None]
    squared = (difference**2).sum(axis=2)
    widest = np.trace(expected, axis1=1, axis2=2)[:, None] + np.trace(points.covariance, axis1=1, axis2=2)
    gates: BoolArray = np.asarray(squared <= GATE**2 * widest)
    ball, point = np.nonzero(gates)
    noise = expected[ball] + points.covariance[point]
    chosen = difference[ball, point][:, :, None]
    distance = (chosen.swapaxes(1, 2) @ np.linalg.solve(noise, chosen))[:, 0, 0]
    gates[ball, point] = distance <= GATE**2
    return gates


def _innovation(track: _Track, candidate: Candidate) -> FloatArray:
    """(6,) from the predicted to the measured pose."""
    turned = so3.rotation_vectors(candidate.rotation @ track.rotation.T)
    return np.concatenate([candidate.translation - track.translation, turned])


def _expected(track: _Track, candidate: Candidate) -> Candidate | None:
    """The candidate with the cost of its distance from the prediction; None outside of the gate."""
    innovation = _innovation(track, candidate)
    distance = float(innovation @ np.linalg.solve(track.covariance[:6, :6] + candidate.covariance, innovation))
    return replace(candidate, cost=candidate.cost + distance) if distance <= _INNOVATION_GATE else None


def _believed(target: Target, points: Points, candidate: Candidate, track: _Track) -> bool:
    """Whether chance does not explain a candidate with hidden balls, among the poses within the gate."""
    if min(candidate.assignment) >= 0:
        return True
    prior = track.covariance[:6, :6]
    poses = math.pi**3 / 6.0 * _INNOVATION_GATE**3 * math.sqrt(max(np.linalg.det(prior + candidate.covariance), 0.0))
    return expected_by_chance(target, points, candidate, poses) < MAX_CHANCE


def _updated(track: _Track, candidate: Candidate, stamp_ns: int) -> _Track:
    """The track with the pose as a measurement (Kalman update)."""
    innovation = _innovation(track, candidate)
    gain = np.linalg.solve(track.covariance[:6, :6] + candidate.covariance, track.covariance[:6]).T
    correction = gain @ innovation
    left = np.eye(12)
    left[:, :6] -= gain
    covariance = left @ track.covariance @ left.T + gain @ candidate.covariance @ gain.T
    return _Track(
        so3.quat_to_matrix(so3.exp(correction[3:6])) @ track.rotation,
        track.translation + correction[:3],
        track.velocity + correction[6:],
        covariance,
        stamp_ns,
    )


def _renumbered(points: IntArray, rows: IntArray) -> IntArray:
    result: IntArray = np.where(points >= 0, rows[points], -1)
    return result
