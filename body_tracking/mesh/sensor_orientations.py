"""Orientations of inertial sensors at the time and in the frame of a depth image."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.orientation import OrientationError, SegmentOrientation
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.fusion.placement import Placement
from body_tracking.mesh.solver import Orientation
from body_tracking.mesh.topics import JOINTS_OF

NEAREST_NS: Final = NANOSECONDS // 20
"""Largest difference between the stamps of an image and an orientation used with it."""
_KEPT: Final = 64
"""Number of orientations kept per segment: a second at the usual 60 Hz."""
_FRAMES: Final = np.radians(4.0)
"""Radians per axis: standard deviation between the anatomical frames of a person's segment and of the mesh; their joint
centres and the forearm's neutral rotation are defined differently."""


class SensorOrientations:
    """Latest orientations of segments, in the frame ``world`` and the reference's clock.

    Args:
        segments: with an inertial sensor.

    Raises:
        OrientationError: the mesh has no such segment.
    """

    def __init__(self, segments: Sequence[str]) -> None:
        unknown = [segment for segment in segments if segment not in JOINTS_OF]
        if unknown:
            known = ", ".join(JOINTS_OF)
            raise OrientationError(f"parameter 'orientations': {', '.join(unknown)}: expected some of {known}")
        self._latest: dict[str, deque[SegmentOrientation]] = {each: deque(maxlen=_KEPT) for each in segments}

    def __bool__(self) -> bool:
        return bool(self._latest)

    def add(self, measurement: SegmentOrientation) -> None:
        """Keep an orientation for images near its time."""
        self._latest[measurement.segment].append(measurement)

    def forget(self, segment: str) -> None:
        """Drop the orientations of a segment after a backward jump of its stamps."""
        self._latest[segment].clear()

    def seen_from(
        self, placement: Placement, stamp_ns: int, names: Sequence[str], counters: Counter[str]
    ) -> list[Orientation]:
        """The orientations at an image's time, in the camera's optical frame.

        Each is the nearest one within 50 ms, extrapolated to the image's stamp by its angular velocity.

        Args:
            placement: pose and clock of the camera.
            stamp_ns: of the image, in the camera's clock.
            names: of the mesh's joints.
            counters: of images without a usable orientation.
        """
        if not self._latest:
            return []
        at_ns = placement.stamp(stamp_ns)
        pose = None if at_ns is None else placement.pose(at_ns)
        if at_ns is None or pose is None:
            counters["images without the camera's pose for inertial sensors"] += 1
            return []
        placement.forget_before(at_ns)
        found = []
        for segment, latest in self._latest.items():
            nearest = min(latest, key=lambda each: abs(each.stamp_ns - at_ns), default=None)
            if nearest is None or abs(nearest.stamp_ns - at_ns) > NEAREST_NS:
                counters[f"images without an orientation of {segment}"] += 1
                continue
            rotation = nearest.rotation
            variances = np.diagonal(rotation.T @ nearest.covariance @ rotation)
            if nearest.angular_velocity is not None:
                elapsed = (at_ns - nearest.stamp_ns) / NANOSECONDS
                rotation = rotation @ so3.quat_to_matrix(so3.exp(elapsed * nearest.angular_velocity))
            found.append(
                Orientation(
                    names.index(JOINTS_OF[segment]), pose.rotation.T @ rotation, np.sqrt(variances + _FRAMES**2)
                )
            )
        return found
