"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``: the stage of the node ``fusion``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final

import numpy as np

from body_tracking.core.parameters import Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED
from body_tracking.core.skeleton import NANOSECONDS, Joint, Skeleton
from body_tracking.fusion.fusion import FusionParameters
from body_tracking.fusion.people_fusion import PeopleFusion
from body_tracking.messages.codecs import Clock, Pose, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import PEOPLE, people_from
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
    """Fuses the skeletons of all sensors, of one person or of several."""

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
        self.fusion = PeopleFusion(sensors, parameters, people_from(values), reference, world)
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in sensors}
        self.inputs = (*calibration_inputs(len(sensors)), *(skeleton_input(topic, values) for topic in self._sensors))
        self.outputs = (Port(graph.FUSED, Skeletons(), skeleton_qos(values), measured=True),)
        self._trunk_up, self._trunk_ns = 0.0, 0

    def change(self, values: Mapping[str, Value]) -> None:
        """From the next frame on."""
        self.fusion.parameters = FusionParameters(**fields_of(FusionParameters, values))
        self.values = values

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic == graph.CALIBRATION_CLOCK:
            self.fusion.set_clock(*payload)
        elif topic == graph.CALIBRATION:
            self.fusion.set_pose(payload)
        elif any(skeleton.valid.any() for skeleton in payload):
            return self._published(self.fusion.push(self._sensors[topic], payload, now.steady_ns))
        return ()

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return self._published(self.fusion.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self.fusion.deadline_ns

    def reset(self, topic: str) -> None:
        """Poses and clocks stay."""
        self.fusion.reset()
        self._trunk_up, self._trunk_ns = 0.0, 0

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        if self._trunk_up > _UPSIDE_DOWN:
            return 0, "", dict(self.fusion.counters)
        text = (
            f"the person is upside down in {self.fusion.world}: are the axes of the skeletons those of an optical "
            "frame (x right, y down, z forward), and is calibration's reference_roll right?"
        )
        return 1, text, dict(self.fusion.counters)

    @property
    def counters(self) -> Mapping[str, int]:
        return self.fusion.counters

    def _published(self, fused: Iterable[tuple[Skeleton, ...]]) -> Iterator[Output]:
        for skeletons in fused:
            self._watch(skeletons[0])
            yield Output(graph.FUSED, skeletons, skeletons[0].stamp_ns)

    def _watch(self, skeleton: Skeleton) -> None:
        """Average how far up the trunk points."""
        trunk = skeleton.positions[Joint.SPINE_SHOULDER] - skeleton.positions[Joint.SPINE_BASE]
        length = float(np.linalg.norm(trunk))
        if not length > 0.0:  # nor where a joint is NaN
            return
        elapsed = min(max(skeleton.stamp_ns - self._trunk_ns, 0) / NANOSECONDS, _LONGEST)
        self._trunk_ns = skeleton.stamp_ns
        self._trunk_up += -math.expm1(-elapsed / _MEMORY) * (float(trunk[2]) / length - self._trunk_up)
