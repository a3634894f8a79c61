"""The nodes' diagnostics as an HTML table."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Final

from body_tracking.messages.node_status import NodeStatus

FRESH: Final = 3.0
"""Seconds after which a node counts as silent; nodes publish diagnostics once a second."""

_COLOURS: Final = {0: "#2f9e44", 1: "#f08c00", 2: "#e03131"}
_NONE: Final = "&ndash;"
_HEADS: Final = {
    "rate": "of the output, else of the input; of a bag, per second of the bag's time",
    "delay": "since the input was sent, median of the last second",
    "latency": "since capture, median of the last second",
}
"""Heads of the columns, and what is shown while the mouse is over them."""
_SILENT: Final = "#adb5bd"


def _rate(status: NodeStatus) -> str:
    """Rate of the node's busiest output, else of its busiest input; a dash without either."""
    for way in ("rate out ", "rate in "):
        rates = [status.number(name) for name in status.values if name.startswith(way)]
        known = [rate for rate in rates if rate is not None]
        if known:
            return f"{max(known):.0f} Hz"
    return _NONE


def _milliseconds(value: float | None) -> str:
    return _NONE if value is None else f"{value:.1f} ms"


def table(statuses: Mapping[str, NodeStatus], now: float) -> str:
    """HTML: per node its state, output rate, median delay (from the sending of its input), median latency (from
    capture), and text; silent nodes are pale.

    Args:
        statuses: by node name.
        now: steady time, seconds.
    """
    rows = []
    for name, status in sorted(statuses.items()):
        silent = now - status.received > FRESH
        colour = _SILENT if silent else _COLOURS.get(status.level, _COLOURS[2])
        numbers = [_rate(status), *(_milliseconds(status.number(f"{what} median ms")) for what in ("delay", "latency"))]
        text = f"silent for {now - status.received:.0f} s" if silent else status.text
        rows.append(
            f"<tr><td style='color:{colour}'>&#9679;</td><td><b>{html.escape(name)}</b></td>"
            + "".join(
                f"<td style='text-align:right;white-space:nowrap'>{'' if silent else number}</td>" for number in numbers
            )
            + "</tr><tr><td></td><td colspan='4' style='color:#868e96;padding-bottom:0.3em'>"
            + f"{html.escape(text)}</td></tr>"
        )
    head = "".join(
        f"<td style='text-align:right' title=\"{html.escape(text)}\">{word}</td>" for word, text in _HEADS.items()
    )
    return (
        "<table style='width:100%;font-size:0.78em;line-height:1.25;border-spacing:0 0'>"
        f"<tr style='color:#868e96'><td></td><td>node</td>{head}</tr>{''.join(rows)}</table>"
    )
