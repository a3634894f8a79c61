"""Which way a person faces, when sensors disagree about left and right (``body_tracking.sides``)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from body_tracking.sides import HALVES, PAIRS, SAME_SENSE, headings_of, put_right
from body_tracking.skeleton import NANOSECONDS, FloatArray, Skeleton

_CLOSE = math.sqrt(0.5)
"""... above which one sensor says the same as another, or as was said before."""

MORE_FRONTAL = math.pi / 6
"""A sensor is believed more on left and right when it sees the body this much more from the front, radians ..."""

TRUST_AFTER = round(1.0 * NANOSECONDS)
"""... for this long, while it agrees with the one believed so far, nanoseconds."""

HOLD = 10.0
"""A reversal that all sensors see at once is not believed for this long, seconds ..."""

LEAST_HOLD = 1.0
"""... or for this long where what it contradicts may be as wrong."""

TURN_RATE = 8.0
"""A person's shoulders turn no faster than this, radians per second (throwing athletes' trunks reach it)."""

TURN_ONCE = math.pi / 3
"""... and by no more than this between two outputs, however long they are apart, radians."""


class Sides:
    """Decides whom to believe on left and right, and keeps the output from turning faster than a person can.

    Args:
        hold: seconds for which a reversal that all sensors see at once is not believed at most.
    """

    def __init__(self, hold: float = HOLD) -> None:
        self._hold_ns = round(hold * NANOSECONDS)
        self._least_ns = min(round(LEAST_HOLD * NANOSECONDS), self._hold_ns)
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self.trusted: str | None = None
        self._trusted_ns = 0
        self._better_since: int | None = None
        self._axes = [math.nan, math.nan]  # headings taken for true
        self._axes_ns: int | None = None
        self._known_since = [0, 0]  # without having been reversed
        self._reversed_since: list[int | None] = [None, None]
        self._output = [(math.nan, 0), (math.nan, 0)]  # heading of the output, and when

    def settle(
        self,
        stamp: int,
        names: Sequence[str],
        angles: Sequence[float],
        points: FloatArray,
        variance: FloatArray,
        states: np.ndarray,
        counters: Counter[str],
    ) -> None:
        """Repair or reject, in place, what a sensor sees turned around or with its sides swapped.

        Where a sensor's left-right axis is opposite to the believed one, left and right are exchanged; where it is
        across, only the joints of the midline are kept; upper and lower body each by their own axis.

        Args:
            stamp: reference time, nanoseconds.
            names: k sensors.
            angles: k angles under which they see the body, radians.
            points: (k, 25, 3) metres in world.
            variance: (k, 25) square metres.
            states: (k, 25).
            counters: counts ``repaired``, ``turned`` and ``reversals_accepted``.
        """
        headings = [headings_of(each) for each in points]
        believed = self.believed(stamp, names, angles, headings, counters)
        for index, found in enumerate(headings):
            put_right(found, believed, points[index], variance[index], states[index], counters)

    def believed(
        self,
        stamp: int,
        names: Sequence[str],
        angles: Sequence[float],
        headings: Sequence[Sequence[float]],
        counters: Counter[str],
    ) -> list[float]:
        """The headings of both halves that are taken for true, radians.

        They are those of the believed sensor; another takes over that sees the body more from the front for a while
        and agrees with it. While the believed one is missing, or sees the body turned round at once and another does
        not, they are that other's.

        Args:
            stamp: reference time, nanoseconds.
            names: k sensors.
            angles: k angles under which they see the body, radians.
            headings: k times what :func:`headings_of` says of what they see.
            counters: counts ``reversals_accepted``.
        """
        known = [index for index, found in enumerate(headings) if not math.isnan(found[0] + found[1])]
        if not known:
            return self._axes
        leading = next((index for index in known if names[index] == self.trusted), None)
        if leading is None:
            leading = min(known, key=lambda index: angles[index])
            takes_over = self.trusted is None or stamp - self._trusted_ns > TRUST_AFTER
        else:
            leading, takes_over = self._most_frontal(stamp, leading, known, angles, headings), True
        recent = self._axes_ns is not None and stamp - self._axes_ns <= TRUST_AFTER
        if not recent:
            self._known_since, self._reversed_since = [self._credited(stamp, angles[leading])] * 2, [None, None]
        others = [headings[index] for index in known if index != leading]
        self._axes = [
            self._held(stamp, half, heading, [other[half] for other in others], recent, angles[leading], counters)
            for half, heading in enumerate(headings[leading])
        ]
        self._axes_ns = stamp
        if takes_over:
            self.trusted, self._trusted_ns = names[leading], stamp
        return self._axes

    def _most_frontal(
        self,
        stamp: int,
        leading: int,
        known: Sequence[int],
        angles: Sequence[float],
        headings: Sequence[Sequence[float]],
    ) -> int:
        """The believed sensor, or one that has agreed with it and seen the body more from the front for a while."""
        upper = headings[leading][0]
        agreeing = [index for index in known if math.cos(headings[index][0] - upper) > _CLOSE]
        better = min(agreeing, key=lambda index: angles[index])
        if angles[leading] - angles[better] <= MORE_FRONTAL:
            self._better_since = None
        elif self._better_since is None:
            self._better_since = stamp
        elif stamp - self._better_since > TRUST_AFTER:
            self._better_since = None
            return better
        return leading

    def _held(
        self,
        stamp: int,
        half: int,
        heading: float,
        others: Sequence[float],
        recent: bool,
        angle: float,
        counters: Counter[str],
    ) -> float:
        """The heading; another sensor's, or the opposite, where the believed one turned the body between two frames.

        Nobody turns round in a thirtieth of a second: a sensor that says so errs now, or has erred before. Where
        another one goes on as before, it errs now, for as long as that one does, unless most sensors are with it. Else
        nobody knows whether it errs now or has until now. It does so for less time than it does not, so that the
        reversal is believed when it has lasted as long as what it contradicts; and seldom so that it sees somebody's
        back, so that who was seen to face it counts as one who was seen for long.
        """
        before = self._axes[half]
        sense = math.cos(before - heading)
        if recent and sense < SAME_SENSE:
            as_before = [other for other in others if math.cos(other - before) > _CLOSE]
            with_it = sum(math.cos(other - heading) > _CLOSE for other in others)
            # of as many on either side those are right that nobody has seen turn
            if len(as_before) > with_it:
                self._reversed_since[half] = None
                return max(as_before, key=lambda other: math.cos(other - before))
        if not (recent and sense < -SAME_SENSE):
            self._reversed_since[half] = None
            return heading
        since = self._reversed_since[half]
        if since is None:
            since = self._reversed_since[half] = stamp
        if stamp - since <= min(max(since - self._known_since[half], self._least_ns), self._hold_ns):
            return heading + math.pi
        counters["reversals_accepted"] += 1
        self._known_since[half] = self._credited(since, angle)
        return heading

    def _credited(self, stamp: int, angle: float) -> int:
        """Since when a body counts as known that a sensor sees from a time on, under an angle."""
        return stamp - self._hold_ns if angle < math.pi / 2 else stamp

    def turn_gently(self, stamp: int, fused: Skeleton, counters: Counter[str]) -> Skeleton:
        """Turn shoulders and hips, with arms and legs, no faster than a person can.

        When the believed sensors change their mind at once about which way a body faces, the output follows them on
        the way that a body would take, and never through a mirror.

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


def _turned(skeleton: Skeleton, half: int, angle: float) -> Skeleton:
    """One half of a body turned about the vertical through the middle of its axis."""
    assert skeleton.covariances is not None
    positions, covariances = skeleton.positions.copy(), skeleton.covariances.copy()
    joints = HALVES[half]
    centre = positions[PAIRS[half]].mean(axis=0)
    arms = positions[joints] - centre
    cosine, sine = math.cos(angle), math.sin(angle)
    moved = arms @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    # What was turned is as uncertain as it was moved.
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
