"""Updates by frames of cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, SingleArray, TrackingState
from body_tracking.filters.ekf.algebra import CLOSE, FAR, LINEARISATIONS, squared_distance, whitening_of
from body_tracking.filters.ekf.motion import Motion
from body_tracking.filters.ekf.orientations import OrientationUpdate
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.poses import PoseSearch
from body_tracking.filters.ekf.priors import Priors
from body_tracking.filters.ekf.sensor_errors import NEGLIGIBLE_SLOW, STRETCH, SensorErrors
from body_tracking.filters.ekf.state import Measurement, SensorState, SlowBasis, State, StateSpace, single

_TRACKED = np.uint8(TrackingState.TRACKED)
_EYE3 = np.eye(3)
_MEAN_VARIANCE = _EYE3.reshape(-1) / 3.0
"""(9,) factors of a covariance, row by row."""
_FORESEEABLE = 0.1
"""Metres: standard deviation of a predicted point up to which its innovation is used for slow errors."""
_SETTLE_AFTER = 0.3
"""Share of the settle time before which no length stays: a person has to be seen in more than one pose."""
_AWAY_NS = NANOSECONDS // 4
"""Unseen for longer than this, a limb may have turned farther than a linearisation reaches."""
_SUDDEN, _SUDDEN_TIME = 20.0, 0.05
"""m/s2 that a joint may be accelerated by beyond expectation (standard deviation), and the longest time for which."""
_DRAWING = 3.0
"""Squared Mahalanobis distance that a point is taken for which has been rejected for long."""
_MOST_GROWN = 100.0
_ENOUGH_BLOCKS = 5
"""Seconds of frames from which on the lengths are what these say."""
_LENGTHS_PERIOD = 0.75
"""Seconds that they are left alone for: several sensors' blocks of a second are brought in together."""


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    """A frame against what was expected of it.

    Attributes:
        observation: (57, 53) derivative of the points by tangent and lengths of the state.
        innovation: (57,) metres, for a state without any correction.
        covariance: (57, 57) of the innovation.
        own: (19, 3, 3) its blocks of single points, with what curvature adds.
        unstretched: (19, 3, 3) the same without limbs that are too long or too short.
        cross: (85, 57) covariance of the state with the innovation.
        basis: of the slow errors; None where these are negligible.
    """

    observation: FloatArray
    innovation: FloatArray
    covariance: FloatArray
    own: FloatArray
    unstretched: FloatArray
    cross: FloatArray
    basis: SlowBasis | None


class SkeletonUpdate:
    """Takes frames into a state.

    Args:
        space: of the states.
        motion: of the filter.
        sensors: of the filter.
        poses: of the filter.
        priors: of the filter.
        orientations: of the filter.
        parameters: of the filter.
        counters: of the filter.

    Attributes:
        innovation_distance: the last frame's normalised innovation squared over all its accepted points.
        innovation_dimension: its expectation.
    """

    def __init__(
        self,
        space: StateSpace,
        motion: Motion,
        sensors: SensorErrors,
        poses: PoseSearch,
        priors: Priors,
        orientations: OrientationUpdate,
        parameters: EkfParameters,
        counters: dict[str, int],
    ) -> None:
        self._space, self._model, self._motion, self._sensors = space, space.model, motion, sensors
        self._poses, self._priors, self._orientations = poses, priors, orientations
        self._parameters, self._counters, self._gate = parameters, counters, parameters.gate
        self.forget()

    def forget(self) -> None:
        """Begin anew: no frame was taken."""
        self.innovation_distance = math.nan
        self.innovation_dimension = 0

    def taken(self, state: State, measurement: Measurement) -> State:
        """A state of the measurement's time, corrected by it.

        Raises:
            LinAlgError: its covariance is none.
        """
        back = measurement.measured & (measurement.stamp_ns - state.used_ns > _AWAY_NS)
        state = self._corrected(state, measurement)
        state = self._poses.searched(state, measurement, back)
        return self._priors.within(self._priors.bounded(self._measured(state, measurement)))

    def _corrected(self, state: State, measurement: Measurement) -> State:
        """The Kalman update with the points that pass the gate; what was learnt of the sensor."""
        space = self._space
        dt = max(0.0, (measurement.stamp_ns - self._last_stamp(state, measurement)) / NANOSECONDS)
        sensor = state.sensors.get(measurement.sensor) or self._sensors.unknown(measurement)
        seen = self._expected(state, measurement, sensor)
        own = seen.own
        y = seen.innovation.reshape(-1, 3)
        distances = squared_distance(own, y)
        near = distances < self._gate
        # a limb may set off faster than it is expected to: what it can do in the time that passed is no outlier
        if not near[measurement.measured].all():
            sudden = 0.5 * _SUDDEN * min(dt, _SUDDEN_TIME) ** 2
            near = squared_distance(own + sudden**2 * _EYE3, y) < self._gate
        # what stays where the person is not believed to be, and where no other pose is found, draws it there slowly
        stubborn = measurement.measured & ~near & (state.rejected_for > self._parameters.reacquire_after)
        grown = np.where(stubborn, np.minimum(distances / _DRAWING, _MOST_GROWN), 1.0)
        used = measurement.measured & (near | stubborn)
        count = int(np.count_nonzero(used))
        self._counters["measured"] += count
        self._counters["rejected"] += int(np.count_nonzero(measurement.measured)) - count
        # a wrong pose must not pass for limbs that stretch
        unstretched = seen.unstretched
        lean, leaning, strain = self._poses.leaning(
            state, y, unstretched, measurement.measured, distances, sensor.white, dt
        )

        rows: slice | IntArray = slice(0, 3 * space.points)
        if count < space.points:
            rows = np.flatnonzero(np.repeat(used, 3))
        rejected_for = np.where(used & near, 0.0, state.rejected_for + np.where(measurement.measured, dt, 0.0))
        used_ns = np.where(used, measurement.stamp_ns, state.used_ns)
        if not count:
            sensors = {**state.sensors, measurement.sensor: self._sensors.seen_by(sensor, measurement, used)}
            return state.but(
                sensors=sensors,
                rejected_for=rejected_for,
                used_ns=used_ns,
                lean=lean,
                leaning=leaning,
                strain=strain,
            )

        correction = np.zeros(len(state.covariance))
        for left in reversed(range(LINEARISATIONS)):
            s = seen.covariance
            s.reshape(-1)[space.own] = grown[:, None, None] * seen.own
            whitening = whitening_of(s[rows][:, rows])
            gain = whitening @ seen.cross[:, rows].T  # (k, 85): L^-1 (P H^T)^T
            white = whitening @ seen.innovation[rows]
            before, correction = correction, white @ gain
            covariance = state.covariance - gain.T @ gain
            turned = np.abs(correction[3 : space.nv]).max()
            if not left or turned < FAR or np.abs(correction - before)[3 : space.nv].max() < CLOSE:
                break
            # Far from where it was linearised the measurement says something else: linearise it anew about what was
            # found (iterated posterior linearisation, Garcia-Fernandez et al. 2015).
            seen = self._expected(state, measurement, sensor, correction[: space.observed], covariance)
        observation, basis = seen.observation, seen.basis
        unlearnt = self._orientations.unlearnt(state) if state.sources.names else None
        if unlearnt is not None:
            combinations, back = unlearnt
            taken = gain @ combinations.T
            correction -= back @ (combinations @ correction)
            covariance += back @ (taken.T @ taken) @ back.T
        # errors are told in the tangent of what is found
        turns = [(ball, so3.right_jacobian(correction[ball])) for ball in self._model.ball_v] if turned >= FAR else []
        for ball, turn in turns:
            covariance[ball] = turn @ covariance[ball]
            covariance[:, ball] = covariance[:, ball] @ turn.T
        if state.settled:
            correction[space.lengths] = 0.0
            covariance[space.lengths, space.lengths] = state.covariance[space.lengths, space.lengths]
        if len(state.null):
            # what no point shows must not tremble with those that are seen
            for part in (correction[space.tangent], correction[space.velocities]):
                part -= (state.null @ part) @ state.null
        self.innovation_distance, self.innovation_dimension = float(white @ white), len(white)

        names, crosses = state.slow_names, state.crosses
        if measurement.sensor in names and basis is None:
            names, crosses = _without(names, crosses, measurement.sensor)
        elif measurement.sensor not in names and basis is not None:
            names = (*names, measurement.sensor)
            none = np.zeros((len(crosses), self._sensors.slow_size), dtype=crosses.dtype)
            crosses = np.concatenate([crosses, none], axis=1)
        own_cross = None
        if names:
            # Slow errors are only considered (Schmidt 1966): C - K H C, and - K B of the sensor's own.
            kalman = gain.T @ whitening  # (85, k)
            if state.settled:
                kalman[space.lengths] = 0.0
            if unlearnt is not None:
                kalman -= back @ (combinations @ kalman)
            change = single(kalman @ observation[rows]) @ crosses[: space.observed]
            if basis is not None:
                place = names.index(measurement.sensor) * self._sensors.slow_size
                own_change = change[:, place : place + self._sensors.slow_size]
                own_change[:, rows] += kalman * basis.points[rows]
                own_change[:, 3 * space.points :] += kalman @ basis.limbs[rows]
            crosses = np.subtract(crosses, change, out=change)
            if basis is not None:
                own_cross = crosses[:, place : place + self._sensors.slow_size]
            for ball, turn in turns:
                crosses[ball] = turn @ crosses[ball]
        moved = state.moved + correction[space.velocities]
        before, after = (m.diagonal()[space.velocities] for m in (state.covariance, covariance))
        moved_variance = state.moved_variance + np.maximum(before - after, 0.0)

        predicted_variance = own.reshape(-1, _EYE3.size) @ _MEAN_VARIANCE - sensor.white
        foreseeable = float(predicted_variance[used].max()) < _FORESEEABLE**2
        slow_scale, slow_estimate, information = (
            self._sensors.slow_learnt(sensor, measurement, whitening, white, rows, bool(state.sources.names))
            if foreseeable  # elsewhere the linearisation errs by more than the sensor
            else (sensor.slow, sensor.slow_estimate, sensor.slow_information)
        )
        if own_cross is not None and slow_scale is not sensor.slow:
            # What the slow errors did to the state so far is as much smaller as they are.
            before_that = np.maximum(sensor.slow, NEGLIGIBLE_SLOW)
            ratio = np.where(sensor.slow > NEGLIGIBLE_SLOW, slow_scale / before_that, 1.0)
            if (ratio != 1.0).any():
                ratio = self._sensors.per_error(ratio)
                covariance -= (own_cross * (1.0 - ratio)) @ own_cross.T
                own_cross *= np.sqrt(ratio)
        learnt = self._sensors.seen_by(sensor, measurement, used).but(
            slow=slow_scale,
            slow_estimate=slow_estimate,
            slow_information=information,
        )
        return state.but(
            q=self._model.integrate(state.q, correction[space.tangent]),
            lengths=state.lengths + correction[space.lengths],
            velocity=state.velocity + correction[space.velocities],
            covariance=covariance,
            log_density=self._motion.densities_learnt(state, moved, moved_variance, after, dt),
            moved=moved,
            moved_variance=moved_variance,
            sensors={**state.sensors, measurement.sensor: learnt},
            slow_names=names,
            crosses=crosses,
            rejected_for=rejected_for,
            used_ns=used_ns,
            lean=lean,
            leaning=leaning,
            strain=strain,
            sources=state.sources if len(correction) == space.size else state.sources.moved(correction[space.size :]),
        )

    def _expected(
        self,
        state: State,
        measurement: Measurement,
        sensor: SensorState,
        correction: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> _Expected:
        """What a sensor is expected to measure, linearised about the state or about what a correction makes of it.

        Args:
            state: of the measurement's time.
            measurement: the frame.
            sensor: its errors.
            correction: (53,) of tangent and lengths; None for none.
            covariance: (85, 85) after it.
        """
        space = self._space
        q, lengths, t = state.q, state.lengths, space.tangent
        if correction is not None:
            q = self._model.integrate(q, correction[t])
            lengths = lengths if state.settled else lengths + correction[space.lengths]
        lines = self._model.linearise(q, lengths)
        observation = space.observation(lines)
        spread = state.covariance if covariance is None else covariance
        curvature = self._model.curvature(lines, spread[t, t])
        innovation = (measurement.positions - lines.posture.positions - curvature).reshape(-1)
        if correction is not None:
            for ball in self._model.ball_v:  # in the tangent of the state
                observation[:, ball] = observation[:, ball] @ so3.right_jacobian(correction[ball])
            known = space.nv if state.settled else space.observed
            innovation += observation[:, :known] @ correction[:known]

        # (85, 57) covariance of the state with the points as they are measured: P H^T + C B^T
        cross_covariance = state.covariance[:, : space.observed] @ observation.T
        basis = self._sensors.slow_basis(sensor.slow, measurement, lines.posture.positions)
        cross = state.cross(measurement.sensor)
        noise = sensor.white.repeat(3)
        if basis is None:
            s = observation @ cross_covariance[: space.observed]
        else:
            # H P H^T + B C^T H^T + H C B^T + B B^T
            half = 0.5 * cross_covariance
            if cross is not None:
                by_slow = basis.of(cross)
                cross_covariance += by_slow
                half += by_slow
            half = observation @ half[: space.observed]
            by_limbs = basis.limbs @ basis.limbs.T
            s = half + half.T + by_limbs
            noise += basis.points * basis.points
        s.reshape(-1)[:: len(s) + 1] += noise
        # a normal error x makes x^2 / 2 of mean m and of variance 2 m^2
        own = s.reshape(-1).take(space.own) + 2.0 * curvature[:, :, None] * curvature[:, None, :]
        unstretched = own if basis is None else own - by_limbs.reshape(-1).take(space.own)
        return _Expected(observation, innovation, s, own, unstretched, cross_covariance, basis)

    def _last_stamp(self, state: State, measurement: Measurement) -> int:
        sensor = state.sensors.get(measurement.sensor)
        return sensor.stamps[-1] if sensor is not None and sensor.stamps else measurement.stamp_ns

    def _measured(self, state: State, measurement: Measurement) -> State:
        """Replace the lengths by those estimated from many poses."""
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
            float(sensor.slow[0]),
            math.sqrt(sensor.slow[1]) * STRETCH,
        )
        news = seen.blocks is not state.seen.blocks and len(seen.blocks) >= _ENOUGH_BLOCKS
        state = state.but(seen=seen)
        if not news or state.tracked - state.measured_at < _LENGTHS_PERIOD:
            return state
        state = state.but(measured_at=state.tracked)
        found = seen.estimate()
        known = float(np.sqrt(found.covariance.diagonal()).max()) < self._parameters.settle_stddev
        if known and state.tracked > _SETTLE_AFTER * self._parameters.settle_time:
            state = state.but(seen=None)
        # The lengths' errors are new ones. What is known of the rest where the lengths are given stays as it is.
        before = state.covariance[space.lengths, space.lengths]
        follows: FloatArray = np.asarray(np.linalg.solve(before, state.covariance[space.lengths]).T, dtype=np.float64)
        crosses = state.crosses - single(follows) @ state.crosses[space.lengths]
        covariance = state.covariance + follows @ (found.covariance - before) @ follows.T
        moved = space.moved(state.but(settled=False), follows @ (found.lengths - state.lengths))
        return moved.but(lengths=found.lengths, covariance=covariance, crosses=crosses, settled=True)


def _without(names: tuple[str, ...], crosses: SingleArray, name: str) -> tuple[tuple[str, ...], SingleArray]:
    """``slow_names`` and ``crosses`` of a state without those of one sensor."""
    kept = np.repeat([each != name for each in names], crosses.shape[1] // len(names))
    return tuple(each for each in names if each != name), crosses[:, kept]
