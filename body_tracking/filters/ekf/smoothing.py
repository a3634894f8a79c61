"""Fixed-lag smoothing of the extended filter: the backward pass of ``filters.smoothing`` on the manifold.

Known lengths, slow errors of cameras and errors of sources of orientations persist over the lag: no later frame
averages them out. With ``P_xc`` the covariance of pose and velocities with these errors, and ``P_cc`` their own,

    N = P - P_xc P_cc^-1 P_cx                                                                                 (1)

is the covariance for known c. Gains follow from ``N`` alone, and only ``N`` shrinks (' marks the next frame, - its
prediction):

    G = N F^T (N-')^-1,    N_s = N + G (N_s' - N-') G^T,    P_s = P + N_s - N.                                (2)

The tangent spaces at the prediction and at the smoothed configuration are not distinguished: both are only degrees
apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from body_tracking.core.skeleton import FloatArray, IntArray, Skeleton
from body_tracking.filters.ekf.algebra import factored, forward_substituted
from body_tracking.filters.ekf.motion import Motion
from body_tracking.filters.ekf.state import State, StateSpace
from body_tracking.filters.smoothing import backward_gain, smoothed_covariance

_LEAST_SHARE = 1e-6
"""Share of each variance that is added against rounding: the slow errors are in single precision."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The estimate after one frame.

    Attributes:
        state: of the filter.
        skeleton: the sensor's.
        epoch: changes where the pose is not continuous.
        free: (n, n) N of the filter; n as of :meth:`Smoother.free`.
        smoothed: (n, n) N_s.
    """

    state: State
    skeleton: Skeleton
    epoch: int
    free: FloatArray
    smoothed: FloatArray

    @property
    def stamp_ns(self) -> int:
        return self.state.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Relation of two frames: (n, n) gain, and the prediction of the later one with its (n, n) N."""

    gain: FloatArray
    prior: State
    free: FloatArray


class Smoother:
    """The backward pass.

    Args:
        space: of the states.
        motion: of the filter.
    """

    def __init__(self, space: StateSpace, motion: Motion) -> None:
        self._space, self._model, self._motion = space, space.model, motion
        self._pose = np.r_[space.tangent, space.velocities]
        self._all = np.arange(space.size)

    def frame(self, state: State, skeleton: Skeleton, epoch: int) -> Frame:
        """The estimate after a frame."""
        try:
            free = self.free(state)
        except np.linalg.LinAlgError:
            own = self._own(state)
            free, epoch = state.covariance[np.ix_(own, own)], -state.stamp_ns  # no other frame has this epoch
        return Frame(state, skeleton, epoch, free, free)

    def _own(self, state: State) -> IntArray:
        """(n,) indices of the smoothed states: pose and velocities, and lengths while they are estimated."""
        return self._pose if state.settled else self._all

    def free(self, state: State) -> FloatArray:
        """(n, n) N of equation 1.

        Raises:
            LinAlgError: the covariance is not positive definite.
        """
        own, crosses = self._own(state), state.crosses.astype(np.float64)
        rest = np.setdiff1d(np.arange(len(state.covariance)), own)
        free = state.covariance[np.ix_(own, own)]
        if count := len(rest) + crosses.shape[1]:
            persisting = np.eye(count)  # slow errors of cameras have unit variance
            persisting[: len(rest), : len(rest)] = state.covariance[np.ix_(rest, rest)]
            persisting[: len(rest), len(rest) :] = crosses[rest]
            persisting[len(rest) :, : len(rest)] = crosses[rest].T
            persisting.reshape(-1)[:: count + 1] *= 1.0 + _LEAST_SHARE
            cross = np.concatenate([state.covariance[np.ix_(rest, own)], crosses[own].T])
            if not factored(persisting):
                raise np.linalg.LinAlgError("not positive definite")
            white = cross
            forward_substituted(persisting, white)
            free -= white.T @ white
        free.reshape(-1)[:: len(own) + 1] += _LEAST_SHARE * state.covariance.diagonal()[own]
        return free

    def link(self, before: Frame, after: Frame) -> Link | None:
        """The gain between two frames; None where the later one does not continue the earlier one."""
        a, b = before.state, after.state
        replaced = a.settled and not np.array_equal(a.lengths, b.lengths)
        if before.epoch != after.epoch or a.settled != b.settled or replaced:
            return None
        prior, own = self._motion.predicted(a, b.stamp_ns), self._own(a)
        cross = np.zeros((self._space.size, len(own)))
        cross[own] = before.free
        self._motion.carry(cross, a, b.stamp_ns)
        try:
            free = self.free(prior)
            return Link(backward_gain(cross[own], free), prior, free)
        except np.linalg.LinAlgError:
            return None

    def smoothed(self, frame: Frame, link: Link, later: Frame) -> Frame:
        """Equation 2."""
        space, own, after, prior = self._space, self._own(frame.state), later.state, link.prior
        change = np.zeros(space.size)
        change[space.tangent] = self._model.difference(prior.q, after.q)
        change[space.lengths] = after.lengths - prior.lengths
        change[space.velocities] = after.velocity - prior.velocity
        correction = np.zeros(space.size)
        correction[own] = link.gain @ change[own]
        smoothed = smoothed_covariance(frame.free, link.gain, later.smoothed, link.free)
        return replace(frame, state=space.moved(frame.state, correction), smoothed=smoothed)

    def state_of(self, frame: Frame) -> State:
        """The state with its smoothed covariance."""
        own, covariance = self._own(frame.state), frame.state.covariance.copy()
        covariance[np.ix_(own, own)] += frame.smoothed - frame.free
        return frame.state.but(covariance=covariance)
