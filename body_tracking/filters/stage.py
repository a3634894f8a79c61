"""Fused skeletons, or every sensor's skeletons and orientations, to filtered ones and the state of a body model: the
stage of the node ``skeleton_filter``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

from body_tracking.core.orientation import SEGMENT_NUMBER, OrientationError, SegmentOrientation
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.skeleton import Skeleton
from body_tracking.filters import (
    DEFAULT_FILTER,
    FILTERS,
    make_filter,
    parameter_classes,
    parameter_prefix,
    prepare,
)
from body_tracking.filters.person import AWAY_NS, PersonFilter
from body_tracking.filters.smoothing import MAX_LAG
from body_tracking.fusion.people import People
from body_tracking.fusion.stage import calibration_inputs
from body_tracking.messages.codecs import (
    Ids,
    Orientation,
)
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, PEOPLE, people_from
from body_tracking.pipeline.roles import role_of
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
    0.1,
    "ekf: publish predicted frames when no frame has arrived for this long",
    unit="s",
    min=0.01,
    max=3600.0,
    live=True,
)
ORDER_WAIT = Parameter(
    "order_wait",
    0.05,
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


def _determines_results(values: Mapping[str, Value]) -> tuple[object, ...]:
    """The settable values on which a filter's estimates depend; without those of other filters."""
    name = str(values["filter"])
    return name, filter_parameters(name, values), values["kinect_v2"], values["not_kinects"]


_CALIBRATIONS = 1000
"""Queue of poses and clocks, long enough that none is lost while the filter is busy."""
_ORIENTATIONS = 32
"""Queue of orientations per segment: half a second."""


class FilterStage(Stage):
    """Filters fused skeletons, or every sensor's frames.

    There is a :class:`PersonFilter` for each person who may be tracked, independent of each other.
    """

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
        self._t_poses: Counter[str] = Counter()
        self._stamp_ns = 0
        self._people: People | None = None
        self._received = dict.fromkeys(sensors_of(values), 0)
        self._use(values, self._persons_of(values))

    def _persons_of(self, values: Mapping[str, Value]) -> dict[str, PersonFilter]:
        """The filters of the people who may be tracked, by their ids.

        Raises:
            FilterError: unknown filter, or invalid parameters.
            GraphError: the filter does not take this input, or cannot smooth.
            FusionError: the reference is not among the sensors.
        """
        name, people = str(values["filter"]), people_from(values)
        by_sensor = role_of({"filter": name, "filter_input": values["input"]}).input == graph.SENSORS_INPUT
        if not sensors_of(values) and not by_sensor:
            raise graph.GraphError(f"filter {name} needs skeletons; inertial sensors alone need --filter ekf")
        several = people.subject == ALL
        ids = graph.bodies(people.people) if several else (graph.check_body(str(values["body"])),)
        return {
            body: PersonFilter(
                make_filter(name, **filter_parameters(name, values)),
                values,
                body,
                self._publish,
                self.wanted,
                by_sensor=by_sensor,
                several=several,
            )
            for body in ids
        }

    def _use(self, values: Mapping[str, Value], persons: Mapping[str, PersonFilter]) -> None:
        """Filter people by these filters from now on; sets the inputs and outputs."""
        people = people_from(values)
        self._several = people.subject == ALL
        self._ids, self._persons = tuple(persons), tuple(persons.values())
        self._last_ns: dict[int, int] = {}
        alignment = self._persons[0].alignment
        if alignment is None:
            self._people = None
        elif self._people is None:
            self._people = People(sensors_of(values), people, alignment.reference, self._gone)
        orientations = orientation_topics(names_in(values["orientations"]))
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in sensors_of(values)}
        qos = skeleton_qos(values)
        if alignment is not None or not self._sensors:
            self.inputs = (
                *calibration_inputs(len(self._sensors), _CALIBRATIONS),
                *(skeleton_input(topic, values) for topic in self._sensors),
                *(Port(topic, Orientation(each), qos, _ORIENTATIONS) for topic, each in orientations.items()),
            )
        else:
            self.inputs = (skeleton_input(graph.FUSED, values),)
        ports = (port for person in self._persons for port in person.outputs(qos, result_qos(values)))
        self.outputs = (
            *{port.topic: port for port in ports}.values(),
            Port(graph.TRACKED, Ids(), RELIABLE_QOS, optional=True),
        )

    def start(self, now: Now) -> Iterable[Output]:
        prepare(str(self.values["filter"]))
        return ()

    def change(self, values: Mapping[str, Value]) -> None:
        """Publish the frames that are held back; start a new filter at the next frame where its results would differ.

        It takes over the sensors' poses and clocks, since latched messages come once, but knows nobody.
        """
        if _determines_results(values) == _determines_results(self.values):
            for person in self._persons:
                person.change(values)
            self.values = values
            return
        made = self._persons_of(values)
        for former in self._persons:
            former.reset()
        self._report_t_poses(self.counters)
        self._t_poses.clear()
        for person, former in zip(made.values(), self._persons, strict=True):
            if person.alignment is not None and former.alignment is not None:
                person.alignment = former.alignment
        self._use(values, made)
        self.values = values
        prepare(str(values["filter"]))
        there = {port.topic for port in self.outputs}
        self._published = [output for output in self._published if output.topic in there]

    def _publish(self, topic: str, payload: Any, stamp_ns: int) -> None:
        self._published.append(Output(topic, payload, stamp_ns))

    def _collect(self) -> Iterable[Output]:
        """The filters' outputs, and the ids of tracked people if they changed."""
        published, self._published = self._published, []
        if self._several:
            published = _together(published)
        if published:
            self._stamp_ns = published[-1].stamp_ns or self._stamp_ns
        tracked = self._tracked_ids()
        if tracked != self._tracked:
            self._tracked = tracked
            payload = self._stamp_ns, str(self.values["world_frame"]), tracked
            published.append(Output(graph.TRACKED, payload, self._stamp_ns))
        return published

    def _tracked_ids(self) -> tuple[str, ...]:
        if self._people is not None:
            return tuple(self._ids[number - 1] for number in self._people.tracked)
        return tuple(body for body, person in zip(self._ids, self._persons, strict=True) if person.tracked)

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic in (graph.CALIBRATION, graph.CALIBRATION_CLOCK):
            for placed in (self._people, *(person.alignment for person in self._persons)):
                if placed is not None and topic == graph.CALIBRATION:
                    placed.set_pose(payload)
                elif placed is not None:
                    placed.set_clock(*payload)
        elif topic == graph.FUSED:
            self._take_fused(payload, now.steady_ns)
        elif topic in self._sensors:
            self._hold(self._sensors[topic], payload, now.steady_ns)
        else:
            self._take_orientation(payload, now.steady_ns)
        return self._collect()

    def _take_fused(self, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """Filter one fused frame; unknown numbers of people are ignored."""
        if self._several:
            self._take_several(skeletons, now_ns)
        else:
            self._persons[0].on_fused(skeletons[0], now_ns)
        self._poll(now_ns)

    def _take_several(self, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        stamp_ns = skeletons[0].stamp_ns
        for number, last_ns in list(self._last_ns.items()):
            if stamp_ns - last_ns > AWAY_NS:  # another person may have the number now
                self._gone(number)
        for skeleton in skeletons:
            if 1 <= skeleton.body <= len(self._persons):
                self._last_ns[skeleton.body] = stamp_ns
                self._persons[skeleton.body - 1].on_fused(skeleton, now_ns)

    def _hold(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """Queue the people in one frame of one sensor."""
        self._received[sensor] += 1
        assert self._people is not None
        for number, skeleton in self._people.sort(sensor, skeletons):
            own = replace(skeleton, body=number) if self._several else skeleton
            self._persons[number - 1].hold(sensor, own, now_ns)

    def _take_orientation(self, measurement: SegmentOrientation, now_ns: int) -> None:
        """Take the orientation of one segment of the wearer, of several people the one nearest to the reference."""
        wearer = self._people.nearest if self._people is not None and self._several else 1
        if wearer is not None:
            self._persons[wearer - 1].on_orientation(measurement, now_ns)

    def _gone(self, number: int) -> None:
        self._last_ns.pop(number, None)
        self._persons[number - 1].forget()

    def poll(self, steady_ns: int) -> Iterable[Output]:
        self._poll(steady_ns)
        return self._collect()

    def _poll(self, now_ns: int) -> None:
        for person in self._persons:
            person.poll(now_ns)
        newest_ns = max(person.newest_ns for person in self._persons)
        for person in self._persons:  # release held frames of people who are not seen now with the others' frames
            person.passed(newest_ns)

    @property
    def deadline_ns(self) -> int | None:
        return min((at for person in self._persons if (at := person.deadline_ns) is not None), default=None)

    @property
    def due_ns(self) -> int | None:
        return min((at for person in self._persons if (at := person.due_ns) is not None), default=None)

    def settle(self) -> None:
        for person in self._persons:
            person.settle()

    def reset(self, topic: str) -> None:
        """Reset for fused frames; with sensors' frames the alignment detects jumps itself."""
        if topic == graph.FUSED:
            self._last_ns.clear()
            for person in self._persons:
                person.reset()

    def restart(self) -> None:
        super().restart()
        if self._people is not None:  # sensors' frames, of which no jump of a stamp resets anything here
            self._people.reset()
            for person in self._persons:
                person.forget()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        counters = self.counters
        self._report_t_poses(counters)
        name, frozen = str(self.values["filter"]), "" if self._people is None else self._people.frozen
        absent = [each for each in dict.fromkeys(names_in(self.values["not_kinects"])) if each not in self._received]
        strange = f"not_kinects: no sensor {', '.join(absent)} here" if absent and self._received else ""
        notes = [note for note in (frozen, strange) if note]
        text = f"{name} ({'; '.join(notes)})" if notes else name
        return int(bool(notes)), text, {"tracked": ", ".join(self._tracked_ids()), **counters}

    def _report_t_poses(self, counters: Mapping[str, int]) -> None:
        """Tell of T-poses that were used or forgotten since the last call."""
        before, self._t_poses = self._t_poses, Counter(counters)
        if self._t_poses["t_poses"] > before["t_poses"]:
            self.events.append("joint centres of this person estimated from a T-pose: angles are more accurate now")
        if self._t_poses["t_poses_forgotten"] > before["t_poses_forgotten"]:
            self.events.append(
                "the T-pose no longer counts: its person was away, time jumped back, or the filter was changed; hold "
                "another one"
            )

    @property
    def counters(self) -> Mapping[str, int]:
        """Sums of all filters' counters, and those of the association of people."""
        total: Counter[str] = Counter()
        for person in self._persons:
            total.update(person.counters)
        if self._people is not None:
            total.update({f"frames of {sensor}": count for sensor, count in self._received.items()})
            total.update({f"association {name}": count for name, count in self._people.counts.items()})
        return dict(total)


def _together(published: Sequence[Output]) -> list[Output]:
    """The outputs with the filtered skeletons of one time in one message, last."""
    bodies = [body for output in published if output.topic == graph.FILTERED for body in output.payload]
    bodies.sort(key=lambda each: (each.stamp_ns, each.body))
    return [
        *(output for output in published if output.topic != graph.FILTERED),
        *(
            Output(graph.FILTERED, tuple(group), stamp_ns)
            for stamp_ns, group in groupby(bodies, key=lambda each: each.stamp_ns)
        ),
    ]
