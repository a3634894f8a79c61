"""Prior knowledge of a pose: ranges of motion, and posture."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, FloatArray, SingleArray
from body_tracking.filters.ekf.kernels import pseudo_measured
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.state import State, StateSpace, single
from body_tracking.kinematics.compiled_posture import excess_of, prior_rows, soft_values

_PRIOR_PERIOD = 0.1
"""Seconds between updates by the ranges of motion."""

_POSTURE_TIME = 1.0
"""Seconds: correlation time of posture; the prior counts as one observation per twice this time."""
_MEAN_POSTURE_TIME = 60.0
"""Seconds over which the posture is averaged; with 5 or 15 the joints of simulated people err by the same to 0.5 mm
(``benchmarks/accuracy.py``: squat, arm raises, reaching)."""
VAGUE = 0.5
"""Share of the range's deviation from which an angle is moved to the middle of its range."""
_SPURIOUS = 0.7
"""Share of the range's variance below which the variance of an unobserved direction is spurious."""
_SEEN_NS = NANOSECONDS
"""Nanoseconds since its last accepted measurement after which a point no longer counts as seen."""
_UNSEEN_PLACE, _UNSEEN_HEADING = 1.0, 1.0
"""Metres and radians: deviations of a base of which nothing was seen lately, as with one hand in view; a longer absence
adds what the motion model says."""
_NULL = 1e-6
"""Singular value, as a share of the greatest, below which a direction moves no seen point."""
_LIMIT_STDDEV = 3.0
"""Degrees: standard deviation of the pseudo-measurement at a limit."""
_HARD_STDDEV = 0.2
"""Degrees: the same far beyond a limit."""
_PROJECTIONS = 3
_FAR_BEYOND, _BACK_TO = np.radians(10.0), np.radians(8.0)
"""Radians: an estimate farther beyond a range than ``_FAR_BEYOND`` is brought back to ``_BACK_TO`` beyond it."""
_HELD_STDDEV = 0.002
"""Radians: standard deviation by which priors may rotate a segment with a measured orientation."""


class Priors:
    """Applies the priors to a state.

    Args:
        space: of the states.
        parameters: of the filter.
        counters: of the filter.
    """

    def __init__(self, space: StateSpace, parameters: EkfParameters, counters: dict[str, int]) -> None:
        self._space, self._model, self._ranges = space, space.model, space.ranges
        self._parameters, self._counters = parameters, counters
        self._prior = space.prior
        # the pseudo-measurements: coordinates, sharing of a twist, and inclination of the pelvis
        self._stddev = space.prior_table.stddev
        self._postural = np.append(self._prior.postural, [True] * 3)
        self._information = space.rest_information.copy()
        self._information[:3] = 1.0 / _UNSEEN_PLACE**2
        self._information[5] = 1.0 / _UNSEEN_HEADING**2

    def bounded(self, state: State) -> State:
        """Update by the ranges of motion: soft limits, and bounds of unobserved directions."""
        space = self._space
        if state.since_prior < _PRIOR_PERIOD:
            return state
        lines, stddev = self._model.linearised(state.q, state.lengths), self._stddev
        coordinates, values, gradients = prior_rows(
            state.q, lines.posture.rotations[0], lines.rotation_jacobian[0], self._space.prior_table
        )
        excess = excess_of(coordinates, self._space.prior_table)
        tangent = self._free(state)[0][space.tangent, space.tangent]
        variance = ((gradients @ tangent) * gradients).sum(axis=1)
        # A coordinate whose variance exceeds that of its prior gets a pseudo-measurement at the prior's mean, with the
        # variance that brings it down to the prior's. It moves no segment whose orientation is measured, since the
        # pseudo-measurement has the same error every time.
        limit = stddev**2
        unknown = variance > limit
        noise = variance * limit / np.maximum(variance - limit, 1e-12)
        state = state.but(since_prior=0.0, mean_posture=_with_posture(state, values))
        if state.seen is not None and state.tracked > self._parameters.settle_time:
            state = state.but(settled=True, seen=None)
        branch = self._ranges.nearest_branch(state.q)
        if branch is not None:
            return self._turned(state, *branch)
        state = self._without_spurious_information(state)
        if unknown.any():
            state = self._pseudo_measured(
                state, gradients[unknown], -values[unknown], noise[unknown], self._free(state)
            )
        if self._parameters.posture:
            rows = self._postural
            noise = 2.0 * _POSTURE_TIME / _PRIOR_PERIOD * limit[rows]
            state = self._pseudo_measured(state, gradients[rows], -values[rows], noise, self._free(state))
        vague = (variance > (VAGUE * stddev) ** 2) & ~self._postural
        if vague.any() and not state.sources.names:
            state = self._centred(state, gradients[vague], values[vague], stddev[vague])
        beyond = excess != 0.0
        if beyond.any():
            state = self._pushed_back(state, gradients[:-3][beyond], excess[beyond])
        return state

    def _turned(self, state: State, q: FloatArray, signs: FloatArray) -> State:
        """The same state in an equivalent configuration, whose tangent has other signs (32,)."""
        self._counters["branches"] += 1
        both = np.concatenate(
            [signs, np.ones(self._space.nl), signs, np.ones(len(state.covariance) - self._space.size)]
        )
        return state.but(
            q=q,
            velocity=state.velocity * signs,
            covariance=state.covariance * both * both[:, None],
            crosses=state.crosses * single(both)[:, None],
        )

    def _without_spurious_information(self, state: State) -> State:
        """Remove spurious information about unobserved directions, which move no point that was seen lately.

        The unobserved directions depend on the estimate, which is noisy; the update takes their rotation from frame to
        frame for information (Huang, Mourikis and Roumeliotis 2010). Along each of them the covariance is raised to a
        share of that of the ranges of motion.
        """
        space = self._space
        lines = self._model.linearised(state.q, state.lengths)
        recent = state.stamp_ns - state.used_ns < _SEEN_NS
        jacobian = lines.jacobian[recent if recent.any() else slice(None)].reshape(-1, space.nv)
        if state.sources.names:
            turning = lines.rotation_jacobian[state.sources.segments].reshape(-1, space.nv)
            jacobian = np.concatenate([jacobian, turning])
        squared, axes = np.linalg.eigh(jacobian.T @ jacobian)
        null = axes.T[squared < _NULL**2 * squared[-1]]
        state = state.but(null=null)
        if not len(null):
            return state
        tangent = state.covariance[space.tangent, space.tangent]
        known = np.linalg.inv(null @ np.linalg.solve(tangent, null.T))
        allowed = _SPURIOUS * np.linalg.inv((null * self._information) @ null.T)
        size, directions = np.linalg.eigh(allowed - known)
        missing = (directions * np.maximum(size, 0.0)) @ directions.T
        covariance = state.covariance.copy()
        covariance[space.tangent, space.tangent] += null.T @ missing @ null
        return state.but(covariance=covariance)

    def _centred(self, state: State, observation: FloatArray, values: FloatArray, stddev: FloatArray) -> State:
        """Move the estimate to the middle of the ranges in unobserved directions; the covariance stays.

        Otherwise an unobserved angle would wander with the noise of the observed ones. With orientations only the
        output is moved (``output``): cameras would pull the state back every time, as the covariance stays, and these
        corrections would accumulate in the headings and misalignments of the sources.
        """
        space = self._space
        cross_covariance = self._free(state)[0][:, space.tangent] @ observation.T
        s = observation @ cross_covariance[space.tangent] + np.diag(stddev**2)
        correction = -cross_covariance @ np.linalg.solve(s, values)
        correction[space.velocities] = 0.0
        correction[space.size :] = 0.0
        return space.moved(state, correction)

    def within(self, state: State) -> State:
        """The nearest state, by the covariance, that is not far beyond any range of motion.

        The soft limits act ten times a second; a velocity that continues while nothing is seen, or a measurement that
        no body can follow, is stopped here at once.
        """
        for _ in range(_PROJECTIONS):
            values = soft_values(state.q, self._space.prior_table)
            excess = excess_of(values, self._space.prior_table)
            size = np.abs(excess)
            far = size > _FAR_BEYOND
            if not far.any():
                return state
            gradients = self._ranges.gradients(values)[far]
            observation = np.zeros((len(gradients), self._space.nv))
            observation[:, 6:] = gradients
            back = excess[far] * (1.0 - _BACK_TO / size[far])
            state = self._pushed_back(state, observation, back, _HARD_STDDEV)
            velocity = state.velocity.copy()
            rate = gradients @ velocity[6:]
            outward = rate * excess[far] > 0.0
            velocity[6:] -= gradients.T @ np.where(outward, rate, 0.0)
            state = state.but(velocity=velocity)
        return state.but(q=self._ranges.clipped(state.q, _FAR_BEYOND))

    def _pseudo_measured(
        self,
        state: State,
        observation: FloatArray,
        error: FloatArray,
        noise: FloatArray,
        part: tuple[FloatArray, SingleArray],
    ) -> State:
        """The update by pseudo-measurements of the tangent.

        Args:
            state: to be corrected.
            observation: (k, 32) observation matrix.
            error: (k,) innovation.
            noise: (k,) variances.
            part: the parts that may be corrected, of the covariance and of that with the slow errors of cameras.

        Raises:
            LinAlgError: the innovation covariance is not positive definite.
        """
        space = self._space
        sound, correction, covariance, crosses = pseudo_measured(
            state.covariance, state.crosses, *part, observation, error, noise
        )
        if not sound:
            raise np.linalg.LinAlgError("not positive definite")
        if state.settled:
            covariance[space.lengths, space.lengths] = state.covariance[space.lengths, space.lengths]
            crosses[space.lengths] = state.crosses[space.lengths]
        return space.moved(state.but(covariance=covariance, crosses=crosses), correction)

    def _pushed_back(
        self, state: State, observation: FloatArray, excess: FloatArray, stddev: float = _LIMIT_STDDEV
    ) -> State:
        """The nearest state, by the covariance, within the limits; softly (Simon 2010, projection of the estimate).

        The covariance stays: limits do not determine an angle within them.
        """
        space = self._space
        cross_covariance = self._free(state)[0][:, space.tangent] @ observation.T
        s = observation @ cross_covariance[space.tangent]
        s[np.arange(len(s)), np.arange(len(s))] += np.radians(stddev) ** 2
        correction = -cross_covariance @ np.linalg.solve(s, excess)
        correction[space.size :] = 0.0  # the covariance stays: corrections would accumulate in the sources
        return space.moved(state, correction)

    def _free(self, state: State) -> tuple[FloatArray, SingleArray]:
        """:meth:`free` of the state's covariance, and of that with the slow errors of cameras."""
        return self.free(state, state.covariance, state.crosses)

    def free(self, state: State, covariance: FloatArray, crosses: SingleArray) -> tuple[FloatArray, SingleArray]:
        """The part of a covariance (n, n), and of that with m other errors (n, m), that orientations leave free.

        Priors must not turn a segment whose orientation is measured: their error is the same every time, and would
        accumulate in the states of the sources.
        """
        active = state.sources.active(state.stamp_ns)
        if not active.any():
            return covariance, crosses
        t = self._space.tangent
        turning = self._model.linearised(state.q, state.lengths).rotation_jacobian[state.sources.segments[active]]
        rows = turning.reshape(-1, self._space.nv)
        cross = rows @ covariance[t]
        s = cross[:, t] @ rows.T
        s[np.arange(len(s)), np.arange(len(s))] += _HELD_STDDEV**2
        gain: FloatArray = np.asarray(np.linalg.solve(s, cross).T, dtype=np.float64)
        return covariance - gain @ cross, crosses - single(gain) @ (single(rows) @ crosses[t])


def _with_posture(state: State, values: FloatArray) -> FloatArray:
    """The state's mean posture (29,), updated by the present posture with the weight of the time since the last one."""
    if state.mean_posture is None:
        return values
    share = state.since_prior / max(min(state.tracked, _MEAN_POSTURE_TIME), state.since_prior)
    mean: FloatArray = state.mean_posture + share * (values - state.mean_posture)
    return mean
