"""Pose and clock of a sensor over time, as the calibration publishes them."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace

from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import MAX_STAMP_NS

_MOST = 64
"""Poses, and clocks, of one sensor that may wait to come into force."""


class Placement:
    """The poses and clock relations of one sensor, by the reference times from which they are in force."""

    def __init__(self) -> None:
        self._poses: list[SensorPose] = []  # by valid_from_ns
        self._clocks: list[tuple[int, ClockModel]] = []  # likewise

    def set_pose(self, pose: SensorPose) -> None:
        """Add a pose, in force from its ``valid_from_ns``; it replaces earlier ones for later times."""
        del self._poses[bisect_right(self._poses, pose.valid_from_ns, key=_valid_from) :]
        self._poses.append(pose)
        del self._poses[:-_MOST]

    def set_clock(self, valid_from_ns: int, clock: ClockModel) -> None:
        """Add a relation of the clocks, in force from a reference time, likewise."""
        del self._clocks[bisect_right(self._clocks, valid_from_ns, key=_first) :]
        self._clocks.append((valid_from_ns, clock))
        del self._clocks[:-_MOST]

    def to_reference(self, sensor_ns: int) -> int:
        """A stamp of this sensor in the reference's clock, by the relation that is in force then."""
        found = sensor_ns
        for index, (valid_from_ns, clock) in enumerate(self._clocks):
            reference_ns = clock.to_reference(sensor_ns)
            if index > 0 and reference_ns < valid_from_ns:
                break
            found = reference_ns
        return found

    def stamp(self, sensor_ns: int) -> int | None:
        """The same; None where the clock relation is wrong, so that the result is no ROS time."""
        found = self.to_reference(sensor_ns)
        return found if 0 <= found <= MAX_STAMP_NS else None

    def pose(self, now_ns: int) -> SensorPose | None:
        """The pose in force at a reference time."""
        at = bisect_right(self._poses, now_ns, key=_valid_from)
        return self._poses[at - 1] if at else None

    def forget_before(self, now_ns: int) -> None:
        """Drop poses and clocks that others have replaced by then."""
        del self._poses[: max(0, bisect_right(self._poses, now_ns, key=_valid_from) - 1)]
        del self._clocks[: max(0, bisect_right(self._clocks, now_ns, key=_first) - 1)]

    def restart(self) -> None:
        """Put the newest pose and clock in force for all times, after a reset of time."""
        del self._poses[:-1], self._clocks[:-1]
        if self._poses:
            self._poses[0] = replace(self._poses[0], valid_from_ns=0)


def _valid_from(pose: SensorPose) -> int:
    return pose.valid_from_ns


def _first(entry: tuple[int, ClockModel]) -> int:
    return entry[0]
