"""The pose of one sensor against another, from a moving person.

The systematic error of a Kinect skeleton depends on the viewing direction and is constant while a person stands and
faces the same way, so that averaging more frames of one pose does not reduce it. The estimator therefore has an unknown
constant offset per joint in addition to the pose. Offsets and pose are ambiguous for a still person, and the stated
uncertainty is large; motion separates them. Offsets average out over places and headings, so their prior variance falls
with the number of these.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from body_tracking.core.measurement import body_heading
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint

MIDLINE: IntArray = np.array(
    [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.NECK, Joint.HEAD], dtype=np.intp
)
"""Joints that do not change when left and right are swapped."""

_SWEEPS = 15
"""Sweeps over the blocks."""

OFFSET_STDDEV = 0.06
"""Prior of the constant offset of a joint between two sensors, metres (from pairs of Kinect v2 at 45 to 90 degrees)."""

CAUCHY = 1.3
"""Scale of the Cauchy weights, in standard deviations."""

FRAMES_PER_SAMPLE = 10.0
"""Pairs of frames, 0.1 s apart, per independent observation."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Frames of two sensors at the same instants.

    Attributes:
        reference: (n, 25, 3) metres in the reference sensor's optical frame.
        sensor: (n, 25, 3) metres in the sensor's optical frame, interpolated to the reference stamps.
        variance: (n, 25) square metres, the sum of both sensors' variances; infinity where either has no joint.
        places: number of distinct places and headings of the body among them.
    """

    reference: FloatArray
    sensor: FloatArray
    variance: FloatArray
    places: int

    def __len__(self) -> int:
        return len(self.reference)

    def first(self, count: int) -> Pairs:
        """The first of them."""
        return replace(
            self, reference=self.reference[:count], sensor=self.sensor[:count], variance=self.variance[:count]
        )


@dataclass(frozen=True, slots=True, eq=False)
class PairEstimate:
    """``reference = rotation @ sensor + translation``.

    Attributes:
        rotation: (3, 3).
        translation: (3,) metres.
        covariance: (6, 6) of (rotation vector about ``centre``, translation there), square radians and metres.
        centre: (3,) metres, where the person was on average, in the reference frame.
        residual: median distance between both sensors' positions of a joint, metres.
        cost: robust cost of all pairs, for comparing estimates from the same pairs.
        turned: share of frames in which one sensor sees the body reversed or swapped.
    """

    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray
    centre: FloatArray
    residual: float
    cost: float
    turned: float

    @property
    def rotation_stddev(self) -> float:
        """Radians, about the least accurate axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def translation_stddev(self) -> float:
        """Metres, at the person's mean place, along the least accurate axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]))


def same_sense(reference: FloatArray, sensor_in_reference: FloatArray) -> BoolArray:
    """Frames in which both sensors give the body's left-right axis the same sense.

    Args:
        reference: (n, 25, 3) metres.
        sensor_in_reference: (n, 25, 3) metres, same frame.

    Returns:
        (n,) false where one of them sees the body reversed or its sides swapped.
    """
    return _same_sense(body_heading(reference), body_heading(sensor_in_reference))


def _same_sense(heading: FloatArray, other: FloatArray) -> BoolArray:
    same: BoolArray = np.einsum("ni,ni->n", heading, other) > 0.0
    return same


def residual(pairs: Pairs, rotation: FloatArray, translation: FloatArray) -> float:
    """Median distance between both sensors' positions of a joint at a pose, metres.

    Args:
        pairs: at least one, with a joint that both sensors see.
        rotation: (3, 3) of the sensor in the reference's frame.
        translation: (3,) metres.
    """
    apart = np.linalg.norm(pairs.reference - pairs.sensor @ rotation.T - translation, axis=2)
    return float(np.median(apart[np.isfinite(pairs.variance)]))


def shared_motion(pairs: Pairs, rotation: FloatArray) -> float:
    """Share of the joints' motion in the reference sensor that the other one sees as well.

    Near 1 where both see one person move, about 0 or less where they see different people, or one who stands still.

    Args:
        pairs: at least two.
        rotation: (3, 3) of the sensor in the reference's frame.
    """
    known = np.isfinite(pairs.variance)
    own, theirs = (np.where(known[..., None], each, np.nan) for each in (pairs.reference, pairs.sensor @ rotation.T))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of a joint that is in no pair
        moved, seen = (each - np.nanmean(each, axis=0) for each in (own, theirs))
    return 1.0 - float(np.nansum((moved - seen) ** 2) / max(float(np.nansum(moved**2)), 1e-12))


def start_from_midline(pairs: Pairs) -> tuple[FloatArray, FloatArray] | None:
    """A start from the spines, independent of left and right.

    Returns:
        Rotation and translation, or None while the person's motion does not determine the rotation about the vertical.
    """
    usable = np.isfinite(pairs.variance[:, MIDLINE]).all(axis=1)
    if usable.sum() < 10:
        return None
    target, source = pairs.reference[usable][:, MIDLINE], pairs.sensor[usable][:, MIDLINE]
    if np.linalg.norm(target[:, 0].std(axis=0)) < 0.25:
        return None
    try:
        return rigid_registration(target.reshape(-1, 3), source.reshape(-1, 3))
    except CalibrationError:
        return None


def estimate(pairs: Pairs, rotation: FloatArray, translation: FloatArray) -> PairEstimate:
    """Refine a pose by iteratively reweighted least squares.

    Minimises over R, t and the joints' offsets b

        sum_nj rho(|a_nj - R s_nj - t - b_j| / sigma_nj) + sum_j |b_j|^2 / (2 sigma_b^2)

    with Cauchy's rho, without reversed or swapped frames, in blocks: pose by the SVD, offsets in closed form, weights
    from the residuals.

    Args:
        pairs: at least ten.
        rotation: (3, 3) start.
        translation: (3,) start, metres.

    Raises:
        CalibrationError: too few pairs, or none in which the sensors agree on left and right.
    """
    if len(pairs) < 10:
        raise CalibrationError(f"{len(pairs)} pairs of frames, at least 10 are needed")
    # Coordinates and joints first: numpy takes several times as long for many short rows as for a few long ones.
    known = np.isfinite(pairs.variance.T)
    precision = np.where(known, 1.0 / np.where(known, pairs.variance.T, 1.0), 0.0)
    reference, sensor = (
        np.where(known, each.transpose(2, 1, 0), 0.0).reshape(3, -1) for each in (pairs.reference, pairs.sensor)
    )
    headings = body_heading(pairs.reference), body_heading(pairs.sensor)
    offset_precision = (1.0 + pairs.places / 4.0) / OFFSET_STDDEV**2
    offsets = np.zeros((3, len(known), 1))

    rotation, translation = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    sweep = 0
    while True:
        rotated = rotation @ sensor
        error = (reference - rotated - translation[:, None]).reshape(3, *known.shape)
        left = error - offsets
        squared = (left * left).sum(axis=0) * precision
        same = _same_sense(headings[0], headings[1] @ rotation.T)
        if same.sum() < 5:
            raise CalibrationError("the sensors do not agree on the body's left and right in any frame")
        weights = precision / (1.0 + squared / CAUCHY**2) * same
        if sweep == _SWEEPS:
            break
        sweep += 1
        total = weights.sum(axis=1, keepdims=True) / FRAMES_PER_SAMPLE
        pull = (weights * error).sum(axis=2, keepdims=True) / FRAMES_PER_SAMPLE
        offsets = pull / (total + offset_precision)
        moved = (reference.reshape(error.shape) - offsets).reshape(3, -1)
        rotation, translation = rigid_registration(moved.T, sensor.T, weights.reshape(-1))

    centre = reference @ weights.reshape(-1) / weights.sum()
    arms = (rotated + (translation - centre)[:, None]).reshape(error.shape)
    return PairEstimate(
        rotation,
        translation,
        _covariance(weights.T / FRAMES_PER_SAMPLE, arms.transpose(2, 1, 0), offset_precision),
        centre,
        float(np.median(np.sqrt((error * error).sum(axis=0))[known])),
        float(np.log1p(squared[known]).sum()),
        float(1.0 - same.mean()),
    )


def _covariance(weights: FloatArray, arms: FloatArray, offset_precision: float) -> FloatArray:
    """(6, 6) covariance of a small rotation and translation, the joints' offsets marginalised.

    With r_nj = b_j + dt - [arm_nj]x dtheta the information of one joint is a sum of W = sum w, m = sum w arm and
    S = sum w (|arm|^2 I - arm arm'); eliminating b_j with its prior p subtracts the square of its coupling / (W + p).
    """
    total: FloatArray = weights.sum(axis=0)
    first = np.einsum("nj,nji->ji", weights, arms)
    second = np.einsum("nj,nji,njk->ik", weights, arms, arms)
    kept = offset_precision / (total + offset_precision)
    lost = 1.0 / (total + offset_precision)
    cross = np.zeros((len(first), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = first
    cross[:, [1, 2, 0], [2, 0, 1]] = -first
    information = np.zeros((6, 6))
    information[:3, :3] = np.trace(second) * np.eye(3) - second - np.einsum("j,jki,jkl->il", lost, cross, cross)
    information[:3, 3:] = np.einsum("j,jik->ik", kept, cross)
    information[3:, :3] = information[:3, 3:].T
    information[3:, 3:] = (kept * total).sum() * np.eye(3)
    covariance: FloatArray = np.linalg.inv(information + 1e-9 * np.eye(6)).astype(np.float64)
    return covariance
