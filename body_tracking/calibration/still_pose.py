"""The thesis's calibration: one still pose, averaged over 50 frames (Schlagenhauf 2017, section 5.3.1)."""

from __future__ import annotations

import numpy as np

from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from body_tracking.core.skeleton import BoolArray, FloatArray, Joint, TrackingState

FRAMES = 50
"""Frames in the average, as in the thesis ("less than two seconds")."""

STILL_DRIFT = 0.035
"""Largest median change of the joints' mean positions between both halves of a still pose's frames, metres: a sensor's
error drifts by a few centimetres."""

STILL_STDDEV = 0.06
"""... and largest 80 % quantile of the joints' standard deviations, metres."""

LONGEST = 5.0
"""Longest duration of the fifty frames, seconds."""


def is_still(stamps: FloatArray, positions: FloatArray) -> bool:
    """Whether a person holds a pose.

    Args:
        stamps: (n,) seconds.
        positions: (n, 25, 3) metres in any fixed frame.
    """
    if len(stamps) < FRAMES or stamps[-1] - stamps[0] > LONGEST:
        return False
    half = len(stamps) // 2
    drift = np.linalg.norm(positions[:half].mean(axis=0) - positions[half:].mean(axis=0), axis=-1)
    stray = np.linalg.norm(positions.std(axis=0), axis=-1)
    seen = np.isfinite(drift)
    if seen.sum() < 3:
        return False
    return bool(np.median(drift[seen]) < STILL_DRIFT and np.quantile(stray[seen], 0.8) < STILL_STDDEV)


def is_t_pose(positions: FloatArray) -> bool:
    """Whether both arms are stretched out sideways, on average.

    Args:
        positions: (n, 25, 3) metres, any frame, NaN where unknown. The result is False if a joint of the arms is
            unknown in all frames.
    """
    known = np.isfinite(positions)
    with np.errstate(invalid="ignore"):
        pose = np.where(known, positions, 0.0).sum(axis=0) / known.sum(axis=0)
    across = pose[Joint.SHOULDER_LEFT] - pose[Joint.SHOULDER_RIGHT]
    arms = (pose[Joint.WRIST_LEFT] - pose[Joint.SHOULDER_LEFT], pose[Joint.SHOULDER_RIGHT] - pose[Joint.WRIST_RIGHT])
    return all(float(arm @ across) > 0.85 * float(np.linalg.norm(arm) * np.linalg.norm(across)) for arm in arms)


def average(positions: FloatArray, states: np.ndarray) -> tuple[FloatArray, BoolArray]:
    """Mean pose (25, 3), and which joints were Tracked in more than half of the frames."""
    tracked = (states == TrackingState.TRACKED) & np.isfinite(positions).all(axis=-1)
    count = tracked.sum(axis=0)
    total = np.where(tracked[..., None], positions, 0.0).sum(axis=0)
    return total / np.maximum(count, 1)[:, None], count > len(positions) / 2


def still_pose_registration(
    reference: tuple[FloatArray, np.ndarray], sensor: tuple[FloatArray, np.ndarray]
) -> tuple[FloatArray, FloatArray, float]:
    """Average two sensors' frames of one pose, and register the averages on every joint that both track.

    Schlagenhauf 2017, section 5.3.1; she takes all 25 joints of a T-pose.

    Args:
        reference: positions (n, 25, 3) metres and states (n, 25) of the reference sensor.
        sensor: positions and states of the other sensor.

    Returns:
        R (3, 3) and t (3,) metres that take the sensor's coordinates into the reference's (eq. 5.1), and the mean
        residual in metres.

    Raises:
        CalibrationError: fewer than three joints tracked by both.
    """
    target, target_known = average(*reference)
    source, source_known = average(*sensor)
    both = target_known & source_known
    if both.sum() < 3:
        raise CalibrationError(f"{both.sum()} joints are tracked by both sensors, at least 3 are needed")
    rotation, translation = rigid_registration(target[both], source[both])
    residual = np.linalg.norm(target[both] - source[both] @ rotation.T - translation, axis=-1)
    return rotation, translation, float(residual.mean())
