"""Effect on the pose of those offsets of a sensor's joint centres that no T-pose has measured."""

from __future__ import annotations

import numpy as np

from body_tracking.calibration.joint_centres import JointCentres
from body_tracking.core.measurement import joint_correlation
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray
from body_tracking.filters.ekf.kernels import displacing
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.state import State, StateSpace
from body_tracking.kinematics.compiled_body import Linearised

_DIMENSIONS = 3
_RECENT_NS = NANOSECONDS // 5
"""Time before the newest frame in which a sensor's last one must lie for it to count as seeing the person."""


class Displacement:
    """Computes the covariance of a pose due to these offsets.

    Args:
        space: of the states.
        centres: estimator of the offsets of the joint centres.
        parameters: of the filter.
    """

    def __init__(self, space: StateSpace, centres: JointCentres, parameters: EkfParameters) -> None:
        self._space, self._centres, self._parameters = space, centres, parameters
        self._rows = (_DIMENSIONS * space.model.joints[:, None] + np.arange(_DIMENSIONS)).reshape(-1)
        joints = space.model.joints
        correlation = joint_correlation(parameters.bone_correlation)[np.ix_(joints, joints)]
        self._correlation = np.kron(correlation, np.eye(_DIMENSIONS))
        tangent = len(space.rest_information)
        self._prior_information = np.zeros((space.observed, space.observed))
        self._prior_information[:tangent, :tangent] = np.diag(space.rest_information)
        self._prior_information[tangent:, tangent:] = np.linalg.inv(space.lengths_covariance)

    def displaced(self, state: State) -> tuple[FloatArray, FloatArray]:
        """(53, 53) covariance of tangent and lengths by offsets of the joint centres; (53,) change by rejected points.

        A rejected point is either an outlier, or a sign that the filter's pose is wrong by this change (the spread of
        innovations of probabilistic data association, Bar-Shalom and Tse 1975).

        Constant offsets ``b`` of covariance ``B`` change the best-fitting pose by ``G b`` with
        ``G = (H^T W H + P^-1)^-1 H^T W``, where ``W`` holds the filter's weights of the points and ``P^-1`` is the
        information of the prior and of the measured orientations; the result is ``G B G^T``. This is first order:
        forearms and hands, hardly longer than the offsets, err by more.
        """
        space = self._space
        lines = space.model.linearised(state.q, state.lengths)
        weights = sum(
            (1.0 / (sensor.white + sensor.slow * space.base_variance) for sensor in state.sensors.values()),
            np.zeros(space.points),
        )
        stated = any(sensor.stated for sensor in state.sensors.values())
        scale = self._parameters.offset_scale if stated else 0.0
        scales = scale * self._factors(state)
        if state.sources.names:
            weights = np.where(space.thumbs[state.sources.segments].any(axis=0), 0.0, weights)
        if self._centres.offsets is not None:
            of_axes = scales.repeat(_DIMENSIONS)
            spread = of_axes * of_axes[:, None] * self._remaining(state, lines)
        else:
            deviations = (scales * np.sqrt(space.base_variance)).repeat(_DIMENSIONS)
            spread = self._correlation * deviations * deviations[:, None]
        gain = displacing(lines.observation, weights, self._prior_information + self._by_orientations(state, lines))
        return gain @ spread @ gain.T, gain @ state.disputed

    def _by_orientations(self, state: State, lines: Linearised) -> FloatArray:
        """(53, 53) information of the orientations measured lately, whose errors are those before any is learnt."""
        space, sources = self._space, state.sources
        information = np.zeros_like(self._prior_information)
        for number in np.flatnonzero(sources.active(state.stamp_ns)):
            misalignment, heading = sources.stated[number]
            error = sources.slow_variance[number] + np.diag([misalignment, misalignment, misalignment + heading])
            turning = lines.rotation_jacobian[sources.segments[number]]
            information[: space.nv, : space.nv] += turning.T @ np.linalg.solve(error, turning)
        return information

    def _factors(self, state: State) -> FloatArray:
        """(19,) factors on the deviations of the offsets, at least 1: how poorly the sensors see each point.

        A sensor that sees a person from the side or from behind, or guesses a joint, displaces it farther. The mean of
        what each of the sensors states, weighted as their points are.
        """
        last = {name: sensor.stamps[-1] for name, sensor in state.sensors.items() if sensor.stated and sensor.stamps}
        if not last:
            return np.ones(self._space.points)
        newest = max(last.values())
        recent = [state.sensors[name] for name, stamp_ns in last.items() if newest - stamp_ns < _RECENT_NS]
        ratios = np.stack([sensor.stated_ratios for sensor in recent])
        weights = 1.0 / ratios
        mean: FloatArray = (weights * np.sqrt(ratios)).sum(axis=0) / weights.sum(axis=0)
        return np.maximum(mean, 1.0)

    def _remaining(self, state: State, lines: Linearised) -> FloatArray:
        """(57, 57) square metres: covariance of the points' offsets that remain after a T-pose."""
        positions = np.full((N_JOINTS, _DIMENSIONS), np.nan)
        positions[self._space.model.joints] = lines.posture.positions
        spread: FloatArray = self._centres.spread(positions, state.stamp_ns)[np.ix_(self._rows, self._rows)]
        return spread
