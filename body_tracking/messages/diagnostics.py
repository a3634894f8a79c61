"""What nodes say of themselves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from body_tracking.messages.base import DIAGNOSTICS, MessageTypes, RosMessages, to_header
from body_tracking.node_status import NodeStatus


def diagnostics(
    stamp_ns: int, name: str, hardware_id: str, level: int, text: str, values: Mapping[str, object], types: MessageTypes
) -> Any:
    """One ``diagnostic_msgs/DiagnosticArray`` with one status.

    Args:
        stamp_ns: node time.
        name: ``<node>: <what>``.
        hardware_id: the sensor, or empty.
        level: 0 OK, 1 warning, 2 error, 3 stale.
        text: one line for people.
        values: counters and rates.
        types: the family of message classes to build.
    """
    status = types.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=bytes([level]) if isinstance(types, RosMessages) else level,
        name=name,
        message=text,
        hardware_id=hardware_id,
        values=[types.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()],
    )
    return types.make(DIAGNOSTICS, header=to_header(stamp_ns, "", types), status=[status])


def statuses(message: Any, received: float = 0.0) -> tuple[NodeStatus, ...]:
    """Those in a ``diagnostic_msgs/DiagnosticArray``, received at a steady time in seconds."""
    return tuple(
        NodeStatus(
            each.name,
            each.level[0] if isinstance(each.level, bytes) else int(each.level),
            each.message,
            {item.key: item.value for item in each.values},
            received,
        )
        for each in message.status
    )
