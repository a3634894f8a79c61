"""The table of nodes: silent nodes are shown as silent, and texts are escaped."""

from __future__ import annotations

import pytest

from body_tracking.messages.node_status import NodeStatus
from body_tracking.viewing.status import FRESH, table

VALUES = {"rate out /a": "29.9", "rate out /b": "1.0", "delay median ms": "1.53", "latency median ms": "22.4"}


def test_a_row_has_rate_delay_and_latency() -> None:
    text = table({"fusion": NodeStatus("fusion: stream", 0, "fine", VALUES, 100.0)}, 100.5)
    for part in ("fusion", "30 Hz", "1.5 ms", "22.4 ms", "fine"):
        assert part in text


def test_a_silent_node_has_no_figures_any_more() -> None:
    text = table({"fusion": NodeStatus("fusion: stream", 0, "fine", VALUES, 100.0)}, 101.0 + FRESH)
    assert "30 Hz" not in text and "fine" not in text
    assert "silent for 4 s" in text


@pytest.mark.parametrize(
    ("values", "rate"),
    [
        ({}, ""),
        ({"rate in /a": "7.0"}, "7 Hz"),
        ({"rate out /a": "fast", "rate out /b": "3.0", "delay median ms": "n/a"}, "3 Hz"),
    ],
)
def test_an_invalid_figure_is_left_out(values: dict[str, str], rate: str) -> None:
    text = table({"fusion": NodeStatus("fusion: stream", 0, "", values)}, 0.0)
    assert " ms" not in text and rate in text and ("Hz" in text) == bool(rate)


def test_node_texts_are_escaped() -> None:
    text = table({"<b>x": NodeStatus("<b>x: y", 2, "<script>alert(1)</script>")}, 0.0)
    assert "<script>" not in text and "&lt;script&gt;" in text and "<b>x" not in text
