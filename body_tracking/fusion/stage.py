"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``: the stage of the node ``fusion``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from body_tracking.core.parameters import Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED
from body_tracking.core.skeleton import Skeleton
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
            return _published(self.fusion.push(self._sensors[topic], payload, now.steady_ns))
        return ()

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return _published(self.fusion.poll(steady_ns))

    @property
    def deadline_ns(self) -> int | None:
        return self.fusion.deadline_ns

    def reset(self, topic: str) -> None:
        """Poses and clocks stay."""
        self.fusion.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        return 0, "", dict(self.fusion.counters)

    @property
    def counters(self) -> Mapping[str, int]:
        return self.fusion.counters


def _published(fused: Iterable[tuple[Skeleton, ...]]) -> Iterator[Output]:
    return (Output(graph.FUSED, skeletons, skeletons[0].stamp_ns) for skeletons in fused)
