"""Updates by frames of cameras."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, TrackingState
from body_tracking.filters.ekf.algebra import CLOSE, FAR, LINEARISATIONS
from body_tracking.filters.ekf.kernels import crosses_updated, expected, gated, solved
from body_tracking.filters.ekf.orientations import OrientationUpdate
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.poses import PoseSearch
from body_tracking.filters.ekf.priors import Priors
from body_tracking.filters.ekf.sensor_errors import STRETCH, SensorErrors
from body_tracking.filters.ekf.state import Measurement, SensorState, State, StateSpace, single
from body_tracking.kinematics.lengths import MIN_LENGTH

_TRACKED = np.uint8(TrackingState.TRACKED)
_EYE3 = np.eye(3)
_MEAN_VARIANCE = _EYE3.reshape(-1) / 3.0
"""(9,) weights of a covariance's elements, row by row, that give the mean variance."""
_FORESEEABLE = 0.1
"""Metres: standard deviation of a predicted point up to which its innovation is used for slow errors."""
_SETTLE_STDDEV = 0.003
"""Metres: the lengths are fixed when their standard deviations are below this."""
_SETTLE_AFTER = 0.3
"""Share of the settle time before which the lengths are not fixed: a person has to be seen in more than one pose."""
_AWAY_NS = NANOSECONDS // 4
"""Unseen for longer than this, a limb may have turned farther than a linearisation reaches."""
_YOUNG = 1.0
"""Seconds after the start in which a pose may be far from the point of linearisation."""
_ENOUGH_BLOCKS = 5
"""Seconds of frames from which on the lengths are estimated from them."""
_LENGTHS_PERIOD = 0.75
"""Least seconds between updates of the lengths: one update serves the blocks of all sensors, a second each."""

_REACH = 0.8
"""Metres: bound of a rejected innovation; a wrong pose is off by at most the length of an arm."""


class _Expected(NamedTuple):
    """Predicted measurement of a frame and its innovation.

    Attributes:
        observation: (57, 53) derivative of the points by tangent and lengths of the state.
        innovation: (57,) metres, referred to the state without any correction.
        covariance: (57, 57) of the innovation.
        cross: (85, 57) covariance of the state with the innovation.
        own: (19, 3, 3) innovation covariance of each point, with the second-order terms.
        limbs: (57, 4) displacement by one standard deviation of each limb's length.
        slow: (19, 19) the points' slow errors by independent ones of unit variance.
    """

    observation: FloatArray
    innovation: FloatArray
    covariance: FloatArray
    cross: FloatArray
    own: FloatArray
    limbs: FloatArray
    slow: FloatArray


class SkeletonUpdate:
    """Updates a state by frames.

    Args:
        space: of the states.
        sensors: of the filter.
        poses: of the filter.
        priors: of the filter.
        orientations: of the filter.
        parameters: of the filter.
        counters: of the filter.

    Attributes:
        innovation_distance: the last frame's normalised innovation squared over all its accepted points.
        innovation_dimension: expectation of this distance.
    """

    def __init__(
        self,
        space: StateSpace,
        sensors: SensorErrors,
        poses: PoseSearch,
        priors: Priors,
        orientations: OrientationUpdate,
        parameters: EkfParameters,
        counters: dict[str, int],
    ) -> None:
        self._space, self._model, self._sensors = space, space.model, sensors
        self._poses, self._priors, self._orientations = poses, priors, orientations
        self._parameters, self._counters, self._gate = parameters, counters, parameters.gate
        self.forget()

    def forget(self) -> None:
        """Forget the last frame."""
        self.innovation_distance = math.nan
        self.innovation_dimension = 0

    def taken(self, state: State, measurement: Measurement) -> State:
        """A state of the measurement's time, corrected by it.

        Raises:
            LinAlgError: an innovation covariance is not positive definite.
        """
        back = measurement.measured & (measurement.stamp_ns - state.used_ns > _AWAY_NS)
        state = self._corrected(state, measurement, bool(back.any()))
        state = self._poses.searched(state, measurement, back)
        return self._priors.within(self._priors.bounded(self._lengths_updated(state, measurement)))

    def _corrected(self, state: State, measurement: Measurement, reappeared: bool) -> State:
        """The Kalman update by the points that pass the gate, and the update of the sensor's errors.

        Args:
            state: of the measurement's time.
            measurement: the frame.
            reappeared: whether a point reappears after a long absence.
        """
        space = self._space
        dt = max(0.0, (measurement.stamp_ns - self._last_stamp(state, measurement)) / NANOSECONDS)
        sensor = state.sensors.get(measurement.sensor) or self._sensors.unknown(measurement)
        if measurement.sensor not in state.slow_names:
            none = np.zeros((len(state.crosses), self._sensors.slow_size), dtype=np.float32)
            names, crosses = (*state.slow_names, measurement.sensor), np.concatenate([state.crosses, none], axis=1)
            state = state.but(slow_names=names, crosses=crosses)
        seen = self._expected(state, measurement, sensor)
        used, rejected_for = gated(seen.innovation, seen.own, measurement.measured, state.rejected_for, dt, self._gate)
        count = int(np.count_nonzero(used))
        self._counters["measured"] += count
        self._counters["rejected"] += int(np.count_nonzero(measurement.measured)) - count
        state = state.but(
            rejected_for=rejected_for,
            disputed=self._disputed(state, measurement, seen.innovation, rejected_for),
            used_ns=np.where(used, measurement.stamp_ns, state.used_ns),
        )
        learnt = self._sensors.seen_by(sensor, measurement, used, state.sensors)
        if not count:
            return state.but(sensors={**state.sensors, measurement.sensor: learnt})

        rows: IntArray = np.flatnonzero(np.repeat(used, 3))
        predicted_variance = seen.own[used].reshape(count, -1) @ _MEAN_VARIANCE - sensor.white[used]
        correction = np.zeros(len(state.covariance))
        # With cameras alone one linearisation is as accurate while a person is tracked. At the start and after an
        # absence it would leave an arm with a wrong axial rotation of small variance, and a source's misalignment would
        # absorb the error. Where orientations are far from a camera's arm, their source would seem to have slipped.
        far = reappeared or bool(state.sources.names) or state.tracked < _YOUNG
        for left in reversed(range(LINEARISATIONS if far else 1)):
            sound, whitening, gain, white, covariance = solved(
                seen.covariance, seen.own, seen.cross, seen.innovation, state.covariance, rows
            )
            if not sound:
                raise np.linalg.LinAlgError("not positive definite")
            before, correction = correction, white @ gain
            turned = np.abs(correction[3 : space.nv]).max()
            if not left or turned < FAR or np.abs(correction - before)[3 : space.nv].max() < CLOSE:
                break
            # The linearisation does not hold that far from the state: linearise anew at the updated estimate (iterated
            # posterior linearisation, Garcia-Fernandez et al. 2015).
            seen = self._expected(state, measurement, sensor, correction[: space.observed], covariance)
        unlearnt = self._orientations.unlearnt(state) if state.sources.names else None
        if unlearnt is not None:
            combinations, back = unlearnt
            taken = gain @ combinations.T
            correction -= back @ (combinations @ correction)
            covariance += back @ (taken.T @ taken) @ back.T
        # express the covariance in the tangent space at the updated estimate
        turns = [(ball, so3.right_jacobian(correction[ball])) for ball in self._model.ball_v] if turned >= FAR else []
        for ball, turn in turns:
            covariance[ball] = turn @ covariance[ball]
            covariance[:, ball] = covariance[:, ball] @ turn.T
        if state.settled:
            correction[space.lengths] = 0.0
            covariance[space.lengths, space.lengths] = state.covariance[space.lengths, space.lengths]
        if len(state.null):
            # keep the unobserved directions from following the noise of the observed ones
            for part in (correction[space.tangent], correction[space.velocities]):
                part -= (state.null @ part) @ state.null
        self.innovation_distance, self.innovation_dimension = float(white @ white), len(white)

        kalman = gain.T @ whitening  # (85, k)
        if state.settled:
            kalman[space.lengths] = 0.0
        if unlearnt is not None:
            kalman -= back @ (combinations @ kalman)
        place = self._sensors.place_of(state, measurement.sensor)
        crosses = crosses_updated(
            state.crosses,
            kalman,
            seen.observation,
            rows,
            place,
            seen.slow,
            seen.limbs,
        )
        for ball, turn in turns:
            crosses[ball] = turn @ crosses[ball]
        foreseeable = float(predicted_variance.max()) < _FORESEEABLE**2
        slow_scale, slow_estimate, information = (
            self._sensors.slow_learnt(sensor, measurement, whitening, white, rows, state.sources)
            if foreseeable  # otherwise the linearisation errs by more than the sensor
            else (sensor.slow, sensor.slow_estimate, sensor.slow_information)
        )
        learnt = learnt.but(slow=slow_scale, slow_estimate=slow_estimate, slow_information=information)
        if slow_scale != sensor.slow and sensor.slow > 0.0:
            # Scale the slow errors' contribution to the covariance by the same ratio.
            old, new = (self._sensors.slow_variance(each, measurement) for each in (sensor, learnt))
            ratio = (new / old).repeat(3)
            own_cross = crosses[:, place : place + 3 * space.points]
            covariance -= (1.0 - ratio) * own_cross @ own_cross.T
            own_cross *= np.sqrt(ratio, dtype=np.float32)
        return state.but(
            q=self._model.integrate(state.q, correction[space.tangent]),
            lengths=np.maximum(state.lengths + correction[space.lengths], MIN_LENGTH),
            velocity=state.velocity + correction[space.velocities],
            covariance=covariance,
            sensors={**state.sensors, measurement.sensor: learnt},
            crosses=crosses,
            sources=state.sources if len(correction) == space.size else state.sources.moved(correction[space.size :]),
        )

    def _disputed(
        self, state: State, measurement: Measurement, innovation: FloatArray, rejected_for: FloatArray
    ) -> FloatArray:
        """(57,) ``State.disputed`` after a frame: 0 for accepted points, unchanged for unseen ones.

        A single rejected frame counts as an outlier. Otherwise the deviations of an arm that one of two sensors sees
        elsewhere would alternate: 104 degrees after each of its frames, 30 after each of the other's.
        """
        before = np.where(rejected_for > 0.0, state.rejected_for, 0.0)
        share = np.minimum(before / max(self._parameters.reacquire_after, 1e-3), 1.0)
        disputed = np.sqrt(share).repeat(3) * np.clip(innovation, -_REACH, _REACH)
        return np.where(measurement.measured.repeat(3), disputed, state.disputed)

    def _expected(
        self,
        state: State,
        measurement: Measurement,
        sensor: SensorState,
        correction: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> _Expected:
        """The predicted measurement, linearised at the state, or at the state after a correction.

        Args:
            state: of the measurement's time.
            measurement: the frame.
            sensor: errors of its sensor.
            correction: (53,) of tangent and lengths; None for none.
            covariance: (85, 85) after the correction.
        """
        space, t = self._space, self._space.tangent
        q, lengths, spread = state.q, state.lengths, state.covariance if covariance is None else covariance
        if correction is not None:
            q = self._model.integrate(q, correction[t])
            lengths = lengths if state.settled else lengths + correction[space.lengths]
        turns = np.zeros((0, 3, 3))
        if correction is not None:  # derivatives by the tangent at the state
            turns = so3.right_jacobian(correction[self._model.ball_v])
        slow, along = self._sensors.slow_errors(sensor, measurement, state.sources)
        found = _Expected(
            *expected(
                q,
                lengths,
                measurement.positions,
                state.covariance,
                np.ascontiguousarray(spread[t, t]),
                state.crosses,
                self._sensors.place_of(state, measurement.sensor),
                slow,
                along,
                self._sensors.carried,
                sensor.white,
                turns,
                self._model.tree,
            ),
            slow,
        )
        if correction is not None:
            known = space.nv if state.settled else space.observed
            found.innovation[:] += found.observation[:, :known] @ correction[:known]
        return found

    def _last_stamp(self, state: State, measurement: Measurement) -> int:
        sensor = state.sensors.get(measurement.sensor)
        return sensor.stamps[-1] if sensor is not None and sensor.stamps else measurement.stamp_ns

    def _lengths_updated(self, state: State, measurement: Measurement) -> State:
        """Add a frame to the estimator of the lengths, and replace the lengths by its estimate when it is due."""
        space = self._space
        if state.seen is None:
            return state
        sensor = state.sensors[measurement.sensor]
        seen = state.seen.with_frame(
            measurement.sensor,
            measurement.stamp_ns,
            measurement.positions,
            measurement.measured & (measurement.skeleton.states[self._model.joints] == _TRACKED),
            sensor.white,
            measurement.model_variance,
            sensor.slow,
            STRETCH if sensor.stated else 0.0,
        )
        news = seen.blocks is not state.seen.blocks and len(seen.blocks) >= _ENOUGH_BLOCKS
        state = state.but(seen=seen)
        if not news or state.tracked - state.measured_at < _LENGTHS_PERIOD:
            return state
        state = state.but(measured_at=state.tracked)
        found = seen.estimate()
        known = float(np.sqrt(found.covariance.diagonal()).max()) < _SETTLE_STDDEV
        if known and state.tracked > _SETTLE_AFTER * self._parameters.settle_time:
            state = state.but(seen=None)
        # Replace the marginal distribution of the lengths; that of the rest given the lengths stays.
        before = state.covariance[space.lengths, space.lengths]
        follows: FloatArray = np.asarray(np.linalg.solve(before, state.covariance[space.lengths]).T, dtype=np.float64)
        crosses = state.crosses - single(follows) @ state.crosses[space.lengths]
        covariance = state.covariance + follows @ (found.covariance - before) @ follows.T
        moved = space.moved(state.but(settled=False), follows @ (found.lengths - state.lengths))
        return moved.but(lengths=found.lengths, covariance=covariance, crosses=crosses, settled=True)
