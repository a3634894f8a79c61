"""Errors of cameras: white noise, and systematic errors that persist for seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray, Joint
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.state import Measurement, SensorState, State, StateSpace

_DIMENSIONS = 3
_MEAN = np.full(_DIMENSIONS, 1.0 / _DIMENSIONS)
_FIRST_WHITE = 0.01
"""Metres: standard deviation of a sensor's white noise before it is learnt."""
_FLOOR = 1e-3
"""Metres: no sensor's white noise is taken for less."""
_MAX_SLOW = 9.0
"""Greatest scale of the slow variance: three times the model's deviation."""
_THIRD_DIFFERENCE_SPAN = 0.25
"""Seconds beyond which four frames in a row show motion, not noise."""
_CORRELATED = 2.31
"""Number of overlapping third differences per independent one."""
_NOISE_FRAMES = 600.0
"""Frames over which the white noise of a point is averaged."""
_POOL = 8.0
"""Frames from which on a point's own noise counts alone."""
_OUTLYING = 6.0
"""A squared difference counts as at most so many times the variance."""
STRETCH = 0.067
"""Share of the length of an upper arm or forearm that a sensor that states covariances is wrong by: a Kinect v2's vary
by 6.7 % (root mean square over clips of UI-PRMD)."""
_BESIDE_ORIENTATIONS = 3.0
"""Beside orientations the variance of slow errors is at least this share of what cameras state: what a camera is always
wrong by alike passes for a body of other proportions as long as nothing but cameras sees it."""
_ALONE = 0.1
"""Share of the parameter ``slow_scale`` for a sensor that no other one contradicts: with all of it the population's
segment lengths outweigh the person's in the first seconds, and elbows err by 10 instead of 6 degrees
(``benchmarks/kinect_vs_vicon.py``)."""
_LEAST_ERROR = 0.004
"""Metres: no sensor knows where the centre of a joint is better than this."""
_SIGNIFICANT = 2.0
"""Standard deviations above zero from which a scale of slow errors is used."""
_SLOW_PERIOD_NS = NANOSECONDS // 15
_SLOW_STEP = 0.02
"""Share by which a scale changes at least: each change requires a correction of the state."""
_SLOW_MEMORY = 0.7
"""Seconds over which the scale of the slow errors is averaged."""


class SensorErrors:
    """Learns what sensors err by, and says what that does to their points.

    Args:
        space: of the states.
        parameters: of the filter.

    Attributes:
        carried: (19, 4) which points hang on each limb.
        slow_size: how many slow errors a sensor has (61): three of each point, and one of each limb.
    """

    def __init__(self, space: StateSpace, parameters: EkfParameters) -> None:
        self._space, self._model, self._parameters = space, space.model, parameters
        self._limbs = tuple(f"{part}_{side}" for part in ("upper_arm", "forearm") for side in ("left", "right"))
        self.carried = self._limb_table()
        self.slow_size = 3 * space.points + len(self._limbs)

    def unknown(self, measurement: Measurement, alone: bool = False) -> SensorState:
        """What is taken of a sensor before it is known; slow errors of one that states how much it errs.

        Args:
            measurement: its first one.
            alone: there is no other sensor.
        """
        space = self._space
        p = self._parameters
        stated = measurement.skeleton.covariances is not None
        points = _ALONE * p.slow_scale if alone else p.slow_scale
        slow = points if stated else 0.0
        white = np.full(space.points, _FIRST_WHITE**2)
        return SensorState(
            (),
            np.empty((0, space.points, 3)),
            white,
            np.zeros(space.points),
            np.zeros(space.points),
            slow,
            slow,
            4.0,
            stated,
        )

    def seen_by(self, sensor: SensorState, measurement: Measurement, used: BoolArray) -> SensorState:
        """The variance of the white noise, from the third differences of the points that passed the gate."""
        points = np.where(used[:, None], measurement.positions, np.nan)
        stamps, frames = sensor.stamps, sensor.positions
        if len(stamps) == 3 and (measurement.stamp_ns - stamps[0]) / NANOSECONDS < _THIRD_DIFFERENCE_SPAN:
            factors = _third_difference((*stamps, measurement.stamp_ns))
            difference = (factors[:3] @ frames.reshape(3, -1)).reshape(-1, 3) + factors[3] * points
            squared = (difference * difference) @ _MEAN
            known = squared >= 0.0  # not NaN
            if known.any():
                sensor = self._white_learnt(sensor, squared, known)
        frames = np.concatenate([frames[-2:], points[None]])
        return sensor.but(stamps=(*stamps[-2:], measurement.stamp_ns), positions=frames)

    def _white_learnt(self, sensor: SensorState, squared: FloatArray, known: BoolArray) -> SensorState:
        """The sensor's noise with one more squared difference (19,) of the known points."""
        weight, differences = sensor.weight, sensor.differences
        early = float(weight.min()) < 2.0 * _POOL
        bound = differences
        if early:
            # what all points say together keeps one that was not seen yet from any value
            bound = np.maximum(bound, _typical(squared[known], 1.0))
        kept = np.minimum(weight, _NOISE_FRAMES)
        differences = np.where(
            known, (kept * differences + np.minimum(squared, _OUTLYING * bound)) / (kept + 1.0), differences
        )
        weight = np.where(known, kept + 1.0, weight)
        white = differences
        if early:
            seen = weight > 0.0
            share = np.maximum(1.0 - weight / (2.0 * _POOL), 0.0)
            white = differences + share * (_typical(differences[seen], float(np.median(weight[seen]))) - differences)
        return sensor.but(white=np.maximum(white, _FLOOR**2), differences=differences, weight=weight)

    def slow_learnt(
        self,
        sensor: SensorState,
        measurement: Measurement,
        whitening: FloatArray,
        white: FloatArray,
        rows: IntArray,
        oriented: bool,
    ) -> tuple[float, float, float]:
        """One step of maximum likelihood (Fisher scoring) for the scale of the slow variance of points.

        Returns:
            The scale to be used, its estimate and the information of this.
        """
        least = self.least_slow(sensor.white, measurement)
        if oriented and measurement.skeleton.covariances is not None:
            least = max(least, _BESIDE_ORIENTATIONS)
        # It changes slowly, and takes a while to compute.
        soon = sensor.stamps and measurement.stamp_ns // _SLOW_PERIOD_NS == sensor.stamps[-1] // _SLOW_PERIOD_NS
        # What is white is not known at first, and would be taken for slow.
        if soon or sensor.weight.max() < 2.0 * _POOL:
            return _kept(sensor.slow, max(sensor.slow, least)), sensor.slow_estimate, sensor.slow_information
        half = whitening * np.sqrt(measurement.model_variance).repeat(3)[rows]
        gram = half.T @ half
        score = 0.5 * float(((white @ half) ** 2 - gram.diagonal()).sum())
        information = 0.5 * float((gram * gram).sum())
        passed = _SLOW_PERIOD_NS / NANOSECONDS
        total = sensor.slow_information * math.exp(-passed / _SLOW_MEMORY) + information
        # the mean of what each frame says, which may be less than nothing
        estimate = sensor.slow_estimate + (information * (sensor.slow - sensor.slow_estimate) + score) / total
        # an error is taken for real when it stands out: else every sensor would have a little of it
        real = estimate * math.sqrt(total) > _SIGNIFICANT
        return _kept(sensor.slow, max(min(estimate, _MAX_SLOW) if real else 0.0, least)), estimate, total

    def least_slow(self, white: FloatArray, measurement: Measurement) -> float:
        """Lower bound of the systematic error's scale: total expected error minus the measured white noise."""
        missing = self._space.points * _LEAST_ERROR**2 - float(white.sum())
        return max(missing, 0.0) / float(measurement.model_variance.sum())

    def slow_stddev(self, sensor: SensorState, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """(19,) metres, of the slow errors of points by themselves; (4,) of those of limbs, as a share of their length.

        The upper arms and forearms are too long or too short in some poses, with all that hangs on them: along a limb a
        depth sensor finds its joints by a tenth of the length nearer or farther.
        """
        stretch = STRETCH if sensor.stated else 0.0
        return math.sqrt(sensor.slow) * np.sqrt(measurement.model_variance), np.full(len(self._limbs), stretch)

    def place_of(self, state: State, sensor: str) -> int:
        """First column of a sensor's slow errors in ``State.crosses``."""
        return state.slow_names.index(sensor) * self.slow_size

    def point_stddev(self, measurement: Measurement, sensors: Mapping[str, SensorState]) -> FloatArray:
        """(19,) metres; infinity where not measured."""
        sensor = sensors.get(measurement.sensor) or self.unknown(measurement)
        return np.where(measurement.measured, np.sqrt(sensor.white + sensor.slow * measurement.model_variance), np.inf)

    def _limb_table(self) -> FloatArray:
        """(19, 4) which points each limb carries."""
        point = {Joint(joint): number for number, joint in enumerate(self._model.joints)}
        beyond = np.zeros((self._space.points, len(self._limbs)))
        chain = ("SHOULDER", "ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")
        for column, limb in enumerate(self._limbs):
            first = 0 if limb.startswith("upper_arm") else 1
            parts = [point[Joint[f"{name}_{limb.rsplit('_', 1)[1].upper()}"]] for name in chain]
            beyond[parts[first + 1 :], column] = 1.0
        return beyond


def _kept(before: float, after: float) -> float:
    """The new scale of slow errors, or the one before where they hardly differ."""
    return before if abs(before - after) <= _SLOW_STEP * after else after


def _typical(variances: FloatArray, weight: float) -> float:
    """What several variances say together, each the mean of so many squared third differences, some of outliers."""
    freedom = _DIMENSIONS * (1.0 + (weight - 1.0) / _CORRELATED)
    # Wilson and Hilferty 1931: the median of chi-square over its mean
    return float(np.median(variances)) / (1.0 - 2.0 / (9.0 * freedom)) ** 3


def _third_difference(stamps: Sequence[int]) -> FloatArray:
    """(4,) factors of the third divided difference at these nanoseconds; their squares sum up to 1."""
    b, c, d = ((stamp - stamps[0]) / NANOSECONDS for stamp in stamps[1:])
    factors = (
        -1.0 / (b * c * d),
        1.0 / (b * (b - c) * (b - d)),
        1.0 / (c * (c - b) * (c - d)),
        1.0 / (d * (d - b) * (d - c)),
    )
    return np.array(factors) / math.hypot(*factors)
