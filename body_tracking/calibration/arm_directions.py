"""Directions of the arms of a Kinect v2 against anatomical ones, as a function of the arm's pose.

A Kinect v2 overstates a lifted arm's elevation towards the side, understates it backward, and sees elbows 6 to 10
degrees too straight, in everybody. With unit directions ``u`` of the upper arm and ``f`` of the forearm in the
axes of the thorax (forward, left, up; of a right arm, a left one mirrored), the anatomical ones are

    u' ~ u + U (1, u),   f' ~ f + F (1, u, f)                                                                       (1)

each normalised. ``U`` (3, 4) and ``F`` (3, 7) are fitted to joint centres by Vicon (``benchmarks/kinect_vs_vicon.py``).
Eq. (1) has an exact inverse: with ``u + A u + b = s u'`` and
``|u| = 1``, ``u = s p - q``, ``p = (I + A)^-1 u'``, ``q = (I + A)^-1 b``, and ``s`` is the greater root of
``|s p - q|^2 = 1``. The simulated Kinect errs by this inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.calibration.joint_centres import body_axes
from body_tracking.core.skeleton import FloatArray, IntArray, Joint, Skeleton

_J = Joint
_ARMS: Final[IntArray] = np.array(
    [[_J.SHOULDER_LEFT, _J.ELBOW_LEFT, _J.WRIST_LEFT], [_J.SHOULDER_RIGHT, _J.ELBOW_RIGHT, _J.WRIST_RIGHT]],
    dtype=np.intp,
)
_WITH_WRIST: Final[IntArray] = np.array(
    [
        [_J.WRIST_LEFT, _J.HAND_LEFT, _J.HAND_TIP_LEFT, _J.THUMB_LEFT],
        [_J.WRIST_RIGHT, _J.HAND_RIGHT, _J.HAND_TIP_RIGHT, _J.THUMB_RIGHT],
    ],
    dtype=np.intp,
)
_TO_RIGHT: Final[FloatArray] = np.array([[[1.0, -1.0, 1.0]], [[1.0, 1.0, 1.0]]])
"""(2, 1, 3) mirrors the left arm's directions to a right one's, and back."""

Directions = Callable[[FloatArray], FloatArray]
"""From (..., 2, 3) unit directions of upper arm and forearm to others."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmLaw:
    """The coefficients of eq. (1).

    Attributes:
        upper: (3, 4) ``U``.
        forearm: (3, 7) ``F``.
    """

    upper: FloatArray
    forearm: FloatArray

    def anatomical(self, measured: FloatArray) -> FloatArray:
        """Eq. (1): (..., 2, 3) unit directions of upper arm and forearm, right arm, axes of the thorax."""
        u, f = measured[..., 0, :], measured[..., 1, :]
        turned = measured + np.stack([_rows(u) @ self.upper.T, _rows(u, f) @ self.forearm.T], axis=-2)
        result: FloatArray = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        return result

    def measured(self, anatomical: FloatArray) -> FloatArray:
        """The inverse of :meth:`anatomical`, exact."""
        u = _solve(self.upper[:, 1:], self.upper[:, 0], anatomical[..., 0, :])
        constant = _rows(u) @ self.forearm[:, :4].T
        return np.stack([u, _solve(self.forearm[:, 4:], constant, anatomical[..., 1, :])], axis=-2)


KINECT_V2: Final = ArmLaw(
    np.array([[-0.031, 0.008, 0.021, 0.139], [-0.018, -0.078, -0.026, -0.090], [-0.048, -0.048, 0.012, -0.068]]),
    np.array(
        [
            [0.034, 0.028, -0.003, 0.028, -0.030, -0.011, 0.071],
            [0.012, -0.042, -0.038, -0.013, -0.065, -0.061, -0.004],
            [-0.024, 0.029, -0.002, -0.018, -0.006, -0.019, 0.009],
        ]
    ),
)
"""Fitted to 48 clips of shoulder exercises of five people (UI-PRMD, Vakanski et al. 2018), those in which the time warp
explains at least 0.9 of the variance: ``benchmarks/kinect_vs_vicon.py --fit``."""


def corrected_arms(skeleton: Skeleton, law: ArmLaw = KINECT_V2) -> Skeleton:
    """A skeleton of a Kinect v2 with the arms in their anatomical directions; unchanged without shoulders.

    Args:
        skeleton: in a frame with z up, along which the thorax counts where SpineMid is unknown, as at a table; only its
            positions change.
        law: eq. (1).
    """
    known = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)
    turned = turn_arms(known, body_axes(known), law.anatomical)
    return replace(skeleton, positions=np.where(skeleton.valid[:, None], turned, skeleton.positions))


def turn_arms(positions: FloatArray, axes: FloatArray, directions: Directions) -> FloatArray:
    """Positions with both arms' directions replaced; bones keep their lengths, hands move with the wrists.

    Args:
        positions: (..., 25, 3) metres, any frame, NaN where unknown.
        axes: (..., 3, 3) the thorax's axes (forward, left, up) in that frame, as columns; NaN where unknown.
        directions: the new directions, for instance :meth:`ArmLaw.anatomical`.

    Returns:
        (..., 25, 3) metres. A bone with an unknown end keeps its direction.
    """
    bones = np.diff(positions[..., _ARMS, :], axis=-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
        axes = axes[..., None, :, :]
        turned = directions(bones / lengths @ axes * _TO_RIGHT) * _TO_RIGHT @ axes.swapaxes(-1, -2) * lengths - bones
    elbow, forearm = (np.where(np.isfinite(turned[..., k, :]), turned[..., k, :], 0.0) for k in (0, 1))
    result = positions.copy()
    result[..., _ARMS[:, 1], :] += elbow
    result[..., _WITH_WRIST, :] += (elbow + forearm)[..., None, :]
    return result


def _rows(*directions: FloatArray) -> FloatArray:
    """(..., 1 + 3 m) a one and the directions."""
    return np.concatenate([np.ones((*directions[0].shape[:-1], 1)), *directions], axis=-1)


def _solve(matrix: FloatArray, constant: FloatArray, end: FloatArray) -> FloatArray:
    """Unit vectors u with u + matrix u + constant along ``end``."""
    inverse = np.linalg.inv(np.eye(3) + matrix).T
    p, q = end @ inverse, constant @ inverse
    square, both = (p * p).sum(axis=-1), (p * q).sum(axis=-1)
    scale = (both + np.sqrt(both**2 + square * (1.0 - (q * q).sum(axis=-1)))) / square
    result: FloatArray = scale[..., None] * p - q
    return result
