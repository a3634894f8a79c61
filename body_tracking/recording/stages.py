"""The graph offline in two stages that only messages connect: what sees sensors, and what writes results.

The second stage runs in a process of its own where the system can fork, because each takes about half of the time; the
messages, their order and the numbers are the same either way.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from body_tracking import graph
from body_tracking.calibration.online import CalibrationParameters, CalibrationUpdate, OnlineCalibration
from body_tracking.calibration.storage import load
from body_tracking.cdr import (
    decode_covariance,
    decode_model_state,
    decode_skeletons,
    encode_angles,
    encode_skeletons,
)
from body_tracking.filtering import (
    DEFAULT_ORDER_WAIT,
    DEFAULT_PREDICT_AFTER,
    FilterSettings,
    angle_streams,
    by_person,
    make_stage,
    orientation_topics,
)
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.fusion.fusion import FusionParameters
from body_tracking.fusion.people import PeopleParameters
from body_tracking.fusion.people_fusion import PeopleFusion
from body_tracking.fusion.subject import ALL, HeldSubject, SubjectSelector
from body_tracking.imu_tracking import ImuSettings, ImuStage
from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.tracking import state_estimate
from body_tracking.messages.base import (
    IMU,
    JOINT_STATE,
    MAGNETIC_FIELD,
    POINT_CLOUD,
    SEGMENTS,
    STRING,
    TIME_REFERENCE,
    TRANSFORM,
)
from body_tracking.messages.calibration import (
    clock_to_time_reference,
    pose_to_transform,
    time_reference_to_clock,
    transform_to_pose,
)
from body_tracking.messages.imus import message_to_orientation, orientation_to_message
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.qos import LATCHED, RELIABLE, SENSOR_DATA, Qos
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagError, BagWriter, deserialize, remove_file, serialize
from body_tracking.skeleton import NANOSECONDS, Skeleton

JUMP_BACK_NS = NANOSECONDS
"""A stamp of a sensor further behind the one before than this is a backward jump of time."""

_BATCH = 128
"""Messages that go through the pipe at once: each trip costs as much as several of them."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """What the offline graph is to do; defaults as the nodes'.

    Attributes:
        sensors: the first is the reference unless ``reference`` says otherwise.
        reference: or empty.
        filter_name: one of the filters.
        filter_input: what it filters; ``graph.AUTO`` for what is its own.
        predict_after: seconds without a frame after which predicted ones are made.
        order_wait: seconds that a sensor's frame waits at most for another's older one, where the filter takes these.
        convention: of the joint angles; ``graph.AUTO`` for the filter's own.
        angles_input: what they are made of; ``graph.AUTO`` for what is the filter's own.
        body: the id in topics and names of angles, of one subject.
        calibration: parameters of the calibration.
        fusion: parameters of the fusion.
        filter_parameters: parameters of the filter.
        calibration_file: start from this calibration; None for none.
        imus: inertial sensors, if there are any.
        orientations: segments whose orientations by these the filter takes.
        people: whom to track.
        model_covariance: write the covariance of the filter's model, too.
    """

    sensors: tuple[str, ...]
    reference: str = ""
    filter_name: str = DEFAULT_FILTER
    filter_input: str = graph.AUTO
    predict_after: float = DEFAULT_PREDICT_AFTER
    order_wait: float = DEFAULT_ORDER_WAIT
    convention: str = graph.AUTO
    angles_input: str = graph.AUTO
    body: str = graph.DEFAULT_BODY
    calibration: CalibrationParameters = field(default_factory=CalibrationParameters)
    fusion: FusionParameters = field(default_factory=FusionParameters)
    filter_parameters: Mapping[str, Any] = field(default_factory=dict)
    calibration_file: Path | None = None
    imus: ImuSettings | None = None
    orientations: tuple[str, ...] = ()
    people: PeopleParameters = field(default_factory=PeopleParameters)
    model_covariance: bool = False

    def role(self) -> graph.FilterRole:
        """What the filter is to do.

        Raises:
            GraphError: it cannot.
        """
        return graph.role_of(
            graph.GraphOptions(
                filter_name=self.filter_name,
                filter_input=self.filter_input,
                convention=self.convention,
                angles_input=self.angles_input,
            )
        )

    def filter_settings(self) -> FilterSettings:
        """Those of the filter's stage."""
        return FilterSettings(
            self.filter_name,
            self.filter_parameters,
            self.filter_input,
            self.sensors,
            self.reference,
            body=self.body,
            predict_after=self.predict_after,
            order_wait=self.order_wait,
            people=self.people,
        )


class Sink(Protocol):
    """Where a stage's messages go."""

    def take(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        """One serialised message."""


class Upstream:
    """Calibration, fusion and inertial sensors, connected by their messages.

    Args:
        settings: what to run.

    Attributes:
        sink: gets every message that they publish; to be set before the first call.

    Raises:
        CalibrationError: the calibration file cannot be used, or the reference is not among the sensors.
    """

    sink: Sink

    def __init__(self, settings: ReplaySettings) -> None:
        reference = settings.reference or None
        self.calibration = OnlineCalibration(settings.sensors, settings.calibration, reference)
        if settings.calibration_file is not None:
            self.calibration.load(load(settings.calibration_file))
        self.fusion = PeopleFusion(settings.sensors, settings.fusion, settings.people, reference)
        self.imus = None if settings.imus is None else ImuStage(settings.imus)
        self._reference = reference or settings.sensors[0]
        self._subjects = {sensor: SubjectSelector() for sensor in settings.sensors}
        self._last_ns: dict[str, int] = {}
        several = settings.people.subject == ALL
        self._wearer = HeldSubject(settings.people.hold) if several else SubjectSelector()

    def start(self, log_time_ns: int) -> None:
        """What is known before the first frame."""
        self._calibrated(self.calibration.current_update(), log_time_ns)

    def push(self, sensor: str, skeletons: Sequence[Skeleton], log_time_ns: int) -> None:
        """One frame of one sensor, with all bodies in it."""
        stamp_ns = skeletons[0].stamp_ns
        if self.imus is not None and sensor == self._reference:
            self.imus.on_frame(stamp_ns, log_time_ns)
        if stamp_ns < self._last_ns.get(sensor, stamp_ns) - JUMP_BACK_NS:
            self._subjects[sensor].reset()
        self._last_ns[sensor] = stamp_ns
        subject = self._subjects[sensor].pick(skeletons)
        if subject is None:
            return
        for update in self.calibration.push(sensor, subject, log_time_ns):
            self._calibrated(update, log_time_ns)
        for fused in self.fusion.push(sensor, skeletons, log_time_ns):
            self._fused(fused, log_time_ns)

    def feel(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        """One message of an inertial sensor.

        Raises:
            BodyTrackingError: it is of no use.
        """
        assert self.imus is not None
        if topic in self.imus.mag:
            self.imus.on_field(topic, deserialize(MAGNETIC_FIELD, cdr))
            return
        told = self.imus.on_imu(topic, deserialize(IMU, cdr), log_time_ns)
        if told.orientation is not None:
            message = serialize(orientation_to_message(told.orientation, BAG_MESSAGES))
            self.sink.take(graph.orientation_topic(told.orientation.segment), message, log_time_ns)
        if told.skeleton is not None:
            self.sink.take(graph.IMU_SKELETON, encode_skeletons([told.skeleton]), log_time_ns)

    def finish(self, log_time_ns: int) -> None:
        """What still waits for a frame that does not come."""
        while self.fusion.deadline_ns is not None:
            for fused in self.fusion.poll(self.fusion.deadline_ns):
                self._fused(fused, log_time_ns)

    def _fused(self, fused: tuple[Skeleton, ...], log_time_ns: int) -> None:
        cdr = encode_skeletons(fused)
        self.sink.take(graph.FUSED, cdr, log_time_ns)
        if self.imus is not None and (wearer := self._wearer.pick(_decoded(cdr))) is not None:
            self.imus.on_skeleton(wearer, log_time_ns)

    def _calibrated(self, update: CalibrationUpdate, log_time_ns: int) -> None:
        result = update.result
        for sensor, clock in result.clocks.items():
            if sensor != result.reference:
                reference = clock_to_time_reference(sensor, clock, update.valid_from_ns, BAG_MESSAGES)
                self.sink.take(graph.CALIBRATION_CLOCK, serialize(reference), log_time_ns)
                self.fusion.set_clock(*time_reference_to_clock(reference))
        for pose in result.poses.values():
            transform = pose_to_transform(pose, self.fusion.world, BAG_MESSAGES)
            self.sink.take(graph.CALIBRATION, serialize(transform), log_time_ns)
            self.fusion.set_pose(transform_to_pose(transform))


@dataclass(frozen=True, slots=True)
class Written:
    """What the second stage did.

    Attributes:
        frames: joint angle messages.
        counters: of the filter.
    """

    frames: int
    counters: Mapping[str, int]


class FilterAndAngles:
    """The filter and the joint angles, connected by their messages, as in the live graph: what is published is what
    was sent, in single precision where messages have no more.

    Args:
        settings: what to run.
        publish: gets the topic and the content of every message that the two publish.

    Attributes:
        frames: joint angle messages so far.

    Raises:
        FilterError: the filter or its parameters make no sense.
        GraphError: the filter cannot do what it was asked for.
    """

    def __init__(self, settings: ReplaySettings, publish: Callable[[str, bytes], None]) -> None:
        role = settings.role()
        self.frames = 0
        self._filter = make_stage(settings.filter_settings(), self._filtered)
        self._angles = angle_streams(role.convention, settings.body, settings.people)
        self._several = settings.people.subject == ALL
        self._of_model = role.angles_input == graph.MODEL_INPUT
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in settings.sensors}
        self._orientations = orientation_topics(settings.orientations)
        # of each person, state and covariance
        models = {body: graph.model_topics(body, self._several) for body in self._angles}
        self._bodies_of_states = {topics.state: body for body, topics in models.items()}
        self._bodies_of_covariances = {topics.covariance: body for body, topics in models.items()}
        self._model_states: dict[str, bytes] = {}
        self._publish = publish

    @property
    def published(self) -> dict[str, tuple[str, Qos]]:
        """Topics with their types and QoS."""
        topics = {topic: (kind, _QOS.get(kind, SENSOR_DATA)) for topic, kind in self._filter.topics.items()}
        for body in self._angles:
            topics[graph.joint_states_topic(body)] = JOINT_STATE, RELIABLE
            topics[graph.joint_states_stddev_topic(body)] = JOINT_STATE, RELIABLE
        return topics

    @property
    def counters(self) -> dict[str, int]:
        """Of the filter."""
        return self._filter.counters

    def take(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        """One message of what comes before; others than those it needs are ignored."""
        if not self._filter.by_sensor:
            if topic == graph.FUSED:
                self._filter.on_fused(_decoded(cdr), log_time_ns)
        elif topic in self._sensors:
            self._filter.on_sensor(self._sensors[topic], _decoded(cdr), log_time_ns)
        elif topic in self._orientations:
            measurement = message_to_orientation(deserialize(IMU, cdr), self._orientations[topic])
            self._filter.on_orientation(measurement, log_time_ns)
        elif topic == graph.CALIBRATION_CLOCK:
            self._filter.set_clock(*time_reference_to_clock(deserialize(TIME_REFERENCE, cdr)))
        elif topic == graph.CALIBRATION:
            self._filter.set_pose(transform_to_pose(deserialize(TRANSFORM, cdr)))

    def finish(self) -> None:
        """What still waits for a frame that does not come."""
        while (deadline_ns := self._filter.deadline_ns) is not None:
            self._filter.poll(deadline_ns)

    def _filtered(self, topic: str, cdr: bytes, stamp_ns: int) -> None:
        """What the filter publishes."""
        self._publish(topic, cdr)
        if topic == graph.FILTERED:
            if not self._of_model:
                self._arrived(_decoded(cdr))
        elif topic in self._bodies_of_states:
            self._model_states[self._bodies_of_states[topic]] = cdr
        elif self._of_model and topic in self._bodies_of_covariances:
            body = self._bodies_of_covariances[topic]
            angles = self._angles[body]
            state = decode_model_state(self._model_states[body], angles.model)
            covariance = decode_covariance(cdr, angles.model)
            assert state is not None
            assert covariance is not None
            _, frame_id, q, velocity = state
            estimate = state_estimate(angles.model, stamp_ns, frame_id, q, velocity, covariance[1])
            self._tell(body, angles.of_estimate(estimate))

    def _arrived(self, skeletons: tuple[Skeleton, ...]) -> None:
        for body, skeleton in by_person(skeletons, self._angles, several=self._several):
            self._tell(body, self._angles[body].of_skeleton(skeleton))

    def _tell(self, body: str, angles: JointAngles | None) -> None:
        if angles is not None:
            states, stddevs = encode_angles(angles, body, self._angles[body].convention)
            self._publish(graph.joint_states_topic(body), states)
            self._publish(graph.joint_states_stddev_topic(body), stddevs)
            self.frames += 1


_QOS: Mapping[str, Qos] = {SEGMENTS: RELIABLE, STRING: graph.URDF_QOS}
"""Of what the filter publishes, by type; all else is sensor data."""


class Downstream:
    """Writes every message, filters what the filter takes, and turns that to angles.

    Args:
        settings: what to run.
        out: the bag to be made.
        topics: type and QoS of further topics that will be written.
        overwrite: replace ``out`` if it is there.

    Raises:
        BagError: ``out`` cannot be written.
        FilterError: the filter or its parameters make no sense.
        GraphError: the filter cannot do what it was asked for.
    """

    def __init__(
        self, settings: ReplaySettings, out: Path, topics: Mapping[str, tuple[str, Qos]], *, overwrite: bool
    ) -> None:
        self._rest = FilterAndAngles(settings, self._write)
        self._now_ns = 0
        self._covariance = settings.model_covariance
        self._writer = BagWriter(out, overwrite=overwrite)
        published = {
            graph.CALIBRATION: (TRANSFORM, LATCHED),
            graph.CALIBRATION_CLOCK: (TIME_REFERENCE, LATCHED),
            graph.FUSED: (POINT_CLOUD, SENSOR_DATA),
            **self._rest.published,
        }
        if settings.imus is not None:
            published[graph.IMU_SKELETON] = POINT_CLOUD, SENSOR_DATA
            for each in graph.imu_topics(settings.imus.segments):
                published[graph.orientation_topic(each.segment)] = IMU, SENSOR_DATA
        for topic, (type_name, qos) in {**topics, **published}.items():
            if self._written(topic):
                self._writer.add_topic(topic, type_name, qos)

    def take(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        """One serialised message."""
        self._writer.write(topic, cdr, log_time_ns)
        self._now_ns = log_time_ns
        self._rest.take(topic, cdr, log_time_ns)

    def _written(self, topic: str) -> bool:
        return self._covariance or not graph.is_model_covariance(topic)

    def _write(self, topic: str, cdr: bytes) -> None:
        if self._written(topic):
            self._writer.write(topic, cdr, self._now_ns)

    def finish(self) -> Written:
        """Close the bag; one without angles is removed again."""
        self._rest.finish()
        if self._rest.frames:
            self._writer.close()
        else:
            self._writer.discard()
        return Written(self._rest.frames, dict(self._rest.counters))

    @property
    def path(self) -> Path:
        """The file that is written."""
        return self._writer.path

    def abandon(self) -> None:
        """Remove the unfinished bag."""
        self._writer.discard()


def _decoded(cdr: bytes) -> tuple[Skeleton, ...]:
    return decode_skeletons(cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, cdr))


class ForkedDownstream:
    """:class:`Downstream` in a process of its own; same arguments, same errors."""

    def __init__(
        self, settings: ReplaySettings, out: Path, topics: Mapping[str, tuple[str, Qos]], *, overwrite: bool
    ) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        # What a process that is killed at once leaves of a bag that was not there before.
        self._path = None if out.exists() else out.absolute() / f"{out.absolute().name}_0.mcap"
        arguments = (self._connection, theirs, settings, out, topics, overwrite)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._batch: list[tuple[str, bytes, int]] = []
        with warnings.catch_warnings():
            # Python 3.12 warns of forking with threads; those of the numeric libraries are prepared for it.
            warnings.simplefilter("ignore", DeprecationWarning)
            collects = gc.isenabled()
            gc.disable()  # until the other process has set aside what it inherits
            try:
                self._process.start()
            finally:
                if collects:
                    gc.enable()
        theirs.close()
        self._path = self._receive()

    def take(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        """One serialised message."""
        self._batch.append((topic, cdr, log_time_ns))
        if len(self._batch) >= _BATCH:
            self._send()

    def finish(self) -> Written:
        """Close the bag; one without angles is removed again."""
        self._send()
        self._connection.send(None)
        written = self._receive()
        self._process.join()
        assert isinstance(written, Written)
        return written

    def abandon(self) -> None:
        """Remove the unfinished bag."""
        self._connection.close()
        self._process.join()
        if self._path is not None:
            remove_file(self._path)  # still there where the other process was killed

    def _send(self) -> None:
        try:
            self._connection.send(self._batch)
        except (BrokenPipeError, ConnectionResetError):
            self._receive()  # raises why
        self._batch = []

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, ConnectionResetError):  # the latter where it left something unread
            self.abandon()
            raise BagError(f"the process that writes the bag ended with code {self._process.exitcode}") from None
        if isinstance(answer, BaseException):
            self._process.join()
            raise answer
        return answer


def _serve(
    theirs: Connection,
    connection: Connection,
    settings: ReplaySettings,
    out: Path,
    topics: Mapping[str, tuple[str, Qos]],
    overwrite: bool,
) -> None:
    """The other process."""
    # While a copy of the first process's end is open here, its closing would not be seen.
    theirs.close()
    # Garbage of the first process is not this one's to take down. ROS nodes among it have threads that are not here,
    # and end in a crash.
    gc.freeze()
    gc.enable()
    stage: Downstream | None = None
    try:
        stage = Downstream(settings, out, topics, overwrite=overwrite)
        connection.send(stage.path)
        while (batch := connection.recv()) is not None:
            for topic, cdr, log_time_ns in batch:
                stage.take(topic, cdr, log_time_ns)
        connection.send(stage.finish())
    except (EOFError, KeyboardInterrupt):
        if stage is not None:
            stage.abandon()
    except BaseException as error:
        if stage is not None:
            stage.abandon()
        connection.send(error)


def start_downstream(
    settings: ReplaySettings, out: Path, topics: Mapping[str, tuple[str, Qos]], *, overwrite: bool
) -> Downstream | ForkedDownstream:
    """The second stage, beside this process where that is possible and there are processors for both.

    Raises:
        BagError: ``out`` cannot be written.
        FilterError: the filter or its parameters make no sense.
        GraphError: the filter cannot do what it was asked for.
    """
    if hasattr(os, "fork") and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1:
        return ForkedDownstream(settings, out, topics, overwrite=overwrite)
    return Downstream(settings, out, topics, overwrite=overwrite)
