"""Shapes in space, as arrays: joints and bones of skeletons, capsules, ellipsoids of uncertainty, views of sensors.

Unknown joints are left out; all results are finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import BONES, MAX_RANGE, BoolArray, FloatArray, IntArray, Joint, Skeleton
from body_tracking.viewing.colours import Colour, ColourArray, joint_colours

ELLIPSOID_RADIUS: Final = 2.7954834829151074
"""Radius of the 95 % ellipsoid of a normal distribution in space, in standard deviations: the square root of the 95 %
quantile of chi-square with 3 degrees of freedom."""
LARGEST_RADIUS: Final = 1.0
"""Limit of an ellipsoid's radii, metres: a larger one would hide everything else."""

KINECT_VIEW: Final = (np.radians(70.6), np.radians(60.0))
"""Horizontal and vertical angle of a Kinect v2's depth camera, radians."""

_PARENTS: Final[IntArray] = np.array([parent for parent, _ in BONES], dtype=np.intp)
_CHILDREN: Final[IntArray] = np.array([child for _, child in BONES], dtype=np.intp)

_RADII: Final = {
    "SPINE_MID": 0.085,
    "SPINE_SHOULDER": 0.085,
    "NECK": 0.045,
    "HEAD": 0.075,
    "SHOULDER": 0.05,
    "ELBOW": 0.042,
    "WRIST": 0.033,
    "HAND": 0.028,
    "HAND_TIP": 0.018,
    "THUMB": 0.012,
    "HIP": 0.07,
    "KNEE": 0.06,
    "ANKLE": 0.045,
    "FOOT": 0.035,
}
"""Radii of segments by the joint at the distal end, metres."""
BONE_RADII: Final[FloatArray] = np.array(
    [_RADII[child.name.removesuffix("_LEFT").removesuffix("_RIGHT")] for _, child in BONES]
)
"""(24,) metres, radii of the segments, in the order of ``BONES``."""


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """Skeletons as points and lines.

    Attributes:
        joints: (n, 3) metres.
        which: (n, 2) index of each joint's skeleton, and its number in :class:`Joint`.
        joint_colours: (n, 3) RGB.
        bones: (m, 2, 3) ends of the bones, metres.
    """

    joints: FloatArray
    which: IntArray
    joint_colours: ColourArray
    bones: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """Cylinders with round ends.

    Attributes:
        ends: (n, 2, 3) metres, the centres of the round ends.
        radii: (n,) metres.
    """

    ends: FloatArray
    radii: FloatArray

    @property
    def centres(self) -> FloatArray:
        """(n, 3) metres."""
        middle: FloatArray = self.ends.mean(axis=1)
        return middle

    @property
    def lengths(self) -> FloatArray:
        """(n,) metres between the centres of the ends."""
        result: FloatArray = np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1)
        return result

    @property
    def quats_xyzw(self) -> FloatArray:
        """(n, 4) unit quaternions of the shortest rotation from z to the capsule's axis."""
        axis = (self.ends[:, 1] - self.ends[:, 0]) / np.maximum(self.lengths, 1e-9)[:, None]
        x, y, z = axis.T
        quats = np.stack([-y, x, np.zeros_like(x), 1.0 + z], axis=1)
        length = np.linalg.norm(quats, axis=1)
        quats[length < 1e-6] = 1.0, 0.0, 0.0, 0.0  # straight down: half a turn about x
        quats /= np.linalg.norm(quats, axis=1)[:, None]
        return quats


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoids:
    """Confidence regions of points.

    Attributes:
        centres: (n, 3) metres.
        rotations: (n, 3, 3) rotation matrices; their columns are the axes.
        radii: (n, 3) metres, along each axis, none above :data:`LARGEST_RADIUS`.
    """

    centres: FloatArray
    rotations: FloatArray
    radii: FloatArray


def in_world(skeleton: Skeleton, pose: SensorPose) -> Skeleton:
    """A sensor's skeleton, transformed by the sensor's pose."""
    placed = pose.apply(skeleton.positions)
    return Skeleton(skeleton.stamp_ns, "world", placed, skeleton.states, skeleton.body)


_LEGS: Final[IntArray] = np.arange(Joint.HIP_LEFT, Joint.FOOT_RIGHT + 1, dtype=np.intp)
_SAME_BODY: Final = 0.5
"""Largest distance of two estimates of a body's trunk, metres."""


def with_legs(skeleton: Skeleton, others: Sequence[Skeleton]) -> Skeleton:
    """A filter's skeleton without legs, completed by the legs of the same body in another skeleton.

    Args:
        skeleton: in world.
        others: in world, the best first.
    """
    missing = _LEGS[~skeleton.valid[_LEGS]]
    for other in others:
        both = skeleton.valid & other.valid
        if len(missing) == 0 or not both.any():
            continue
        apart = np.linalg.norm(skeleton.positions[both] - other.positions[both], axis=1)
        if np.median(apart) > _SAME_BODY:
            continue
        positions, states = skeleton.positions.copy(), skeleton.states.copy()
        positions[missing], states[missing] = other.positions[missing], other.states[missing]
        return Skeleton(skeleton.stamp_ns, skeleton.frame_id, positions, states, skeleton.body)
    return skeleton


def figure(skeletons: Sequence[Skeleton], own: Colour) -> Figure:
    """The joints that have a position, and the bones between them.

    Joints that are not tracked are drawn where the source still gives a position.

    Args:
        skeletons: any number, in one frame.
        own: the colour of tracked joints.
    """
    joints, colours, bones = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)], [np.empty((0, 2, 3))]
    which: list[IntArray] = [np.empty((0, 2), np.intp)]
    for place, skeleton in enumerate(skeletons):
        placed = np.all(np.abs(skeleton.positions) < MAX_RANGE, axis=1)
        joints.append(skeleton.positions[placed])
        numbers = np.flatnonzero(placed)
        which.append(np.stack([np.full_like(numbers, place), numbers], axis=1))
        colours.append(joint_colours(skeleton.states[placed], own))
        bones.append(_bones(skeleton, placed)[0])
    return Figure(np.concatenate(joints), np.concatenate(which), np.concatenate(colours), np.concatenate(bones))


def joint_label(number: int) -> str:
    """A joint in words: ``left elbow``."""
    words = Joint(number).name.lower().split("_")
    sides = [word for word in words if word in ("left", "right")]
    return " ".join([*sides, *(word for word in words if word not in sides)])


def capsules(skeletons: Sequence[Skeleton]) -> Capsules:
    """A capsule for each segment with both ends known."""
    ends, radii = [np.empty((0, 2, 3))], [np.empty(0)]
    for skeleton in skeletons:
        bones, there = _bones(skeleton, skeleton.valid)
        ends.append(bones)
        radii.append(BONE_RADII[there])
    return Capsules(np.concatenate(ends), np.concatenate(radii))


def _bones(skeleton: Skeleton, known: BoolArray) -> tuple[FloatArray, BoolArray]:
    """(m, 2, 3) ends of the bones between known joints, and the (24,) mask of these bones."""
    there = np.logical_and(known[_PARENTS], known[_CHILDREN])
    ends = np.stack([skeleton.positions[_PARENTS[there]], skeleton.positions[_CHILDREN[there]]], axis=1)
    return ends, there


def ellipsoids(skeletons: Sequence[Skeleton]) -> Ellipsoids:
    """The 95 % ellipsoid of each joint with a finite covariance.

    With the covariance ``C = R diag(s) R'`` its points are ``c + k R sqrt(s) u`` for unit vectors u, and k is
    :data:`ELLIPSOID_RADIUS`. Negative eigenvalues, by rounding, count as 0.
    """
    centres, covariances = [np.empty((0, 3))], [np.empty((0, 3, 3))]
    for skeleton in skeletons:
        if skeleton.covariances is not None:
            known = skeleton.valid & np.isfinite(skeleton.covariances).all(axis=(1, 2))
            centres.append(skeleton.positions[known])
            covariances.append(skeleton.covariances[known])
    variances, axes = np.linalg.eigh(np.concatenate(covariances))
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
    radii = np.minimum(ELLIPSOID_RADIUS * np.sqrt(np.maximum(variances, 0.0)), LARGEST_RADIUS)
    return Ellipsoids(np.concatenate(centres), axes, radii)


def frustum(depth: float, view: tuple[float, float] = KINECT_VIEW) -> FloatArray:
    """(8, 2, 3) edges of a camera's view up to a depth, in its optical frame (x right, y down, z forward).

    Four edges from the camera to the corners, then four around.

    Args:
        depth: metres.
        view: horizontal and vertical angle, radians.
    """
    x, y = (depth * np.tan(angle / 2.0) for angle in view)
    corners = np.array([[-x, -y, depth], [x, -y, depth], [x, y, depth], [-x, y, depth]])
    rays = np.stack([np.zeros((4, 3)), corners], axis=1)
    around = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return np.concatenate([rays, around])


_FEET: Final[IntArray] = np.array(
    [Joint.ANKLE_LEFT, Joint.FOOT_LEFT, Joint.ANKLE_RIGHT, Joint.FOOT_RIGHT], dtype=np.intp
)
_FLOOR_STEP: Final = 0.03


def floor_height(skeletons: Sequence[Skeleton], before: float | None) -> float | None:
    """The height at which the floor is drawn: below the feet, robust to jitter.

    Args:
        skeletons: in world, z up.
        before: the previous height, metres; None for none.

    Returns:
        The lowest tracked ankle or foot if that is more than 3 cm below ``before``; else ``before``, raised by 1 mm
        while the feet are more than 3 cm above it; None until a foot is seen.
    """
    feet = [each.positions[_FEET, 2][each.valid[_FEET] & (each.states[_FEET] == 2)] for each in skeletons]
    heights = np.concatenate([np.empty(0), *feet])
    if not len(heights):
        return before
    lowest = float(heights.min())
    if before is None or lowest < before - _FLOOR_STEP:
        return lowest
    return before + 0.001 if lowest > before + _FLOOR_STEP else before
