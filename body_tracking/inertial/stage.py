"""``sensor_msgs/Imu`` per segment to orientations and a skeleton: the stage of the node ``imu_skeleton``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import ImuSample
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.inertial.tracking import InertialTracker
from body_tracking.messages.codecs import Field, Orientation, Reading, Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, HOLD, PEOPLE, SubjectSelector
from body_tracking.pipeline.shared import (
    REFERENCE,
    RELIABLE,
    SENSORS,
    WORLD_FRAME,
    names_in,
    skeleton_input,
    skeleton_qos,
)
from body_tracking.pipeline.stage import Now, Output, Port, Stage

SEGMENTS = Parameter(
    "segments",
    (),
    "segments with an inertial sensor, each as SEGMENT (topics /SEGMENT/imu/data, data_raw and mag), SEGMENT:NAME "
    "(topics /NAME/imu/...) or SEGMENT:/TOPIC",
)
MOUNTINGS = Parameter(
    "mountings",
    (),
    "SEGMENT:AXES of sensors that are not worn as usual: the directions of the sensor's x and z axes with hanging "
    "arms and upright trunk, where the person faces +x and +y is to the left, as in forearm_left:-z+y",
)
_SETTABLE = ("pose", "camera", "clock", "magnetometer", "rate", "pose_stddev", "stature")
IMU_PARAMETERS: Final = (SEGMENTS, MOUNTINGS, *parameters_from(TrackingParameters, only=_SETTABLE))
_READINGS = 64
"""Queue of readings per sensor: a sixth of a second of the fastest ones."""
_FIELD_NS = NANOSECONDS // 20
"""Greatest difference of stamps between a reading and its magnetic field."""


class ImuStage(Stage):
    """Tracks the segments of a body by inertial sensors."""

    NAME = "imu_skeleton"
    PARAMETERS = (
        *IMU_PARAMETERS,
        *(item for item in PEOPLE if item.name == "subject"),
        SENSORS,
        REFERENCE,
        WORLD_FRAME,
        RELIABLE,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        parameters: dict[str, Any] = fields_of(TrackingParameters, values)
        sensors = graph.imu_topics(names_in(values["segments"]))
        self.tracker = InertialTracker(
            tuple(each.segment for each in sensors),
            TrackingParameters(**parameters),
            names_in(values["mountings"]),
            str(values["world_frame"]),
        )
        self._readings = {topic: each.segment for each in sensors for topic in each.imu}
        self._mags = {each.mag: each.segment for each in sensors}
        self._fields: dict[str, tuple[int, FloatArray]] = {}
        self._refused: Counter[str] = Counter()
        # of several people, the one nearest to the reference sensor is the wearer
        self._wearer = SubjectSelector(HOLD if values["subject"] == ALL else 0.0)
        reference = str(values["reference"]) or next(iter(names_in(values["sensors"])), "")
        self._reference = graph.skeleton_topic(reference) if reference else ""
        qos = skeleton_qos(values)
        ports = []
        for each in sensors:
            ports.append(Port(each.mag, Field(), qos, _READINGS, absolute=each.absolute))
            ports += [Port(topic, Reading(), qos, _READINGS, absolute=each.absolute) for topic in each.imu]
        # the reference sensor's frames first: their clock offset holds for the skeletons fused from them
        frames = [self._reference] if reference else []
        self.inputs = (*ports, *(skeleton_input(topic, values) for topic in (*frames, graph.FUSED)))
        self.outputs = (
            Port(graph.IMU_SKELETON, Skeletons(), qos, measured=True),
            *(Port(graph.orientation_topic(s.segment), Orientation(s.segment), qos, measured=True) for s in sensors),
        )
        self.services = {graph.ALIGN_SERVICE: self._align}

    def _align(self) -> str:
        line = self.tracker.align()
        self.events.append(line)
        return line

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic in self._mags:
            # for the next reading of its sensor
            self._fields[self._mags[topic]] = payload[0], payload[2]
        elif topic in self._readings:
            return self._read(self._readings[topic], payload, now.ros_ns)
        elif topic == self._reference:
            self.tracker.take_camera_frame(payload[0].stamp_ns, now.ros_ns)
        else:
            wearer = self._wearer.pick(payload)
            if wearer is not None:
                self.tracker.take_skeleton(wearer, now.ros_ns)
        return ()

    def _read(self, segment: str, sample: ImuSample, received_ns: int) -> Iterable[Output]:
        stamp_ns, field = self._fields.pop(segment, (0, None))  # the latest, once
        if field is not None and abs(sample.stamp_ns - stamp_ns) < _FIELD_NS:
            sample = replace(sample, magnetic_field=field)
        try:
            output = self.tracker.add(segment, sample, received_ns, skeleton=self.wanted(graph.IMU_SKELETON))
        except BodyTrackingError:
            self._refused[f"refused of {segment}"] += 1
            raise
        outputs = []
        if output.orientation is not None:
            # the segment of an exchanged sensor differs from the stated one
            topic = graph.orientation_topic(output.orientation.segment)
            outputs.append(Output(topic, output.orientation, output.orientation.stamp_ns))
        if output.skeleton is not None:
            outputs.append(Output(graph.IMU_SKELETON, (output.skeleton,), output.skeleton.stamp_ns))
        return outputs

    def refused(self, topic: str) -> None:
        """Count an invalid message of a sensor."""
        if topic in self._readings:
            self._refused[f"refused of {self._readings[topic]}"] += 1
        elif topic in self._mags:
            self._refused[f"refused fields of {self._mags[topic]}"] += 1

    def restart(self) -> None:
        """The tracker detects jumps of time itself."""
        super().restart()
        self.tracker.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Problems by sensor, counters, and standard deviations of the alignments."""
        problems = self.tracker.problems(ros_ns)
        values: dict[str, object] = {f"problem {number}": line for number, line in enumerate(problems, start=1)}
        values |= self.tracker.counters
        values |= self._refused
        values |= self.tracker.state()
        return (1 if problems else 0), "; ".join(problems), values

    @property
    def counters(self) -> Mapping[str, int]:
        return self.tracker.counters
