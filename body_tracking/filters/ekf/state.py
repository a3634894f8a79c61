"""The state of the extended filter, and the layout of its vectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint, SingleArray, Skeleton
from body_tracking.filters.ekf.sources import Sources
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.compiled_posture import prior_table
from body_tracking.kinematics.lengths import SegmentLengths, proportions
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges

NOBODY = Sources.none()


def single(values: FloatArray) -> SingleArray:
    """Values in single precision, that of ``State.crosses``."""
    return values.astype(np.float32)


class Changeable:
    """A frozen dataclass without slots that is copied often."""

    def but(self, **changes: Any) -> Self:
        """``dataclasses.replace``, thirty times as fast for that many fields."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.__dict__.update(changes)
        return other


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One frame of one sensor, on the model's points.

    Attributes:
        sensor: its name.
        stamp_ns: capture time.
        positions: (19, 3) metres in world; 0 where not measured.
        measured: (19,) which points are measured.
        model_variance: (19,) square metres per axis by the measurement model, of white and slow errors together.
        base_variance: (19,) the same of a person who faces a Kinect v2 at 2 m, with these tracking states.
        skeleton: the frame as received.
    """

    sensor: str
    stamp_ns: int
    positions: FloatArray
    measured: BoolArray
    model_variance: FloatArray
    base_variance: FloatArray
    skeleton: Skeleton


@dataclass(frozen=True, eq=False)
class SensorState(Changeable):
    """Estimated errors of a sensor.

    Attributes:
        stamps: nanoseconds of its last (at most 3) frames.
        positions: (k, 19, 3) their points, NaN where not used.
        white: (19,) variance of the white noise per axis, square metres.
        differences: (19,) mean of the squared differences of each point alone.
        weight: (19,) number of squared differences in this mean.
        slow: scale of the slow variance of points.
        slow_estimate: running estimate of this scale, used only if significant.
        slow_information: of the running estimate.
        stated: whether its skeletons bring covariances, which include the systematic error.
        least_stated: the least that it stated lately, as a multiple of ``Measurement.base_variance``; infinity of a
            single sensor.
        stated_ratios: (19,) what it stated of each point when this was last used, as a multiple of
            ``StateSpace.base_variance``.
    """

    stamps: tuple[int, ...]
    positions: FloatArray
    white: FloatArray
    differences: FloatArray
    weight: FloatArray
    slow: float
    slow_estimate: float
    slow_information: float
    stated: bool
    least_stated: float
    stated_ratios: FloatArray


@dataclass(frozen=True, eq=False)
class State(Changeable):
    """The complete state, immutable, so that the filter can continue from an earlier one.

    Attributes:
        stamp_ns: of the state.
        q, lengths, velocity: the estimate.
        covariance: (85 + m, 85 + m) of tangent, lengths, velocities, and m states of m / 7 sources of orientations.
        sensors: estimated errors of each.
        slow_names: (n,) sensors whose slow errors are correlated with the state.
        crosses: (85 + m, 61 n) covariance of the state with the slow errors of these, in units of their deviation. In
            single precision: seven digits are enough for considered states, and with four cameras half the size of this
            largest matrix saves an eighth of a frame's time.
        rejected_for: (19,) seconds for which each point has been rejected.
        disputed: (57,) metres, innovations of rejected points, times the square root of the share of the time after
            which another pose is searched for; 0 of accepted points.
        jump: (53,) change of tangent and lengths by the last restart of the pose: either pose may be wrong. It
            fades with ``reacquire_after``, while frames confirm the new one.
        used_ns: (19,) stamp of the last accepted measurement of each point.
        since_prior: seconds since ranges of motion were last applied.
        tracked: seconds since the start.
        settled: the lengths are only considered.
        seen: estimator of the segment lengths; None once they are fixed.
        mean_posture: (29,) mean of the residuals of ``prior_rows`` over the last minute; None in the first tenth of a
            second.
        measured_at: seconds since the start at which its lengths were last applied.
        null: (k, 32) directions of the tangent that move no point seen lately, and no segment of a source.
        fresh: started from a frame, without any after it.
        attempted_ns: stamp of the last search for another pose.
        sources: of orientations.
        oriented_ns: stamp of the last accepted orientation.
        unplaced: started by orientations, with an unknown position of the base.
        doubt: faded log likelihood ratio of contradicting frames as seen against left and right swapped.
    """

    stamp_ns: int
    q: FloatArray
    lengths: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    sensors: dict[str, SensorState]
    slow_names: tuple[str, ...]
    crosses: SingleArray
    rejected_for: FloatArray
    disputed: FloatArray
    jump: FloatArray
    used_ns: IntArray
    since_prior: float
    tracked: float
    settled: bool
    seen: SegmentLengths | None
    mean_posture: FloatArray | None
    null: FloatArray
    measured_at: float = 0.0
    fresh: bool = False
    attempted_ns: int = 0
    sources: Sources = NOBODY
    oriented_ns: int = 0
    unplaced: bool = False
    doubt: float = 0.0


class StateSpace:
    """The body model, and the indices of its parts in the state.

    Args:
        model: the body.

    Attributes:
        model: as given.
        ranges: of its motion.
        prior: of posture.
        prior_table: ranges and prior as arrays.
        points: how many of its joints are observed (19).
        nv: dimension of the tangent space (32).
        nl: how many lengths it has (21).
        observed: size of tangent and lengths together (53), on which points depend.
        size: of the state without any source of orientations (85).
        tangent, lengths, velocities: slices of the state.
        base_variance: (19,) square metres, systematic error of a camera that states no variances.
        rest_information: (32,) prior information on the tangent.
        lengths_covariance: (21, 21) of people's lengths.
        thumbs: (12, 19) the thumb at the end of each segment, of forearms and hands.
    """

    def __init__(self, model: CompiledUpperBody) -> None:
        self.model = model
        self.ranges = Ranges(model)
        self.prior = PosturePrior(model, self.ranges)
        self.prior_table = prior_table(model, self.ranges, self.prior)
        self.points = len(model.joints)
        self.nv, self.nl = model.nv, len(model.length_names)
        self.observed = self.nv + self.nl
        self.size = self.observed + self.nv
        self.tangent = slice(0, self.nv)
        self.lengths = slice(self.nv, self.observed)
        self.velocities = slice(self.observed, self.size)
        self.base_variance = BASE_STDDEV[model.joints] ** 2
        self.rest_information = np.full(self.nv, 1e-4)
        self.rest_information[3:5] = 1.0 / self.prior.tilt_stddev.max() ** 2
        self.rest_information[6:] = 1.0 / self.prior.stddev**2
        self.lengths_covariance = proportions()
        self.thumbs = np.zeros((len(model.segment_names), self.points), dtype=np.bool_)
        for number, name in enumerate(model.segment_names):
            if name.startswith(("forearm", "hand")):
                self.thumbs[number] = model.joints == Joint[f"THUMB_{name.rsplit('_', 1)[1].upper()}"]

    def moved(self, state: State, correction: FloatArray) -> State:
        """The state after a correction (85 or more,)."""
        lengths = state.lengths if state.settled else state.lengths + correction[self.lengths]
        return state.but(
            q=self.model.integrate(state.q, correction[self.tangent]),
            lengths=lengths,
            velocity=state.velocity + correction[self.velocities],
            sources=state.sources if len(correction) == self.size else state.sources.moved(correction[self.size :]),
        )
