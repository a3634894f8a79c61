"""A standing person: joints and flesh by hand, for tests of sensors' views."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import N_JOINTS, FloatArray, Joint
from body_tracking.kinect.occlusion import Capsules

_MIDDLE = {"SPINE_BASE": 0.95, "SPINE_MID": 1.2, "SPINE_SHOULDER": 1.45, "NECK": 1.52, "HEAD": 1.66}
_SIDE = {
    "SHOULDER": (0.0, 0.18, 1.4),
    "HIP": (0.0, 0.08, 0.92),
    "KNEE": (0.01, 0.09, 0.5),
    "ANKLE": (0.0, 0.1, 0.1),
    "FOOT": (0.12, 0.11, 0.05),
}
_ARM = {"ELBOW": (0.0, 0.3), "WRIST": (0.0, 0.55), "HAND": (0.0, 0.63), "HAND_TIP": (0.0, 0.7), "THUMB": (0.04, 0.63)}
"""Metres to the front and along the arm from the shoulder."""

T_POSE, HANGING = (0.0, 1.0, 0.0), (0.0, 0.15, -0.99)


def standing(arms: tuple[float, float, float] = T_POSE) -> FloatArray:
    """(25, 3) metres: x forward, y left, z up, the origin between the feet; arms: where the left one points."""
    body = np.zeros((N_JOINTS, 3))
    for name, height in _MIDDLE.items():
        body[Joint[name], 2] = height
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        for name, place in _SIDE.items():
            body[Joint[f"{name}_{side}"]] = place * np.array([1.0, sign, 1.0])
        along = np.array(arms) * [1.0, sign, 1.0] / np.linalg.norm(arms)
        front = np.array([0.0, 0.0, 1.0]) if abs(along[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
        for name, (out, way) in _ARM.items():
            body[Joint[f"{name}_{side}"]] = body[Joint[f"SHOULDER_{side}"]] + way * along + out * front
    return body


def placed(body: FloatArray, position: FloatArray, yaw: FloatArray | float) -> FloatArray:
    """(n, 25, 3) a (25, 3) body at (3,) a position, turned by (n,) radians."""
    turns = Rotation.from_euler("z", np.atleast_1d(yaw)[:, None]).as_matrix()
    result: FloatArray = np.einsum("nij,kj->nki", turns, body) + position
    return result


def flesh() -> Capsules:
    """Capsules of an ordinary person."""
    parts = [
        ("HEAD", "HEAD", 0.1),
        ("SPINE_BASE", "SPINE_MID", 0.12),
        ("SPINE_MID", "SPINE_SHOULDER", 0.12),
    ]
    for side in ("LEFT", "RIGHT"):
        parts += [
            (f"{start}_{side}", f"{end}_{side}", radius)
            for start, end, radius in (
                ("SHOULDER", "HIP", 0.09),
                ("SHOULDER", "ELBOW", 0.045),
                ("ELBOW", "WRIST", 0.04),
                ("WRIST", "HAND_TIP", 0.03),
                ("HIP", "KNEE", 0.075),
                ("KNEE", "ANKLE", 0.05),
                ("ANKLE", "FOOT", 0.04),
            )
        ]
    starts, ends, radii = zip(*parts, strict=True)
    return Capsules(
        np.array([Joint[name] for name in starts], dtype=np.intp),
        np.array([Joint[name] for name in ends], dtype=np.intp),
        np.array(radii),
    )
