"""The body model's configuration from the orientations of some of its segments, with its covariance.

The most probable configuration q, by Gauss-Newton over the segments s that carry a sensor, with every angle's range of
motion as a weak measurement (as in the skeleton filter):

    sum_s |log(R_s(q)^T R_s)|^2 / S_s  +  sum_i ((q_i - centre_i) / stddev_i)^2  +  ((T q) / stddev_T)^2            (14)

The last term shares the twist of the trunk between its joints. Elbow and wrist have two angles for a rotation of three;
the rest is measurement error, spread over both segments by their covariances. The position of the base is not observed
and stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.ranges import TWIST_SHARING_STDDEV, Ranges
from body_tracking.kinematics.upper_body import PARENTS, UpperBody

_STEPS = 15
_ENOUGH = 1e-8


class OrientationKinematics:
    """Estimates configurations of ``UpperBody`` from orientations of segments."""

    def __init__(self, model: UpperBody, segments: Sequence[str]) -> None:
        """For the segments that carry sensors, at least one."""
        self._model, self._ranges = model, Ranges(model)
        self._numbers = np.array([model.segment_names.index(name) for name in segments], dtype=np.intp)
        self._lengths = model.default_lengths()

    def solve(
        self, rotations: FloatArray, covariances: FloatArray, start: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The most probable configuration (eq. 14).

        Args:
            rotations: (k, 3, 3) segments to world.
            covariances: (k, 3, 3) radians squared, in the segments' own frames.
            start: (35,) initial configuration, such as that of the frame before; its base is kept.

        Returns:
            (35,) configuration, (32, 32) covariance of its tangent, infinite for the position of the base.
        """
        model, ranges = self._model, self._ranges
        weights = np.linalg.inv(covariances)
        q = self._start(rotations) if start is None else start.copy()
        part = ranges.coordinates
        information = np.eye(model.nv - 3)
        damping, cost = 0.0, np.inf
        best = q
        for _ in range(_STEPS):
            lines = model.linearise(q, self._lengths)
            world = lines.posture.rotations[self._numbers]
            off = so3.rotation_vectors(world.swapaxes(-1, -2) @ rotations)
            turning = world.swapaxes(-1, -2) @ lines.rotation_jacobian[self._numbers]
            jacobian = (so3.right_jacobian_inverse(-off) @ turning)[..., 3:]
            soft = ranges.soft_coordinates(q)
            away = (soft.values - ranges.centre) / ranges.stddev
            twist = float(ranges.twist @ soft.values) / np.radians(TWIST_SHARING_STDDEV)
            weighted = np.einsum("kij,kj->ki", weights, off)
            now = float((weighted * off).sum() + away @ away + twist**2)
            if now > cost + _ENOUGH:  # the cost has grown: a shorter step from the best configuration
                damping = max(10.0 * damping, 1.0)
                q = best
                cost = np.inf
                continue
            done = cost - now < _ENOUGH
            best, cost = q, now
            information = np.einsum("kai,kab,kbj->ij", jacobian, weights, jacobian)
            gradient = np.einsum("kai,ka->i", jacobian, weighted)
            scaled = soft.gradients / ranges.stddev[:, None]
            rows = slice(part.start - 3, part.stop - 3)
            information[rows, rows] += scaled.T @ scaled
            gradient[rows] -= scaled.T @ away
            shared = (ranges.twist @ soft.gradients) / np.radians(TWIST_SHARING_STDDEV)
            information[rows, rows] += np.outer(shared, shared)
            gradient[rows] -= shared * twist
            if done:
                break
            step = np.zeros(model.nv)
            step[3:] = np.linalg.solve(information + damping * np.diag(information.diagonal()), gradient)
            q = model.integrate(q, step)
        covariance = np.diag(np.full(model.nv, np.inf))
        covariance[3:, 3:] = np.linalg.inv(information)
        return best, covariance

    def _start(self, rotations: FloatArray) -> FloatArray:
        """Ball joints by the nearest sensors, the other angles at the middle of their ranges."""
        model = self._model
        q = model.neutral()
        own = dict(zip(self._numbers.tolist(), rotations, strict=True))

        trunk = model.segment_names.index("upper_trunk")
        while trunk > 0 and trunk not in own:
            trunk = PARENTS[trunk]
        base = own.get(0, own.get(trunk, rotations[0]))
        q[model.quaternion_of("pelvis")] = so3.matrix_to_quat(base)
        q[model.scalar_q] = self._ranges.centre[model.scalar_v - 6]
        for side in ("left", "right"):
            segment = model.segment_names.index(f"upper_arm_{side}")
            if segment in own:
                clavicle = model.forward(q, self._lengths).rotations[PARENTS[segment]]
                q[model.quaternion_of(f"upper_arm_{side}")] = so3.matrix_to_quat(clavicle.T @ own[segment])
        return q
