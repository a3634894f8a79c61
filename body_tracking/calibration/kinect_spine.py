"""Where a Kinect v2 sees the spine: behind the centres of its joints, alike for everybody.

The skeleton of the SDK has SpineBase 36 mm behind the middle of the hips and level with it, in eight people of two
data sets (medians per person 34 to 48 mm behind, 4 below to 4 above). In a body the joint of the lumbar spine lies
above the middle of the hip joints. Taken for it, the Kinect's SpineBase tilts the pelvis of an upright person backward,
so that the trunk seems to be bent forward against it by 15 to 21 degrees. SpineShoulder lies 27 mm farther behind the
shoulders than by Vicon (UI-PRMD, five people); Schlagenhauf (2017), table E.1, has all of the spine 31 to 62 mm behind
and its base 30 mm below the anatomical joints.

So SpineBase is moved forward and up in the axes of the pelvis, and all above it forward in those of the thorax, by the
same distance, so that the thorax keeps its direction, on which the law of the arms rests.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray, Joint, Skeleton

BASE_FORWARD: Final = 0.036
BASE_UP: Final = 0.029
"""Metres from the Kinect's SpineBase to the joint, which lies above the middle of the hips by 0.018 of the stature."""
FORWARD: Final = 0.027
"""Metres from the Kinect's SpineMid, SpineShoulder, Neck and Head to the joints."""

_J = Joint
_UPPER: Final[IntArray] = np.array([_J.SPINE_MID, _J.SPINE_SHOULDER, _J.NECK, _J.HEAD], dtype=np.intp)
_BELOW: Final[IntArray] = np.array([_J.SPINE_BASE, _J.SPINE_MID], dtype=np.intp)
_ABOVE: Final[IntArray] = np.array([_J.SPINE_MID, _J.SPINE_SHOULDER], dtype=np.intp)
_RIGHT: Final[IntArray] = np.array([_J.HIP_RIGHT, _J.SHOULDER_RIGHT], dtype=np.intp)
_LEFT: Final[IntArray] = np.array([_J.HIP_LEFT, _J.SHOULDER_LEFT], dtype=np.intp)


def corrected_spine(skeleton: Skeleton) -> Skeleton:
    """A skeleton of a Kinect v2 with the spine at the centres of its joints.

    To be used before left and right are put right: the Kinect places the spine behind what it takes for the front.

    Args:
        skeleton: in any frame; only its positions change, and only where both axes of the pelvis, or of the thorax, are
            known.
    """
    positions = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)
    up = _unit(positions[_ABOVE] - positions[_BELOW])
    left = positions[_LEFT] - positions[_RIGHT]
    forward = _unit(np.cross(left, up))
    base = BASE_FORWARD * forward[0] + BASE_UP * up[0]
    moved = skeleton.positions.copy()
    moved[_J.SPINE_BASE] += np.where(np.isfinite(base).all(), base, 0.0)
    moved[_UPPER] += np.where(np.isfinite(forward[1]).all(), FORWARD * forward[1], 0.0)
    return replace(skeleton, positions=moved)


def _unit(vectors: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        result: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result
