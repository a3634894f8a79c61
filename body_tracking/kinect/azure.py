"""The 32 joints of the Azure Kinect body tracking SDK as the 25 of the Kinect v2.

Microsoft's ROS driver (Azure_Kinect_ROS_Driver, both for ROS 1 and 2) publishes ``body_tracking_data``, a
``visualization_msgs/MarkerArray`` with a sphere per joint and body, whose id is ``100 body + joint`` with the joint of
``k4abt_joint_id_t``, in the frame of the depth camera (metres, x right, y down, z forward: already an optical frame),
stamped with the capture time. It lacks the SDK's confidence: seen and guessed joints cannot be distinguished.

SpineMid and SpineShoulder have no counterpart and are computed as midpoints; nose, eyes and ears are left out. Joints
of one name lie at slightly different points of the body (Albert et al. 2020, Sensors 20:5104), which is not corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import MAX_RANGE, FloatArray, IntArray, Joint, Skeleton, TrackingState

JOINTS_PER_BODY = 100
"""A marker's id is the body's times this, plus the joint."""

MAX_BODIES = 64
"""A message with more bodies is malformed."""

_BODY_NUMBERS = 1 << 16


class AzureError(BodyTrackingError):
    """Raised for markers that do not form bodies of the Azure Kinect."""


class AzureJoint(IntEnum):
    """The joints of the Azure Kinect body tracking SDK (``k4abt_joint_id_t``), in its order."""

    PELVIS = 0
    SPINE_NAVEL = 1
    SPINE_CHEST = 2
    NECK = 3
    CLAVICLE_LEFT = 4
    SHOULDER_LEFT = 5
    ELBOW_LEFT = 6
    WRIST_LEFT = 7
    HAND_LEFT = 8
    HANDTIP_LEFT = 9
    THUMB_LEFT = 10
    CLAVICLE_RIGHT = 11
    SHOULDER_RIGHT = 12
    ELBOW_RIGHT = 13
    WRIST_RIGHT = 14
    HAND_RIGHT = 15
    HANDTIP_RIGHT = 16
    THUMB_RIGHT = 17
    HIP_LEFT = 18
    KNEE_LEFT = 19
    ANKLE_LEFT = 20
    FOOT_LEFT = 21
    HIP_RIGHT = 22
    KNEE_RIGHT = 23
    ANKLE_RIGHT = 24
    FOOT_RIGHT = 25
    HEAD = 26
    NOSE = 27
    EYE_LEFT = 28
    EAR_LEFT = 29
    EYE_RIGHT = 30
    EAR_RIGHT = 31


COUNTERPARTS: Final[dict[Joint, tuple[AzureJoint, AzureJoint]]] = {
    Joint.SPINE_BASE: (AzureJoint.PELVIS,) * 2,
    Joint.SPINE_MID: (AzureJoint.SPINE_NAVEL, AzureJoint.SPINE_CHEST),
    Joint.SPINE_SHOULDER: (AzureJoint.CLAVICLE_LEFT, AzureJoint.CLAVICLE_RIGHT),
    Joint.HAND_TIP_LEFT: (AzureJoint.HANDTIP_LEFT,) * 2,
    Joint.HAND_TIP_RIGHT: (AzureJoint.HANDTIP_RIGHT,) * 2,
    # all others have the same name in both
    **{joint: (AzureJoint[joint.name],) * 2 for joint in Joint if joint.name in AzureJoint.__members__},
}
"""The two joints of the SDK whose midpoint gives each joint; one joint twice where it has a counterpart."""

_FIRST: IntArray = np.array([COUNTERPARTS[joint][0] for joint in Joint], dtype=np.intp)
_SECOND: IntArray = np.array([COUNTERPARTS[joint][1] for joint in Joint], dtype=np.intp)


def bodies_of(
    ids: Sequence[int],
    points: FloatArray,
    stamp_ns: int,
    frame_id: str,
    state: TrackingState = TrackingState.TRACKED,
) -> tuple[Skeleton, ...]:
    """The bodies in the markers of one message, in order of their numbers.

    Args:
        ids: of the markers, in any order.
        points: (n, 3) metres, in the optical frame.
        stamp_ns: of the capture.
        frame_id: of the skeletons.
        state: of every joint in the message, which has no tracking states.

    Returns:
        Skeletons; a joint that is missing or not finite is NaN and NOT_TRACKED, and so is a midpoint with it. A body's
        number is the SDK's, modulo 65536.

    Raises:
        AzureError: an invalid or duplicate id; more than 64 bodies.
    """
    if not len(ids):
        return ()
    bodies, joints = np.divmod(np.asarray(ids, dtype=np.int64), JOINTS_PER_BODY)
    if bodies.min() < 0 or joints.max() >= len(AzureJoint):
        worst = ids[int(np.argmax((bodies < 0) | (joints >= len(AzureJoint))))]
        raise AzureError(f"marker {worst}, expected 100 times the body and a joint below {len(AzureJoint)}")
    numbers, index = np.unique(bodies, return_inverse=True)
    if len(numbers) > MAX_BODIES:
        raise AzureError(f"{len(numbers)} bodies, expected {MAX_BODIES} at most")
    if len(np.unique(ids)) < len(ids):
        raise AzureError("a marker twice")
    there = np.full((len(numbers), len(AzureJoint), 3), np.nan)
    there[index, joints] = points
    there[~(np.abs(there) < MAX_RANGE).all(axis=-1)] = np.nan
    positions = 0.5 * (there[:, _FIRST] + there[:, _SECOND])
    known = np.isfinite(positions).all(axis=-1)
    states = np.where(known, state, TrackingState.NOT_TRACKED).astype(np.uint8)
    return tuple(
        Skeleton(stamp_ns, frame_id, positions[k], states[k], int(numbers[k]) % _BODY_NUMBERS)
        for k in range(len(numbers))
        if known[k].any()
    )
