"""Whether somebody holds a pose by which sensors can be aligned: by what they feel, and by what a camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.measurement import body_heading
from body_tracking.core.skeleton import FloatArray, Skeleton
from body_tracking.inertial.alignment import (
    StillPeriod,
    Stream,
    pose_covariance,
    pose_of,
    pose_rotations,
    still_periods,
    yaw,
)
from body_tracking.inertial.heading import bone_of
from body_tracking.inertial.parameters import AUTO, POSES
from body_tracking.kinematics.upper_body import UpperBody

_FACING: Final = float(np.radians(8.0))
"""Radians by which a skeleton's shoulders tell wrongly where a person faces."""
_CAMERA_CONE: Final = float(np.radians(40.0))
"""Radians within which a camera sees the arms as a pose has them."""
_RECENT = 0.5
"""Seconds since which a pose must have been held."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldPose:
    """A pose, and what was felt in it.

    Attributes:
        name: of the parameters' ``POSES``.
        streams: of the sensors, while it was held.
        facing: radians from world's x, which way a camera saw the person face; None without one.
    """

    name: str
    streams: tuple[Stream, ...]
    facing: float | None


class PoseFinder:
    """Finds poses of a body model's."""

    def __init__(self, model: UpperBody) -> None:
        self._model = model
        self._rotations = {name: pose_rotations(model, pose) for name, pose in POSES.items()}

    def rotations(self, name: str, segments: Sequence[str]) -> FloatArray:
        """(k, 3, 3) orientations of segments in a pose of somebody who faces x."""
        return self._rotations[name][[self._model.segment_names.index(each) for each in segments]]

    def covariance(self, held: HeldPose, segments: Sequence[str], stddev: float) -> FloatArray:
        """(3 k, 3 k) radians squared by which segments are off a pose, and off where the person seems to face.

        Args:
            held: the pose.
            segments: k names.
            stddev: radians by which joints are off it, per axis.
        """
        spread = pose_covariance(self._model, POSES[held.name], segments, stddev)
        if held.facing is None:
            return spread
        up = (yaw(held.facing) @ self.rotations(held.name, segments))[:, 2].reshape(-1)
        facing: FloatArray = spread + _FACING**2 * np.outer(up, up)
        return facing

    def find(
        self,
        streams: Sequence[Stream],
        meant: FloatArray,
        wanted: str,
        now: float,
        seen: Sequence[tuple[float, Skeleton]],
        *,
        asked: bool,
    ) -> HeldPose | None:
        """The pose that is held now.

        Args:
            streams: k sensors, of the last seconds.
            meant: (k, 3, 3) segment to sensor, as they were meant to be put on.
            wanted: of the parameters: one of ``POSES``, or ``auto``.
            now: seconds.
            seen: skeletons of a camera of the same time with their stamps in seconds; none without a camera.
            asked: somebody said that the pose is held.

        Returns:
            None where it is another one, where the camera sees another one or not which way the person faces, and where
            neither arms, nor a camera, nor anybody tells a pose from sitting still.
        """
        periods = still_periods(streams)
        if not periods or periods[-1].end < now - _RECENT:
            return None
        period = periods[-1]
        name = wanted
        if name == AUTO:
            pose = pose_of(streams, meant, period)
            if pose is None:
                return None
            name = next(each for each, letter in POSES.items() if letter == pose)
        facing = None
        if seen:
            facing = _faced(period, seen)
            if facing is None or not self._looks_like(seen[-1][1], name):
                return None
        elif not asked and not any(stream.segment.startswith("upper_arm") for stream in streams):
            return None  # forearms alone do not tell a pose from hands on a table
        return HeldPose(name, tuple(stream.between(period.begin, period.end) for stream in streams), facing)

    def _looks_like(self, skeleton: Skeleton, name: str) -> bool:
        """Whether a camera sees the arms in a pose, as far as it sees them."""
        facing = _facing(skeleton)
        if facing is None:
            return False
        valid = skeleton.valid
        for segment in (f"{part}_{side}" for side in ("left", "right") for part in ("upper_arm", "forearm")):
            bone = bone_of(segment)
            assert bone is not None
            if not (valid[bone.start] and valid[bone.end]):
                continue
            way = skeleton.positions[bone.end] - skeleton.positions[bone.start]
            expected = yaw(facing) @ self.rotations(name, [segment])[0] @ bone.axis
            if float(way @ expected) < np.cos(_CAMERA_CONE) * float(np.linalg.norm(way)):
                return False
        return True


def _faced(period: StillPeriod, seen: Sequence[tuple[float, Skeleton]]) -> float | None:
    """Radians from world's x, which way the person faced meanwhile, as a camera saw it."""
    found = [_facing(skeleton) for stamp, skeleton in seen if period.begin <= stamp <= period.end]
    turns = np.exp(1j * np.array([each for each in found if each is not None]))
    return float(np.angle(turns.mean())) if len(turns) else None


def _facing(skeleton: Skeleton) -> float | None:
    """Radians from world's x, which way a person faces, by shoulders and hips."""
    left = body_heading(np.where(skeleton.valid[:, None], skeleton.positions, np.nan))
    if not np.isfinite(left).all() or np.linalg.norm(left[:2]) < 0.05:
        return None
    return float(np.arctan2(-left[0], left[1]))
