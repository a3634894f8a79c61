"""What a node says of itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """One status of ``/diagnostics``.

    Attributes:
        name: ``<node>: <what>``, with the namespace before the node where that is not known.
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
        """Whose it is."""
        return self.name.partition(":")[0]

    def number(self, key: str) -> float | None:
        """A value as a number; None where there is none, as other people's nodes may say anything."""
        try:
            return float(self.values[key])
        except (KeyError, ValueError):
            return None


MAX_NODES = 64
"""Nodes of which a status is kept: a graph has some twenty."""


def update_statuses(known: dict[str, NodeStatus], told: Iterable[NodeStatus]) -> None:
    """Keep the newest status of each node, in place; of too many nodes those that were heard last."""
    for status in told:
        known.pop(status.node, None)
        known[status.node] = status
        if len(known) > MAX_NODES:
            del known[next(iter(known))]
