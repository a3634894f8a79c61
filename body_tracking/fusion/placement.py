"""Poses and clocks of sensors over time, as the calibration publishes them."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Generic, TypeVar

from body_tracking.core.clocks import JUMP_BACK_NS, ClockModel, jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import MAX_STAMP_NS

WORLD: Final = "world"
"""The usual frame of the output."""

_MOST = 64
"""Poses, and clocks, that are kept of one sensor."""


class FusionError(BodyTrackingError):
    """Raised when the reference sensor is not among the sensors."""


class Placement:
    """The poses and clock relations of one sensor, by the reference times from which they are in force."""

    def __init__(self) -> None:
        self._poses: list[SensorPose] = []  # by valid_from_ns
        self._clocks: list[tuple[int, ClockModel]] = []  # by the reference time from which each is valid
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self.newest_ns: int | None = None  # in the reference's clock
        self.ahead = False  # over a second ahead of the reference's frames: the clock relation is wrong

    def set_pose(self, pose: SensorPose) -> None:
        """Add a pose, in force from its ``valid_from_ns``; it replaces earlier ones for later times."""
        del self._poses[bisect_right(self._poses, pose.valid_from_ns, key=_valid_from) :]
        self._poses.append(pose)
        del self._poses[:-_MOST]

    def set_clock(self, valid_from_ns: int, clock: ClockModel) -> None:
        """Add a clock relation, in force from a reference time; it replaces earlier ones for later times."""
        del self._clocks[bisect_right(self._clocks, valid_from_ns, key=_first) :]
        self._clocks.append((valid_from_ns, clock))
        del self._clocks[:-_MOST]

    def to_reference(self, sensor_ns: int) -> int:
        """A stamp of this sensor in the reference's clock, by the relation that is in force then."""
        found = sensor_ns
        # The newest first: by an older one, a clock that was set back since is never in force.
        for valid_from_ns, clock in reversed(self._clocks):
            found = clock.to_reference(sensor_ns)
            if found >= valid_from_ns:
                break
        return found

    def stamp(self, sensor_ns: int) -> int | None:
        """As :meth:`to_reference`; None where the result is no ROS time, because the clock relation is wrong."""
        found = self.to_reference(sensor_ns)
        return found if 0 <= found <= MAX_STAMP_NS else None

    def pose(self, now_ns: int) -> SensorPose | None:
        """The pose in force at a reference time."""
        at = bisect_right(self._poses, now_ns, key=_valid_from)
        return self._poses[at - 1] if at else None

    def forget_before(self, now_ns: int) -> None:
        """Drop poses and clocks that are no longer in force at a reference time."""
        del self._poses[: max(0, bisect_right(self._poses, now_ns, key=_valid_from) - 1)]
        del self._clocks[: max(0, bisect_right(self._clocks, now_ns, key=_first) - 1)]

    def restart(self) -> None:
        """Put the newest pose and clock in force for all times, after a reset of time."""
        del self._poses[:-1], self._clocks[:-1]
        if self._poses:
            self._poses[0] = replace(self._poses[0], valid_from_ns=0)


S = TypeVar("S", bound=Placement)


class PlacedSensors(Generic[S]):
    """Several sensors with their poses and clocks: base of the classes that take their frames.

    Attributes:
        reference: the sensor whose clock is that of the output.
        counters: event counts since the construction, for diagnostics.
    """

    def __init__(self, sensors: Sequence[str], reference: str | None, kind: type[S]) -> None:
        """Start without poses and clocks.

        Args:
            sensors: their names.
            reference: one of them; the first one when None.
            kind: class of the state of a sensor.

        Raises:
            FusionError: the reference is not among the sensors.
        """
        self.reference = reference or (sensors[0] if sensors else "")
        if self.reference not in sensors:
            listed = ", ".join(sensors) or "(none)"
            raise FusionError(f"reference sensor {self.reference!r} is not among the sensors {listed}")
        self.counters: Counter[str] = Counter()
        self._sensors: dict[str, S] = {name: kind() for name in sensors}

    def reset(self) -> None:
        """Forget all frames; calibrations stay, and those that wait for their time come into force."""
        self.forget()
        for sensor in self._sensors.values():
            sensor.restart()
        self.counters["resets"] += 1

    def forget(self) -> None:
        """Forget all frames, because the next ones are of another person."""
        for sensor in self._sensors.values():
            sensor.clear()

    def set_pose(self, pose: SensorPose) -> None:
        """Take a sensor's pose, in force from its ``valid_from_ns``; unknown sensors are counted and ignored."""
        if (sensor := self._known(pose.sensor)) is not None:
            sensor.set_pose(pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """Take a sensor's clock, in force from a reference time; unknown sensors are counted and ignored."""
        if (known := self._known(sensor)) is not None:
            known.set_clock(valid_from_ns, clock)

    def _known(self, sensor: str) -> S | None:
        """The sensor of a name; None, and counted, for an unknown one."""
        found = self._sensors.get(sensor)
        if found is None:
            self.counters["unknown_sensor"] += 1
        return found

    def _clock_jumped_back(self, sensor: str) -> None:
        """Reset the sensor, or all for the reference."""
        if sensor == self.reference:
            self.reset()
        else:
            self._sensors[sensor].clear()
            self.counters["resets"] += 1

    def _in_step(self, sensor: str, stamp_ns: int) -> bool:
        """Whether a frame's stamp is consistent with the reference sensor's newest one.

        The clock of a restarted sensor may have another offset until the calibration has estimated it again.
        """
        source = self._sensors[sensor]
        source.newest_ns = stamp_ns
        if sensor == self.reference:
            for other in self._sensors.values():
                other.ahead |= other.newest_ns is not None and other.newest_ns > stamp_ns + JUMP_BACK_NS
            return True
        reference_ns = self._sensors[self.reference].newest_ns
        source.ahead &= reference_ns is not None and stamp_ns > reference_ns + JUMP_BACK_NS
        return not source.ahead and not jumped_back(stamp_ns, reference_ns)


def _valid_from(pose: SensorPose) -> int:
    return pose.valid_from_ns


def _first(entry: tuple[int, ClockModel]) -> int:
    return entry[0]
