"""Which sensor is where it should not be: exchanged with another one, or slipped.

**Exchanged.** How well each of k streams goes with each of k segments is a table of log likelihoods; the assignment
with the highest sum (Kuhn and Munkres) tells of an exchange, where being where it is said to be is worth something of
its own to each sensor: forearm and upper arm of one side turn so much alike that either fits the other. From a
skeleton: of the rate at which a bone turns, the correlation rho with that of the sensor's over n' independent samples
is worth

    - n' / 2 log(1 - rho^2),  0 for rho < 0                                                                         (13)

and needs neither alignment nor heading. From a pose: how far the orientation is from how the sensor was meant to be put
on, normal with the deviations of both. Sensors that each have a heading of their own only show how steep they are.

**Slipped.** What a camera, or a joint, sees of a segment stays beside what the sensor says by more than noise and over
seconds: the median over a window is free of outliers, and its deviation that of the camera's lasting errors.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from body_tracking.calibration.clock_correlation import STEP, Series
from body_tracking.core.skeleton import FloatArray
from body_tracking.inertial.alignment import (
    MOUNTING_STDDEV,
    AlignmentError,
    rotation_vectors,
    yaw,
)
from body_tracking.inertial.clock import LEAST_OVERLAP, LEAST_RATE, independent_samples

SEGMENT_STDDEV: Final = float(np.radians(8.0))
"""Radians per axis by which a person's segment is off a pose."""
SURE: Final = 5.0
"""Logarithm of the likelihood ratio from which a sensor is somewhere else than is said."""
SLIP_TURN: Final = float(np.radians(10.0))
"""Radians from which a slip is one: below, the flesh gives as much."""
SLIP_TIME: Final = 6.0
"""Seconds over which it must last."""
SLIP_SURE: Final = 3.0
"""Standard deviations by which it must stand out; a filter that follows the slip takes some of it away meanwhile."""
LASTING: Final = 1.0
"""Seconds that the errors of what it is compared with last."""
_LEAST_SAMPLES = 20


@dataclass(frozen=True, slots=True)
class Assignment:
    """Which stream belongs to which segment.

    Attributes:
        segments: for each stream the segment that fits best, of those stated.
        exchanged: those that are not the stated ones, as (stated, found); empty where nothing is sure.
        advantage: logarithm of the likelihood ratio of the best assignment against the stated one.
    """

    segments: tuple[str, ...]
    exchanged: tuple[tuple[str, str], ...]
    advantage: float


def assign(stated: Sequence[str], likelihood: FloatArray) -> Assignment:
    """The best assignment of streams to segments.

    Args:
        stated: k segments, where the streams are said to be.
        likelihood: (k, k) logarithms: of stream i being on segment j; 0 where nothing is known.

    Raises:
        AlignmentError: a table of another shape, or with NaN.
    """
    k = len(stated)
    if likelihood.shape != (k, k) or not np.isfinite(likelihood).all():
        raise AlignmentError(f"assignment of {k} sensors: table of shape {likelihood.shape}, expected finite numbers")
    _, columns = linear_sum_assignment(likelihood + SURE * np.eye(k), maximize=True)
    found = tuple(stated[column] for column in columns.tolist())
    exchanged = tuple((said, is_) for said, is_ in zip(stated, found, strict=True) if said != is_)
    return Assignment(found, exchanged, float(likelihood[np.arange(k), columns].sum() - likelihood.trace()))


def likelihood_by_motion(sensors: Sequence[Series], bones: Sequence[Series | None]) -> FloatArray:
    """(k, k) log likelihoods by how fast sensors and bones turn, in one clock (eq. 13).

    Args:
        sensors: k streams.
        bones: of the k segments as a camera sees them; None of one that it does not see, of which nothing is known.
    """
    result = np.zeros((len(sensors), len(bones)))
    seen = [(j, bone) for j, bone in enumerate(bones) if bone is not None and len(bone.stamps)]
    for i, sensor in enumerate(sensors):
        if not len(sensor.stamps):
            continue
        for j, bone in seen:
            begin, end = max(sensor.stamps[0], bone.stamps[0]), min(sensor.stamps[-1], bone.stamps[-1])
            if end - begin < LEAST_OVERLAP:
                continue
            times = np.arange(begin, end, STEP)
            (a, known_a), (b, known_b) = sensor.at(times), bone.at(times)
            a, b, both = a[:, 0], b[:, 0], known_a & known_b
            if both.sum() * STEP < LEAST_OVERLAP or min(float(a[both].std()), float(b[both].std())) < LEAST_RATE:
                continue
            rho = float(np.clip(np.corrcoef(a[both], b[both])[0, 1], 0.0, 0.99))
            result[i, j] = -0.5 * independent_samples(a, b, both) * np.log1p(-(rho**2))
    return result


def likelihood_by_pose(
    segments: Sequence[str],
    measured: FloatArray,
    pose: FloatArray,
    mountings: FloatArray,
    *,
    common_heading: bool,
    stddev: float = MOUNTING_STDDEV,
    steps: int = 72,
) -> FloatArray:
    """(k, k) log likelihoods of stream i on segment j, by a pose.

    Args:
        segments: k names.
        measured: (k, 3, 3) sensor to earth, the mean over the pose.
        pose: (k, 3, 3) the segments of somebody who faces x.
        mountings: (k, 3, 3) segment to sensor on each segment, as meant.
        common_heading: all earths face the same way (magnetometers); which way is tried in steps. Otherwise each sensor
            has a heading of its own, and only how steep its axes are counts.
        stddev: radians per axis by which sensors are off how they are meant to be put on.
        steps: how many headings are tried.
    """
    variance = np.full(len(segments), stddev**2 + SEGMENT_STDDEV**2)
    if not common_heading:
        # the direction of up in the sensor, as it is and as it should be: two directions of error
        up, meant = measured[:, 2], (mountings @ pose[:, 2][..., None])[..., 0]
        off = np.arccos(np.clip(up @ meant.T, -1.0, 1.0))
        steep: FloatArray = -0.5 * off**2 / variance - np.log(variance)
        return steep
    tables = []
    for psi in np.linspace(-np.pi, np.pi, steps, endpoint=False):
        expected = yaw(psi).T @ pose @ mountings.swapaxes(-1, -2)
        off = rotation_vectors(measured[:, None].swapaxes(-1, -2) @ expected)
        tables.append(-0.5 * (off**2).sum(axis=-1) / variance - 1.5 * np.log(variance))
    best = max(tables, key=lambda table: float(table[linear_sum_assignment(table, maximize=True)].sum()))
    return np.asarray(best)


@dataclass(frozen=True, slots=True, eq=False)
class SlipFound:
    """A sensor is not turned on its segment as it was.

    Attributes:
        segment: that carries it.
        stamp: seconds, when it was noticed.
        turn: (3,) radians, rotation vector in the segment's frame of what is seen against what the sensor says.
        stddev: radians, of its size.
    """

    segment: str
    stamp: float
    turn: FloatArray
    stddev: float


class SlipDetector:
    """Watches what is left between a segment as seen and as its sensor has it."""

    def __init__(self, segment: str, *, least: float = SLIP_TURN, window: float = SLIP_TIME) -> None:
        """Of a segment.

        Args:
            segment: name.
            least: radians from which a turn is a slip.
            window: seconds over which it must last.
        """
        self._segment, self._least, self._window = segment, least, window
        self._recent: deque[tuple[float, FloatArray, float]] = deque()

    def update(self, stamp: float, turn: FloatArray, stddev: float) -> SlipFound | None:
        """Take one comparison.

        Args:
            stamp: seconds, ascending; after a jump backwards it starts anew.
            turn: (3,) radians in the segment's frame, such as ``Innovation.turn``; ignored where it is not finite.
            stddev: radians per direction that it is off by noise and by what is known of alignment and heading.

        Returns:
            A slip, once; then it starts anew.
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
        if size < max(self._least, SLIP_SURE * off):
            return None
        self._recent.clear()
        return SlipFound(self._segment, stamp, middle, off)
