"""What the node ``skeleton_filter`` does, without ROS: skeletons and calibrations in, serialised messages out.

The node and the offline replay run this same class, so that they publish the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from body_tracking import graph
from body_tracking.calibration.result import ClockModel, SensorPose
from body_tracking.cdr import (
    encode_covariance,
    encode_model_state,
    encode_segments,
    encode_skeletons,
    encode_string,
)
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
from body_tracking.fusion.subject import SubjectSelector
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.tracking import ALL_CONVENTIONS, LengthChanges, segment_poses
from body_tracking.orientation import SEGMENT_NUMBER, OrientationError, SegmentOrientation
from body_tracking.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.skeleton import Skeleton

FILTER = Parameter("filter", DEFAULT_FILTER, "which filter", choices=FILTERS, live=True)
INPUT = Parameter(
    "input",
    graph.AUTO,
    "what is filtered: fused skeletons, or every sensor's frames at their own time; auto: sensors for ekf, else fused",
    choices=(graph.AUTO, graph.FUSED_INPUT, graph.SENSORS_INPUT),
)
DEFAULT_PREDICT_AFTER = 0.1
"""Seconds."""

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
ANGLES = (
    Parameter(
        "convention",
        graph.AUTO,
        "which angles: the model's own, those of the ISB, of REP-155, of Schlagenhauf (2017), or angles between joint "
        "positions; auto: by the filter, positional for linear ones, else model",
        choices=(graph.AUTO, *ALL_CONVENTIONS),
        live=True,
    ),
    Parameter(
        "input",
        graph.AUTO,
        "what they are made of: the state of the filter's model, or filtered skeletons, to which a model is fitted "
        "(positional angles need none); auto: by the filter",
        choices=(graph.AUTO, graph.SKELETON_INPUT, graph.MODEL_INPUT),
        live=True,
    ),
)
"""The parameters of ``joint_angles`` that the offline graph has too."""


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
        body: the person's id in topics.
        predict_after: seconds without a frame after which predicted ones are published.
        order_wait: seconds that a sensor's frame waits at most for an older one.
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


class FilterStage:
    """Feeds a filter and publishes what it makes.

    Args:
        settings: which one.
        publish: takes a topic, a serialised message and its capture time.
        wanted: whether to make messages of a topic at all; always when None.
        steady: the clock, nanoseconds, by which frames wait; when None, that of ``now_ns``, which may stand still.

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
        publish: Callable[[str, bytes, int], None],
        wanted: Callable[[str], bool] | None = None,
        steady: Callable[[], int] | None = None,
    ) -> None:
        self._filter = make_filter(settings.filter_name, **settings.parameters)
        role = graph.role_of(graph.GraphOptions(filter_name=settings.filter_name, filter_input=settings.input))
        self.by_sensor = role.input == graph.SENSORS_INPUT
        self.alignment: SensorAlignment | None = None
        if self.by_sensor:
            self.alignment = SensorAlignment(settings.sensors, settings.reference or None, settings.world)
        self._steady = steady
        self._ordering = Ordering(settings.sensors, settings.order_wait)
        self._model_filter = self._filter if isinstance(self._filter, ModelFilter) else None
        self.models = self._model_filter is not None
        self._subjects = {sensor: SubjectSelector() for sensor in settings.sensors}
        self._prediction = Prediction(settings.predict_after)
        self._lengths = LengthChanges()
        self._segments_topic = graph.segments_topic(settings.body)
        self._urdf_topic = graph.urdf_topic(settings.body)
        self._body = settings.body
        self._publish = publish
        self._wanted = wanted if wanted is not None else lambda topic: True
        self._predicted = 0
        self._received = dict.fromkeys(settings.sensors, 0)

    @property
    def counters(self) -> dict[str, int]:
        """What happened since the construction."""
        counters = dict(self._filter.counters)
        if self.alignment is not None:
            counters |= {f"frames of {sensor}": count for sensor, count in self._received.items()}
            counters |= {f"alignment {name}": count for name, count in self.alignment.counters.items()}
            counters |= {f"waited {name}": count for name, count in self._ordering.counters.items()}
        if self._model_filter is not None:
            counters["predicted frames"] = self._predicted
        return counters

    def set_pose(self, pose: SensorPose) -> None:
        """A sensor's pose, in force from its time on."""
        if self.alignment is not None:
            self.alignment.set_pose(pose)

    def set_clock(self, sensor: str, valid_from_ns: int, clock: ClockModel) -> None:
        """A sensor's clock, in force from a reference time on."""
        if self.alignment is not None:
            self.alignment.set_clock(sensor, valid_from_ns, clock)

    def on_fused(self, skeleton: Skeleton, now_ns: int) -> None:
        """One fused frame.

        Args:
            skeleton: in world.
            now_ns: when it arrived, in a clock that goes on.
        """
        self.poll(now_ns)
        if self._model_filter is not None:
            self._take([("", skeleton)], now_ns)
        elif (filtered := self._filter.update(skeleton)) is not None:
            self._publish(graph.FILTERED, encode_skeletons([filtered]), filtered.stamp_ns)

    def on_sensor(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """One frame of one sensor.

        Args:
            sensor: its name.
            skeletons: the bodies in it, in the sensor's own frame and clock.
            now_ns: as above.
        """
        aligned = self._aligned(sensor, skeletons)
        if aligned is not None:
            self.poll(now_ns)
            self._take(self._ordering.push(sensor, aligned, self._waiting_ns(now_ns)), now_ns)

    def hold(self, sensor: str, skeletons: Sequence[Skeleton], now_ns: int) -> None:
        """The same for one of several frames that are here: the next :meth:`poll` takes them together, in their order.

        Args:
            sensor: as above.
            skeletons: as above.
            now_ns: as above.
        """
        aligned = self._aligned(sensor, skeletons)
        if aligned is not None:
            self._ordering.hold(sensor, aligned, self._waiting_ns(now_ns))

    def _aligned(self, sensor: str, skeletons: Sequence[Skeleton]) -> Skeleton | None:
        """The person in ``world``; None where the sensor is not calibrated, or shows nobody."""
        self._received[sensor] += 1
        subject = self._subjects[sensor].pick(skeletons)
        return None if subject is None or self.alignment is None else self.alignment.push(sensor, subject)

    def _waiting_ns(self, now_ns: int) -> int:
        """The time in the clock by which frames wait."""
        return now_ns if self._steady is None else self._steady()

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
        if self._steady is not None:
            self._take(self._ordering.poll(self._steady()), now_ns)
        else:
            # each when it need not wait longer, whenever somebody asks: else what is predicted would depend on that
            while (deadline_ns := self._ordering.deadline_ns) is not None and deadline_ns <= now_ns:
                self._take(self._ordering.poll(deadline_ns), deadline_ns)
        # what waits is of a time that must not be told before
        while self.deadline_ns is None and (stamp_ns := self._prediction.due(now_ns)) is not None:
            predicted = self._model_filter.predict(stamp_ns)
            if predicted is None:
                self._prediction.stop()
                return
            self._predicted += 1
            self._send(*predicted)

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

    def sensor_jumped_back(self, sensor: str) -> None:
        """Forget who was picked of a sensor; the alignment finds out by itself."""
        self._subjects[sensor].reset()

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
                self._publish(self._urdf_topic, encode_string(text), estimate.stamp_ns)

    def _send(self, skeleton: Skeleton | None, estimate: ModelEstimate) -> None:
        """Publish an estimate, and the skeleton that belongs to it; None for the filter's own."""
        assert self._model_filter is not None
        model, stamp_ns = self._model_filter.model, estimate.stamp_ns
        if self._wanted(graph.FILTERED):
            skeleton = skeleton or self._model_filter.filtered
            assert skeleton is not None
            self._publish(graph.FILTERED, encode_skeletons([skeleton]), stamp_ns)
        state_wanted, stddev_wanted = self._wanted(graph.MODEL_STATE), self._wanted(graph.MODEL_STATE_STDDEV)
        if state_wanted or stddev_wanted:
            state, stddev = encode_model_state(estimate, model)
            if state_wanted:
                self._publish(graph.MODEL_STATE, state, stamp_ns)
            if stddev_wanted:
                self._publish(graph.MODEL_STATE_STDDEV, stddev, stamp_ns)
        if self._wanted(graph.MODEL_COVARIANCE):
            self._publish(graph.MODEL_COVARIANCE, encode_covariance(estimate), stamp_ns)
        if self._wanted(self._segments_topic):
            placed = segment_poses(estimate, model)
            self._publish(self._segments_topic, encode_segments(estimate, model.segment_names, *placed), stamp_ns)
