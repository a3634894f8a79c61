"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``: the stage of the node ``fusion``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, Final

import numpy as np

from body_tracking.core.parameters import Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED
from body_tracking.core.skeleton import NANOSECONDS, Joint, Skeleton
from body_tracking.fusion.fusion import Fusion, FusionParameters
from body_tracking.fusion.people import People
from body_tracking.fusion.placement import PlacedSensors
from body_tracking.messages.codecs import Clock, Pose, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, PEOPLE, people_from
from body_tracking.pipeline.shared import (
    REFERENCE,
    RELIABLE,
    SENSORS,
    WORLD_FRAME,
    sensors_of,
    skeleton_input,
    skeleton_qos,
)
from body_tracking.pipeline.stage import Now, Output, Port, Stage

_MEMORY: Final = 5.0
"""Seconds over which the direction of the trunk is averaged."""
_LONGEST: Final = 0.1
"""Seconds for which one frame counts at most."""
_UPSIDE_DOWN: Final = -0.5
"""Mean vertical component of the trunk's direction below which axes must be wrong: nobody bends as far for so long."""


def calibration_inputs(sensors: int, waiting: int = 0) -> tuple[Port, ...]:
    """The poses and clocks of some sensors, of which the ones in force and the next ones must be kept."""
    kept = waiting or 2 * max(1, sensors)
    return (
        Port(graph.CALIBRATION_CLOCK, Clock(), LATCHED, waiting=kept),
        Port(graph.CALIBRATION, Pose(), LATCHED, waiting=kept),
    )


class FusionStage(Stage):
    """Fuses the skeletons of all sensors, of one person or of several.

    There is a :class:`Fusion` for each person who may be tracked, independent of each other.
    """

    NAME = "fusion"
    PARAMETERS = (
        SENSORS,
        REFERENCE,
        WORLD_FRAME,
        *PEOPLE,
        *parameters_from(FusionParameters, only=("method", "silence", "max_wait"), live=True),
        RELIABLE,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        sensors = sensors_of(values)
        parameters = FusionParameters(**fields_of(FusionParameters, values))
        reference, world = str(values["reference"]) or None, str(values["world_frame"])
        people = people_from(values)
        self._several = people.subject == ALL
        self._fusions = [
            Fusion(sensors, parameters, reference, world) for _ in range(people.people if self._several else 1)
        ]
        self._people = People(
            sensors, people, self._fusions[0].reference, lambda number: self._fusions[number - 1].forget()
        )
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in sensors}
        self.inputs = (*calibration_inputs(len(sensors)), *(skeleton_input(topic, values) for topic in self._sensors))
        self.outputs = (Port(graph.FUSED, Skeletons(), skeleton_qos(values), measured=True),)
        self._trunk_up, self._trunk_ns = 0.0, 0

    def change(self, values: Mapping[str, Value]) -> None:
        """From the next frame on."""
        for fusion in self._fusions:
            fusion.parameters = FusionParameters(**fields_of(FusionParameters, values))
        self.values = values

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic in (graph.CALIBRATION, graph.CALIBRATION_CLOCK):
            placing: tuple[PlacedSensors[Any], ...] = (self._people, *self._fusions)
            for placed in placing:
                if topic == graph.CALIBRATION:
                    placed.set_pose(payload)
                else:
                    placed.set_clock(*payload)
        elif any(skeleton.valid.any() for skeleton in payload):
            return self._published(self._fused(self._sensors[topic], payload, now.steady_ns))
        return ()

    def _fused(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> list[Skeleton]:
        """The skeletons that are complete with one frame of one sensor.

        With several people ``body`` is the number of the person, else the sensor's own.
        """
        found: list[Skeleton] = []
        for number, skeleton in self._people.sort(sensor, skeletons):
            own = replace(skeleton, body=number) if self._several else skeleton
            found += self._fusions[number - 1].push(sensor, own, now_ns)
        return found + self._polled(now_ns) if self._several else found

    def _polled(self, now_ns: int) -> list[Skeleton]:
        """The skeletons whose wait is over."""
        return [skeleton for fusion in self._fusions for skeleton in fusion.poll(now_ns)]

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._published(self._polled(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return min((at for fusion in self._fusions if (at := fusion.deadline_ns) is not None), default=None)

    def reset(self, topic: str) -> None:
        """Poses and clocks stay."""
        self._people.reset()
        for fusion in self._fusions:
            fusion.reset()
        self._trunk_up, self._trunk_ns = 0.0, 0

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        return int(bool(text := self._problem())), text, dict(self.counters)

    def _problem(self) -> str:
        """What is wrong with the frames; empty if nothing is."""
        if self._trunk_up <= _UPSIDE_DOWN:
            return (
                f"the person is upside down in {self.values['world_frame']}: are the axes of the skeletons those of an "
                "optical frame (x right, y down, z forward), and is calibration's reference_roll right?"
            )
        silence = self._fusions[0].parameters.silence
        behind = {name: lag for each in self._fusions for name, lag in each.behind.items() if lag > silence}
        late = [
            f"{name} is not used: its frames arrive {lag:.2f} s after another sensor's of the same time, more than "
            f"silence ({silence:g} s); check its clock and its network"
            for name, lag in sorted(behind.items())
        ]
        return "; ".join(filter(None, (self._people.frozen, *late)))

    @property
    def counters(self) -> Mapping[str, int]:
        """Sums over all people, and the counters of their association."""
        total: Counter[str] = Counter()
        for fusion in self._fusions:
            total.update(fusion.counters)
        return {**total, **{f"association {name}": count for name, count in self._people.counts.items()}}

    def _published(self, fused: Iterable[Skeleton]) -> Iterator[Output]:
        """The skeletons of one time in one message."""
        ordered = sorted(fused, key=lambda each: (each.stamp_ns, each.body))
        for stamp_ns, group in groupby(ordered, key=lambda each: each.stamp_ns):
            skeletons = tuple(group)
            self._watch(skeletons[0])
            yield Output(graph.FUSED, skeletons, stamp_ns)

    def _watch(self, skeleton: Skeleton) -> None:
        """Average how far up the trunk points."""
        trunk = skeleton.positions[Joint.SPINE_SHOULDER] - skeleton.positions[Joint.SPINE_BASE]
        length = float(np.linalg.norm(trunk))
        if not length > 0.0:  # nor where a joint is NaN
            return
        elapsed = min(max(skeleton.stamp_ns - self._trunk_ns, 0) / NANOSECONDS, _LONGEST)
        self._trunk_ns = skeleton.stamp_ns
        self._trunk_up += -math.expm1(-elapsed / _MEMORY) * (float(trunk[2]) / length - self._trunk_up)
