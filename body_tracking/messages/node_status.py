"""The status of a node, as it reports it in ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """One status of ``/diagnostics``.

    Attributes:
        name: ``<node>: <subject>``, with the node's namespace unless the receiver selected one.
        level: 0 OK, 1 warning, 2 error, 3 stale.
        text: one line.
        values: rates, counters.
        received: steady time, seconds.
    """

    name: str
    level: int
    text: str
    values: Mapping[str, str] = field(default_factory=dict)
    received: float = 0.0

    @property
    def node(self) -> str:
        """The node's name."""
        return self.name.partition(":")[0]

    def number(self, key: str) -> float | None:
        """A value as a number; None where it is absent or not a number."""
        try:
            return float(self.values[key])
        except (KeyError, ValueError):
            return None


MAX_NODES = 64
"""Nodes whose status is kept; a graph has about twenty."""


def update_statuses(known: dict[str, NodeStatus], received: Iterable[NodeStatus]) -> None:
    """Keep the newest status of each node, in place; of too many nodes, the most recent ones."""
    for status in received:
        known.pop(status.node, None)
        known[status.node] = status
        if len(known) > MAX_NODES:
            del known[next(iter(known))]
