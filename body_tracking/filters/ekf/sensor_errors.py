"""Errors of cameras: white noise, and systematic errors that persist for seconds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from body_tracking.core.measurement import GIRDLE_CORRELATION, offset_correlation
from body_tracking.core.orientation import SEGMENT_NUMBER
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray, Joint
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.sources import Sources
from body_tracking.filters.ekf.state import Measurement, SensorState, State, StateSpace

_DIMENSIONS = 3
_EYE3 = np.eye(3)
_MEAN = np.full(_DIMENSIONS, 1.0 / _DIMENSIONS)
_FIRST_WHITE = 0.01
"""Metres: standard deviation of a sensor's white noise before it is learnt."""
_FLOOR = 1e-3
"""Metres: least standard deviation of a sensor's white noise."""
_MAX_SLOW = 9.0
"""Greatest scale of the slow variance: three times the model's deviation."""
_THIRD_DIFFERENCE_SPAN = 0.25
"""Seconds beyond which four frames in a row show motion, not noise."""
_CORRELATED = 2.31
"""Number of overlapping third differences per independent one."""
_NOISE_FRAMES = 600.0
"""Frames over which the white noise of a point is averaged."""
_POOL = 8.0
"""Half the number of frames from which on a point's noise is estimated from its own frames alone."""
_OUTLYING = 6.0
"""Bound of a squared difference, as a multiple of the variance."""
STRETCH = 0.067
"""Standard deviation of the length of an upper arm or forearm, as a share of it, by a sensor that states covariances:
6.7 % for a Kinect v2 (root mean square over clips of UI-PRMD)."""
_BESIDE_ORIENTATIONS = 3.0
"""With orientations, least variance of a camera's slow errors as a multiple of the variance that it states: without
them, its constant errors are explained by a body of other proportions."""
_SLOW_BONE_CORRELATION = 0.7
"""Correlation of the slow errors of the two joints of a limb's bone beside orientations, where that of the joints'
offsets is not smaller: only a part of the slow errors is due to offsets (docs/tried.md, "Sensors on one arm")."""
_ALONE = 0.1
"""Factor on the parameter ``slow_scale`` for a single sensor: without it, average segment lengths outweigh the person's
in the first seconds, and elbows err by 10 instead of 6 degrees (``benchmarks/kinect_vs_vicon.py``)."""
_LEAST_ERROR = 0.004
"""Metres: least standard deviation of a sensor's joint centres, white and slow errors together."""
_SIGNIFICANT = 2.0
"""Standard deviations above zero from which a scale of slow errors is used."""
_UPPER_TRUNK = SEGMENT_NUMBER["upper_trunk"]
_SLOW_PERIOD_NS = NANOSECONDS // 15
_SLOW_STEP = 0.02
"""Least relative change of a scale: each change requires a correction of the state."""
_LEAST_MEMORY = 30.0
"""Seconds in which the least variance that a sensor stated grows by the factor e, so that an old one is forgotten. A
distance changes more slowly than people turn. Four motions (:func:`_slow_parts`), mean of all angles: 9.1 degrees with
5 s, 8.7 with 30 and with 300."""
_SLOW_MEMORY = 0.7
"""Seconds over which the scale of the slow errors is averaged."""


class SensorErrors:
    """Estimates the errors of sensors, and gives the covariances of their points.

    Args:
        space: of the states.
        parameters: of the filter.

    Attributes:
        carried: (19, 4) which points each limb carries.
        slow_size: how many slow errors a sensor has (61): three of each point, and one of each limb.
    """

    def __init__(self, space: StateSpace, parameters: EkfParameters) -> None:
        self._space, self._model, self._parameters = space, space.model, parameters
        self._limbs = tuple(f"{part}_{side}" for part in ("upper_arm", "forearm") for side in ("left", "right"))
        self.carried = self._limb_table()
        joints = np.ix_(space.model.joints, space.model.joints)
        of_bones = min(_SLOW_BONE_CORRELATION, parameters.bone_correlation)
        self._of_limbs, self._of_limbs_and_girdles = (
            np.linalg.cholesky(offset_correlation(of_bones, of_girdles)[joints]).astype(np.float64)
            for of_girdles in (0.0, GIRDLE_CORRELATION)
        )
        self.slow_size = 3 * space.points + len(self._limbs)

    def unknown(self, measurement: Measurement, alone: bool = False) -> SensorState:
        """The initial errors of a sensor; slow errors only if it states covariances.

        Args:
            measurement: its first one.
            alone: whether there is no other sensor.
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
            math.inf,
            np.ones(space.points),
        )

    def seen_by(
        self, sensor: SensorState, measurement: Measurement, used: BoolArray, sensors: Mapping[str, SensorState]
    ) -> SensorState:
        """Update the white noise by the third differences of the points that passed the gate, and ``least_stated``.

        Args:
            sensor: its errors before.
            measurement: the frame.
            used: (19,) which points passed the gate.
            sensors: all that have been seen.
        """
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
        least = math.inf
        if sensors.keys() - {measurement.sensor}:
            passed = max(measurement.stamp_ns - stamps[-1], 0) / NANOSECONDS if stamps else 0.0
            least = min(_stated_ratio(measurement), sensor.least_stated * math.exp(passed / _LEAST_MEMORY))
        ratios = np.where(used, measurement.model_variance / self._space.base_variance, sensor.stated_ratios)
        return sensor.but(
            stamps=(*stamps[-2:], measurement.stamp_ns), positions=frames, least_stated=least, stated_ratios=ratios
        )

    def _white_learnt(self, sensor: SensorState, squared: FloatArray, known: BoolArray) -> SensorState:
        """The sensor's noise with one more squared difference (19,) of the known points."""
        weight, differences = sensor.weight, sensor.differences
        early = float(weight.min()) < 2.0 * _POOL
        bound = differences
        if early:
            # bound a point without an estimate of its own by the typical value of all points
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
        sources: Sources,
    ) -> tuple[float, float, float]:
        """One step of maximum likelihood (Fisher scoring) for the scale of the slow variance of points.

        Returns:
            The scale to be used, its estimate, and the information of the estimate.
        """
        least = self.least_slow(sensor.white, measurement)
        if sources.names and measurement.skeleton.covariances is not None:
            least = max(least, _BESIDE_ORIENTATIONS)
        # The scale changes slowly, and its computation is expensive: 15 times a second are enough.
        soon = sensor.stamps and measurement.stamp_ns // _SLOW_PERIOD_NS == sensor.stamps[-1] // _SLOW_PERIOD_NS
        # White noise would be taken for slow errors before its variance is known.
        if soon or sensor.weight.max() < 2.0 * _POOL:
            return _kept(sensor.slow, max(sensor.slow, least)), sensor.slow_estimate, sensor.slow_information
        scaled, _ = _slow_parts(sensor, measurement)
        half = whitening * np.sqrt(scaled).repeat(3)[rows]
        correlated = self._correlated(sources)
        if correlated is not None:
            half = half @ np.kron(correlated, _EYE3)[rows]
        gram = half.T @ half
        score = 0.5 * float(((white @ half) ** 2 - gram.diagonal()).sum())
        information = 0.5 * float((gram * gram).sum())
        passed = _SLOW_PERIOD_NS / NANOSECONDS
        total = sensor.slow_information * math.exp(-passed / _SLOW_MEMORY) + information
        # mean of the frames' estimates, weighted by their information; it may be negative
        estimate = sensor.slow_estimate + (information * (sensor.slow - sensor.slow_estimate) + score) / total
        # use only a significant scale: otherwise every sensor would have small slow errors
        real = estimate * math.sqrt(total) > _SIGNIFICANT
        return _kept(sensor.slow, max(min(estimate, _MAX_SLOW) if real else 0.0, least)), estimate, total

    def least_slow(self, white: FloatArray, measurement: Measurement) -> float:
        """Lower bound of the systematic error's scale: total expected error minus the measured white noise."""
        missing = self._space.points * _LEAST_ERROR**2 - float(white.sum())
        return max(missing, 0.0) / float(measurement.model_variance.sum())

    def slow_errors(
        self, sensor: SensorState, measurement: Measurement, sources: Sources
    ) -> tuple[FloatArray, FloatArray]:
        """The slow errors of a sensor's points by independent ones of unit variance.

        In some poses a depth sensor measures upper arms and forearms a tenth too long or too short, and displaces all
        points beyond.

        Args:
            sensor: its errors.
            measurement: the frame.
            sources: of orientations.

        Returns:
            (19, 19) metres, lower triangular: the points' own errors; (4,) the limbs', as a share of their length.
        """
        stddev = np.sqrt(self.slow_variance(sensor, measurement))
        stretch = STRETCH if sensor.stated else 0.0
        correlated = self._correlated(sources)
        own = np.diag(stddev) if correlated is None else stddev[:, None] * correlated
        return own, np.full(len(self._limbs), stretch)

    @staticmethod
    def slow_variance(sensor: SensorState, measurement: Measurement) -> FloatArray:
        """(19,) square metres per axis of a sensor's slow errors; arguments as in :meth:`slow_errors`."""
        scaled, rest = _slow_parts(sensor, measurement)
        return sensor.slow * scaled + rest

    def _correlated(self, sources: Sources) -> FloatArray | None:
        """(19, 19) Cholesky factor of the correlation of the points' slow errors; None if they are independent.

        Beside orientations slow errors are large (``_BESIDE_ORIENTATIONS``). Independent ones would hide the directions
        of arms, and, where no sensor on the trunk measures it, how a person twists (20 instead of 11 degrees off in a
        recording with sensors on one arm). With cameras alone real arms err by 5.1 instead of 4.8, and 6.5 instead of
        5.9, degrees with correlated ones (``benchmarks/kinect_vs_vicon.py``).
        """
        if not sources.names:
            return None
        return self._of_limbs_and_girdles if (sources.segments > _UPPER_TRUNK).all() else self._of_limbs

    def place_of(self, state: State, sensor: str) -> int:
        """First column of a sensor's slow errors in ``State.crosses``."""
        return state.slow_names.index(sensor) * self.slow_size

    def point_stddev(self, measurement: Measurement, sensors: Mapping[str, SensorState]) -> FloatArray:
        """(19,) metres; infinity where not measured."""
        sensor = sensors.get(measurement.sensor) or self.unknown(measurement)
        slow = self.slow_variance(sensor, measurement)
        return np.where(measurement.measured, np.sqrt(sensor.white + slow), np.inf)

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


def _slow_parts(sensor: SensorState, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
    """The part of the stated variance (19,) that the scale of slow errors applies to, and the rest.

    The scale is estimated over all points, mostly while the sensor sees the person well: 0.1 for one who faces it. From
    the side a Kinect v2 errs by three times as much, which it states, and most of all at the far arm. With the same
    scale there, the filter would follow it against a sensor in front. So a scale below 1 applies to the least variance
    stated lately, and what is stated beyond stays whole (docs/tried.md, "What a sensor sees from the side"). A
    single sensor has none to follow instead. With a scale of 0 the sensor has no systematic errors.

    Tried and left: a margin of twice the least variance (nothing is gained), and instead a lower bound of the scale of
    0.15 (mean of all angles in four motions 9.1 instead of 8.7 degrees; the points of one real sensor are predicted by
    another with NIS 0.52 instead of 0.84).
    """
    stated = measurement.model_variance
    if not 0.0 < sensor.slow < 1.0:
        return stated, np.zeros(len(stated))
    scaled = np.minimum(stated, sensor.least_stated * measurement.base_variance)
    return scaled, stated - scaled


def _stated_ratio(measurement: Measurement) -> float:
    """Mean ratio of the stated to the base variance, over the measured points; infinity without any."""
    measured = measurement.measured
    count = np.count_nonzero(measured)
    ratio = measurement.model_variance / measurement.base_variance
    return float(ratio[measured].sum()) / count if count else math.inf


def _kept(before: float, after: float) -> float:
    """The new scale of slow errors, or the old one if they hardly differ."""
    return before if abs(before - after) <= _SLOW_STEP * after else after


def _typical(variances: FloatArray, weight: float) -> float:
    """Common value of several variances, robust to outliers; each is the mean of ``weight`` squared differences."""
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
