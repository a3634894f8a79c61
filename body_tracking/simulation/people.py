"""People of the simulator: bodies from anthropometric tables, their configurations over time, and their joints.

A body is that of ``upper_body`` on two legs. The legs connect the hips with ankles placed by the motion; the knees
follow from the lengths of thigh and shank. Sources: stature, mass and breadths by Gordon et al., "2012 anthropometric
survey of U.S. Army personnel" (ANSUR II), Natick/TR-15/007 (2014); lengths as shares of the stature by Drillis and
Contini (1966), in Winter, "Biomechanics and motor control of human movement" (2009), figure 4.1; masses of the segments
by de Leva, J. Biomech. 29 (1996) 1223, table 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import N_JOINTS, FloatArray, Joint
from body_tracking.kinect.occlusion import Capsules
from body_tracking.kinematics.upper_body import UpperBody

MODEL: Final = UpperBody()
"""The body from the pelvis upwards."""


class PeopleError(BodyTrackingError):
    """Raised if an ankle is out of the leg's reach."""


@dataclass(frozen=True, slots=True)
class _Table:
    """Anthropometry of one sex.

    Attributes:
        stature: metres, mean and standard deviation.
        body_mass_index: kg/m^2, median; ``spread`` is its coefficient of variation.
        shoulders, hips: breadth as a share of the stature, relative to the mean of both sexes (biacromial breadth
            415.7 mm of 1755.8 mm and 365.3 mm of 1628.5 mm; hip breadth alike).
        masses: of head, trunk, and one upper arm, forearm, hand, thigh, shank and foot, as shares of the body mass.
    """

    stature: tuple[float, float]
    body_mass_index: float
    spread: float
    shoulders: float
    hips: float
    masses: dict[str, float]


_PARTS = ("head", "trunk", "upper_arm", "forearm", "hand", "thigh", "shank", "foot")
_TABLES: dict[str, _Table] = {
    "female": _Table(
        (1.6285, 0.0642),
        25.3,
        0.135,
        0.973,
        1.045,
        dict(zip(_PARTS, (0.0668, 0.4257, 0.0255, 0.0138, 0.0056, 0.1478, 0.0481, 0.0129), strict=True)),
    ),
    "male": _Table(
        (1.7558, 0.0686),
        27.4,
        0.145,
        1.027,
        0.955,
        dict(zip(_PARTS, (0.0694, 0.4346, 0.0271, 0.0162, 0.0061, 0.1416, 0.0433, 0.0137), strict=True)),
    ),
}
SEXES: tuple[str, ...] = tuple(_TABLES)
_TAIL = 2.5
"""Standard deviations at which drawn people are clipped."""

# shares of the stature, the last one from the ankle to the FOOT point
_THIGH, _SHANK, _ANKLE_HEIGHT, _FOOT = 0.245, 0.246, 0.039, 0.093
_TOE_HEIGHT = 0.4
"""Height of the FOOT point above the floor for a flat sole, as a share of the ankle's."""
_UPRIGHT = ("lower_trunk", "upper_trunk", "neck", "head", "hip_drop")
"""Lengths that add up to the stature with those of the legs."""
_PROPORTION_STDDEV = 0.04
"""Relative standard deviation of a length, given the stature."""
_ASYMMETRY_STDDEV = 0.008
"""Relative standard deviation between left and right."""

_DENSITY = 1060.0
"""kg/m^3, mean density of flesh and bone (Winter 2009, table 4.1: 0.9 of the trunk to 1.1 of the limbs)."""
_TRUNK_ASPECT = 1.5
"""Breadth over depth of the trunk."""
_SKULL = 0.062
"""Radius of an average head, as a share of the stature."""


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """A body.

    Attributes:
        sex: ``female`` or ``male``.
        stature: metres.
        mass: kilograms.
        lengths: (21,) metres, as ``UpperBody.length_names``, between the joint centres of a Kinect v2.
        thigh, shank: (2,) metres, left and right.
        ankle_height: metres, of the ankle joints above the soles.
        foot: metres from an ankle to the FOOT point.
    """

    sex: str
    stature: float
    mass: float
    lengths: FloatArray
    thigh: FloatArray
    shank: FloatArray
    ankle_height: float
    foot: float

    @classmethod
    def average(cls, sex: str) -> Person:
        """The average person of a sex, with equal left and right."""
        table = _TABLES[sex]
        stature = table.stature[0]
        return cls._of(sex, stature, table.body_mass_index * stature**2, {}, {})

    @classmethod
    def draw(cls, rng: np.random.Generator, sex: str | None = None) -> Person:
        """Draw a person: stature and build by the tables, proportions with a standard deviation of 4 %.

        Without ``sex`` it is drawn, too. The body mass index is lognormal; all deviations are clipped to 2.5 standard
        deviations. The upright lengths are scaled to add up to the stature.
        """
        chosen = sex if sex is not None else SEXES[rng.integers(len(SEXES))]
        table = _TABLES[chosen]

        def normal() -> float:
            return float(np.clip(rng.normal(), -_TAIL, _TAIL))

        stature = table.stature[0] + table.stature[1] * normal()
        mass = table.body_mass_index * float(np.exp(table.spread * normal())) * stature**2
        kinds = dict.fromkeys(_kind(name) for name in (*MODEL.length_names, "thigh", "shank", "ankle", "foot"))
        factors = {kind: 1.0 + _PROPORTION_STDDEV * normal() for kind in kinds}
        apart = {kind: _ASYMMETRY_STDDEV * normal() for kind in kinds}
        return cls._of(chosen, stature, mass, factors, apart)

    @classmethod
    def _of(cls, sex: str, stature: float, mass: float, factors: dict[str, float], apart: dict[str, float]) -> Person:
        """A person with the average lengths times ``factors``; left and right differ by ``apart``."""
        table = _TABLES[sex]
        breadths = {"clavicle": table.shoulders, "hip_width": table.hips}
        lengths = MODEL.default_lengths(stature)
        for number, name in enumerate(MODEL.length_names):
            kind = _kind(name)
            side = 0.5 * (name.endswith("_left") - name.endswith("_right"))
            lengths[number] *= breadths.get(kind, 1.0) * factors.get(kind, 1.0) * (1.0 + side * apart.get(kind, 0.0))
        sides = np.array([0.5, -0.5])
        # the asymmetry of legs is half that of arms
        thigh, shank = (
            share * stature * factors.get(kind, 1.0) * (1.0 + 0.5 * sides * apart.get(kind, 0.0))
            for kind, share in (("thigh", _THIGH), ("shank", _SHANK))
        )
        ankle_height = _ANKLE_HEIGHT * stature * factors.get("ankle", 1.0)
        foot = _FOOT * stature * factors.get("foot", 1.0)

        upright = np.isin(MODEL.length_names, _UPRIGHT)
        average = MODEL.default_lengths(stature)[upright].sum() + (_THIGH + _SHANK + _ANKLE_HEIGHT) * stature
        whole = average / (lengths[upright].sum() + thigh.mean() + shank.mean() + ankle_height)
        lengths[upright] *= whole
        return cls(sex, stature, mass, lengths, whole * thigh, whole * shank, whole * ankle_height, foot)

    @property
    def legs(self) -> FloatArray:
        """(2,) metres from hip to ankle of straight legs, left and right."""
        return self.thigh + self.shank

    @property
    def toe_height(self) -> float:
        """Height of the FOOT points above the soles, metres."""
        return _TOE_HEIGHT * self.ankle_height

    def length(self, name: str) -> float:
        """One of ``UpperBody.length_names``, metres."""
        return float(self.lengths[MODEL.length_names.index(name)])

    def capsules(self) -> Capsules:
        """Capsules for self-occlusion: each segment has the volume of its share of the mass (de Leva 1996)."""
        masses = _TABLES[self.sex].masses
        trunk = self.length("lower_trunk") + self.length("upper_trunk")
        depth = _radius(masses["trunk"] * self.mass / _TRUNK_ASPECT, trunk)
        # heads grow less than proportionally to the body mass
        skull = 0.5 * (_ball(masses["head"] * self.mass) + _SKULL * self.stature)
        parts: list[tuple[Joint, Joint, float]] = [
            (Joint.HEAD, Joint.HEAD, skull),
            (Joint.SPINE_SHOULDER, Joint.HEAD, 0.55 * skull),
            (Joint.SPINE_BASE, Joint.SPINE_MID, depth),
            (Joint.SPINE_MID, Joint.SPINE_SHOULDER, depth),
        ]
        for number, side in enumerate(("left", "right")):
            joint = {name: Joint[f"{name}_{side.upper()}"] for name in _SIDE_JOINTS}
            upper_arm, forearm = (self.length(f"{part}_{side}") for part in ("upper_arm", "forearm"))
            hand = sum(self.length(f"{part}_{side}") for part in ("hand", "hand_tip"))
            arm = _radius(masses["upper_arm"] * self.mass, upper_arm)
            palm = _radius(masses["hand"] * self.mass, 1.6 * hand)
            parts += [
                # the flanks, which widen the trunk
                (joint["SHOULDER"], joint["HIP"], 0.75 * depth),
                (Joint.SPINE_SHOULDER, joint["SHOULDER"], 1.2 * arm),
                (joint["SHOULDER"], joint["ELBOW"], arm),
                (joint["ELBOW"], joint["WRIST"], _radius(masses["forearm"] * self.mass, forearm)),
                (joint["WRIST"], joint["HAND_TIP"], palm),
                (joint["HIP"], joint["KNEE"], _radius(masses["thigh"] * self.mass, self.thigh[number])),
                (joint["KNEE"], joint["ANKLE"], _radius(masses["shank"] * self.mass, self.shank[number])),
                (joint["ANKLE"], joint["FOOT"], _radius(masses["foot"] * self.mass, 1.6 * self.foot)),
            ]
        starts, ends, radii = zip(*parts, strict=True)
        return Capsules(np.array(starts, dtype=np.intp), np.array(ends, dtype=np.intp), np.array(radii, dtype=float))


_SIDE_JOINTS = ("SHOULDER", "ELBOW", "WRIST", "HAND_TIP", "HIP", "KNEE", "ANKLE", "FOOT")
_LEGS = {
    part: np.array([Joint[f"{part}_LEFT"], Joint[f"{part}_RIGHT"]], dtype=np.intp)
    for part in ("HIP", "KNEE", "ANKLE", "FOOT")
}


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Configurations of a body and positions of its feet at n instants, in one frame.

    A person's own frame has its origin on the floor between the initial positions of the feet, x forward, z up.

    Attributes:
        times: (n,) seconds.
        q: (n, 35) configurations of ``UpperBody``.
        ankles: (n, 2, 3) metres, left and right.
        toes: (n, 2, 3) metres, the FOOT points.
    """

    times: FloatArray
    q: FloatArray
    ankles: FloatArray
    toes: FloatArray

    def placed(self, position: FloatArray, yaw: float) -> Course:
        """The course in a frame in which this frame's origin is at (3,) metres, with a yaw in radians."""
        turn = so3.exp(np.array([0.0, 0.0, yaw]))
        matrix = so3.quat_to_matrix(turn)
        q = self.q.copy()
        q[:, :3] = self.q[:, :3] @ matrix.T + position
        pelvis = MODEL.quaternion_of("pelvis")
        q[:, pelvis] = so3.quat_multiply(turn, self.q[:, pelvis])
        return Course(self.times, q, self.ankles @ matrix.T + position, self.toes @ matrix.T + position)


def joints(person: Person, course: Course) -> FloatArray:
    """The 25 joints of a course.

    Returns:
        (n, 25, 3) metres in the course's frame, in the order of :class:`~body_tracking.core.skeleton.Joint`.

    Raises:
        PeopleError: an ankle is farther from its hip than the leg is long.
    """
    posture = MODEL.forward(course.q, person.lengths)
    result = np.empty((len(course.times), N_JOINTS, 3))
    result[:, MODEL.joints] = posture.positions
    result[:, _LEGS["ANKLE"]], result[:, _LEGS["FOOT"]] = course.ankles, course.toes
    hips = result[:, _LEGS["HIP"]]
    result[:, _LEGS["KNEE"]] = _knees(person, hips, course.ankles, _forward(course, posture.rotations[:, 0]))
    return result


def _forward(course: Course, pelvis: FloatArray) -> FloatArray:
    """(n, 2, 3) horizontal directions in which the knees bend: halfway between those of pelvis and foot."""
    feet = (course.toes - course.ankles) * [1.0, 1.0, 0.0]
    feet /= np.linalg.norm(feet, axis=-1, keepdims=True)
    # the pelvis' left axis, turned by 90 degrees: its x axis is vertical for a person bent down
    left = pelvis[:, None, :, 1]
    ahead = np.stack([left[..., 1], -left[..., 0], np.zeros_like(left[..., 0])], axis=-1)
    result: FloatArray = feet + ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    return result


def _knees(person: Person, hips: FloatArray, ankles: FloatArray, forward: FloatArray) -> FloatArray:
    """(n, 2, 3) knees between hips and ankles, by the law of cosines, bent towards ``forward``."""
    leg = ankles - hips
    distance = np.linalg.norm(leg, axis=-1)
    too_far = distance > person.legs + 1e-9
    if too_far.any():
        instant = int(np.flatnonzero(too_far.any(axis=1))[0])
        side = int(np.flatnonzero(too_far[instant])[0])
        raise PeopleError(
            f"instant {instant}: the {('left', 'right')[side]} ankle is {distance[instant, side]:.3f} m from its "
            f"hip, the leg is {person.legs[side]:.3f} m long"
        )
    direction = leg / distance[..., None]
    along = 0.5 * (person.thigh**2 - person.shank**2 + distance**2) / distance
    aside = np.sqrt(np.maximum(person.thigh**2 - along**2, 0.0))
    bend = forward - (forward * direction).sum(axis=-1, keepdims=True) * direction
    bend /= np.linalg.norm(bend, axis=-1, keepdims=True)
    result: FloatArray = hips + along[..., None] * direction + aside[..., None] * bend
    return result


def _kind(name: str) -> str:
    return name.removesuffix("_left").removesuffix("_right")


def _radius(mass: float, length: float) -> float:
    """Radius of a cylinder of this mass and length, metres."""
    return float(np.sqrt(mass / (_DENSITY * np.pi * length)))


def _ball(mass: float) -> float:
    """Radius of a sphere of this mass, metres."""
    return float(np.cbrt(0.75 * mass / (_DENSITY * np.pi)))
