"""Poses by inverse kinematics: the initial one, and another one if the filter's is wrong."""

from __future__ import annotations

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import ModelError
from body_tracking.core.skeleton import BONES, NANOSECONDS, BoolArray, FloatArray, Joint
from body_tracking.filters.ekf.algebra import CLOSE
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.sensor_errors import SensorErrors
from body_tracking.filters.ekf.sources import PER_SOURCE
from body_tracking.filters.ekf.state import NOBODY, Measurement, SensorState, State, StateSpace
from body_tracking.kinematics.inverse import InverseKinematics
from body_tracking.kinematics.lengths import SegmentLengths

_LONG_NS = 60 * NANOSECONDS
"""Age of the last measurement of a point that has had none."""
_REST_NS = NANOSECONDS // 4
"""Least time between searches for another pose."""
_MISFIT = 0.02
"""Metres: standard deviation of a person's points from the best-fitting pose of the model."""
_WHOLE = 15
"""Least number of points of a frame for an estimate of a person's size."""
_MUCH_BETTER = 0.5
"""Greatest cost of a new pose, as a share of the present one's."""
_FIRST_SPEED, _FIRST_TURN_RATE = 0.3, 1.0
"""m/s and rad/s: standard deviation of the velocities of a person who is first seen."""
_CONTRADICTION = 0.8
"""Greatest change in radians of a segment with a measured orientation by a new pose."""
_ANOTHER_SIZE = 1.2
"""Ratio of sizes beyond which the person is taken for another one."""


class PoseSearch:
    """Finds poses that fit frames.

    Args:
        space: of the states.
        sensors: of the filter.
        parameters: of the filter.
        counters: of the filter.

    Attributes:
        inverse: the inverse kinematics.
        started_by: sensor and stamp of the frame that last started a pose.
    """

    def __init__(
        self,
        space: StateSpace,
        sensors: SensorErrors,
        parameters: EkfParameters,
        counters: dict[str, int],
    ) -> None:
        self._space, self._model, self._sensors = space, space.model, sensors
        self._parameters, self._counters, self._gate = parameters, counters, parameters.gate
        self.inverse = InverseKinematics(space.model)
        self.started_by: tuple[str, int] | None = None
        self._velocity_variance = np.full(space.nv, _FIRST_TURN_RATE**2)
        self._velocity_variance[:3] = _FIRST_SPEED**2
        path = {Joint(joint): number for number, joint in enumerate(space.model.joints)}
        bones = [(path[a], path[b]) for a, b in BONES if a in path and b in path]
        self._bones = np.array([a for a, _ in bones], dtype=np.intp), np.array([b for _, b in bones], dtype=np.intp)

    def first_state(
        self, measurement: Measurement, previous: State | None, learnt: dict[str, SensorState] | None = None
    ) -> State | None:
        """The pose of one frame by inverse kinematics; None where no trunk is seen."""
        points = np.where(measurement.measured[:, None], measurement.positions, np.nan)
        known = learnt if learnt is not None else {} if previous is None else previous.sensors
        stddev = self._sensors.point_stddev(measurement, known)
        lengths = self._lengths_of(points) if previous is None else previous.lengths
        try:
            fit = self.inverse.solve(points, stddev, lengths)
        except ModelError:
            self._counters["no_trunk"] += 1
            return None
        self.started_by = measurement.sensor, measurement.stamp_ns
        state = self.new_state(measurement.stamp_ns, fit.q, lengths, stddev, previous)
        state = state.but(fresh=True, sensors=state.sensors if learnt is None else learnt)
        sensor = state.sensors.get(measurement.sensor) or self._sensors.unknown(measurement)
        sensor = self._sensors.seen_by(sensor, measurement, measurement.measured, state.sensors)
        return state.but(sensors={**state.sensors, measurement.sensor: sensor})

    def new_state(
        self,
        stamp_ns: int,
        q: FloatArray,
        lengths: FloatArray,
        stddev: FloatArray,
        previous: State | None,
        *,
        keep_lengths: bool = True,
    ) -> State:
        """A state at rest, with the covariance of a fit to points of these deviations (19,), metres; inf: unseen."""
        space = self._space
        lines = self._model.linearised(q, lengths)
        seen = np.isfinite(stddev)
        weights = np.where(seen, 1.0 / stddev**2, 0.0)
        by_tangent = lines.jacobian.reshape(-1, space.nv)
        by_length = lines.length_jacobian.reshape(-1, space.nl)
        weighted = by_tangent * np.repeat(weights, 3)[:, None]
        information = weighted.T @ by_tangent
        information[np.arange(space.nv), np.arange(space.nv)] += space.rest_information
        tangent = np.linalg.inv(information)
        # the fit assumed exact lengths: their errors propagate to the pose
        from_lengths = -tangent @ (weighted.T @ by_length)
        lengths_covariance = (
            previous.covariance[space.lengths, space.lengths]
            if previous is not None and keep_lengths
            else space.lengths_covariance
        )
        sources = NOBODY if previous is None else previous.sources
        size = space.size + PER_SOURCE * len(sources)
        covariance = np.zeros((size, size))
        if previous is not None:
            covariance[space.size :, space.size :] = previous.covariance[space.size :, space.size :]
        t, n, v = space.tangent, space.lengths, space.velocities
        covariance[t, t] = tangent + from_lengths @ lengths_covariance @ from_lengths.T
        covariance[t, n] = from_lengths @ lengths_covariance
        covariance[n, t] = covariance[t, n].T
        covariance[n, n] = lengths_covariance
        covariance[v, v] = np.diag(self._velocity_variance)
        return State(
            stamp_ns,
            q,
            lengths,
            np.zeros(space.nv),
            covariance,
            {} if previous is None else previous.sensors,
            (),
            np.empty((size, 0), dtype=np.float32),
            np.zeros(space.points),
            np.zeros(3 * space.points),
            np.zeros(space.observed),
            np.where(seen | ~seen.any(), stamp_ns, stamp_ns - _LONG_NS if previous is None else previous.used_ns),
            0.0,
            0.0 if previous is None else previous.tracked,
            False if previous is None else previous.settled,
            SegmentLengths(self._parameters.slow_time) if previous is None else previous.seen,
            None if previous is None else previous.mean_posture,
            np.empty((0, space.nv)),
            sources=sources,
        )

    def searched(self, state: State, measurement: Measurement, back: BoolArray) -> State:
        """The given state, or a restarted one if its pose is wrong.

        Args:
            state: after the update by the frame.
            measurement: the frame.
            back: (19,) points that reappear in it after a long absence.
        """
        # a search takes ten times as long as filtering a frame
        if state.stamp_ns - state.attempted_ns <= _REST_NS:
            return state
        if state.rejected_for.max() > self._parameters.reacquire_after:
            return self._reacquired(state, measurement).but(attempted_ns=state.stamp_ns)
        if back.any() and self._astray(state, measurement, back):
            points, stddev = self._as_fitted(measurement, state)
            return self._restarted(state, points, stddev, _MUCH_BETTER).but(attempted_ns=state.stamp_ns)
        return state

    def _reacquired(self, state: State, measurement: Measurement) -> State:
        """Restart the pose if another one fits the rejected points much better."""
        space = self._space
        points, stddev = self._as_fitted(measurement, state)
        # a rejected point that another sensor has just confirmed is no reason for another pose
        confirmed = measurement.measured & (state.rejected_for > 0.0) & self._confirmed(state, measurement)
        points[confirmed] = self._model.forward(state.q, state.lengths).positions[confirmed]
        started = self._restarted(state, points, stddev, _MUCH_BETTER)
        if started is not state or state.settled or int(measurement.measured.sum()) < _WHOLE:
            return started
        # No pose fits: wrong lengths from a wrong start would cause the rejection of right points for ever.
        covariance = state.covariance.copy()
        covariance[space.lengths, space.lengths] += space.lengths_covariance
        return state.but(covariance=covariance)

    def _confirmed(self, state: State, measurement: Measurement) -> BoolArray:
        """(19,) whether the last frame of another sensor, not long ago, was accepted at the point."""
        earliest_ns = measurement.stamp_ns - self._parameters.reacquire_after * NANOSECONDS
        confirmed = np.zeros(self._space.points, dtype=np.bool_)
        for name, sensor in state.sensors.items():
            if name != measurement.sensor and sensor.stamps and sensor.stamps[-1] >= earliest_ns:
                confirmed |= np.isfinite(sensor.positions[-1, :, 0])
        return confirmed

    def _astray(self, state: State, measurement: Measurement, back: BoolArray) -> bool:
        """Whether the updated pose misses any of the reappeared points (19,)."""
        off = measurement.positions - self._model.forward(state.q, state.lengths).positions
        variance = self._sensors.point_stddev(measurement, state.sensors) ** 2 + _MISFIT**2
        return bool(((off**2).sum(axis=1) > self._gate * variance)[back].any())

    def _as_fitted(self, measurement: Measurement, state: State) -> tuple[FloatArray, FloatArray]:
        """(19, 3) points, NaN where not measured, and their deviations (19,)."""
        points = np.where(measurement.measured[:, None], measurement.positions, np.nan)
        return points, self._sensors.point_stddev(measurement, state.sensors)

    def _restarted(self, state: State, points: FloatArray, stddev: FloatArray, share: float) -> State:
        """A state restarted at a pose whose cost is at most a share of the present one's; else the present state."""
        try:
            # a coarse fit suffices for the decision, and takes half the steps
            fit = self.inverse.solve(points, stddev, state.lengths, tolerance=CLOSE)
            # lengths that were learnt in a wrong pose are wrong, too
            lengths = self._lengths_of(points)
            size = float(np.median(lengths / state.lengths))
            other = not state.settled or not 1.0 / _ANOTHER_SIZE < size < _ANOTHER_SIZE
            fresh = self.inverse.solve(points, stddev, lengths, fit.q) if other else fit
        except ModelError:
            return state
        if self._contradicts(state, fit.q) or (other and self._contradicts(state, fresh.q)):
            return state
        present = float(self.inverse.cost(state.q[None], points, stddev, state.lengths)[0])
        whole = int(np.isfinite(points).all(axis=1).sum()) >= _WHOLE
        if other and whole and fresh.cost < share * min(fit.cost, present):
            self._counters["restarts"] += 1
            seen = SegmentLengths(self._parameters.slow_time) if state.settled else state.seen
            state = state.but(settled=False, tracked=0.0, seen=seen)
            return self._jumped(
                state, self.new_state(state.stamp_ns, fresh.q, lengths, stddev, state, keep_lengths=False)
            )
        if fit.cost > share * present:
            return state
        self._counters["restarts"] += 1
        fit = self.inverse.solve(points, stddev, state.lengths, fit.q)
        return self._jumped(state, self.new_state(state.stamp_ns, fit.q, state.lengths, stddev, state))

    def _jumped(self, before: State, after: State) -> State:
        """The state after a restart, with the change as its ``jump``."""
        change = self._model.difference(before.q, after.q), after.lengths - before.lengths
        return after.but(jump=np.concatenate(change))

    def _lengths_of(self, points: FloatArray) -> FloatArray:
        """(21,) metres: average proportions, scaled to the size of the observed person."""
        lengths = self._model.default_lengths()
        neutral = self._model.forward(self._model.neutral(), lengths).positions
        starts, ends = self._bones
        seen = np.sqrt(((points[ends] - points[starts]) ** 2).sum(axis=1))
        expected = np.sqrt(((neutral[ends] - neutral[starts]) ** 2).sum(axis=1))
        ratio = seen / expected
        ratio = ratio[np.isfinite(ratio)]
        return lengths * float(np.clip(np.median(ratio), 0.5, 1.4)) if len(ratio) else lengths

    def _contradicts(self, state: State, q: FloatArray) -> bool:
        """Whether a pose rotates a segment far from its measured orientation."""
        segments = state.sources.segments[state.sources.unfit_for == 0.0]
        if not len(segments):
            return False
        now, then = (self._model.forward(each, state.lengths).rotations[segments] for each in (state.q, q))
        apart = so3.rotation_vectors(now @ then.swapaxes(-1, -2))
        return bool(((apart * apart).sum(axis=1) > _CONTRADICTION**2).any())
