"""A robot arm with three red balls tracked by a colour-and-depth camera (Schlagenhauf 2017, section 4.1.1).

The robot states the balls' positions in its own frame. Delay and rigid registration (eq. 4.1) are fitted on the first
trial and applied to the others, whose errors are therefore independent of the fit.
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
"""Order of the balls in the robot's messages."""
_PAIRS: Final = tuple(combinations(range(len(BALLS)), 2))
_UNLIKE: Final = 0.1
"""Largest difference between measured and true ball distances, metres: the end effector moves during the delay."""
_CLEAR: Final = 0.05
"""Least difference between the distance errors of the best and second best order, metres."""
_LEAST: Final = 30
"""Least number of images for the registration."""
_ORDERS: Final = np.array(list(permutations(range(len(BALLS)))))
_RATE: Final = 30.0
"""Hz: rate at which trials are compared with their mean."""
_MAX_GAP: Final = 0.1
"""Longest time between positions for interpolation, seconds."""
_MOVED: Final = 0.01
"""Metres from its initial position at which the end effector counts as moving."""
_SAME: Final = 0.005
"""Largest root mean square difference between two trials of one motion, metres."""


class ArmError(BodyTrackingError):
    """Raised for trials of a robot arm that cannot be compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One execution of the motion.

    Attributes:
        name: of the trial.
        times: (n,) s, capture times by the camera's clock.
        positions: (n, 3, 3) metres, the balls in the camera's frame; in the order of :data:`BALLS` after
            :func:`by_distances` or :func:`by_places`, before in any order.
        images: number of image pairs, of which n show three balls.
        true_times: (m,) s, by the robot's clock.
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
        """The robot's motion; time counts from :attr:`zero`."""
        return Curve(self.true_times - self.zero, self.true_positions)

    @property
    def zero(self) -> float:
        """The robot's first time, at which the curves' time is zero."""
        return float(self.true_times[0])

    @property
    def tracked(self) -> Trajectory:
        """The camera's measurement; time counts from :attr:`zero`."""
        return Trajectory(self.times - self.zero, self.positions)


@dataclass(frozen=True, slots=True, eq=False)
class ArmErrors:
    """One row of table 4.1 (Schlagenhauf 2017; figures 4.5-4.7, A.1-A.3), for the end effector, metres.

    Attributes:
        mae: (3,) mean absolute error along the robot's axes.
        largest: (3,) maximum absolute error.
        deviation: (3,) mean absolute deviation from the mean of all trials (figure 4.8).
        largest_deviation: (3,) maximum absolute deviation.
        delay: s by which the camera's stamps lag the robot's, from this trial alone; NaN if unobservable.
        times: (n,) s on the first trial's time axis, delay removed.
        found: (n, 3) tracked end effector in the robot's frame.
        true: (n, 3) the robot's end effector.
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
    """Result of a comparison of trials.

    Attributes:
        trials: all trials; the fit uses the first one.
        alignment: fitted to the first trial (eq. 4.1).
        errors: a row of table 4.1 for each trial.
    """

    trials: tuple[Trial, ...]
    alignment: Alignment
    errors: tuple[ArmErrors, ...]


def distances(balls: FloatArray) -> FloatArray:
    """(..., 3) distances between balls (..., 3, 3), metres."""
    return np.stack([np.linalg.norm(balls[..., i, :] - balls[..., j, :], axis=-1) for i, j in _PAIRS], axis=-1)


def by_distances(trial: Trial) -> Trial:
    """A trial with its balls in the robot's order, from their mutual distances; needs no delay or registration.

    Images whose distances differ from the robot's, or fit two orders, are left out.

    Raises:
        ArmError: too few images remain.
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
    """A trial with its balls in the order nearest to the robot's, after delay and registration."""
    true = trial.truth.at(trial.tracked.times - alignment.delay)
    placed = alignment.apply(trial.tracked).positions
    off = np.square(placed[:, _ORDERS] - true[:, None]).sum(axis=(-2, -1))
    known = np.isfinite(off).all(axis=1)
    return _ordered(trial, np.argmin(np.where(known[:, None], off, 0.0), axis=1), known)


def _ordered(trial: Trial, order: IntArray, kept: BoolArray) -> Trial:
    """The kept images (n,), each with its balls in the chosen order."""
    positions = trial.positions[np.arange(len(order))[:, None], _ORDERS[order]]
    return replace(trial, times=trial.times[kept], positions=positions[kept])


def compare(trials: Sequence[Trial]) -> ArmResult:
    """Fit delay and registration on the first trial, and compute the errors of all trials (table 4.1).

    Raises:
        ArmError: a single trial, an arm that hardly moves, or trials of other motions.
        MetricsError: all points are collinear.
    """
    if len(trials) < 2:
        raise ArmError("one trial alone: the registration is fitted on the first, and others are judged by it")
    first = by_distances(trials[0])
    delay = find_delay(first.tracked, first.truth)
    if np.isnan(delay):
        raise ArmError(
            f"{first.name}: delay of the camera is unknown; it is over 0.5 s, or the arm moves too little or for "
            "less than 2 s"
        )
    alignment = align(first.tracked, first.truth, delay)
    # with the alignment, images whose distances fit two orders are usable, too
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
    """Seconds by which the motion begins later in a trial than in the first trial.

    Raises:
        ArmError: the robot's motions differ.
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
    """For each trial (k, 3) metres: absolute deviations of the end effector from the mean of all trials.

    Interpolates the difference to the robot's motion, because trials sample the motion at different times.
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
