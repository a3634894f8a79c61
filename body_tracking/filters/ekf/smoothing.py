"""Fixed-lag smoothing of the extended filter: the backward pass of ``filters.smoothing`` on the manifold.

Lengths that are only considered, slow errors of cameras and errors of sources of orientations persist over the lag: no
later frame averages them out. So the covariance is split into a part by these errors c, ``S S^T`` with
``S = P_xc L^-T`` and ``P_cc = L L^T``, and the rest ``N``, which is the error's covariance for known c. Gains follow
from ``N`` alone, and with the prediction (-) and the smoothed estimate (s) of the next frame

    G = N F^T (N-)^-1,    N_s = N + G (N_s' - N-) G^T,    S_s = S + G (S_s' - S-),    P_s = N_s + S_s S_s^T.     (1)

The errors of configurations are taken in the tangents of the prediction and of the smoothed one alike: they are degrees
apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dtrtrs

from body_tracking.core.skeleton import FloatArray, IntArray, Skeleton
from body_tracking.filters.ekf.algebra import cholesky
from body_tracking.filters.ekf.motion import Motion
from body_tracking.filters.ekf.state import State, StateSpace
from body_tracking.filters.smoothing import backward_gain, smoothed_covariance

_LEAST_SHARE = 1e-6
"""Share of each variance that is added where rounding, in single precision, may have left none."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """The covariance of what is smoothed (n), by what it comes from.

    Attributes:
        free: (n, n) N.
        persisting: (n, c) S.
        root: (c, c) L, lower.
    """

    free: FloatArray
    persisting: FloatArray
    root: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The estimate after one frame.

    Attributes:
        state: of the filter.
        skeleton: the sensor's.
        epoch: changes where a pose is not the continuation of the one before.
        split: of the state's covariance.
    """

    state: State
    skeleton: Skeleton
    epoch: int
    split: Split

    @property
    def stamp_ns(self) -> int:
        return self.state.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Between two frames.

    Attributes:
        gain: (n, n) G.
        prior: the prediction of the later one.
        split: of its covariance.
    """

    gain: FloatArray
    prior: State
    split: Split


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

    def _parts(self, state: State) -> tuple[IntArray, IntArray]:
        """(n,) indices of what is smoothed: pose and velocities, lengths while they are estimated; (k,) of the rest."""
        own = self._pose if state.settled else self._all
        return own, np.setdiff1d(np.arange(len(state.covariance)), own)

    def split(self, state: State) -> Split:
        """The split covariance of a state.

        Raises:
            LinAlgError: its covariance is none.
        """
        own, rest = self._parts(state)
        covariance, crosses = state.covariance, state.crosses.astype(np.float64)
        count = len(rest) + crosses.shape[1]
        considered = np.eye(count)
        considered[: len(rest), : len(rest)] = covariance[np.ix_(rest, rest)]
        considered[: len(rest), len(rest) :] = crosses[rest]
        considered[len(rest) :, : len(rest)] = crosses[rest].T
        considered.reshape(-1)[:: count + 1] *= 1.0 + _LEAST_SHARE
        root = cholesky(considered) if count else considered
        cross = np.concatenate([covariance[np.ix_(own, rest)], crosses[own]], axis=1)
        persisting = dtrtrs(root, cross.T, lower=1)[0].T if count else cross
        free = covariance[np.ix_(own, own)] - persisting @ persisting.T
        free.reshape(-1)[:: len(own) + 1] += _LEAST_SHARE * covariance.diagonal()[own]
        return Split(free, persisting, root)

    def link(self, before: Frame, after: Frame) -> Link | None:
        """The gain between two frames; None where the later one does not continue the earlier one."""
        a, b = before.state, after.state
        replaced = a.settled and b.settled and a.lengths is not b.lengths and (a.lengths != b.lengths).any()
        same = a.settled == b.settled and a.slow_names == b.slow_names and len(a.covariance) == len(b.covariance)
        if before.epoch != after.epoch or replaced or not same:
            return None
        prior = self._motion.predicted(a, b.stamp_ns)
        try:
            split = self.split(prior)
            own, _ = self._parts(a)
            moved = np.zeros((len(a.covariance), len(own)))
            moved[own] = before.split.free
            self._motion.carry(moved, a, b.stamp_ns)
            return Link(backward_gain(moved[own], split.free), prior, split)
        except np.linalg.LinAlgError:
            return None

    def smoothed(self, frame: Frame, link: Link, later: Frame) -> Frame:
        """Equation 1."""
        space, state, prior = self._space, frame.state, link.prior
        own, _ = self._parts(state)
        change = np.zeros(len(state.covariance))
        change[space.tangent] = self._model.difference(prior.q, later.state.q)
        change[space.lengths] = later.state.lengths - prior.lengths
        change[space.velocities] = later.state.velocity - prior.velocity
        correction = np.zeros(space.size)
        correction[own] = link.gain @ change[own]
        persisting = frame.split.persisting + link.gain @ (later.split.persisting - link.split.persisting)
        free = smoothed_covariance(frame.split.free, link.gain, later.split.free, link.split.free)
        split = Split(free, persisting, frame.split.root)
        return replace(frame, state=space.moved(state, correction), split=split)

    def state_of(self, frame: Frame) -> State:
        """The state with its covariance put together again."""
        own, rest = self._parts(frame.state)
        covariance, split = frame.state.covariance.copy(), frame.split
        covariance[np.ix_(own, own)] = split.free + split.persisting @ split.persisting.T
        cross = (split.persisting @ split.root.T)[:, : len(rest)]
        covariance[np.ix_(own, rest)], covariance[np.ix_(rest, own)] = cross, cross.T
        return frame.state.but(covariance=covariance)
