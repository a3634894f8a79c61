"""What publishes in the ROS domain: the sensors that ``up`` takes where none are named, and a graph that runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import rclpy
from rclpy.node import Node
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


@dataclass(frozen=True, slots=True)
class Domain:
    """The content of a namespace of the ROS domain.

    Attributes:
        sensors: the options of a graph that takes the sensors that publish; empty where none does.
        runs: whether a ``body_tracking up`` runs.
    """

    sensors: Mapping[str, Value] = field(default_factory=dict)
    runs: bool = False


def look(namespace: str = "/", patience: float = PATIENCE, stopped: Callable[[], bool] = lambda: False) -> Domain:
    """Look until sensors are found and no more appear, or for ``patience`` seconds where there are none."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node(f"body_tracking_look_{time.time_ns()}", namespace=namespace, context=context)
        end, found = time.monotonic() + patience, Domain()
        while time.monotonic() < end and not stopped():
            time.sleep(_LOOK)
            now = _domain(node, namespace)
            if now != found:
                end = max(end, time.monotonic() + SETTLED) if not now.sensors else time.monotonic() + SETTLED
                found = now
        node.destroy_node()
        return found
    finally:
        rclpy.try_shutdown(context=context)


def _domain(node: Node, namespace: str) -> Domain:
    topics: dict[str, str] = {}
    for topic, kinds in node.get_topic_names_and_types():
        own = names.within(topic, namespace)
        if own is not None and kinds and node.count_publishers(topic):
            topics[own] = kinds[0]
    others = node.get_node_names_and_namespaces()
    runs = any(name.startswith(f"{UP_NODE}_") and where == node.get_namespace() for name, where in others)
    return Domain(found_sensors(topics), runs)
