"""The offset between two sensors' clocks, from the motion that both saw.

The times of receipt give a first guess, with an error of up to a network burst. The speeds of the joints do not depend
on the sensors' poses, so their correlation over time gives the offset before any pose is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.calibration import moving
from body_tracking.calibration.clock_correlation import STEP, Series, correlate
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray

RECEIPT_PRIOR = 0.05
"""Standard deviation of an offset by times of receipt, seconds: sensors have different delays. In nine recordings of
two Kinects on two computers these are 15 to 40 ms apart."""

LIKE = 60.0
"""Seconds of motion whose variance of the offset equals that of the systematic error: a twist that is seen from its
side changes the offset by up to 60 ms, for as long as it lasts."""

_OVERLAP = 2.0
"""Least overlap of both sensors' motion at an offset, seconds."""

_SPAN = 4
"""Frames over which a speed is taken: limbs move at up to about 5 Hz, higher frequencies are noise."""

_SMOOTHING = (0.0625, 0.25, 0.375, 0.25, 0.0625)
"""Weights of neighbouring speeds."""

_MIN_JOINTS = 8
"""Least number of joints known in both frames of a speed."""

_LIMB_JOINTS: IntArray = np.array([0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 16, 17, 20], dtype=np.intp)

_INDEPENDENT = 0.5
"""Time between independent joint speeds where offsets far apart are compared, seconds: limbs swing about once a second,
and swings resemble each other."""

_UNLIKE = 0.05
"""Least share of unexplained variance of the joint speeds between two sensors: bounds the likelihood."""


@dataclass(frozen=True, slots=True)
class OffsetEstimate:
    """Sensor clock minus reference clock.

    Attributes:
        offset: seconds.
        correlation: normalised correlation of the joint speeds at that offset, -1 to 1.
        likely: correlation that would be equally probable at the guess: smaller than ``correlation`` for an offset far
            from the guess, and for little motion.
        margin: difference of ``likely`` to the best offset more than 0.3 s away.
    """

    offset: float
    correlation: float
    likely: float
    margin: float


def joint_speeds(stamps: FloatArray, positions: FloatArray) -> Series:
    """Compressed speeds of the limbs' joints.

    Args:
        stamps: (n,) seconds, ascending.
        positions: (n, 25, 3) metres; NaN where not known.

    Returns:
        Speeds at n - 4 times; empty where there are not enough frames.
    """
    if len(stamps) < 2 * _SPAN:
        return Series(np.empty(0), np.empty((0, len(_LIMB_JOINTS))), np.empty(0, dtype=np.bool_))
    step = stamps[_SPAN:] - stamps[:-_SPAN]
    moved = positions[_SPAN:, _LIMB_JOINTS] - positions[:-_SPAN, _LIMB_JOINTS]
    speed = np.linalg.norm(moved, axis=-1) / np.maximum(step, 1e-3)[:, None]
    known = np.isfinite(speed)
    good: BoolArray = (known.sum(axis=1) >= _MIN_JOINTS) & (step < _SPAN * 0.07)
    # A label that jumps is faster than any limb; the logarithm keeps it from deciding alone.
    value = np.log1p(5.0 * np.minimum(np.where(known, speed, 0.0), 5.0))
    # An unknown joint gets the mean speed of the others.
    mean = value.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    value = np.where(known, value, mean[:, None])
    # Interpolation half-way between independent samples halves their noise and would bias the offset towards it;
    # smoothing correlates neighbours.
    value = moving.weighted(value.T, _SMOOTHING).T
    good = moving.all_in(good, len(_SMOOTHING))
    return Series(0.5 * (stamps[_SPAN:] + stamps[:-_SPAN]), value, good)


def _time_of_motion(speeds: FloatArray, known: BoolArray) -> float:
    """Effective duration of motion, seconds: (sum e)^2 / sum e^2 samples, e the squared deviations from the mean."""
    moved = ((speeds - speeds.sum(axis=0) / max(known.sum(), 1)) ** 2).sum(axis=1) * known
    return STEP * max(float(moved.sum() ** 2 / np.maximum((moved**2).sum(), 1e-12)), 1.0)


def correlate_clocks(
    reference: tuple[FloatArray, FloatArray], sensor: tuple[FloatArray, FloatArray], guess: float, window: float
) -> OffsetEstimate | None:
    """Find the offset at which the joint speeds of two recordings of one person agree best.

    Args:
        reference: stamps (n,) seconds ascending, positions (n, 25, 3) metres.
        sensor: stamps and positions of the other sensor, in its own clock and frame.
        guess: sensor clock minus reference clock, seconds, known to within ``window``.
        window: half width of the search, seconds.

    Returns:
        The best offset, or None where the recordings do not overlap for at least two seconds.
    """
    own, theirs = joint_speeds(*reference), joint_speeds(sensor[0] - guess, sensor[1])
    found = correlate(own, theirs, window, _OVERLAP)
    if found is None:
        return None
    lag, score = found.lags, np.where(found.overlap < _OVERLAP, -1.0, found.rho)
    # Periodic or little motion correlates at several offsets. A correlation rho of n independent samples adds
    # n / 2 log(1 / (1 - rho^2)) to the log-likelihood, and the guess a Cauchy prior, because its error is heavy-tailed.
    # Their sum is expressed as a correlation again.
    worse = (1.0 + (lag / RECEIPT_PRIOR) ** 2) ** (2.0 * _INDEPENDENT / _time_of_motion(*found.reference))
    unlike = np.maximum(1.0 - score**2, _UNLIKE) * worse
    likely = np.where(score > 0.0, np.sqrt(np.maximum(1.0 - unlike, 0.0)), score)
    best = int(np.argmax(likely))
    far = np.abs(lag - lag[best]) > 0.3
    margin = float(likely[best] - likely[far].max()) if far.any() else 0.0
    # The prior selects the peak and must not shift it.
    peak = int(np.argmax(np.where(np.abs(lag - lag[best]) <= 0.1, score, -np.inf)))
    return OffsetEstimate(guess + float(lag[peak]), float(score[peak]), float(likely[best]), margin)
