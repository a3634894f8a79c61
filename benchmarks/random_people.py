"""Random people with random motions, their ground truth, and white-noise measurements of them.

Data for tests of the filters of the body model: everything obeys the model (``upper_body`` with its ranges of motion),
so all errors are the filter's. The caller passes a seeded generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.skeleton import (
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion

START_NS = 1_000 * NANOSECONDS
"""Stamp of time 0."""

STATURES = (1.5, 2.0)
"""Least and greatest stature, metres."""
_PROPORTION_STDDEV = 0.06
_ASYMMETRY = (0.01, 0.02)
"""Range of the relative difference between left and right."""


@dataclass(frozen=True, slots=True, eq=False)
class RandomPerson:
    """A body.

    Attributes:
        stature: metres.
        lengths: (21,) metres, as ``UpperBody.length_names``.
    """

    stature: float
    lengths: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> RandomPerson:
        """A person of 1.5 to 2.0 m with 6 % standard deviation of proportions, left and right 1 to 2 % different."""
        stature = rng.uniform(*STATURES)
        lengths = MODEL.default_lengths(stature)
        kinds = [name.removesuffix("_left").removesuffix("_right") for name in MODEL.length_names]
        factors = {kind: 1.0 + _PROPORTION_STDDEV * np.clip(rng.normal(), -2.5, 2.5) for kind in dict.fromkeys(kinds)}
        apart = {kind: rng.choice([-0.5, 0.5]) * rng.uniform(*_ASYMMETRY) for kind in factors}
        for number, (name, kind) in enumerate(zip(MODEL.length_names, kinds, strict=True)):
            side = 1.0 if name.endswith("_left") else -1.0 if name.endswith("_right") else 0.0
            lengths[number] *= factors[kind] * (1.0 + side * apart[kind])
        return cls(stature, lengths)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of a person at n instants.

    Attributes:
        times: (n,) seconds.
        q: (n, 35) configurations of ``UpperBody``.
        velocity: (n, 32) tangent velocities, per second.
        lengths: (21,) metres.
        positions: (n, 19, 3) metres, ``UpperBody.joints`` in world.
        speeds: (n, 19) speeds of these points, m/s.
    """

    times: FloatArray
    q: FloatArray
    velocity: FloatArray
    lengths: FloatArray
    positions: FloatArray
    speeds: FloatArray


def capture_times(duration: float, rng: np.random.Generator, rate: float = 30.0) -> FloatArray:
    """(n,) capture times of a sensor in seconds, ascending, at a rate in Hz with a jitter of 1 ms."""
    times = np.arange(0.0, duration, 1.0 / rate)
    # stamps are whole nanoseconds
    moved = times + np.clip(rng.normal(scale=0.001, size=len(times)), -0.3 / rate, 0.3 / rate)
    result: FloatArray = np.round(moved * NANOSECONDS) / NANOSECONDS
    return result


def truth_of(person: RandomPerson, motion: RandomMotion, times: FloatArray) -> Truth:
    """The ground truth at (n,) seconds."""
    # central differences of the closed form, accurate to 1e-5
    before, q, after = (motion.configuration(times + step) for step in (-1e-4, 0.0, 1e-4))
    velocity = MODEL.difference(before, after) / 2e-4
    linear = MODEL.linearise(q, person.lengths)
    speeds = np.linalg.norm((linear.jacobian @ velocity[:, None, :, None])[..., 0], axis=-1)
    return Truth(times, q, velocity, person.lengths, linear.posture.positions, speeds)


ARMS: Final[dict[str, tuple[Joint, ...]]] = {
    side: tuple(Joint[f"{part}_{side}"] for part in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB"))
    for side in ("LEFT", "RIGHT")
}
"""The joints of an arm except the shoulder."""
EVERYTHING: Final = tuple(Joint)
_LOSABLE: Final = (
    ARMS["LEFT"],
    ARMS["RIGHT"],
    (Joint.SHOULDER_LEFT, *ARMS["LEFT"]),
    (Joint.SHOULDER_RIGHT, *ARMS["RIGHT"]),
    ARMS["LEFT"][1:],
    ARMS["RIGHT"][1:],
    (*ARMS["LEFT"], *ARMS["RIGHT"]),
    (Joint.HEAD, Joint.NECK),
    (Joint.SPINE_BASE, Joint.HIP_LEFT, Joint.HIP_RIGHT),
    (Joint.SPINE_MID, Joint.SPINE_SHOULDER),
)


@dataclass(frozen=True, slots=True)
class Dropout:
    """Joints that are lost from ``begin`` to ``end``, seconds."""

    begin: float
    end: float
    joints: tuple[Joint, ...]


def draw_dropouts(
    rng: np.random.Generator,
    count: int,
    between: tuple[float, float],
    longest: float = 1.0,
    everything: float = 0.0,
) -> tuple[Dropout, ...]:
    """Dropouts of a limb, of the head, of a part of the trunk, or of a few joints.

    Args:
        rng: random generator.
        count: number of dropouts.
        between: seconds within which they lie.
        longest: seconds; the shortest is 0.1 s.
        everything: probability that a dropout affects all joints.
    """
    dropouts = []
    for _ in range(count):
        length = min(rng.uniform(0.1, longest), between[1] - between[0])
        begin = rng.uniform(between[0], between[1] - length)
        if rng.random() < everything:
            joints = EVERYTHING
        elif rng.random() < 0.8:
            joints = _LOSABLE[rng.integers(len(_LOSABLE))]
        else:
            some = rng.choice(MODEL.joints, size=int(rng.integers(1, 7)), replace=False)
            joints = tuple(Joint(joint) for joint in some)
        dropouts.append(Dropout(begin, begin + length, joints))
    return tuple(dropouts)


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementErrors:
    """Errors of the measurements.

    Attributes:
        noise: standard deviation per axis of the white Gaussian noise, metres.
        factors: (25,) of the noise per joint; None for 1.
        dropouts: of joints.
        gaps: (begin, end) seconds without any frame.
        outliers: share of the joint samples that are displaced in a random direction.
        outlier_size: largest displacement, metres; uniform from 0.
        outliers_between: seconds within which there are outliers.
    """

    noise: float
    factors: FloatArray | None = None
    dropouts: tuple[Dropout, ...] = ()
    gaps: tuple[tuple[float, float], ...] = ()
    outliers: float = 0.0
    outlier_size: float = 1.0
    outliers_between: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Measurements at n instants.

    Attributes:
        skeletons: of the frames that arrived, in the frame ``world``.
        frames: for each skeleton the index of its instant in the truth.
        seen: (n, 19) whether a point of the model was measured; False in a gap.
        outlier: (n, 19) whether the measurement is an outlier.
    """

    skeletons: tuple[Skeleton, ...]
    frames: IntArray
    seen: BoolArray
    outlier: BoolArray


def observe(truth: Truth, errors: MeasurementErrors, rng: np.random.Generator) -> Observation:
    """Measure skeletons, without covariances; joints of the legs, which the model lacks, are NOT_TRACKED."""
    times, points = truth.times, MODEL.joints
    shape = (len(times), len(points))
    seen: BoolArray = np.ones(shape, dtype=np.bool_)
    for dropout in errors.dropouts:
        during = (times >= dropout.begin) & (times < dropout.end)
        seen &= ~(during[:, None] & np.isin(points, dropout.joints))
    arrived: BoolArray = np.ones(len(times), dtype=np.bool_)
    for begin, end in errors.gaps:
        arrived &= (times < begin) | (times >= end)
    seen &= arrived[:, None]

    scale = errors.noise * (np.ones(len(points)) if errors.factors is None else errors.factors[points])
    measured = truth.positions + scale[:, None] * rng.normal(size=(*shape, 3))
    begin, end = errors.outliers_between
    during = (times >= begin) & (times < end)
    outlier: BoolArray = (rng.random(shape) < errors.outliers) & during[:, None] & seen
    direction = rng.normal(size=(*shape, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    measured += (outlier * rng.uniform(0.0, errors.outlier_size, shape))[..., None] * direction

    positions = np.full((len(times), N_JOINTS, 3), np.nan)
    positions[:, points] = np.where(seen[..., None], measured, np.nan)
    states = np.full((len(times), N_JOINTS), TrackingState.NOT_TRACKED, dtype=np.uint8)
    states[:, points] = np.where(seen, TrackingState.TRACKED, TrackingState.NOT_TRACKED)
    frames = np.flatnonzero(arrived)
    skeletons = tuple(
        Skeleton(START_NS + round(times[k] * NANOSECONDS), "world", positions[k], states[k]) for k in frames
    )
    return Observation(skeletons, frames, seen, outlier)
