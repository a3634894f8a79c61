"""Smoothers on the body model: what the frames after an instant say of it, too.

Both run :class:`~body_tracking.filters.ekf.ExtendedKalmanFilter` forward and the smoother of Rauch, Tung and Striebel
backward over its states (Sarkka 2013, "Bayesian Filtering and Smoothing", theorem 8.2; on a manifold: Barfoot 2017,
"State Estimation for Robotics", section 8.2): for offline use over the whole recording, as a filter of a fixed lag over
the last frames.

    x_s(k) = x_f(k) (+) G (x_s(k+1) (-) x_p(k+1)),  G = P_f F^T P_p^-1,  P_s(k) = P_f + G (P_s(k+1) - P_p) G^T

The error state is that of the filter (tangent, lengths, velocities) together with the slow errors of the sensors. The
filter considers these, and from some time on the lengths, without estimating them. The equations hold all the same:
with the errors of everything that persists in the state, the error of a filtered state is tied to later ones through
the next state alone, whatever gains the filter took. But as gains of a filter that only considers are not the best
ones, a smoothed variance may now and then be larger than the filtered one, by some percent.

A known weakness: the pitch of the pelvis, and lumbar flexion with it, are seen on a lever of 3 cm. With 20 mm of noise
they are far from linear, and the smoother is too sure of them: the truth is in its 95 % band in about 70 %. Of all
other angles it is in 84 % (eight simulated people); forearms and wrists are the worst.

What is an outlier is the filter's affair. A pose that starts anew has no tie to what was before, so that each such
stretch is smoothed by itself.

Over 500 lines: the recursions forwards and backwards share their state and are read side by side.
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
"""Frames between two states that are kept of a recording; those between them are filtered once more."""


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A smoothed recording, frame by frame in the order in which it was given.

    Attributes:
        skeletons: the modelled joints at each frame's stamp with covariances and velocities; None where a frame shows
            no person yet or repeats another one.
        estimates: the model state that belongs to each of them.
        stretches: (n,) number of the stretch without a break that the frame lies in; -1 where there is no skeleton.
        counters: what happened when the frames were filtered, for diagnostics.
    """

    skeletons: tuple[Skeleton | None, ...]
    estimates: tuple[ModelEstimate | None, ...]
    stretches: IntArray
    counters: dict[str, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """What all frames say of the state after one of them.

    Attributes:
        state: smoothed, but for its covariance as it was filtered.
        sensors: whose slow errors are part of it.
        slow: (m,) their smoothed values, in units of their deviation.
        covariance: (85 + m, 85 + m) of the state and the slow errors.
    """

    state: State
    sensors: tuple[str, ...]
    slow: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Link:
    """How a state is tied to the next one.

    Attributes:
        sensors: whose slow errors are known of both.
        predicted: the next state as it is expected from this one.
        covariance: (85 + m, 85 + m) of that and the slow errors.
        gain: (85 + m', 85 + m) the smoother's; m' counts the slow errors of all sensors that this state has to do with.
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
        """Whether a pose was just started: nothing but passing time ties it to its velocity."""
        return not state.covariance[self._tangent, self._velocities].any()

    def link(self, state: State, following: State) -> _Link | None:
        """The tie of two states in a row; None where the second one is a start."""
        if self.starts(following):
            return None
        ekf = self._ekf
        # in double precision, as what it is divided by must be the same as what moves to more than seven digits
        precise = state.but(crosses=state.crosses.astype(np.float64))
        predicted = ekf._motion.predicted(precise, following.stamp_ns)
        known = _sensors(state)
        shared = tuple(name for name in known if name in _sensors(following))
        covariance = self._joint(predicted, shared)
        moved = self._moved(state, following.stamp_ns, self._joint(state, known))
        columns = self._columns(state, known, shared)
        return _Link(shared, predicted, covariance, _divided(moved[columns].T, covariance))

    def last(self, state: State) -> _Posterior:
        """Where nothing comes after, the filtered state is the smoothed one."""
        known = _sensors(state)
        covariance = self._joint(state, known)
        return _Posterior(state, known, np.zeros(len(covariance) - self._size), covariance)

    def step(self, state: State, link: _Link, following: _Posterior) -> _Posterior:
        """Smooth a state by the smoothed next one."""
        model = self._ekf.model
        predicted, after = link.predicted, following.state
        columns = self._columns(after, following.sensors, link.sensors)
        news = np.concatenate(
            [
                model.difference(predicted.q, after.q),
                after.lengths - predicted.lengths,
                after.velocity - predicted.velocity,
                following.slow[columns[self._size :] - self._size],
            ]
        )
        known = _sensors(state)
        correction = link.gain @ news
        learnt = following.covariance[np.ix_(columns, columns)] - link.covariance
        covariance = self._joint(state, known) + link.gain @ learnt @ link.gain.T
        covariance = 0.5 * (covariance + covariance.T)
        smoothed = replace(
            state,
            q=model.integrate(state.q, correction[self._tangent]),
            lengths=state.lengths + correction[self._lengths],
            velocity=state.velocity + correction[self._velocities],
        )
        return _Posterior(smoothed, known, correction[self._size :], covariance)

    def output(self, posterior: _Posterior, skeleton: Skeleton) -> tuple[Skeleton, ModelEstimate]:
        """What is told of a smoothed state; ``skeleton`` is the frame that was measured."""
        state = replace(posterior.state, covariance=posterior.covariance[: self._size, : self._size])
        estimate = self._ekf._output.estimate(state, skeleton.frame_id, skeleton.body)
        return self._ekf._output.skeleton(state, skeleton), estimate

    def _joint(self, state: State, sensors: tuple[str, ...]) -> FloatArray:
        """Covariance of a state and the slow errors of these sensors, which are in units of their deviation."""
        crosses = [cross for name in sensors if (cross := state.cross(name)) is not None]
        n = self._size
        joint = np.eye(n + sum(cross.shape[1] for cross in crosses))
        joint[:n, :n] = state.covariance
        if crosses:
            joint[:n, n:] = np.concatenate(crosses, axis=1)
            joint[n:, :n] = joint[:n, n:].T
        return joint

    def _moved(self, state: State, stamp_ns: int, errors: FloatArray) -> FloatArray:
        """Errors (85 + m, ...) of a state as they are at a later time: those of the filter's motion model."""
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
        """Where the state and the slow errors of the wanted sensors lie, among those of the known ones."""
        columns = [np.arange(self._size)]
        place = self._size
        for name in known:
            cross = state.cross(name)
            count = 0 if cross is None else cross.shape[1]
            if name in wanted:
                columns.append(place + np.arange(count))
            place += count
        return np.concatenate(columns).astype(np.intp)


def _sensors(state: State) -> tuple[str, ...]:
    """The sensors whose slow errors a state has to do with."""
    return state.slow_names


def _divided(numerator: FloatArray, covariance: FloatArray) -> FloatArray:
    """``numerator @ inv(covariance)`` for a positive definite matrix."""
    factor, failed = lapack.dpotrf(covariance, lower=1)
    if failed:  # something is known exactly, as far as the numbers go
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

    It is filtered once to learn the lengths and the noise; with these from the start it is filtered again, and smoothed
    from its end. The memory needed besides the result hardly grows with the length of the recording.

    Args:
        skeletons: each with its sensor's name, in a fixed frame of reference with z up; they are taken in the order of
            their stamps.
        parameters: of the filter.
        model: the body.
        progress: called now and then with the share that is done, from 0 to 1.
        learn: False leaves out the first run, so that the forward pass is what the filter says live.
    """
    order = sorted(range(len(skeletons)), key=lambda k: skeletons[k][1].stamp_ns)
    passes = 3 if learn else 2
    total = passes * len(order)

    def tell(done: int) -> None:
        if progress is not None and (done % _SECTION == 0 or done == total):
            progress(done / max(total, 1))

    ekf = ExtendedKalmanFilter(parameters, model)
    if learn:
        learnt = _learnt(ekf, (skeletons[k] for k in order), tell)
        # what a T-pose told at any time holds all the time
        centres = ekf._centres.snapshot().as_long_known()
        ekf._centres.restore(centres)
        again = ExtendedKalmanFilter(replace(ekf.parameters, t_pose=False), ekf.model)
        forward = _Forward(again, learnt, centres)
    else:
        forward = _Forward(ekf)
    kept = [(0, forward.place())]
    for number, k in enumerate(order):
        # not while the filter waits for a start, about which the place says nothing
        if number >= kept[-1][0] + _SECTION and forward.place()[0] is not None:
            kept.append((number, forward.place()))
        forward.take(*skeletons[k])
        tell((passes - 2) * len(order) + number + 1)
    counters = dict(ekf.counters)

    backward = _Backward(ekf)
    found: list[tuple[Skeleton, ModelEstimate] | None] = [None] * len(order)
    last_of_stretch = np.zeros(len(order), dtype=np.intp)
    following: _Posterior | None = None
    filtered: State | None = None
    end = len(order)
    for first, place in reversed(kept):
        forward.go_back(place)
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
            tell(total - first - number)
    known = np.array([found[k] is not None for k in order], dtype=np.bool_)
    stretches = np.empty(len(order), dtype=np.intp)
    stretches[order] = np.where(known, np.cumsum(last_of_stretch) - last_of_stretch, -1)
    return Smoothed(
        tuple(None if pair is None else pair[0] for pair in found),
        tuple(None if pair is None else pair[1] for pair in found),
        stretches,
        counters,
    )


def _learnt(
    ekf: ExtendedKalmanFilter, frames: Iterable[tuple[str, Skeleton]], tell: Callable[[int], None]
) -> State | None:
    """What a run over all frames finds out about the person and the sensors; None where it sees no person."""
    best: State | None = None
    start: State | None = None
    for number, (sensor, skeleton) in enumerate(frames):
        ekf.update(skeleton, sensor)
        state = ekf._state
        if state is not None:
            start = start or state
            if best is None or state.tracked >= best.tracked:
                best = state
        tell(number + 1)
    if best is None or start is None:
        return None
    sensors = {
        name: replace(sensor, stamps=(), positions=sensor.positions[:0]) for name, sensor in best.sensors.items()
    }
    # The lengths come from the very frames that follow: they are considered, as estimates would count these twice. How
    # briskly the person moves is found anew: what suits the end, or the average, is too sure of itself in between.
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
    """A filter that can be put back to an earlier place, and that never forgets what was learnt before."""

    def __init__(self, ekf: ExtendedKalmanFilter, learnt: State | None = None, centres: Snapshot | None = None) -> None:
        self._ekf = ekf
        self._learnt, self._centres = learnt, centres
        if centres is not None:
            ekf._centres.restore(centres)
        # as if the person had been out of sight for longer than is predicted
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

    def place(self) -> tuple[State | None, str, Snapshot]:
        """From where to go on."""
        return self._ekf._state, self._ekf._frame_id, self._ekf._centres.snapshot()

    def go_back(self, place: tuple[State | None, str, Snapshot]) -> None:
        """Go on from an earlier place."""
        self._ekf.reset()
        self._ekf._state, self._ekf._frame_id, centres = place
        self._ekf._centres.restore(centres)


# --- live


@dataclass(slots=True, eq=False)
class _Frame:
    """A frame that is not told yet.

    Attributes:
        state: after it.
        skeleton: as measured.
        link: to the next one; None for the newest, and where a stretch ends.
    """

    state: State
    skeleton: Skeleton
    link: _Link | None = None


class FixedLagSmoother:
    """The filter ``ekf`` that waits for some frames more before it tells a state.

    Each frame goes in at once and the oldest one that is due comes out: one that is older than the newest by the lag.
    No frame is left out; where frames become rarer, the lag grows to the time that as many frames take.

    Attributes:
        lag_s: seconds.
        filter: the filter that runs ahead; its ``estimate`` is of now.
        counters: the filter's.
    """

    def __init__(
        self, lag_s: float = 0.2, parameters: EkfParameters | None = None, model: UpperBody | None = None
    ) -> None:
        """A smoother that has seen nothing.

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
        self._told_ns: int | None = None
        self._estimate: ModelEstimate | None = None

    def reset(self) -> None:
        """Forget the person, and the frames that are not told yet; the counters stay."""
        self.filter.reset()
        self._frames.clear()
        self._told_ns = None
        self._estimate = None

    @property
    def estimate(self) -> ModelEstimate | None:
        """The state of the model that belongs to the last skeleton that was returned; None before a first."""
        return self._estimate

    def update(self, skeleton: Skeleton, sensor: str = "") -> Skeleton | None:
        """Take one frame.

        Args:
            skeleton: as for the filter.
            sensor: whose it is.

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
                if self._told_ns is not None and skeleton.stamp_ns < self._told_ns:
                    self._told_ns = None  # time jumped back
                self._append(state, skeleton, follows=before is not None)
        if not self._frames:
            return None
        count = self._stretch()
        newest_ns = self._frames[-1].state.stamp_ns
        if count == len(self._frames) and self._frames[0].state.stamp_ns > newest_ns - self._lag_ns:
            return None
        *_, posterior = self._smoothed(self._frames[:count])
        frame = self._frames.pop(0)
        self._told_ns = frame.state.stamp_ns
        result, self._estimate = self._backward.output(posterior, frame.skeleton)
        return result

    def flush(self) -> list[tuple[Skeleton, ModelEstimate]]:
        """The frames that are not told yet, oldest first, each smoothed by all that is there of later ones."""
        told: list[tuple[Skeleton, ModelEstimate]] = []
        while self._frames:
            count = self._stretch()
            stretch, self._frames = self._frames[:count], self._frames[count:]
            posteriors = list(self._smoothed(stretch))
            told += [
                self._backward.output(posterior, frame.skeleton)
                for frame, posterior in zip(stretch, reversed(posteriors), strict=True)
            ]
        if told:
            self._told_ns, self._estimate = told[-1][0].stamp_ns, told[-1][1]
        return told

    def _append(self, state: State, skeleton: Skeleton, follows: bool = True) -> None:
        if self._frames and follows:
            self._frames[-1].link = self._backward.link(self._frames[-1].state, state)
        self._frames.append(_Frame(state, skeleton))

    def _insert(self, late: Skeleton) -> None:
        """Take over the states that the filter came to when it went back for a late frame."""
        while self._frames and self._frames[-1].state.stamp_ns > late.stamp_ns:
            self._frames.pop()
        history = [(state, each) for state, each in self.filter._history if isinstance(each, Measurement)]
        newest = self.filter._state
        assert newest is not None
        # it is not among them where it came late to the start, and was the first one of it
        first = next((k for k, (_, measurement) in enumerate(history) if measurement.skeleton is late), 0)
        states = [*(state for state, _ in history[first + 1 :]), newest]
        for state, (_, measurement) in zip(states, history[first:], strict=True):
            if self._told_ns is None or state.stamp_ns > self._told_ns:
                self._append(state, measurement.skeleton)

    def _stretch(self) -> int:
        """How many of the frames, from the oldest on, are tied to each other."""
        return 1 + next(k for k, frame in enumerate(self._frames) if frame.link is None)

    def _smoothed(self, stretch: list[_Frame]) -> Iterator[_Posterior]:
        """The smoothed states of a stretch, newest first."""
        posterior = self._backward.last(stretch[-1].state)
        yield posterior
        for frame in reversed(stretch[:-1]):
            assert frame.link is not None
            posterior = self._backward.step(frame.state, frame.link, posterior)
            yield posterior
