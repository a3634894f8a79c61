"""The whole of Schlagenhauf (2017), chapter 5, as a baseline: calibrate, pair, fuse, filter. For others to import.

As published, with the errors of DESIGN 4 (1-3) corrected and nothing else: one registration from the first 50 frames,
in the T-pose (section 5.3.1); whatever each sensor said last, taken together when the first one speaks (section 5.2:
two computers, no common clock); weights by the tracking states as her text has them (section 5.3.2); LKF1 and LKF2
(algorithm 1, eq. 5.11-5.12) with a fixed step of 1/30 s, constant noise and no gate, or her extended filter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.calibration.result import level_pose
from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.still_pose import FRAMES, still_pose_registration
from body_tracking.filters.schlagenhauf import SchlagenhaufKalmanFilter
from body_tracking.fusion.weights import thesis_text
from body_tracking.sensors import RecordedFrame
from body_tracking.skeleton import N_JOINTS, BoolArray, FloatArray, Skeleton, TrackingState

LKF1: Final = "thesis LKF1"
LKF2: Final = "thesis LKF2"
EKF: Final = "thesis EKF"
FUSED: Final = "thesis fused"

PROCESS_NOISE = 0.005
"""Q of both linear filters (figures 5.7 and 5.9): variance added in every frame to each position and velocity."""
MEASUREMENT_NOISE = 0.001
"""R, which she does not state. The output hardly lags behind with it and is as smooth as her figures show; with a tenth
of it the filters pass on what they are given, with ten times as much they lag behind."""
_STEP = 1.0 / 30.0


class ThesisLinearFilter:
    """Algorithm 1 for 25 joints, whose axes are alike; a missing joint has no gain (eq. 5.21-5.22).

    Args:
        velocity: LKF2, whose state has velocities (eq. 5.12); else LKF1 (eq. 5.11).
        process: Q, the diagonal of all states.
        measurement: R, of each coordinate.
    """

    def __init__(
        self, *, velocity: bool, process: float = PROCESS_NOISE, measurement: float = MEASUREMENT_NOISE
    ) -> None:
        self._f = np.array([[1.0, _STEP], [0.0, 1.0]]) if velocity else np.eye(1)
        size = len(self._f)
        self._q, self._r = process * np.eye(size), measurement
        self._s = np.full((N_JOINTS, size, 3), np.nan)
        self._p = np.zeros((N_JOINTS, size, size))

    def update(self, skeleton: Skeleton) -> Skeleton:
        """One frame."""
        seen: BoolArray = skeleton.valid
        new = seen & ~np.isfinite(self._s[:, 0, 0])
        self._s[new] = 0.0
        self._s[new, 0] = skeleton.positions[new]
        self._p[new] = self._r * np.eye(len(self._q))
        self._s = self._f @ self._s
        self._p = self._f @ self._p @ self._f.T + self._q
        old = seen & ~new
        gain = self._p[old, :, :1] / (self._p[old, :1, :1] + self._r)
        innovation = skeleton.positions[old, None, :] - self._s[old, :1]
        self._s[old] += gain * innovation
        self._p[old] -= gain @ self._p[old, :1]
        positions = self._s[:, 0].copy()
        known = np.isfinite(positions[:, 0])
        states = np.where(seen, skeleton.states, np.where(known, TrackingState.INFERRED, 0)).astype(np.uint8)
        return Skeleton(skeleton.stamp_ns, skeleton.frame_id, positions, states, skeleton.body)


_FILTERS: Final[dict[str, Callable[[], ThesisLinearFilter | SchlagenhaufKalmanFilter]]] = {
    LKF1: lambda: ThesisLinearFilter(velocity=False),
    LKF2: lambda: ThesisLinearFilter(velocity=True),
    EKF: SchlagenhaufKalmanFilter,
}


@dataclass(frozen=True, slots=True, eq=False)
class ThesisResult:
    """What her system makes of a recording, in ``world`` as its first sensor, which stands level, defines it.

    Attributes:
        outputs: of each method, one skeleton per frame of the first sensor, stamped by it.
    """

    outputs: dict[str, list[Skeleton]]


def run_thesis(
    frames: Sequence[RecordedFrame], sensors: Sequence[str], methods: Sequence[str] = (LKF1, LKF2, EKF)
) -> ThesisResult:
    """Her pipeline over frames in the order of receipt.

    Args:
        frames: of all sensors.
        sensors: the first is the one that all others are brought together with.
        methods: which of her filters to run.

    Raises:
        CalibrationError: a sensor has less than 50 frames, or shows too little in them.
    """
    level = level_pose(sensors[0]).rotation
    registrations = {sensors[0]: (level, np.zeros(3))}
    opening = {name: _opening(frames, name) for name in sensors}
    for other in sensors[1:]:
        rotation, translation, _ = still_pose_registration(opening[sensors[0]], opening[other])
        registrations[other] = level @ rotation, level @ translation
    filters = {name: _FILTERS[name]() for name in methods}
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
    return ThesisResult(outputs)


def _opening(frames: Sequence[RecordedFrame], sensor: str) -> tuple[FloatArray, np.ndarray]:
    """Positions (50, 25, 3) and states (50, 25) of a sensor's first frames."""
    own = [frame.skeletons[0] for frame in frames if frame.sensor == sensor and frame.skeletons][:FRAMES]
    if len(own) < FRAMES:
        raise CalibrationError(f"{sensor}: {len(own)} frames, the thesis's calibration takes {FRAMES}")
    return np.stack([each.positions for each in own]), np.stack([each.states for each in own])


def _fused(seen: Sequence[tuple[Skeleton, FloatArray, FloatArray]]) -> Skeleton:
    """Eq. 5.8 of skeletons, each with its rotation and translation into ``world``."""
    states = np.stack([np.where(each.valid, each.states, 0) for each, _, _ in seen])
    weights = thesis_text(states)
    placed = np.stack([each.positions @ rotation.T + translation for each, rotation, translation in seen])
    best = states.max(axis=0)
    positions = (weights[..., None] * np.where(weights[..., None] > 0.0, placed, 0.0)).sum(axis=0)
    positions[best == TrackingState.NOT_TRACKED] = np.nan
    first = seen[0][0]
    return Skeleton(first.stamp_ns, "world", positions, best.astype(np.uint8), first.body)
