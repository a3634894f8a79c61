"""The thesis's upper body: 26 angles, Denavit-Hartenberg tables, a fixed base (Schlagenhauf 2017, chapter 3).

Exactly tables 3.1 and 3.2, with two oddities: the names of the torso's angles in table 3.4 do not fit their axes, and
theta15 and theta16 (right: theta22 and theta23) have the same axis, so that "elbow pronation" is a second humeral
rotation. At theta = 0, the T-pose, the angles turn about these axes of the base frame (x to the subject's left, y
backward, z up):

=========================  ===========================================================================================
theta1, theta2, theta3     lower trunk about SpineBase: +z (turns left), +x (bends forwards), +y (bends to the left)
theta4, theta5, theta6     upper trunk about SpineMid: +y (bends to the left), +z (turns left), +x (bends forwards)
theta7, theta8, theta9     left clavicle about SpineShoulder: +y (goes down), +z (back), +x (turns about itself)
theta10, theta11, theta12  right clavicle about SpineShoulder: +y (goes up), +z (forward), +x (turns about itself)
theta13, theta14, theta15  left upper arm about ShoulderLeft: +y (goes down), +z (back), +x (turns about itself)
theta16, theta17           left forearm about ElbowLeft: +x (the upper arm's axis), +z (goes back: extension)
theta18, theta19           left hand about WristLeft: +z (goes back), +y (goes down)
theta20 to theta26         right arm: the same axes; what goes down and back on the left goes up and forward here
=========================  ===========================================================================================
"""

from __future__ import annotations

from typing import Final

import numpy as np

from body_tracking.core.body_model import Linearisation, ModelError, Posture
from body_tracking.core.skeleton import FloatArray, IntArray, Joint

_QUARTER = np.pi / 2

_TABLE: Final[tuple[tuple[float, int, int, float], ...]] = (
    # table 3.1, torso
    (+_QUARTER, 0, 0, +_QUARTER),  # 1 SpineBase Z
    (+_QUARTER, 0, 0, +_QUARTER),  # 2 SpineBase X
    (0.0, 0, +1, 0.0),  # 3 SpineBase Y
    (+_QUARTER, 0, 0, +_QUARTER),  # 4 SpineMid Y
    (+_QUARTER, 0, 0, +_QUARTER),  # 5 SpineMid Z
    (+_QUARTER, 0, +2, +_QUARTER),  # 6 SpineMid X
    (+_QUARTER, 0, 0, +_QUARTER),  # 7 SpineShoulder Y (left)
    (+_QUARTER, 0, 0, +_QUARTER),  # 8 SpineShoulder Z (left)
    (+_QUARTER, +3, 0, +_QUARTER),  # 9 SpineShoulder X (left)
    (+_QUARTER, 0, 0, +_QUARTER),  # 10 SpineShoulder Y (right)
    (+_QUARTER, 0, 0, +_QUARTER),  # 11 SpineShoulder Z (right)
    (+_QUARTER, -7, 0, +_QUARTER),  # 12 SpineShoulder X (right)
    # table 3.2, arms
    (+_QUARTER, 0, 0, +_QUARTER),  # 13 ShoulderLeft Y
    (+_QUARTER, 0, 0, +_QUARTER),  # 14 ShoulderLeft Z
    (0.0, +4, 0, 0.0),  # 15 ShoulderLeft X
    (0.0, 0, 0, -_QUARTER),  # 16 ElbowLeft X
    (-_QUARTER, 0, +5, 0.0),  # 17 ElbowLeft Z
    (0.0, 0, 0, -_QUARTER),  # 18 WristLeft Z
    (0.0, 0, +6, 0.0),  # 19 WristLeft Y
    (+_QUARTER, 0, 0, +_QUARTER),  # 20 ShoulderRight Y
    (+_QUARTER, 0, 0, +_QUARTER),  # 21 ShoulderRight Z
    (0.0, -8, 0, 0.0),  # 22 ShoulderRight X
    (0.0, 0, 0, -_QUARTER),  # 23 ElbowRight X
    (-_QUARTER, 0, -9, 0.0),  # 24 ElbowRight Z
    (0.0, 0, 0, -_QUARTER),  # 25 WristRight Z
    (0.0, 0, -10, 0.0),  # 26 WristRight Y
)
"""Offset of theta_i, d_i, a_i, alpha_i: table 3.1 with figures 3.2-3.3, table 3.2 with figures 3.4-3.5.

A length is its number in table 3.3, with its sign, and 0 is none.
"""

_COUNT = len(_TABLE)
# frame i hangs on frame i - 1, but for the first of the right clavicle and of both arms
_PARENT: IntArray = np.array([{10: 6, 13: 9, 20: 12}.get(i, i - 1) for i in range(1, _COUNT + 1)], dtype=np.intp)
"""(26,) the frame that theta_i turns in; 0 is the base."""

_TRUNK_FRAMES = range(1, 7)
_ARM_FRAMES: IntArray = np.array([[*range(7, 10), *range(13, 20)], [*range(10, 13), *range(20, 27)]], dtype=np.intp).T
"""(10, 2) the frames from SpineShoulder outwards, left and right."""

# segment: the last frame of its joint; in the T-pose the arm's segments are turned from hanging about the forward axis
_SEGMENTS: Final[dict[str, tuple[int, float]]] = {
    "pelvis": (0, 0.0),
    "lower_trunk": (3, 0.0),
    "upper_trunk": (6, 0.0),
    "clavicle_left": (9, 0.0),
    "clavicle_right": (12, 0.0),
    "upper_arm_left": (15, 1.0),
    "upper_arm_right": (22, -1.0),
    "forearm_left": (17, 1.0),
    "forearm_right": (24, -1.0),
    "hand_left": (19, 1.0),
    "hand_right": (26, -1.0),
}

_ENDS: Final[dict[Joint, str]] = {
    Joint.SPINE_MID: "lower_trunk",
    Joint.SPINE_SHOULDER: "upper_trunk",
    Joint.SHOULDER_LEFT: "clavicle_left",
    Joint.ELBOW_LEFT: "upper_arm_left",
    Joint.WRIST_LEFT: "forearm_left",
    Joint.HAND_TIP_LEFT: "hand_left",
    Joint.SHOULDER_RIGHT: "clavicle_right",
    Joint.ELBOW_RIGHT: "upper_arm_right",
    Joint.WRIST_RIGHT: "forearm_right",
    Joint.HAND_TIP_RIGHT: "hand_right",
}
"""Each measured joint (table 5.3), and the segment that it ends: L1 to L10 in this order (table 3.3, figure 3.6)."""
_LENGTH_COUNT = len(_ENDS)

# Drillis and Contini (1966) in Winter (2009), figure 4.1, with the shoulder width that Kinect shows; the palm ends at
# the hand's tip. Fractions of the stature, L1 to L10.
_FRACTIONS: FloatArray = np.array([0.140, 0.148, 0.103, 0.186, 0.146, 0.100, 0.103, 0.186, 0.146, 0.100])

_TO_WORLD: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Her base frame (x left, y backward, z up) to that of a person who faces +x (x forward, y left, z up)."""

_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])


def _local_rotations() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Three (26, 3, 3) arrays: the rotation of eq. 3.1 is the first + cos(theta) second + sin(theta) third.

    Eq. 5.17 is eq. 3.1 again. Figure 3.1 shows the parameters; its text has a and alpha from axis i to i + 1, the
    equation and the tables from axis i - 1 to i, which is meant.
    """
    along = np.diag([0.0, 0.0, 1.0])
    cosine = np.diag([1.0, 1.0, 0.0])
    sine = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    parts = []
    for offset, _, _, twist in _TABLE:
        # exact: all offsets and twists are quarter turns
        co, so, ct, st = np.round([np.cos(offset), np.sin(offset), np.cos(twist), np.sin(twist)])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, ct, -st], [0.0, st, ct]])
        parts.append(np.stack([along, co * cosine + so * sine, co * sine - so * cosine]) @ about_x)
    constant, by_cosine, by_sine = np.stack(parts, axis=1)
    return constant, by_cosine, by_sine


_CONSTANT, _BY_COSINE, _BY_SINE = _local_rotations()


def _bones() -> tuple[IntArray, IntArray, FloatArray]:
    """(10,) frame, (10,) column and (10, 1) sign of the unit vector along each length."""
    bones: dict[int, tuple[int, int, int]] = {}
    for i, (_, offset, length, _) in enumerate(_TABLE, start=1):
        if offset:  # d_i lies along z_{i-1}
            bones[abs(offset)] = (int(_PARENT[i - 1]), 2, int(np.sign(offset)))
        if length:  # a_i lies along x_i
            bones[abs(length)] = (i, 0, int(np.sign(length)))
    frame, column, sign = np.array([bones[number] for number in sorted(bones)], dtype=np.intp).T
    return frame, column, sign[:, None].astype(np.float64)


_BONE_FRAME, _BONE_COLUMN, _BONE_SIGN = _bones()


def _ancestors() -> FloatArray:
    """(27, 26) 1 where frame i is turned by theta_k."""
    turned = np.zeros((_COUNT + 1, _COUNT))
    for i in range(1, _COUNT + 1):
        turned[i] = turned[_PARENT[i - 1]]
        turned[i, i - 1] = 1.0
    return turned


_TURNED = _ancestors()
_SEGMENT_FRAME: IntArray = np.array([frame for frame, _ in _SEGMENTS.values()], dtype=np.intp)
_SEGMENT_TURNED: FloatArray = _TURNED[_SEGMENT_FRAME][:, None, :]
"""(11, 1, 26) which angles turn a segment."""


def _paths() -> tuple[FloatArray, FloatArray]:
    """(10, 10) the lengths on the way to each joint, and (11, 10) to each segment's own joint."""
    names = list(_SEGMENTS)
    number = {segment: k for k, segment in enumerate(_ENDS.values())}
    to_end, to_origin = np.zeros((_LENGTH_COUNT, _LENGTH_COUNT)), np.zeros((len(names), _LENGTH_COUNT))
    for s, name in enumerate(names):
        for other, k in number.items():
            # a segment lies on the way to another if all that turns it turns the other too
            own, outer = _TURNED[_SEGMENTS[other][0]], _TURNED[_SEGMENTS[name][0]]
            to_origin[s, k] = name != other and (own <= outer).all()
        if name in number:
            to_end[number[name]] = to_origin[s]
            to_end[number[name], number[name]] = 1.0
    return to_end, to_origin


_TO_END, _TO_ORIGIN = _paths()
_POINTS: FloatArray = np.concatenate([_TO_END, _TO_ORIGIN])

_LEVERS: FloatArray = (_TO_END.T[:, :, None] * _TURNED[_BONE_FRAME][:, None, :]).reshape(_LENGTH_COUNT, -1)
"""(10, 10 * 26) 1 where a length is part of the lever from the axis of an angle to a joint."""


class Schlagenhauf26:
    """Her model; a :class:`~body_tracking.core.body_model.BodyModel`.

    Its points are the ten joints that she measures and compares (section 5.7.2): SpineMid, SpineShoulder and, left
    before right, Shoulder, Elbow, Wrist and HandTip. Each is the end of one segment, in the order of L1 to L10 (table
    3.3). The Jacobian of these ten has rank 20 of 26 in general and 18 in the T-pose: the rest is not observed.
    SpineBase is the origin of her base frame, fixed at ``base_position``.

    The segments are those of her chains and the fixed pelvis. Their frames are not the DH frames, which the tables put
    where the formula needs them, but turned with them: x forward, y left, z up where the subject stands upright with
    arms hanging, palms inwards, thumbs forward. So at theta = 0, the T-pose with the palms down, those of the arms are
    turned by 90 deg. A frame's origin is the joint about which its segment turns. An upper arm turns by theta13 to
    theta15 (20 to 22); theta16 (23), of the same axis as theta15 (22), belongs to the forearm, as in table 3.2.

    Attributes:
        name, joints, segment_names, coordinate_names, length_names, nq, nv: see ``model.BodyModel``.
        base_position: (3,) metres, SpineBase in world.
        base_rotation: (3, 3) from the frame x forward, y left, z up of the subject's T-pose to world.
    """

    name = "schlagenhauf26"
    joints: IntArray = np.array(list(_ENDS), dtype=np.intp)
    segment_names: tuple[str, ...] = tuple(_SEGMENTS)
    coordinate_names: tuple[str, ...] = tuple(f"theta{i}" for i in range(1, _COUNT + 1))
    length_names: tuple[str, ...] = tuple(f"L{i}" for i in range(1, _LENGTH_COUNT + 1))
    nq = _COUNT
    nv = _COUNT

    def __init__(self, base_position: FloatArray | None = None, base_rotation: FloatArray | None = None) -> None:
        """Place the base.

        Args:
            base_position: (3,) metres, SpineBase in world; the origin where None.
            base_rotation: (3, 3) from the frame x forward, y left, z up of the subject's T-pose to world; the identity
                (the subject faces +x) where None.

        Raises:
            ModelError: not a place, or not a rotation.
        """
        self.base_position: FloatArray = np.zeros(3) if base_position is None else np.array(base_position, dtype=float)
        self.base_rotation: FloatArray = np.eye(3) if base_rotation is None else np.array(base_rotation, dtype=float)
        if self.base_position.shape != (3,) or not np.isfinite(self.base_position).all():
            raise ModelError(f"schlagenhauf26 base position: {self.base_position}, expected three finite metres")
        turn = self.base_rotation
        if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-9) or np.linalg.det(turn) < 0.0:
            raise ModelError(f"schlagenhauf26 base rotation: {turn.tolist()}, expected a (3, 3) rotation matrix")
        self._base: FloatArray = turn @ _TO_WORLD

    def neutral(self) -> FloatArray:
        """(26,) zeros: the T-pose."""
        return np.zeros(_COUNT)

    def default_lengths(self, stature: float = 1.75) -> FloatArray:
        """(10,) metres, L1 to L10 of a person of average proportions."""
        return stature * _FRACTIONS

    def integrate(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """(..., 26) the angles' sum; they are not wrapped."""
        return q + v

    def difference(self, q0: FloatArray, q1: FloatArray) -> FloatArray:
        """(..., 26) the angles' difference; they are not wrapped."""
        return q1 - q0

    def forward(self, q: FloatArray, lengths: FloatArray) -> Posture:
        """Forward kinematics (eq. 3.2-3.3; eq. 5.18-5.19 for the joints that are measured).

        Args:
            q: (..., 26) radians.
            lengths: (..., 10) metres.

        Raises:
            ModelError: other sizes.
        """
        frames, bones, lengths = self._chains(q, lengths)
        return self._posture(frames, lengths[..., None] * bones)

    def linearise(self, q: FloatArray, lengths: FloatArray) -> Linearisation:
        """Forward kinematics with the analytic derivatives; arguments and errors as of :meth:`forward`.

        The Jacobian is J of eq. 3.5, and the part of H (eq. 3.27, 5.20) that belongs to the angles.
        A point moves with an angle by the cross product of the angle's axis and the lever from the axis to the point.
        """
        frames, bones, lengths = self._chains(q, lengths)
        vectors = lengths[..., None] * bones
        axes = frames[..., 2][..., _PARENT, :].swapaxes(-1, -2)  # (..., 3, 26): theta_i turns about z_{i-1}
        levers = vectors.swapaxes(-1, -2) @ _LEVERS
        levers = levers.reshape(*levers.shape[:-1], _LENGTH_COUNT, _COUNT)  # (..., 3, 10, 26)
        spread = axes[..., None, :]
        jacobian = spread.take(_YZX, axis=-3) * levers.take(_ZXY, axis=-3)
        jacobian -= spread.take(_ZXY, axis=-3) * levers.take(_YZX, axis=-3)
        return Linearisation(
            self._posture(frames, vectors),
            jacobian.swapaxes(-2, -3),
            bones.swapaxes(-1, -2)[..., None, :, :] * _TO_END[:, None, :],
            axes[..., None, :, :] * _SEGMENT_TURNED,
        )

    def _chains(self, q: FloatArray, lengths: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(..., 27, 3, 3) rotations of base and DH frames, (..., 10, 3) unit vectors along L1 to L10, the lengths."""
        q, lengths = np.asarray(q, dtype=float), np.asarray(lengths, dtype=float)
        if q.shape[-1:] != (_COUNT,) or lengths.shape[-1:] != (_LENGTH_COUNT,):
            raise ModelError(
                f"schlagenhauf26: angles {q.shape} and lengths {lengths.shape}, expected (..., 26) and (..., 10)"
            )
        lead = np.broadcast_shapes(q.shape[:-1], lengths.shape[:-1])
        if q.shape[:-1] != lead:
            q = np.broadcast_to(q, (*lead, _COUNT))
        local = _CONSTANT + np.cos(q)[..., None, None] * _BY_COSINE + np.sin(q)[..., None, None] * _BY_SINE
        frames = np.empty((*lead, _COUNT + 1, 3, 3))
        frames[..., 0, :, :] = self._base
        for i in _TRUNK_FRAMES:
            frames[..., i, :, :] = frames[..., i - 1, :, :] @ local[..., i - 1, :, :]
        turns = local[..., _ARM_FRAMES - 1, :, :]  # (..., 10, 2, 3, 3): both sides at once
        chain = np.empty_like(turns)
        chain[..., 0, :, :, :] = frames[..., _TRUNK_FRAMES[-1], None, :, :] @ turns[..., 0, :, :, :]
        for k in range(1, len(_ARM_FRAMES)):
            chain[..., k, :, :, :] = chain[..., k - 1, :, :, :] @ turns[..., k, :, :, :]
        frames[..., _ARM_FRAMES, :, :] = chain
        bones = frames.swapaxes(-1, -2)[..., _BONE_FRAME, _BONE_COLUMN, :] * _BONE_SIGN
        return frames, bones, lengths

    def _posture(self, frames: FloatArray, vectors: FloatArray) -> Posture:
        points = self.base_position + _POINTS @ vectors
        rotations = frames[..., _SEGMENT_FRAME, :, :] @ _SEGMENT_FROM_DH
        return Posture(points[..., :_LENGTH_COUNT, :], points[..., _LENGTH_COUNT:, :], rotations)


def _segments_from_dh() -> FloatArray:
    """(11, 3, 3) from a segment's frame to the DH frame that it turns with, from where both are at theta = 0."""
    frames, _, _ = Schlagenhauf26()._chains(np.zeros(_COUNT), np.zeros(_LENGTH_COUNT))
    out = np.array([side for _, side in _SEGMENTS.values()])
    at_zero = np.broadcast_to(np.eye(3), (len(out), 3, 3)).copy()
    arms = out != 0.0
    at_zero[arms, 1:, 1:] = out[arms, None, None] * np.array([[0.0, -1.0], [1.0, 0.0]])
    from_dh: FloatArray = frames[_SEGMENT_FRAME].swapaxes(-1, -2) @ at_zero
    return from_dh


_SEGMENT_FROM_DH = _segments_from_dh()
