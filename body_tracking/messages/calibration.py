"""Poses and clocks of sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.message_types import TIME_REFERENCE, TRANSFORM
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import MAX_RANGE, MAX_STAMP_NS, NANOSECONDS
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds, to_time, to_transform


def pose_to_transform(pose: SensorPose, world: str, types: MessageTypes) -> Any:
    """``geometry_msgs/TransformStamped`` of a sensor's optical frame in ``world``; the stamp is ``valid_from_ns``."""
    return types.make(
        TRANSFORM,
        header=to_header(pose.valid_from_ns, world, types),
        child_frame_id=f"{pose.sensor}_optical_frame",
        transform=to_transform(pose.translation, pose.quat_xyzw, types),
    )


def transform_to_pose(message: Any) -> SensorPose:
    """The inverse of :func:`pose_to_transform`.

    Raises:
        MessageError: a child frame that is not ``<sensor>_optical_frame``, numbers that are not finite, a translation
            beyond :data:`MAX_RANGE`, a quaternion far from unit length, an invalid stamp.
    """
    suffix = "_optical_frame"
    child = str(message.child_frame_id)
    if not child.endswith(suffix) or child == suffix:
        raise MessageError(f"child_frame_id {child!r}, expected <sensor>{suffix}")
    t, q = message.transform.translation, message.transform.rotation
    translation, quat_xyzw = np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])
    norm = float(np.linalg.norm(quat_xyzw))
    if not (np.abs(translation) <= MAX_RANGE).all() or not abs(norm - 1.0) < 1e-3:
        raise MessageError(f"transform of {child!r}: translation {translation}, quaternion of length {norm:.3g}")
    return SensorPose(child.removesuffix(suffix), translation, quat_xyzw / norm, to_nanoseconds(message.header.stamp))


def clock_to_time_reference(sensor: str, clock: ClockModel, at_ns: int, types: MessageTypes) -> Any:
    """``sensor_msgs/TimeReference``: at ``header.stamp`` of the reference clock the sensor's clock showed ``time_ref``.

    The relation is valid from ``at_ns`` by the reference clock, or from when the sensor's clock is not negative.
    """
    at_ns = max(at_ns, clock.to_reference(0))
    return types.make(
        TIME_REFERENCE,
        header=to_header(at_ns, "", types),
        time_ref=to_time(max(0, clock.to_sensor(at_ns)), types),  # rounding may give -1 ns
        source=sensor,
    )


def time_reference_to_clock(message: Any) -> tuple[str, int, ClockModel]:
    """(sensor, reference time from which the relation is valid in nanoseconds, the sensor's clock).

    ``time_ref`` may be negative, as in recordings of sensors that were switched on later than the reference.

    Raises:
        MessageError: an invalid stamp.
    """
    at_ns, shown = to_nanoseconds(message.header.stamp), message.time_ref
    shown_ns = int(shown.sec) * NANOSECONDS + int(shown.nanosec)
    if abs(shown_ns) > MAX_STAMP_NS or not 0 <= shown.nanosec < NANOSECONDS:
        raise MessageError(f"the sensor's clock shows {shown.sec} s and {shown.nanosec} ns")
    return str(message.source), at_ns, ClockModel(shown_ns - at_ns, 0.0, at_ns)
