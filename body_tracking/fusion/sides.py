"""Which way a person faces, when sensors disagree about left and right (``body_tracking.core.sides``)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from body_tracking.core.measurement import back_view_factor
from body_tracking.core.sides import (
    HALVES,
    PAIRS,
    SAME_SENSE,
    heading_weights,
    headings_of,
    reversed_halves,
    swap_left_right,
)
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Skeleton

_CLOSE = math.sqrt(0.5)
"""Two sensors' headings agree where their cosine exceeds this."""

_AGREES = math.cos(math.radians(30.0))
"""Cosine of the largest angle at which a measured left-right axis agrees with the accepted one."""

HEADING_DRIFT = 1.6
"""Spectral density of a person's turning, as a random walk of the heading, rad2/s."""

_START_VARIANCE = 1.0
"""Initial variance of a heading, before the update with the frame that it starts from, rad2."""

HEADING_BIAS = 0.2
"""Standard deviation of a sensor's systematic heading error, radians."""

MORE_FRONTAL = math.pi / 6
"""A sensor becomes the trusted one when it sees the body this much more from the front, radians ..."""

TRUST_AFTER = round(1.0 * NANOSECONDS)
"""... for this long, while it agrees with the trusted one, nanoseconds."""

VIEW_KEPT = round(0.5 * NANOSECONDS)
"""A sensor that was silent for longer may have swapped left and right meanwhile, nanoseconds."""

HOLD = 10.0
"""A reversal that all sensors see at once is rejected for at most this long, seconds ..."""

MIN_HOLD = 1.0
"""... and for at least this long."""

TURN_RATE = 8.0
"""Fastest rotation of a person's shoulders, radians per second (throwing athletes' trunks reach it)."""

TURN_ONCE = math.pi / 3
"""Largest rotation between two outputs, radians, however long these are apart."""

JUMP = math.radians(20.0)
"""Radians beyond ``TURN_RATE`` by which an axis that one sensor sees must turn between two frames to be an outlier."""

JUMP_WIDTH = 1.3
"""Factor by which an outlier's axis must also lengthen or shorten: a misplaced end changes its length."""

JUMP_HOLD = 0.3
"""Seconds after which a new heading and width is accepted."""


class _Heading:
    """A Kalman filter of the heading of half a body, radians: a random walk, measured as the direction of a line."""

    def __init__(self, angle: float) -> None:
        self.angle, self._variance = angle, _START_VARIANCE

    def predict(self, elapsed: float) -> None:
        """Predict over some seconds."""
        self._variance += HEADING_DRIFT * max(elapsed, 0.0)

    def innovation(self, angle: float) -> float:
        """Innovation of a line's direction, radians within a quarter turn: a line has no sense."""
        return math.remainder(angle - self.angle, math.pi)

    def update(self, angles: Sequence[float], weights: Sequence[float]) -> float:
        """Update with the sensors' angles, radians, downweighting large innovations; start with the surest of them.

        Args:
            angles: radians.
            weights: inverse variances, 1/rad2; 0 where nothing was measured.

        Returns:
            Size of the correction, radians; infinite at the start.
        """
        if math.isnan(self.angle):
            surest = max(range(len(weights)), key=lambda index: weights[index])
            if weights[surest]:
                self.angle, self._variance = angles[surest], _START_VARIANCE
            return math.inf
        total = towards = 0.0
        for angle, weight in zip(angles, weights, strict=True):
            if not weight:
                continue
            noise = 1.0 / weight + HEADING_BIAS**2
            away = self.innovation(angle)
            information = 1.0 / (noise * (1.0 + away**2 / (self._variance + noise) / 4.0))
            total += information
            towards += information * away
        if not total:
            return 0.0
        self._variance = 1.0 / (1.0 / self._variance + total)
        self.angle += self._variance * towards
        return abs(self._variance * towards)


class _View(NamedTuple):
    """A sensor's last frame of a body: stamp, headings, and 1, or -1 where it swaps left and right."""

    stamp: int
    headings: Sequence[float]
    sense: float


class Sides:
    """Estimates a person's heading, corrects frames that contradict it, and limits the output's turn rate.

    Args:
        hold: longest time for which a reversal that all sensors see at once is rejected, seconds.

    Attributes:
        reliable: sensors that tell left from right also from behind, unlike a Kinect: a reversal that they see is
            rejected for no longer than :data:`MIN_HOLD`.
    """

    def __init__(self, hold: float = HOLD) -> None:
        self.reliable: set[str] = set()
        self._hold_ns = round(hold * NANOSECONDS)
        self._least_ns = min(round(MIN_HOLD * NANOSECONDS), self._hold_ns)
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self.trusted: str | None = None
        self._trusted_ns = 0
        self._better_since: int | None = None
        self._halves = [_Heading(math.nan), _Heading(math.nan)]
        self._headings_ns: int | None = None
        self._known_since = 0  # start of the time without a reversal
        self._reversed_since: int | None = None
        self._views: dict[str, _View] = {}
        # the latest heading, width and stamp, by sensor and half
        self._seen: dict[tuple[str, int], tuple[float, float, int]] = {}
        self._output = [(math.nan, 0), (math.nan, 0)]  # heading of the output, and when

    def correct(
        self,
        stamp: int,
        names: Sequence[str],
        angles: Sequence[float],
        points: FloatArray,
        variance: FloatArray,
        states: np.ndarray,
        counters: Counter[str],
    ) -> BoolArray:
        """Swap left and right, in place, in frames that show the body reversed, and reject joints of a turned half.

        Where a sensor's left-right axis is opposite to the accepted one, left and right are swapped; where it is
        across, only the joints of the midline are kept; upper and lower body each by their own axis.

        Args:
            stamp: reference time, nanoseconds.
            names: k sensors.
            angles: k angles under which they see the body, radians.
            points: (k, 25, 3) metres in world.
            variance: (k, 25) square metres.
            states: (k, 25).
            counters: counts ``repaired``, ``turned``, ``jumped`` and ``reversals_accepted``.

        Returns:
            (k, 2) whether the corrected upper and lower body of each sensor agree with the accepted headings.
        """
        headings = [headings_of(each) for each in points]
        weights = [heading_weights(*each) for each in zip(points, variance, strict=True)]
        for index, name in enumerate(names):
            for half in self._jumped(stamp, name, headings[index], points[index]):
                weights[index][half] = 0.0
                variance[index, HALVES[half]] = np.inf
                counters["jumped"] += 1
        accepted = self.accepted_headings(stamp, names, angles, headings, weights, counters)
        for index, found in enumerate(headings):
            halves = reversed_halves(found, accepted)
            if halves:
                factor = back_view_factor(angles[index])
                swap_left_right(halves, points[index], variance[index], states[index], factor)
            for _, opposite in halves:
                counters["repaired" if opposite else "turned"] += 1
        lines = [[abs(math.cos(a - b)) for a, b in zip(found, accepted, strict=True)] for found in headings]
        return np.array(lines) > _AGREES

    def _jumped(self, stamp: int, name: str, headings: Sequence[float], points: FloatArray) -> list[int]:
        """The halves whose axis changed heading and width from one frame to the next: one of its ends is an outlier."""
        jumped = []
        for half, (heading, pair) in enumerate(zip(headings, PAIRS, strict=True)):
            width = math.dist(*points[pair].tolist())
            before, width_before, before_ns = self._seen.get((name, half), (math.nan, math.nan, 0))
            elapsed = (stamp - before_ns) / NANOSECONDS
            turn = abs(math.remainder(heading - before, math.pi))  # swapped sides are no outlier
            other = max(width, width_before) > JUMP_WIDTH * min(width, width_before)
            if elapsed < JUMP_HOLD and other and turn > TURN_RATE * elapsed + JUMP:
                jumped.append(half)
            elif not math.isnan(heading):
                self._seen[name, half] = heading, width, stamp
        return jumped

    def accepted_headings(
        self,
        stamp: int,
        names: Sequence[str],
        angles: Sequence[float],
        headings: Sequence[Sequence[float]],
        weights: Sequence[Sequence[float]],
        counters: Counter[str],
    ) -> list[float]:
        """The estimated headings of both halves, radians.

        Each half has its own Kalman filter. A sensor measures the left-right axis as a line without a sense. The
        trusted sensor decides the sense for the whole body: at the start, and when it has seen the body reversed for
        long enough. Another sensor becomes the trusted one when it sees the body more from the front for a while and
        agrees with it, or when the trusted one is missing.

        Args:
            stamp: reference time, nanoseconds.
            names: k sensors.
            angles: k angles under which they see the body, radians.
            headings: of each, by :func:`headings_of`.
            weights: of each, by :func:`heading_weights`.
            counters: counts ``reversals_accepted``.
        """
        known = [index for index, found in enumerate(headings) if not all(map(math.isnan, found))]
        if not known:
            return [half.angle for half in self._halves]
        leading = next((index for index in known if names[index] == self.trusted), None)
        if leading is None:
            leading = min(known, key=lambda index: angles[index])
            takes_over = self.trusted is None or stamp - self._trusted_ns > TRUST_AFTER
        else:
            leading, takes_over = self._most_frontal(stamp, leading, known, angles, headings), True
        if self._headings_ns is None or stamp - self._headings_ns > TRUST_AFTER:
            self._start(stamp, headings[leading], weights[leading], angles[leading])
        else:
            for half in self._halves:
                half.predict((stamp - self._headings_ns) / NANOSECONDS)
            senses = {index: self._sense(headings[index], weights[index]) for index in known}
            if self._reversal_accepted(
                stamp, leading, senses, angles[leading], reliable=names[leading] in self.reliable
            ):
                counters["reversals_accepted"] += 1
                for half in self._halves:
                    half.angle += math.pi
                self._views.clear()
        moved = [
            half.update([headings[index][number] for index in known], [weights[index][number] for index in known])
            for number, half in enumerate(self._halves)
        ]
        upper, lower = self._halves
        if math.cos(upper.angle - lower.angle) < 0.0:  # anatomically impossible: the half that moved more is wrong
            (lower if moved[1] > moved[0] else upper).angle += math.pi
        expected = {index: self._expected(stamp, names[index], headings[index], weights[index]) for index in known}
        if expected[leading] * self._sense(headings[leading], weights[leading]) < -SAME_SENSE:
            # another sensor turned the estimate, while the one that sees the body best saw no reversal
            counters["senses_restored"] += 1
            for half in self._halves:
                half.angle += math.pi
        self._headings_ns = stamp
        if takes_over:
            self.trusted, self._trusted_ns = names[leading], stamp
        return [half.angle for half in self._halves]

    def _start(self, stamp: int, headings: Sequence[float], weights: Sequence[float], angle: float) -> None:
        """Start from one sensor's headings; of two opposite ones the one with the larger weight."""
        self._halves = [_Heading(heading) for heading in headings]
        if math.cos(headings[0] - headings[1]) < 0.0:
            self._halves[int(weights[0] > weights[1])].angle += math.pi
        self._known_since, self._reversed_since = self._known_from(stamp, angle), None

    def _sense(self, headings: Sequence[float], weights: Sequence[float]) -> float:
        """1 where a sensor's headings equal the estimate, -1 where reversed; the weighted mean of the known halves."""
        return _agreement(headings, [half.angle for half in self._halves], weights) or 0.0

    def _expected(self, stamp: int, name: str, headings: Sequence[float], weights: Sequence[float]) -> float:
        """The sense in which a sensor should see the body: as in its last frame, unless it swapped left and right."""
        sense = math.copysign(1.0, self._sense(headings, weights))
        view = self._views.get(name)
        if view is not None and stamp - view.stamp <= VIEW_KEPT:
            kept = _agreement(headings, view.headings, weights)
            if kept is not None:
                sense = view.sense if kept > 0.0 else -view.sense
        self._views[name] = _View(stamp, headings, sense)
        return sense

    def _most_frontal(
        self,
        stamp: int,
        leading: int,
        known: Sequence[int],
        angles: Sequence[float],
        headings: Sequence[Sequence[float]],
    ) -> int:
        """The trusted sensor, or one that has agreed with it and seen the body more from the front for a while."""
        upper = headings[leading][0]
        agreeing = [index for index in known if math.cos(headings[index][0] - upper) > _CLOSE] or [leading]
        better = min(agreeing, key=lambda index: angles[index])
        if angles[leading] - angles[better] <= MORE_FRONTAL:
            self._better_since = None
        elif self._better_since is None:
            self._better_since = stamp
        elif stamp - self._better_since > TRUST_AFTER:
            self._better_since = None
            return better
        return leading

    def _reversal_accepted(
        self, stamp: int, leading: int, senses: Mapping[int, float], angle: float, *, reliable: bool
    ) -> bool:
        """Whether to reverse the estimate, because the trusted sensor sees the body reversed.

        No person reverses between two frames, so the sensor errs now or has erred until now. While at least as many
        sensors keep the old sense as see the reversal, it errs now. Otherwise the reversal is accepted when it has
        lasted as long as the sense that it contradicts, because sensors are wrong for less time than they are right. A
        body seen from the front counts as seen for long: sensors seldom mistake a back for a front.
        """
        as_before = sum(sense > _CLOSE for sense in senses.values())
        with_it = sum(sense < -_CLOSE for index, sense in senses.items() if index != leading)
        if senses[leading] > -SAME_SENSE or as_before > with_it:
            self._reversed_since = None
            return False
        since = self._reversed_since
        if since is None:
            since = self._reversed_since = stamp
        held = self._least_ns if reliable else min(max(since - self._known_since, self._least_ns), self._hold_ns)
        if stamp - since <= held:
            return False
        self._known_since, self._reversed_since = self._known_from(since, angle), None
        return True

    def _known_from(self, stamp: int, angle: float) -> int:
        """Start of the time for which a sense counts as known, for a sensor that sees the body under an angle."""
        return stamp - self._hold_ns if angle < math.pi / 2 else stamp

    def limit_turn_rate(self, stamp: int, fused: Skeleton, counters: Counter[str]) -> Skeleton:
        """Limit the turn rate of shoulders and hips, with arms and legs, to :data:`TURN_RATE`.

        When the accepted heading jumps, the output turns as a body would, and is never mirrored on the way.

        Args:
            stamp: reference time, nanoseconds.
            fused: with covariances.
            counters: counts ``turned_gently``.
        """
        for half, heading in enumerate(headings_of(fused.positions)):
            if math.isnan(heading):
                continue
            before, before_ns = self._output[half]
            excess = 0.0
            if stamp - before_ns < TRUST_AFTER and not math.isnan(before):
                turn = math.remainder(heading - before, math.tau)
                most = min(TURN_RATE * (stamp - before_ns) / NANOSECONDS, TURN_ONCE)
                excess = math.copysign(max(abs(turn) - most, 0.0), turn)
            self._output[half] = heading - excess, stamp
            if excess:
                fused = _turned(fused, half, -excess)
                counters["turned_gently"] += 1
        return fused


def _agreement(headings: Sequence[float], others: Sequence[float], weights: Sequence[float]) -> float | None:
    """Weighted mean cosine between the headings of both halves, or of the one that is known; None without one."""
    known = [
        (weight, math.cos(heading - other))
        for heading, other, weight in zip(headings, others, weights, strict=True)
        if weight and not math.isnan(other)
    ]
    total = sum(weight for weight, _ in known)
    return sum(weight * cosine for weight, cosine in known) / total if total else None


def _turned(skeleton: Skeleton, half: int, angle: float) -> Skeleton:
    """One half of a body turned about the vertical through the middle of its axis."""
    assert skeleton.covariances is not None
    positions, covariances = skeleton.positions.copy(), skeleton.covariances.copy()
    joints = HALVES[half]
    centre = positions[PAIRS[half]].mean(axis=0)
    arms = positions[joints] - centre
    cosine, sine = math.cos(angle), math.sin(angle)
    moved = arms @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    # The displacement counts as uncertainty.
    covariances[joints] += np.einsum("ji,jk->jik", moved - arms, moved - arms)
    positions[joints] = centre + moved
    return Skeleton(
        skeleton.stamp_ns,
        skeleton.frame_id,
        positions,
        skeleton.states,
        skeleton.body,
        covariances,
        skeleton.velocities,
    )
