"""A robot arm with three red balls that a colour-and-depth camera tracks (Schlagenhauf 2017, section 4.1.1).

The robot states where the balls are in its own frame. Delay and rigid registration (eq. 4.1) are fitted on the first
trial and applied to the others, so that the errors of these are of data that nothing was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.evaluation.metrics import Alignment, Curve, Trajectory, align, find_delay, grid

BALLS: Final = ("base", "elbow", "end effector")
"""In the order in which the robot states them."""
_PAIRS: Final = tuple(combinations(range(len(BALLS)), 2))
_UNLIKE: Final = 0.1
"""Metres by which a distance between balls may differ from the robot's: a delay moves the end effector meanwhile."""
_CLEAR: Final = 0.05
"""Metres by which the distances fit the second best order worse than the best one."""
_LEAST: Final = 30
"""Images for the registration."""
_ORDERS: Final = np.array(list(permutations(range(len(BALLS)))))
_RATE: Final = 30.0
"""Hz at which trials are compared with their mean."""
_MAX_GAP: Final = 0.1
"""Seconds between positions from which on nothing is known in between."""
_MOVED: Final = 0.01
"""Metres from its first place from which on the end effector has begun to move."""
_SAME: Final = 0.005
"""Root mean square difference, metres, up to which two trials are of one motion."""


class ArmError(BodyTrackingError):
    """Trials of a robot arm that cannot be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One execution of the motion.

    Attributes:
        name: of the trial.
        times: (n,) s, capture times by the camera.
        positions: (n, 3, 3) metres, the balls in the camera's frame; in the order of :data:`BALLS` after
            :func:`by_distances` or :func:`by_places`, in any order before.
        images: number of pairs of images, n of which show three balls.
        true_times: (m,) s, by the robot.
        true_positions: (m, 3, 3) metres, the balls in the robot's frame.
    """

    name: str
    times: FloatArray
    positions: FloatArray
    images: int
    true_times: FloatArray
    true_positions: FloatArray

    @property
    def truth(self) -> Curve:
        """The robot's motion, relative to the first time."""
        return Curve(self.true_times - self.zero, self.true_positions)

    @property
    def zero(self) -> float:
        """The first time of the robot, to which seconds of curves count."""
        return float(self.true_times[0])

    @property
    def tracked(self) -> Trajectory:
        """The camera's measurement, likewise."""
        return Trajectory(self.times - self.zero, self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class ArmErrors:
    """One row of table 4.1 (Schlagenhauf 2017; figures 4.5-4.7, A.1-A.3), of the end effector, metres.

    Attributes:
        mae: (3,) mean absolute error along the robot's axes.
        largest: (3,) maximum absolute error.
        deviation: (3,) mean absolute deviation from the mean of all trials (figure 4.8).
        largest_deviation: (3,) maximum absolute deviation.
        delay: s by which the camera's stamps follow the robot's, by this trial alone; NaN where it cannot be told.
        times: (n,) s of the first trial's record, delay removed.
        found: (n, 3) the tracked end effector in the robot's frame.
        true: (n, 3) the robot's.
    """

    mae: FloatArray
    largest: FloatArray
    deviation: FloatArray
    largest_deviation: FloatArray
    delay: float
    times: FloatArray
    found: FloatArray
    true: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ArmResult:
    """What the comparison of trials gives.

    Attributes:
        trials: all of them; the first one is that of the fit.
        alignment: fitted to the first one (eq. 4.1).
        errors: a row of table 4.1 for each trial.
    """

    trials: tuple[Trial, ...]
    alignment: Alignment
    errors: tuple[ArmErrors, ...]


def distances(balls: FloatArray) -> FloatArray:
    """(..., 3) metres between balls (..., 3, 3)."""
    return np.stack([np.linalg.norm(balls[..., i, :] - balls[..., j, :], axis=-1) for i, j in _PAIRS], axis=-1)


def by_distances(trial: Trial) -> Trial:
    """A trial's balls in the robot's order, by their distances from each other, without delay and registration.

    Left out are images in which they have other distances than the robot's, or fit two orders.

    Raises:
        ArmError: hardly any image is left.
    """
    true = distances(trial.true_positions)
    wanted = np.column_stack([np.interp(trial.times, trial.true_times, column) for column in true.T])
    off = np.abs(distances(trial.positions[:, _ORDERS]) - wanted[:, None]).max(axis=-1)
    first, second, *_ = np.sort(off, axis=1).T
    clear = (first < _UNLIKE) & (second > first + _CLEAR)
    if np.count_nonzero(clear) < _LEAST:
        raise ArmError(
            f"{trial.name}: {np.count_nonzero(clear)} of {len(clear)} images show the balls at the distances of the "
            f"robot's, and in one order only; are they in the order {', '.join(BALLS)}, and the links of two lengths?"
        )
    return _ordered(trial, np.argmin(off, axis=1), clear)


def by_places(trial: Trial, alignment: Alignment) -> Trial:
    """A trial's balls in the order in which they are nearest to the robot's, by delay and registration."""
    true = trial.truth.at(trial.tracked.times - alignment.delay)
    placed = alignment.apply(trial.tracked).positions
    off = np.square(placed[:, _ORDERS] - true[:, None]).sum(axis=(-2, -1))
    known = np.isfinite(off).all(axis=1)
    return _ordered(trial, np.argmin(np.where(known[:, None], off, 0.0), axis=1), known)


def _ordered(trial: Trial, order: IntArray, kept: BoolArray) -> Trial:
    """The kept images (n,), each with its balls in one of the orders."""
    positions = trial.positions[np.arange(len(order))[:, None], _ORDERS[order]]
    return replace(trial, times=trial.times[kept], positions=positions[kept])


def compare(trials: Sequence[Trial]) -> ArmResult:
    """Fit delay and registration on the first trial, and report the errors of all (table 4.1).

    Raises:
        ArmError: one trial alone, an arm that hardly moves, or trials of other motions.
        MetricsError: all points on one line.
    """
    if len(trials) < 2:
        raise ArmError("one trial alone: the registration is fitted on the first, and others are judged by it")
    first = by_distances(trials[0])
    delay = find_delay(first.tracked, first.truth)
    if np.isnan(delay):
        raise ArmError(
            f"{first.name}: delay of the camera cannot be told; it is over 0.5 s, or the arm moves too little or for "
            "less than 2 s"
        )
    alignment = align(first.tracked, first.truth, delay)
    # with them the images are of use, too, whose distances fit two orders
    first = by_places(trials[0], alignment)
    alignment = align(first.tracked, first.truth, find_delay(first.tracked, first.truth))
    trials = [first, *(by_places(trial, alignment) for trial in trials[1:])]
    placed = [alignment.apply(trial.tracked) for trial in trials]
    shifts = [_shift(trial, first) for trial in trials]
    deviations = _deviations(trials, placed, shifts)
    rows = []
    for trial, at, deviation, shift in zip(trials, placed, deviations, shifts, strict=True):
        true = trial.truth.at(at.times)[:, -1]
        found = at.positions[:, -1]
        error = np.abs(found - true)
        rows.append(
            ArmErrors(
                np.nanmean(error, axis=0),
                np.nanmax(error, axis=0),
                np.nanmean(deviation, axis=0),
                np.nanmax(deviation, axis=0),
                find_delay(trial.tracked, trial.truth),
                at.times - shift,
                found,
                true,
            )
        )
    return ArmResult(tuple(trials), alignment, tuple(rows))


def _shift(trial: Trial, first: Trial) -> float:
    """Seconds by which the motion begins later in a trial's record than in the first one's.

    Raises:
        ArmError: the robot did not move likewise.
    """
    begins = []
    for each in (trial, first):
        far = np.linalg.norm(each.true_positions[:, -1] - each.true_positions[0, -1], axis=1) > _MOVED
        if not far.any():
            raise ArmError(f"{each.name}: the robot's end effector stands still")
        begins.append(float(each.true_times[np.argmax(far)] - each.zero))
    around = begins[0] - begins[1]
    if trial is first:
        return 0.0
    own = Trajectory(trial.true_times - trial.zero, trial.true_positions)
    shift = find_delay(own, first.truth, around=around)
    if not np.isnan(shift):
        apart = first.truth.at(own.times - shift)[:, -1] - own.positions[:, -1]
        if np.sqrt(np.nanmean((apart**2).sum(axis=1))) < _SAME:
            return shift
    raise ArmError(f"{trial.name}: the robot does not make the motion of {first.name}")


def _deviations(trials: Sequence[Trial], placed: Sequence[Trajectory], shifts: Sequence[float]) -> list[FloatArray]:
    """For each trial (k, 3) metres, the absolute deviations of the end effector from the mean of all trials.

    Trials are interpolated about the robot's motion, as they are sampled at other times of it.
    """
    first = max(float(each.times[0]) - shift for each, shift in zip(placed, shifts, strict=True))
    last = min(float(each.times[-1]) - shift for each, shift in zip(placed, shifts, strict=True))
    if not last > first:
        raise ArmError("the trials have no part of the motion in common")
    times = grid(first, last, _RATE)
    positions = []
    for trial, each, shift in zip(trials, placed, shifts, strict=True):
        errors = Trajectory(each.times, each.positions[:, -1:] - trial.truth.at(each.times)[:, -1:])
        positions.append(errors.at(times + shift, _MAX_GAP).positions[:, 0] + trial.truth.at(times + shift)[:, -1])
    return list(np.abs(np.array(positions) - np.mean(positions, axis=0)))
