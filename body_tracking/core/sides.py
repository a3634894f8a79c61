"""Left and right of one body: which way its upper and its lower half face, and how they are swapped.

A Kinect takes every body to face it, and sometimes turns only the shoulders. Upper and lower body each have a heading
here, the direction of their left-right axis in the horizontal plane of ``world``; it is a plain number, because the
arithmetic of two angles per sensor is cheaper without arrays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from body_tracking.core.skeleton import MIRROR, N_JOINTS, FloatArray, IntArray, Joint

SAME_SENSE = 0.5
"""Cosine between two axes above which they have the same sense; a mean of axes farther apart has no length left."""

_SHORTEST = 0.02
"""An axis shorter than this, metres, has no heading."""

PAIRS = (
    np.array([Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT], dtype=np.intp),
    np.array([Joint.HIP_LEFT, Joint.HIP_RIGHT], dtype=np.intp),
)
"""The ends of the left-right axes of the upper and of the lower body."""

_ENDS = np.concatenate(PAIRS)
_LOWER = np.isin(
    np.arange(N_JOINTS), [joint for joint in Joint if joint.name.startswith(("HIP", "KNEE", "ANKLE", "FOOT"))]
)
_LATERAL = np.arange(N_JOINTS) != MIRROR
HALVES = (np.flatnonzero(_LATERAL & ~_LOWER), np.flatnonzero(_LATERAL & _LOWER))
"""The paired joints (left and right) of the upper and of the lower body."""


def headings_of(points: FloatArray) -> list[float]:
    """The headings of the upper and the lower body, radians, of (25, 3) joints in world; NaN where not known."""
    found, ends = [], points[_ENDS].tolist()
    for (left_x, left_y, _), (right_x, right_y, _) in (ends[0:2], ends[2:4]):
        x, y = left_x - right_x, left_y - right_y
        found.append(math.atan2(y, x) if math.hypot(x, y) > _SHORTEST else math.nan)
    return found


def heading_weights(points: FloatArray, variance: FloatArray) -> list[float]:
    """The inverse variances of both headings of :func:`headings_of`, 1/rad2; 0 where not known.

    The variance of the direction of an axis is that of the difference of its ends across it over its squared length.

    Args:
        points: (25, 3) metres in world.
        variance: (25,) square metres.
    """
    weights = []
    for left, right in PAIRS:
        x, y, _ = (points[left] - points[right]).tolist()
        weight = (x * x + y * y) / (float(variance[left]) + float(variance[right]))
        weights.append(weight if math.isfinite(weight) else 0.0)
    return weights


def reversed_halves(headings: Sequence[float], believed: Sequence[float]) -> list[tuple[IntArray, bool]]:
    """The halves of a body whose heading differs from the reference; a half with an unknown heading is left out.

    Args:
        headings: of both halves, from :func:`headings_of`.
        believed: the reference headings of both halves.

    Returns:
        The joints of each such half, and whether its heading is opposite to the reference, so that left and right
        are swapped; otherwise it is across.
    """
    cosines = [math.cos(a - b) for a, b in zip(headings, believed, strict=True)]  # NaN for an unknown heading
    return [
        (joints, cosine < -SAME_SENSE) for joints, cosine in zip(HALVES, cosines, strict=True) if cosine < SAME_SENSE
    ]


def swap_left_right(
    halves: Sequence[tuple[IntArray, bool]],
    points: FloatArray,
    variance: FloatArray,
    states: np.ndarray,
    factor: float = 2.0,
) -> None:
    """Swap left and right, in place, in halves that are opposite, and reject the joints of those that are across.

    Args:
        halves: from :func:`reversed_halves`.
        points: (25, 3) metres.
        variance: (25,) square metres; infinite for rejected joints.
        states: (25,).
        factor: on the variances of the joints that are swapped.
    """
    for joints, opposite in halves:
        if opposite:
            other = MIRROR[joints]
            points[joints], states[joints] = points[other], states[other]
            variance[joints] = factor * variance[other]
        else:
            variance[joints] = np.inf
