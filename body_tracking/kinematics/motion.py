"""Model of human movement: white acceleration of a joint, of a spectral density ``q`` per axis (m2/s3).

An acceleration of the standard deviation ``a`` that is correlated over ``tau`` seconds is, at time scales above
``tau``, equivalent to ``q = 2 a^2 tau``.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray, Joint

TRUNK, LIMB, EXTREMITY = range(3)
"""Joint classes: spine, head, shoulders and hips; elbows and knees; hands and feet from the wrist and ankle on."""

_LIMB = ("ELBOW", "KNEE")
_EXTREMITY = ("WRIST", "HAND", "THUMB", "ANKLE", "FOOT")


def _class_of(joint: Joint) -> int:
    first = joint.name.split("_")[0]
    return EXTREMITY if first in _EXTREMITY else LIMB if first in _LIMB else TRUNK


JOINT_CLASSES: IntArray = np.array([_class_of(joint) for joint in Joint], dtype=np.intp)
"""(25,) the class of each joint."""

ACCELERATION_DENSITIES: tuple[float, float, float] = (0.5, 2.0, 6.0)
"""m2/s3 for the three classes.

Trunk 1 m/s2 over 0.25 s, elbows and knees 3 m/s2 over 0.11 s, hands 5 m/s2 over 0.12 s per axis: brisk gestures and
walking. A hand with 50 m/s2 has an innovation of 28 mm in the next frame, which no gate rejects.
"""


def joint_densities(densities: tuple[float, float, float] = ACCELERATION_DENSITIES) -> FloatArray:
    """(25,) the density of each joint from those of the classes."""
    return np.array(densities)[JOINT_CLASSES]
