"""The motion of one target: a Kalman filter of a constant velocity, which says where to look for its balls.

A target has few numbers: compiled, a step takes a tenth of the time that numpy's calls take.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_so3 import turn_between, turned
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.search import GATE
from body_tracking.markers.targets import Target


@dataclass(frozen=True, slots=True)
class Motion:
    """How targets move.

    Attributes:
        acceleration: m/s^2, standard deviation of what is constant between two frames.
        angular_acceleration: rad/s^2.
        speed: m/s, standard deviation when a target is recognised.
        angular_speed: rad/s.
        coast: seconds for which a target that is not seen is predicted.
    """

    acceleration: float = 15.0
    angular_acceleration: float = 150.0
    speed: float = 1.5
    angular_speed: float = 6.0
    coast: float = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The motion of a target.

    Attributes:
        rotation: (3, 3) and
        translation: (3,) metres, its pose.
        velocity: (6,) m/s, and rad/s about fixed axes.
        covariance: (12, 12) of the pose, as :attr:`TargetPose.covariance`, and of the velocity.
        seen_ns: when it was last seen, nanoseconds.
    """

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    seen_ns: int

    @classmethod
    def begun(cls, pose: TargetPose, motion: Motion) -> Track:
        """That of a target that was recognised."""
        covariance = np.diag(np.repeat([0.0, 0.0, motion.speed**2, motion.angular_speed**2], 3))
        covariance[:6, :6] = pose.covariance
        return cls(pose.rotation, pose.translation, np.zeros(6), covariance, pose.stamp_ns)

    def predicted(self, elapsed_ns: int, motion: Motion) -> Track:
        """After so much time."""
        noise = np.array([motion.acceleration**2, motion.angular_acceleration**2])
        moved = _predicted(*self._numbers, elapsed_ns / NANOSECONDS, noise)
        return Track(*moved, self.seen_ns)

    def updated(self, pose: tuple[FloatArray, FloatArray, FloatArray], stamp_ns: int) -> Track:
        """With a pose as a measurement, rotation, translation, covariance: Kalman's update in Joseph's form."""
        # numpy's: these few calls take 0.1 ms, as a loop they take the compiler ten seconds
        gain = np.linalg.solve(self.covariance[:6, :6] + pose[2], self.covariance[:6]).T
        correction = gain @ _innovation(self.rotation, self.translation, *pose[:2])
        left = np.eye(12)
        left[:, :6] -= gain
        covariance = left @ self.covariance @ left.T + gain @ pose[2] @ gain.T
        return Track(
            turned(correction[3:6], self.rotation),
            self.translation + correction[:3],
            self.velocity + correction[6:],
            # rounding errors that are not symmetrical would grow from frame to frame
            0.5 * (covariance + covariance.T),
            stamp_ns,
        )

    def distance(self, pose: tuple[FloatArray, FloatArray, FloatArray]) -> float:
        """Squared Mahalanobis distance of a pose from the predicted one."""
        innovation = _innovation(self.rotation, self.translation, *pose[:2])
        return float(innovation @ np.linalg.solve(self.covariance[:6, :6] + pose[2], innovation))

    def gates(self, target: Target, points: Points) -> BoolArray:
        """(k, n) whether a point may be a ball of the target, by where the ball is expected."""
        # the balls' own covariance turns with the target, which its trace bounds
        own = target.covariance.diagonal().reshape(-1, 3).sum(axis=1)
        return _gates(target.points @ self.rotation.T, own, *self._numbers[1::2], points.positions, points.covariance)

    @property
    def _numbers(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        return self.rotation, self.translation, self.velocity, self.covariance


@compiled
def _predicted(
    rotation: FloatArray,
    translation: FloatArray,
    velocity: FloatArray,
    covariance: FloatArray,
    elapsed: float,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The numbers of a track after ``elapsed`` s; noise: (2,) squares of the accelerations."""
    moved = covariance.copy()
    for i in range(6):  # loops: array expressions take the compiler five times as long
        for j in range(6):
            mixed = covariance[i, j + 6] + elapsed * covariance[i + 6, j + 6]
            moved[i, j] += elapsed * (covariance[i + 6, j] + mixed)
            moved[i, j + 6] = mixed
            moved[j + 6, i] = mixed
    for i in range(6):
        square = noise[i // 3] * elapsed**2
        moved[i, i] += 0.25 * elapsed**2 * square
        moved[i, i + 6] += 0.5 * elapsed * square
        moved[i + 6, i] += 0.5 * elapsed * square
        moved[i + 6, i + 6] += square
    step = elapsed * velocity
    return turned(step[3:], rotation), translation + step[:3], velocity, moved


def _innovation(
    rotation: FloatArray, translation: FloatArray, measured_rotation: FloatArray, measured_translation: FloatArray
) -> FloatArray:
    """(6,) from the predicted to the measured pose."""
    turn = turn_between(rotation, measured_rotation)
    return np.concatenate([measured_translation - translation, turn])


@compiled
def _gates(
    arms: FloatArray,
    own: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    positions: FloatArray,
    noise: FloatArray,
) -> BoolArray:
    """(k, n) of :meth:`Track.gates`, of balls (k, 3) from the target's origin with variances (k,) of their own."""
    gates = np.zeros((len(arms), len(positions)), dtype=np.bool_)
    jacobian = np.zeros((3, 6))
    jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 1.0
    place = covariance[:6, :6].copy()
    for ball in range(len(arms)):
        x, y, z = arms[ball]
        # minus the cross product matrix of the arm
        jacobian[0, 4], jacobian[0, 5], jacobian[1, 5] = z, -y, x
        jacobian[1, 3], jacobian[2, 3], jacobian[2, 4] = -z, y, -x
        expected = jacobian @ place @ jacobian.T.copy()
        for i in range(3):
            expected[i, i] += own[ball]
        widest = expected[0, 0] + expected[1, 1] + expected[2, 2]
        for point in range(len(positions)):
            dx = positions[point, 0] - x - translation[0]
            dy = positions[point, 1] - y - translation[1]
            dz = positions[point, 2] - z - translation[2]
            s = noise[point]
            if dx * dx + dy * dy + dz * dz > GATE**2 * (widest + s[0, 0] + s[1, 1] + s[2, 2]):
                continue
            # the innovation's covariance by Cholesky, and the squared distance by forward substitution
            l00 = math.sqrt(expected[0, 0] + s[0, 0])
            l10, l20 = (expected[1, 0] + s[1, 0]) / l00, (expected[2, 0] + s[2, 0]) / l00
            l11 = math.sqrt(expected[1, 1] + s[1, 1] - l10 * l10)
            l21 = (expected[2, 1] + s[2, 1] - l20 * l10) / l11
            l22 = math.sqrt(expected[2, 2] + s[2, 2] - l20 * l20 - l21 * l21)
            a = dx / l00
            b = (dy - l10 * a) / l11
            c = (dz - l20 * a - l21 * b) / l22
            gates[ball, point] = a * a + b * b + c * c <= GATE**2
    return gates
