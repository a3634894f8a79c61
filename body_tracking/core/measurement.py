"""Measurement noise of a skeleton camera's joints, and the heading of a body.

The noise of a joint depends on its tracking state, its distance and the body's yaw to the sensor. Calibration, fusion
and filters all use this model.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from body_tracking.core.skeleton import BONES, BoolArray, FloatArray, Joint, TrackingState

# Standard deviation of a Tracked joint of a body that faces the sensor at 2 m, metres. Kinect v2 against markers:
# trunk and elbows about 20-40 mm, hand tips, thumbs and feet two to three times that (Wang 2015, Napoli 2017,
# Schlagenhauf 2017 table E.1).
_BASE = {
    0.030: ("SPINE_BASE", "SPINE_MID", "SPINE_SHOULDER", "NECK", "HEAD", "SHOULDER", "ELBOW", "HIP", "KNEE"),
    0.040: ("WRIST", "ANKLE"),
    0.050: ("HAND", "FOOT"),
    0.065: ("HAND_TIP", "THUMB"),
}


def _base_stddev() -> FloatArray:
    stddev = np.empty(len(Joint))
    kinds = {name: value for value, names in _BASE.items() for name in names}
    for joint in Joint:
        stddev[joint] = kinds[joint.name.removesuffix("_LEFT").removesuffix("_RIGHT")]
    return stddev


BASE_STDDEV: FloatArray = _base_stddev()
"""(25,) metres."""

INFERRED_FACTOR = 3.0
"""Factor on the standard deviation of an Inferred joint, which the SDK guesses."""

BONE_CORRELATION = 0.86
"""Correlation of the errors of the two joints of a bone: a skeleton camera displaces neighbouring joints alike, so that
bones have better directions than independent joints would give. With 0.87 the stated variance of the elbow matches the
errors of a Kinect v2 against Vicon that remain after the correction of the arms' directions, in people to whom the
correction was not fitted (``benchmarks/kinect_vs_vicon.py --fit``)."""

HEAD_CORRELATION = 0.65
"""The same of head and neck: Kinects v2 show the heads of three people who exercise at constant places between 40 mm to
the right and 65 mm to the left of the neck, and two sensors differ by 20 to 100 mm at one time (``kinect_pairs``)."""

GIRDLE_CORRELATION = BONE_CORRELATION**2
"""Correlation of the errors of the left and the right shoulder, and of both hips: two bones lie between them. With this
value the twist between shoulders and hips has a deviation of 11 degrees if all four joints have that of ``BASE_STDDEV``
times 1.2; independent joints would give 21. A Kinect v2 shows people who face it and move an arm (54 clips of UI-PRMD)
with twists whose deviation between the clips of one person is 4 to 15 degrees."""

COMMON_SHARE = 0.5
"""Share of the variance of a joint seen from the front that is the same before every sensor, so that several sensors do
not reduce it: clothes, and where the recognition places a joint. Two real Kinects side by side show the elevations of
three people 1 degree apart in the mean and 7 RMS about it, so that each errs by 5 on its own; against Vicon one errs by
7 (docs/tried.md, "What two sensors err by alike")."""

_LEFT_ENDS = np.array([Joint.SHOULDER_LEFT, Joint.HIP_LEFT], dtype=np.intp)
_RIGHT_ENDS = np.array([Joint.SHOULDER_RIGHT, Joint.HIP_RIGHT], dtype=np.intp)

_YAW_DEG = np.array([0.0, 30.0, 60.0, 90.0, 180.0])
_YAW_FACTOR = np.array([1.0, 1.0, 1.3, 3.2, 3.2])
"""Joint error against the body's yaw to the sensor: table 4.4 of Schlagenhauf 2017 (x1.3 at 60, x3.2 at 90 deg), and a
back view as bad as a side view."""

_REFERENCE_DISTANCE = 2.0


def joint_correlation(of_bones: float = BONE_CORRELATION) -> FloatArray:
    """(25, 25) correlation of the joints' errors, ``of_bones`` to the power of the number of bones between two joints.

    Head and neck have at most :data:`HEAD_CORRELATION`. This is the Gauss-Markov field on the tree of bones: given a
    joint, the two sides of it are independent. Outside the diagonal, the inverse has entries only for the two joints
    of a bone.

    Args:
        of_bones: correlation of the two joints of a bone, from 0 (independent) to less than 1.
    """
    return _tree_correlation(
        [(start, end, min(of_bones, HEAD_CORRELATION) if end == Joint.HEAD else of_bones) for start, end in BONES]
    )


def offset_correlation(of_bones: float = BONE_CORRELATION, of_girdles: float = GIRDLE_CORRELATION) -> FloatArray:
    """(25, 25) correlation of the joints' constant offsets from the anatomical joints.

    ``of_girdles`` between the shoulders and between the hips, as in :func:`joint_correlation` within a limb. None
    between the spine's joints and others: a camera may place a part of the spine in front of or behind shoulders and
    hips, as if the person bent (with correlated ones simulated people bend by 9 instead of 3 degrees).

    Args:
        of_bones: correlation of the two joints of a limb's bone, from 0 (independent) to less than 1.
        of_girdles: correlation of the left and the right joint, from 0 to less than 1.
    """
    sides = ("_LEFT", "_RIGHT")
    pairs = [(Joint[f"{name}_LEFT"], Joint[f"{name}_RIGHT"], of_girdles) for name in ("SHOULDER", "HIP")]
    limbs = [
        (start, end, of_bones)
        for start, end in BONES
        if Joint(start).name.endswith(sides) and Joint(end).name.endswith(sides)
    ]
    return _tree_correlation(pairs + limbs)


def _tree_correlation(edges: Iterable[tuple[int, int, float]]) -> FloatArray:
    """(25, 25) correlation along a tree, or several, of joints: the product of the edges' between two joints."""
    precision = np.eye(len(Joint))
    for start, end, shared in edges:
        both = [start, end]
        precision[both, both] += shared**2 / (1.0 - shared**2)
        precision[both, both[::-1]] -= shared / (1.0 - shared**2)
    correlation: FloatArray = np.linalg.inv(precision).astype(np.float64)
    return correlation


def left_right_axes(positions: FloatArray) -> FloatArray:
    """The left-right axes of shoulders and of hips.

    Args:
        positions: (..., 25, 3) metres, any frame.

    Returns:
        (..., 2, 3) metres: the vector from the right to the left shoulder, and that from the right to the left hip.
    """
    axes: FloatArray = positions.take(_LEFT_ENDS, axis=-2) - positions.take(_RIGHT_ENDS, axis=-2)
    return axes


def body_heading(positions: FloatArray) -> FloatArray:
    """The left-right axis of a body, from its shoulders and hips.

    Args:
        positions: (..., 25, 3) metres, any frame.

    Returns:
        (..., 3) metres: the mean of the vectors from right to left shoulder and from right to left hip; the one that is
        known where the other is not, as of a person behind a table.
    """
    axes = left_right_axes(positions)
    upper, lower = axes[..., 0, :], axes[..., 1, :]
    axis: FloatArray = 0.5 * (upper + lower)  # numpy's mean takes more than twice as long
    unknown = np.isnan(axis)
    if unknown.any():
        axis = np.where(unknown, np.where(np.isnan(lower), upper, lower), axis)
    return axis


def viewing_angle(positions: FloatArray) -> FloatArray:
    """The angle between a body's facing direction and the direction to the sensor, in the horizontal plane.

    Args:
        positions: (..., 25, 3) metres in a sensor's optical frame (x right, y down, z forward).

    Returns:
        (...) radians, 0 when the body faces the sensor, pi when it shows its back.
    """
    axis = body_heading(positions)
    centre = positions[..., Joint.SPINE_SHOULDER, :]
    # The body faces along left x up, with up = -y: (left_z, 0, -left_x).
    facing = np.arctan2(axis[..., 2], -axis[..., 0])
    to_sensor = np.arctan2(-centre[..., 0], -centre[..., 2])
    angle: FloatArray = np.abs((facing - to_sensor + np.pi) % (2 * np.pi) - np.pi)
    return angle


def joint_stddev(positions: FloatArray, states: np.ndarray, angle: FloatArray | None = None) -> FloatArray:
    """The standard deviation of each joint position, isotropic.

    Args:
        positions: (..., 25, 3) metres in the sensor's optical frame.
        states: (..., 25) tracking states.
        angle: (...) :func:`viewing_angle` of the positions; computed when None.

    Returns:
        (..., 25) metres; infinity for joints that are not tracked or not finite.
    """
    if angle is None:
        angle = viewing_angle(positions)
    yaw = np.interp(np.degrees(np.where(np.isfinite(angle), angle, np.pi / 2)), _YAW_DEG, _YAW_FACTOR)
    # Depth noise of a time-of-flight camera grows with distance; below the reference distance it is a floor.
    depth = positions[..., Joint.SPINE_MID, 2]
    distance = np.maximum(np.where(np.isfinite(depth), depth, _REFERENCE_DISTANCE) / _REFERENCE_DISTANCE, 1.0)
    stddev = BASE_STDDEV * (yaw * distance)[..., None]
    stddev = np.where(states == TrackingState.INFERRED, stddev * INFERRED_FACTOR, stddev)
    usable: BoolArray = (states > TrackingState.NOT_TRACKED) & np.isfinite(positions).all(axis=-1)
    result: FloatArray = np.where(usable, stddev, np.inf)
    return result


def back_view_factor(angle: float) -> float:
    """Factor on the variances of a frame that shows the back, of a sensor that takes every body to face it.

    The frame's own variances are those of a front view. At least 2: left and right may be swapped wrongly.

    Args:
        angle: :func:`viewing_angle` of the frame as the sensor reports it, radians.
    """
    front, back = np.interp(np.degrees([angle, np.pi - angle]), _YAW_DEG, _YAW_FACTOR)
    return max(2.0, float((back / front) ** 2))


def joint_variance(
    positions: FloatArray, states: np.ndarray, covariances: FloatArray | None, angle: FloatArray | None = None
) -> FloatArray:
    """The variance per axis of each joint position: stated by the sensor, else that of :func:`joint_stddev`.

    :data:`BASE_STDDEV` is the lower bound: a linear filter's deviations of angles assume that errors of neighbouring
    joints correlate as a Kinect's do (:data:`BONE_CORRELATION`). With the 15 mm that the fit of a mesh states, the
    elevation was within 1.96 deviations in 80 % of the frames; with the bound it is in 93 %.

    Args:
        positions: (25, 3) metres in the sensor's optical frame.
        states: (25,) tracking states.
        covariances: (25, 3, 3) square metres, or None where the sensor states none.
        angle: :func:`viewing_angle` of the positions; computed when None.

    Returns:
        (25,) square metres, of stated covariances the mean over the axes; infinity for joints that are not tracked or
        not finite.
    """
    if covariances is None:
        return joint_stddev(positions, states, angle) ** 2
    stated = covariances.trace(axis1=1, axis2=2) / 3.0
    usable = (states > TrackingState.NOT_TRACKED) & np.isfinite(positions).all(axis=1) & (stated >= 0.0)
    variance: FloatArray = np.where(usable, np.maximum(stated, BASE_STDDEV**2), np.inf)
    return variance
