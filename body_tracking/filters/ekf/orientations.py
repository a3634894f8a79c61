"""Updates of the state, and of the errors of the sources, by measured orientations of segments."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.orientation import SEGMENT_NUMBER, SegmentOrientation
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.filters.ekf.algebra import CLOSE, FAR, LINEARISATIONS, whitening_of
from body_tracking.filters.ekf.motion import Motion
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.priors import Priors
from body_tracking.filters.ekf.sources import ORIENTATION_NOISE, PER_SOURCE, about, expect, slipped
from body_tracking.filters.ekf.state import Measurement, State, StateSpace, single

_AHEAD_OF = 0.8
"""Least time between two orientations of a source, as a share of the period of the greatest rate: clocks jitter."""
_TOGETHER_NS = NANOSECONDS // 125
"""An orientation this soon after the state is compared with the extrapolated pose. That saves a prediction; the process
noise of the interval (1 mrad) is added with the next one."""
_FORGET_AFTER_NS = 30 * NANOSECONDS
"""A source that is silent for longer is forgotten."""
_RATE_FACTOR = 3.0
"""Factor on the stated standard deviation of angular velocities: their errors are not white, but persist."""
_SLIP_AFTER = 0.4
"""Seconds of inconsistent orientations after which their sensor counts as slipped."""
_SLIP_TIME = 0.5
"""Seconds: decay time of the sum of a source's innovations, which detects a nonzero mean."""
_SLIPPED = 30.0
"""Squared normalised sum that a consistent source does not reach (chi-square with 3 degrees of freedom)."""


class OrientationUpdate:
    """Updates a state by orientations.

    Args:
        space: of the states.
        motion: of the filter.
        priors: of the filter.
        parameters: of the filter.
        counters: of the filter.
    """

    def __init__(
        self,
        space: StateSpace,
        motion: Motion,
        priors: Priors,
        parameters: EkfParameters,
        counters: dict[str, int],
    ) -> None:
        self._space, self._model, self._ranges = space, space.model, space.ranges
        self._motion, self._priors = motion, priors
        self._parameters, self._counters, self._gate = parameters, counters, parameters.gate
        self._by_thumbs = self._thumb_table()

    def oriented(self, state: State, measurement: SegmentOrientation) -> State:
        """A state corrected by an orientation, at its time; unchanged if the source's last one is too recent.

        Raises:
            LinAlgError: an innovation covariance is not positive definite.
        """
        space = self._space
        p, sources = self._parameters, state.sources
        number = sources.find(measurement.source)
        since = math.inf if number is None else (measurement.stamp_ns - int(sources.stamps[number])) / NANOSECONDS
        if since < _AHEAD_OF / p.orientation_rate:
            return state
        if measurement.stamp_ns - state.stamp_ns > _TOGETHER_NS:
            state = self._motion.predicted(state, measurement.stamp_ns)
        segment = SEGMENT_NUMBER[measurement.segment]
        active = measurement.stamp_ns - sources.stamps <= _FORGET_AFTER_NS
        if number is not None:
            active[number] &= segment == sources.segments[number]
        if not active.all():
            state = self._forgotten(state, active)
        number = state.sources.find(measurement.source)
        known = number is not None
        if number is None:
            state = self._with_source(state, measurement)
            number = len(state.sources) - 1
        sources = state.sources
        own = slice(space.size + PER_SOURCE * number, space.size + PER_SOURCE * (number + 1))
        restated = sources.restated(number, measurement, p)
        if restated is not None:
            sources, left, new = restated
            errors = slice(own.start, own.start + len(left))
            covariance, crosses = state.covariance.copy(), state.crosses.copy()
            covariance[errors] *= left[:, None]
            covariance[:, errors] *= left
            covariance[errors, errors] += np.diag(new)
            crosses[errors] *= left[:, None]
            state = state.but(covariance=covariance, crosses=crosses, sources=sources)

        fade = math.exp(-since / _SLIP_TIME)
        innovation_sum, sum_variance = (
            fade * sources.innovation_sum[number],
            fade * fade * float(sources.sum_variance[number]),
        )
        corrected, white = self._turned_by(state, measurement, number, own)
        distance = float(white @ white)
        near = distance < self._gate
        innovation_sum = innovation_sum + white * min(1.0, math.sqrt(self._gate / max(distance, 1e-9)))
        sum_variance += 1.0
        fits = near and float(innovation_sum @ innovation_sum) < _SLIPPED * sum_variance
        passed = min(since, _SLIP_AFTER) if known else 0.0  # a new source has no earlier orientation
        unfit_for = 0.0 if fits else float(sources.unfit_for[number]) + passed
        if unfit_for > _SLIP_AFTER:
            self._counters["slips"] += 1
            state = state.but(covariance=slipped(state.covariance, own, p))
            innovation_sum, sum_variance, unfit_for, near = np.zeros(3), 0.0, 0.0, True
            corrected, _ = self._turned_by(state, measurement, number, own)
        if near:
            corrected = self._spun_by(corrected, measurement, number, own)
            state = corrected.but(oriented_ns=measurement.stamp_ns)
        self._counters["orientations_used" if near else "orientations_rejected"] += 1
        looked_at = state.sources.looked_at(number, measurement, p, unfit_for, innovation_sum, sum_variance)
        return self._priors.within(self._priors.bounded(state.but(sources=looked_at)))

    def _turned_by(
        self,
        state: State,
        measurement: SegmentOrientation,
        number: int,
        own: slice,
    ) -> tuple[State, FloatArray]:
        """The Kalman update by an orientation, iterated until it converges, and (3,) the normalised innovation.

        Args:
            state: of the orientation's time.
            measurement: the orientation.
            number: of its source.
            own: rows of the source's states.
        """
        space = self._space
        t, v = space.tangent, space.velocities
        ahead = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        q = self._model.integrate(state.q, ahead * state.velocity) if ahead > 0.0 else state.q
        correction, white = np.zeros(len(state.covariance)), np.zeros(3)
        first: FloatArray | None = None
        for left in reversed(range(LINEARISATIONS)):
            seen = expect(
                self._model,
                q,
                state.sources,
                number,
                measurement.rotation,
                None if first is None else correction[own],
            )
            by_tangent, by_source, innovation = seen.by_tangent, seen.by_source, seen.innovation
            if first is not None:
                for ball in self._model.ball_v:  # derivatives by the tangent at the state
                    by_tangent[:, ball] = by_tangent[:, ball] @ so3.right_jacobian(correction[ball])
                step = correction[t] + ahead * correction[v]
                innovation = innovation + by_tangent @ step + by_source @ correction[own]
            cross = by_tangent @ state.covariance[t] + by_source @ state.covariance[own]
            if ahead > 0.0:
                cross += by_tangent @ (ahead * state.covariance[v])
            s = (cross[:, t] + ahead * cross[:, v]) @ by_tangent.T + cross[:, own] @ by_source.T
            s.reshape(-1)[::4] += ORIENTATION_NOISE**2
            whitening = whitening_of(s)
            white = whitening @ innovation
            first = white if first is None else first
            gain = whitening @ cross
            before, correction = correction, white @ gain
            turned = float(np.abs(correction[3 : space.nv]).max())
            if not left or turned < FAR or np.abs(correction - before)[3 : space.nv].max() < CLOSE:
                break
            step = correction[t] + ahead * (state.velocity + correction[v])
            q = self._model.integrate(state.q, step)
        assert first is not None
        covariance = state.covariance - gain.T @ gain
        kalman = gain.T @ whitening
        if state.settled:
            correction[space.lengths] = 0.0
            kalman[space.lengths] = 0.0
            covariance[space.lengths, space.lengths] = state.covariance[space.lengths, space.lengths]
        if len(state.null):
            for part in (correction[t], correction[space.velocities]):
                part -= (state.null @ part) @ state.null
        crosses = state.crosses
        if crosses.shape[1]:
            shown = single(by_tangent) @ (crosses[t] + ahead * crosses[v]) + single(by_source) @ crosses[own]
            crosses = crosses - single(kalman) @ shown
        if turned >= FAR:
            for ball in self._model.ball_v:
                turn = so3.right_jacobian(correction[ball])
                covariance[ball] = turn @ covariance[ball]
                covariance[:, ball] = covariance[:, ball] @ turn.T
                crosses[ball] = turn @ crosses[ball]
        return space.moved(state.but(covariance=covariance, crosses=crosses), correction), first

    def _spun_by(self, state: State, measurement: SegmentOrientation, number: int, own: slice) -> State:
        """A state whose velocities alone are corrected by the angular velocity that comes with an orientation.

        Its errors (mounting of the source, axes of the person's joints) persist and would bias the pose and the
        sources' states: these are considered but not corrected (Schmidt 1966).
        """
        rate = measurement.angular_velocity
        if rate is None:
            return state
        v = self._space.velocities
        rotation, turning = self._model.turning(state.q, int(state.sources.segments[number]))
        innovation = rotation @ (state.sources.misalignment[number] @ rate) - turning @ state.velocity
        # the axes of the rate err by the misalignment of the source
        misaligned = float(state.covariance.diagonal()[own][:3].mean())
        cross = turning @ state.covariance[v]
        s = cross[:, v] @ turning.T
        s.reshape(-1)[::4] += _RATE_FACTOR**2 * measurement.angular_velocity_variance + misaligned * float(rate @ rate)
        whitening = whitening_of(s)
        white = whitening @ innovation
        if float(white @ white) > self._gate:
            self._counters["rates_rejected"] += 1  # a blow, or the pose is far off
            return state
        half = whitening @ cross
        gain = half[:, v]
        taken = gain.T @ half
        covariance = state.covariance.copy()
        covariance[v] -= taken
        covariance[:, v] -= taken.T
        covariance[v, v] += gain.T @ gain
        correction = white @ gain
        if len(state.null):
            correction -= (state.null @ correction) @ state.null
        crosses = state.crosses
        if crosses.shape[1]:
            crosses = crosses.copy()
            crosses[v] -= gain.T @ (whitening @ (turning @ crosses[v]))
        return state.but(velocity=state.velocity + correction, covariance=covariance, crosses=crosses)

    def _with_source(self, state: State, measurement: SegmentOrientation) -> State:
        """A state with one more source of orientations."""
        sources, added = state.sources.with_new(measurement, self._parameters)
        old = len(state.covariance)
        covariance = np.zeros((old + PER_SOURCE, old + PER_SOURCE))
        covariance[:old, :old] = state.covariance
        covariance[old:, old:] = added
        none = np.zeros((PER_SOURCE, state.crosses.shape[1]), dtype=state.crosses.dtype)
        crosses = np.concatenate([state.crosses, none])
        # earlier updates by thumbs had too much weight
        doubtful = self._by_thumbs[sources.segments[-1]]
        covariance[doubtful, doubtful] += self._ranges.stddev[doubtful - 6] ** 2
        # unobserved directions may be observed now
        null = np.empty((0, self._space.nv))
        return state.but(sources=sources, covariance=covariance, crosses=crosses, null=null)

    def without_thumbs(self, state: State, measurement: Measurement) -> Measurement:
        """A frame without the thumbs of forearms or hands whose orientation is measured.

        For a camera only the thumb shows the axial rotation of a forearm, with a persistent error of 50 degrees for a
        Kinect v2. Any alignment of an inertial sensor is better.
        """
        unseen = self._space.thumbs[state.sources.segments].any(axis=0)
        return replace(measurement, measured=measurement.measured & ~unseen)

    def unlearnt(self, state: State) -> tuple[FloatArray, FloatArray] | None:
        """The states of sources that a camera must not correct: axial rotation of forearm or hand.

        Except for thumbs (:meth:`without_thumbs`), a camera observes this rotation only by the direction in which an
        arm is bent, with a small variance and an error that persists as long as the arm looks the same. That
        combination of a source's states is only considered (Schmidt 1966): its gain is zero along the direction in
        which the source's states vary with it.

        Returns:
            (n, 85 or more) combinations C, and (85 or more, n) directions D, so that a correction x without them is
            x - D C x; None without any.
        """
        space = self._space
        hidden = np.flatnonzero(space.thumbs[state.sources.segments].any(axis=1))
        if not len(hidden):
            return None
        axes = self._model.forward(state.q, state.lengths).rotations[state.sources.segments[hidden], :, 2]
        combinations = np.zeros((len(hidden), len(state.covariance)))
        back = np.zeros((len(state.covariance), len(hidden)))
        for place, (number, axis) in enumerate(zip(hidden, axes, strict=True)):
            own = slice(space.size + PER_SOURCE * int(number), space.size + PER_SOURCE * (int(number) + 1))
            combinations[place, own] = about(axis)
            spread = state.covariance[own, own] @ combinations[place, own]
            back[own, place] = spread / (combinations[place, own] @ spread)
        return combinations, back

    def _forgotten(self, state: State, kept: BoolArray) -> State:
        """A state with only the ``kept`` (n,) of its sources of orientations."""
        rows = np.concatenate([np.ones(self._space.size, dtype=np.bool_), np.repeat(kept, PER_SOURCE)])
        return state.but(
            sources=state.sources.kept(kept),
            covariance=state.covariance[np.ix_(rows, rows)],
            crosses=state.crosses[rows],
        )

    def _thumb_table(self) -> list[IntArray]:
        """(12,) for each segment, the coordinates that its thumb observes."""
        coordinates = [np.empty(0, dtype=np.intp) for _ in self._model.segment_names]
        for number in np.flatnonzero(self._space.thumbs.any(axis=1)).tolist():
            side = self._model.segment_names[number].rsplit("_", 1)[1]
            resting = ("forearm_pronation", "wrist_flexion", "wrist_deviation")
            places = [self._model.coordinate_names.index(f"{each}_{side}") for each in resting]
            coordinates[number] = np.array(places, dtype=np.intp)
        return coordinates
