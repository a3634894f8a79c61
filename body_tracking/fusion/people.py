"""Selection of the tracked people: one person, the same in all sensors, or all, each with a number.

Brings frames into world for :mod:`body_tracking.fusion.association`, and gives its people numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from body_tracking.core.clocks import jumped_back
from body_tracking.core.repeats import REPEATED, Repeats
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.fusion.association import Association
from body_tracking.fusion.placement import PlacedSensors, Placement
from body_tracking.pipeline.people import ALL, FIRST, PeopleParameters, SubjectSelector

_PRESENT = round(0.2 * NANOSECONDS)
"""A person may be chosen when seen within this time, nanoseconds."""

_PENDING = 5
"""Frames of a lone person that wait for the next association; the first and the last give the velocity."""

_KEEP = 5 * NANOSECONDS
"""Poses and clocks are kept for frames that are late by no more than this, nanoseconds."""


class Slots:
    """Assigns the numbers 1 to ``count`` to people who come and go.

    Attributes:
        of: the number of each person who has one.
    """

    def __init__(self, count: int) -> None:
        self.of: dict[int, int] = {}
        self._free = deque(range(1, count + 1))  # the one unused for longest first

    def update(self, people: Sequence[int]) -> tuple[list[int], int]:
        """Give the numbers of people who are gone to new ones.

        Args:
            people: all who are present, the longest known first.

        Returns:
            The freed numbers, including those given to another person, and the count of people without a number.
        """
        gone = [person for person in self.of if person not in people]
        freed = [self.of.pop(person) for person in gone]
        self._free.extend(freed)
        for person in people:
            if person not in self.of and self._free:
                self.of[person] = self._free.popleft()
        return freed, len(people) - len(self.of)


class _Sensor(Placement):
    """Pose and clock of a sensor, and its frames of a lone person that wait for the association."""

    def clear(self) -> None:
        super().clear()
        self.selector = SubjectSelector()
        self.repeats = Repeats()
        self.last_ns: int | None = None  # in its own clock
        self.used: SensorPose | None = None
        self.pending: deque[tuple[int, SensorPose, Skeleton]] = deque(maxlen=_PENDING)


class People(PlacedSensors[_Sensor]):
    """Sorts the bodies of every sensor's frames by person.

    With one subject, a sensor that is not calibrated, or whose clock is wrong, selects the person nearest to itself, so
    that the fusion learns its frame rate; with all, its frames are left out.

    Args:
        sensors: their names.
        parameters: whom to track.
        reference: the sensor whose clock is that of ``world``; the first one when None.
        gone: callback with the number of a person who is lost, before it is given again; never with one subject.
    """

    def __init__(
        self,
        sensors: Sequence[str],
        parameters: PeopleParameters,
        reference: str | None = None,
        gone: Callable[[int], None] = lambda number: None,
    ) -> None:
        super().__init__(sensors, reference, _Sensor)
        self.parameters = parameters
        self.gone = gone
        self._association = Association(parameters.hold)
        self._slots = Slots(parameters.people)
        self._chosen: int | None = None
        self._without = 0

    @property
    def counts(self) -> dict[str, int]:
        """The present number of people, and event counts since the construction."""
        counters = {"people": len(self._association.people), **self._association.counters, **self.counters}
        if self._without:
            counters["people without a number"] = self._without
        return counters

    @property
    def tracked(self) -> tuple[int, ...]:
        """The numbers in use."""
        if self.parameters.subject == ALL:
            return tuple(sorted(self._slots.of.values()))
        return () if self._chosen is None else (1,)

    @property
    def frozen(self) -> str:
        """Which sensors repeat one frame, in words; empty if none does."""
        names = ", ".join(name for name, source in self._sensors.items() if source.repeats.frozen)
        return names and f"{names}: {REPEATED.format('frame')}"

    @property
    def nearest(self) -> int | None:
        """With all, the number of the person whom ``nearest`` would choose."""
        return None if self._chosen is None else self._slots.of.get(self._chosen)

    def reset(self) -> None:
        """Forget all people, because time jumped back; poses and clocks stay."""
        for source in self._sensors.values():
            source.clear()
            source.restart()
        self._association.reset()
        self._chosen = None
        self._free_slots()

    def sensor_jumped_back(self, sensor: str) -> None:
        """Forget one sensor's frames."""
        self._sensors[sensor].clear()
        self._association.forget_sensor(sensor)

    def sort(self, sensor: str, skeletons: Sequence[Skeleton]) -> list[tuple[int, Skeleton]]:
        """The people in one frame of one sensor.

        Args:
            sensor: one of those given.
            skeletons: the bodies in it, in the sensor's own frame and clock.

        Returns:
            Pairs of number and unchanged body; with one subject at most one pair, with number 1.
        """
        seen = [skeleton for skeleton in skeletons if skeleton.valid.any()]
        if not seen:
            return []
        source = self._sensors[sensor]
        if source.repeats.add(seen[0].stamp_ns, *(skeleton.positions for skeleton in seen)):
            self.counters[f"repeated frames of {sensor}"] += 1
            return []
        one = self.parameters.subject != ALL
        placed = self._placed(sensor, source, seen[0].stamp_ns)
        if placed is None:
            subject = source.selector.pick(seen) if one else None
            return [] if subject is None else [(1, subject)]
        stamp_ns, pose = placed
        if len(seen) == 1:
            alone = self._association.alone(sensor, stamp_ns, seen[0].body)
            if alone is not None and self._number(alone) is not None:
                source.pending.append((stamp_ns, pose, seen[0]))
                return [(1 if one else self._slots.of[alone], seen[0])]
        self._record_pending()
        if source.used is not None and source.used is not pose:
            turned = pose.rotation @ source.used.rotation.T
            self._association.move_sensor(sensor, turned, pose.translation - turned @ source.used.translation)
        source.used = pose
        whose = self._association.assign(
            sensor, [replace(body, stamp_ns=stamp_ns, positions=_points(body, pose)) for body in seen]
        )
        self._choose(stamp_ns)
        numbers = (None if person is None else self._number(person) for person in whose)
        found = [(number, body) for number, body in zip(numbers, seen, strict=True) if number is not None]
        return sorted(found, key=lambda each: each[0])

    def _number(self, person: int) -> int | None:
        """The number of a tracked person; None for others."""
        if self.parameters.subject == ALL:
            return self._slots.of.get(person)
        return 1 if person == self._chosen else None

    def _placed(self, sensor: str, source: _Sensor, sensor_ns: int) -> tuple[int, SensorPose] | None:
        """A frame's time in the reference's clock and its sensor's pose; None where they are not known."""
        if jumped_back(sensor_ns, source.last_ns):
            if sensor == self.reference:
                self.reset()
            else:
                self.sensor_jumped_back(sensor)
        source.last_ns = sensor_ns
        stamp_ns = source.stamp(sensor_ns)
        if stamp_ns is None:
            self.counters["other_clock"] += 1
            return None
        pose = source.pose(stamp_ns)
        if pose is None:
            self.counters["uncalibrated"] += 1
            return None
        source.forget_before(stamp_ns - _KEEP)
        if not self._in_step(sensor, stamp_ns):
            self.counters["other_clock"] += 1
            return None
        return stamp_ns, pose

    def _record_pending(self) -> None:
        """Pass the lone person's waiting frames to the association."""
        for sensor, source in self._sensors.items():
            if source.pending:
                ends = (source.pending[0], source.pending[-1])[2 - min(2, len(source.pending)) :]
                seen = [(stamp_ns, _points(body, pose)) for stamp_ns, pose, body in ends]
                self._association.record(sensor, seen, ends[-1][2].body)
                source.used = ends[-1][1]
                source.pending.clear()

    def _choose(self, stamp_ns: int) -> None:
        """Update the numbers, and choose a subject where there is none."""
        people = self._association.people
        if self.parameters.subject == ALL:
            self._free_slots()
        if self._chosen in people:
            return
        seen = ((person, self._association.seen_ns(person)) for person in people)
        present = [person for person, seen_ns in seen if seen_ns is not None and stamp_ns - seen_ns <= _PRESENT]
        self._chosen = None
        if present and self.parameters.subject == FIRST:
            self._chosen = present[0]
        elif present:
            self._chosen = min(present, key=lambda person: float(np.linalg.norm(self._association.place(person))))

    def _free_slots(self) -> None:
        freed, self._without = self._slots.update(self._association.people)
        for number in freed:
            self.gone(number)


def _points(skeleton: Skeleton, pose: SensorPose) -> FloatArray:
    """(25, 3) metres in world; NaN for joints that are not valid."""
    return pose.apply(np.where(skeleton.valid[:, None], skeleton.positions, np.nan))
