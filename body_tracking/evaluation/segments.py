"""Frames of a body's segments, computed from its joint positions.

An anatomical joint centre and a sensor's differ by a constant vector in the segment's frame, so constant offsets are
estimated and removed in these frames.

Pelvis and thorax have three points each. A limb's segment has two, which leave the rotation about its axis
undetermined; its frame is that of its parent segment, turned by the smallest rotation that aligns the axes. For an
elbow or knee (a hinge) this is the joint's own motion; for a shoulder or hip the rotation starts from a direction whose
opposite is out of reach, so that it is continuous.
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
"""Centre of reach of each limb's first bone: x forward, y left, z up."""


def segment_frames(positions: FloatArray) -> FloatArray:
    """The frame of the segment that ends at each joint.

    Args:
        positions: (n, 25, 3) metres, NaN where unknown.

    Returns:
        (n, 25, 3, 3) rotations from the segment's frame (in the neutral pose x forward, y left, z up) to the frame of
        the positions. The thorax replaces an unknown pelvis and vice versa, the parent an unknown bone; NaN if both
        pelvis and thorax are unknown.
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
    """(n, 3, 3) rotations with z along ``up`` and y in the plane of z and ``left``, from (n, 3) vectors; else NaN."""
    z = _unit(up)
    x = _unit(np.cross(left, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _unit(vectors: FloatArray) -> FloatArray:
    """(n, 3) unit vectors; NaN for zero vectors."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: FloatArray = vectors / np.where(length > 1e-6, length, np.nan)
    return unit


def _known_or(values: FloatArray, others: FloatArray) -> FloatArray:
    """``values`` (n, ...), replaced by ``others`` where not finite."""
    known = np.isfinite(values).all(axis=tuple(range(1, values.ndim)), keepdims=True)
    return np.where(known, values, others)


def _smallest_rotation(start: FloatArray, end: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations from (n, 3) unit vectors to others: Rodrigues' formula about their normal."""
    cross = skew(np.cross(start, end))
    cosine = (start * end).sum(axis=-1)[:, None, None]
    rotation: FloatArray = np.eye(3) + cross + cross @ cross / np.maximum(1.0 + cosine, 1e-9)
    return rotation
