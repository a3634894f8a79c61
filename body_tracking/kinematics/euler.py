"""Rotations as three successive angles, continuous through singular poses.

``R = R(e1, t1) R(e2, t2) R(e3, t3)``: intrinsic, about three of a frame's axes, one after the
other. Every such sequence has a singular pose in which the first and the last axis coincide: for ``e3`` along ``e1``
(proper Euler angles) where the middle angle is 0 or 180 deg, for three different axes (Cardan angles) where it is 90 or
-90 deg. There only the sum or the difference of the outer angles is determined.

A quarter turn about its second axis makes a Cardan sequence an Euler sequence, whose middle angle is a quarter turn
less. So the code has only the Euler sequence x y x of ``pre @ R @ post``, with angles (a, b, c): ``t1 = a``,
``t2 = b + offset``, ``t3 = sign c``. Its first column, (cos b, sin a sin b, -cos a sin b), is the direction of the last
axis; the distance ``|sin b|`` of this direction from the first axis determines the accuracy of a.

Near the singular pose, where that distance is within the uncertainty of the rotation, the first angle is held at its
previous value (at 0 where there is none), and the other two are chosen nearest to the rotation; the departure is of the
size of the rotation's own uncertainty. From :data:`FREE` standard deviations on the angles are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from body_tracking.core.skeleton import BoolArray, FloatArray

_TURN = 2.0 * np.pi

HELD, FREE = 2.5, 5.0
"""Standard deviations from the singular pose: within the first the split is held, from the second on it is free.

The outer angles have an infinite standard deviation within the first, which noise alone exceeds in one frame of twenty.
Between the two the first angle changes by a share of the measured change.
"""
MIN_HOLD = np.radians(0.1)
"""Radians: lower bound of a rotation's standard deviation, so that rounding errors decide no angle."""
MAX_HOLD = np.radians(4.0)
"""Radians: upper bound, so that 20 deg away from a singular pose even an unobserved rotation has its own angles."""
WHOLE_MARGIN = np.radians(60.0)
"""Radians by which an angle may leave its usual range for the sake of continuity, before it jumps by a full turn."""
_SURE = np.radians(20.0)
"""Standard deviation of the rotation about the last axis at which the last angle's range counts half.

The direction given by the first two angles is usually better known: noise that rotates a straight arm beyond its range
must not reverse its direction.
"""


@dataclass(frozen=True, slots=True)
class EulerAngles:
    """A sequence of three angles for one rotation.

    Attributes:
        axes: the three axes, each along an axis of the frame, the second perpendicular to both others.
        usual: degrees, (least, greatest) of the three angles, to choose among equivalent triples.
        turn: (3, 3) ``R @ turn`` is decomposed instead of R. None for the identity.
        margin: degrees by which the excess of the three angles over their usual ranges, summed, may be greater than
            that of the equivalent triple, for continuity, before they jump to that triple; from half of it on their
            uncertainty grows. A continuous path around a singular pose can end in angles such as -180, 180, 180 deg for
            hanging arms: noise decides on which side of the pose an arm passes. Where hanging is the singular pose, an
            arm that swings back through it needs 60 deg (extension).
        together: degrees, greatest usual sum of the absolute values of the first two angles. Of a rotation's two Cardan
            triples one has a sum of s, the other one of about 360 - s: a sum near 360 stands for a small rotation.
    """

    axes: tuple[FloatArray, FloatArray, FloatArray]
    usual: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
    turn: FloatArray | None = None
    margin: float = 60.0
    together: float = float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Angles of n rotations and their derivatives.

    Attributes:
        angles: (n, 3) radians.
        gradients: (n, 3, 3) of the angles by the angular velocity, in the parent's frame; huge at a singular pose.
        rates: (n, 3, 3) the same for the angles as they are held near a singular pose.
        doubt: (n,) from 0 to 1: how near the three angles are to a jump back into their usual ranges.
        second_order: (n,) square radians: variance of the first and of the third angle beyond that of ``gradients``,
            near a singular pose; see :meth:`EulerSequences.split`.
    """

    angles: FloatArray
    gradients: FloatArray
    rates: FloatArray
    doubt: FloatArray
    second_order: FloatArray


class EulerSequences:
    """n three-angle sequences, split at once."""

    def __init__(self, sequences: Sequence[EulerAngles]) -> None:
        quarter = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # -90 deg about y
        pre, post, offset, sign = [], [], [], []
        for sequence in sequences:
            first, second, third = sequence.axes
            basis = np.stack([first, second, np.cross(first, second)], axis=-1)
            along = float(third @ first)
            cardan = along == 0.0
            turn = np.eye(3) if sequence.turn is None else sequence.turn
            pre.append(basis.T)
            post.append(turn @ basis @ (quarter if cardan else np.eye(3)))
            offset.append(0.5 * np.pi if cardan else 0.0)
            sign.append(float(third @ basis[:, 2]) if cardan else along)
        self.basis: FloatArray = np.stack(pre).swapaxes(-1, -2)
        self._pre, self._post = np.stack(pre), np.stack(post)
        # weights of a small rotation's three variances: the mean of the two that are not about the first axis
        self._tilt = 0.5 * (1.0 - self._pre[:, 0] ** 2)
        self._offset, self._sign = np.array(offset), np.array(sign)
        usual = np.radians([sequence.usual for sequence in sequences])
        self._low, self._high = usual[..., 0], usual[..., 1]
        self._centre = 0.5 * (self._low + self._high)
        self._margin = np.radians([sequence.margin for sequence in sequences])
        self._together = np.radians([sequence.together for sequence in sequences])

    def split(self, rotations: FloatArray, variances: FloatArray, previous: FloatArray | None) -> Split:
        """Angles of rotations.

        The first angle is the direction in which an axis leaves that of the singular pose. At a sine d from there,
        known with a deviation s, its deviation is to first order r = s / d. It is the angle of a normal distribution in
        the plane with the mean (d, 0), whose 95 % interval has the half width 1.96 sqrt(r^2 + 2 r^4) to 4 % while r is
        below 0.7 (by simulation; for larger r the formula gives too much). The third angle turns with the first. The
        term in r^4 has the factor 1 - d^2: a quarter turn from the singular pose the relation is linear.

        Args:
            rotations: (n, 3, 3) of a child in its parent.
            variances: (n, 3) square radians, of a small rotation about the parent's axes; pi squared where unknown.
            previous: (n, 3) radians to stay near to, or None.
        """
        # entries of pre @ R @ post
        r = self._pre @ rotations @ self._post
        y, z = r[:, 1, 0], r[:, 2, 0]
        distance = np.sqrt(y * y + z * z)
        tilt = (self._tilt * variances).sum(axis=-1)
        doubt = np.sqrt(np.minimum(np.maximum(tilt, MIN_HOLD**2), MAX_HOLD**2))
        x = np.minimum(np.maximum((distance / doubt - HELD) / (FREE - HELD), 0.0), 1.0)
        hold = 1.0 - x * x * (3.0 - 2.0 * x)

        # two solutions, half a turn of the first angle apart: (2, n)
        angles = np.empty((2, len(r), 3))
        a = angles[..., 0]
        a[0] = np.arctan2(y, -z)
        a[1] = a[0] + np.pi
        away = (0.0 if previous is None else previous[:, 0]) - a
        a += hold * (away - _TURN * np.rint(away / _TURN))
        # cosines and sines of a and b
        parts = np.empty((4, 2, len(r)))
        ca, sa, cb, sb = np.cos(a, out=parts[0]), np.sin(a, out=parts[1]), parts[2], parts[3]
        row_y = ca[..., None] * r[:, 1] + sa[..., None] * r[:, 2]
        row_z = ca[..., None] * r[:, 2] - sa[..., None] * r[:, 1]
        b = np.arctan2(-row_z[..., 0], r[:, 0, 0])
        np.cos(b, out=cb)
        np.sin(b, out=sb)
        c = np.arctan2(
            sb * r[:, 0, 1] + cb * row_z[..., 1] - row_y[..., 2], row_y[..., 1] + sb * r[:, 0, 2] + cb * row_z[..., 2]
        )
        angles[..., 1] = b + self._offset
        angles[..., 2] = self._sign * c
        # variance of a small rotation about the last axis
        last = ((self._pre.swapaxes(-1, -2) @ r[:, :, :1])[..., 0] ** 2 * variances).sum(axis=-1)
        chosen, best, beyond = self._choose(angles, previous, _SURE**2 / (_SURE**2 + last))
        derivatives = self._derivatives(np.where(best, parts[:, 0], parts[:, 1]), distance, hold)
        square = np.maximum(distance**2, 1e-18)
        second_order = 2.0 * np.square(tilt / square) * np.maximum(1.0 - square, 0.0)
        return Split(chosen, *derivatives, np.clip(2.0 * beyond / self._margin - 1.0, 0.0, 1.0), second_order)

    def _choose(
        self, angles: FloatArray, previous: FloatArray | None, weight: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """The better of two solutions.

        Args:
            angles: (2, n, 3) both, without full turns.
            previous: (n, 3) to stay near to, or None.
            weight: (n,) of the last angle's range.

        Returns:
            (n, 3) angles; (n,) whether they are the first solution; and (n,) radians by which they leave their usual
            ranges farther than the other solution.
        """
        near = self._centre if previous is None else previous
        angles = angles + _TURN * np.rint((near - angles) / _TURN)
        excess = self._excess(angles)
        if previous is not None and excess.max() > WHOLE_MARGIN:
            usual = angles + _TURN * np.rint((self._centre - angles) / _TURN)
            angles = np.where(excess > WHOLE_MARGIN, usual, angles)
            excess = self._excess(angles)
        if previous is None:
            cost = (np.abs(angles) + 100.0 * excess).sum(axis=-1)
            beyond = np.zeros(cost.shape)
        else:
            outside = excess[..., 0] + excess[..., 1] + weight * excess[..., 2]
            beyond = outside - outside[::-1]
            # continuity first; of two solutions as near the more usual one
            cost = (
                np.abs(angles - previous).sum(axis=-1) + 0.1 * outside + 100.0 * np.maximum(beyond - self._margin, 0.0)
            )
        best: BoolArray = cost[0] <= cost[1]
        return np.where(best[:, None], angles[0], angles[1]), best, np.where(best, beyond[0], beyond[1])

    def _excess(self, angles: FloatArray) -> FloatArray:
        excess: FloatArray = np.maximum(np.maximum(angles - self._high, self._low - angles), 0.0)
        excess[..., 1] += np.maximum(np.abs(angles[..., :2]).sum(axis=-1) - self._together, 0.0)
        return excess

    def _derivatives(self, parts: FloatArray, distance: FloatArray, hold: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n, 3, 3) of the free, and of the held, angles by the angular velocity in the parent's frame.

        From w = a' x + b' (0, cos a, sin a) + c' (cos b, sin a sin b, -cos a sin b) in the frame of the axes.
        """
        ca, sa, cb, sb = parts
        gradients = np.zeros((2, len(ca), 3, 3))
        size = np.maximum(np.abs(sb), 1e-9)
        held = np.maximum(distance, size)
        across = np.empty((2, len(ca)))
        across[0] = 1.0 / size
        across[1] = (1.0 - hold) / held
        across = np.copysign(across, sb)
        gradients[:, :, 1, 1], gradients[:, :, 1, 2] = ca, sa
        gradients[1, :, 2, 0] = hold * cb
        gradients[:, :, 2, 1], gradients[:, :, 2, 2] = across * sa, -across * ca
        gradients[:, :, 0, 0] = 1.0
        gradients[:, :, 0] -= cb[:, None] * gradients[:, :, 2]
        gradients[:, :, 2] *= self._sign[:, None]
        free, still = gradients @ self._pre
        return free, still
