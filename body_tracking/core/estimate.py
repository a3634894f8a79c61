"""The estimate of a body model's state at one instant, by a filter or by a fit."""

from __future__ import annotations

from dataclasses import dataclass

from body_tracking.core.skeleton import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ModelEstimate:
    """The state of a body model with its uncertainty.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        frame_id: the frame of the base, usually ``world``.
        body: the sensor's number of this body.
        q: (nq,) configuration.
        velocity: (nv,) tangent velocity, per second; NaN where nothing estimates it.
        covariance: (2 nv, 2 nv) of the tangent at ``q``, then of the velocity; infinite variances where unknown.
        lengths: (nl,) metres.
        lengths_stddev: (nl,) metres.
    """

    stamp_ns: int
    frame_id: str
    body: int
    q: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    lengths: FloatArray
    lengths_stddev: FloatArray
