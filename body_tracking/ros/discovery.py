"""Discovery in the ROS domain: the sensors that ``up`` takes if none are named, and a running graph."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import rclpy
from rclpy.signals import SignalHandlerOptions

from body_tracking.core import names
from body_tracking.core.parameters import Value
from body_tracking.pipeline.graph import UP_NODE
from body_tracking.systems import found_sensors

PATIENCE = 4.0
"""Seconds for a first sensor to be discovered."""
SETTLED = 1.0
"""Seconds without another topic after which all are known."""
_LOOK = 0.1
_OWN_NAME = "body_tracking_look"


@dataclass(frozen=True, slots=True)
class Domain:
    """The content of a namespace of the ROS domain.

    Attributes:
        sensors: the options of a graph that takes the sensors that publish; empty where none does.
        runs: whether a ``body_tracking up`` runs.
        nodes: full names, sorted.
    """

    sensors: Mapping[str, Value] = field(default_factory=dict)
    runs: bool = False
    nodes: tuple[str, ...] = field(default=(), compare=False)


class Watch:
    """Discovers nodes and topics of the ROS domain until it is closed; the first ones appear after a second or so.

    Args:
        namespace: in which sensors are looked for.
    """

    def __init__(self, namespace: str = "/") -> None:
        self._namespace, self._context = namespace, rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        name = f"{_OWN_NAME}_{time.time_ns()}"
        self._node = rclpy.create_node(name, namespace=namespace, context=self._context)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def now(self) -> Domain:
        """The sensors, graph and nodes that are discovered at present."""
        topics: dict[str, str] = {}
        for topic, kinds in self._node.get_topic_names_and_types():
            own = names.within(topic, self._namespace)
            if own is not None and kinds and self._node.count_publishers(topic):
                topics[own] = kinds[0]
        there = self._node.get_node_names_and_namespaces()
        runs = any(name.startswith(f"{UP_NODE}_") and where == self._node.get_namespace() for name, where in there)
        nodes = {f"{where.rstrip('/')}/{name}" for name, where in there if not name.startswith((_OWN_NAME, "_"))}
        return Domain(found_sensors(topics), runs, tuple(sorted(nodes)))


def look(namespace: str = "/", patience: float = PATIENCE, stopped: Callable[[], bool] = lambda: False) -> Domain:
    """Look until sensors are found and no more appear, or for ``patience`` seconds where there are none."""
    end, found = time.monotonic() + patience, Domain()
    with Watch(namespace) as watch:
        while time.monotonic() < end and not stopped():
            time.sleep(_LOOK)
            now = watch.now()
            if now != found:
                end = max(end, time.monotonic() + SETTLED) if not now.sensors else time.monotonic() + SETTLED
                found = now
    return found
