"""Ranges of motion: soft limits of the angles of ``upper_body``, and the prior of an unobserved angle.

The limits are soft, because people differ, and the frames of a sensor's skeleton are not those of a goniometer. The
prior of an angle is normal about the centre of its range, with the limits at three standard deviations, unless
:mod:`body_tracking.kinematics.posture` has a better one: people are seldom near their limits.

Sources: AAOS, "Joint motion: method of measuring and recording" (1965), as in Norkin and White, "Measurement of joint
motion" (2016), appendix A, for neck, elbow, forearm and wrist; White and Panjabi, "Clinical biomechanics of the spine"
(1990), table 2-5, summed over T12-S1 (lumbar) and T1-T12 (thoracic); Ludewig et al., J. Bone Joint Surg. Am. 91 (2009)
378, for the clavicle against the thorax, with the elevation lowered because a Kinect's shoulder points hang low; the
cone of the shoulder by Engin and Tumer, J. Biomech. Eng. 111 (1989) 113. The bounds are theirs rounded outwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.upper_body import UpperBody

RANGES: dict[str, tuple[float, float]] = {
    "lumbar_flexion": (-35.0, 65.0),
    "lumbar_lateral": (-30.0, 30.0),
    "lumbar_axial": (-15.0, 15.0),
    "thoracic_flexion": (-25.0, 45.0),
    "thoracic_lateral": (-30.0, 30.0),
    "thoracic_axial": (-35.0, 35.0),
    "neck_flexion": (-60.0, 60.0),
    "neck_lateral": (-45.0, 45.0),
    "clavicle_protraction": (-25.0, 30.0),
    "clavicle_elevation": (-25.0, 40.0),
    "elbow_flexion": (-5.0, 150.0),
    "forearm_pronation": (-90.0, 90.0),
    "wrist_flexion": (-75.0, 80.0),
    "wrist_deviation": (-40.0, 30.0),
}
"""Degrees: (least, greatest) of each joint angle, of either side; a Kinect's hand point makes the wrist's wider."""

SHOULDER_SWING = 130.0
"""Degrees: largest angle between an upper arm and the centre of its reach."""
SHOULDER_TWIST = 110.0
"""Degrees: largest axial rotation of an upper arm, against the shortest rotation from the centre."""
RANGE_DEVIATIONS = 3.0
"""Standard deviations from the centre of a range to its limits."""
TWIST_SHARING_STDDEV = 30.0
"""Degrees: deviation of the lumbar part of a twist from its share by the ranges. Weak: only the sum is observed."""

_REACH = {"left": np.array([np.sin(np.pi / 4), np.cos(np.pi / 4), 0.0])}
_REACH["right"] = _REACH["left"] * [1.0, -1.0, 1.0]
"""Centre of the reach in the clavicle's frame: horizontal, 45 degrees between forward and sideways."""


_HALF_TURN = np.array([0.0, 0.0, 1.0, 0.0])
"""Quaternion xyzw of half a turn about z."""


@dataclass(frozen=True, slots=True)
class _Arm:
    """Indices of one arm's angles in configuration and tangent."""

    elbow_q: int
    elbow_v: int
    pronation_q: int
    shoulder_v: int


@dataclass(frozen=True, slots=True, eq=False)
class SoftCoordinates:
    """The bounded quantities at one configuration.

    Attributes:
        values: (..., 26) radians: the tangent's coordinates after the base; for a shoulder the rotation vector from the
            centre of its reach.
        gradients: (..., 26, 26) by the same tangent coordinates; the identity but for the shoulders.
    """

    values: FloatArray
    gradients: FloatArray


class Ranges:
    """The ranges of ``upper_body``.

    Attributes:
        low, high: (26,) radians, of :class:`SoftCoordinates`.
        centre, stddev: (26,) radians: prior of each coordinate by its range.
        coordinates: their slice of the tangent vector.
        to_centre: (2, 4) quaternions from the centres of the reach of the left and the right shoulder.
        twist: (26,) coefficients of the difference from sharing a twist between lumbar and thoracic joints by range.
    """

    def __init__(self, model: UpperBody) -> None:
        self._model = model
        names = model.coordinate_names
        self.coordinates = slice(6, model.nv)
        low, high = np.empty(model.nv - 6), np.empty(model.nv - 6)
        for number, name in enumerate(names[6:]):
            kind = name.removesuffix("_left").removesuffix("_right")
            if kind.startswith("shoulder"):
                bound = SHOULDER_TWIST if kind.endswith("_z") else SHOULDER_SWING
                low[number], high[number] = -bound, bound
            else:
                low[number], high[number] = RANGES[kind]
        self.low: FloatArray = np.radians(low)
        self.high: FloatArray = np.radians(high)
        self.centre: FloatArray = 0.5 * (self.low + self.high)
        self.stddev: FloatArray = (self.high - self.low) / (2.0 * RANGE_DEVIATIONS)
        self.twist: FloatArray = np.zeros(model.nv - 6)
        lumbar, thoracic = (names[6:].index(f"{part}_axial") for part in ("lumbar", "thoracic"))
        self.twist[lumbar], self.twist[thoracic] = 1.0, -high[lumbar] / high[thoracic]
        self._scalar_soft = model.scalar_v - 6
        starts = [names.index(f"shoulder_x_{side}") for side in _REACH]
        self._soft: IntArray = (np.array(starts)[:, None] - 6 + np.arange(3)).astype(np.intp)
        self._quaternions: IntArray = np.array(
            [[model.quaternion_of(f"upper_arm_{side}").start + k for k in range(4)] for side in _REACH], dtype=np.intp
        )
        place = {names[v]: int(q) for v, q in zip(model.scalar_v, model.scalar_q, strict=True)}
        self._arms = {
            side: _Arm(
                place[f"elbow_flexion_{side}"],
                names.index(f"elbow_flexion_{side}"),
                place[f"forearm_pronation_{side}"],
                names.index(f"shoulder_x_{side}"),
            )
            for side in _REACH
        }
        hanging = np.array([0.0, 0.0, -1.0])
        self.to_centre: FloatArray = so3.quat_inverse(
            so3.exp(np.array([0.5 * np.pi * np.cross(hanging, reach) for reach in _REACH.values()]))
        )

    def soft_coordinates(self, q: FloatArray) -> SoftCoordinates:
        """The bounded quantities of configurations (..., nq)."""
        values = self.values(q)
        return SoftCoordinates(values, self.gradients(values))

    def gradients(self, values: FloatArray) -> FloatArray:
        """(..., 26, 26) gradients of :class:`SoftCoordinates`, from its values (..., 26)."""
        turned = values[..., self._soft]
        gradients = np.zeros((*values.shape, len(self.low)))
        gradients[...] = np.eye(len(self.low))
        jacobian = so3.right_jacobian_inverse(turned)
        for side, rows in enumerate(self._soft):
            gradients[..., rows[:, None], rows] = jacobian[..., side, :, :]
        return gradients

    def values(self, q: FloatArray) -> FloatArray:
        """(..., 26) values of :class:`SoftCoordinates` at configurations (..., nq)."""
        values = np.empty((*q.shape[:-1], len(self.low)))
        values[..., self._scalar_soft] = q[..., self._model.scalar_q]
        values[..., self._soft] = so3.log(so3.quat_multiply(self.to_centre, q[..., self._quaternions]))
        return values

    def excess(self, q: FloatArray) -> FloatArray:
        """(..., 26) radians by which configurations (..., nq) leave the ranges; 0 inside.

        The swing of a shoulder is bounded as a whole: its two components share the excess in their proportion.
        """
        values = self.values(q)
        excess = np.maximum(values - self.high, 0.0) + np.minimum(values - self.low, 0.0)
        for rows in self._soft:
            swing = values[..., rows[:2]]
            size = np.sqrt((swing * swing).sum(axis=-1, keepdims=True))
            over = np.maximum(size - np.radians(SHOULDER_SWING), 0.0)
            excess[..., rows[:2]] = swing * (over / np.maximum(size, 1e-12))
        return excess

    def clipped(self, q: FloatArray, margin: float) -> FloatArray:
        """(nq,) a configuration whose angles and shoulders are at most a margin (radians) beyond their ranges."""
        rows = self._model.scalar_v - 6
        clipped = q.copy()
        turned = self.values(q)[self._soft]
        swing = np.sqrt((turned[:, :2] ** 2).sum(axis=1, keepdims=True))
        turned[:, :2] *= np.minimum(1.0, (np.radians(SHOULDER_SWING) + margin) / np.maximum(swing, 1e-12))
        twist = np.radians(SHOULDER_TWIST) + margin
        turned[:, 2] = np.clip(turned[:, 2], -twist, twist)
        clipped[self._quaternions] = so3.quat_multiply(so3.quat_inverse(self.to_centre), so3.exp(turned))
        clipped[self._model.scalar_q] = np.clip(
            q[self._model.scalar_q], self.low[rows] - margin, self.high[rows] + margin
        )
        return clipped

    def nearest_branch(self, q: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """An equivalent configuration whose angles leave the ranges less.

        Half a turn of the upper arm about its axis, the elbow bent the other way and half a turn of the forearm leave
        the posture unchanged. A fit to points can converge to either branch; the ranges distinguish them.

        Args:
            q: (nq,) one configuration.

        Returns:
            The other configuration, and (nv,) factors 1 or -1 that turn its tangent into the old one's; None where the
            present branch is as good.
        """
        found = q
        signs = np.ones(self._model.nv)
        for side, arm in self._arms.items():
            if found[arm.elbow_q] >= 0.0 and abs(found[arm.pronation_q]) <= np.pi:
                continue
            other = found.copy()
            other[arm.pronation_q] = so3.wrapped(found[arm.pronation_q])
            candidates = [(other, False)]
            if found[arm.elbow_q] < 0.0:
                flipped = other.copy()
                upper_arm = self._model.quaternion_of(f"upper_arm_{side}")
                flipped[upper_arm] = so3.quat_multiply(found[upper_arm], _HALF_TURN)
                flipped[arm.elbow_q] = -found[arm.elbow_q]
                flipped[arm.pronation_q] = np.remainder(found[arm.pronation_q], 2.0 * np.pi) - np.pi
                candidates.append((flipped, True))
            least = np.abs(self.excess(found)).sum()
            for candidate, turned in candidates:
                outside = np.abs(self.excess(candidate)).sum()
                if outside < least - 1e-9:
                    found, least = candidate, outside
                    if turned:
                        signs[[arm.shoulder_v, arm.shoulder_v + 1, arm.elbow_v]] *= -1.0
        return None if found is q else (found, signs)
