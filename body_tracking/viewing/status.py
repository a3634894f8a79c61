"""What nodes say of themselves, as a small table for a page."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

FRESH: Final = 3.0
"""Seconds for which what a node said of itself counts; it says so once a second."""

_COLOURS: Final = {0: "#2f9e44", 1: "#f08c00", 2: "#e03131"}
_SILENT: Final = "#adb5bd"


@dataclass(frozen=True, slots=True)
class NodeStatus:
    """The latest diagnostics of one node.

    Attributes:
        level: 0 OK, 1 warning, 2 error.
        text: one line.
        values: rates, counters.
        received: steady time, seconds.
    """

    level: int
    text: str
    values: Mapping[str, str]
    received: float

    @property
    def rate(self) -> str:
        """Messages per second of the node's busiest output; empty where it has none."""
        rates = [float(value) for name, value in self.values.items() if name.startswith("rate out ")]
        return f"{max(rates):.0f} Hz" if rates else ""

    @property
    def delay(self) -> str:
        """From the input's sending to the output, median."""
        return _milliseconds(self.values.get("delay median ms"))

    @property
    def latency(self) -> str:
        """From capture to the output, median."""
        return _milliseconds(self.values.get("latency median ms"))


def _milliseconds(value: str | None) -> str:
    return "" if value is None else f"{float(value):.1f} ms"


def table(statuses: Mapping[str, NodeStatus], now: float) -> str:
    """HTML: per node its state, its output's rate, delay and latency, and what it says; silent nodes are pale.

    Args:
        statuses: by node name.
        now: steady time, seconds.
    """
    rows = []
    for name, status in sorted(statuses.items()):
        silent = now - status.received > FRESH
        colour = _SILENT if silent else _COLOURS.get(status.level, _COLOURS[2])
        numbers = ("", "", "") if silent else (status.rate, status.delay, status.latency)
        text = f"silent for {now - status.received:.0f} s" if silent else status.text
        rows.append(
            f"<tr><td style='color:{colour}'>&#9679;</td><td><b>{html.escape(name)}</b></td>"
            + "".join(f"<td style='text-align:right;white-space:nowrap'>{number}</td>" for number in numbers)
            + "</tr><tr><td></td><td colspan='4' style='color:#868e96;padding-bottom:0.3em'>"
            + f"{html.escape(text)}</td></tr>"
        )
    head = "".join(f"<td style='text-align:right'>{word}</td>" for word in ("rate", "delay", "latency"))
    return (
        "<table style='width:100%;font-size:0.78em;line-height:1.25;border-spacing:0 0'>"
        f"<tr style='color:#868e96'><td></td><td>node</td>{head}</tr>{''.join(rows)}</table>"
    )
