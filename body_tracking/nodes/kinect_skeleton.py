"""One sensor's skeletons, from a live backend or a recording, to ``/<sensor>/skeleton``."""

from __future__ import annotations

import re
import threading
import traceback
from dataclasses import replace
from functools import partial
from typing import Any

from sensor_msgs.msg import PointCloud2

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import Parameter, fields_of, parameters_from
from body_tracking.core.sources import RecordedFrame, check_sensor_name
from body_tracking.kinect.live import SourceSettings, backends, described, open_source
from body_tracking.kinect.ros_time import RosTime
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE, skeleton_qos
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import GraphNode

_PROBLEM_PERIOD_S = 30.0

_SENSOR, *_SETTINGS = parameters_from(SourceSettings)
_BACKEND = Parameter("backend", "recording", "where skeletons come from", choices=backends())
PARAMETERS = (_SENSOR, _BACKEND, *_SETTINGS, RELIABLE)


class KinectSkeleton(GraphNode):
    """Publishes the frames of a sensor or a recording."""

    NAME = "kinect_skeleton"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
        """Open the source, and start the thread that reads its frames."""
        given: dict[str, Any] = dict(self.values)
        self.failure = self.problem = ""
        self.source_errors: dict[str, str] = {}
        sensor = check_sensor_name(given["sensor"])
        settings = SourceSettings(**fields_of(SourceSettings, given))
        self.ros_time = RosTime()
        self.source = open_source(given["backend"], settings)
        qos = to_profile(skeleton_qos(self.values))
        self.output = self.make_publisher(PointCloud2, graph.skeleton_topic(sensor), qos)
        self.thread = threading.Thread(target=self.publish_frames, daemon=True)
        self.thread.start()

    def publish_frames(self) -> None:
        """Publish until the source or the node ends. If the source fails, the node stays and reports the error."""
        publish = self.guarded("frames", self.publish_frame)
        try:
            while self.context.ok() and not self.source.ended:
                frame = self.source.read(timeout=0.2)
                if frame is not None:
                    publish(frame)
        except Exception as error:  # the library of a sensor may raise anything
            if self.context.ok():  # otherwise the source was closed during the read
                self.failed(error)

    def publish_frame(self, frame: RecordedFrame) -> None:
        """Publish one frame, stamped in ROS time."""
        skeletons = frame.skeletons
        stamp_ns = self.ros_time.stamp(skeletons[0].stamp_ns, frame.received_ns)
        if stamp_ns != skeletons[0].stamp_ns:
            skeletons = tuple(replace(each, stamp_ns=stamp_ns) for each in skeletons)
        message = encode_skeletons(skeletons)
        if not self.is_stale(self.output.topic_name, stamp_ns):
            self.send(self.output, message, stamp_ns)

    def failed(self, error: Exception) -> None:
        """Log an error of the source, with a traceback unless it is one of ours; call it in the except clause."""
        failure = described(error)
        self.get_logger().error(failure)
        if not isinstance(error, BodyTrackingError):
            self.get_logger().error(traceback.format_exc())
        self.failure = failure

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Streaming, ended, failed, or the problem of the source."""
        problem = self.source_value("problem", "")
        if problem:
            kind = re.sub(r" \(from .*\)|[\d.]+", "", problem)  # a problem of another kind is logged at once
            self.log_throttled(kind, problem, _PROBLEM_PERIOD_S)
        elif self.problem and not self.failure:
            self.get_logger().info("frames arrive")
        self.problem = problem
        text = self.failure or problem or ("ended" if self.source_value("ended", False) else "streaming")
        counters = dict(self.source_value("counters", {}))
        return (
            (2 if self.failure else 1 if problem or self.source_errors else 0),
            "; ".join([text, *self.source_errors.values()]),
            counters,
        )

    def source_value(self, name: str, otherwise: Any) -> Any:
        """A property of the source; if it raises, the default, and the diagnostics report the error."""
        self.source_errors.pop(name, None)
        try:
            return getattr(self.source, name)
        except Exception as error:
            self.source_errors[name] = f"{name}: {described(error)}"
            self.log_throttled(name, f"{self.source_errors[name]}\n{traceback.format_exc()}", _PROBLEM_PERIOD_S)
            return otherwise

    def close(self) -> None:
        try:
            self.source.close()
        except Exception as error:
            self.failed(error)
        self.thread.join(timeout=1.0)


main = partial(run, KinectSkeleton)
