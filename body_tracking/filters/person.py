"""The filter of one person: sensors' frames in their order, predicted frames in a silence, smoothing, lengths."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from body_tracking.calibration.kinect_spine import corrected_kinect
from body_tracking.core.clocks import jumped_back
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.qos import Qos
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.filters import THESIS_FILTERS, LearningFilter, ModelFilter, SkeletonFilter
from body_tracking.filters.prediction import Prediction
from body_tracking.filters.smoothing import FixedLag, SmoothableFilter
from body_tracking.fusion.alignment import SensorAlignment
from body_tracking.fusion.ordering import Ordering
from body_tracking.kinematics.codecs import Segments
from body_tracking.kinematics.lengths import LengthChanges
from body_tracking.messages.codecs import (
    ModelCovariance,
    ModelState,
    ModelStddev,
    Skeletons,
    Text,
)
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import HOLD
from body_tracking.pipeline.shared import names_in, sensors_of
from body_tracking.pipeline.stage import Port

AWAY_NS = round(HOLD * NANOSECONDS)
"""Nanoseconds without a frame or an orientation after which the next ones may be of another person."""


class PersonFilter:
    """Feeds the filter of one person and publishes its output.

    Args:
        estimator: the filter.
        values: of the parameters of the stage ``skeleton_filter``.
        body: the person's id in topics.
        publish: called with topic, payload and capture time.
        wanted: whether a topic has a subscriber.
        by_sensor: whether it takes sensors' frames instead of fused ones.
        several: whether this is one of several people, whose ids are in the topics of their models.

    Attributes:
        alignment: from sensors to world; None for fused frames, or without sensors.
        tracked: whether a fused frame has come since the start or the last jump of time.

    Raises:
        GraphError: the filter cannot smooth, and ``lag`` is given.
        FusionError: the reference is not among the sensors.
    """

    def __init__(
        self,
        estimator: SkeletonFilter,
        values: Mapping[str, Any],
        body: str,
        publish: Callable[[str, Any, int], None],
        wanted: Callable[[str], bool],
        *,
        by_sensor: bool,
        several: bool,
    ) -> None:
        self._filter = estimator
        name, sensors = str(values["filter"]), sensors_of(values)
        self._name = name
        self.alignment: SensorAlignment | None = None
        if by_sensor and sensors:
            self.alignment = SensorAlignment(sensors, values["reference"] or None, values["world_frame"])
        corrects = values["kinect_v2"] and name not in THESIS_FILTERS
        self._kinects = set(sensors) - set(names_in(values["not_kinects"])) if corrects else set()
        self._corrects_fused = corrects and (bool(self._kinects) or not sensors)
        self._ordering = Ordering(sensors, values["order_wait"])
        self._model_filter = estimator if isinstance(estimator, ModelFilter) else None
        self._lag = self._lag_of(values["lag"])
        self._prediction = Prediction(values["predict_after"])
        self._lengths = LengthChanges()
        self._topics = graph.model_topics(body, several)
        self._body = body
        self._publish = publish
        self._wanted = wanted
        self._predicted = 0
        self._overtaken = 0
        self._published_ns: int | None = None
        self._seen_ns: int | None = None
        self.tracked = False

    def _lag_of(self, seconds: float) -> FixedLag | None:
        if not seconds:
            return None
        if not isinstance(self._filter, SmoothableFilter):
            raise graph.GraphError(f"filter {self._name} cannot smooth (lag, --smooth)")
        return FixedLag(self._filter, seconds)

    def change(self, values: Mapping[str, Any]) -> None:
        """Use other values of ``order_wait``, ``predict_after`` and ``lag``; frames that are held back are published.

        Raises:
            GraphError: the filter cannot smooth; nothing is changed.
        """
        lag = self._lag_of(values["lag"])
        self.flush()
        self._lag = lag
        self._ordering.set_wait(values["order_wait"])
        self._prediction.set_after(values["predict_after"])

    @property
    def counters(self) -> dict[str, int]:
        counters = dict(self._filter.counters)
        if self.alignment is not None:
            counters |= {f"alignment {name}": count for name, count in self.alignment.counters.items()}
            counters |= {f"waited {name}": count for name, count in self._ordering.counters.items()}
        if self._model_filter is not None:
            counters["predicted frames"] = self._predicted
            counters["frames that count in the next estimate"] = self._overtaken
        return counters

    def outputs(self, skeletons: Qos, results: Qos) -> tuple[Port, ...]:
        """The published topics, with these qualities of service of skeletons and results."""
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

    def on_fused(self, skeleton: Skeleton, now_ns: int) -> None:
        """One fused frame.

        Args:
            skeleton: in world.
            now_ns: time of arrival, in a steady clock.
        """
        self.poll(now_ns)
        if self._corrects_fused:
            skeleton = corrected_kinect(skeleton)
        self.tracked = True
        if self._model_filter is not None:
            self._take([("", skeleton)], now_ns)
            return
        self._see(skeleton.stamp_ns)
        if (filtered := self._filter.update(skeleton)) is None:
            return
        elif self._lag is not None:
            self._hold_back(self._lag, filtered, now_ns)
        else:
            self._publish_skeleton(filtered)

    def hold(self, sensor: str, skeleton: Skeleton, now_ns: int) -> None:
        """Queue one frame of one sensor for the next :meth:`poll`, which filters frames in the order of their stamps.

        Args:
            sensor: its name.
            skeleton: the person, in the sensor's own frame and clock.
            now_ns: time of arrival, in a steady clock.
        """
        aligned = None if self.alignment is None else self.alignment.push(sensor, skeleton)
        if aligned is not None:  # else the sensor is not calibrated
            self._ordering.hold(sensor, corrected_kinect(aligned) if sensor in self._kinects else aligned, now_ns)

    def on_orientation(self, measurement: SegmentOrientation, now_ns: int) -> None:
        """Take the orientation of one segment, in ``world`` and in the reference's clock.

        The corrected estimate is published with the next frame, measured or predicted. Filters without a body model
        ignore it.
        """
        if self._model_filter is None:
            return
        self.poll(now_ns)
        self._see(measurement.stamp_ns)
        taken = self._model_filter.take_orientation(measurement)
        if taken and not self.newest_ns and self._prediction.due_ns is None:
            self._prediction.arrived(measurement.stamp_ns, now_ns)

    def poll(self, now_ns: int) -> None:
        """Take the frames that have waited long enough, and publish the predicted ones that are due."""
        self._poll_filter(now_ns)
        if self._lag is not None and self._lag.due_ns is not None and self._lag.due_ns <= now_ns:
            self.flush()

    def _poll_filter(self, now_ns: int) -> None:
        if self._model_filter is None:
            return
        # each at its own deadline: predictions must not depend on the times of the calls
        while (deadline_ns := self._ordering.deadline_ns) is not None and deadline_ns <= now_ns:
            self._take(self._ordering.poll(deadline_ns), deadline_ns)
        self._take(self._ordering.poll(now_ns), now_ns)
        # a waiting frame is older than a prediction, and goes first
        while self.deadline_ns is None and (stamp_ns := self._prediction.due(now_ns)) is not None:
            predicted = self._model_filter.predict(stamp_ns)
            if predicted is None:
                self._prediction.stop()
                return
            self._predicted += 1
            self._send(*predicted)

    def settle(self) -> None:
        """Do deferred work before the next frame; to be called when idle."""
        expected_ns = self._ordering.expected_ns
        if self._model_filter is not None and expected_ns is not None:
            self._model_filter.settle(expected_ns)

    @property
    def deadline_ns(self) -> int | None:
        """Time of the next :meth:`poll` for a waiting frame, in the clock of ``now_ns``; None without one."""
        deadlines = self._ordering.deadline_ns, None if self._lag is None else self._lag.due_ns
        return min((each for each in deadlines if each is not None), default=None)

    @property
    def due_ns(self) -> int | None:
        """Time of the next :meth:`poll` for a predicted frame; None if a frame waits, or without prediction."""
        return self._prediction.due_ns if self.deadline_ns is None else None

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest frame that is held back; 0 without one."""
        return 0 if self._lag is None else self._lag.newest_ns

    def passed(self, newest_ns: int) -> None:
        """Publish the held frames that are older by the lag than this stamp, of anyone's newest frame."""
        if self._lag is not None:
            self._release(self._lag.passed(newest_ns))

    def flush(self) -> None:
        """Publish all frames that are held back."""
        if self._lag is not None:
            self._release(self._lag.flush())

    def _hold_back(self, lag: FixedLag, filtered: Skeleton | None, now_ns: int) -> None:
        """Hold the last frame back, and publish the earlier ones that have been held for the lag."""
        assert isinstance(self._filter, SmoothableFilter)
        self._release(lag.take(self._filter.last_frame(filtered), now_ns))

    def _release(self, frames: Sequence[Any]) -> None:
        for frame in frames:
            assert isinstance(self._filter, SmoothableFilter)
            skeleton, estimate = self._filter.results_of(frame)
            if estimate is None:
                self._publish_skeleton(skeleton)
            else:
                self._send(skeleton, estimate)

    def _see(self, stamp_ns: int) -> None:
        """Note that the person was seen, by a camera or a worn sensor; after a longer absence it may be another one."""
        last_ns = self._seen_ns
        if last_ns is not None and stamp_ns - last_ns > AWAY_NS and isinstance(self._filter, LearningFilter):
            self.flush()
            self._filter.forget_joint_centres()
        if last_ns is None or stamp_ns > last_ns or jumped_back(stamp_ns, last_ns):
            self._seen_ns = stamp_ns

    def reset(self) -> None:
        """Publish the held frames, and forget the person, after a jump of time; poses and clocks stay."""
        self.flush()
        self._filter.reset()
        self._lengths.reset()
        self._ordering.flush()
        self._prediction.stop()
        self._published_ns = self._seen_ns = None
        self.tracked = False

    def forget(self) -> None:
        """Forget the person, because the next frames are of another one."""
        self.reset()
        if self.alignment is not None:
            self.alignment.forget()

    def _take(self, frames: Sequence[tuple[str, Skeleton]], now_ns: int) -> None:
        """Filter frames, and publish the estimate after each one that is the newest."""
        assert self._model_filter is not None
        for sensor, skeleton in frames:
            self._see(skeleton.stamp_ns)
            if not self._model_filter.take(skeleton, sensor):
                continue
            estimate = self._model_filter.estimate
            assert estimate is not None  # a frame was taken
            if self._lag is not None:
                self._prediction.stop()
                self._hold_back(self._lag, None, now_ns)
            else:
                self._prediction.arrived(skeleton.stamp_ns, now_ns)
                self._send(None, estimate)
            if self._lengths.due(estimate.stamp_ns, estimate.lengths):
                from body_tracking.kinematics.urdf import urdf

                text = urdf(self._model_filter.model, estimate.lengths, self._body)
                self._publish(self._topics.urdf, text, estimate.stamp_ns)

    def _publish_skeleton(self, skeleton: Skeleton) -> None:
        self._publish(graph.FILTERED, (skeleton,), skeleton.stamp_ns)

    def _send(self, skeleton: Skeleton | None, estimate: ModelEstimate) -> None:
        """Publish an estimate and its skeleton; None for the filter's current one.

        Stamps increase, as receivers of transforms need it: a frame that comes after an estimate of its time, or after
        a prediction of a later one, counts in the next estimate.
        """
        assert self._model_filter is not None
        last_ns = self._published_ns
        if last_ns is not None and estimate.stamp_ns <= last_ns and not jumped_back(estimate.stamp_ns, last_ns):
            self._overtaken += 1
            return
        self._published_ns = estimate.stamp_ns
        if self._wanted(graph.FILTERED):
            skeleton = skeleton or self._model_filter.filtered
            assert skeleton is not None
            self._publish_skeleton(skeleton)
        topics = self._topics
        for topic in (topics.state, topics.stddev, topics.covariance, topics.segments):
            if self._wanted(topic):
                self._publish(topic, estimate, estimate.stamp_ns)
