"""The whole of Schlagenhauf (2017), chapter 5, as a baseline: calibrate, pair, fuse, filter. For others to import.

As published; only its three errors (transposed rotation, weights, innovation) are corrected. One registration from the
first 50 frames, in the T-pose (section 5.3.1). The latest skeleton of each sensor is fused at each frame of the first
sensor (section 5.2: two computers, no common clock). Weights by the tracking states as in her text (section 5.3.2).
LKF1, LKF2 or her extended filter from ``filters.thesis`` and ``filters.schlagenhauf``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.still_pose import FRAMES, still_pose_registration
from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import FloatArray, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.filters import make_filter
from body_tracking.filters.schlagenhauf import SCHLAGENHAUF_EKF
from body_tracking.filters.thesis import THESIS_LKF1, THESIS_LKF2
from body_tracking.fusion.weights import thesis_text

LKF1: Final = "thesis LKF1"
LKF2: Final = "thesis LKF2"
EKF: Final = "thesis EKF"
FUSED: Final = "thesis fused"

_FILTERS: Final = {LKF1: THESIS_LKF1, LKF2: THESIS_LKF2, EKF: SCHLAGENHAUF_EKF}


def run_thesis(
    frames: Sequence[RecordedFrame], sensors: Sequence[str], methods: Sequence[str] = (LKF1, LKF2, EKF)
) -> dict[str, list[Skeleton]]:
    """Her pipeline (figure 5.1) over frames in the order of receipt.

    Returns:
        For each method one skeleton per frame of the first sensor, with its stamp, in the ``world`` defined by this
        sensor, which is assumed to stand level.

    Args:
        frames: of all sensors.
        sensors: the others are registered to the first one.
        methods: which of her filters to run.

    Raises:
        CalibrationError: a sensor has less than 50 frames, or too few tracked joints in them.
    """
    level = level_pose(sensors[0]).rotation
    registrations = {sensors[0]: (level, np.zeros(3))}
    opening = {name: _opening(frames, name) for name in sensors}
    for other in sensors[1:]:
        rotation, translation, _ = still_pose_registration(opening[sensors[0]], opening[other])
        registrations[other] = level @ rotation, level @ translation
    filters = {name: make_filter(_FILTERS[name]) for name in methods}
    outputs: dict[str, list[Skeleton]] = {FUSED: [], **{name: [] for name in filters}}
    last: dict[str, Skeleton] = {}
    for frame in frames:
        if not frame.skeletons:
            continue
        last[frame.sensor] = frame.skeletons[0]
        if frame.sensor != sensors[0] or len(last) < len(sensors):
            continue
        fused = _fused([(last[name], *registrations[name]) for name in sensors])
        outputs[FUSED].append(fused)
        for name, filter_ in filters.items():
            if (out := filter_.update(fused)) is not None:
                outputs[name].append(out)
    return outputs


def _opening(frames: Sequence[RecordedFrame], sensor: str) -> tuple[FloatArray, np.ndarray]:
    """Positions (50, 25, 3) and states (50, 25) of a sensor's first frames."""
    own = [frame.skeletons[0] for frame in frames if frame.sensor == sensor and frame.skeletons][:FRAMES]
    if len(own) < FRAMES:
        raise CalibrationError(f"{sensor}: {len(own)} frames, the thesis's calibration takes {FRAMES}")
    return np.stack([each.positions for each in own]), np.stack([each.states for each in own])


def _fused(seen: Sequence[tuple[Skeleton, FloatArray, FloatArray]]) -> Skeleton:
    """Fusion by eq. 5.8 of skeletons, each with its rotation and translation into ``world``."""
    states = np.stack([np.where(each.valid, each.states, 0) for each, _, _ in seen])
    weights = thesis_text(states)
    placed = np.stack([each.positions @ rotation.T + translation for each, rotation, translation in seen])
    best = states.max(axis=0)
    positions = (weights[..., None] * np.where(weights[..., None] > 0.0, placed, 0.0)).sum(axis=0)
    positions[best == TrackingState.NOT_TRACKED] = np.nan
    first = seen[0][0]
    return Skeleton(first.stamp_ns, "world", positions, best.astype(np.uint8), first.body)
