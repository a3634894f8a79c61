"""One filter per person, for several people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from body_tracking.core.clocks import ClockModel
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.qos import Qos
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.filters.person import FilterSettings, PersonFilter
from body_tracking.fusion.people import People
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, SubjectSelector
from body_tracking.pipeline.stage import Port

_AWAY = NANOSECONDS
"""Nanoseconds without a fused frame of a person after which that person is forgotten."""


class PeopleFilter:
    """A :class:`PersonFilter` per person, independent of each other; arguments, attributes and errors as there."""

    def __init__(
        self,
        settings: FilterSettings,
        publish: Callable[[str, Any, int], None],
        wanted: Callable[[str], bool] | None = None,
    ) -> None:
        ids = graph.bodies(settings.people.people)
        self._persons = [
            PersonFilter(replace(settings, body=body), publish, wanted, self._filtered_one) for body in ids
        ]
        first = self._persons[0]
        self.by_sensor, self.models = first.by_sensor, first.models
        self._ids = ids
        self._publish = publish
        self._filtered: list[Skeleton] = []
        self._last_ns: dict[int, int] = {}
        self._wearer = SubjectSelector(settings.people.hold)
        self.people: People | None = None
        if first.alignment is not None:
            self.people = People(settings.sensors, settings.people, first.alignment.reference, self._gone)

    def inherit(self, before: PersonFilter | PeopleFilter) -> None:
        """Take over the sensors' poses and clocks from the previous filter: latched messages come once."""
        if isinstance(before, PeopleFilter) and self.people is not None and before.people is not None:
            self.people, self.people.gone = before.people, self._gone
            for person, former in zip(self._persons, before._persons, strict=True):
                person.inherit(former)

    def outputs(self, skeletons: Qos, results: Qos) -> tuple[Port, ...]:
        """As of :class:`PersonFilter`."""
        ports = (port for person in self._persons for port in person.outputs(skeletons, results))
        return tuple({port.topic: port for port in ports}.values())

    @property
    def tracked(self) -> tuple[str, ...]:
        """The ids of the people who are tracked."""
        if self.people is not None:
            return tuple(self._ids[number - 1] for number in self.people.tracked)
        return tuple(body for person in self._persons for body in person.tracked)

    @property
    def counters(self) -> dict[str, int]:
        """Sums of all filters' counters."""
        total: Counter[str] = Counter()
        for person in self._persons:
            total.update(person.counters)
        if self.people is not None:
            total.update({f"association {name}": count for name, count in self.people.counts.items()})
        return dict(total)

    def set_pose(self, pose: SensorPose) -> None:
        """A sensor's pose, in force from its time on."""
        if self.people is not None:
            self.people.set_pose(pose)
        for person in self._persons:
            person.set_pose(pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """A sensor's clock, in force from a reference time on."""
        if self.people is not None:
            self.people.set_clock(sensor, valid_from_ns, clock)
        for person in self._persons:
            person.set_clock(sensor, valid_from_ns, clock)

    def on_fused(self, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """One fused frame.

        Args:
            skeletons: in world, each with the person's number; unknown numbers are ignored.
            now_ns: time of arrival, in a steady clock.
        """
        self._wearer.pick(skeletons)
        stamp_ns = skeletons[0].stamp_ns
        for number, last_ns in list(self._last_ns.items()):
            if stamp_ns - last_ns > _AWAY:  # another person may have the number now
                self._gone(number)
        for skeleton in skeletons:
            if 1 <= skeleton.body <= len(self._persons):
                self._last_ns[skeleton.body] = stamp_ns
                self._persons[skeleton.body - 1].on_fused([skeleton], now_ns)
        self.poll(now_ns)

    def hold(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """As of :class:`PersonFilter`, with all bodies in the frame."""
        assert self.people is not None
        for number, body in self.people.sort(sensor, skeletons):
            self._persons[number - 1].hold(sensor, [replace(body, body=number)], now_ns)

    def on_orientation(self, measurement: SegmentOrientation, now_ns: int) -> None:
        """Take the orientation of one segment of the wearer, who is the person nearest to the reference sensor."""
        wearer = self._wearer.body if self.people is None else self.people.nearest
        if wearer is not None and wearer <= len(self._persons):
            self._persons[wearer - 1].on_orientation(measurement, now_ns)
            self._flush()

    def poll(self, now_ns: int) -> None:
        """Take the frames that have waited long enough, and publish the predicted ones that are due."""
        for person in self._persons:
            person.poll(now_ns)
        newest_ns = max(person.newest_ns for person in self._persons)
        for person in self._persons:  # release held frames of people who are not seen now with the others' frames
            person.passed(newest_ns)
        self._flush()

    def settle(self) -> None:
        """As of :class:`PersonFilter`."""
        for person in self._persons:
            person.settle()

    @property
    def deadline_ns(self) -> int | None:
        """As of :class:`PersonFilter`, the earliest of all."""
        return min((at for person in self._persons if (at := person.deadline_ns) is not None), default=None)

    @property
    def due_ns(self) -> int | None:
        """As of :class:`PersonFilter`, the earliest of all."""
        return min((at for person in self._persons if (at := person.due_ns) is not None), default=None)

    def reset(self) -> None:
        """Forget all people, after a jump of time; poses and clocks stay."""
        self._last_ns.clear()
        for person in self._persons:
            person.reset()
        self._flush()

    def _gone(self, number: int) -> None:
        self._last_ns.pop(number, None)
        self._persons[number - 1].forget()

    def _filtered_one(self, skeleton: Skeleton) -> None:
        self._filtered.append(skeleton)

    def flush(self) -> None:
        """Publish all frames that are held back."""
        for person in self._persons:
            person.flush()
        self._flush()

    def _flush(self) -> None:
        """Publish the skeletons of one time together."""
        filtered, self._filtered = self._filtered, []
        filtered.sort(key=lambda each: (each.stamp_ns, each.body))
        for stamp_ns, together in groupby(filtered, key=lambda each: each.stamp_ns):
            self._publish(graph.FILTERED, tuple(together), stamp_ns)


def filter_of(
    settings: FilterSettings,
    publish: Callable[[str, Any, int], None],
    wanted: Callable[[str], bool] | None = None,
) -> PersonFilter | PeopleFilter:
    """The filter for one or several people by the settings; arguments and errors as of :class:`PersonFilter`."""
    of_people = settings.people.subject == ALL
    return PeopleFilter(settings, publish, wanted) if of_people else PersonFilter(settings, publish, wanted)
