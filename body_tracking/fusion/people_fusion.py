"""Fused skeletons of one person among several, or of each of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import groupby

from body_tracking.core.clocks import ClockModel
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import Skeleton
from body_tracking.fusion.fusion import Fusion, FusionParameters
from body_tracking.fusion.people import People
from body_tracking.fusion.placement import WORLD
from body_tracking.pipeline.people import ALL, PeopleParameters


class PeopleFusion:
    """A :class:`Fusion` per tracked person, each independent of the others.

    Args:
        sensors: their names.
        parameters: of each fusion.
        people: whom to track.
        reference: the sensor whose clock is the output's; the first one when None.
        world: the frame of the output.

    Raises:
        FusionError: the reference is not among the sensors.
    """

    def __init__(
        self,
        sensors: Sequence[str],
        parameters: FusionParameters | None = None,
        people: PeopleParameters | None = None,
        reference: str | None = None,
        world: str = WORLD,
    ) -> None:
        people = people or PeopleParameters()
        self._several = people.subject == ALL
        count = people.people if self._several else 1
        self._fusions = [Fusion(sensors, parameters, reference, world) for _ in range(count)]
        self.people = People(sensors, people, self._fusions[0].reference, self._gone)
        self.world = world

    @property
    def parameters(self) -> FusionParameters:
        """Parameters of each fusion."""
        return self._fusions[0].parameters

    @parameters.setter
    def parameters(self, parameters: FusionParameters) -> None:
        for fusion in self._fusions:
            fusion.parameters = parameters

    @property
    def counters(self) -> dict[str, int]:
        """Event counts since the construction."""
        total: Counter[str] = Counter()
        for fusion in self._fusions:
            total.update(fusion.counters)
        return {**total, **{f"association {name}": count for name, count in self.people.counts.items()}}

    def set_pose(self, pose: SensorPose) -> None:
        """Take a sensor's pose, in force from its ``valid_from_ns``; unknown sensors are counted and ignored."""
        self.people.set_pose(pose)
        for fusion in self._fusions:
            fusion.set_pose(pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """Take a sensor's clock, in force from a reference time; unknown sensors are counted and ignored."""
        self.people.set_clock(sensor, valid_from_ns, clock)
        for fusion in self._fusions:
            fusion.set_clock(sensor, valid_from_ns, clock)

    def push(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> list[tuple[Skeleton, ...]]:
        """Take one frame of one sensor.

        Args:
            sensor: one of those given.
            skeletons: the bodies in it, in the sensor's optical frame and clock.
            now_ns: when it arrived, in a clock that never goes back.

        Returns:
            The fused skeletons that are complete now, those of one time together; with several people ``body`` is the
            number of the person, else the sensor's own.
        """
        found: list[Skeleton] = []
        for number, skeleton in self.people.sort(sensor, skeletons):
            body = replace(skeleton, body=number) if self._several else skeleton
            found += self._fusions[number - 1].push(sensor, body, now_ns)
        return _together(found + self._polled(now_ns) if self._several else found)

    def poll(self, now_ns: int) -> list[tuple[Skeleton, ...]]:
        """The fused skeletons whose wait is over."""
        return _together(self._polled(now_ns))

    def _polled(self, now_ns: int) -> list[Skeleton]:
        return [skeleton for fusion in self._fusions for skeleton in fusion.poll(now_ns)]

    @property
    def deadline_ns(self) -> int | None:
        """When :meth:`poll` should be called, in the clock of ``now_ns``; None while nothing waits."""
        return min((at for fusion in self._fusions if (at := fusion.deadline_ns) is not None), default=None)

    def reset(self) -> None:
        """Forget everything but poses and clocks, because time jumped back."""
        self.people.reset()
        for fusion in self._fusions:
            fusion.reset()

    def _gone(self, number: int) -> None:
        self._fusions[number - 1].forget()


def _together(skeletons: Iterable[Skeleton]) -> list[tuple[Skeleton, ...]]:
    ordered = sorted(skeletons, key=lambda each: (each.stamp_ns, each.body))
    return [tuple(group) for _, group in groupby(ordered, key=lambda each: each.stamp_ns)]
