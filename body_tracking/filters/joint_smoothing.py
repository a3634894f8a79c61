"""Fixed-lag smoothing of the linear filters: the backward pass of ``filters.smoothing``, for every joint by itself.

The slow part of the noise persists over the lag, and stays in the output covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from body_tracking.core.skeleton import BoolArray, FloatArray, Skeleton
from body_tracking.filters.smoothing import backward_gain, smoothed_covariance


@dataclass(frozen=True, slots=True, eq=False)
class JointFrame:
    """The estimate after one frame; n is 3 (positions) or 6 (and velocities).

    Attributes:
        skeleton: as published without smoothing.
        state: (25, n, 1) of each joint.
        covariance: (25, n, n) of these, without slow errors.
        slow: (25, 3, 3) square metres: covariance of slow errors and of the last jump.
        alive: (25,) joints with an estimate.
        continued: (25,) those that were not started by this frame.
        transition: (25, n, n) from the frame before.
        prior: (25, n, 1) predicted state.
        prior_covariance: (25, n, n) of the predicted state, with the adapted process noise.
    """

    skeleton: Skeleton
    state: FloatArray
    covariance: FloatArray
    slow: FloatArray
    alive: BoolArray
    continued: BoolArray
    transition: FloatArray
    prior: FloatArray
    prior_covariance: FloatArray

    @classmethod
    def of(
        cls,
        skeleton: Skeleton,
        posterior: tuple[FloatArray, FloatArray],
        slow: FloatArray,
        alive: BoolArray,
        continued: BoolArray,
        transition: FloatArray,
        prior: tuple[FloatArray, FloatArray],
    ) -> Self:
        """A frame of copies; posterior and prior are (state, covariance), the transition is (n, n) or (25, n, n)."""
        x, p, x_prior, p_prior = map(np.array, (*posterior, *prior))
        return cls(
            skeleton, x, p, slow, alive.copy(), continued, np.broadcast_to(transition, p.shape), x_prior, p_prior
        )

    @property
    def stamp_ns(self) -> int:
        return self.skeleton.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class JointLink:
    """Backward gains (25, n, n), and predicted state (25, n, 1) and covariance (25, n, n) of the next frame."""

    gain: FloatArray
    prior: FloatArray
    prior_covariance: FloatArray


class JointSmoother:
    """The backward pass of :class:`~body_tracking.filters.linear.LinearKalmanFilter`."""

    def link(self, before: JointFrame, after: JointFrame) -> JointLink:
        """Backward gains; zero for joints that were started or lost in between."""
        gain = backward_gain(after.transition @ before.covariance, after.prior_covariance)
        gain *= (before.alive & after.continued)[:, None, None]
        return JointLink(gain, after.prior, after.prior_covariance)

    def smoothed(self, frame: JointFrame, link: JointLink, later: JointFrame) -> JointFrame:
        """Equation 1 of ``filters.smoothing``, for every joint."""
        state = frame.state + link.gain @ (later.state - link.prior)
        covariance = smoothed_covariance(frame.covariance, link.gain, later.covariance, link.prior_covariance)
        return replace(frame, state=state, covariance=covariance)

    def results_of(self, frame: JointFrame) -> tuple[Skeleton, None]:
        """The skeleton with the smoothed estimates."""
        alive = frame.alive[:, None]
        covariances = frame.covariance[:, :3, :3] + frame.slow
        skeleton = replace(
            frame.skeleton,
            positions=np.where(alive, frame.state[:, :3, 0], np.nan),
            covariances=np.where(alive[:, :, None], covariances, np.diag([np.inf] * 3)),
        )
        if frame.state.shape[1] > 3:
            skeleton = replace(skeleton, velocities=np.where(alive, frame.state[:, 3:, 0], np.nan))
        return skeleton, None
