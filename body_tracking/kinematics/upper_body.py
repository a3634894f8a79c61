"""The default model: an upper body on a free base, in anatomical joint order.

Pelvis, lower and upper trunk, head, and per side clavicle, upper arm, forearm and hand. All segment frames are aligned
with the world (x forward, y left, z up) in the neutral-zero pose of clinical goniometry: upright, arms hanging, elbows
straight, palms inwards and thumbs forward. Every angle is zero there, and positive in the direction of its name:

=====================  =========================================================================================
lumbar, thoracic       flexion (forward), lateral (leans to the right), axial (turns to the left), in this order
neck                   flexion, lateral
clavicle               protraction (shoulder forward), elevation (shoulder up)
shoulder               a ball joint; its tangent is (x, y, z) of the upper arm's own frame
elbow, forearm         flexion, then pronation (the thumb turns inwards)
wrist                  flexion (towards the palm), deviation (towards the thumb)
=====================  =========================================================================================

The lumbar joint lies at SpineBase, the thoracic one at SpineMid, both clavicles at SpineShoulder, the neck at Neck.
With all 19 points seen, two directions of the tangent space move none of them: turning the lower trunk about its own
axis and the upper trunk back, and turning the upper trunk about its axis while both shoulders keep their place (one
clavicle protracts, the other retracts). They involve four angles, :data:`UNOBSERVED`, and for a bent trunk, a little,
its other angles. A straight elbow adds the axial rotation of the humerus against pronation on that side.
``test_upper_body.py`` computes all of this.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS, Linearisation, ModelError, Posture
from body_tracking.core.skeleton import FloatArray, IntArray, Joint

_EYE3 = np.eye(3)
_X, _Y, _Z = _EYE3
# of a point x, [x]x and the identity: (3, 6), row by row
_ARM = np.concatenate([so3.SKEW.reshape(3, 3, 3), np.zeros((3, 3, 3))], axis=-1).reshape(3, 18)
_BESIDE = np.concatenate([np.zeros((3, 3)), _EYE3], axis=-1).reshape(18)
_CROSS = -so3.SKEW
_BASE_SCREWS = np.concatenate([np.zeros((3, 3)), -_EYE3])

PARENTS: Final = (-1, 0, 1, 2, 2, 2, 4, 5, 6, 7, 8, 9)
"""Index of each segment's parent; -1 for the base."""

# segment: the axes of the joint that connects it to its parent, one after the other; None for a ball joint
AXES: tuple[tuple[tuple[str, FloatArray], ...] | None, ...] = (
    None,
    (("lumbar_flexion", _Y), ("lumbar_lateral", _X), ("lumbar_axial", _Z)),
    (("thoracic_flexion", _Y), ("thoracic_lateral", _X), ("thoracic_axial", _Z)),
    (("neck_flexion", _Y), ("neck_lateral", _X)),
    (("clavicle_protraction_left", -_Z), ("clavicle_elevation_left", _X)),
    (("clavicle_protraction_right", _Z), ("clavicle_elevation_right", -_X)),
    None,
    None,
    (("elbow_flexion_left", -_Y), ("forearm_pronation_left", -_Z)),
    (("elbow_flexion_right", -_Y), ("forearm_pronation_right", _Z)),
    (("wrist_flexion_left", -_X), ("wrist_deviation_left", -_Y)),
    (("wrist_flexion_right", _X), ("wrist_deviation_right", -_Y)),
)

SHOULDER_AXES: Final = {"left": (-_Y, _X, -_Z), "right": (-_Y, -_X, _Z)}
"""Axes of flexion, abduction and inward rotation, intrinsic in this order, for the ball joint as angles."""

UNOBSERVED: tuple[str, ...] = (
    "lumbar_axial",
    "thoracic_axial",
    "clavicle_protraction_left",
    "clavicle_protraction_right",
)
"""Angles that all 19 points together leave undetermined; only ranges of motion bound them."""

# length: fraction of the stature. Trunk, arms and hands by Drillis and Contini (1966) in Winter (2009), figure 4.1,
# with the widths between the joint centres that a Kinect v2 shows; thumb and hand points as that sensor places them.
_LENGTHS: dict[str, float] = {
    "lower_trunk": 0.140,
    "upper_trunk": 0.148,
    "neck": 0.040,
    "head": 0.075,
    "clavicle_left": 0.103,
    "clavicle_right": 0.103,
    "upper_arm_left": 0.172,
    "upper_arm_right": 0.172,
    "forearm_left": 0.146,
    "forearm_right": 0.146,
    "hand_left": 0.050,
    "hand_right": 0.050,
    "hand_tip_left": 0.045,
    "hand_tip_right": 0.045,
    "thumb_along_left": 0.050,
    "thumb_along_right": 0.050,
    "thumb_out_left": 0.027,
    "thumb_out_right": 0.027,
    "hip_width_left": 0.046,
    "hip_width_right": 0.046,
    "hip_drop": 0.018,
}
LENGTHS: tuple[str, ...] = tuple(_LENGTHS)

# point: segment that carries it, and its place there as a sum of lengths along directions
POINTS: tuple[tuple[Joint, str, tuple[tuple[str, FloatArray], ...]], ...] = (
    (Joint.SPINE_BASE, "pelvis", ()),
    (Joint.HIP_LEFT, "pelvis", (("hip_width_left", _Y), ("hip_drop", -_Z))),
    (Joint.HIP_RIGHT, "pelvis", (("hip_width_right", -_Y), ("hip_drop", -_Z))),
    (Joint.SPINE_MID, "lower_trunk", (("lower_trunk", _Z),)),
    (Joint.SPINE_SHOULDER, "upper_trunk", (("upper_trunk", _Z),)),
    (Joint.NECK, "upper_trunk", (("upper_trunk", _Z), ("neck", _Z))),
    (Joint.HEAD, "head", (("head", _Z),)),
    (Joint.SHOULDER_LEFT, "clavicle_left", (("clavicle_left", _Y),)),
    (Joint.SHOULDER_RIGHT, "clavicle_right", (("clavicle_right", -_Y),)),
    (Joint.ELBOW_LEFT, "upper_arm_left", (("upper_arm_left", -_Z),)),
    (Joint.ELBOW_RIGHT, "upper_arm_right", (("upper_arm_right", -_Z),)),
    (Joint.WRIST_LEFT, "forearm_left", (("forearm_left", -_Z),)),
    (Joint.WRIST_RIGHT, "forearm_right", (("forearm_right", -_Z),)),
    (Joint.HAND_LEFT, "hand_left", (("hand_left", -_Z),)),
    (Joint.HAND_RIGHT, "hand_right", (("hand_right", -_Z),)),
    (Joint.HAND_TIP_LEFT, "hand_left", (("hand_left", -_Z), ("hand_tip_left", -_Z))),
    (Joint.HAND_TIP_RIGHT, "hand_right", (("hand_right", -_Z), ("hand_tip_right", -_Z))),
    (Joint.THUMB_LEFT, "hand_left", (("thumb_along_left", -_Z), ("thumb_out_left", _X))),
    (Joint.THUMB_RIGHT, "hand_right", (("thumb_along_right", -_Z), ("thumb_out_right", _X))),
)

# where each segment's frame stands: at a point of its parent
ORIGINS: tuple[Joint, ...] = (
    Joint.SPINE_BASE,
    Joint.SPINE_BASE,
    Joint.SPINE_MID,
    Joint.NECK,
    Joint.SPINE_SHOULDER,
    Joint.SPINE_SHOULDER,
    Joint.SHOULDER_LEFT,
    Joint.SHOULDER_RIGHT,
    Joint.ELBOW_LEFT,
    Joint.ELBOW_RIGHT,
    Joint.WRIST_LEFT,
    Joint.WRIST_RIGHT,
)

_BASE = ("base_x", "base_y", "base_z", "base_rx", "base_ry", "base_rz")


class UpperBody:
    """The model ``upper_body``: 26 joint angles on a free base, 19 points, 12 segments, 21 lengths.

    Configuration (35): base position, base quaternion xyzw, then joint by joint in the order of ``coordinate_names``,
    with a quaternion xyzw for each shoulder. Tangent (32): base position in world, base rotation in the pelvis' own
    frame, then joint by joint, with three numbers in the upper arm's own frame for each shoulder.

    Attributes:
        name, joints, segment_names, coordinate_names, length_names, nq, nv: see ``model.BodyModel``.
        parents: index of each segment's parent, -1 for the base.
        segment_coordinates: (12,) for each segment the slice of the tangent that turns it against its parent.
        scalar_q, scalar_v: (20,) where configuration and tangent hold the angles of the joints that turn about axes.
        point_segments: (19,) index of the segment that carries each point.
        ball_v: (3, 3) where the tangent holds the rotations of the pelvis and of the two upper arms.
    """

    name = "upper_body"
    segment_names = SEGMENTS
    parents = PARENTS
    length_names = LENGTHS

    def __init__(self) -> None:
        names = list(_BASE)
        self.segment_coordinates: list[slice] = [slice(3, 6)]
        q_scalar: list[int] = []
        v_scalar: list[int] = []
        q_ball: list[int] = [3]
        v_ball: list[int] = [3]
        ball_segments: list[int] = [0]
        scalar_segments: list[int] = []
        axes = np.zeros((len(SEGMENTS), 3, 3))
        scalar_of: list[tuple[int, int]] = []
        nq = 7
        for segment, joint in enumerate(AXES):
            if segment == 0:
                continue
            start = len(names)
            if joint is None:
                side = "left" if SEGMENTS[segment].endswith("left") else "right"
                names += [f"shoulder_{axis}_{side}" for axis in "xyz"]
                q_ball.append(nq)
                v_ball.append(start)
                ball_segments.append(segment)
                nq += 4
            else:
                scalar_segments.append(segment)
                for number, (name, axis) in enumerate(joint):
                    axes[segment, number] = axis
                    q_scalar.append(nq + number)
                    v_scalar.append(start + number)
                    scalar_of.append((segment, number))
                    names.append(name)
                nq += len(joint)
            self.segment_coordinates.append(slice(start, len(names)))
        self.coordinate_names: tuple[str, ...] = tuple(names)
        self.nq, self.nv = nq, len(names)
        self.joints: IntArray = np.array([point[0] for point in POINTS], dtype=np.intp)

        self._quaternion_of = {
            SEGMENTS[s]: slice(start, start + 4) for s, start in zip(ball_segments, q_ball, strict=True)
        }
        # configuration and tangent
        self.scalar_q: IntArray = np.array(q_scalar, dtype=np.intp)
        self.scalar_v: IntArray = np.array(v_scalar, dtype=np.intp)
        self._quat_q: IntArray = (np.array(q_ball)[:, None] + np.arange(4)).astype(np.intp)
        self.ball_v: IntArray = (np.array(v_ball)[:, None] + np.arange(3)).astype(np.intp)
        # coordinates of the tangent that are simply added to the configuration
        self._added = np.zeros((self.nv, self.nq))
        self._added[:3, :3] = _EYE3
        self._added[self.scalar_v, self.scalar_q] = 1.0

        # rotations of the joints: exp(angle [axis]x) = 1 + sin [axis]x + (1 - cos) [axis]x^2; in this order the first
        # axes of all joints that turn about axes, the second ones, and the third ones, which only the first joints have
        order = [(segment, number) for number in range(3) for segment in scalar_segments if axes[segment, number].any()]
        self._turning_joints = len(scalar_segments)
        self._three_axes = len(order) - 2 * len(scalar_segments)
        places = list(zip(scalar_of, q_scalar, strict=True))
        self._angle_q: IntArray = np.array([q for axis in order for of, q in places if of == axis], dtype=np.intp)
        generator = so3.skew(np.array([axes[axis] for axis in order]))
        self._sine_part, self._cosine_part = generator, generator @ generator
        joints = [*scalar_segments, *ball_segments]
        joint_of = [*map(joints.index, range(len(SEGMENTS))), *range(len(joints), len(joints) + self._three_axes)]
        self._joint_of: IntArray = np.array(joint_of, dtype=np.intp)

        # the tree: levels of segments that can be computed at once; these and their parents stand side by side
        depth = [0] * len(SEGMENTS)
        for segment, parent in enumerate(PARENTS[1:], start=1):
            depth[segment] = depth[parent] + 1
        levels = [[s for s in range(len(SEGMENTS)) if depth[s] == level] for level in range(1, max(depth) + 1)]
        self._levels = [
            (_rotations(level[0], level[-1] + 1), _rotations(PARENTS[level[0]], PARENTS[level[-1]] + 1))
            for level in levels
        ]
        point_of = {joint: number for number, (joint, _, _) in enumerate(POINTS)}
        segment_of = [SEGMENTS.index(name) for _, name, _ in POINTS]
        self.point_segments: IntArray = np.array(segment_of, dtype=np.intp)
        self._origin_point: IntArray = np.array([point_of[joint] for joint in ORIGINS], dtype=np.intp)
        self._place_directions(scalar_segments, ball_segments)
        self._place_lengths(segment_of)

        # which coordinates turn which segment, and move which point
        turns = np.zeros((len(SEGMENTS), self.nv))
        for segment, parent in enumerate(PARENTS):
            if parent >= 0:
                turns[segment] = turns[parent]
            turns[segment, self.segment_coordinates[segment]] = 1.0
        self._turns = turns[:, None, 3:]
        self._minus_moves = np.full((len(POINTS), 1, self.nv), -1.0)  # the base's translation moves every point
        self._minus_moves[..., 3:] = -self._turns[segment_of]
        carrier = [
            segment for segment, part in enumerate(self.segment_coordinates) for _ in range(part.start, part.stop)
        ]
        self._centre_segment: IntArray = np.array(carrier, dtype=np.intp)
        self._centre_point = self._origin_point[self._centre_segment]
        # weights of second derivatives: the earlier axis is the outer one; in a ball joint both orders count by half
        same = self._centre_segment[:, None] == self._centre_segment
        ball = same & np.isin(self._centre_segment, ball_segments)
        later = np.triu(np.ones((self.nv - 3, self.nv - 3)), 1)
        self._pairs = np.where(ball, 0.5, later) * (1.0 - np.eye(self.nv - 3)) + 0.5 * np.eye(self.nv - 3)

    def _place_directions(self, scalar_segments: list[int], ball_segments: list[int]) -> None:
        """Find the rotation in world of which a column, or its opposite, is the axis of a rotational coordinate.

        The last axis of a joint stands still in the segment that it turns, the first one in the parent. The middle one
        of three stands still in a frame of its own, which comes after the segments.
        """
        three = [s for s in scalar_segments if len(AXES[s] or ()) == 3]
        assert three == scalar_segments[: self._three_axes]
        # the last level: the middle axes of the joints with three
        first = PARENTS[three[0]]
        assert [PARENTS[s] for s in three] == list(range(first, first + len(three)))
        count = len(SEGMENTS)
        self._levels.append((_rotations(count, count + len(three)), _rotations(first, first + len(three))))
        frame: dict[int, tuple[int, FloatArray]] = {}
        for segment in ball_segments:
            start = self.segment_coordinates[segment].start
            frame.update({start + axis: (segment, np.eye(3)[axis]) for axis in range(3)})
        for segment in scalar_segments:
            joint = AXES[segment]
            assert joint is not None
            start = self.segment_coordinates[segment].start
            frame[start] = (PARENTS[segment], joint[0][1])
            frame[start + len(joint) - 1] = (segment, joint[-1][1])
            if len(joint) == 3:
                frame[start + 1] = (len(SEGMENTS) + three.index(segment), joint[1][1])
        self._axis_columns = _columns([frame[v] for v in range(3, self.nv)])

    def _place_lengths(self, segment_of: list[int]) -> None:
        """Find the column of a segment's rotation along which each length extends, and the points that it displaces."""
        carried: dict[str, tuple[int, FloatArray]] = {}
        self._counts = np.zeros((len(POINTS), len(LENGTHS)))
        for point, (_, _, parts) in enumerate(POINTS):
            for name, direction in parts:
                known, along = carried.setdefault(name, (segment_of[point], direction))
                assert known == segment_of[point] and np.array_equal(along, direction)
                self._counts[point, LENGTHS.index(name)] = 1.0
        for point, segment in enumerate(segment_of):
            while segment > 0:
                origin = int(self._origin_point[segment])
                # the origin is a point of the parent, and hangs on the parent's own origin
                self._counts[point] += (
                    self._counts[origin]
                    * (segment_of[origin] == PARENTS[segment])
                    * ([carried[name][0] == PARENTS[segment] for name in LENGTHS])
                )
                segment = PARENTS[segment]
        self._length_columns = _columns([carried[name] for name in LENGTHS])

    def neutral(self) -> FloatArray:
        """(35,) the neutral-zero pose at the world's origin, facing x."""
        q = np.zeros(self.nq)
        q[self._quat_q[:, 3]] = 1.0
        return q

    def default_lengths(self, stature: float = 1.75) -> FloatArray:
        """(21,) metres, of a person of average proportions (Drillis and Contini 1966)."""
        return stature * np.array(list(_LENGTHS.values()))

    def quaternion_of(self, segment: str) -> slice:
        """Where a configuration holds the quaternion xyzw of a segment against its parent: pelvis, upper arms."""
        return self._quaternion_of[segment]

    def integrate(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """(..., 35) the configuration (..., 35) moved by the tangent vector (..., 32)."""
        moved: FloatArray = q + v @ self._added
        turned = so3.quat_multiply(q.take(self._quat_q, axis=-1), so3.exp(v.take(self.ball_v, axis=-1)))
        # products of unit quaternions leave the unit sphere by a rounding error each
        moved[..., self._quat_q] = turned / np.sqrt((turned * turned).sum(axis=-1, keepdims=True))
        return moved

    def difference(self, q0: FloatArray, q1: FloatArray) -> FloatArray:
        """(..., 32) the shortest ``v`` with ``integrate(q0, v) == q1``."""
        v: FloatArray = (q1 - q0) @ self._added.T
        relative = so3.quat_multiply(so3.quat_inverse(q0.take(self._quat_q, axis=-1)), q1.take(self._quat_q, axis=-1))
        v[..., self.ball_v] = so3.log(relative)
        return v

    def forward(self, q: FloatArray, lengths: FloatArray) -> Posture:
        """Forward kinematics.

        Args:
            q: (..., 35) configurations.
            lengths: (..., 21) metres.

        Raises:
            ModelError: the last dimension of an argument is another.
        """
        return self._place(q, lengths, self._frames(q))[1]

    def linearise(self, q: FloatArray, lengths: FloatArray) -> Linearisation:
        """Forward kinematics and its derivatives; arguments and errors as of :meth:`forward`."""
        frames = self._frames(q)
        along, posture = self._place(q, lengths, frames)
        axes = _directions(frames, self._axis_columns)  # (..., 3, 29)
        # a segment turns with the axes of all joints up to it; a point moves by axis x (point - origin), the opposite
        # of [point]x axis + axis x origin; and it moves with the base
        shape = axes.shape[:-2]
        screws = np.empty((*shape, 6, self.nv))
        screws[..., :3] = _BASE_SCREWS
        screws[..., :3, 3:] = axes
        screws[..., 3:, 3:] = _cross(axes, posture.positions.swapaxes(-1, -2).take(self._centre_point, axis=-1))
        arms = (posture.positions @ _ARM + _BESIDE).reshape(*shape, -1, 6)
        jacobian = (arms @ screws).reshape(*shape, len(self.joints), 3, self.nv)
        jacobian *= self._minus_moves
        turning = np.zeros((*shape, len(SEGMENTS), 3, self.nv))
        np.multiply(axes[..., None, :, :], self._turns, out=turning[..., 3:])
        by_lengths = self._counts[:, None, :] * along[..., None, :, :]
        return Linearisation(posture, jacobian, by_lengths, turning)

    def turning(self, q: FloatArray, segment: int) -> tuple[FloatArray, FloatArray]:
        """:meth:`linearise` for one segment, in half the time.

        Args:
            q: (..., 35) configurations.
            segment: its number in ``segment_names``.

        Returns:
            (..., 3, 3) its rotation to world, and (..., 3, 32) its angular velocity in world per tangent velocity.

        Raises:
            ModelError: the last dimension of ``q`` is another.
        """
        frames = self._frames(q)
        turning = np.zeros((*frames.shape[:-3], 3, self.nv))
        np.multiply(_directions(frames, self._axis_columns), self._turns[segment], out=turning[..., 3:])
        return frames[..., segment, :, :], turning

    def turned_by(self, segment: str) -> IntArray:
        """The coordinates of the tangent that turn a segment, ascending."""
        return np.asarray(3 + np.flatnonzero(self._turns[self.segment_names.index(segment)]), dtype=np.intp)

    def curvature(self, lines: Linearisation, covariance: FloatArray) -> FloatArray:
        """Expectation of the points minus their positions at the mean of the configuration, to second order.

        Half the sum over all pairs of coordinates of their covariance and the point's second derivative, axis x
        (derivative by the later one).

        Args:
            lines: the linearisation at the mean, of one configuration.
            covariance: (32, 32) of the tangent.

        Returns:
            (19, 3) metres.
        """
        axes = lines.rotation_jacobian[self._centre_segment, :, np.arange(3, self.nv)]
        behind = lines.jacobian[..., 3:].reshape(-1, self.nv - 3) @ (covariance[3:, 3:] * self._pairs).T
        behind = behind.reshape(-1, 3, self.nv - 3) * self._minus_moves[..., 3:]
        # the sum of axis x behind over all coordinates, as one product
        result: FloatArray = behind.reshape(len(behind), -1) @ so3.skew(axes).transpose(2, 0, 1).reshape(-1, 3)
        return -result

    def _frames(self, q: FloatArray) -> FloatArray:
        """(..., 14, 3, 3) rotations in world: of the segments, then of the middle axes of the joints with three."""
        if q.shape[-1] != self.nq:
            raise ModelError(f"upper_body: a configuration of {q.shape[-1]} numbers, expected {self.nq}")
        angles = q.take(self._angle_q, axis=-1)[..., None, None]
        steps = _EYE3 + np.sin(angles) * self._sine_part + (1.0 - np.cos(angles)) * self._cosine_part
        joints, three = self._turning_joints, self._three_axes
        turned = steps[..., :joints, :, :] @ steps[..., joints : 2 * joints, :, :]
        turned[..., :three, :, :] = turned[..., :three, :, :] @ steps[..., 2 * joints :, :, :]
        balls = so3.quat_to_matrix(q.take(self._quat_q, axis=-1))
        local = np.concatenate([turned, balls, steps[..., :three, :, :]], axis=-3)
        frames: FloatArray = local.take(self._joint_of, axis=-3)
        for segments, parents in self._levels:  # in place, parents first; the base has its own already
            frames[segments] = frames[parents] @ frames[segments]
        return frames

    def _place(self, q: FloatArray, lengths: FloatArray, frames: FloatArray) -> tuple[FloatArray, Posture]:
        """(..., 3, 21) directions of the lengths in world, and the posture; points are linear in the lengths."""
        if lengths.shape[-1] != len(LENGTHS):
            raise ModelError(f"upper_body: {lengths.shape[-1]} segment lengths, expected {len(LENGTHS)}")
        along = _directions(frames, self._length_columns)
        positions = q[..., None, :3] + self._counts @ (lengths[..., None, :] * along).swapaxes(-1, -2)
        origins = positions.take(self._origin_point, axis=-2)
        return along, Posture(positions, origins, frames[..., : len(SEGMENTS), :, :])


def _rotations(start: int, stop: int) -> tuple[Any, ...]:
    """The index of a range of a stack of rotations (..., n, 3, 3)."""
    return (..., slice(start, stop), slice(None), slice(None))


def _columns(places: list[tuple[int, FloatArray]]) -> tuple[IntArray, FloatArray]:
    """(3, n) indices of columns in a flat stack of rotations, and (n,) signs, of (rotation, signed axis)."""
    columns = [9 * frame + 3 * np.arange(3) + np.abs(axis).argmax() for frame, axis in places]
    return np.array(columns, dtype=np.intp).T.copy(), np.array([float(axis.sum()) for _, axis in places])


def _directions(frames: FloatArray, columns: tuple[IntArray, FloatArray]) -> FloatArray:
    """(..., 3, n) columns of rotations (..., 14, 3, 3), or their opposites."""
    places, signs = columns
    result: FloatArray = frames.reshape(*frames.shape[:-3], -1).take(places, axis=-1) * signs
    return result


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., 3, n) cross products of columns."""
    products = a[..., :, None, :] * b[..., None, :, :]
    result: FloatArray = _CROSS @ products.reshape(*products.shape[:-3], 9, -1)
    return result
