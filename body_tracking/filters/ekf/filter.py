"""The extended filter: processes frames and orientations in the order of their stamps.

Over 500 lines: one estimator, whose start, order of stamps and replay of late measurements share its state; updates,
priors and errors of sensors have modules of their own.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from body_tracking.calibration.joint_centres import JointCentres
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.measurement import INFERRED_FACTOR
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.filters.ekf.algebra import forward_substituted, whitening_of
from body_tracking.filters.ekf.displacement import Displacement
from body_tracking.filters.ekf.facing import Facing
from body_tracking.filters.ekf.motion import Motion
from body_tracking.filters.ekf.orientations import OrientationUpdate
from body_tracking.filters.ekf.output import Output
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.poses import PoseSearch
from body_tracking.filters.ekf.priors import Priors
from body_tracking.filters.ekf.sensor_errors import SensorErrors
from body_tracking.filters.ekf.skeletons import SkeletonUpdate
from body_tracking.filters.ekf.smoothing import Frame, Link, Smoother
from body_tracking.filters.ekf.sources import pose_of
from body_tracking.filters.ekf.state import Measurement, SensorState, State, StateSpace
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.lengths import SegmentLengths

_TRACKED = np.uint8(TrackingState.TRACKED)
_EYE3 = np.eye(3)
_START_FRAMES = 4
"""Number of frames of one sensor that start the filter: they give an estimate of its noise."""
_WAIT_NS = NANOSECONDS // 2
"""Greatest time between the frames that start the filter together."""
_START_AFTER_NS = NANOSECONDS
"""After this time without a skeleton, orientations alone start the body."""
_PREPARED = 10
"""Frames after which all compiled functions have run."""
_MAX_COORDINATE = 100.0
_LONGEST_WAIT_NS = NANOSECONDS // 10
"""Greatest time that an orientation is queued without a request for the estimate."""
_DISORDER_NS = NANOSECONDS // 300
"""Orientations may arrive out of order by up to this time."""
_BREAKS = ("restarts", "branches", "slips", "broken_covariances", "frame_changes", "gaps")
"""Counters of events that break the continuity of the pose."""
_UNPLACED_STDDEV, _UNTURNED_STDDEV = 100.0, 1.0
"""Metres and radians: standard deviations of the base when orientations alone start the body."""


class ExtendedKalmanFilter:
    """The filter ``ekf``.

    Attributes:
        model: the body.
        counters: events since the construction, for diagnostics.
    """

    def __init__(self, parameters: EkfParameters | None = None) -> None:
        self.parameters = p = parameters or EkfParameters()
        self.model = CompiledUpperBody()
        self.counters: dict[str, int] = dict.fromkeys(
            (
                "frames",
                "measured",
                "rejected",
                "restarts",
                "branches",
                "repeated_stamps",
                "late_frames",
                "taken_again",
                "too_late",
                "backward_jumps",
                "gaps",
                "frame_changes",
                "no_trunk",
                "broken_covariances",
                "orientations",
                "orientations_used",
                "orientations_rejected",
                "rates_rejected",
                "orientations_late",
                "orientations_refused",
                "slips",
                "sides_swapped",
            ),
            0,
        )
        self._space = space = StateSpace(self.model)
        self._motion = Motion(space, p)
        self._sensors = SensorErrors(space, p)
        self._priors = Priors(space, p, self.counters)
        self._poses = PoseSearch(space, self._sensors, p, self.counters)
        self._centres = JointCentres(self.counters)
        self._displacement = Displacement(space, self._centres, p)
        self._orientations = OrientationUpdate(space, self._motion, self._priors, p, self.counters)
        self._skeletons = SkeletonUpdate(
            space,
            self._sensors,
            self._poses,
            self._priors,
            self._orientations,
            p,
            self.counters,
        )
        self._facing = Facing(space, self.counters)
        self._output = Output(space, self._displacement, self._priors, p)
        self._smoother = Smoother(space, self._motion)
        self.reset()

    # --- interface

    def reset(self) -> None:
        """Forget the person; the counters stay."""
        self._last: State | None = None
        self._late: list[Measurement | SegmentOrientation] = []
        self._frame_id = ""
        self._newest: Skeleton | None = None
        self._history: deque[tuple[State, Measurement | SegmentOrientation]] = deque()
        self._waiting: list[Measurement] = []
        self._turned_only: dict[str, SegmentOrientation] = {}
        self._turned_since: int | None = None
        self._newest_of: dict[str, int] = {}
        self._poses.started_by = None
        self._skeletons.forget()
        self._centres.reset()
        self._lengths_from_ns: int | None = None
        self._output.forget()

    def forget_joint_centres(self) -> None:
        """Forget what a T-pose has shown of the person. Lengths stay: frames of another person's replace them soon."""
        self._centres.reset()
        self._lengths_from_ns = None

    @property
    def innovation_distance(self) -> float:
        """The last frame's normalised innovation squared over all its accepted points; NaN before the first one."""
        return self._skeletons.innovation_distance

    @property
    def innovation_dimension(self) -> int:
        """Expectation of :attr:`innovation_distance`: the number of accepted coordinates."""
        return self._skeletons.innovation_dimension

    def start(
        self, q: FloatArray, lengths: FloatArray | None = None, stamp_ns: int = 0, frame_id: str = "world"
    ) -> None:
        """Set the pose instead of finding it by inverse kinematics from the first frame.

        Args:
            q: (35,) configuration.
            lengths: (21,) metres; those of an average person if None.
            stamp_ns: time of the pose.
            frame_id: of the base.
        """
        self.reset()
        lengths = self.model.default_lengths() if lengths is None else lengths
        self._frame_id = frame_id
        stddev = np.sqrt(self._space.base_variance)
        self._state = self._poses.new_state(stamp_ns, q, lengths, stddev, None)

    def update(self, skeleton: Skeleton, sensor: str = "") -> Skeleton | None:
        """Take one frame and return the filtered skeleton: :meth:`take`, then :attr:`filtered`.

        Returns:
            None if the frame is repeated or late, or shows no trunk yet.
        """
        return self.filtered if self.take(skeleton, sensor) else None

    def take(self, skeleton: Skeleton, sensor: str = "") -> bool:
        """Take one frame; a late one is queued until the estimate is next requested.

        Args:
            skeleton: in a fixed frame with z up; ``/fused/skeleton``, or one sensor's brought into ``world``.
            sensor: its name; each sensor has its own noise.

        Returns:
            Whether there is now an estimate at its stamp: False if the frame is repeated or late, or shows no trunk
            yet.
        """
        measurement = self._measurement(skeleton, sensor)
        state = self._last
        if state is not None and measurement.stamp_ns >= state.stamp_ns and not self._is_awaited(measurement):
            state = self._state
        if state is not None and not self._in_time(measurement, state):
            return False
        if state is not None and self._last is None:  # reset: the joint centres were those of the person before
            measurement = self._measurement(skeleton, sensor)
        state = self._last
        self.counters["frames"] += 1
        if self.parameters.t_pose and self._centres.update(skeleton, sensor):
            self._lengths_from_ns = skeleton.stamp_ns
        if state is not None and state.unplaced:
            return self._placed(measurement)
        if state is not None and (self._is_awaited(measurement) or self._is_late(measurement, state)):
            # orientations arrive before frames of the same time: such a frame is overtaken, but not late
            overtaken = self._is_awaited(measurement) or bool((state.sources.stamps >= measurement.stamp_ns).any())
            late = not overtaken or self._newest is None or measurement.stamp_ns < self._newest.stamp_ns
            self.counters["late_frames"] += late
            self._late.append(measurement)
            if not late:
                self._newest = skeleton
            return not late
        self._newest = skeleton
        if state is None:
            self._frame_id = skeleton.frame_id
            self._state = self._begun(measurement)
            return self._state is not None
        if not (state.sensors and state.fresh and state.stamp_ns == measurement.stamp_ns):
            self._state = self._remember(state, measurement)  # else it was started from this frame, after a gap
        return True

    def take_orientation(self, measurement: SegmentOrientation) -> bool:
        """Take the orientation of one segment, to be processed in the order of the stamps.

        Without skeletons, orientations alone start the body after a second, with its base at the origin and the
        deviation of an unknown position. The first skeletons then restart it.

        Returns:
            Whether there is now an estimate at about its stamp: False if the orientation is repeated or late.
        """
        self.counters["orientations"] += 1
        state = self._last
        if state is None:
            return self._begun_turned(measurement)
        if not self._orientation_in_time(measurement, state):
            return False
        state = self._last
        if state is None:
            return self._begun_turned(measurement)
        late = self._is_late(measurement, state)
        self.counters["orientations_late"] += late
        # queued until the estimate is requested: a camera's frame of an earlier time may still arrive
        self._late.append(measurement)
        if measurement.stamp_ns - state.stamp_ns > _LONGEST_WAIT_NS:
            self._last = self._replay(state)
        return not late

    def settle(self, until_ns: int) -> None:
        """Process the queued orientations that no earlier measurement is likely to precede; results do not change.

        Called while idle, this shortens the processing of the next frame.

        Args:
            until_ns: no frame is expected before this time.
        """
        state = self._last
        if state is None or not self._late:
            return
        until_ns = min(until_ns, max(each.stamp_ns for each in self._late) - _DISORDER_NS)
        # more orientations from before the last frame may arrive, and each would cause a replay of that frame
        if until_ns > state.stamp_ns:
            self._last = self._replay(state, until_ns)

    @property
    def filtered(self) -> Skeleton | None:
        """The modelled joints at the latest frame, with covariances and velocities; None before the first one.

        INFERRED where predicted, NOT_TRACKED where not modelled.
        """
        if self._state is None:
            return None
        newest = self._newest
        if newest is None:
            if not self._state.unplaced:
                return None
            newest = self._empty(self._state.stamp_ns)
        return self._output.skeleton(self._state, newest)

    @property
    def estimate(self) -> ModelEstimate | None:
        """The state of the model at the latest frame; None before the first one."""
        return None if self._state is None else self._output.estimate(self._state, self._frame_id, self._body())

    def predict(self, stamp_ns: int) -> tuple[Skeleton, ModelEstimate] | None:
        """The prediction at a later time, without changing the filter; None if the person is lost."""
        state = self._state
        if state is None:
            return None
        last_ns = max(int(state.used_ns.max()), state.oriented_ns)
        if stamp_ns - last_ns > self.parameters.predict_for * NANOSECONDS:
            return None
        state = self._priors.within(self._motion.predicted(state, stamp_ns))
        estimate = self._output.estimate(state, self._frame_id, self._body())
        return self._output.skeleton(state, self._empty(stamp_ns)), estimate

    # --- smoothing (filters.smoothing)

    def last_frame(self, filtered: Skeleton | None = None) -> Frame:
        """The estimate at the latest frame."""
        state = self._state
        assert state is not None
        skeleton = self._newest or self._empty(state.stamp_ns)
        return self._smoother.frame(state, skeleton, sum(self.counters[name] for name in _BREAKS))

    def link(self, before: Frame, after: Frame) -> Link | None:
        """See :meth:`Smoother.link`."""
        return self._smoother.link(before, after)

    def smoothed(self, frame: Frame, link: Link, later: Frame) -> Frame:
        """See :meth:`Smoother.smoothed`."""
        return self._smoother.smoothed(frame, link, later)

    def results_of(self, frame: Frame) -> tuple[Skeleton, ModelEstimate]:
        """:attr:`filtered` and :attr:`estimate` of a frame."""
        state, skeleton = self._smoother.state_of(frame), frame.skeleton
        estimate = self._output.estimate(state, skeleton.frame_id, skeleton.body)
        return self._output.skeleton(state, skeleton), estimate

    # --- input

    def _measurement(self, skeleton: Skeleton, sensor: str) -> Measurement:
        joints = self.model.joints
        valid = skeleton.valid
        measured = valid[joints]
        corrected = self._centres.corrected(skeleton.positions, valid, skeleton.stamp_ns)
        positions = np.where(measured[:, None], corrected[joints], 0.0)
        states = skeleton.states[joints]
        inferred = np.where(states == _TRACKED, 1.0, INFERRED_FACTOR**2)
        base = model = self._space.base_variance * inferred
        if skeleton.covariances is not None:
            given = skeleton.covariances[joints]
            diagonal = given.diagonal(axis1=1, axis2=2)
            # a sum is finite where all its numbers are
            sound = (diagonal > 0.0).all(axis=1) & (np.abs(given).sum(axis=(1, 2)) < _MAX_COORDINATE**2)
            model = np.where(sound, diagonal.mean(axis=1), model)
        return Measurement(sensor, skeleton.stamp_ns, positions, measured, model, base, skeleton)

    def _in_time(self, measurement: Measurement, state: State) -> bool:
        """Whether to take a frame; a jump of time, a gap or another frame of reference reset the filter."""
        p = self.parameters
        elapsed = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        last = state.sensors.get(measurement.sensor)
        if measurement.skeleton.frame_id != self._frame_id:
            self.counters["frame_changes"] += 1
            self.reset()
        elif elapsed > p.predict_for:
            self.counters["gaps"] += 1
            self._history.clear()
            self._late.clear()
            started = self._poses.first_state(measurement, state)
            if started is None:
                return False  # keep the estimates of person and sensors until a frame shows a trunk
            self._state = started
        elif self._is_known(measurement, state, last):
            self.counters["repeated_stamps"] += 1
            return False
        elif elapsed < -p.late_window:
            jump = elapsed < -max(1.0, 2.0 * p.late_window)
            self.counters["backward_jumps" if jump else "too_late"] += 1
            if jump:
                self.reset()
            return jump
        return True

    def _is_known(self, measurement: Measurement, state: State, last: SensorState | None) -> bool:
        """Whether this sensor's frame of this stamp was taken before."""
        if measurement.stamp_ns > state.stamp_ns:
            return False
        if last is not None and measurement.stamp_ns in last.stamps:
            return True
        own = measurement.sensor, measurement.stamp_ns
        taken = (*self._late, *(each for _, each in self._history))
        return own == self._poses.started_by or any(
            (each.sensor, each.stamp_ns) == own for each in taken if isinstance(each, Measurement)
        )

    def _orientation_in_time(self, measurement: SegmentOrientation, state: State) -> bool:
        """Whether to take an orientation. Its stamp never resets a state that skeletons have started."""
        p = self.parameters
        elapsed = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        alone = state.unplaced and (elapsed > p.predict_for or elapsed < -max(1.0, 2.0 * p.late_window))
        if measurement.frame_id != self._frame_id or (elapsed > p.predict_for and not alone):
            self.counters["orientations_refused"] += 1
            return False
        if alone:
            self.counters["gaps" if elapsed > 0.0 else "backward_jumps"] += 1
            self.reset()
            return True
        known = self._newest_of.get(measurement.source)
        if known is None or measurement.stamp_ns > known:
            self._newest_of[measurement.source] = measurement.stamp_ns
        elif any(
            each.stamp_ns == measurement.stamp_ns and each.source == measurement.source
            for each in (*self._late, *(each for _, each in self._history))
            if isinstance(each, SegmentOrientation)
        ):
            self.counters["repeated_stamps"] += 1
            return False
        if elapsed < -p.late_window:
            self.counters["too_late"] += 1
            return False
        return True

    def _begun_turned(self, measurement: SegmentOrientation) -> bool:
        """Start the body by orientations alone if no skeleton has come for some time; whether it was started."""
        since, stamp_ns = self._turned_since, measurement.stamp_ns
        if since is None or abs(stamp_ns - since) > _START_AFTER_NS + NANOSECONDS:
            self._turned_only, since = {}, stamp_ns
        self._turned_since = since = min(since, stamp_ns)
        latest = self._turned_only.get(measurement.source)
        if latest is None or latest.stamp_ns < stamp_ns:
            self._turned_only[measurement.source] = measurement
        seen = self._waiting and abs(self._waiting[-1].stamp_ns - stamp_ns) < _START_AFTER_NS
        if seen or stamp_ns - since < _START_AFTER_NS:
            return False
        together = [each for each in self._turned_only.values() if each.frame_id == measurement.frame_id]
        self._frame_id = measurement.frame_id
        self._turned_only, self._turned_since, self._waiting = {}, None, []
        q = pose_of(self.model, self._space.ranges, together)
        unseen = np.full(self._space.points, np.inf)
        state = self._poses.new_state(measurement.stamp_ns, q, self.model.default_lengths(), unseen, None)
        covariance = state.covariance.copy()
        covariance[:3, :3] = _UNPLACED_STDDEV**2 * _EYE3
        covariance[3:6, 3:6] = _UNTURNED_STDDEV**2 * _EYE3
        self._state = self._remember(state.but(covariance=covariance, unplaced=True), measurement)
        return True

    def _placed(self, measurement: Measurement) -> bool:
        """Restart with skeletons a body that orientations alone had started; whether it was restarted."""
        self._history.clear()
        self._late.clear()
        began = self._begun(measurement)
        if began is None:
            return False
        self._frame_id, self._newest = measurement.skeleton.frame_id, measurement.skeleton
        self._state, self._newest_of = began, {}
        return True

    # --- time

    @property
    def _state(self) -> State | None:
        """The state after all measurements, late ones included; None before the start."""
        if self._late and self._last is not None:
            self._last = self._replay(self._last)
        return self._last

    @_state.setter
    def _state(self, state: State | None) -> None:
        self._last = state

    def _is_late(self, measurement: Measurement | SegmentOrientation, state: State) -> bool:
        """Whether a measurement precedes one that was processed already."""
        if measurement.stamp_ns < state.stamp_ns:
            return True
        return bool(self._history) and _order(self._history[-1][1]) > _order(measurement)

    def _is_awaited(self, measurement: Measurement) -> bool:
        """Whether queued orientations are to be processed after this frame."""
        return any(
            isinstance(each, SegmentOrientation) and each.stamp_ns >= measurement.stamp_ns for each in self._late
        )

    def _remember(self, state: State, measurement: Measurement | SegmentOrientation) -> State:
        """Process a measurement, and keep it with the state before it, for a replay with late measurements."""
        horizon = measurement.stamp_ns - self.parameters.late_window * NANOSECONDS
        while self._history and self._history[0][1].stamp_ns < horizon:
            self._history.popleft()
        self._history.append((state, measurement))
        return self._step(state, measurement)

    def _replay(self, state: State, until_ns: int | None = None) -> State:
        """Go back to the state before the first late measurement, and process it and all later ones in order.

        A connection that stalls delivers many measurements at once: one replay serves them all.

        Args:
            state: the latest one.
            until_ns: measurements after this time stay queued; None to process all.
        """
        oldest_ns = self._history[0][0].stamp_ns if self._history else state.stamp_ns
        late = [each for each in self._late if each.stamp_ns >= oldest_ns]  # others are older than the history
        self._late = []
        if until_ns is not None:
            self._late = [each for each in late if each.stamp_ns > until_ns]
            late = [each for each in late if each.stamp_ns <= until_ns]
        if not late:
            return state
        first = min(map(_order, late))
        again = []
        while self._history and _order(self._history[-1][1]) > first:
            state, measurement = self._history.pop()
            again.append(measurement)
        self.counters["taken_again"] += len(again)
        # the sort is stable: of frames with the same stamp, late ones come last
        for measurement in sorted(again[::-1] + late, key=_order):
            state = self._remember(state, measurement)
        return state

    def _step(self, state: State, measurement: Measurement | SegmentOrientation) -> State:
        if isinstance(measurement, SegmentOrientation):
            try:
                return self._orientations.oriented(state, measurement)
            except np.linalg.LinAlgError:
                self.counters["broken_covariances"] += 1
                unseen = np.full(self._space.points, np.inf)
                anew = self._poses.new_state(state.stamp_ns, state.q, state.lengths, unseen, None)
                return anew.but(sensors=state.sensors, unplaced=state.unplaced)
        from_ns = self._lengths_from_ns
        if from_ns is not None and state.stamp_ns < from_ns <= measurement.stamp_ns and state.seen is not None:
            # a T-pose has corrected the joint centres: the lengths measured before it are void
            state = state.but(seen=SegmentLengths(self.parameters.slow_time))
        state = self._motion.predicted(state, measurement.stamp_ns)
        if state.sources.names:
            state, skeleton = self._facing.corrected(state, measurement.skeleton)
            if skeleton is not measurement.skeleton:
                measurement = self._measurement(skeleton, measurement.sensor)
            measurement = self._orientations.without_thumbs(state, measurement)
        try:
            return self._skeletons.taken(state, measurement)
        except np.linalg.LinAlgError:
            # Rounding, or absurd input, has made the covariance indefinite: discard it.
            self.counters["broken_covariances"] += 1
            learnt = state.sensors
            unseen = np.full(self._space.points, np.inf)
            return self._poses.first_state(measurement, None, learnt) or self._poses.new_state(
                state.stamp_ns, state.q, state.lengths, unseen, None
            ).but(sensors=learnt)

    def _begun(self, measurement: Measurement) -> State | None:
        """The state after the first frames; None until one sensor has enough of them for an estimate of its noise."""
        if self._waiting and abs(measurement.stamp_ns - self._waiting[-1].stamp_ns) > _WAIT_NS:
            self._waiting.clear()
        if any((each.sensor, each.stamp_ns) == (measurement.sensor, measurement.stamp_ns) for each in self._waiting):
            self.counters["repeated_stamps"] += 1
            return None
        self._waiting.append(measurement)
        self._waiting.sort(key=lambda each: each.stamp_ns)
        by_sensor = [each for each in self._waiting if each.sensor == measurement.sensor]
        if len(by_sensor) < _START_FRAMES:
            return None
        alone = len(by_sensor) == len(self._waiting)
        sensors: dict[str, SensorState] = {}
        for each in self._waiting:
            known = sensors.get(each.sensor) or self._sensors.unknown(each, alone)
            known = self._sensors.seen_by(known, each, each.measured, sensors)
            slow = max(known.slow, self._sensors.least_slow(known.white, each))
            sensors[each.sensor] = known.but(slow=slow)
        # keep the noise only: the frames themselves are processed below
        learnt = {
            name: sensor.but(stamps=(), positions=sensor.positions[:0], least_stated=np.inf)
            for name, sensor in sensors.items()
        }
        first, *others = self._waiting
        self._waiting = []
        state = self._poses.first_state(first, None, learnt)
        for each in others:
            state = self._remember(state, each) if state is not None else self._poses.first_state(each, None, learnt)
        return state

    # --- output

    def _body(self) -> int:
        return 0 if self._newest is None else self._newest.body

    def _empty(self, stamp_ns: int) -> Skeleton:
        """A frame without any tracked joint."""
        nowhere, unseen = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, dtype=np.uint8)
        return Skeleton(stamp_ns, self._frame_id, nowhere, unseen, self._body())


def _order(measurement: Measurement | SegmentOrientation) -> tuple[int, str]:
    """Sort key: the stamp; with the same stamp, frames come before orientations."""
    return measurement.stamp_ns, measurement.source if isinstance(measurement, SegmentOrientation) else ""


def prepare() -> None:
    """Compile all functions for frames, or load them from the cache, by filtering frames of a person standing still."""
    estimator = ExtendedKalmanFilter()
    positions = np.full((N_JOINTS, 3), np.nan)
    model = estimator.model
    positions[model.joints] = model.forward(model.neutral(), model.default_lengths()).positions
    states = np.full(N_JOINTS, _TRACKED)
    covariances = np.full((N_JOINTS, 3, 3), 1e-4 * _EYE3)
    for number in range(_PREPARED):
        stamp_ns = number * NANOSECONDS // 30
        estimator.take(Skeleton(stamp_ns, "", positions, states, covariances=covariances))
    assert estimator.filtered is not None
    forward_substituted(np.eye(3), whitening_of(np.eye(3)))  # orientations and the smoother call them directly
