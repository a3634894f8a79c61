"""Detection of a held pose for the alignment, by the sensors' rates and by a camera's skeletons."""

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
"""Radians: standard deviation of a person's heading by the shoulders of a skeleton."""
_CAMERA_CONE: Final = float(np.radians(40.0))
"""Radians by which a camera's arms may deviate from those of a pose."""
_RECENT = 0.5
"""Greatest age of the end of a pose, seconds."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldPose:
    """A pose, and the readings during it.

    Attributes:
        name: one of the parameters' ``POSES``.
        streams: of the sensors, while it was held.
        facing: the person's heading by the camera, radians from world's x; None without a camera.
    """

    name: str
    streams: tuple[Stream, ...]
    facing: float | None


class PoseFinder:
    """Finds held poses of a body model."""

    def __init__(self, model: UpperBody) -> None:
        self._model = model
        self._rotations = {name: pose_rotations(model, pose) for name, pose in POSES.items()}

    def rotations(self, name: str, segments: Sequence[str]) -> FloatArray:
        """(k, 3, 3) orientations of segments in a pose of a person who faces x."""
        return self._rotations[name][[self._model.segment_names.index(each) for each in segments]]

    def covariance(self, held: HeldPose, segments: Sequence[str], stddev: float) -> FloatArray:
        """(3 k, 3 k) radians squared: covariance of segments about a pose, with the error of the camera's heading.

        Args:
            held: the pose.
            segments: k names.
            stddev: radians per axis, of the joints.
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
        intended: FloatArray,
        wanted: str,
        now: float,
        seen: Sequence[tuple[float, Skeleton]],
        *,
        asked: bool,
    ) -> HeldPose | None:
        """The pose that is held now.

        Args:
            streams: k sensors, of the last seconds.
            intended: (k, 3, 3) segment to sensor, intended mountings.
            wanted: one of the parameters' ``POSES``, or ``auto``.
            now: seconds.
            seen: skeletons of a camera over the same time with their stamps in seconds; empty without a camera.
            asked: the user requested the alignment.

        Returns:
            The pose; None where sensors or camera show another pose or no heading. Also None without a camera, a
            request and a sensor on an upper arm: then a pose cannot be distinguished from sitting still.
        """
        periods = still_periods(streams)
        if not periods or periods[-1].end < now - _RECENT:
            return None
        period = periods[-1]
        name = wanted
        if name == AUTO:
            pose = pose_of(streams, intended, period)
            if pose is None:
                return None
            name = next(each for each, letter in POSES.items() if letter == pose)
        facing = None
        if seen:
            facing = _faced(period, seen)
            if facing is None or not self._looks_like(seen[-1][1], name):
                return None
        elif not asked and not any(stream.segment.startswith("upper_arm") for stream in streams):
            return None  # with forearms alone a pose looks like hands on a table
        return HeldPose(name, tuple(stream.between(period.begin, period.end) for stream in streams), facing)

    def _looks_like(self, skeleton: Skeleton, name: str) -> bool:
        """Whether the arms that a camera sees agree with a pose."""
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
    """Mean heading of the person in a period by a camera, radians from world's x."""
    found = [_facing(skeleton) for stamp, skeleton in seen if period.begin <= stamp <= period.end]
    turns = np.exp(1j * np.array([each for each in found if each is not None]))
    return float(np.angle(turns.mean())) if len(turns) else None


def _facing(skeleton: Skeleton) -> float | None:
    """Heading of a person by shoulders and hips, radians from world's x."""
    left = body_heading(np.where(skeleton.valid[:, None], skeleton.positions, np.nan))
    if not np.isfinite(left).all() or np.linalg.norm(left[:2]) < 0.05:
        return None
    return float(np.arctan2(-left[0], left[1]))
