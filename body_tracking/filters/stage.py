"""Fused skeletons, or every sensor's skeletons and orientations, to filtered ones and the state of a body model: the
stage of the node ``skeleton_filter``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from body_tracking.core.orientation import SEGMENT_NUMBER, OrientationError
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.filters import (
    DEFAULT_FILTER,
    FILTERS,
    parameter_classes,
    parameter_prefix,
    prepare,
)
from body_tracking.filters.people import PeopleFilter, filter_of
from body_tracking.filters.person import DEFAULT_ORDER_WAIT, DEFAULT_PREDICT_AFTER, FilterSettings, PersonFilter
from body_tracking.filters.smoothing import MAX_LAG
from body_tracking.fusion.stage import calibration_inputs
from body_tracking.messages.codecs import (
    Ids,
    Orientation,
)
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import PEOPLE, people_from
from body_tracking.pipeline.shared import (
    BODY,
    REFERENCE,
    RELIABLE,
    SENSORS,
    WORLD_FRAME,
    names_in,
    result_qos,
    sensors_of,
    skeleton_input,
    skeleton_qos,
)
from body_tracking.pipeline.stage import Now, Output, Port, Stage

FILTER = Parameter("filter", DEFAULT_FILTER, "the filter", choices=FILTERS, live=True)
INPUT = Parameter(
    "input",
    graph.AUTO,
    "the input: fused skeletons, or every sensor's frames at their own times; auto: sensors for ekf, else fused",
    choices=(graph.AUTO, graph.FUSED_INPUT, graph.SENSORS_INPUT),
)
PREDICT_AFTER = Parameter(
    "predict_after",
    DEFAULT_PREDICT_AFTER,
    "ekf: publish predicted frames when no frame has arrived for this long",
    unit="s",
    min=0.01,
    max=3600.0,
    live=True,
)
ORDER_WAIT = Parameter(
    "order_wait",
    DEFAULT_ORDER_WAIT,
    "input sensors: the longest wait of a frame for an older one of another sensor that is due; 0 for the least "
    "delay: late frames are then inserted and later updates repeated",
    unit="s",
    min=0.0,
    max=1.0,
    live=True,
)
LAG = Parameter(
    "lag",
    0.0,
    "fixed-lag smoothing: publish each frame this much later, corrected by the frames after it; for recording and "
    "looking, not for control. Not with the thesis's filters. Above 0, nothing is predicted while all sensors are "
    "silent",
    unit="s",
    min=0.0,
    max=MAX_LAG,
    live=True,
)
KINECT_V2 = Parameter(
    "kinect_v2",
    True,
    "subtract the errors that all Kinects v2 share: those of the arms' directions against Vicon, and of the spine, "
    "which they see behind its joints; false for other sensors. No effect on the thesis's filters",
    live=True,
)
NOT_KINECTS = Parameter(
    "not_kinects",
    (),
    "sensors to which kinect_v2 does not apply; up and replay name those of --depth and --camera here",
    live=True,
)
ORIENTATIONS = Parameter(
    "orientations",
    (),
    "ekf: segments with inertial sensors, whose orientations come from /imu/<segment>/orientation",
)


def orientation_topics(segments: Sequence[str]) -> dict[str, str]:
    """Segments of :data:`ORIENTATIONS` by topic.

    Raises:
        OrientationError: the body has no such segment.
    """
    unknown = [segment for segment in segments if segment not in SEGMENT_NUMBER]
    if unknown:
        known = ", ".join(SEGMENT_NUMBER)
        raise OrientationError(f"parameter 'orientations': {', '.join(unknown)}: expected some of {known}")
    return {graph.orientation_topic(segment): segment for segment in segments}


_SETTABLE = {
    "": ("measurement_noise_scale", "predict_for", "t_pose"),
    "ekf.": ("predict_for", "posture", "t_pose", "bone_correlation"),
}
"""The settable parameters of filters by prefix; those of the thesis are fixed."""


def filter_table() -> tuple[Parameter, ...]:
    """The settable parameters of all filters."""
    classes = parameter_classes()
    return tuple(
        item
        for prefix, names in _SETTABLE.items()
        for item in parameters_from(classes[prefix], only=names, live=True, prefix=prefix)
    )


def filter_parameters(name: str, values: Mapping[str, Value]) -> dict[str, Any]:
    """The named filter's values of :func:`filter_table`, without the prefix."""
    prefix = parameter_prefix(name)
    return fields_of(parameter_classes()[prefix], values, prefix=prefix)


_CALIBRATIONS = 1000
"""Queue of poses and clocks, long enough that none is lost while the filter is busy."""
_ORIENTATIONS = 32
"""Queue of orientations per segment: half a second."""


class FilterStage(Stage):
    """Filters fused skeletons, or every sensor's frames."""

    NAME = "skeleton_filter"
    PARAMETERS = (
        FILTER,
        INPUT,
        SENSORS,
        REFERENCE,
        WORLD_FRAME,
        BODY,
        ORDER_WAIT,
        PREDICT_AFTER,
        LAG,
        ORIENTATIONS,
        KINECT_V2,
        NOT_KINECTS,
        *PEOPLE,
        *filter_table(),
        RELIABLE,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self._published: list[Output] = []
        self._tracked: tuple[str, ...] = ()
        self._t_poses = 0
        self._stamp_ns = 0
        self.filter = self._make(values)
        self._connect(values)

    def _make(self, values: Mapping[str, Value]) -> PersonFilter | PeopleFilter:
        given: dict[str, Any] = dict(values)
        name = given["filter"]
        settings = FilterSettings(
            name,
            filter_parameters(name, values),
            given["input"],
            sensors_of(values),
            given["reference"],
            given["world_frame"],
            graph.check_body(given["body"]),
            given["predict_after"],
            given["order_wait"],
            people_from(values),
            given["kinect_v2"],
            given["lag"],
            names_in(values["not_kinects"]),
        )
        return filter_of(settings, self._publish, self.wanted)

    def _connect(self, values: Mapping[str, Value]) -> None:
        """Set the inputs and outputs of the current filter."""
        orientations = orientation_topics(names_in(values["orientations"]))
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in sensors_of(values)}
        qos = skeleton_qos(values)
        if self.filter.by_sensor:
            self.inputs = (
                *calibration_inputs(len(self._sensors), _CALIBRATIONS),
                *(skeleton_input(topic, values) for topic in self._sensors),
                *(Port(topic, Orientation(each), qos, _ORIENTATIONS) for topic, each in orientations.items()),
            )
        else:
            self.inputs = (skeleton_input(graph.FUSED, values),)
        self.outputs = (
            *self.filter.outputs(qos, result_qos(values)),
            Port(graph.TRACKED, Ids(), RELIABLE_QOS, optional=True),
        )

    def start(self, now: Now) -> Iterable[Output]:
        prepare(str(self.values["filter"]))
        return ()

    def change(self, values: Mapping[str, Value]) -> None:
        """Start a new filter at the next frame; frames that the present one holds back are published."""
        made = self._make(values)
        self.filter.flush()
        made.inherit(self.filter)
        self.filter, self.values = made, values
        prepare(str(values["filter"]))
        self._connect(values)
        there = {port.topic for port in self.outputs}
        self._published = [output for output in self._published if output.topic in there]

    def _publish(self, topic: str, payload: Any, stamp_ns: int) -> None:
        self._published.append(Output(topic, payload, stamp_ns))

    def _collect(self) -> Iterable[Output]:
        """The filter's outputs, and the ids of tracked people if they changed."""
        published, self._published = self._published, []
        if published:
            self._stamp_ns = published[-1].stamp_ns or self._stamp_ns
        if self.filter.tracked != self._tracked:
            self._tracked = self.filter.tracked
            payload = self._stamp_ns, str(self.values["world_frame"]), self._tracked
            published.append(Output(graph.TRACKED, payload, self._stamp_ns))
        return published

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic == graph.CALIBRATION_CLOCK:
            self.filter.set_clock(*payload)
        elif topic == graph.CALIBRATION:
            self.filter.set_pose(payload)
        elif topic == graph.FUSED:
            self.filter.on_fused(payload, now.steady_ns)
        elif topic in self._sensors:
            self.filter.hold(self._sensors[topic], payload, now.steady_ns)
        else:
            self.filter.on_orientation(payload, now.steady_ns)
        return self._collect()

    def poll(self, steady_ns: int) -> Iterable[Output]:
        self.filter.poll(steady_ns)
        return self._collect()

    @property
    def deadline_ns(self) -> int | None:
        return self.filter.deadline_ns

    @property
    def due_ns(self) -> int | None:
        return self.filter.due_ns

    def settle(self) -> None:
        self.filter.settle()

    def reset(self, topic: str) -> None:
        """Reset for fused frames; with sensors' frames the alignment detects jumps itself."""
        if topic == graph.FUSED:
            self.filter.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        counters = self.filter.counters
        before, self._t_poses = self._t_poses, counters.get("t_poses", 0)
        if self._t_poses > before:
            self.events.append("joint centres of this person estimated from a T-pose: angles are more accurate now")
        return 0, str(self.values["filter"]), {"tracked": ", ".join(self.filter.tracked), **counters}

    @property
    def counters(self) -> Mapping[str, int]:
        return self.filter.counters
