"""Status reports of nodes, as ``diagnostic_msgs/DiagnosticArray``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from body_tracking.core.message_types import DIAGNOSTICS
from body_tracking.messages.base import MessageTypes, RosMessages, to_header
from body_tracking.messages.node_status import NodeStatus

MAX_VALUES, MAX_TEXT = 500, 1000
"""Values of a received status, and characters of each text, that are kept; our nodes report a tenth of that."""


def diagnostics(
    stamp_ns: int, name: str, hardware_id: str, level: int, text: str, values: Mapping[str, object], types: MessageTypes
) -> Any:
    """One ``diagnostic_msgs/DiagnosticArray`` with one status; see :class:`NodeStatus`.

    ``name`` has the node's full name without the leading slash; ``stamp_ns`` is node time.
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


def statuses(message: Any, received: float = 0.0, namespace: str | None = None) -> tuple[NodeStatus, ...]:
    """The statuses in a ``diagnostic_msgs/DiagnosticArray``.

    Args:
        message: the array.
        received: steady time, seconds.
        namespace: select the nodes in this namespace, and use their names in it; None for all nodes by full name.
    """
    prefix = "" if namespace is None else f"{namespace.strip('/')}/".removeprefix("/")
    return tuple(
        NodeStatus(
            each.name.removeprefix(prefix)[:MAX_TEXT],
            each.level[0] if isinstance(each.level, bytes) else int(each.level),
            each.message[:MAX_TEXT],
            {item.key[:MAX_TEXT]: item.value[:MAX_TEXT] for item in each.values[:MAX_VALUES]},
            received,
        )
        for each in message.status
        if namespace is None
        or (each.name.startswith(prefix) and "/" not in each.name.removeprefix(prefix).partition(":")[0])
    )
