"""What the node ``imu_skeleton`` does, without ROS: messages of inertial sensors and skeletons in, messages out.

The node and the offline replay run this same class, so that they publish the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from body_tracking import graph
from body_tracking.errors import BodyTrackingError
from body_tracking.fusion.fusion import WORLD
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.inertial.tracking import InertialTracker, Told
from body_tracking.messages.imus import message_to_magnetic_field, message_to_sample
from body_tracking.parameters import Parameter, parameters_from
from body_tracking.skeleton import NANOSECONDS, FloatArray, Skeleton

SEGMENTS = Parameter(
    "segments",
    (),
    "segments with an inertial sensor, each as SEGMENT (topics /SEGMENT/imu/data, data_raw and mag), SEGMENT:NAME (the "
    "same of another name) or SEGMENT:/TOPIC",
)
MOUNTINGS = Parameter(
    "mountings",
    (),
    "SEGMENT:AXES of sensors that are not put on as usual: where their x and z point on the hanging arm or the upright "
    "trunk of somebody who looks along x with y to the left, as in forearm_left:-z+y",
)
IMU_PARAMETERS: Final = (SEGMENTS, MOUNTINGS, *parameters_from(TrackingParameters))
_FIELD_NS = NANOSECONDS // 20
"""A magnetic field goes with a reading no further away than this."""


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """What to track, and how; defaults as the node's.

    Attributes:
        segments: see :data:`SEGMENTS`.
        mountings: see :data:`MOUNTINGS`.
        parameters: of the tracker.
        world: the frame of the output.
    """

    segments: Sequence[str] = ()
    mountings: Sequence[str] = ()
    parameters: TrackingParameters = field(default_factory=TrackingParameters)
    world: str = WORLD


class ImuStage:
    """Feeds a tracker.

    Args:
        settings: which one.

    Attributes:
        tracker: what is fed.
        sensors: the topics of each.
        imu: segment by topic of ``sensor_msgs/Imu``.
        mag: segment by topic of ``sensor_msgs/MagneticField``.
        refused: how many messages of each segment could not be used.

    Raises:
        GraphError: a list of segments that is none.
        InertialTrackingError: no segments, or unknown ones.
        MountingError: a mounting that is none.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self.sensors = graph.imu_topics(settings.segments)
        names = tuple(each.segment for each in self.sensors)
        self.tracker = InertialTracker(names, settings.parameters, settings.mountings, settings.world)
        self.imu = {topic: each.segment for each in self.sensors for topic in each.imu}
        self.mag = {each.mag: each.segment for each in self.sensors}
        self.refused: Counter[str] = Counter()
        self._fields: dict[str, tuple[int, FloatArray]] = {}

    def on_imu(self, topic: str, message: Any, received_ns: int, *, skeleton: bool = True) -> Told:
        """One ``sensor_msgs/Imu``.

        Args:
            topic: on which it came.
            message: of a ROS install or of a recording.
            received_ns: when.
            skeleton: tell the whole body when it is due.

        Raises:
            BodyTrackingError: it is of no use; counted.
        """
        segment = self.imu[topic]
        try:
            sample = message_to_sample(message, self._field_at(segment, message))
            return self.tracker.add(segment, sample, received_ns, skeleton=skeleton)
        except BodyTrackingError:
            self.refused[f"refused of {segment}"] += 1
            raise

    def on_field(self, topic: str, message: Any) -> None:
        """One ``sensor_msgs/MagneticField``, which goes with the next reading of its sensor.

        Raises:
            ImuSampleError: no field; counted.
        """
        segment = self.mag[topic]
        try:
            stamp_ns, _, vector = message_to_magnetic_field(message)
        except BodyTrackingError:
            self.refused[f"refused fields of {segment}"] += 1
            raise
        self._fields[segment] = stamp_ns, vector

    def on_frame(self, stamp_ns: int, received_ns: int) -> None:
        """When a frame of the reference sensor came."""
        self.tracker.hear(stamp_ns, received_ns)

    def on_skeleton(self, skeleton: Skeleton, received_ns: int) -> None:
        """One fused skeleton."""
        self.tracker.see(skeleton, received_ns)

    def _field_at(self, segment: str, message: Any) -> FloatArray | None:
        """The latest field, once, if it is of about the same time."""
        stamp_ns, vector = self._fields.pop(segment, (0, None))
        if vector is None:
            return None
        stamp = message.header.stamp
        apart = stamp.sec * NANOSECONDS + stamp.nanosec - stamp_ns
        return vector if abs(apart) < _FIELD_NS else None

    def state(self, now_ns: int) -> tuple[int, str, dict[str, object]]:
        """Level, line and values for diagnostics."""
        problems = self.tracker.problems(now_ns)
        values: dict[str, object] = {f"problem {number}": line for number, line in enumerate(problems, start=1)}
        values |= self.tracker.counters
        values |= self.refused
        values |= self.tracker.state()
        return (1 if problems else 0), "; ".join(problems), values
