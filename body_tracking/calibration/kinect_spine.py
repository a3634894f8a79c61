"""Correction of a Kinect v2's spine, whose joints lie behind the anatomical ones in everybody.

The skeleton of the SDK has SpineBase 36 mm behind the middle of the hips and level with it: 35.5 to 37.7 mm in each of
five people (UI-PRMD), 34 to 38 in eight of nine recordings of three others, 48 in the ninth; 4 mm below to 4 above. The
anatomical joint of the lumbar spine lies above the middle of the hip joints. With the Kinect's SpineBase in its place,
the pelvis of an upright person tilts backward, and the trunk seems to be bent forward by 15 to 21 degrees.
SpineShoulder lies 27 mm farther behind the shoulders than by Vicon (UI-PRMD, five people); Schlagenhauf (2017), table
E.1, has all of the spine 31 to 62 mm behind and its base 30 mm below the anatomical joints.

So SpineBase is moved forward and up in the axes of the pelvis. The joints above it are moved forward in the axes of the
thorax, all by one distance: the thorax keeps its direction, on which the law of the arms (`arm_directions`) rests.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from body_tracking.calibration.arm_directions import KINECT_V2, ArmLaw, corrected_arms
from body_tracking.calibration.joint_centres import thorax_axes, trunk_axes
from body_tracking.core.skeleton import IntArray, Joint, Skeleton

BASE_FORWARD: Final = 0.036
BASE_UP: Final = 0.029
"""Metres from the Kinect's SpineBase to the joint, which lies above the middle of the hips by 0.018 of the stature."""
FORWARD: Final = 0.027
"""Metres from the Kinect's SpineMid, SpineShoulder, Neck and Head to the joints."""

_J = Joint
_UPPER: Final[IntArray] = np.array([_J.SPINE_MID, _J.SPINE_SHOULDER, _J.NECK, _J.HEAD], dtype=np.intp)
_NEEDED: Final[IntArray] = np.array(
    [_J.SPINE_BASE, _J.SPINE_MID, _J.SPINE_SHOULDER, _J.HIP_LEFT, _J.HIP_RIGHT, _J.SHOULDER_LEFT, _J.SHOULDER_RIGHT],
    dtype=np.intp,
)


def corrected_kinect(skeleton: Skeleton, law: ArmLaw = KINECT_V2) -> Skeleton:
    """A skeleton of a Kinect v2 without the systematic errors of arms and spine that all Kinects v2 share.

    Args:
        skeleton: in a frame with z up; only its positions change.
        law: corrects the directions of the arms.
    """
    return corrected_spine(corrected_arms(skeleton, law))


def corrected_spine(skeleton: Skeleton) -> Skeleton:
    """A skeleton of a Kinect v2 with the spine at the centres of its joints.

    A sensor's own frame must be corrected before its left and right are swapped, since the Kinect places the spine
    behind the side that it takes for the front. A fused frame has correct sides already.

    Args:
        skeleton: in a frame with z up; only its positions change. Where the axes of the pelvis are unknown, those of
            the thorax replace them, and the other way round: without a correction SpineBase would move by 46 mm
            whenever a hip is missing, and filters would estimate a velocity. Where both are unknown the thorax counts
            as upright; where the shoulders are, too, nothing changes.
    """
    known = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)
    base, middle, top, left_hip, right_hip, left_shoulder, right_shoulder = known.take(_NEEDED, axis=0).tolist()
    positions = skeleton.positions.copy()
    pelvis = trunk_axes(middle, base, left_hip, right_hip)
    thorax = trunk_axes(top, middle, left_shoulder, right_shoulder)
    if not math.isfinite(pelvis[0][0]):
        pelvis = thorax
    if not math.isfinite(thorax[0][0]):
        thorax = pelvis
    if not math.isfinite(thorax[0][0]):
        pelvis = thorax = thorax_axes(top, middle, left_shoulder, right_shoulder)
    if math.isfinite(pelvis[0][0]):
        forward, _, up = pelvis
        positions[_J.SPINE_BASE] += [BASE_FORWARD * f + BASE_UP * u for f, u in zip(forward, up, strict=True)]
        positions[_UPPER] += [FORWARD * each for each in thorax[0]]
    return replace(skeleton, positions=positions)
