"""Orientations of segments as measurements of the model's state, with the errors of their sources.

A source measures its segment's rotation R to world as

    R_m = Exp(n) Exp(h z) Exp(g) R M,    M = Exp(m) M_0                                                   (1)

with white noise n, an error h of its heading, an error g that persists for some seconds (of the filter in the source,
of tissue), and a misalignment m with the segment. The covariance that a source states is mostly that of its
mounting and heading, so it is the initial covariance of h and m. Both are random walks, and their variances follow
later changes of the stated covariance. g is a Gauss-Markov process of a few degrees, by tissue and the source's own
filter. All seven numbers are estimated with the body; their parts that cannot be distinguished from the pose (a
forearm's axial misalignment and its pronation) keep their deviation. This requires a linearisation with the same
direction for both at every estimate, so m is expressed in the segment's frame and not in the sensor's, which rotates
with the estimate (Huang, Mourikis and Roumeliotis 2010 on such spurious information). An angular velocity that comes
with an orientation corrects the velocities only: its error persists, and is not in the state. Errors of rotations are
rotation vectors (Sola, Deray and Atchuthan 2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from body_tracking.core import so3
from body_tracking.core.orientation import SEGMENT_NUMBER, SegmentOrientation
from body_tracking.core.parameters import number_field
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UpperBody

PER_SOURCE: Final = 7
"""States of each source: misalignment (3), heading, persistent error (3)."""
_MISALIGNMENT, _HEADING, _SLOW = slice(0, 3), 3, slice(4, 7)
TISSUE_TIME = 2.0
"""Seconds: correlation time of the errors of moving tissue."""
MISALIGNMENT_DENSITY, HEADING_DENSITY = 3e-5, 3e-5
"""rad2/s: densities of the random walks of misalignment and heading, the latter beside the growth that a source
states."""
ORIENTATION_NOISE = 0.01
"""Radians: white noise per axis of each orientation that is used."""
_SLIP_STDDEV = 0.35
"""Radians: standard deviation of the misalignment, per axis, that a slip adds."""
_EYE3 = np.eye(3)
_Z = np.array([0.0, 0.0, 1.0])
_PARTS = np.array([0, 0, 0, 1])
"""Index of the stated variance (misalignment, heading) for each of misalignment (3) and heading."""
_SAME = 0.02
"""Relative change of a stated variance below which it is ignored."""
_ACTIVE_FOR_NS = NANOSECONDS // 4
"""A source without a measurement for longer does not constrain its segment."""
_SMALL = 1e-4
"""Radians below which the first terms of a series are exact."""

_WALKS = np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

_HEADINGS = 8
"""Number of initial headings of the base in the search for a pose."""
_STEPS = 20
_FARTHEST = 0.5
"""Radians: greatest step of the search."""
_CONVERGED = 1e-4
_FIT_STDDEV = 0.1
"""Radians: standard deviation of an orientation in the search."""
_UPRIGHT = 0.3
"""Radians: standard deviation of the tilt of the pelvis in the search."""


@dataclass(frozen=True, slots=True)
class OrientationParameters:
    """How segment orientations are taken; each field's metadata says what it is, its unit and its range."""

    misalignment_stddev: float = number_field(
        0.06,
        "orientations: misalignment of a source with its segment per axis beside what the source states, before it is "
        "learnt",
        "rad",
        1e-4,
        3.0,
    )
    heading_stddev: float = number_field(
        0.09,
        "orientations: error of a source's heading, before it is learnt, where the source states no more",
        "rad",
        1e-4,
        3.2,
    )
    tissue_stddev: float = number_field(
        0.05,
        "orientations: what moving tissue, and at most as much again a source's own filter, err by, per axis",
        "rad",
        0.0,
        1.0,
    )
    orientation_rate: float = number_field(
        30.0, "orientations: of a source that is faster no more than so many are used", "Hz", 1.0, 1000.0
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sources:
    """Estimated errors of n sources of orientations; the arrays are never written into.

    Attributes:
        names: of the sources.
        segments: (n,) numbers of the segments that they sit on.
        misalignment: (n, 3, 3) M.
        heading: (n,) radians h.
        slow: (n, 3) radians g.
        slow_variance: (n, 3, 3) rad2, stationary covariance of g.
        stated: (n, 2) rad2, variances of misalignment and heading by the last stated covariance.
        stamps: (n,) nanoseconds, of the last orientation that was compared with the state.
        unfit_for: (n,) seconds of inconsistent orientations without a break.
        innovation_sum: (n, 3) faded sum of the normalised innovations.
        sum_variance: (n,) variance of each component of ``innovation_sum`` for a consistent source.
    """

    names: tuple[str, ...]
    segments: IntArray
    misalignment: FloatArray
    heading: FloatArray
    slow: FloatArray
    slow_variance: FloatArray
    stated: FloatArray
    stamps: NDArray[np.int64]
    unfit_for: FloatArray
    innovation_sum: FloatArray
    sum_variance: FloatArray

    @classmethod
    def none(cls) -> Self:
        """No sources."""
        zero, whole = np.zeros(0), np.zeros(0, dtype=np.intp)
        cube = np.zeros((0, 3, 3))
        pairs, triples = np.zeros((0, 2)), np.zeros((0, 3))
        return cls((), whole, cube, zero, triples, cube, pairs, whole, zero, triples, zero)

    def __len__(self) -> int:
        return len(self.names)

    def active(self, stamp_ns: int) -> BoolArray:
        """(n,) whether a source has measured lately, so that it constrains its segment."""
        return stamp_ns - self.stamps < _ACTIVE_FOR_NS

    def find(self, name: str) -> int | None:
        """Index of the source of this name; None without one."""
        return self.names.index(name) if name in self.names else None

    def _but(self, **changes: Any) -> Self:
        return type(self)(**{name: getattr(self, name) for name in self.__slots__} | changes)

    def moved(self, correction: FloatArray) -> Self:
        """The sources after a correction (7 n,)."""
        parts = correction.reshape(-1, PER_SOURCE)
        turned = so3.quat_to_matrix(so3.exp(parts[:, _MISALIGNMENT])) @ self.misalignment
        return self._but(
            misalignment=turned, heading=self.heading + parts[:, _HEADING], slow=self.slow + parts[:, _SLOW]
        )

    def faded(self, share: float) -> Self:
        """The sources with their persistent errors g scaled by a decay factor."""
        return self._but(slow=share * self.slow)

    def kept(self, which: BoolArray) -> Self:
        """Only the sources that ``which`` (n,) selects."""
        names = tuple(name for name, kept in zip(self.names, which, strict=True) if kept)
        return self._but(
            names=names, **{each: getattr(self, each)[which] for each in self.__slots__ if each != "names"}
        )

    def with_new(self, measurement: SegmentOrientation, parameters: OrientationParameters) -> tuple[Self, FloatArray]:
        """The sources with another one at the end, and the (7, 7) prior covariance of its states."""
        slow_variance = _slow_variance(measurement.covariance, parameters)
        stated = _stated(measurement.covariance, parameters)
        covariance = np.zeros((PER_SOURCE, PER_SOURCE))
        covariance[_MISALIGNMENT, _MISALIGNMENT] = stated[0] * _EYE3
        covariance[_HEADING, _HEADING] = stated[1]
        covariance[_SLOW, _SLOW] = slow_variance
        never = measurement.stamp_ns - 3600 * NANOSECONDS
        new = {
            "segments": SEGMENT_NUMBER[measurement.segment],
            "misalignment": _EYE3,
            "heading": 0.0,
            "slow": np.zeros(3),
            "slow_variance": slow_variance,
            "stated": stated,
            "stamps": never,
            "unfit_for": 0.0,
            "innovation_sum": np.zeros(3),
            "sum_variance": 0.0,
        }
        grown = {name: np.append(getattr(self, name), [value], axis=0) for name, value in new.items()}
        return self._but(names=(*self.names, measurement.source), **grown), covariance

    def looked_at(
        self,
        number: int,
        measurement: SegmentOrientation,
        parameters: OrientationParameters,
        unfit_for: float,
        innovation_sum: FloatArray,
        sum_variance: float,
    ) -> Self:
        """The sources after another orientation of one of them, used or rejected."""
        new = {
            "slow_variance": _slow_variance(measurement.covariance, parameters),
            "stamps": measurement.stamp_ns,
            "unfit_for": unfit_for,
            "innovation_sum": innovation_sum,
            "sum_variance": sum_variance,
        }
        changed = {name: getattr(self, name).copy() for name in new}
        for name, value in new.items():
            changed[name][number] = value
        return self._but(**changed)

    def restated(
        self, number: int, measurement: SegmentOrientation, parameters: OrientationParameters
    ) -> tuple[Self, FloatArray, FloatArray] | None:
        """The sources after one of them has changed the variance that it states.

        If it grows from a to b, the error is a random walk: b - a is added. If it shrinks, the source has corrected
        itself: of an error e of variance a, (b / a) e is left, and a new one of variance b (1 - b / a) is added: the
        regression of an optimal estimate's error on its earlier error.

        Returns:
            The sources, (4,) factors on the errors of misalignment and heading, and (4,) rad2 that are added to their
            variances; None if the stated variance has hardly changed.
        """
        before, after = self.stated[number], _stated(measurement.covariance, parameters)
        if (np.abs(after - before) < _SAME * before).all():
            return None
        left = np.minimum(1.0, after / before)
        new = np.maximum(after - before, 0.0) + after * (1.0 - left)
        turn = so3.rotation_vectors(self.misalignment[number])
        misalignment, heading, stated = self.misalignment.copy(), self.heading.copy(), self.stated.copy()
        misalignment[number] = so3.quat_to_matrix(so3.exp(left[0] * turn))
        heading[number] *= left[1]
        stated[number] = after
        known = self._but(misalignment=misalignment, heading=heading, stated=stated)
        return known, left[_PARTS], new[_PARTS]


def _stated(covariance: FloatArray, parameters: OrientationParameters) -> FloatArray:
    """(2,) rad2, of misalignment per axis and of heading, from the stated (3, 3) covariance about the axes of world."""
    level = 0.5 * float(covariance[0, 0] + covariance[1, 1])
    return np.array(
        [parameters.misalignment_stddev**2 + level, max(parameters.heading_stddev**2, float(covariance[2, 2]))]
    )


def _slow_variance(covariance: FloatArray, parameters: OrientationParameters) -> FloatArray:
    """(3, 3) rad2, covariance of g: that of tissue, and at most as much again of the source's own filter."""
    tissue = parameters.tissue_stddev**2
    variance: FloatArray = tissue * _EYE3 + np.diag(np.minimum(covariance.diagonal(), tissue))
    return variance


def advance(covariance: FloatArray, first: int, sources: Sources, dt: float) -> float:
    """Predict the sources' part of a covariance (first + 7 n, first + 7 n) in place; the decay factor of g."""
    share = math.exp(-dt / TISSUE_TIME)
    fades = np.ones((len(sources), PER_SOURCE))
    fades[:, _SLOW] = share
    covariance[first:] *= fades.reshape(-1, 1)
    covariance[:, first:] *= fades.reshape(-1)
    added = np.zeros((len(sources), PER_SOURCE, PER_SOURCE))
    added[:, _SLOW, _SLOW] = (1.0 - share * share) * sources.slow_variance
    added[:] += _WALKS[0] * (dt * MISALIGNMENT_DENSITY) + _WALKS[1] * (dt * HEADING_DENSITY)
    own = covariance[first:, first:]
    for number, block in enumerate(added):
        place = slice(PER_SOURCE * number, PER_SOURCE * (number + 1))
        own[place, place] += block
    return share


def about(axis: FloatArray) -> FloatArray:
    """(7,) derivative of a segment's measured rotation about its z axis (3,), in world, by the source's states."""
    return np.array([0.0, 0.0, 1.0, axis[2], *axis])


def slipped(covariance: FloatArray, own: slice, parameters: OrientationParameters) -> FloatArray:
    """The covariance after a source (rows ``own``) has slipped, or was switched off and on."""
    covariance = covariance.copy()
    variance = np.array([_SLIP_STDDEV**2] * 3 + [parameters.heading_stddev**2] + [0.0] * 3)
    covariance[own, own] += np.diag(variance)
    return covariance


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """A measured orientation compared with its prediction.

    Attributes:
        innovation: (3,) radians about the axes of world, Log(R_m R_p^T).
        by_tangent: (3, 32) minus its derivative by the configuration's tangent.
        by_source: (3, 7) minus its derivative by the source's states.
    """

    innovation: FloatArray
    by_tangent: FloatArray
    by_source: FloatArray


def expect(
    model: UpperBody,
    q: FloatArray,
    sources: Sources,
    number: int,
    measured: FloatArray,
    correction: FloatArray | None = None,
) -> Expected:
    """The innovation of a source's orientation against equation (1), and its derivatives.

    Args:
        model: the body.
        q: (35,) configuration.
        sources: all of them.
        number: index of the source.
        measured: (3, 3) R_m.
        correction: (7,) of the source's states; None for none.
    """
    rotation, turning = model.turning(q, int(sources.segments[number]))
    misalignment, slow, heading = sources.misalignment[number], sources.slow[number], float(sources.heading[number])
    if correction is not None:
        turn, by_turn = _exp(correction[_MISALIGNMENT])
        misalignment, slow = turn @ misalignment, slow + correction[_SLOW]
        heading += float(correction[_HEADING])
    cosine, sine = math.cos(heading), math.sin(heading)
    level = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    persisting, by_persisting = _exp(slow)
    before = level @ persisting
    by_turning = before @ rotation
    predicted = by_turning @ misalignment
    innovation = so3.rotation_vectors(measured @ predicted.T)
    # R_p changes to Exp(d) R_p, and the innovation by -J_r^-1 d
    by_source = np.empty((3, PER_SOURCE))
    by_source[:, _MISALIGNMENT] = by_turning if correction is None else by_turning @ by_turn
    by_source[:, _HEADING] = _Z
    by_source[:, _SLOW] = level @ by_persisting
    inverse = so3.right_jacobian_inverse(innovation)
    return Expected(innovation, inverse @ before @ turning, inverse @ by_source)


def _exp(vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3, 3) rotation of a rotation vector, and its left Jacobian (Sola eq. 134 and 145); both share their parts."""
    cross = so3.skew(vector)
    squared = cross @ cross
    angle = math.sqrt(float(vector @ vector))
    if angle < _SMALL:
        first, second, third = 1.0, 0.5, 1.0 / 6.0
    else:
        first = math.sin(angle) / angle
        second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        third = (1.0 - first) / angle**2
    return _EYE3 + first * cross + second * squared, _EYE3 + second * cross + third * squared


def pose_of(model: UpperBody, ranges: Ranges, measurements: Sequence[SegmentOrientation]) -> FloatArray:
    """(35,) the likeliest pose, with the base at the origin, for measured orientations of segments.

    Maximum a posteriori by Gauss-Newton steps from several headings of the base: coordinates without a measurement are
    in the middle of their range, and the pelvis upright.
    """
    segments = np.array([SEGMENT_NUMBER[each.segment] for each in measurements], dtype=np.intp)
    measured = np.stack([each.rotation for each in measurements])
    lengths = model.default_lengths()
    fits = []
    for heading in 2.0 * np.pi * np.arange(_HEADINGS) / _HEADINGS:
        q = model.neutral()
        q[model.quaternion_of("pelvis")] = so3.exp(heading * _Z)
        fits.append(_fitted(model, ranges, q, lengths, segments, measured))
    return min(fits, key=lambda fit: fit[1])[0]


def _fitted(
    model: UpperBody, ranges: Ranges, q: FloatArray, lengths: FloatArray, segments: IntArray, measured: FloatArray
) -> tuple[FloatArray, float]:
    """(35,) configuration after Gauss-Newton steps from ``q``, and its cost."""
    nv = model.nv
    for _ in range(_STEPS):
        lines = model.linearise(q, lengths)
        rotations = lines.posture.rotations
        errors = so3.rotation_vectors(measured @ rotations[segments].swapaxes(-1, -2))
        soft = ranges.soft_coordinates(q)
        upright = np.zeros((2, nv))
        upright[:, :] = so3.skew(-rotations[0, :, 2])[:2] @ lines.rotation_jacobian[0]
        by_range = np.zeros((nv - 6, nv))
        by_range[:, 6:] = soft.gradients
        rows = np.concatenate(
            [
                lines.rotation_jacobian[segments].reshape(-1, nv) / _FIT_STDDEV,
                by_range / ranges.stddev[:, None],
                upright / _UPRIGHT,
            ]
        )
        residuals = np.concatenate(
            [
                errors.reshape(-1) / _FIT_STDDEV,
                (ranges.centre - soft.values) / ranges.stddev,
                -rotations[0, :2, 2] / _UPRIGHT,
            ]
        )
        information = rows.T @ rows
        information[np.arange(nv), np.arange(nv)] += 1e-6
        step = np.linalg.solve(information, rows.T @ residuals)
        longest = float(np.abs(step).max())
        q = model.integrate(q, step * min(1.0, _FARTHEST / max(longest, 1e-12)))
        if longest < _CONVERGED:
            break
    return q, float(residuals @ residuals)
