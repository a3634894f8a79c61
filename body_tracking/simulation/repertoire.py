"""What people do before the sensors: the thesis's test motions (Schlagenhauf 2017, 4.3.3-4.3.4, 5.6.1), others of daily
life and of exercise, and random ones.

A motion is told in the angles of people rather than of the model: where an upper arm points against the chest
(elevation, and the plane that it is raised in: 0 sideways, 90 forward) and how far it is turned about itself against
the shortest way there from hanging; how far the trunk is bent and turned as a whole. Shoulder girdle and spine share
these as they do in people: a clavicle rises by a third of the arm's elevation beyond 30 degrees (Inman et al., J. Bone
Joint Surg. 26 (1944) 1) and comes forward with the arm, lumbar and thoracic joints divide a bend by their ranges. The
pelvis is as high as bent or straight legs carry it; feet stand, pivot on their toes, rise on them, or walk.

Every movement is a closed function of time with continuous accelerations, made of minimum-jerk moves, sinusoids that
are taken up and given back smoothly, and the slow waves of somebody who cannot stand like a statue. No angle leaves the
ranges of ``kinematics.ranges``: close to a limit it is bent away from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from body_tracking.errors import BodyTrackingError
from body_tracking.kinematics import so3
from body_tracking.kinematics.ranges import SHOULDER_SWING, SHOULDER_TWIST, Ranges
from body_tracking.simulation.people import MODEL, Course, Person
from body_tracking.simulation.random_people import RandomMotion
from body_tracking.simulation.trajectories import Moves, Waves, eased, minimum_jerk
from body_tracking.skeleton import FloatArray, IntArray

TPOSE_S = 3.0
"""Seconds of T-pose at the beginning."""
END_S = 1.5
"""Seconds of T-pose at the end, at least."""
_ENTRY_S = 1.2
"""Seconds from the T-pose to the first posture, and back."""
_RAMP_S = 0.5
"""Seconds in which a repeated motion is taken up, and in which it is given back."""


class RepertoireError(BodyTrackingError):
    """Something was asked for that nobody here performs."""


# ---------------------------------------------------------------------------------------------------------------------
# postures: vectors of named quantities

_MIDDLE = (
    "pelvis_flexion",
    "pelvis_lateral",
    "pelvis_yaw",
    "forward",
    "left",
    "drop",
    "trunk_flexion",
    "trunk_lateral",
    "trunk_axial",
    "neck_flexion",
    "neck_lateral",
)
_SIDED = (
    "shrug",
    "reach",
    "elevation",
    "plane",
    "swing",
    "twist",
    "elbow",
    "pronation",
    "wrist_flexion",
    "wrist_deviation",
    "heel",
    "pivot",
)
"""Shrug and reach are elevation and protraction of a clavicle beyond what the arm asks of it; a swing moves an
arm forward whatever its plane; a twist is inwards; a heel rises about the toes; a foot pivots on them inwards."""
_NAMES: Final = (*_MIDDLE, *(f"{name}_{side}" for name in _SIDED for side in ("left", "right")))
"""Degrees, signs as those of the model's angles; ``forward``, ``left`` and ``drop`` of the pelvis from where it is
above standing feet, as shares of the length of the legs."""


def _posture(**quantities: float) -> FloatArray:
    """(35,) a posture; a name without its side means both sides, one that is missing 0."""
    result = np.zeros(len(_NAMES))
    for name, value in quantities.items():
        both = (f"{name}_left", f"{name}_right") if name in _SIDED else (name,)
        result[[_NAMES.index(one) for one in both]] = value
    return result


def _at(name: str) -> IntArray:
    """Where postures hold a quantity: left and right, or the one."""
    both = (f"{name}_left", f"{name}_right") if name in _SIDED else (name,)
    return np.array([_NAMES.index(one) for one in both], dtype=np.intp)


def _mirrored(posture: FloatArray) -> FloatArray:
    """(35,) the same with left and right exchanged."""
    result = posture.copy()
    for name in _SIDED:
        result[_at(name)] = posture[_at(name)[::-1]]
    for name in ("pelvis_lateral", "pelvis_yaw", "left", "trunk_lateral", "trunk_axial", "neck_lateral"):
        result[_at(name)] *= -1.0
    return result


_TPOSE: Final = _posture(elevation=88.0, plane=3.0, elbow=6.0)
_HANGING: Final = _posture(elevation=9.0, plane=15.0, twist=12.0, elbow=16.0, pronation=15.0, wrist_flexion=5.0)

# ---------------------------------------------------------------------------------------------------------------------
# from postures to configurations

_RANGES: Final = Ranges(MODEL)
_SCALAR_NAMES: Final = tuple(MODEL.coordinate_names[v] for v in MODEL.scalar_v)
_SCALAR_CENTRE: Final = _RANGES.centre[MODEL.scalar_v - 6]
_SCALAR_HALF: Final = 0.5 * (_RANGES.high - _RANGES.low)[MODEL.scalar_v - 6]
_SHOULDERS: Final = np.array([MODEL.coordinate_names.index(f"shoulder_x_{side}") for side in ("left", "right")]) - 6
_SHOULDER_QUATERNIONS: Final = tuple(MODEL.quaternion_of(f"upper_arm_{side}") for side in ("left", "right"))
_PELVIS_QUATERNION: Final = MODEL.quaternion_of("pelvis")
_FROM_CENTRE: Final = so3.quat_inverse(
    so3.exp(np.stack([_RANGES.soft_coordinates(MODEL.neutral()).values[start : start + 3] for start in _SHOULDERS]))
)
"""(2, 4) the upper arms at the centres of their reach, in the clavicles' frames."""

_SPINE_SHARES = {"flexion": 0.58, "lateral": 0.5, "axial": 0.3}
"""The lumbar joint's part of a bend, the rest is the thoracic one's: as their ranges."""
_RHYTHM = 1.0 / 3.0
_RHYTHM_FROM, _RHYTHM_SOFTNESS = 30.0, 8.0
"""Degrees of an arm's elevation from which the clavicle rises, and how gradually it begins to."""
_CLAVICLE_REST = -10.0
"""Degrees of elevation: a Kinect's shoulder points hang below its SpineShoulder."""
_PROTRACTION = 14.0
"""Degrees by which a clavicle comes forward with an arm that points forward."""
_ROOM = 0.9
"""Share of half a range within which an angle is what the motion says; beyond it bends away from the limit."""


def _bounded(share: FloatArray) -> FloatArray:
    """Itself up to 0.9, then ever less of it and always below 1; twice continuously differentiable, odd."""
    size = np.abs(share)
    bent = _ROOM + (1.0 - _ROOM) * np.tanh((size - _ROOM) / (1.0 - _ROOM))
    result: FloatArray = np.sign(share) * np.where(size > _ROOM, bent, size)
    return result


def _turns(angle: FloatArray, axis: tuple[float, float, float]) -> FloatArray:
    """(..., 4) quaternions of turns by (...) radians about an axis."""
    return so3.exp(angle[..., None] * np.array(axis))


def _configuration(postures: FloatArray) -> FloatArray:
    """(n, 35) configurations, the base at the origin, of postures (n, 35) of which only the heights are missing."""
    angles = np.radians(postures)
    value = {name: angles[:, number] for number, name in enumerate(_NAMES)}
    scalars: dict[str, FloatArray] = {name: value[name] for name in ("neck_flexion", "neck_lateral")}
    for bend, share in _SPINE_SHARES.items():
        scalars[f"lumbar_{bend}"] = share * value[f"trunk_{bend}"]
        scalars[f"thoracic_{bend}"] = (1.0 - share) * value[f"trunk_{bend}"]
    softness = np.radians(_RHYTHM_SOFTNESS)
    across: dict[str, tuple[FloatArray, FloatArray]] = {}
    for side in ("left", "right"):
        elevation, plane = value[f"elevation_{side}"], value[f"plane_{side}"]
        outward, ahead = elevation * np.cos(plane), elevation * np.sin(plane) + value[f"swing_{side}"]
        across[side] = outward, ahead
        raised = np.sqrt(outward**2 + ahead**2 + 1e-4)
        rhythm = _RHYTHM * softness * np.logaddexp(0.0, (raised - np.radians(_RHYTHM_FROM)) / softness)
        scalars[f"clavicle_elevation_{side}"] = np.radians(_CLAVICLE_REST) + rhythm + value[f"shrug_{side}"]
        forward = np.radians(_PROTRACTION) * np.sin(raised) * ahead / raised
        scalars[f"clavicle_protraction_{side}"] = forward + value[f"reach_{side}"]
        scalars[f"elbow_flexion_{side}"] = value[f"elbow_{side}"]
        scalars[f"forearm_pronation_{side}"] = value[f"pronation_{side}"]
        scalars[f"wrist_flexion_{side}"] = value[f"wrist_flexion_{side}"]
        scalars[f"wrist_deviation_{side}"] = value[f"wrist_deviation_{side}"]
    told = np.stack([scalars[name] for name in _SCALAR_NAMES], axis=1)
    bounded = _SCALAR_CENTRE + _SCALAR_HALF * _bounded((told - _SCALAR_CENTRE) / _SCALAR_HALF)

    q = np.tile(MODEL.neutral(), (len(postures), 1))
    q[:, MODEL.scalar_q] = bounded
    heading = _turns(value["pelvis_yaw"], (0.0, 0.0, 1.0))
    tilt = so3.quat_multiply(
        _turns(value["pelvis_flexion"], (0.0, 1.0, 0.0)), _turns(value["pelvis_lateral"], (1.0, 0.0, 0.0))
    )
    q[:, _PELVIS_QUATERNION] = so3.quat_multiply(heading, tilt)
    for side, sign, where in zip(("left", "right"), (1.0, -1.0), _SHOULDER_QUATERNIONS, strict=True):
        outward, ahead = across[side]
        swing = np.stack([sign * outward, -ahead, np.zeros_like(ahead)], axis=1)
        arm = so3.quat_multiply(so3.exp(swing), _turns(value[f"twist_{side}"], (0.0, 0.0, -sign)))
        clavicle = so3.quat_multiply(
            _turns(bounded[:, _SCALAR_NAMES.index(f"clavicle_protraction_{side}")], (0.0, 0.0, -sign)),
            _turns(bounded[:, _SCALAR_NAMES.index(f"clavicle_elevation_{side}")], (sign, 0.0, 0.0)),
        )
        q[:, where] = so3.quat_multiply(so3.quat_inverse(clavicle), arm)
    return _within_reach(q)


def _within_reach(q: FloatArray) -> FloatArray:
    """Shoulders bent away from the limits of their swing and twist."""
    values = _RANGES.soft_coordinates(q).values[:, _SHOULDERS[:, None] + np.arange(3)]
    size = np.linalg.norm(values[..., :2], axis=-1, keepdims=True) / np.radians(SHOULDER_SWING)
    values[..., :2] *= _bounded(size) / np.maximum(size, 1e-12)
    values[..., 2] = np.radians(SHOULDER_TWIST) * _bounded(values[..., 2] / np.radians(SHOULDER_TWIST))
    arms = so3.quat_multiply(_FROM_CENTRE, so3.exp(values))
    for side, where in enumerate(_SHOULDER_QUATERNIONS):
        q[:, where] = arms[:, side]
    return q


# ---------------------------------------------------------------------------------------------------------------------
# feet

_STANCE = 0.055
"""Of the stature: half the distance of the ankles of somebody who stands."""
_TOE_OUT = np.radians(8.0)
_BEHIND = 0.03
"""Of the stature: how far the ankles are behind the point above which the hips are."""
_STRAIGHT = 0.998
"""Share of a leg's length to which a knee straightens."""
_SOFTNESS = 0.006
"""Metres within which one leg after the other carries the pelvis."""


@dataclass(frozen=True, slots=True, eq=False)
class _Feet:
    """Where the feet are: the FOOT points (n, 2, 3) metres, headings (n, 2) and pitches (n, 2), radians.

    A pitch lifts the heel; the sole of a foot with pitch 0 is parallel to the floor.
    """

    toes: FloatArray
    heading: FloatArray
    pitch: FloatArray

    def ankles(self, person: Person) -> FloatArray:
        """(n, 2, 3) metres."""
        flat = np.arcsin((person.ankle_height - person.toe_height) / person.foot)
        along, up = person.foot * np.cos(flat + self.pitch), person.foot * np.sin(flat + self.pitch)
        back = np.stack([-along * np.cos(self.heading), -along * np.sin(self.heading), up], axis=-1)
        result: FloatArray = self.toes + back
        return result


def _footprints(person: Person, places: FloatArray, yaw: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of somebody who stands at places (n, 2) and faces yaw (n,): (n, 2, 3) FOOT points, (n, 2) headings."""
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


def _standing(person: Person, postures: FloatArray) -> _Feet:
    """Feet that stand, but for heels that rise and for pivoting on the toes."""
    toes, heading = _footprints(person, np.zeros((1, 2)), np.zeros(1))
    inward = np.radians(postures[:, _at("pivot")]) * [-1.0, 1.0]
    return _Feet(np.tile(toes, (len(postures), 1, 1)), heading + inward, np.radians(postures[:, _at("heel")]))


def _carried(person: Person, q: FloatArray, ankles: FloatArray, drop: FloatArray) -> FloatArray:
    """(n,) metres: how high the pelvis is whose hips both legs reach, ``drop`` (n,) metres below the highest."""
    hips = np.array(
        [
            [0.0, sign * person.length(f"hip_width_{side}"), -person.length("hip_drop")]
            for side, sign in (("left", 1.0), ("right", -1.0))
        ]
    )
    local = hips @ so3.quat_to_matrix(q[:, _PELVIS_QUATERNION]).swapaxes(1, 2)
    away = q[:, None, :2] + local[..., :2] - ankles[..., :2]
    reach = np.sqrt((_STRAIGHT * person.legs) ** 2 - (away**2).sum(axis=-1))
    heights = ankles[..., 2] + reach - local[..., 2]
    # below the lower one of the two, smoothly
    lowest: FloatArray = -_SOFTNESS * np.logaddexp(-heights[:, 0] / _SOFTNESS, -heights[:, 1] / _SOFTNESS)
    return lowest - drop


# ---------------------------------------------------------------------------------------------------------------------
# movements


@dataclass(frozen=True, slots=True, eq=False)
class Movement:
    """How somebody moves.

    Attributes:
        name: of :data:`MOTIONS`.
        duration: seconds.
        tpose_s: seconds of T-pose at the beginning; 0 where there is none.
    """

    name: str
    duration: float
    tpose_s: float
    _course: Callable[[FloatArray], Course] = field(repr=False)

    def course(self, times: FloatArray) -> Course:
        """How the body is placed at (n,) seconds, in the person's own frame: origin on the floor, x forward."""
        return self._course(np.asarray(times, dtype=np.float64))

    def velocity(self, times: FloatArray) -> FloatArray:
        """(n, 32) tangent velocities of the configuration; central differences of the closed form, good to 1e-5."""
        step = 1e-4
        before, after = self.course(times - step), self.course(times + step)
        result: FloatArray = MODEL.difference(before.q, after.q) / (2.0 * step)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Manner:
    """How somebody performs what others perform too.

    Attributes:
        tempo: factor of all rates.
        amplitude: (35,) factors of what a motion moves.
        habit: (35,) degrees and shares, what is always added.
        lag: (2,) seconds by which the sides come late.
        restless: (35,) amplitudes of the waves.
        waves, effort: the waves, and those by which one repetition differs from the next.
    """

    tempo: float
    amplitude: FloatArray
    habit: FloatArray
    lag: FloatArray
    restless: FloatArray
    waves: Waves
    effort: Waves

    @classmethod
    def of(cls, rng: np.random.Generator | None) -> _Manner:
        """Somebody's; without a generator that of the standard performance, which only sways."""
        restless = _posture(**_RESTLESS)
        size = len(_NAMES)
        if rng is None:
            fixed = np.random.default_rng(0)
            return cls(
                1.0, np.ones(size), np.zeros(size), np.zeros(2), restless, Waves(fixed, size, 0.5), Waves(fixed, 1, 0.4)
            )
        amplitude = np.full(size, 1.0 + 0.08 * _normal(rng))
        amplitude += 0.04 * _normal(rng, size)
        habit = _posture(**_HABITS) * _normal(rng, size)
        lag = np.zeros(2)
        lag[rng.integers(2)] = rng.uniform(0.0, 0.04)
        restless *= rng.uniform(0.6, 1.5)
        tempo = float(np.exp(0.13 * _normal(rng)))
        return cls(tempo, amplitude, habit, lag, restless, Waves(rng, size, 0.5), Waves(rng, 1, 0.4))

    def added(self, times: FloatArray) -> FloatArray:
        """(n, 35) what is added to the postures of a motion."""
        result: FloatArray = self.habit + self.restless * self.waves.at(times)
        return result


_RESTLESS = {
    "pelvis_flexion": 0.6,
    "pelvis_lateral": 0.6,
    "pelvis_yaw": 1.0,
    "forward": 0.010,
    "left": 0.007,
    "trunk_flexion": 1.2,
    "trunk_lateral": 1.0,
    "trunk_axial": 1.2,
    "neck_flexion": 2.5,
    "neck_lateral": 2.0,
    "shrug": 0.6,
    "reach": 0.8,
    "elevation": 1.6,
    "plane": 2.0,
    "twist": 2.0,
    "elbow": 2.0,
    "pronation": 4.0,
    "wrist_flexion": 4.0,
    "wrist_deviation": 2.0,
}
"""Amplitude of the waves, degrees and shares of the legs: standing people sway by some millimetres."""
_HABITS = {
    "pelvis_flexion": 1.5,
    "trunk_flexion": 2.0,
    "trunk_lateral": 0.7,
    "trunk_axial": 1.0,
    "neck_flexion": 4.0,
    "neck_lateral": 1.5,
    "shrug": 2.0,
    "reach": 2.0,
    "elevation": 2.5,
    "plane": 3.0,
    "twist": 4.0,
    "elbow": 3.0,
    "pronation": 7.0,
    "wrist_flexion": 5.0,
    "wrist_deviation": 3.0,
}
"""Standard deviation of what somebody does otherwise all the time."""


def _normal(rng: np.random.Generator, size: int | None = None) -> FloatArray:
    """Standard normal numbers, none beyond 2.2."""
    return np.clip(rng.normal(size=size), -2.2, 2.2)


@dataclass(frozen=True, slots=True, eq=False)
class _Swing:
    """What a repeated motion adds to the posture that it is about, in the course of one period.

    Attributes:
        out: added in the middle of the period, (1 - cos) / 2.
        sine: added by the sine.
        left, right: added in the first and in the second half, by the cube of the sine, which begins gently.
    """

    out: FloatArray = field(default_factory=lambda: np.zeros(len(_NAMES)))
    sine: FloatArray = field(default_factory=lambda: np.zeros(len(_NAMES)))
    left: FloatArray = field(default_factory=lambda: np.zeros(len(_NAMES)))
    right: FloatArray = field(default_factory=lambda: np.zeros(len(_NAMES)))

    def at(self, phase: FloatArray) -> FloatArray:
        """(n, 35) at phases (n,) or (n, 35), in periods."""
        turn = 2.0 * np.pi * (phase if phase.ndim == 2 else phase[:, None])
        sine = np.sin(turn)
        result: FloatArray = (
            self.out * 0.5 * (1.0 - np.cos(turn))
            + self.sine * sine
            + self.left * np.maximum(sine, 0.0) ** 3
            + self.right * np.maximum(-sine, 0.0) ** 3
        )
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Exercise:
    """A motion on the spot between two T-poses.

    Attributes:
        start: the posture from which it is done.
        repetitions: of the standard performance.
        period: seconds of a repetition.
        swing: what a repetition adds, and is done over and over; or
        round: postures one after the other, with the seconds to get to each and to stay there; it ends in ``start``.
    """

    start: FloatArray
    repetitions: int
    period: float = 0.0
    swing: _Swing | None = None
    round: tuple[tuple[FloatArray, float, float], ...] = ()

    @property
    def round_s(self) -> float:
        """Seconds of a repetition."""
        return self.period if self.swing is not None else sum(move + stay for _, move, stay in self.round)


def _perform(name: str, person: Person, manner: _Manner, exercise: _Exercise, seconds: float | None) -> Movement:
    """An exercise as a movement."""
    swing, entry, ramp = exercise.swing, _ENTRY_S / manner.tempo, _RAMP_S / manner.tempo
    period = exercise.round_s / manner.tempo
    about = TPOSE_S + 2.0 * entry + END_S + (ramp + manner.lag.max() if swing is not None else 0.0)
    repetitions = exercise.repetitions
    if seconds is not None:
        repetitions = int((seconds - about) / period + 1e-9)
        if repetitions < 1:
            raise RepertoireError(f"{name}: {seconds} s, it takes {about + period:.1f} s at least")
    begin = TPOSE_S + entry

    def moved(posture: FloatArray) -> FloatArray:
        """A posture as far from the start as this person goes."""
        return exercise.start + manner.amplitude * (posture - exercise.start)

    moves = Moves(_TPOSE)
    moves.move(TPOSE_S, entry, exercise.start)
    time = begin
    for _ in range(repetitions if swing is None else 0):
        for posture, move, stay in exercise.round:
            moves.move(time, move / manner.tempo, moved(posture))
            time += (move + stay) / manner.tempo
    if swing is not None:
        time += repetitions * period + ramp + manner.lag.max()
    moves.move(time, entry, _TPOSE)
    end = time + entry + END_S

    def course(times: FloatArray) -> Course:
        postures = moves.at(times) + manner.added(times)
        if swing is not None:
            late = np.zeros(len(_NAMES))
            for side in _SIDED:
                late[_at(side)] = manner.lag
            phase = eased(times[:, None] - begin - late, repetitions * period, ramp) / period
            effort = 1.0 + 0.06 * manner.effort.at(times)
            postures += effort * manner.amplitude * swing.at(phase)
        return _stand(person, times, postures)

    return Movement(name, end if seconds is None else seconds, TPOSE_S, course)


def _stand(person: Person, times: FloatArray, postures: FloatArray) -> Course:
    """Somebody on the spot."""
    return _compose(
        person, times, postures, _standing(person, postures), np.zeros((len(times), 2)), np.zeros(len(times))
    )


def _compose(
    person: Person, times: FloatArray, postures: FloatArray, feet: _Feet, places: FloatArray, yaw: FloatArray
) -> Course:
    """Postures on feet; the pelvis is off its places (n, 2) and headings (n,) by what the postures say."""
    turned = postures.copy()
    turned[:, _at("pelvis_yaw")[0]] += np.degrees(yaw)
    q = _configuration(turned)
    leg = float(person.legs.mean())
    forward, left, drop = (leg * postures[:, _at(name)[0]] for name in ("forward", "left", "drop"))
    q[:, 0] = places[:, 0] + np.cos(yaw) * forward - np.sin(yaw) * left
    q[:, 1] = places[:, 1] + np.sin(yaw) * forward + np.cos(yaw) * left
    ankles = feet.ankles(person)
    q[:, 2] = _carried(person, q, ankles, drop)
    return Course(times, q, ankles, feet.toes)


# ---------------------------------------------------------------------------------------------------------------------
# exercises


def _two_handed_wave(rng: np.random.Generator | None) -> _Exercise:
    """Upper arms out, forearms up, both swinging in the frontal plane (thesis, section 4.3.3)."""
    start = _posture(elevation=92.0, plane=10.0, twist=-70.0, elbow=100.0, pronation=10.0)
    return _Exercise(start, 5, 1.6, _Swing(out=_posture(elevation=14.0, elbow=-75.0)))


def _slow_down(rng: np.random.Generator | None) -> _Exercise:
    """Both arms forward, palms down, pressing down and rising again in the sagittal plane (thesis, section 4.3.3)."""
    start = _posture(elevation=105.0, plane=82.0, twist=22.0, elbow=60.0, pronation=60.0, wrist_flexion=-15.0)
    return _Exercise(start, 5, 2.0, _Swing(out=_posture(elevation=-60.0, elbow=-35.0, trunk_flexion=6.0)))


def _move_along(rng: np.random.Generator | None) -> _Exercise:
    """The left arm points to the left; the right hand goes round an ellipse (thesis, section 4.3.4)."""
    start = _posture(elevation_left=86.0, plane_left=8.0, elbow_left=5.0, pronation_left=15.0)
    start += _posture(elevation_right=72.0, plane_right=28.0, twist_right=-30.0, elbow_right=75.0, pronation_right=25.0)
    out = _posture(plane_right=60.0, twist_right=45.0, elbow_right=15.0, trunk_axial=3.0, plane_left=3.0)
    return _Exercise(start, 5, 1.8, _Swing(out=out, sine=_posture(elevation_right=20.0, elbow_right=-20.0)))


def _torso_twist(rng: np.random.Generator | None) -> _Exercise:
    """Arms out, the shoulders' line turning by about 90 degrees to each side against the feet (thesis, section 5.6.1).

    Hips, spine and shoulder girdle share the turn, and the foot left behind pivots on its toes.
    """
    start = _posture(elevation=82.0, plane=6.0, elbow=12.0)
    sine = _posture(pelvis_yaw=46.0, trunk_axial=40.0, trunk_lateral=2.0, reach_left=-6.0, reach_right=6.0)
    left = _posture(pivot_right=28.0, heel_right=28.0, drop=0.012)
    return _Exercise(start, 5, 3.6, _Swing(sine=sine, left=left, right=_mirrored(left)))


def _squat(rng: np.random.Generator | None) -> _Exercise:
    """Down until the thighs are almost level, the arms forward for balance (thesis, section 5.8, figure 5.16)."""
    out = _posture(
        drop=0.42,
        forward=-0.17,
        pelvis_flexion=32.0,
        trunk_flexion=14.0,
        neck_flexion=-22.0,
        swing=115.0,
        twist=-12.0,
        elbow=-6.0,
        pronation=30.0,
    )
    return _Exercise(_HANGING, 5, 3.2, _Swing(out=out))


def _calf_raise(rng: np.random.Generator | None) -> _Exercise:
    """Up onto the toes and down again (thesis, section 5.8, figure 5.16)."""
    return _Exercise(_HANGING, 6, 2.2, _Swing(out=_posture(heel=36.0, forward=0.06)))


def _arm_raises(rng: np.random.Generator | None) -> _Exercise:
    """Straight arms up and down: forward (flexion), in the plane of the scapula (scaption), sideways (abduction)."""
    raises = ((86.0, 0.0), (38.0, -8.0), (4.0, -30.0))
    steps: list[tuple[FloatArray, float, float]] = []
    for plane, twist in raises:
        down, up = (_posture(elevation=e, plane=plane, twist=t, elbow=8.0) for e, t in ((8.0, 0.0), (150.0, twist)))
        steps += [(down, 0.6, 0.0), (up, 1.5, 0.4), (down, 1.6, 0.3)]
    return _Exercise(_HANGING, 2, round=(*steps, (_HANGING, 0.6, 0.0)))


_LOW_LEGS = {"drop": 0.10, "forward": -0.07, "pelvis_flexion": 24.0}
_TARGETS: tuple[FloatArray, ...] = (
    # with the right arm: ahead, across, up, down, to the side
    _posture(
        elevation_right=86.0, plane_right=84.0, elbow_right=12.0, reach_right=8.0, trunk_flexion=8.0, trunk_axial=12.0
    ),
    _posture(
        elevation_right=80.0,
        plane_right=108.0,
        elbow_right=22.0,
        pronation_right=30.0,
        reach_right=8.0,
        trunk_axial=24.0,
        pelvis_yaw=14.0,
    ),
    _posture(elevation_right=138.0, plane_right=62.0, elbow_right=10.0, shrug_right=4.0, trunk_lateral=-6.0),
    _posture(
        elevation_right=62.0,
        plane_right=72.0,
        elbow_right=12.0,
        swing_left=42.0,
        trunk_flexion=34.0,
        trunk_axial=12.0,
        **_LOW_LEGS,
    ),
    _posture(elevation_right=96.0, plane_right=8.0, elbow_right=10.0, trunk_lateral=12.0, left=-0.04, trunk_axial=-6.0),
)
_OTHER_ARM = _posture(
    elevation_left=9.0, plane_left=15.0, twist_left=12.0, elbow_left=18.0, pronation_left=15.0, wrist_flexion_left=5.0
)


def _reaching(rng: np.random.Generator | None) -> _Exercise:
    """To five places with one arm after the other."""
    targets = [target + _OTHER_ARM for target in _TARGETS]
    targets = [target if number % 2 == 0 else _mirrored(target) for number, target in enumerate(targets)]
    if rng is not None:
        apart = _posture(elevation=9.0, plane=8.0, elbow=6.0, trunk_axial=4.0, trunk_flexion=3.0)
        targets = [target + apart * _normal(rng, len(_NAMES)) for target in targets]
        targets = [targets[k] if rng.random() < 0.5 else _mirrored(targets[k]) for k in rng.permutation(len(targets))]
    return _Exercise(
        _HANGING, 2, round=tuple(step for target in targets for step in ((target, 0.95, 0.3), (_HANGING, 0.95, 0.2)))
    )


def _hair_combing(rng: np.random.Generator | None) -> _Exercise:
    """One hand from the forehead over the crown to the nape, in a stroke."""
    front = _posture(elevation_right=118.0, plane_right=46.0, elbow_right=127.0)
    back = _posture(elevation_right=145.0, plane_right=34.0, twist_right=-66.0, elbow_right=140.0)
    crown = _posture(elevation_right=-2.0, twist_right=2.0, elbow_right=-13.0)
    start, out = front + _OTHER_ARM + _posture(neck_flexion=8.0), back - front
    # over the hair to the nape, and back through the air
    swing = _Swing(out=out, left=crown, right=1.8 * crown)
    if rng is not None and rng.random() < 0.1:
        start, swing = _mirrored(start), _Swing(_mirrored(out), left=_mirrored(crown), right=1.8 * _mirrored(crown))
    return _Exercise(start, 5, 1.9, swing)


def _forearm_rolling(rng: np.random.Generator | None) -> _Exercise:
    """Both forearms before the chest, rolling about each other."""
    centre = _posture(elevation=48.0, plane=46.0, twist=54.0, elbow=111.0, pronation=40.0)
    # what takes a left hand 9 cm forward, and up
    forward = _posture(plane_left=4.0, twist_left=-7.5, elbow_left=-12.5)
    up = _posture(plane_left=1.6, twist_left=-10.5, elbow_left=8.5)
    forward, up = forward - _mirrored(forward), up - _mirrored(up)
    return _Exercise(centre + forward, 8, 1.1, _Swing(out=-2.0 * forward, sine=-up))


def _punching(rng: np.random.Generator | None) -> _Exercise:
    """From a boxer's guard, left and right in turn."""
    start = _posture(elevation=32.0, plane=55.0, twist=15.0, elbow=128.0, pronation=10.0, drop=0.03, trunk_flexion=6.0)
    arm = _posture(
        elevation_left=56.0,
        plane_left=33.0,
        twist_left=10.0,
        elbow_left=-118.0,
        pronation_left=65.0,
        reach_left=6.0,
        trunk_axial=-20.0,
        pelvis_yaw=-14.0,
    )
    return _Exercise(start, 8, 1.4, _Swing(left=arm, right=_mirrored(arm)))


def _shoulder_lifts(rng: np.random.Generator | None) -> _Exercise:
    """Both shoulders up and down, the arms hanging."""
    return _Exercise(_HANGING, 6, 1.8, _Swing(out=_posture(shrug=26.0, elevation=3.0, elbow=6.0)))


_EXERCISES: dict[str, Callable[[np.random.Generator | None], _Exercise]] = {
    "two_handed_wave": _two_handed_wave,
    "slow_down": _slow_down,
    "move_along": _move_along,
    "torso_twist": _torso_twist,
    "squat": _squat,
    "calf_raise": _calf_raise,
    "arm_raises": _arm_raises,
    "reaching": _reaching,
    "hair_combing": _hair_combing,
    "forearm_rolling": _forearm_rolling,
    "punching": _punching,
    "shoulder_lifts": _shoulder_lifts,
}
"""The first six are the thesis's (sections 4.3.3-4.3.4 with figures 4.14 and 4.18, 5.6.1, 5.8).

Arm raises, hair combing, forearm rolling, punching and shoulder lifts are among those of Jatesiktat et al. (2018),
section IV-B.
"""


# ---------------------------------------------------------------------------------------------------------------------
# standing, walking, anything


class _Steps:
    """Feet that follow a path: one foot after the other swings to where it stands best half a stance later.

    Args:
        person: who walks.
        path: (n,) seconds to places (n, 2), metres, and headings (n,), radians.
        begin, end: seconds between which steps begin.
        step_s: seconds from a step to the next one's.
    """

    _SWING = 0.84
    """Seconds that a foot is in the air, per step: 42 % of a stride."""
    _HIGH, _TIPTOE = 0.05, np.radians(52.0)
    """Metres to which a foot is lifted, and the pitch with which it leaves the floor, of long steps."""

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
        # in the middle of the stance that follows
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

    def at(self, times: FloatArray) -> _Feet:
        """Where the feet are at (n,) seconds."""
        where = np.stack([moves.at(times) for moves in self._moves], axis=1)
        pitch = np.concatenate([pitch.at(times) for pitch in self._pitch], axis=1)
        up = np.zeros((len(times), 2))
        for side, (starts, heights) in enumerate(self._lifts):
            x = np.clip((times[:, None] - np.array(starts)) / self._swing, 0.0, 1.0)
            up[:, side] = (64.0 * (x * (1.0 - x)) ** 3) @ np.array(heights)
        toes = np.concatenate([where[..., :2], (self._height + up)[..., None]], axis=-1)
        return _Feet(toes, where[..., 2], pitch)


def _standing_still(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """Arms hanging, swaying as people do."""
    manner = _Manner.of(rng)
    return Movement(
        name,
        20.0 if seconds is None else seconds,
        0.0,
        lambda times: _stand(person, times, _HANGING + manner.added(times)),
    )


_WALK_RATE = 0.85
"""Metres per second of somebody with legs of 0.86 m in a room."""
_STEP_S = 0.55
_TURN_RATE = np.radians(95.0)
_WITHIN = 0.9
"""Metres: how far from the origin people walk."""


def _walking_and_turning(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """To and fro in a room, turning towards where to go next; the standard walk goes from side to side."""
    manner = _Manner.of(rng)
    duration = 20.0 if seconds is None else seconds
    speed = _WALK_RATE * manner.tempo * float(np.sqrt(person.legs.mean() / 0.86))
    step_s, ramp = _STEP_S / manner.tempo * float(np.sqrt(person.legs.mean() / 0.86)), 0.5
    heading = Moves(np.zeros(1))
    walks: list[tuple[float, float, FloatArray]] = []
    here, time, number = np.zeros(2), 0.8, 0
    while True:
        target = _WITHIN * np.array([0.0, 1.0 if number % 2 == 0 else -1.0])
        while rng is not None:
            target = _WITHIN * np.sqrt(rng.random()) * np.array([np.cos(a := rng.uniform(0.0, 2.0 * np.pi)), np.sin(a)])
            if np.linalg.norm(target - here) > 0.6 * _WITHIN:
                break
        way = target - here
        distance = float(np.linalg.norm(way))
        turn = np.arctan2(way[1], way[0]) - heading.target[0]
        turn = np.remainder(turn + np.pi, 2.0 * np.pi) - np.pi
        turning = max(1.0, 1.4 * abs(turn) / (_TURN_RATE * manner.tempo))
        begin = time + 0.7 * turning
        end = begin + distance / speed + ramp
        if end > duration - 1.0:
            break
        heading.move(time, turning, heading.target + turn)
        walks.append((begin, distance / speed, way / distance * speed))
        here, time, number = target, end - 0.3, number + 1
    if not walks:
        raise RepertoireError(f"{name}: {duration} s, too short to walk anywhere (6 s are enough)")

    def path(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        places = sum((eased(times - b, length, ramp)[:, None] * rate for b, length, rate in walks), np.zeros(2))
        return places, heading.at(times)[:, 0]

    first = 0.8
    steps = _Steps(person, path, first, duration - step_s, step_s)

    def course(times: FloatArray) -> Course:
        pace = sum(
            (minimum_jerk((times - b) / ramp) - minimum_jerk((times - b - length) / ramp) for b, length, _ in walks),
            np.zeros(len(times)),
        )
        # the left foot is in the air about half = 1, and lands about half = 0
        stride = np.pi * (times - first) / step_s
        over, landing = pace * np.cos(stride - 0.4 * np.pi), pace * np.cos(stride - 0.8 * np.pi)
        postures = _HANGING + manner.added(times)
        postures += manner.amplitude * (np.outer(over, _OVER) + np.outer(landing, _LANDING) + np.outer(pace, _PACE))
        return _compose(person, times, postures, steps.at(times), *path(times))

    return Movement(name, duration, 0.0, course)


_OVER = _posture(left=-0.022, pelvis_lateral=-3.0, trunk_lateral=2.5)
"""Of walking, while the left foot is in the air: over the right one."""
_LANDING = _posture(
    pelvis_yaw=-4.0,
    trunk_axial=8.0,
    swing_left=-20.0,
    swing_right=20.0,
    elbow_right=8.0,
    elbow_left=-8.0,
)
"""Of walking, when the left foot lands: the left hip and the right shoulder are ahead."""
_PACE = _posture(trunk_flexion=3.0, pelvis_flexion=2.0, elbow=8.0)
"""Of walking, always."""


def _random(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """Anything within the ranges of motion (``random_people``), on feet that follow."""
    chance = np.random.default_rng(0) if rng is None else rng
    duration = 20.0 if seconds is None else seconds
    motion = RandomMotion(chance, duration, tempo=float(0.4 * 2.5 ** chance.random()))

    def base(times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Configurations, places and headings; the latter may be off by full turns."""
        q = motion.configuration(times)
        left = so3.quat_to_matrix(q[:, _PELVIS_QUATERNION])[:, :, 1]
        return q, q[:, :2], np.arctan2(-left[:, 0], left[:, 1])

    def path(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        # headings are continuous in time: found between instants close to each other
        dense = np.arange(0.0, times.max() + 0.1, 0.05)
        _, _, turned = base(dense)
        _, places, yaw = base(times)
        near = np.unwrap(turned)[np.searchsorted(dense, times).clip(max=len(dense) - 1)]
        return places, yaw + 2.0 * np.pi * np.round((near - yaw) / (2.0 * np.pi))

    steps = _Steps(person, path, 0.0, duration, 0.3)
    _, place, yaw = base(np.zeros(1))

    def course(times: FloatArray) -> Course:
        q, _, _ = base(times)
        feet = steps.at(times)
        ankles = feet.ankles(person)
        q[:, 2] = _carried(person, q, ankles, 0.015 - q[:, 2])
        back = Course(times, q, ankles, feet.toes).placed(np.array([*-place[0], 0.0]), 0.0)
        return back.placed(np.zeros(3), -float(yaw[0]))

    return Movement(name, duration, 0.0, course)


_Builder = Callable[[str, Person, np.random.Generator | None, float | None], Movement]


def _exercise(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    return _perform(name, person, _Manner.of(rng), _EXERCISES[name](rng), seconds)


MOTIONS: dict[str, _Builder] = {
    **dict.fromkeys(_EXERCISES, _exercise),
    "walking_and_turning": _walking_and_turning,
    "standing_still": _standing_still,
    "random": _random,
}
"""What people can do, by name."""


def make_movement(
    name: str, person: Person, rng: np.random.Generator | None = None, seconds: float | None = None
) -> Movement:
    """Somebody's way of doing something.

    Args:
        name: of :data:`MOTIONS`.
        person: who does it.
        rng: where tempo, amplitude, asymmetry and sway come from; without it the standard performance.
        seconds: how long it takes, reached by more repetitions or fewer; as usual without it.

    Raises:
        RepertoireError: an unknown name, or too few seconds for what is to be done.
    """
    if name not in MOTIONS:
        raise RepertoireError(f"unknown motion {name!r}, expected one of {', '.join(MOTIONS)}")
    if seconds is not None and not 0.0 < seconds < np.inf:
        raise RepertoireError(f"{name}: {seconds} s")
    return MOTIONS[name](name, person, rng, seconds)
