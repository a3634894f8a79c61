"""The viewer's drawing thread outlives a drawing that fails, and ends the node where all do."""

from __future__ import annotations

import threading
from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from body_tracking.nodes.viewer import ViewerNode


class Drawing(SimpleNamespace):
    """What ``keep_drawing`` has to do with; drawings of these numbers fail."""

    def __init__(self, failing: range, until: int) -> None:
        super().__init__(
            values={"rate": 1000.0},
            page=SimpleNamespace(watched=1),
            ended=threading.Event(),
            monitor=SimpleNamespace(totals=Counter()),
            context=SimpleNamespace(try_shutdown=lambda: self.reported.append("ended")),
            reported=[],
            failing=failing,
            until=until,
            tried=0,
            drawn=0,
            drawing_s=0.0,
        )

    def draw(self, now: float) -> None:
        self.tried += 1
        if self.tried == self.until:
            self.ended.set()
        if self.tried in self.failing:
            raise RuntimeError("deque mutated during iteration")

    def get_logger(self) -> Any:
        return SimpleNamespace(fatal=self.reported.append)

    def log_throttled(self, key: str, text: str) -> None:
        self.reported.append(f"warned of {key}")


def test_a_drawing_that_fails_is_tried_again_and_counted() -> None:
    drawing = Drawing(range(3, 6), 20)
    ViewerNode.keep_drawing(drawing)  # type: ignore[arg-type]
    assert (drawing.tried, drawing.drawn) == (20, 17)
    assert drawing.monitor.totals["drawings failed"] == 3
    assert drawing.reported == ["warned of drawing"] * 3


def test_the_node_reports_repeated_failures_of_drawing_and_ends() -> None:
    drawing = Drawing(range(1, 1000), 1000)
    ViewerNode.keep_drawing(drawing)  # type: ignore[arg-type]
    assert drawing.tried == 10
    assert "drawing failed 10 times" in drawing.reported[-2] and "deque mutated" in drawing.reported[-2]
    assert drawing.reported[-1] == "ended"
