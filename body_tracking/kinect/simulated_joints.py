"""Tables of the simulated sensor (``simulated_sensor``): errors of a Kinect v2 by joint."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from body_tracking.core.skeleton import BONES, N_JOINTS, FloatArray, IntArray, Joint
from body_tracking.kinect.occlusion import named
from body_tracking.kinematics.motion import EXTREMITY, JOINT_CLASSES, LIMB

_KINDS: Final[dict[str, tuple[Any, ...]]] = {
    # kind of joint: multiples of the white noise and of the slow errors; offset along the ray, mm; anatomical offset, m
    # forward, left and up in the trunk's frame, of the left joint and of the right one; arms have their shoulder's
    "SPINE_BASE": (1.0, 1.2, 32.0, (-0.031, 0.0, -0.030)),
    "SPINE_MID": (0.8, 0.8, 14.0, (-0.062, 0.0, -0.060)),
    "SPINE_SHOULDER": (1.0, 0.8, -8.0, (-0.037, 0.0, -0.020)),
    "NECK": (1.0, 0.8, -18.0, (-0.037, 0.0, -0.020)),
    "HEAD": (1.3, 1.1, 32.0, (-0.037, 0.0, -0.020)),
    "SHOULDER": (1.3, 1.1, 4.0, (-0.010, -0.008, -0.020), (-0.010, 0.008, -0.020)),
    "ELBOW": (1.4, 1.3, -10.0),
    "WRIST": (2.0, 1.4, -15.0),
    "HAND": (4.5, 1.5, -12.0),
    "HAND_TIP": (10.0, 1.8, -10.0),
    "THUMB": (22.0, 2.0, -20.0),
    "HIP": (1.0, 1.2, 6.0),
    "KNEE": (1.7, 1.2, -15.0),
    "ANKLE": (1.7, 1.4, -20.0),
    "FOOT": (3.0, 1.8, -33.0),
}
"""White noise: third differences of the ``kinect_pairs`` recordings; slow errors: spread of limb lengths and
disagreement of two sensors there, and the greater errors of hands and feet in Schlagenhauf 2017, table E.1; along the
ray: the consistent disagreement of sensors 45 and 90 degrees apart there; anatomical offsets: of the spine forward and
up by Schlagenhauf 2017, table E.1, of the shoulders against SpineShoulder by the five subjects of ``kinect_vs_vicon``,
alike on both sides (medians: 27 mm forward, 8 mm inward, of a hanging arm's 0 mm up). The directions of the arms have
errors of their own (``calibration.arm_directions``)."""


def _column(number: int) -> FloatArray:
    """(25, ...) a column of the table; a right joint without its own entry has the left one's, 0 where neither has."""
    values = []
    for joint in Joint:
        row = _KINDS[joint.name.removesuffix("_LEFT").removesuffix("_RIGHT")]
        own = number + 1 if number == 3 and joint.name.endswith("_RIGHT") else number
        values.append(row[own] if own < len(row) else (0.0, 0.0, 0.0))
    return np.array(values)


WHITE_SCALE: Final[FloatArray] = _column(0)
"""(25,) multiples of ``white``."""
SLOW_SCALE: Final[FloatArray] = _column(1)
"""(25,) multiples of ``bias``, ``drift``, ``offset`` and ``guess``."""
DEPTH_PATTERN: Final[FloatArray] = _column(2) / np.sqrt((_column(2) ** 2).mean())
"""(25,) multiples of ``depth_offset``."""
ANATOMICAL: Final[FloatArray] = _column(3)
"""(25, 3) metres, multiples of ``anatomical``."""

SPINE: Final = named("SPINE_BASE", "SPINE_MID", "SPINE_SHOULDER", "NECK", "HEAD")
ARMS: Final = named("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")
LEGS: Final = named("KNEE", "ANKLE", "FOOT")
for _side in ("LEFT", "RIGHT"):
    ANATOMICAL[ARMS & [joint.name.endswith(_side) for joint in Joint]] = ANATOMICAL[Joint[f"SHOULDER_{_side}"]]
FLICKERS: Final[FloatArray] = np.select([JOINT_CLASSES == EXTREMITY, JOINT_CLASSES == LIMB], [1.0, 0.5], 0.0)
PARENTS: Final[IntArray] = np.arange(N_JOINTS, dtype=np.intp)
"""(25,) the joint at the other end of each joint's segment."""
for _parent, _child in BONES:
    PARENTS[_child] = _parent
ANCHORS: Final[IntArray] = np.where(SPINE | named("HIP"), np.intp(Joint.SPINE_SHOULDER), PARENTS)
"""(25,) the joint from which a varying length is measured: for the trunk SPINE_SHOULDER, its most precise joint."""
VARYING: Final[IntArray] = np.where(ANCHORS == Joint.SPINE_SHOULDER, np.intp(Joint.SPINE_BASE), np.arange(N_JOINTS))
VARYING[[Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT]] = Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT
ON_TRUNK: Final = ~(ARMS | LEGS)
FIRST: Final[IntArray] = np.where(ON_TRUNK, np.intp(Joint.ELBOW_LEFT), np.arange(N_JOINTS))
SECOND: Final[IntArray] = np.where(ON_TRUNK, np.intp(Joint.ELBOW_RIGHT), PARENTS)
SECOND[named("ELBOW", "KNEE")] = np.flatnonzero(named("WRIST", "ANKLE"))
"""(25,) outer joints of the segments on whose directions a joint's errors depend; the upper arms for the trunk."""
REST: Final[FloatArray] = np.zeros((N_JOINTS, 3))
REST[LEGS] = [0.0, 0.0, -1.0]
REST[ARMS, 1] = [1.0 if joint.name.endswith("LEFT") else -1.0 for joint in Joint if ARMS[joint]]
FOLLOWS: Final = (
    # shares by which a limb's joints follow the displacement of its root by ``turn_loss``
    (Joint.SPINE_SHOULDER, "SHOULDER", {"ELBOW": 0.6, "WRIST": 0.2, "HAND": 0.2, "HAND_TIP": 0.2, "THUMB": 0.2}),
    (Joint.SPINE_BASE, "HIP", {"KNEE": 0.4}),
)
CHAINS: Final = tuple(
    np.flatnonzero(named(*names))
    for names in (("SHOULDER", "HIP"), ("ELBOW", "KNEE"), ("WRIST", "ANKLE"), ("HAND", "FOOT"), ("HAND_TIP", "THUMB"))
)
_KINSHIP = 0.8
"""Correlation of slow errors along a segment: limbs shift as a whole more than their lengths change."""
KIN: Final[FloatArray] = np.eye(N_JOINTS)
"""(25, 25) takes independent errors of unit variance to errors correlated from parents to children."""
for _parent, _child in BONES:
    KIN[_child] = _KINSHIP * KIN[_parent]
    KIN[_child, _child] = np.sqrt(1.0 - _KINSHIP**2)
