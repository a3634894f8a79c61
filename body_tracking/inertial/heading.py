"""Tracking of the heading of each inertial sensor's earth frame and of the sensor's alignment with its segment.

A Kalman filter on the errors of an :class:`~body_tracking.inertial.alignment.Alignment`: delta, a small rotation of
each sensor's segment in the segment's own frame, and the heading psi. With R of eq. 1, a segment's orientation is off
by

    e = delta + (R^T z) d psi                                                                                        (8)

Both are random walks: headings drift with the gyroscopes without a magnetometer, alignments as straps creep. The
observations are:

- a bone that a camera sees, along the axis a of a segment: ``P^T R^T d = -P^T [a]x e``, P normal to a               (9)
- an elbow, whose axes of flexion and pronation stay normal: ``(R1 a1) . (R2 a2) = 0`` (Mueller 2016)               (11)
- ranges of motion: an angle beyond its limit is observed to be at the limit, one within it gives no observation
  (Lehmann, Laidig and Seel 2020 use them so for headings)                                                          (12)

Without a camera only differences of headings are observed: their common part drifts, and the covariance grows with it.
Errors of a camera's skeleton, of joint axes and of a person at a limit persist for a time tau. An observation repeated
within it counts in part: its variance is multiplied by ``max(1, 2 tau / dt)``. Outliers get the weight of a Student's t
(4 degrees of freedom).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.inertial.alignment import (
    TISSUE_STDDEV,
    Alignment,
    AlignmentError,
    across,
    elbow_segment_axes,
)
from body_tracking.kinematics.ranges import RANGES

HEADING_WALK: Final = float(np.radians(0.4))
"""Radians per root second of a heading without magnetometer: 3 degrees in a minute, as with a bias of 0.05 deg/s."""
ALIGNMENT_WALK: Final = float(np.radians(0.05))
"""Radians per root second and axis of an alignment: a degree and a half in a quarter of an hour."""
CAMERA_TIME: Final = 1.0
"""Seconds for which the errors of a camera's skeleton persist."""
ELBOW_STDDEV: Final = float(np.radians(6.0))
"""Radians: standard deviation of the angle between an elbow's axes from 90 degrees: carrying angle and soft tissue."""
ELBOW_TIME: Final = 20.0
"""Seconds for which this error persists: it is constant in a person, but its direction turns with the movement."""
RANGE_STDDEV: Final = float(np.radians(8.0))
"""Radians: standard deviation of people's limits from the published ones."""
RANGE_TIME: Final = 5.0
_FREEDOM = 4.0
_FAR = 0.5
"""Radians of a heading's standard deviation from which the update starts at the observed heading."""
_Z: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Bone:
    """The bone of a skeleton that shows a segment's direction.

    Attributes:
        axis: (3,) unit vector in the segment's frame.
        start, end: joints between which it lies.
    """

    axis: FloatArray
    start: Joint
    end: Joint


def bone_of(segment: str) -> Bone | None:
    """The bone along a segment's axis; None for a segment whose axis a camera does not see."""
    side = segment.rpartition("_")[2]
    ends: dict[str, tuple[FloatArray, str, str]] = {
        "pelvis": (np.array([0.0, 1.0, 0.0]), "HIP_RIGHT", "HIP_LEFT"),
        "upper_trunk": (np.array([0.0, 1.0, 0.0]), "SHOULDER_RIGHT", "SHOULDER_LEFT"),
    }
    if side in ("left", "right"):
        down, end = -_Z, side.upper()
        ends |= {
            f"upper_arm_{side}": (down, f"SHOULDER_{end}", f"ELBOW_{end}"),
            f"forearm_{side}": (down, f"ELBOW_{end}", f"WRIST_{end}"),
            f"hand_{side}": (down, f"WRIST_{end}", f"HAND_{end}"),
        }
    if segment not in ends:
        return None
    axis, start, stop = ends[segment]
    return Bone(axis, Joint[start], Joint[stop])


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """The innovation of an observation.

    Attributes:
        residual: (m,) radians.
        covariance: (m, m) of the residual.
        turn: (3,) radians: the smallest rotation of the segment, in its own frame, that explains the residual; NaN for
            an observation of two sensors.
        weight: of the observation, at most 1.
    """

    residual: FloatArray
    covariance: FloatArray
    turn: FloatArray
    weight: float


_Linear = tuple[FloatArray, FloatArray]
"""(m,) residual and (m, 4 k) its derivative by the error."""


class HeadingTracker:
    """Alignments and headings of k sensors over time; every ``observe`` takes the sensors' rotations of that instant.

    Attributes:
        alignment: the current estimate.
    """

    def __init__(self, alignment: Alignment, *, heading_walk: FloatArray | float = HEADING_WALK) -> None:
        """Start from an alignment.

        Args:
            alignment: such as one by a pose.
            heading_walk: (k,) or one for all, radians per root second; less for sensors with magnetometers.
        """
        self.alignment = alignment
        k = len(alignment.segments)
        walk = np.full((k, 4), ALIGNMENT_WALK)
        walk[:, 3] = heading_walk
        self._walk: FloatArray = walk.reshape(-1) ** 2
        self._stamp: float | None = None
        self._last: dict[tuple[str, ...], float] = {}

    def predict(self, stamp: float) -> None:
        """Predict to a time, seconds.

        Raises:
            AlignmentError: earlier than the last one.
        """
        if self._stamp is not None:
            if stamp < self._stamp:
                raise AlignmentError(f"headings: {stamp:.3f} s comes before {self._stamp:.3f} s")
            a = self.alignment
            grown = a.covariance + np.diag(self._walk * (stamp - self._stamp))
            self.alignment = Alignment(a.segments, a.rotations, a.headings, grown)
        self._stamp = stamp

    def loosen(self, segment: str, stddev: float) -> None:
        """Inflate the covariance of a sensor's alignment and heading, such as after a slip or when it was switched on.

        Args:
            segment: of the sensor.
            stddev: radians per axis; its square is added to the variances.
        """
        number = self._number(segment)
        a = self.alignment
        covariance = a.covariance.copy()
        rows = np.arange(4 * number, 4 * number + 4)
        covariance[rows, rows] += stddev**2
        self.alignment = Alignment(a.segments, a.rotations, a.headings, covariance)

    def orientation_covariance(self, segment: str, rotation: FloatArray) -> FloatArray:
        """(3, 3) radians squared: covariance of a segment's orientation in its own frame (eq. 8); rotation as below."""
        number = self._number(segment)
        world = self.alignment.oriented(number, rotation)
        by = self._turning(number, world)
        result: FloatArray = by @ self.alignment.covariance @ by.T
        return result

    def observe_bone(
        self, stamp: float, segment: str, rotation: FloatArray, direction: FloatArray, stddev: float
    ) -> Innovation | None:
        """Update by the direction of a bone that a camera sees (eq. 9).

        Args:
            stamp: seconds.
            segment: with a :func:`bone_of`.
            rotation: (3, 3) sensor to earth at that time.
            direction: (3,) in world, of any length; ignored if it is not finite.
            stddev: radians per axis, of the direction.

        Raises:
            AlignmentError: a segment without bone or without sensor, or a stamp that comes before the last one.
        """
        bone, number = bone_of(segment), self._number(segment)
        if bone is None:
            raise AlignmentError(f"{segment}: no bone shows its direction")
        length = float(np.linalg.norm(direction))
        if not (np.isfinite(length) and length > 0.0 and np.isfinite(rotation).all()):
            return None
        seen, square, axis = direction / length, across(bone.axis), bone.axis

        def linear(a: Alignment) -> _Linear:
            world = a.oriented(number, rotation)
            local = world.T @ seen
            aside = square.T @ local
            size = float(np.linalg.norm(aside))
            # the angle, not its sine, which is small for the opposite direction too
            angle = np.arctan2(size, float(axis @ local))
            aside = aside * (angle / size) if size > 1e-9 else np.array([angle, 0.0])
            return aside, -square.T @ so3.skew(axis) @ self._turning(number, world)

        def turned(a: Alignment) -> float:
            points = a.oriented(number, rotation) @ axis
            flat = np.linalg.norm(points[:2]) * np.linalg.norm(seen[:2])
            if flat < 0.2:
                return 0.0
            return float(np.arctan2(points[0] * seen[1] - points[1] * seen[0], points[:2] @ seen[:2]))

        noise = (stddev**2 + TISSUE_STDDEV**2) * np.eye(2)
        back = (-square.T @ so3.skew(axis)).T  # the pseudoinverse: the rows are orthonormal
        return self._update(stamp, ("bone", segment), linear, noise, CAMERA_TIME, number, turned, back)

    def observe_elbow(self, stamp: float, side: str, upper: FloatArray, lower: FloatArray) -> Innovation:
        """Update by an elbow, whose axes of flexion and pronation are normal to each other (eq. 11).

        Args:
            stamp: seconds.
            side: ``left`` or ``right``.
            upper: (3, 3) the upper arm's sensor to its earth at that time.
            lower: (3, 3) the forearm's sensor, likewise.
        """
        numbers = self._number(f"upper_arm_{side}"), self._number(f"forearm_{side}")
        axes = elbow_segment_axes(side)

        def linear(a: Alignment) -> _Linear:
            worlds = [a.oriented(i, rotation) for i, rotation in zip(numbers, (upper, lower), strict=True)]
            pointing = [world @ axis for world, axis in zip(worlds, axes, strict=True)]
            jacobian = np.zeros((1, len(a.covariance)))
            for i, world, axis, other in zip(numbers, worlds, axes, pointing[::-1], strict=True):
                jacobian[0] += -(other @ world @ so3.skew(axis)) @ self._turning(i, world)
            return np.array([-float(pointing[0] @ pointing[1])]), jacobian

        return self._update(stamp, ("elbow", side), linear, np.array([[ELBOW_STDDEV**2]]), ELBOW_TIME)

    def observe_range(
        self, stamp: float, parent: str, child: str, rotations: tuple[FloatArray, FloatArray]
    ) -> Innovation | None:
        """Update by a joint beyond its range of motion (eq. 12); None where it is within.

        Args:
            stamp: seconds.
            parent: segment of one of :data:`JOINTS`.
            child: its other segment.
            rotations: (3, 3) of the two sensors to their earths at that time.

        Raises:
            AlignmentError: no joint between both.
        """
        if (parent, child) not in JOINTS:
            raise AlignmentError(f"{parent} and {child}: no joint between them has a range")
        limits = JOINTS[parent, child]
        numbers = self._number(parent), self._number(child)

        def excess(a: Alignment) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
            worlds = [a.oriented(i, rotation) for i, rotation in zip(numbers, rotations, strict=True)]
            found: FloatArray = Rotation.from_matrix(worlds[0].T @ worlds[1]).as_euler("YXZ")
            return np.maximum(found - limits[:, 1], 0.0) + np.minimum(found - limits[:, 0], 0.0), found, worlds

        beyond = np.abs(excess(self.alignment)[0]) > 0.0
        if not beyond.any():
            self.predict(stamp)
            return None

        def linear(a: Alignment) -> _Linear:
            over, found, (above, below) = excess(a)
            gradient = _euler_gradient(found)
            turning = above.T @ below @ self._turning(numbers[1], below) - self._turning(numbers[0], above)
            return -over[beyond], (gradient @ turning)[beyond]

        noise = RANGE_STDDEV**2 * np.eye(int(beyond.sum()))
        return self._update(stamp, ("range", parent, child), linear, noise, RANGE_TIME)

    def _number(self, segment: str) -> int:
        if segment not in self.alignment.segments:
            raise AlignmentError(f"{segment}: carries no sensor")
        return self.alignment.segments.index(segment)

    def _turning(self, number: int, world: FloatArray) -> FloatArray:
        """(3, 4 k) derivative of the segment's orientation by the error (eq. 8)."""
        by = np.zeros((3, len(self.alignment.covariance)))
        by[:, 4 * number : 4 * number + 3] = np.eye(3)
        by[:, 4 * number + 3] = world[2]
        return by

    def _update(
        self,
        stamp: float,
        kind: tuple[str, ...],
        linear: Callable[[Alignment], _Linear],
        noise: FloatArray,
        lasting: float,
        number: int | None = None,
        turned: Callable[[Alignment], float] | None = None,
        back: FloatArray | None = None,
    ) -> Innovation:
        """The iterated update; ``turned`` gives the initial error of a heading that is hardly known."""
        self.predict(stamp)
        before = self.alignment
        prior = before.covariance
        since = stamp - self._last.get(kind, -np.inf)
        self._last[kind] = stamp
        effective = noise * max(1.0, 2.0 * lasting / max(since, 1e-3))
        residual, jacobian = linear(before)
        expected = jacobian @ prior @ jacobian.T + noise
        distance = float(residual @ np.linalg.solve(expected, residual))
        turn = np.full(3, np.nan) if back is None else back @ residual
        error = np.zeros(len(prior))
        weight = min(1.0, (_FREEDOM + len(residual)) / (_FREEDOM + distance))
        if number is not None and turned is not None and prior[4 * number + 3, 4 * number + 3] > _FAR**2:
            error[4 * number + 3], weight = turned(before), 1.0
        effective = effective / weight
        covariance = prior
        for _ in range(3):
            residual_at, jacobian = linear(before.moved(error, prior))
            gain = prior @ jacobian.T @ np.linalg.inv(jacobian @ prior @ jacobian.T + effective)
            error = gain @ (residual_at + jacobian @ error)
            # Joseph's form stays positive definite under rounding
            left = np.eye(len(prior)) - gain @ jacobian
            covariance = left @ prior @ left.T + gain @ effective @ gain.T
        self.alignment = before.moved(error, covariance)
        return Innovation(residual, expected, turn, weight)


def _euler_gradient(angles: FloatArray) -> FloatArray:
    """(3, 3) derivative of angles about y, x, z, in this order, by the angular velocity in the parent's frame."""
    x, y, z = np.eye(3)
    axes = y, Rotation.from_euler("Y", angles[0]).apply(x), Rotation.from_euler("YX", angles[:2]).apply(z)
    gradient: FloatArray = np.linalg.pinv(np.stack(axes, axis=1))
    return gradient


def _sum(*names: str) -> tuple[float, float]:
    return sum(RANGES[name][0] for name in names), sum(RANGES[name][1] for name in names)


def _against(limits: tuple[float, float]) -> tuple[float, float]:
    return -limits[1], -limits[0]


_GIRDLE = 45.0
"""Degrees of a clavicle's rotation about its axis, which the model does not have; 15 for elbow and wrist."""

_Range = tuple[float, float]
_LEFT: Final[dict[tuple[str, str], tuple[_Range, _Range, _Range]]] = {
    ("pelvis", "upper_trunk"): (
        _sum("lumbar_flexion", "thoracic_flexion"),
        _sum("lumbar_lateral", "thoracic_lateral"),
        _sum("lumbar_axial", "thoracic_axial"),
    ),
    ("upper_trunk", "head"): (RANGES["neck_flexion"], RANGES["neck_lateral"], (-80.0, 80.0)),
    ("upper_trunk", "clavicle_left"): (
        (-_GIRDLE, _GIRDLE),
        RANGES["clavicle_elevation"],
        _against(RANGES["clavicle_protraction"]),
    ),
    ("upper_arm_left", "forearm_left"): (
        _against(RANGES["elbow_flexion"]),
        (-15.0, 15.0),
        _against(RANGES["forearm_pronation"]),
    ),
    ("forearm_left", "hand_left"): (
        _against(RANGES["wrist_deviation"]),
        _against(RANGES["wrist_flexion"]),
        (-15.0, 15.0),
    ),
}
JOINTS: Final[dict[tuple[str, str], FloatArray]] = {pair: np.radians(ranges) for pair, ranges in _LEFT.items()} | {
    (parent.replace("left", "right"), child.replace("left", "right")): np.radians([y, _against(x), _against(z)])
    for (parent, child), (y, x, z) in _LEFT.items()
    if child.endswith("left")  # mirrored at the sagittal plane
}
"""(3, 2) radians: ranges about y, x and z of the parent, of joints whose two segments may both carry a sensor.
The shoulder is missing: its range is nearly unlimited."""
