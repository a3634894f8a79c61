"""Detection of exchanged and slipped sensors.

**Exchanged.** A table has the log likelihoods of each of k streams on each of k segments; the assignment with the
highest sum (Kuhn and Munkres) shows an exchange. The prior favours the stated segments, because forearm and upper arm
of one side turn so similarly that each fits the other. With a skeleton, each of two exchanged sensors turns with the
other's bone: the difference of the sensors' turning rates has the correlation rho with the opposite difference of their
bones' rates, over n' independent samples. Limbs that move alike (a squat) give no difference, and cannot be
distinguished this way. The logarithm of the likelihood ratio is

    - n' / 2 log(1 - rho^2),  with the sign of rho                                                                  (13)

and needs neither alignment nor heading. In a pose, an orientation's deviation from the expected one is normal; its
variance is the sum of those of pose and mounting. If each sensor has an unknown heading, only the inclination counts.

**Slipped.** The residual between a segment's direction by a camera or a joint and by its sensor exceeds the noise for
seconds. The median over a window rejects outliers; its standard deviation is that of the camera's persistent errors.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from body_tracking.calibration.clock_correlation import STEP, Series
from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.inertial.alignment import MOUNTING_STDDEV, yaw
from body_tracking.inertial.clock import LEAST_OVERLAP, LEAST_RATE, independent_samples

SEGMENT_STDDEV: Final = float(np.radians(8.0))
"""Radians per axis: standard deviation of a person's segment from a pose."""
SURE: Final = 5.0
"""Log likelihood ratio in favour of each sensor's stated segment."""
SLIP_TURN: Final = float(np.radians(10.0))
"""Least turn of a slip, radians: soft tissue moves by less."""
SLIP_TIME: Final = 6.0
"""Seconds over which a slip must last."""
SLIP_SURE: Final = 3.0
"""Standard deviations that a slip must exceed; the heading filter removes part of a slip meanwhile."""
LASTING: Final = 1.0
"""Seconds for which the errors of the reference persist."""
_LEAST_SAMPLES = 20
_HEADINGS = 72
"""Number of headings on the grid of a search."""


def assign(stated: Sequence[str], likelihood: FloatArray) -> tuple[str, ...]:
    """The best assignment of streams to segments.

    Args:
        stated: k segments of the streams.
        likelihood: (k, k) logarithms: of stream i being on segment j; 0 where nothing is known.

    Returns:
        For each stream the segment on which it most probably is; those stated where the evidence is too weak.
    """
    _, columns = linear_sum_assignment(likelihood + SURE * np.eye(len(stated)), maximize=True)
    return tuple(stated[column] for column in columns.tolist())


def likelihood_by_motion(sensors: Sequence[Series], bones: Sequence[Series | None]) -> FloatArray:
    """(k, k) log likelihood ratios by how fast sensors and bones turn, in one clock (eq. 13).

    Args:
        sensors: k streams.
        bones: of the k segments, in the same order, by a camera; None for an unseen one, whose ratios are 0.

    Returns:
        Of stream i being on segment j, and stream j on i, against both being where they are stated; 0 on the diagonal.
    """
    count = len(sensors)
    result = np.zeros((count, count))
    for i, j in combinations(range(count), 2):
        result[i, j] = result[j, i] = _exchanged(sensors[i], sensors[j], bones[i], bones[j])
    return result


def _exchanged(one: Series, other: Series, bone: Series | None, other_bone: Series | None) -> float:
    """Log likelihood ratio of two sensors being exchanged; 0 where too little is seen."""
    if bone is None or other_bone is None:
        return 0.0
    series = (one, other, bone, other_bone)
    if any(not len(each.stamps) for each in series):
        return 0.0
    begin, end = max(each.stamps[0] for each in series), min(each.stamps[-1] for each in series)
    if end - begin < LEAST_OVERLAP:
        return 0.0
    times = np.arange(begin, end, STEP)
    rates, known = zip(*(each.at(times) for each in series), strict=True)
    all_known = np.logical_and.reduce(known)
    worn, seen = rates[0][:, 0] - rates[1][:, 0], rates[3][:, 0] - rates[2][:, 0]
    if all_known.sum() * STEP < LEAST_OVERLAP or min(worn[all_known].std(), seen[all_known].std()) < LEAST_RATE:
        return 0.0
    rho = float(np.clip(np.corrcoef(worn[all_known], seen[all_known])[0, 1], -0.99, 0.99))
    return float(np.copysign(-0.5 * independent_samples(worn, seen, all_known) * np.log1p(-(rho**2)), rho))


def likelihood_by_pose(
    segments: Sequence[str],
    measured: FloatArray,
    pose: FloatArray,
    mountings: FloatArray,
    *,
    common_heading: bool,
) -> FloatArray:
    """(k, k) log likelihoods of stream i on segment j, by a pose.

    Args:
        segments: k names.
        measured: (k, 3, 3) sensor to earth, the mean over the pose.
        pose: (k, 3, 3) the segments of a person who faces x.
        mountings: (k, 3, 3) segment to sensor on each segment, as intended.
        common_heading: all headings are equal (magnetometers), and are searched on a grid. Otherwise each sensor has a
            heading of its own, and only the inclination of its axes counts.
    """
    variance = np.full(len(segments), MOUNTING_STDDEV**2 + SEGMENT_STDDEV**2)
    if not common_heading:
        # the vertical in the sensor's frame, measured and intended: two directions of error
        up, meant = measured[:, 2], (mountings @ pose[:, 2][..., None])[..., 0]
        off = np.arccos(np.clip(up @ meant.T, -1.0, 1.0))
        steep: FloatArray = -0.5 * off**2 / variance - np.log(variance)
        return steep
    tables = []
    for psi in np.linspace(-np.pi, np.pi, _HEADINGS, endpoint=False):
        expected = yaw(psi).T @ pose @ mountings.swapaxes(-1, -2)
        off = so3.rotation_vectors(measured[:, None].swapaxes(-1, -2) @ expected)
        tables.append(-0.5 * (off**2).sum(axis=-1) / variance - 1.5 * np.log(variance))
    # the prior keeps the stated assignment where another fits as well at another heading: two forearms in a T-pose,
    # exchanged, fit half a turn away

    def value(table: FloatArray) -> float:
        likely = table + SURE * np.eye(len(segments))
        return float(likely[linear_sum_assignment(likely, maximize=True)].sum())

    best = max(tables, key=value)
    return np.asarray(best)


class SlipDetector:
    """Monitors the residual between a segment's observed orientation and its sensor's, over a window of seconds."""

    def __init__(self, window: float = SLIP_TIME) -> None:
        self._window = window
        self._recent: deque[tuple[float, FloatArray, float]] = deque()

    def update(self, stamp: float, turn: FloatArray, stddev: float) -> FloatArray | None:
        """Take one residual.

        Args:
            stamp: seconds, ascending; a jump backwards restarts the detector.
            turn: (3,) radians in the segment's frame, such as ``Innovation.turn``; ignored where it is not finite.
            stddev: radians per direction, of noise, alignment and heading together.

        Returns:
            (3,) radians, the rotation vector in the segment's frame from the sensor's orientation to the observed one,
            once the sensor has slipped; then the detector restarts.
        """
        if self._recent and stamp < self._recent[-1][0]:
            self._recent.clear()
        if np.isfinite(turn).all():
            self._recent.append((stamp, turn, stddev))
        while self._recent and self._recent[0][0] < stamp - self._window:
            self._recent.popleft()
        if len(self._recent) < _LEAST_SAMPLES or stamp - self._recent[0][0] < 0.75 * self._window:
            return None
        middle = np.median([turn for _, turn, _ in self._recent], axis=0)
        # independent samples in the window; the median needs pi / 2 as many as the mean (Kendall and Stuart)
        independent = max(self._window / (2.0 * LASTING), 1.0)
        off = float(np.median([stddev for *_, stddev in self._recent])) * np.sqrt(0.5 * np.pi / independent)
        size = float(np.linalg.norm(middle))
        if size < max(SLIP_TURN, SLIP_SURE * off):
            return None
        self._recent.clear()
        return np.asarray(middle)
