"""The viewer's drawing thread survives a failed drawing and ends the node if all fail; age of the views' messages."""

from __future__ import annotations

import threading
from collections import Counter, deque
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from body_tracking.nodes.viewer import ViewerNode


class Drawing(SimpleNamespace):
    """A stand-in for the node in ``keep_drawing``; drawings of these numbers fail."""

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


class Playback(SimpleNamespace):
    """Views' messages of a recording that is played; one topic is latched."""

    def __init__(self) -> None:
        super().__init__(
            recent={"/mesh": deque(maxlen=16), "/camera_info": deque(maxlen=16)},
            held={"/camera_info"},
            monitor=SimpleNamespace(totals=Counter()),
            clock_s=0.0,
        )

    def waiting_ns(self) -> int:
        return round(1e9 * self.clock_s)

    def play_to(self, clock_s: float, *topics: str) -> dict[str, list[bytes]]:
        self.clock_s = clock_s
        for topic in topics:
            ViewerNode.on_recent(self, topic, f"{clock_s:g}".encode(), 0)  # type: ignore[arg-type]
        return ViewerNode.fresh(self)  # type: ignore[arg-type]


def test_messages_of_views_grow_old_by_the_clock_of_the_recording() -> None:
    playback = Playback()
    assert playback.play_to(10.0, "/mesh", "/camera_info")["/mesh"] == [b"10"]
    # four times as slow: one mesh per 0.8 s of wall time, which is 0.2 s of the recording
    assert playback.play_to(10.2, "/mesh")["/mesh"] == [b"10", b"10.2"]
    assert playback.play_to(11.1)["/mesh"] == [b"10.2"]
    assert playback.play_to(11.5) == {"/mesh": [], "/camera_info": [b"10"]}


def test_messages_of_views_from_before_a_backward_jump_are_not_drawn() -> None:
    playback = Playback()
    playback.play_to(10.0, "/mesh")
    assert playback.play_to(2.0, "/mesh")["/mesh"] == [b"2"]
