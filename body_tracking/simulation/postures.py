"""Postures in clinical angles, and their conversion to configurations of the body model.

A posture gives the direction of an upper arm relative to the chest (elevation, and its plane: 0 sideways, 90 forward),
its twist relative to the shortest rotation from hanging, and the bend and rotation of the whole trunk. They are
distributed over shoulder girdle and spine: a clavicle rises by a third of the arm's elevation beyond 30 degrees (Inman
et al., J. Bone Joint Surg. 26 (1944) 1) and protracts with the arm; lumbar and thoracic joints share a bend in
proportion to their ranges. Close to a limit of ``kinematics.ranges``, angles are compressed so that none exceeds it.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.ranges import SHOULDER_SWING, SHOULDER_TWIST, Ranges
from body_tracking.simulation.people import MODEL

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
SIDED = (
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
"""Shrug and reach: elevation and protraction of a clavicle beyond its share of the arm's elevation. Swing: moves an arm
forward in any plane. Twist: inwards. Heel: rises about the toes. Pivot: of a foot on its toes, inwards."""
NAMES: Final = (*_MIDDLE, *(f"{name}_{side}" for name in SIDED for side in ("left", "right")))
"""Degrees, with the signs of the model's angles; ``forward``, ``left`` and ``drop`` displace the pelvis relative to
standing feet, as shares of the length of the legs."""


def posture(**quantities: float) -> FloatArray:
    """(35,) a posture; a name without a side sets both sides; missing names are 0."""
    result = np.zeros(len(NAMES))
    for name, value in quantities.items():
        result[at(name)] = value
    return result


def at(name: str) -> IntArray:
    """Indices of a quantity in a posture: left and right, or a single one."""
    both = (f"{name}_left", f"{name}_right") if name in SIDED else (name,)
    return np.array([NAMES.index(one) for one in both], dtype=np.intp)


def mirrored(original: FloatArray) -> FloatArray:
    """(35,) the posture with left and right swapped."""
    result = original.copy()
    for name in SIDED:
        result[at(name)] = original[at(name)[::-1]]
    for name in ("pelvis_lateral", "pelvis_yaw", "left", "trunk_lateral", "trunk_axial", "neck_lateral"):
        result[at(name)] *= -1.0
    return result


TPOSE: Final = posture(elevation=88.0, plane=3.0, elbow=6.0)
HANGING: Final = posture(elevation=9.0, plane=15.0, twist=12.0, elbow=16.0, pronation=15.0, wrist_flexion=5.0)

_RANGES: Final = Ranges(MODEL)
_SCALAR_NAMES: Final = tuple(MODEL.coordinate_names[v] for v in MODEL.scalar_v)
_SCALAR_CENTRE: Final = _RANGES.centre[MODEL.scalar_v - 6]
_SCALAR_HALF: Final = 0.5 * (_RANGES.high - _RANGES.low)[MODEL.scalar_v - 6]
_SHOULDERS: Final = np.array([MODEL.coordinate_names.index(f"shoulder_x_{side}") for side in ("left", "right")]) - 6
SHOULDER_QUATERNIONS: Final = tuple(MODEL.quaternion_of(f"upper_arm_{side}") for side in ("left", "right"))
PELVIS_QUATERNION: Final = MODEL.quaternion_of("pelvis")
FROM_CENTRE: Final = so3.quat_inverse(
    so3.exp(np.stack([_RANGES.values(MODEL.neutral())[start : start + 3] for start in _SHOULDERS]))
)
"""(2, 4) orientations of the upper arms at the centres of their reach, in the clavicles' frames."""

_SPINE_SHARES = {"flexion": 0.58, "lateral": 0.5, "axial": 0.3}
"""The lumbar joint's share of a bend, in proportion to the ranges; the rest is thoracic."""
_RHYTHM = 1.0 / 3.0
_RHYTHM_FROM, _RHYTHM_SOFTNESS = 30.0, 8.0
"""Degrees of an arm's elevation at which the clavicle starts to rise, and width of the smooth transition."""
_CLAVICLE_REST = -10.0
"""Degrees of elevation: a Kinect's shoulder points lie below its SpineShoulder."""
_PROTRACTION = 14.0
"""Degrees of a clavicle's protraction for an arm that points forward."""
_ROOM = 0.9
"""Share of half a range up to which an angle is unchanged; larger angles are compressed."""


def _bounded(share: FloatArray) -> FloatArray:
    """The identity up to 0.9, then saturating below 1; twice continuously differentiable, odd."""
    size = np.abs(share)
    bent = _ROOM + (1.0 - _ROOM) * np.tanh((size - _ROOM) / (1.0 - _ROOM))
    result: FloatArray = np.sign(share) * np.where(size > _ROOM, bent, size)
    return result


def _turns(angle: FloatArray, axis: tuple[float, float, float]) -> FloatArray:
    """(..., 4) quaternions of rotations by (...) radians about an axis."""
    return so3.exp(angle[..., None] * np.array(axis))


def configuration(postures: FloatArray) -> FloatArray:
    """(n, 35) configurations of (n, 35) postures, with the base at the origin."""
    angles = np.radians(postures)
    value = {name: angles[:, number] for number, name in enumerate(NAMES)}
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
    free = np.stack([scalars[name] for name in _SCALAR_NAMES], axis=1)
    bounded = _SCALAR_CENTRE + _SCALAR_HALF * _bounded((free - _SCALAR_CENTRE) / _SCALAR_HALF)

    q = np.tile(MODEL.neutral(), (len(postures), 1))
    q[:, MODEL.scalar_q] = bounded
    heading = _turns(value["pelvis_yaw"], (0.0, 0.0, 1.0))
    tilt = so3.quat_multiply(
        _turns(value["pelvis_flexion"], (0.0, 1.0, 0.0)), _turns(value["pelvis_lateral"], (1.0, 0.0, 0.0))
    )
    q[:, PELVIS_QUATERNION] = so3.quat_multiply(heading, tilt)
    for side, sign, where in zip(("left", "right"), (1.0, -1.0), SHOULDER_QUATERNIONS, strict=True):
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
    """Compress the shoulders' swing and twist into their limits, in place."""
    values = _RANGES.values(q)[:, _SHOULDERS[:, None] + np.arange(3)]
    size = np.linalg.norm(values[..., :2], axis=-1, keepdims=True) / np.radians(SHOULDER_SWING)
    values[..., :2] *= _bounded(size) / np.maximum(size, 1e-12)
    values[..., 2] = np.radians(SHOULDER_TWIST) * _bounded(values[..., 2] / np.radians(SHOULDER_TWIST))
    arms = so3.quat_multiply(FROM_CENTRE, so3.exp(values))
    for side, where in enumerate(SHOULDER_QUATERNIONS):
        q[:, where] = arms[:, side]
    return q
