"""Message classes by name, and conversion of QoS profiles between rclpy and :mod:`body_tracking.core.qos`."""

from __future__ import annotations

import importlib
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.qos import INFINITE_NS, Qos


class UnknownTypeError(BodyTrackingError):
    """The package of a message type is not installed."""


def message_class(type_name: str) -> Any:
    """The class of ``sensor_msgs/msg/PointCloud2``.

    Raises:
        UnknownTypeError: it cannot be imported here.
    """
    try:
        package, kind, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ValueError, ImportError, AttributeError) as error:
        raise UnknownTypeError(f"message type {type_name!r} is not installed") from error


def to_profile(qos: Qos) -> QoSProfile:
    """rclpy's profile."""
    durations = {
        name: Duration(nanoseconds=nanoseconds)
        for name, nanoseconds in (
            ("deadline", qos.deadline_ns),
            ("lifespan", qos.lifespan_ns),
            ("liveliness_lease_duration", qos.liveliness_lease_ns),
        )
        if 0 < nanoseconds < INFINITE_NS
    }
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if qos.history == "keep_all" else HistoryPolicy.KEEP_LAST,
        depth=max(1, qos.depth),
        reliability=ReliabilityPolicy.BEST_EFFORT if qos.reliability == "best_effort" else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if qos.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC
        if qos.liveliness == "manual_by_topic"
        else LivelinessPolicy.AUTOMATIC,
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
        **durations,
    )


def from_profile(profile: QoSProfile) -> Qos:
    """The profile of a publisher as discovery reports it."""
    return Qos(
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        depth=profile.depth,
        history=profile.history.name.lower(),
        deadline_ns=profile.deadline.nanoseconds or INFINITE_NS,
        lifespan_ns=profile.lifespan.nanoseconds or INFINITE_NS,
        liveliness=profile.liveliness.name.lower(),
        liveliness_lease_ns=profile.liveliness_lease_duration.nanoseconds or INFINITE_NS,
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )
