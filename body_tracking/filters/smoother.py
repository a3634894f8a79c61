"""Smoothers on the body model: estimates that also use later frames.

Both run :class:`~body_tracking.filters.ekf.ExtendedKalmanFilter` forward and the smoother of Rauch, Tung and Striebel
backward over its states (Sarkka 2013, "Bayesian Filtering and Smoothing", theorem 8.2; on a manifold: Barfoot 2017,
"State Estimation for Robotics", section 8.2): for offline use over the whole recording, as a filter of a fixed lag over
the last frames.

    x_s(k) = x_f(k) (+) G (x_s(k+1) (-) x_p(k+1)),  G = P_f F^T P_p^-1,  P_s(k) = P_f + G (P_s(k+1) - P_p) G^T

The error state is that of the filter (tangent, lengths, velocities) together with the slow errors of the sensors, which
the filter considers without estimating them (Schmidt); later it also only considers the lengths. The equations still
hold: with all persistent errors in the state, the errors are a Markov process, whatever the filter's gains. As the
gains of a Schmidt filter are not optimal, a smoothed variance may be some percent larger than the filtered one.

A known weakness: the pitch of the pelvis, and lumbar flexion with it, are observed over a lever of 3 cm. With 20 mm of
noise they are far from linear, and the smoother's variance is too small: its 95 % interval holds the truth in about
70 %, that of all other angles in 84 % (eight simulated people); forearms and wrists are the worst.

The filter rejects outliers. A restarted pose is independent of the states before, so each stretch between restarts is
smoothed separately.

Over 500 lines: the forward and backward recursions share their state and are read together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack

from body_tracking.calibration.joint_centres import Snapshot
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, Skeleton
from body_tracking.filters.ekf import EkfParameters, ExtendedKalmanFilter
from body_tracking.filters.ekf.state import Measurement, State
from body_tracking.filters.linear import FilterError
from body_tracking.kinematics.upper_body import UpperBody

_SECTION = 200
"""Frames between two stored states of a recording; the frames between them are filtered again."""


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A smoothed recording, in the order of the input frames.

    Attributes:
        skeletons: the modelled joints at each frame's stamp with covariances and velocities; None where a frame shows
            no person yet or repeats another one.
        estimates: the model state of each of them.
        stretches: (n,) number of the frame's stretch without a restart; -1 where there is no skeleton.
        counters: of the filter, for diagnostics.
    """

    skeletons: tuple[Skeleton | None, ...]
    estimates: tuple[ModelEstimate | None, ...]
    stretches: IntArray
    counters: dict[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """The smoothed state at one frame.

    Attributes:
        state: smoothed, with the covariance of the filter.
        sensors: whose slow errors are part of it.
        slow: (m,) smoothed slow errors, in units of their deviation.
        covariance: (85 + m, 85 + m) of the state and the slow errors.
    """

    state: State
    sensors: tuple[str, ...]
    slow: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """The transition from a state to the next one.

    Attributes:
        sensors: with slow errors in both states.
        predicted: the next state, predicted from this one.
        covariance: (85 + m, 85 + m) of that and the slow errors.
        gain: (85 + m', 85 + m) of the smoother; m' is the number of slow errors of all sensors in this state.
    """

    sensors: tuple[str, ...]
    predicted: State
    covariance: FloatArray
    gain: FloatArray


class _Backward:
    """The backward recursion over the states of a filter."""

    def __init__(self, ekf: ExtendedKalmanFilter) -> None:
        self._ekf = ekf
        space = ekf._space
        self._tangent, self._lengths, self._velocities = space.tangent, space.lengths, space.velocities
        self._size = space.size

    def starts(self, state: State) -> bool:
        """Whether a pose was just started: only prediction correlates it with its velocity."""
        return not state.covariance[self._tangent, self._velocities].any()

    def link(self, state: State, following: State) -> _Link | None:
        """The transition between two states in a row; None where the second one is a start."""
        if self.starts(following):
            return None
        ekf = self._ekf
        # in double precision: numerator and denominator of the gain must agree to more than seven digits
        precise = state.but(crosses=state.crosses.astype(np.float64))
        predicted = ekf._motion.predicted(precise, following.stamp_ns)
        known = state.slow_names
        shared = tuple(name for name in known if name in following.slow_names)
        covariance = self._joint(predicted, shared)
        moved = self._moved(state, following.stamp_ns, self._joint(state, known))
        columns = self._columns(state, known, shared)
        return _Link(shared, predicted, covariance, _divided(moved[columns].T, covariance))

    def last(self, state: State) -> _Posterior:
        """The posterior of the last state of a stretch, which is the filtered one."""
        covariance = self._joint(state, state.slow_names)
        return _Posterior(state, state.slow_names, np.zeros(len(covariance) - self._size), covariance)

    def step(self, state: State, link: _Link, following: _Posterior) -> _Posterior:
        """Smooth a state, given the smoothed next one."""
        model = self._ekf.model
        predicted, after = link.predicted, following.state
        columns = self._columns(after, following.sensors, link.sensors)
        difference = np.concatenate(
            [
                model.difference(predicted.q, after.q),
                after.lengths - predicted.lengths,
                after.velocity - predicted.velocity,
                following.slow[columns[self._size :] - self._size],
            ]
        )
        known = state.slow_names
        correction = link.gain @ difference
        reduction = following.covariance[np.ix_(columns, columns)] - link.covariance
        covariance = self._joint(state, known) + link.gain @ reduction @ link.gain.T
        covariance = 0.5 * (covariance + covariance.T)
        smoothed = replace(
            state,
            q=model.integrate(state.q, correction[self._tangent]),
            lengths=state.lengths + correction[self._lengths],
            velocity=state.velocity + correction[self._velocities],
        )
        return _Posterior(smoothed, known, correction[self._size :], covariance)

    def output(self, posterior: _Posterior, skeleton: Skeleton) -> tuple[Skeleton, ModelEstimate]:
        """Skeleton and estimate of a smoothed state; ``skeleton`` is the measured frame."""
        state = replace(posterior.state, covariance=posterior.covariance[: self._size, : self._size])
        estimate = self._ekf._output.estimate(state, skeleton.frame_id, skeleton.body)
        return self._ekf._output.skeleton(state, skeleton), estimate

    def _joint(self, state: State, sensors: tuple[str, ...]) -> FloatArray:
        """Joint covariance of a state and the slow errors of these sensors, in units of their deviation."""
        crosses = [cross for name in sensors if (cross := state.cross(name)) is not None]
        n = self._size
        joint = np.eye(n + sum(cross.shape[1] for cross in crosses))
        joint[:n, :n] = state.covariance
        if crosses:
            joint[:n, n:] = np.concatenate(crosses, axis=1)
            joint[n:, :n] = joint[:n, n:].T
        return joint

    def _moved(self, state: State, stamp_ns: int, errors: FloatArray) -> FloatArray:
        """Errors (85 + m, ...) of a state, predicted to a later time by the filter's motion model."""
        parameters = self._ekf.parameters
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        fade = np.exp(-dt / parameters.velocity_time)
        reach = parameters.velocity_time * (1.0 - fade)
        moved = errors.copy()
        moved[self._tangent] = self._ekf._motion.turning_back(reach * state.velocity) @ errors[self._tangent]
        moved[self._tangent] += reach * errors[self._velocities]
        moved[self._velocities] *= fade
        moved[self._size :] *= np.exp(-dt / parameters.slow_time)
        return moved

    def _columns(self, state: State, known: tuple[str, ...], wanted: tuple[str, ...]) -> IntArray:
        """Indices of the state and of the wanted sensors' slow errors among those of the known sensors."""
        columns = [np.arange(self._size)]
        place = self._size
        for name in known:
            cross = state.cross(name)
            count = 0 if cross is None else cross.shape[1]
            if name in wanted:
                columns.append(place + np.arange(count))
            place += count
        return np.concatenate(columns).astype(np.intp)


def _divided(numerator: FloatArray, covariance: FloatArray) -> FloatArray:
    """``numerator @ inv(covariance)`` for a positive definite matrix."""
    factor, failed = lapack.dpotrf(covariance, lower=1)
    if failed:  # singular to rounding
        result: FloatArray = numerator @ np.linalg.pinv(covariance, hermitian=True)
        return result
    solution, _ = lapack.dpotrs(factor, numerator.T, lower=1)
    return np.ascontiguousarray(solution.T)


# --- recordings


def smooth(
    skeletons: Sequence[tuple[str, Skeleton]],
    parameters: EkfParameters | None = None,
    model: UpperBody | None = None,
    progress: Callable[[float], None] | None = None,
    learn: bool = True,
) -> Smoothed:
    """Smooth the recording of one person.

    A first pass estimates lengths and noise; with these as initial values the recording is filtered again and smoothed
    backward. The memory besides the result hardly grows with the length of the recording.

    Args:
        skeletons: each with its sensor's name, in a fixed frame of reference with z up; sorted by stamp here.
        parameters: of the filter.
        model: the body.
        progress: called repeatedly with the completed share, from 0 to 1.
        learn: False omits the first pass, so that the forward pass equals the live filter.
    """
    order = sorted(range(len(skeletons)), key=lambda k: skeletons[k][1].stamp_ns)
    passes = 3 if learn else 2
    total = passes * len(order)

    def report(done: int) -> None:
        if progress is not None and (done % _SECTION == 0 or done == total):
            progress(done / max(total, 1))

    ekf = ExtendedKalmanFilter(parameters, model)
    if learn:
        learnt = _learn(ekf, (skeletons[k] for k in order), report)
        # the joint centres by a T-pose at any time hold for the whole recording
        centres = ekf._centres.snapshot().as_long_known()
        ekf._centres.restore(centres)
        again = ExtendedKalmanFilter(replace(ekf.parameters, t_pose=False), ekf.model)
        forward = _Forward(again, learnt, centres)
    else:
        forward = _Forward(ekf)
    kept = [(0, forward.snapshot())]
    for number, k in enumerate(order):
        # not while the filter waits for a start: the snapshot does not include the waiting frames
        if number >= kept[-1][0] + _SECTION and forward.snapshot()[0] is not None:
            kept.append((number, forward.snapshot()))
        forward.take(*skeletons[k])
        report((passes - 2) * len(order) + number + 1)
    counters = dict(ekf.counters)

    backward = _Backward(ekf)
    found: list[tuple[Skeleton, ModelEstimate] | None] = [None] * len(order)
    last_of_stretch = np.zeros(len(order), dtype=np.intp)
    following: _Posterior | None = None
    filtered: State | None = None
    end = len(order)
    for first, place in reversed(kept):
        forward.restore(place)
        states = [forward.take(*skeletons[k]) for k in order[first:end]]
        end = first
        for number in reversed(range(len(states))):
            state, k = states[number], order[first + number]
            if state is not None:
                link = None if filtered is None else backward.link(state, filtered)
                if link is None or following is None:
                    following = backward.last(state)
                    last_of_stretch[first + number] = 1
                else:
                    following = backward.step(state, link, following)
                filtered = state
                found[k] = backward.output(following, skeletons[k][1])
            report(total - first - number)
    known = np.array([found[k] is not None for k in order], dtype=np.bool_)
    stretches = np.empty(len(order), dtype=np.intp)
    stretches[order] = np.where(known, np.cumsum(last_of_stretch) - last_of_stretch, -1)
    return Smoothed(
        tuple(None if pair is None else pair[0] for pair in found),
        tuple(None if pair is None else pair[1] for pair in found),
        stretches,
        counters,
    )


def _learn(
    ekf: ExtendedKalmanFilter, frames: Iterable[tuple[str, Skeleton]], report: Callable[[int], None]
) -> State | None:
    """Person and sensors as estimated in a pass over all frames; None where there is no person."""
    best: State | None = None
    start: State | None = None
    for number, (sensor, skeleton) in enumerate(frames):
        ekf.update(skeleton, sensor)
        state = ekf._state
        if state is not None:
            start = start or state
            if best is None or state.tracked >= best.tracked:
                best = state
        report(number + 1)
    if best is None or start is None:
        return None
    sensors = {
        name: replace(sensor, stamps=(), positions=sensor.positions[:0]) for name, sensor in best.sensors.items()
    }
    # The lengths come from the frames of the next pass: they are considered, not estimated, to use the frames once. The
    # noise density is estimated again: that of the end, or the average, gives too small variances in between.
    return replace(
        best,
        log_density=start.log_density,
        sensors=sensors,
        slow_names=(),
        crosses=best.crosses[:, :0],
        settled=True,
        seen=None,
    )


class _Forward:
    """A filter that can be restored to an earlier state, and starts every person from the learnt one."""

    def __init__(self, ekf: ExtendedKalmanFilter, learnt: State | None = None, centres: Snapshot | None = None) -> None:
        self._ekf = ekf
        self._learnt, self._centres = learnt, centres
        if centres is not None:
            ekf._centres.restore(centres)
        # as if the person had been out of sight for longer than ``predict_for``
        self._absence_ns = round((ekf.parameters.predict_for + 1.0) * NANOSECONDS)

    def take(self, sensor: str, skeleton: Skeleton) -> State | None:
        """The state after a frame; None where the frame changed nothing."""
        ekf = self._ekf
        if self._learnt is not None and (ekf._state is None or ekf._frame_id != skeleton.frame_id):
            ekf.reset()
            if self._centres is not None:
                ekf._centres.restore(self._centres)
            ekf._state = replace(self._learnt, stamp_ns=skeleton.stamp_ns - self._absence_ns)
            ekf._frame_id = skeleton.frame_id
        before = ekf._state
        ekf.update(skeleton, sensor)
        return None if ekf._state is before else ekf._state

    def snapshot(self) -> tuple[State | None, str, Snapshot]:
        """State for :meth:`restore`."""
        return self._ekf._state, self._ekf._frame_id, self._ekf._centres.snapshot()

    def restore(self, place: tuple[State | None, str, Snapshot]) -> None:
        """Continue from an earlier snapshot."""
        self._ekf.reset()
        self._ekf._state, self._ekf._frame_id, centres = place
        self._ekf._centres.restore(centres)


# --- live


@dataclass(slots=True, eq=False)
class _Frame:
    """A frame that is still to be returned.

    Attributes:
        state: filtered, at this frame.
        skeleton: as measured.
        link: to the next frame; None for the newest one, and where a stretch ends.
    """

    state: State
    skeleton: Skeleton
    link: _Link | None = None


class FixedLagSmoother:
    """The filter ``ekf`` with a fixed-lag smoother.

    Each call takes one frame and returns the oldest one that is due: one that is older than the newest by the lag. No
    frame is skipped; where frames become rarer, the lag grows to the time of as many frames.

    Attributes:
        lag_s: seconds.
        filter: the filter, without lag.
        counters: the filter's.
    """

    def __init__(
        self, lag_s: float = 0.2, parameters: EkfParameters | None = None, model: UpperBody | None = None
    ) -> None:
        """Set up without a frame.

        Raises:
            FilterError: a lag that is negative or not finite.
        """
        if not 0.0 <= lag_s < np.inf:
            raise FilterError(f"smoother lag: {lag_s!r} s, expected a number from 0")
        self.lag_s = lag_s
        self.filter = ExtendedKalmanFilter(parameters, model)
        self.counters = self.filter.counters
        self._backward = _Backward(self.filter)
        self._lag_ns = round(lag_s * NANOSECONDS)
        self._frames: list[_Frame] = []
        self._output_ns: int | None = None
        self._estimate: ModelEstimate | None = None

    def reset(self) -> None:
        """Forget the person and the frames still to be returned; the counters stay."""
        self.filter.reset()
        self._frames.clear()
        self._output_ns = None
        self._estimate = None

    @property
    def estimate(self) -> ModelEstimate | None:
        """The state of the model of the last returned skeleton; None before the first one."""
        return self._estimate

    def update(self, skeleton: Skeleton, sensor: str = "") -> Skeleton | None:
        """Take one frame.

        Args:
            skeleton: as for the filter.
            sensor: its sensor's name.

        Returns:
            The smoothed skeleton of a frame about the lag ago, or None while none is due.
        """
        before = self.filter._state
        self.filter.update(skeleton, sensor)
        state = self.filter._state
        if state is not None and state is not before:
            if skeleton.stamp_ns < state.stamp_ns:
                self._insert(skeleton)
            else:
                if self._output_ns is not None and skeleton.stamp_ns < self._output_ns:
                    self._output_ns = None  # time jumped back
                self._append(state, skeleton, follows=before is not None)
        if not self._frames:
            return None
        count = self._stretch()
        newest_ns = self._frames[-1].state.stamp_ns
        if count == len(self._frames) and self._frames[0].state.stamp_ns > newest_ns - self._lag_ns:
            return None
        *_, posterior = self._smoothed(self._frames[:count])
        frame = self._frames.pop(0)
        self._output_ns = frame.state.stamp_ns
        result, self._estimate = self._backward.output(posterior, frame.skeleton)
        return result

    def flush(self) -> list[tuple[Skeleton, ModelEstimate]]:
        """The frames still to be returned, oldest first, each smoothed by all later ones."""
        outputs: list[tuple[Skeleton, ModelEstimate]] = []
        while self._frames:
            count = self._stretch()
            stretch, self._frames = self._frames[:count], self._frames[count:]
            posteriors = list(self._smoothed(stretch))
            outputs += [
                self._backward.output(posterior, frame.skeleton)
                for frame, posterior in zip(stretch, reversed(posteriors), strict=True)
            ]
        if outputs:
            self._output_ns, self._estimate = outputs[-1][0].stamp_ns, outputs[-1][1]
        return outputs

    def _append(self, state: State, skeleton: Skeleton, follows: bool = True) -> None:
        if self._frames and follows:
            self._frames[-1].link = self._backward.link(self._frames[-1].state, state)
        self._frames.append(_Frame(state, skeleton))

    def _insert(self, late: Skeleton) -> None:
        """Replace the states that the filter computed again for a late frame."""
        while self._frames and self._frames[-1].state.stamp_ns > late.stamp_ns:
            self._frames.pop()
        history = [(state, each) for state, each in self.filter._history if isinstance(each, Measurement)]
        newest = self.filter._state
        assert newest is not None
        # a late frame that became the first one of the start is not in the history
        first = next((k for k, (_, measurement) in enumerate(history) if measurement.skeleton is late), 0)
        states = [*(state for state, _ in history[first + 1 :]), newest]
        for state, (_, measurement) in zip(states, history[first:], strict=True):
            if self._output_ns is None or state.stamp_ns > self._output_ns:
                self._append(state, measurement.skeleton)

    def _stretch(self) -> int:
        """Number of linked frames, from the oldest on."""
        return 1 + next(k for k, frame in enumerate(self._frames) if frame.link is None)

    def _smoothed(self, stretch: list[_Frame]) -> Iterator[_Posterior]:
        """The smoothed states of a stretch, newest first."""
        posterior = self._backward.last(stretch[-1].state)
        yield posterior
        for frame in reversed(stretch[:-1]):
            assert frame.link is not None
            posterior = self._backward.step(frame.state, frame.link, posterior)
            yield posterior
