"""Motions of people: the thesis's test motions (Schlagenhauf 2017, 4.3.3-4.3.4, 5.6.1), others of daily life and
exercise, and random ones.

Every movement is a closed function of time with continuous accelerations, composed of minimum-jerk moves, sinusoids
that fade in and out, and slow sway.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.trajectories import Moves, Waves, eased, minimum_jerk
from body_tracking.simulation.exercises import EXERCISES, Exercise, normal
from body_tracking.simulation.feet import Feet, Steps, carried, standing
from body_tracking.simulation.people import Course, Person
from body_tracking.simulation.postures import (
    HANGING,
    NAMES,
    PELVIS_QUATERNION,
    SIDED,
    TPOSE,
    at,
    configuration,
    posture,
)
from body_tracking.simulation.random_motion import RandomMotion

TPOSE_S = 3.0
"""Seconds of T-pose at the beginning."""
END_S = 1.5
"""Least duration of the T-pose at the end, seconds."""
_ENTRY_S = 1.2
"""Duration of the move from the T-pose to the first posture, and back, seconds."""
_RAMP_S = 0.5
"""Duration of the fade-in and of the fade-out of a periodic motion, seconds."""


class RepertoireError(BodyTrackingError):
    """Raised for an unknown motion, or too short a duration."""


# ---------------------------------------------------------------------------------------------------------------------
# movements


@dataclass(frozen=True, slots=True, eq=False)
class Movement:
    """A person's movement.

    Attributes:
        name: of :data:`MOTIONS`.
        duration: seconds.
        tpose_s: seconds of T-pose at the beginning; 0 for none.
    """

    name: str
    duration: float
    tpose_s: float
    _course: Callable[[FloatArray], Course] = field(repr=False)

    def course(self, times: FloatArray) -> Course:
        """The body at (n,) seconds, in the person's own frame: origin on the floor, x forward."""
        return self._course(np.asarray(times, dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class _Manner:
    """A person's individual manner of performing a motion.

    tempo: factor on all rates.
    amplitude: (35,) factors on the motion's amplitudes.
    habit: (35,) constant offsets, degrees and shares.
    lag: (2,) delays of left and right, seconds.
    restless: (35,) amplitudes of the sway.
    waves, effort: time courses of the sway, and of the variation between repetitions.
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
        """Draw a manner; None for the standard performance, which only sways."""
        restless = posture(**{name: wave for name, (wave, _) in _MANNERS.items()})
        size = len(NAMES)
        if rng is None:
            fixed = np.random.default_rng(0)
            return cls(
                1.0, np.ones(size), np.zeros(size), np.zeros(2), restless, Waves(fixed, size, 0.5), Waves(fixed, 1, 0.4)
            )
        amplitude = np.full(size, 1.0 + 0.08 * normal(rng))
        amplitude += 0.04 * normal(rng, size)
        habit = posture(**{name: habit for name, (_, habit) in _MANNERS.items()}) * normal(rng, size)
        lag = np.zeros(2)
        lag[rng.integers(2)] = rng.uniform(0.0, 0.04)
        restless *= rng.uniform(0.6, 1.5)
        tempo = float(np.exp(0.13 * normal(rng)))
        return cls(tempo, amplitude, habit, lag, restless, Waves(rng, size, 0.5), Waves(rng, 1, 0.4))

    def added(self, times: FloatArray) -> FloatArray:
        """(n, 35) offsets and sway, added to the postures of a motion."""
        result: FloatArray = self.habit + self.restless * self.waves.at(times)
        return result


_MANNERS = {
    "pelvis_flexion": (0.6, 1.5),
    "pelvis_lateral": (0.6, 0.0),
    "pelvis_yaw": (1.0, 0.0),
    "forward": (0.01, 0.0),
    "left": (0.007, 0.0),
    "trunk_flexion": (1.2, 2.0),
    "trunk_lateral": (1.0, 0.7),
    "trunk_axial": (1.2, 1.0),
    "neck_flexion": (2.5, 4.0),
    "neck_lateral": (2.0, 1.5),
    "shrug": (0.6, 2.0),
    "reach": (0.8, 2.0),
    "elevation": (1.6, 2.5),
    "plane": (2.0, 3.0),
    "twist": (2.0, 4.0),
    "elbow": (2.0, 3.0),
    "pronation": (4.0, 7.0),
    "wrist_flexion": (4.0, 5.0),
    "wrist_deviation": (2.0, 3.0),
}
"""Amplitude of the sway, and standard deviation of habits; degrees and shares of the legs' length."""


def _perform(name: str, person: Person, manner: _Manner, exercise: Exercise, seconds: float | None) -> Movement:
    """An exercise as a movement."""
    swings, entry, ramp = exercise.period > 0.0, _ENTRY_S / manner.tempo, _RAMP_S / manner.tempo
    period = exercise.round_s / manner.tempo
    about = TPOSE_S + 2.0 * entry + END_S + (ramp + manner.lag.max() if swings else 0.0)
    repetitions = exercise.repetitions
    if seconds is not None:
        repetitions = int((seconds - about) / period + 1e-9)
        if repetitions < 1:
            raise RepertoireError(f"{name}: {seconds} s, it takes {about + period:.1f} s at least")
    begin = TPOSE_S + entry

    moves = Moves(TPOSE)
    moves.move(TPOSE_S, entry, exercise.start)
    time = begin
    for _ in range(0 if swings else repetitions):
        for target, move, stay in exercise.round:
            # scaled by this person's amplitude
            moves.move(time, move / manner.tempo, exercise.start + manner.amplitude * (target - exercise.start))
            time += (move + stay) / manner.tempo
    if swings:
        time += repetitions * period + ramp + manner.lag.max()
    moves.move(time, entry, TPOSE)
    end = time + entry + END_S

    def course(times: FloatArray) -> Course:
        postures = moves.at(times) + manner.added(times)
        if swings:
            late = np.zeros(len(NAMES))
            for side in SIDED:
                late[at(side)] = manner.lag
            phase = eased(times[:, None] - begin - late, repetitions * period, ramp) / period
            effort = 1.0 + 0.06 * manner.effort.at(times)
            postures += effort * manner.amplitude * exercise.at(phase)
        return _stand(person, times, postures)

    return Movement(name, end if seconds is None else seconds, TPOSE_S, course)


def _stand(person: Person, times: FloatArray, postures: FloatArray) -> Course:
    return _compose(
        person, times, postures, standing(person, postures), np.zeros((len(times), 2)), np.zeros(len(times))
    )


def _compose(
    person: Person, times: FloatArray, postures: FloatArray, feet: Feet, places: FloatArray, yaw: FloatArray
) -> Course:
    """Postures on feet; the postures displace the pelvis relative to positions (n, 2) and headings ``yaw`` (n,)."""
    turned = postures.copy()
    turned[:, at("pelvis_yaw")[0]] += np.degrees(yaw)
    q = configuration(turned)
    leg = float(person.legs.mean())
    forward, left, drop = (leg * postures[:, at(name)[0]] for name in ("forward", "left", "drop"))
    q[:, 0] = places[:, 0] + np.cos(yaw) * forward - np.sin(yaw) * left
    q[:, 1] = places[:, 1] + np.sin(yaw) * forward + np.cos(yaw) * left
    ankles = feet.ankles(person)
    q[:, 2] = carried(person, q, ankles, drop)
    return Course(times, q, ankles, feet.toes)


# ---------------------------------------------------------------------------------------------------------------------
# standing, walking, anything


def _standing_still(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """Arms hanging, with sway."""
    manner = _Manner.of(rng)
    return Movement(
        name,
        20.0 if seconds is None else seconds,
        0.0,
        lambda times: _stand(person, times, HANGING + manner.added(times)),
    )


_WALK_RATE = 0.85
"""Walking speed with legs of 0.86 m, m/s."""
_STEP_S = 0.55
_TURN_RATE = np.radians(95.0)
_WITHIN = 0.9
"""Greatest distance from the origin when walking, metres."""


def _walking_and_turning(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """Walk between random targets, turning towards each; the standard walk goes from side to side."""
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
        turn = so3.wrapped(np.arctan2(way[1], way[0]) - heading.target[0])
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
    steps = Steps(person, path, first, duration - step_s, step_s)

    def course(times: FloatArray) -> Course:
        pace = sum(
            (minimum_jerk((times - b) / ramp) - minimum_jerk((times - b - length) / ramp) for b, length, _ in walks),
            np.zeros(len(times)),
        )
        # the left foot is in the air about half = 1, and lands about half = 0
        stride = np.pi * (times - first) / step_s
        over, landing = pace * np.cos(stride - 0.4 * np.pi), pace * np.cos(stride - 0.8 * np.pi)
        postures = HANGING + manner.added(times)
        postures += manner.amplitude * (np.outer(over, _OVER) + np.outer(landing, _LANDING) + np.outer(pace, _PACE))
        return _compose(person, times, postures, steps.at(times), *path(times))

    return Movement(name, duration, 0.0, course)


_OVER = posture(left=-0.022, pelvis_lateral=-3.0, trunk_lateral=2.5)
"""Posture of walking while the left foot is in the air: weight on the right one."""
_LANDING = posture(
    pelvis_yaw=-4.0,
    trunk_axial=8.0,
    swing_left=-20.0,
    swing_right=20.0,
    elbow_right=8.0,
    elbow_left=-8.0,
)
"""Posture of walking when the left foot lands: the left hip and the right shoulder are ahead."""
_PACE = posture(trunk_flexion=3.0, pelvis_flexion=2.0, elbow=8.0)
"""Constant posture of walking."""


def _random(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    """A random motion (``random_people``) on feet that follow it."""
    chance = np.random.default_rng(0) if rng is None else rng
    duration = 20.0 if seconds is None else seconds
    motion = RandomMotion(chance, duration, tempo=float(0.4 * 2.5 ** chance.random()))

    def base(times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Configurations, positions and headings; headings are modulo full turns."""
        q = motion.configuration(times)
        left = so3.quat_to_matrix(q[:, PELVIS_QUATERNION])[:, :, 1]
        return q, q[:, :2], np.arctan2(-left[:, 0], left[:, 1])

    def path(times: FloatArray) -> tuple[FloatArray, FloatArray]:
        # unwrap the headings on a dense time grid
        dense = np.arange(0.0, times.max() + 0.1, 0.05)
        _, _, turned = base(dense)
        _, places, yaw = base(times)
        near = np.unwrap(turned)[np.searchsorted(dense, times).clip(max=len(dense) - 1)]
        return places, yaw + 2.0 * np.pi * np.round((near - yaw) / (2.0 * np.pi))

    steps = Steps(person, path, 0.0, duration, 0.3)
    _, place, yaw = base(np.zeros(1))

    def course(times: FloatArray) -> Course:
        q, _, _ = base(times)
        feet = steps.at(times)
        ankles = feet.ankles(person)
        q[:, 2] = carried(person, q, ankles, 0.015 - q[:, 2])
        back = Course(times, q, ankles, feet.toes).placed(np.array([*-place[0], 0.0]), 0.0)
        return back.placed(np.zeros(3), -float(yaw[0]))

    return Movement(name, duration, 0.0, course)


_Builder = Callable[[str, Person, np.random.Generator | None, float | None], Movement]


def _exercise(name: str, person: Person, rng: np.random.Generator | None, seconds: float | None) -> Movement:
    manner, exercise = _Manner.of(rng), EXERCISES[name]
    return _perform(name, person, manner, exercise(rng) if callable(exercise) else exercise, seconds)


MOTIONS: dict[str, _Builder] = {
    **dict.fromkeys(EXERCISES, _exercise),
    "walking_and_turning": _walking_and_turning,
    "standing_still": _standing_still,
    "random": _random,
}
"""Motions by name."""


def make_movement(
    name: str, person: Person, rng: np.random.Generator | None = None, seconds: float | None = None
) -> Movement:
    """A person's performance of a motion.

    Args:
        name: of :data:`MOTIONS`.
        person: the body.
        rng: for tempo, amplitude, asymmetry and sway; None for the standard performance.
        seconds: duration, reached by the number of repetitions; None for the usual one.

    Raises:
        RepertoireError: an unknown name, or too few seconds.
    """
    if name not in MOTIONS:
        raise RepertoireError(f"unknown motion {name!r}, {one_of(name, MOTIONS)}")
    if seconds is not None and not 0.0 < seconds < np.inf:
        raise RepertoireError(f"{name}: {seconds} s")
    return MOTIONS[name](name, person, rng, seconds)
