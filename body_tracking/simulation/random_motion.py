"""Random motions of the body model, inside its ranges of motion.

The caller passes a seeded generator. A motion is a closed function of time: phases of rest
and activity, in which trunk, neck, arms and base make minimum-jerk moves (Flash and Hogan 1985) between random
postures, plus slow waves (0.05 to 0.8 Hz). Every angle stays inside its range at every instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import (
    FloatArray,
    IntArray,
)
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.trajectories import WAVE_BAND, Moves, Waves
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.postures import FROM_CENTRE, PELVIS_QUATERNION, SHOULDER_QUATERNIONS

_RANGES: Final = Ranges(MODEL)
_NAMES: Final = MODEL.coordinate_names[6:]
_CENTRE: Final = _RANGES.centre
_HALF: Final = 0.5 * (_RANGES.high - _RANGES.low)
"""(26,) centres and half widths of the ranges; postures are drawn as shares u: coordinate = centre + half u."""

TEMPI = (0.4, 1.6)
"""Range from calm to brisk: factor on the greatest angular rates of moves, and divisor of the shortest durations."""
_TRUNK_RATE, _NECK_RATE, _ARM_RATE = np.radians([100.0, 150.0, 200.0])
_PEAK_OF_MEAN = 1.875
"""Ratio of peak to mean velocity of a minimum-jerk move."""
_SHORTEST_MOVE = np.radians(90.0)
"""Shortest duration of a move, seconds, times its greatest rate: 0.9 s for the trunk, 0.45 s for an arm."""

_WAVE_SHARE = 0.25
"""Amplitude of the waves in the middle of a range, as a share of its half width; it falls to 0 at the ends."""
_RESTLESSNESS = 0.04
"""Share of the waves that remains at rest."""

_SWAY = np.array([0.006, 0.006, 0.002, *np.radians([1.0, 1.0, 1.5])])
"""Sway amplitude of a standing person's base: metres, then radians about its own axes."""
_PELVIS = np.radians([4.0, 6.0, 0.0])
"""Amplitude of the additional pelvic tilt of an active person."""

_DIRECTIONS = {
    "arms_up": (0.0, 0.0, 1.0),
    "arms_down": (0.0, 0.0, -1.0),
    "arms_forward": (1.0, 0.0, 0.0),
    "t_pose": (0.0, 1.0, 0.0),
}
"""Direction of the left arm in special postures with straight arms and upright trunk; the right arm is mirrored."""
POSTURES: Final = tuple(_DIRECTIONS)


def _indices(*starts: str, end: str = "") -> IntArray:
    return np.array(
        [k for k, name in enumerate(_NAMES) if name.startswith(starts) and name.endswith(end)], dtype=np.intp
    )


_TRUNK = _indices("lumbar", "thoracic")
_TWIST = np.array([_NAMES.index("lumbar_axial"), _NAMES.index("thoracic_axial")], dtype=np.intp)
_NECK = _indices("neck")
_ARMS = tuple(_indices("clavicle", "shoulder", "elbow", "forearm", "wrist", end=side) for side in ("_left", "_right"))
"""Per side: clavicle (2), shoulder (3), elbow, forearm, wrist (2)."""
_SHOULDERS = np.stack([_indices("shoulder", end=side) for side in ("_left", "_right")])
_HANGING: Final = _RANGES.values(MODEL.neutral())[_SHOULDERS]
"""(2, 3) rotation vectors of hanging arms from the centres of their reach."""
_MIRROR_ARM = np.array([1.0, 1.0, -1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
"""Factors from a left arm's shares to a right arm's: only the shoulder's rotation vector changes signs."""


def _share(degrees: FloatArray, where: IntArray) -> FloatArray:
    """Angles in degrees as shares of the half ranges, clipped to 95 % of them."""
    result: FloatArray = np.clip((np.radians(degrees) - _CENTRE[where]) / _HALF[where], -0.95, 0.95)
    return result


def _draw_trunk(rng: np.random.Generator) -> FloatArray:
    """(6,) shares: often upright; lumbar and thoracic axial rotation share the twist roughly by their ranges."""
    if rng.random() < 0.4:
        shares, twist = _share(rng.normal(scale=4.0, size=len(_TRUNK)), _TRUNK), 0.1 * rng.normal()
    else:
        shares, twist = 0.45 * rng.uniform(-1.0, 1.0, (2, len(_TRUNK))).sum(axis=0), 0.7 * rng.uniform(-1.0, 1.0)
    shares[np.isin(_TRUNK, _TWIST)] = np.clip(twist, -0.7, 0.7) + 0.25 * rng.uniform(-1.0, 1.0, 2)
    return shares


def _draw_neck(rng: np.random.Generator) -> FloatArray:
    if rng.random() < 0.4:
        return _share(rng.normal(scale=5.0, size=len(_NECK)), _NECK)
    shares: FloatArray = 0.8 * rng.uniform(-1.0, 1.0, len(_NECK))
    return shares


def _draw_arm(rng: np.random.Generator) -> FloatArray:
    """(9,) shares of a left arm: hanging, or anywhere within its reach."""
    arm = _ARMS[0]
    if rng.random() < 0.25:
        shares = _share(
            np.array([*rng.normal(scale=3.0, size=2), 0, 0, 0, rng.uniform(5, 25), *rng.normal(scale=10.0, size=3)]),
            arm,
        )
        shares[2:5] = (_HANGING[0] + np.radians(rng.normal(scale=6.0, size=3))) / _HALF[_SHOULDERS[0]]
        return shares
    shares = 0.8 * rng.uniform(-1.0, 1.0, len(arm))
    direction, size = rng.uniform(0.0, 2.0 * np.pi), 0.8 * np.sqrt(rng.random())
    shares[2:4] = size * np.cos(direction), size * np.sin(direction)
    return shares


def _draw_posture(rng: np.random.Generator, name: str) -> FloatArray:
    """(26,) shares of a special posture: upright within 2 degrees, elbows straight within 3."""
    shares = _share(rng.normal(scale=2.0, size=len(_NAMES)), np.arange(len(_NAMES), dtype=np.intp))
    for side, arm in enumerate(_ARMS):
        direction = np.array(_DIRECTIONS[name]) * [1.0, 1.0 if side == 0 else -1.0, 1.0]
        centre = so3.quat_to_matrix(FROM_CENTRE[side])
        # the shortest rotation from the centre of the reach, as a rotation vector in the upper arm's frame there
        wanted = centre.T @ direction
        axis = np.cross([0.0, 0.0, -1.0], wanted)
        swing = np.arctan2(np.linalg.norm(axis), -wanted[2]) * axis / np.linalg.norm(axis)
        shares[arm[2:5]] = (swing + np.radians([0.0, 0.0, rng.normal(scale=15.0)])) / _HALF[arm[2:5]]
        shares[arm[5]] = _share(np.array([rng.uniform(0.0, 3.0)]), arm[5:6])[0]
    return shares


class RandomMotion:
    """A person's motion as a function of time.

    Args:
        rng: random generator.
        duration: seconds of motion; the person rests afterwards.
        tempo: 0.4 calm to 1.6 brisk; None draws it (log-uniformly).
        postures: special postures (:data:`POSTURES`) to take in this order, each held for 1 to 2 s.
        full_turns: least number of full turns of the body.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        duration: float,
        tempo: float | None = None,
        postures: Sequence[str] = (),
        full_turns: int = 0,
    ) -> None:
        low, high = TEMPI
        self.tempo = low * (high / low) ** rng.random() if tempo is None else tempo
        fastest = WAVE_BAND[1] * min(self.tempo, 1.0)
        self._waves = Waves(rng, len(_NAMES), fastest)
        self._pelvis = Waves(rng, 3, fastest)
        self._sway = Waves(rng, 6, 0.5)
        self._trunk = Moves(_draw_trunk(rng), _HALF[_TRUNK], _TRUNK_RATE)
        self._neck = Moves(_draw_neck(rng), _HALF[_NECK], _NECK_RATE)
        left, right = _draw_arm(rng), _draw_arm(rng) * _MIRROR_ARM
        self._arms = (Moves(left, _HALF[_ARMS[0]], _ARM_RATE), Moves(right, _HALF[_ARMS[1]], _ARM_RATE))
        self._activity = Moves(np.zeros(1))
        self._base = Moves(np.array([*self._draw_place(rng), 0.0, rng.uniform(-np.pi, np.pi)]))
        self._choreograph(rng, duration, list(postures), full_turns)

    def configuration(self, times: FloatArray) -> FloatArray:
        """(n, 35) configurations of ``UpperBody`` at (n,) seconds."""
        goal = np.empty((len(times), len(_NAMES)))
        goal[:, _TRUNK] = self._trunk.at(times)
        goal[:, _NECK] = self._neck.at(times)
        for course, arm in zip(self._arms, _ARMS, strict=True):
            goal[:, arm] = course.at(times)
        activity = _RESTLESSNESS + (1.0 - _RESTLESSNESS) * self._activity.at(times)
        waves = self._waves.at(times)
        waves[:, _TWIST[0]] = 0.7 * waves[:, _TWIST[1]] + 0.3 * waves[:, _TWIST[0]]
        swing = _SHOULDERS[:, :2]
        waves[:, swing] /= np.sqrt(2.0)
        # |u| + a (1 - u^2) <= 1 for |u| <= 1 and a <= 1/2, so angles stay in range; a swing's two components count
        # together
        room = 1.0 - goal**2
        room[:, swing] = 1.0 - (goal[:, swing] ** 2).sum(axis=-1, keepdims=True)
        soft = _CENTRE + _HALF * (goal + _WAVE_SHARE * activity * waves * room)

        q = np.tile(MODEL.neutral(), (len(times), 1))
        q[:, MODEL.scalar_q] = soft[:, MODEL.scalar_v - 6]
        for where, centre, shoulder in zip(SHOULDER_QUATERNIONS, FROM_CENTRE, _SHOULDERS, strict=True):
            q[:, where] = so3.quat_multiply(centre, so3.exp(soft[:, shoulder]))
        base, sway = self._base.at(times), _SWAY * self._sway.at(times)
        q[:, :3] = base[:, :3] + sway[:, :3]
        yaw = np.zeros((len(times), 3))
        yaw[:, 2] = base[:, 3]
        tilt = sway[:, 3:] + _PELVIS * activity * self._pelvis.at(times)
        q[:, PELVIS_QUATERNION] = so3.quat_multiply(so3.exp(yaw), so3.exp(tilt))
        return q

    @staticmethod
    def _draw_place(rng: np.random.Generator) -> FloatArray:
        """(2,) position on the floor, metres: about 2 m in front of the reference sensor."""
        radius, direction = 0.6 * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
        return np.array([2.0 + radius * np.cos(direction), radius * np.sin(direction)])

    def _reach(self, course: Moves, begin: float, target: FloatArray, slower: float) -> None:
        """Add a move as fast as the tempo allows, or slower by a factor."""
        way = float(np.abs((target - course.target) * course.half).max())
        course.move(begin, slower * max(_PEAK_OF_MEAN * way, _SHORTEST_MOVE) / (course.rate * self.tempo), target)

    def _choreograph(self, rng: np.random.Generator, duration: float, postures: list[str], full_turns: int) -> None:
        time = rng.uniform(0.2, 1.0)
        while time < duration:
            if full_turns:
                full_turns -= 1
                end = self._turn(rng, time, full=True)
                time = self._act(rng, time, end) if rng.random() < 0.5 else end
            if postures:
                time = self._pose(rng, time, postures.pop(0)) + rng.uniform(1.0, 2.0)
            if rng.random() < 0.3:
                self._turn(rng, time, full=rng.random() < 0.25)
            elif rng.random() < 0.4:
                self._walk(rng, time)
            time = self._act(rng, time, time + rng.uniform(1.5, 3.5))
            time = max(time, self._base.end) + rng.uniform(0.4, 1.6)

    def _act(self, rng: np.random.Generator, begin: float, end: float) -> float:
        """Move trunk, neck and arms between two instants; returns the time at which all moves have ended."""
        ramp = 0.5 / self.tempo
        self._activity.move(begin, ramp, np.ones(1))
        together = rng.random() < 0.35
        left, right = self._arms
        parts: tuple[tuple[Moves, float, Callable[[np.random.Generator], FloatArray]], ...] = (
            (self._trunk, 0.7, _draw_trunk),
            (self._neck, 0.6, _draw_neck),
            (left, 0.85, _draw_arm),
            (right, 0.85, lambda rng: _draw_arm(rng) * _MIRROR_ARM),
        )
        for course, probability, draw in parts:
            if rng.random() > probability or (together and course is right):
                continue
            time = begin + rng.uniform(0.0, 0.5)
            while time < end:
                target, slower = draw(rng), rng.uniform(1.0, 2.0)
                self._reach(course, time, target, slower)
                if together and course is left:
                    self._reach(right, time, target * _MIRROR_ARM, slower)
                time = course.end + rng.uniform(0.0, 0.6)
        done = max(end, self._trunk.end, self._neck.end, *(arm.end for arm in self._arms))
        self._activity.move(done - ramp, ramp, np.zeros(1))
        return self._activity.end

    def _pose(self, rng: np.random.Generator, begin: float, name: str) -> float:
        """Take a special posture; returns the time at which it is reached."""
        shares = _draw_posture(rng, name)
        slower = rng.uniform(1.0, 1.5)
        for course, where in ((self._trunk, _TRUNK), (self._neck, _NECK), *zip(self._arms, _ARMS, strict=True)):
            self._reach(course, begin, shares[where], slower)
        return max(self._trunk.end, self._neck.end, *(arm.end for arm in self._arms))

    def _turn(self, rng: np.random.Generator, begin: float, full: bool) -> float:
        """Turn on the spot; returns the time at which the turn ends."""
        angle = 2.0 * np.pi if full else np.radians(rng.uniform(30.0, 180.0))
        slowest = 3.5 if full else 0.8
        duration = max(slowest, angle / np.radians(120.0)) * rng.uniform(0.8, 1.4) / np.sqrt(self.tempo)
        self._base.move(begin, duration, self._base.target + [0.0, 0.0, 0.0, rng.choice([-1.0, 1.0]) * angle])
        return self._base.end

    def _walk(self, rng: np.random.Generator, begin: float) -> None:
        """One to three steps of 0.2 to 0.6 m towards random places, with slightly bent knees."""
        for _ in range(rng.integers(1, 4)):
            way = self._draw_place(rng) - self._base.target[:2]
            way *= min(1.0, rng.uniform(0.2, 0.6) / float(np.linalg.norm(way)))
            place = self._base.target.copy()
            place[:2] += way
            place[2] = rng.uniform(-0.04, 0.01)
            place[3] += np.radians(rng.normal(scale=10.0))
            self._base.move(begin, rng.uniform(0.5, 0.8) / np.sqrt(self.tempo), place)
