"""Fused skeletons, or every sensor's skeletons and orientations, to filtered ones and the state of a body model.

The stage of the node ``skeleton_filter``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

from body_tracking import graph
from body_tracking.calibration.result import SensorPose
from body_tracking.clocks import ClockModel
from body_tracking.filters import (
    DEFAULT_FILTER,
    FILTERS,
    ModelFilter,
    make_filter,
    parameter_classes,
    parameter_prefix,
)
from body_tracking.filters.prediction import Prediction
from body_tracking.fusion.alignment import SensorAlignment
from body_tracking.fusion.fusion import WORLD
from body_tracking.fusion.ordering import Ordering
from body_tracking.fusion.people import PEOPLE, People, PeopleParameters, people_from
from body_tracking.fusion.stage import calibration_inputs
from body_tracking.fusion.subject import ALL, HeldSubject
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.tracking import LengthChanges
from body_tracking.orientation import SEGMENT_NUMBER, OrientationError, SegmentOrientation
from body_tracking.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.pipeline.codecs import (
    Ids,
    ModelCovariance,
    ModelState,
    ModelStddev,
    Orientation,
    Segments,
    Skeletons,
    Text,
)
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
from body_tracking.recording.qos import RELIABLE as RELIABLE_QOS
from body_tracking.recording.qos import Qos
from body_tracking.skeleton import NANOSECONDS, Skeleton

FILTER = Parameter("filter", DEFAULT_FILTER, "which filter", choices=FILTERS, live=True)
INPUT = Parameter(
    "input",
    graph.AUTO,
    "what is filtered: fused skeletons, or every sensor's frames at their own time; auto: sensors for ekf, else fused",
    choices=(graph.AUTO, graph.FUSED_INPUT, graph.SENSORS_INPUT),
)
DEFAULT_PREDICT_AFTER = 0.1
"""Seconds."""

_AWAY = NANOSECONDS
"""Of somebody who is away from the fused frames for this long, nanoseconds, nothing is kept with several people."""

PREDICT_AFTER = Parameter(
    "predict_after",
    DEFAULT_PREDICT_AFTER,
    "ekf: publish what is to be expected when no frame has come for this long",
    unit="s",
    min=0.01,
    max=3600.0,
    live=True,
)
DEFAULT_ORDER_WAIT = 0.05
"""Seconds."""

ORDER_WAIT = Parameter(
    "order_wait",
    DEFAULT_ORDER_WAIT,
    "sensors' frames: one waits at most this long for another sensor's older one that is due; 0 for the least delay, "
    "with frames that come late then taken into account by going back",
    unit="s",
    min=0.0,
    max=1.0,
    live=True,
)
ORIENTATIONS = Parameter(
    "orientations",
    (),
    "ekf: segments whose orientations by inertial sensors it takes, from /imu/<segment>/orientation",
)


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """What to filter, and how; defaults as the node's.

    Attributes:
        filter_name: one of ``FILTERS``.
        parameters: of the filter, without a prefix.
        input: ``graph.AUTO``, ``graph.FUSED_INPUT`` or ``graph.SENSORS_INPUT``.
        sensors: for ``graph.SENSORS_INPUT``.
        reference: likewise: whose clock is that of ``world``; the first one where empty.
        world: likewise: the frame of the output.
        body: the person's id in topics, of one subject.
        predict_after: seconds without a frame after which predicted ones are published.
        order_wait: seconds that a sensor's frame waits at most for an older one.
        people: whom to filter.
    """

    filter_name: str = DEFAULT_FILTER
    parameters: Mapping[str, Any] = field(default_factory=dict)
    input: str = graph.AUTO
    sensors: Sequence[str] = ()
    reference: str = ""
    world: str = WORLD
    body: str = graph.DEFAULT_BODY
    predict_after: float = DEFAULT_PREDICT_AFTER
    order_wait: float = DEFAULT_ORDER_WAIT
    people: PeopleParameters = field(default_factory=PeopleParameters)


def orientation_topics(segments: Sequence[str]) -> dict[str, str]:
    """Of each segment in :data:`ORIENTATIONS` its topic, as segment by topic.

    Raises:
        OrientationError: the body has no such segment.
    """
    unknown = [segment for segment in segments if segment not in SEGMENT_NUMBER]
    if unknown:
        known = ", ".join(SEGMENT_NUMBER)
        raise OrientationError(f"parameter 'orientations': {', '.join(unknown)}: expected some of {known}")
    return {graph.orientation_topic(segment): segment for segment in segments}


def filter_table() -> tuple[Parameter, ...]:
    """The parameters of all filters, as ``skeleton_filter`` has them."""
    return tuple(
        item
        for prefix, parameter_class in parameter_classes().items()
        for item in parameters_from(parameter_class, live=True, prefix=prefix)
    )


def filter_parameters(name: str, values: Mapping[str, Value]) -> dict[str, Any]:
    """Those of the values of :func:`filter_table` that are the named filter's, without the prefix."""
    prefix = parameter_prefix(name)
    return fields_of(parameter_classes()[prefix], values, prefix=prefix)


class PersonFilter:
    """Feeds the filter of one person and publishes its output.

    Args:
        settings: which one.
        publish: takes a topic, the content of a message and its capture time.
        wanted: whether to make messages of a topic at all; always when None.
        one_of_several: gets the filtered skeletons instead of ``publish``, of one of several people; frames are of this
            person alone then, and topics below the person's name.

    Attributes:
        by_sensor: it takes sensors' frames, not fused ones.
        alignment: places these; None with fused ones.
        models: it publishes the state of a model.

    Raises:
        FilterError: the filter or its parameters make no sense.
        GraphError: it does not take this input.
        FusionError: the reference is not among the sensors.
    """

    def __init__(
        self,
        settings: FilterSettings,
        publish: Callable[[str, Any, int], None],
        wanted: Callable[[str], bool] | None = None,
        one_of_several: Callable[[Skeleton], None] | None = None,
    ) -> None:
        self._filter = make_filter(settings.filter_name, **settings.parameters)
        role = graph.role_of(graph.GraphOptions(filter_name=settings.filter_name, filter_input=settings.input))
        self.by_sensor = role.input == graph.SENSORS_INPUT
        self.alignment: SensorAlignment | None = None
        self.people: People | None = None
        if self.by_sensor:
            self.alignment = SensorAlignment(settings.sensors, settings.reference or None, settings.world)
            if one_of_several is None:
                self.people = People(settings.sensors, settings.people, self.alignment.reference)
        self._ordering = Ordering(settings.sensors, settings.order_wait)
        self._model_filter = self._filter if isinstance(self._filter, ModelFilter) else None
        self.models = self._model_filter is not None
        self._prediction = Prediction(settings.predict_after)
        self._lengths = LengthChanges()
        self._topics = graph.model_topics(settings.body, one_of_several is not None)
        self._body = settings.body
        self._publish = publish
        self._skeleton = one_of_several or self._publish_skeleton
        self._wanted = wanted if wanted is not None else lambda topic: True
        self._predicted = 0
        self._present = False
        self._received = dict.fromkeys(settings.sensors, 0)

    @property
    def counters(self) -> dict[str, int]:
        """What happened since the construction."""
        counters = dict(self._filter.counters)
        if self.alignment is not None:
            counters |= {f"frames of {sensor}": count for sensor, count in self._received.items()}
            counters |= {f"alignment {name}": count for name, count in self.alignment.counters.items()}
            counters |= {f"waited {name}": count for name, count in self._ordering.counters.items()}
        if self.people is not None:
            counters |= {f"association {name}": count for name, count in self.people.counters.items()}
        if self._model_filter is not None:
            counters["predicted frames"] = self._predicted
        return counters

    def set_pose(self, pose: SensorPose) -> None:
        """A sensor's pose, in force from its time on."""
        if self.people is not None:
            self.people.set_pose(pose)
        if self.alignment is not None:
            self.alignment.set_pose(pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """A sensor's clock, in force from a reference time on."""
        if self.people is not None:
            self.people.set_clock(sensor, valid_from_ns, clock)
        if self.alignment is not None:
            self.alignment.set_clock(sensor, valid_from_ns, clock)

    def inherit(self, before: PersonFilter | PeopleFilter) -> None:
        """Take over what is known of the sensors from the filter that was there before: latched poses come once."""
        if self.by_sensor and before.by_sensor and isinstance(before, PersonFilter):
            self.alignment, self.people = before.alignment, before.people

    def outputs(self, skeletons: Qos, results: Qos) -> tuple[Port, ...]:
        """The topics that it publishes, where skeletons and results have these qualities of service."""
        filtered = (Port(graph.FILTERED, Skeletons(), skeletons, measured=True),)
        if self._model_filter is None:
            return filtered
        model, topics = self._model_filter.model, self._topics
        return (
            *filtered,
            Port(topics.state, ModelState(model), skeletons, measured=True),
            Port(topics.stddev, ModelStddev(model), skeletons),
            Port(topics.covariance, ModelCovariance(model), skeletons),
            Port(topics.segments, Segments(model), results),
            Port(topics.urdf, Text(), graph.URDF_QOS),
        )

    @property
    def tracked(self) -> tuple[str, ...]:
        """The ids of the people who are there."""
        there = self._present if self.people is None else bool(self.people.tracked)
        return (self._body,) if there else ()

    def on_fused(self, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """One fused frame.

        Args:
            skeletons: in world; with one subject the first of them counts.
            now_ns: when it arrived, in a clock that goes on.
        """
        self.poll(now_ns)
        skeleton = skeletons[0]
        self._present = True
        if self._model_filter is not None:
            self._take([("", skeleton)], now_ns)
        elif (filtered := self._filter.update(skeleton)) is not None:
            self._skeleton(filtered)

    def hold(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """Keep one frame of one sensor: the next :meth:`poll` takes all that are here, in the order of their stamps.

        Args:
            sensor: its name.
            skeletons: the bodies in it, in the sensor's own frame and clock.
            now_ns: as above.
        """
        aligned = self._aligned(sensor, skeletons)
        if aligned is not None:
            self._ordering.hold(sensor, aligned, now_ns)

    def _aligned(self, sensor: str, skeletons: Sequence[Skeleton]) -> Skeleton | None:
        """The person in ``world``; None where the sensor is not calibrated, or shows nobody."""
        self._received[sensor] += 1
        if self.people is None:
            subject = skeletons[0]
        elif found := self.people.sort(sensor, skeletons):
            ((_, subject),) = found
        else:
            return None
        return None if self.alignment is None else self.alignment.push(sensor, subject)

    def on_orientation(self, measurement: SegmentOrientation, now_ns: int) -> None:
        """The orientation of one segment, in ``world`` and in the reference's clock, as inertial sensors have it.

        What it changes is published with the next frame; while none comes, with the predicted ones. Filters without a
        model of the body have no use for it.

        Args:
            measurement: how it is turned.
            now_ns: as above.
        """
        if self._model_filter is None:
            return
        self.poll(now_ns)
        if self._model_filter.take_orientation(measurement) and self._prediction.due_ns is None:
            self._prediction.arrived(measurement.stamp_ns, now_ns)

    def poll(self, now_ns: int) -> None:
        """Take the frames that have waited long enough, and publish the predicted ones that are due."""
        if self._model_filter is None:
            return
        # each when it need not wait longer, whenever somebody asks: else what is predicted would depend on that
        while (deadline_ns := self._ordering.deadline_ns) is not None and deadline_ns <= now_ns:
            self._take(self._ordering.poll(deadline_ns), deadline_ns)
        self._take(self._ordering.poll(now_ns), now_ns)
        # what waits is of a time that must not be told before
        while self.deadline_ns is None and (stamp_ns := self._prediction.due(now_ns)) is not None:
            predicted = self._model_filter.predict(stamp_ns)
            if predicted is None:
                self._prediction.stop()
                return
            self._predicted += 1
            self._send(*predicted)

    def settle(self) -> None:
        """Do what the next frame would have to wait for; to be called when there is nothing else to do."""
        expected_ns = self._ordering.expected_ns
        if self._model_filter is not None and expected_ns is not None:
            self._model_filter.settle(expected_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When :meth:`poll` is to be called for a frame that waits, in the clock by which it does; None without one."""
        return self._ordering.deadline_ns

    @property
    def due_ns(self) -> int | None:
        """When it should be called for a predicted frame, in the clock of ``now_ns``; None where none is to come
        before a frame that waits.
        """
        return self._prediction.due_ns if self.deadline_ns is None else None

    def reset(self) -> None:
        """Forget the person, because time jumped back; poses and clocks stay."""
        self._filter.reset()
        self._ordering.flush()
        self._prediction.stop()
        self._lengths.reset()
        self._present = False

    def forget(self) -> None:
        """Forget the person, because the next frames are of somebody else."""
        self.reset()
        if self.alignment is not None:
            self.alignment.forget()

    def _take(self, frames: Sequence[tuple[str, Skeleton]], now_ns: int) -> None:
        """Filter frames, and publish what is known after each that does not come after newer ones."""
        assert self._model_filter is not None
        for sensor, skeleton in frames:
            if not self._model_filter.take(skeleton, sensor):
                continue
            estimate = self._model_filter.estimate
            assert estimate is not None  # a frame was taken
            self._prediction.arrived(skeleton.stamp_ns, now_ns)
            self._send(None, estimate)
            if self._lengths.news(estimate.stamp_ns, estimate.lengths):
                from body_tracking.kinematics.urdf import urdf

                text = urdf(self._model_filter.model, estimate.lengths, self._body)
                self._publish(self._topics.urdf, text, estimate.stamp_ns)

    def _publish_skeleton(self, skeleton: Skeleton) -> None:
        self._publish(graph.FILTERED, (skeleton,), skeleton.stamp_ns)

    def _send(self, skeleton: Skeleton | None, estimate: ModelEstimate) -> None:
        """Publish an estimate, and the skeleton that belongs to it; None for the filter's own."""
        assert self._model_filter is not None
        if self._wanted(graph.FILTERED):
            skeleton = skeleton or self._model_filter.filtered
            assert skeleton is not None
            self._skeleton(skeleton)
        topics = self._topics
        for topic in (topics.state, topics.stddev, topics.covariance, topics.segments):
            if self._wanted(topic):
                self._publish(topic, estimate, estimate.stamp_ns)


class PeopleFilter:
    """A :class:`PersonFilter` of each person; each gives what it would give if there were nobody else.

    Arguments and errors as there.

    Attributes:
        by_sensor: as there.
        models: as there.
    """

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
        self._wearer = HeldSubject(settings.people.hold)
        self.people: People | None = None
        if first.alignment is not None:
            self.people = People(settings.sensors, settings.people, first.alignment.reference, self._gone)

    def inherit(self, before: PersonFilter | PeopleFilter) -> None:
        """Take over what is known of the sensors from the filter that was there before: latched poses come once."""
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
        """The ids of the people who are there."""
        if self.people is not None:
            return tuple(self._ids[number - 1] for number in self.people.tracked)
        return tuple(body for person in self._persons for body in person.tracked)

    @property
    def counters(self) -> dict[str, int]:
        """What happened since the construction, to all together."""
        total: Counter[str] = Counter()
        for person in self._persons:
            total.update(person.counters)
        if self.people is not None:
            total.update({f"association {name}": count for name, count in self.people.counters.items()})
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
            skeletons: in world, each with the person's number; others than those that there are do not count.
            now_ns: when it arrived, in a clock that goes on.
        """
        self._wearer.pick(skeletons)
        stamp_ns = skeletons[0].stamp_ns
        for number, last_ns in list(self._last_ns.items()):
            if stamp_ns - last_ns > _AWAY:  # somebody else may have the number now
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
        """The orientation of one segment of the one who wears the sensors: who is nearest to the reference sensor."""
        wearer = self._wearer.body if self.people is None else self.people.nearest
        if wearer is not None and wearer <= len(self._persons):
            self._persons[wearer - 1].on_orientation(measurement, now_ns)
            self._flush()

    def poll(self, now_ns: int) -> None:
        """Take the frames that have waited long enough, and publish the predicted ones that are due."""
        for person in self._persons:
            person.poll(now_ns)
        self._flush()

    def settle(self) -> None:
        """As of :class:`PersonFilter`."""
        for person in self._persons:
            person.settle()

    @property
    def deadline_ns(self) -> int | None:
        """As of :class:`PersonFilter`, of whoever comes first."""
        return min((at for person in self._persons if (at := person.deadline_ns) is not None), default=None)

    @property
    def due_ns(self) -> int | None:
        """As of :class:`PersonFilter`, of whoever comes first."""
        return min((at for person in self._persons if (at := person.due_ns) is not None), default=None)

    def reset(self) -> None:
        """Forget everybody, because time jumped back; poses and clocks stay."""
        self._last_ns.clear()
        for person in self._persons:
            person.reset()

    def _gone(self, number: int) -> None:
        self._last_ns.pop(number, None)
        self._persons[number - 1].forget()

    def _filtered_one(self, skeleton: Skeleton) -> None:
        self._filtered.append(skeleton)

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
    """The filter that the settings ask for; arguments and errors as of :class:`PersonFilter`."""
    of_people = settings.people.subject == ALL
    return PeopleFilter(settings, publish, wanted) if of_people else PersonFilter(settings, publish, wanted)


_CALIBRATIONS = 1000
"""Poses, and clocks, that may wait while the filter is busy; none is to be lost."""
_ORIENTATIONS = 32
"""Orientations of a segment that may wait likewise: half a second of them."""


class FilterStage(Stage):
    """Filters fused skeletons, or what every sensor sees."""

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
        ORIENTATIONS,
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
        self.filter = self._made(values)
        self._connect(values)

    def _made(self, values: Mapping[str, Value]) -> PersonFilter | PeopleFilter:
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
        )
        return filter_of(settings, self._publish, self.wanted)

    def _connect(self, values: Mapping[str, Value]) -> None:
        """Take what the filter needs, and nothing else."""
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

    def change(self, values: Mapping[str, Value]) -> None:
        """A new filter starts from the next frame on."""
        made = self._made(values)
        made.inherit(self.filter)
        self.filter, self.values = made, values
        self._connect(values)

    def _publish(self, topic: str, payload: Any, stamp_ns: int) -> None:
        self._published.append(Output(topic, payload, stamp_ns))

    def _taken(self) -> Iterable[Output]:
        """What the filter has published, and the ids of those who are tracked where these are others now."""
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
        return self._taken()

    def poll(self, steady_ns: int) -> Iterable[Output]:
        self.filter.poll(steady_ns)
        return self._taken()

    @property
    def deadline_ns(self) -> int | None:
        return self.filter.deadline_ns

    @property
    def due_ns(self) -> int | None:
        return self.filter.due_ns

    def settle(self) -> None:
        self.filter.settle()

    def reset(self, topic: str) -> None:
        """Of a sensor, the alignment finds out by itself."""
        if topic == graph.FUSED:
            self.filter.reset()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        counters = self.filter.counters
        before, self._t_poses = self._t_poses, counters.get("t_poses", 0)
        if self._t_poses > before:
            self.events.append("learnt from a T-pose where sensors see this person's joints: angles are better now")
        return 0, str(self.values["filter"]), {"tracked": ", ".join(self.filter.tracked), **counters}

    @property
    def counters(self) -> Mapping[str, int]:
        return self.filter.counters
