"""Feet that stand, lift and step, and the height of the pelvis above them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.trajectories import Moves
from body_tracking.simulation.people import Person
from body_tracking.simulation.postures import PELVIS_QUATERNION, at

_STANCE = 0.055
"""Half the distance between the ankles when standing, as a share of the stature."""
_TOE_OUT = np.radians(8.0)
_BEHIND = 0.03
"""Distance of the ankles behind the hips when standing, as a share of the stature."""
_STRAIGHT = 0.998
"""Largest distance of hip and ankle as a share of the leg's length."""
_SOFTNESS = 0.006
"""Metres within which the support changes smoothly from one leg to the other."""


@dataclass(frozen=True, slots=True, eq=False)
class Feet:
    """Poses of the feet: FOOT points (n, 2, 3) metres, headings (n, 2) and pitches (n, 2), radians.

    A pitch lifts the heel; the sole of a foot with pitch 0 is parallel to the floor.
    """

    toes: FloatArray
    heading: FloatArray
    pitch: FloatArray

    def ankles(self, person: Person) -> FloatArray:
        """(n, 2, 3) ankle positions, metres."""
        flat = np.arcsin((person.ankle_height - person.toe_height) / person.foot)
        along, up = person.foot * np.cos(flat + self.pitch), person.foot * np.sin(flat + self.pitch)
        back = np.stack([-along * np.cos(self.heading), -along * np.sin(self.heading), up], axis=-1)
        result: FloatArray = self.toes + back
        return result


def _footprints(person: Person, places: FloatArray, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 2, 3) FOOT points and (n, 2) headings of a person who stands at places (n, 2) with yaw (n,)."""
    out = np.array([_TOE_OUT, -_TOE_OUT])
    heading = yaw[:, None] + out
    length = np.sqrt(person.foot**2 - (person.ankle_height - person.toe_height) ** 2)
    ankles = person.stature * np.array([[-_BEHIND, _STANCE], [-_BEHIND, -_STANCE]])
    local = ankles + length * np.stack([np.cos(out), np.sin(out)], axis=1)
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    toes = np.stack(
        [
            places[:, None, 0] + cos * local[:, 0] - sin * local[:, 1],
            places[:, None, 1] + sin * local[:, 0] + cos * local[:, 1],
            np.full((len(places), 2), person.toe_height),
        ],
        axis=-1,
    )
    return toes, heading


def standing(person: Person, postures: FloatArray) -> Feet:
    """Feet on the spot, with heel rise and pivoting on the toes."""
    toes, heading = _footprints(person, np.zeros((1, 2)), np.zeros(1))
    inward = np.radians(postures[:, at("pivot")]) * [-1.0, 1.0]
    return Feet(np.tile(toes, (len(postures), 1, 1)), heading + inward, np.radians(postures[:, at("heel")]))


def carried(person: Person, q: FloatArray, ankles: FloatArray, drop: FloatArray) -> FloatArray:
    """(n,) height of the pelvis, metres: ``drop`` (n,) metres below the greatest height that both legs reach."""
    hips = np.array(
        [
            [0.0, sign * person.length(f"hip_width_{side}"), -person.length("hip_drop")]
            for side, sign in (("left", 1.0), ("right", -1.0))
        ]
    )
    local = hips @ so3.quat_to_matrix(q[:, PELVIS_QUATERNION]).swapaxes(1, 2)
    away = q[:, None, :2] + local[..., :2] - ankles[..., :2]
    reach = np.sqrt((_STRAIGHT * person.legs) ** 2 - (away**2).sum(axis=-1))
    heights = ankles[..., 2] + reach - local[..., 2]
    # a smooth minimum of the two
    lowest: FloatArray = -_SOFTNESS * np.logaddexp(-heights[:, 0] / _SOFTNESS, -heights[:, 1] / _SOFTNESS)
    return lowest - drop


class Steps:
    """Feet that follow a path: in turn, each foot swings to the path's position at the middle of its next stance.

    Args:
        person: the body.
        path: from (n,) seconds to positions (n, 2), metres, and headings (n,), radians.
        begin, end: seconds between which steps begin.
        step_s: seconds between the starts of two steps.
    """

    _SWING = 0.84
    """Share of ``step_s`` that a foot is in the air: 42 % of a stride."""
    _HIGH, _TIPTOE = 0.05, np.radians(52.0)
    """For long steps: height of a swinging foot, metres, and its pitch at lift-off."""

    def __init__(
        self,
        person: Person,
        path: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
        begin: float,
        end: float,
        step_s: float,
    ) -> None:
        swing = self._SWING * step_s
        starts = np.arange(begin, end, step_s)
        # at the middle of the following stance
        toes, heading = _footprints(person, *path(np.concatenate([[0.0], starts + 0.5 * swing + step_s])))
        where = np.concatenate([toes[..., :2], heading[..., None]], axis=-1)
        self._height = person.toe_height
        self._moves = [Moves(where[0, side]) for side in range(2)]
        self._pitch = [Moves(np.zeros(1)) for _ in range(2)]
        self._lifts: list[tuple[list[float], list[float]]] = [([], []), ([], [])]
        self._swing = swing
        for number, start in enumerate(starts):
            side = number % 2
            way = where[number + 1, side] - self._moves[side].target
            size = float(np.hypot(np.linalg.norm(way[:2]), 0.3 * way[2]))
            if size < 0.02:
                continue
            self._moves[side].move(float(start), swing, where[number + 1, side])
            self._lifts[side][0].append(float(start))
            self._lifts[side][1].append(self._HIGH * float(np.tanh(size / 0.15)))
            pitch = np.array([self._TIPTOE * np.tanh(size / 0.9)])
            self._pitch[side].move(float(start) - 0.55 * step_s, 0.55 * step_s + 0.15 * swing, pitch)
            self._pitch[side].move(float(start) + 0.15 * swing, 0.7 * swing, np.zeros(1))

    def at(self, times: FloatArray) -> Feet:
        """The feet at (n,) seconds."""
        where = np.stack([moves.at(times) for moves in self._moves], axis=1)
        pitch = np.concatenate([pitch.at(times) for pitch in self._pitch], axis=1)
        up = np.zeros((len(times), 2))
        for side, (starts, heights) in enumerate(self._lifts):
            x = np.clip((times[:, None] - np.array(starts)) / self._swing, 0.0, 1.0)
            up[:, side] = (64.0 * (x * (1.0 - x)) ** 3) @ np.array(heights)
        toes = np.concatenate([where[..., :2], (self._height + up)[..., None]], axis=-1)
        return Feet(toes, where[..., 2], pitch)
