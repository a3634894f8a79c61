"""Motion of one target: a Kalman filter with constant velocity, which predicts where its balls are.

The state is small: a compiled step takes a tenth of the time of numpy calls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_linear import inverse_of, whitening_of
from body_tracking.core.compiled_so3 import turn_between, turned
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.search import GATE
from body_tracking.markers.targets import Target


@dataclass(frozen=True, slots=True)
class Motion:
    """Process noise and initial uncertainty of targets' motion.

    Attributes:
        acceleration: m/s^2, standard deviation, constant between two frames.
        angular_acceleration: rad/s^2, standard deviation, constant between two frames.
        speed: m/s, standard deviation when a target is recognised.
        angular_speed: rad/s, standard deviation when a target is recognised.
        coast: seconds for which an unseen target is predicted.
    """

    acceleration: float = 15.0
    angular_acceleration: float = 150.0
    speed: float = 1.5
    angular_speed: float = 6.0
    coast: float = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """State of a target's filter.

    Attributes:
        rotation: (3, 3) and
        translation: (3,) metres: its pose.
        velocity: (6,) m/s, and rad/s about fixed axes.
        covariance: (12, 12) of the pose, as :attr:`TargetPose.covariance`, and of the velocity.
        seen_ns: capture time of the last measurement, nanoseconds.
    """

    rotation: FloatArray
    translation: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    seen_ns: int

    @classmethod
    def begun(cls, pose: TargetPose, motion: Motion) -> Track:
        """Initial track of a recognised target."""
        covariance = np.diag(np.repeat([0.0, 0.0, motion.speed**2, motion.angular_speed**2], 3))
        covariance[:6, :6] = pose.covariance
        return cls(pose.rotation, pose.translation, np.zeros(6), covariance, pose.stamp_ns)

    def predicted(self, elapsed_ns: int, motion: Motion) -> Track:
        """The track after ``elapsed_ns``."""
        noise = np.array([motion.acceleration**2, motion.angular_acceleration**2])
        moved = _predicted(*self._numbers, elapsed_ns / NANOSECONDS, noise)
        return Track(*moved, self.seen_ns)

    def updated(self, pose: tuple[FloatArray, FloatArray, FloatArray], stamp_ns: int) -> Track:
        """The track after a measured pose (rotation, translation, covariance): Kalman update in Joseph form."""
        return Track(*_updated(*self._numbers, *pose), stamp_ns)

    def distance(self, pose: tuple[FloatArray, FloatArray, FloatArray]) -> float:
        """Squared Mahalanobis distance of a pose from the predicted one; infinity if the covariance is invalid."""
        return float(_distance(self.rotation, self.translation, self.covariance, *pose))

    def gates(self, target: Target, points: Points) -> BoolArray:
        """(k, n) whether a point lies within the gate of a ball's predicted position."""
        # the trace bounds the balls' own covariance for any rotation of the target
        own = target.covariance.diagonal().reshape(-1, 3).sum(axis=1)
        positions = np.ascontiguousarray(points.positions)  # the type compiled ahead
        return _gates(target.points @ self.rotation.T, own, *self._numbers[1::2], positions, points.covariance)

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
    """The state after ``elapsed`` s; noise: (2,) variances of the accelerations."""
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


@compiled
def _innovation(
    rotation: FloatArray, translation: FloatArray, measured_rotation: FloatArray, measured_translation: FloatArray
) -> FloatArray:
    """(6,) step from the predicted to the measured pose."""
    result = np.empty(6)
    result[:3] = measured_translation - translation
    result[3:] = turn_between(rotation, measured_rotation)
    return result


@compiled
def _distance(
    rotation: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    measured_rotation: FloatArray,
    measured_translation: FloatArray,
    noise: FloatArray,
) -> float:
    """:meth:`Track.distance`."""
    whitening = np.empty((6, 6))
    if not whitening_of(covariance[:6, :6] + noise, whitening):
        return math.inf
    innovation = _innovation(rotation, translation, measured_rotation, measured_translation)
    distance = 0.0
    for i in range(6):
        white = 0.0
        for j in range(i + 1):
            white += whitening[i, j] * innovation[j]
        distance += white * white
    return distance


@compiled
def _updated(
    rotation: FloatArray,
    translation: FloatArray,
    velocity: FloatArray,
    covariance: FloatArray,
    measured_rotation: FloatArray,
    measured_translation: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The state after a measured pose with covariance (6, 6): :meth:`Track.updated`."""
    inverse, gain, left = np.empty((6, 6)), np.empty((12, 6)), np.empty((12, 12))
    inverse_of(covariance[:6, :6] + noise, inverse)
    innovation = _innovation(rotation, translation, measured_rotation, measured_translation)
    correction, result = np.zeros(12), np.empty((12, 12))
    for i in range(12):
        for j in range(6):
            gain[i, j] = 0.0
            for k in range(6):
                gain[i, j] += covariance[i, k] * inverse[k, j]
            correction[i] += gain[i, j] * innovation[j]
    for i in range(12):  # (1 - K H) P
        for j in range(12):
            left[i, j] = covariance[i, j]
            for k in range(6):
                left[i, j] -= gain[i, k] * covariance[k, j]
    for i in range(12):  # (1 - K H) P (1 - K H)' + K R K', symmetrical in spite of rounding
        for j in range(i + 1):
            value = left[i, j]
            for k in range(6):
                mixed = -left[i, k]
                for m in range(6):
                    mixed += gain[i, m] * noise[m, k]
                value += mixed * gain[j, k]
            result[i, j] = result[j, i] = value
    return (
        turned(correction[3:6], rotation),
        translation + correction[:3],
        velocity + correction[6:],
        result,
    )


@compiled
def _gates(
    arms: FloatArray,
    own: FloatArray,
    translation: FloatArray,
    covariance: FloatArray,
    positions: FloatArray,
    noise: FloatArray,
) -> BoolArray:
    """(k, n) of :meth:`Track.gates`; arms (k, 3): balls from the target's origin; own (k,): their variances."""
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
