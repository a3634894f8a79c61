"""Inertial sensors and the orientations of segments."""

from __future__ import annotations

from typing import Any

import numpy as np

from body_tracking.core import so3
from body_tracking.core.imu import ImuSample, check_magnetic_field
from body_tracking.core.message_types import IMU, MAGNETIC_FIELD
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds, to_vector

_ABSENT = np.diag([-1.0, 0.0, 0.0])
"""The covariance that marks an absent quantity (REP-145)."""


def imu_to_message(
    stamp_ns: int,
    frame_id: str,
    angular_velocity: FloatArray,
    linear_acceleration: FloatArray,
    quat_xyzw: FloatArray | None,
    covariances: tuple[FloatArray, FloatArray, FloatArray],
    types: MessageTypes,
) -> Any:
    """``sensor_msgs/Imu`` by REP-145.

    Args:
        stamp_ns: capture time in the sensor's clock.
        frame_id: of the sensor.
        angular_velocity: (3,) rad/s.
        linear_acceleration: (3,) m/s2, specific force.
        quat_xyzw: (4,) of the sensor in an east-north-up frame; None for raw data.
        covariances: (3, 3) each, of orientation, angular velocity and acceleration; -1 in [0, 0] where unknown.
        types: see :class:`MessageTypes`.
    """
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if quat_xyzw is None else (float(value) for value in quat_xyzw)
    orientation, angular, linear = (types.floats(covariance.flatten()) for covariance in covariances)
    return types.make(
        IMU,
        header=to_header(stamp_ns, frame_id, types),
        orientation=types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        orientation_covariance=orientation,
        angular_velocity=to_vector(angular_velocity, types),
        angular_velocity_covariance=angular,
        linear_acceleration=to_vector(linear_acceleration, types),
        linear_acceleration_covariance=linear,
    )


def magnetic_field_to_message(
    stamp_ns: int, frame_id: str, field: FloatArray, covariance: FloatArray, types: MessageTypes
) -> Any:
    """``sensor_msgs/MagneticField`` of (3,) tesla with a covariance (3, 3); the rest as :func:`imu_to_message`."""
    return types.make(
        MAGNETIC_FIELD,
        header=to_header(stamp_ns, frame_id, types),
        magnetic_field=to_vector(field, types),
        magnetic_field_covariance=types.floats(covariance.reshape(-1)),
    )


def sample_to_messages(sample: ImuSample, types: MessageTypes) -> tuple[Any, Any | None]:
    """``sensor_msgs/Imu`` and, if there is a field, ``sensor_msgs/MagneticField`` of a reading.

    Absent quantities are marked by -1 (REP-145); an unknown covariance is zero.
    """
    unknown = np.zeros((3, 3))
    stated = unknown if sample.orientation_covariance is None else sample.orientation_covariance
    imu = imu_to_message(
        sample.stamp_ns,
        sample.frame_id,
        np.zeros(3) if sample.angular_velocity is None else sample.angular_velocity,
        np.zeros(3) if sample.acceleration is None else sample.acceleration,
        sample.orientation,
        (
            _ABSENT if sample.orientation is None else stated,
            _ABSENT if sample.angular_velocity is None else unknown,
            _ABSENT if sample.acceleration is None else unknown,
        ),
        types,
    )
    if sample.magnetic_field is None:
        return imu, None
    field = magnetic_field_to_message(sample.stamp_ns, sample.frame_id, sample.magnetic_field, unknown, types)
    return imu, field


def message_to_sample(message: Any) -> ImuSample:
    """The reading in a ``sensor_msgs/Imu``; None for quantities whose covariance begins with -1 (REP-145).

    Raises:
        MessageError: a covariance without nine elements.
        ImuSampleError: an invalid reading.
    """
    covariances = {}
    for name in ("orientation", "angular_velocity", "linear_acceleration"):
        values = np.array(getattr(message, f"{name}_covariance"), dtype=np.float64)
        if values.size != 9:
            raise MessageError(f"{name}_covariance of {values.size} elements, expected 9")
        covariances[name] = values.reshape(3, 3)
    there = {name: covariance[0, 0] != -1.0 for name, covariance in covariances.items()}
    q, stated = message.orientation, covariances["orientation"]
    return ImuSample(
        to_nanoseconds(message.header.stamp),
        str(message.header.frame_id),
        np.array([q.x, q.y, q.z, q.w]) if there["orientation"] else None,
        stated if there["orientation"] and stated.any() else None,  # all zeros: unknown
        _array(message.angular_velocity) if there["angular_velocity"] else None,
        _array(message.linear_acceleration) if there["linear_acceleration"] else None,
    )


def message_to_magnetic_field(message: Any) -> tuple[int, str, FloatArray]:
    """(stamp in nanoseconds, frame, (3,) tesla) of a ``sensor_msgs/MagneticField``.

    Raises:
        ImuSampleError: not finite, or beyond 1e-3 T.
    """
    field = _array(message.magnetic_field)
    check_magnetic_field(field)
    return to_nanoseconds(message.header.stamp), str(message.header.frame_id), field


def _array(vector: Any) -> FloatArray:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


def orientation_to_message(measurement: SegmentOrientation, types: MessageTypes) -> Any:
    """``sensor_msgs/Imu`` of a segment's orientation: rotation and covariance in a fixed frame, rate in its own.

    The header's frame is the fixed frame, such as ``world``; the topic names the segment.
    """
    rate = measurement.angular_velocity
    return imu_to_message(
        measurement.stamp_ns,
        measurement.frame_id,
        np.zeros(3) if rate is None else rate,
        np.zeros(3),
        so3.matrix_to_quat(measurement.rotation),
        (
            measurement.covariance,
            _ABSENT if rate is None else measurement.angular_velocity_variance * np.eye(3),
            _ABSENT,
        ),
        types,
    )


def message_to_orientation(message: Any, segment: str) -> SegmentOrientation:
    """The inverse of :func:`orientation_to_message`.

    Raises:
        MessageError: a covariance without nine elements, no orientation, or no covariance of it.
        ImuSampleError: numbers that are not finite, an invalid quaternion, no frame.
        OrientationError: an invalid orientation or segment.
    """
    sample = message_to_sample(message)
    if sample.orientation is None or sample.orientation_covariance is None:
        raise MessageError(f"orientation of {segment}: without orientation, or without its covariance")
    variance = float(message.angular_velocity_covariance[0])
    rate = sample.angular_velocity if variance > 0.0 else None
    return SegmentOrientation(
        sample.stamp_ns,
        f"imu_{segment}",
        segment,
        so3.quat_to_matrix(sample.orientation),
        sample.orientation_covariance,
        rate,
        variance if rate is not None else 0.0,
        sample.frame_id,
    )
