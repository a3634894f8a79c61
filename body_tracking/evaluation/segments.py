"""Frames that move with the segments of a body, from its joint positions alone.

An anatomist's joint centre and a sensor's differ by a vector that stays with the segment, not with the room: on a
person who turns round it turns too. So a constant offset is told, and taken off, in these frames.

Pelvis and thorax have three points each. A limb's segment has two, which leave its rotation about itself open; it is
taken over from the segment before it by the smallest rotation that brings the one along the other. For an elbow or
knee, a hinge, that is the joint's own movement, straight or bent; for a shoulder or hip it starts from a direction
whose opposite the limb cannot reach, so that it is continuous.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import BONES, N_JOINTS, FloatArray, Joint
from body_tracking.core.so3 import skew

_PELVIS = (Joint.SPINE_BASE, Joint.HIP_LEFT, Joint.HIP_RIGHT)
_THORAX = (
    Joint.SPINE_MID,
    Joint.SPINE_SHOULDER,
    Joint.NECK,
    Joint.HEAD,
    Joint.SHOULDER_LEFT,
    Joint.SHOULDER_RIGHT,
)
_NEUTRAL = {
    Joint.SHOULDER_LEFT: np.array([1.0, 1.0, -1.0]),
    Joint.SHOULDER_RIGHT: np.array([1.0, -1.0, -1.0]),
    Joint.HIP_LEFT: np.array([0.0, 0.0, -1.0]),
    Joint.HIP_RIGHT: np.array([0.0, 0.0, -1.0]),
}
"""The middle of what the first bone of each limb can reach: x forward, y left, z up."""


def segment_frames(positions: FloatArray) -> FloatArray:
    """The frame of the segment that ends in each joint.

    Args:
        positions: (n, 25, 3) metres, NaN where unknown.

    Returns:
        (n, 25, 3, 3) rotations that take coordinates in the segment's frame (in the neutral pose x forward, y left,
        z up) to those of the positions. Where one of pelvis and thorax is unknown the other stands for it, and for a
        bone that is unknown the one before it; NaN where both pelvis and thorax are.
    """
    joint = {each: positions[:, each] for each in Joint}
    middle = joint[Joint.SPINE_MID]
    pelvis = _axes(middle - joint[Joint.SPINE_BASE], joint[Joint.HIP_LEFT] - joint[Joint.HIP_RIGHT])
    shoulders = joint[Joint.SHOULDER_LEFT] - joint[Joint.SHOULDER_RIGHT]
    thorax = _known_or(
        _axes(joint[Joint.SPINE_SHOULDER] - middle, shoulders),
        _axes(joint[Joint.SPINE_SHOULDER] - joint[Joint.SPINE_BASE], shoulders),
    )
    frames = np.full((len(positions), N_JOINTS, 3, 3), np.nan)
    frames[:, _PELVIS] = _known_or(pelvis, thorax)[:, None]
    frames[:, _THORAX] = _known_or(thorax, pelvis)[:, None]
    directions: dict[Joint, FloatArray] = {}
    for parent, child in BONES:
        if child in _PELVIS or child in _THORAX:
            continue
        before = directions.get(parent)
        if before is None:
            before = frames[:, parent] @ (_NEUTRAL[parent] / np.linalg.norm(_NEUTRAL[parent]))
        bone = _known_or(_unit(joint[child] - joint[parent]), before)
        directions[child] = bone
        frames[:, child] = _smallest_rotation(before, bone) @ frames[:, parent]
    return frames


def _axes(up: FloatArray, left: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations with z along ``up`` and y in its plane with ``left``, of (n, 3) vectors; NaN where none."""
    z = _unit(up)
    x = _unit(np.cross(left, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _unit(vectors: FloatArray) -> FloatArray:
    """(n, 3) vectors of length 1; NaN where they have none."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: FloatArray = vectors / np.where(length > 1e-6, length, np.nan)
    return unit


def _known_or(values: FloatArray, others: FloatArray) -> FloatArray:
    """``values`` (n, ...) with the ``others`` at the instants at which they are not known."""
    known = np.isfinite(values).all(axis=tuple(range(1, values.ndim)), keepdims=True)
    return np.where(known, values, others)


def _smallest_rotation(start: FloatArray, end: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations that bring (n, 3) unit vectors along others: Rodrigues' formula about their normal."""
    cross = skew(np.cross(start, end))
    cosine = (start * end).sum(axis=-1)[:, None, None]
    rotation: FloatArray = np.eye(3) + cross + cross @ cross / np.maximum(1.0 + cosine, 1e-9)
    return rotation
