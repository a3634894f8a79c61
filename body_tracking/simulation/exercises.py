"""The exercises of the repertoire, as key postures and periodic additions to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.skeleton import FloatArray
from body_tracking.simulation.postures import HANGING, NAMES, mirrored, posture


def _nothing() -> FloatArray:
    return np.zeros(len(NAMES))


@dataclass(frozen=True, slots=True, eq=False)
class Exercise:
    """A motion on the spot between two T-poses: a periodic swing, or a sequence (round) of postures.

    Attributes:
        start: (35,) initial posture.
        repetitions: of the standard performance.
        period: seconds per repetition; 0 for a round.
        out: (35,) amplitude of (1 - cos) / 2.
        sine: (35,) amplitude of the sine.
        left, right: (35,) amplitudes of the cube of the sine in the first and in the second half.
        round: postures in order, each with the seconds to reach it and to hold it; it ends in ``start``.
    """

    start: FloatArray
    repetitions: int
    period: float = 0.0
    out: FloatArray = field(default_factory=_nothing)
    sine: FloatArray = field(default_factory=_nothing)
    left: FloatArray = field(default_factory=_nothing)
    right: FloatArray = field(default_factory=_nothing)
    round: tuple[tuple[FloatArray, float, float], ...] = ()

    @property
    def round_s(self) -> float:
        """Seconds per repetition."""
        return self.period or sum(move + stay for _, move, stay in self.round)

    def at(self, phase: FloatArray) -> FloatArray:
        """(n, 35) additions of the swing to the posture at phases (n, 35), in periods."""
        turn = 2.0 * np.pi * phase
        sine = np.sin(turn)
        result: FloatArray = (
            self.out * 0.5 * (1.0 - np.cos(turn))
            + self.sine * sine
            + self.left * np.maximum(sine, 0.0) ** 3
            + self.right * np.maximum(-sine, 0.0) ** 3
        )
        return result


def normal(rng: np.random.Generator, size: int | None = None) -> FloatArray:
    """Standard normal numbers, clipped to 2.2."""
    return np.clip(rng.normal(size=size), -2.2, 2.2)


def _arm_raises() -> Exercise:
    """Straight arms up and down: forward (flexion), in the plane of the scapula (scaption), sideways (abduction)."""
    raises = ((86.0, 0.0), (38.0, -8.0), (4.0, -30.0))
    steps: list[tuple[FloatArray, float, float]] = []
    for plane, twist in raises:
        down, up = (posture(elevation=e, plane=plane, twist=t, elbow=8.0) for e, t in ((8.0, 0.0), (150.0, twist)))
        steps += [(down, 0.6, 0.0), (up, 1.5, 0.4), (down, 1.6, 0.3)]
    return Exercise(HANGING, 2, round=(*steps, (HANGING, 0.6, 0.0)))


_LOW_LEGS = {"drop": 0.10, "forward": -0.07, "pelvis_flexion": 24.0}
_TARGETS: tuple[FloatArray, ...] = (
    # with the right arm: ahead, across, up, down, sideways
    posture(
        elevation_right=86.0, plane_right=84.0, elbow_right=12.0, reach_right=8.0, trunk_flexion=8.0, trunk_axial=12.0
    ),
    posture(
        elevation_right=80.0,
        plane_right=108.0,
        elbow_right=22.0,
        pronation_right=30.0,
        reach_right=8.0,
        trunk_axial=24.0,
        pelvis_yaw=14.0,
    ),
    posture(elevation_right=138.0, plane_right=62.0, elbow_right=10.0, shrug_right=4.0, trunk_lateral=-6.0),
    posture(
        elevation_right=62.0,
        plane_right=72.0,
        elbow_right=12.0,
        swing_left=42.0,
        trunk_flexion=34.0,
        trunk_axial=12.0,
        **_LOW_LEGS,
    ),
    posture(elevation_right=96.0, plane_right=8.0, elbow_right=10.0, trunk_lateral=12.0, left=-0.04, trunk_axial=-6.0),
)
_OTHER_ARM = posture(
    elevation_left=9.0, plane_left=15.0, twist_left=12.0, elbow_left=18.0, pronation_left=15.0, wrist_flexion_left=5.0
)


def _reaching(rng: np.random.Generator | None) -> Exercise:
    """Reaching for five targets, with alternating arms."""
    targets = [target + _OTHER_ARM for target in _TARGETS]
    targets = [target if number % 2 == 0 else mirrored(target) for number, target in enumerate(targets)]
    if rng is not None:
        apart = posture(elevation=9.0, plane=8.0, elbow=6.0, trunk_axial=4.0, trunk_flexion=3.0)
        targets = [target + apart * normal(rng, len(NAMES)) for target in targets]
        targets = [targets[k] if rng.random() < 0.5 else mirrored(targets[k]) for k in rng.permutation(len(targets))]
    return Exercise(
        HANGING, 2, round=tuple(step for target in targets for step in ((target, 0.95, 0.3), (HANGING, 0.95, 0.2)))
    )


def _hair_combing(rng: np.random.Generator | None) -> Exercise:
    """One hand combs from the forehead over the crown to the nape in a stroke, and returns through the air."""
    front = posture(elevation_right=118.0, plane_right=46.0, elbow_right=127.0)
    back = posture(elevation_right=145.0, plane_right=34.0, twist_right=-66.0, elbow_right=140.0)
    crown = posture(elevation_right=-2.0, twist_right=2.0, elbow_right=-13.0)
    parts = front + _OTHER_ARM + posture(neck_flexion=8.0), back - front, crown, 1.8 * crown
    if rng is not None and rng.random() < 0.1:
        parts = mirrored(parts[0]), mirrored(parts[1]), mirrored(parts[2]), mirrored(parts[3])
    start, out, left, right = parts
    return Exercise(start, 5, 1.9, out=out, left=left, right=right)


def _forearm_rolling() -> Exercise:
    """Both forearms in front of the chest, rolling about each other."""
    centre = posture(elevation=48.0, plane=46.0, twist=54.0, elbow=111.0, pronation=40.0)
    # these additions move a left hand 9 cm forward, and up
    forward = posture(plane_left=4.0, twist_left=-7.5, elbow_left=-12.5)
    up = posture(plane_left=1.6, twist_left=-10.5, elbow_left=8.5)
    forward, up = forward - mirrored(forward), up - mirrored(up)
    return Exercise(centre + forward, 8, 1.1, out=-2.0 * forward, sine=-up)


_MOVE_ALONG = posture(elevation_left=86.0, plane_left=8.0, elbow_left=5.0, pronation_left=15.0) + posture(
    elevation_right=72.0, plane_right=28.0, twist_right=-30.0, elbow_right=75.0, pronation_right=25.0
)
_PIVOT = posture(pivot_right=28.0, heel_right=28.0, drop=0.012)
_PUNCH = posture(
    elevation_left=56.0,
    plane_left=33.0,
    twist_left=10.0,
    elbow_left=-118.0,
    pronation_left=65.0,
    reach_left=6.0,
    trunk_axial=-20.0,
    pelvis_yaw=-14.0,
)

EXERCISES: dict[str, Exercise | Callable[[np.random.Generator | None], Exercise]] = {
    # upper arms out, forearms up, both swinging in the frontal plane (thesis, section 4.3.3)
    "two_handed_wave": Exercise(
        posture(elevation=92.0, plane=10.0, twist=-70.0, elbow=100.0, pronation=10.0),
        5,
        1.6,
        out=posture(elevation=14.0, elbow=-75.0),
    ),
    # both arms forward, palms down, pressed down and raised in the sagittal plane (section 4.3.3)
    "slow_down": Exercise(
        posture(elevation=105.0, plane=82.0, twist=22.0, elbow=60.0, pronation=60.0, wrist_flexion=-15.0),
        5,
        2.0,
        out=posture(elevation=-60.0, elbow=-35.0, trunk_flexion=6.0),
    ),
    # the left arm points to the left; the right hand moves on an ellipse (section 4.3.4)
    "move_along": Exercise(
        _MOVE_ALONG,
        5,
        1.8,
        out=posture(plane_right=60.0, twist_right=45.0, elbow_right=15.0, trunk_axial=3.0, plane_left=3.0),
        sine=posture(elevation_right=20.0, elbow_right=-20.0),
    ),
    # arms out, shoulders turning by about 90 degrees to each side relative to the feet (section 5.6.1): hips, spine and
    # shoulder girdle share the rotation, and the foot left behind pivots on its toes
    "torso_twist": Exercise(
        posture(elevation=82.0, plane=6.0, elbow=12.0),
        5,
        3.6,
        sine=posture(pelvis_yaw=46.0, trunk_axial=40.0, trunk_lateral=2.0, reach_left=-6.0, reach_right=6.0),
        left=_PIVOT,
        right=mirrored(_PIVOT),
    ),
    # down until the thighs are almost level, arms forward for balance (section 5.8, figure 5.16)
    "squat": Exercise(
        HANGING,
        5,
        3.2,
        out=posture(
            drop=0.42,
            forward=-0.17,
            pelvis_flexion=32.0,
            trunk_flexion=14.0,
            neck_flexion=-22.0,
            swing=115.0,
            twist=-12.0,
            elbow=-6.0,
            pronation=30.0,
        ),
    ),
    # up onto the toes and down again (section 5.8, figure 5.16)
    "calf_raise": Exercise(HANGING, 6, 2.2, out=posture(heel=36.0, forward=0.06)),
    "arm_raises": _arm_raises(),
    "reaching": _reaching,
    "hair_combing": _hair_combing,
    "forearm_rolling": _forearm_rolling(),
    # from a boxer's guard, alternating left and right
    "punching": Exercise(
        posture(elevation=32.0, plane=55.0, twist=15.0, elbow=128.0, pronation=10.0, drop=0.03, trunk_flexion=6.0),
        8,
        1.4,
        left=_PUNCH,
        right=mirrored(_PUNCH),
    ),
    # both shoulders up and down, the arms hanging
    "shoulder_lifts": Exercise(HANGING, 6, 1.8, out=posture(shrug=26.0, elevation=3.0, elbow=6.0)),
}
"""Exercises by name; random ones are functions of a generator, or of None for the standard performance.

The first six are the thesis's (Schlagenhauf 2017, sections 4.3.3-4.3.4 with figures 4.14 and 4.18, section 5.6.1,
section 5.8 with figure 5.16). Arm raises, hair combing, forearm rolling, punching and shoulder lifts are among those of
Jatesiktat et al. (2018), section IV-B.
"""
