"""The control panel, without a browser: a user's choice is kept while the nodes still report the old value."""

from __future__ import annotations

import asyncio
import importlib
import queue
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

pytest.importorskip("viser", reason="viser is not installed")

from body_tracking.messages.node_status import NodeStatus
from body_tracking.viewing.panel import ControlPanel, checked
from body_tracking.viewing.server import serve, stop
from body_tracking.viewing.snapshot import PageError
from patience import PATIENCE


class Choice(SimpleNamespace):
    """A list or a box of the page, in which a user can choose."""

    def on_update(self, called: Any) -> None:
        self.called = called

    def receive(self, value: object) -> None:
        """The user's choice arrives."""
        self.value = value

    def handle(self) -> None:
        """The server calls back, in a thread of its own, a moment later."""
        self.called(SimpleNamespace(client="a browser"))


@pytest.fixture
def page() -> SimpleNamespace:
    """A panel with the lists of filters and conventions, and the controls that it calls."""
    lists: dict[str, Choice] = {}

    def add_dropdown(label: str, options: tuple[str, ...]) -> Choice:
        return lists.setdefault(label, Choice(options=options, value=options[0], visible=True))

    server, controls = MagicMock(), MagicMock()
    server.gui.add_dropdown.side_effect = add_dropdown
    server.gui.add_slider.return_value = Choice(value=0.0, max=1.0, visible=True)
    server.gui.add_checkbox.return_value = loop = Choice(value=False, visible=True)
    server.get_clients.return_value = {}
    panel = ControlPanel(server, controls, ("lkf", "ekf"), ("positional", "model", "isb"))

    def report(convention: str, loops: bool = False) -> None:
        angles = NodeStatus("joint_angles: angles", 0, f"{convention} angles")
        player = NodeStatus("bag_player: bag", 0, "playing", {"loop": str(loops), "duration s": "15.4"})
        panel.draw({"joint_angles": angles, "bag_player": player}, 0.0, False)

    return SimpleNamespace(angles=lists["angles"], loop=loop, controls=controls, report=report)


def test_a_choice_is_not_undone_by_a_report_of_what_ran_before(page: SimpleNamespace) -> None:
    page.report("model")
    assert page.angles.value == "model"
    page.angles.receive("isb")
    page.report("model")
    page.angles.handle()
    page.controls.choose_convention.assert_called_once_with("isb")
    page.report("model")
    assert page.angles.value == "isb"
    page.report("isb")
    page.report("positional")  # another program set it
    assert page.angles.value == "positional"


def test_a_click_on_loop_is_not_undone_by_a_report_of_before(page: SimpleNamespace) -> None:
    page.report("model", loops=False)
    page.loop.receive(True)
    page.report("model", loops=False)
    page.loop.handle()
    page.controls.loop.assert_called_once_with(True)
    page.report("model", loops=True)
    assert page.loop.value is True
    page.report("model", loops=False)
    assert page.loop.value is False


def test_after_a_refusal_the_list_shows_what_runs(page: SimpleNamespace) -> None:
    page.report("model")
    page.controls.choose_convention.side_effect = PageError("refused")
    page.angles.receive("isb")
    page.angles.handle()
    page.report("model")
    assert page.angles.value == "model"


def test_what_is_none_of_the_options_is_refused_and_not_passed_on(page: SimpleNamespace) -> None:
    page.report("model")
    page.angles.receive("/nonexistent")
    page.angles.handle()
    page.controls.choose_convention.assert_not_called()
    page.report("model")
    assert page.angles.value == "model"


def test_a_choice_of_the_page_is_one_of_its_options() -> None:
    assert checked("body2", ("body1", "body2")) == "body2"
    with pytest.raises(PageError, match=r"^'x{39}, expected one of body1, body2$"):
        checked("x" * 1_000_000, ("body1", "body2"))


@pytest.fixture
def server() -> Iterator[Any]:
    """A server without browsers."""
    server = serve("127.0.0.1", 0)
    yield server
    stop(server)


class Slider:
    """The slider of a panel at a real server, in which a user moves it; the bag has 15.4 s.

    Attributes:
        sought: positions to which the bag was asked to seek.
        answer: event for which the player's answer waits.
    """

    def __init__(self, server: Any) -> None:
        self.server, self.sought, self.answer = server, queue.Queue[float](), threading.Event()
        self.panel = ControlPanel(server, controls := MagicMock(), ("lkf",), ("positional",))
        controls.seek.side_effect = self._seek
        server._connected_clients[1] = MagicMock()
        inputs = server.gui._gui_input_handle_from_uuid.values()
        (self.handle,) = (each for each in inputs if type(each).__name__ == "GuiSliderHandle")

    def _seek(self, place: float) -> str:
        self.sought.put(place)
        assert self.answer.wait(PATIENCE)
        return f"plays on from {place} s"

    def report(self, place: float, received: float | None = None) -> None:
        """The player reports the bag's position."""
        values = {"duration s": "15.4", "position s": str(place), "loop": "False"}
        at = time.monotonic() if received is None else received
        self.panel.draw({"bag_player": NodeStatus("bag_player: bag", 0, "playing", values, at)}, at, False)
        self._in_loop(asyncio.sleep(0.0))

    def move(self, place: float) -> None:
        """The browser reports that the user moved the slider."""
        message = importlib.import_module("viser._messages").GuiUpdateMessage(self.handle._impl.uuid, {"value": place})
        self._in_loop(self.server.gui._handle_gui_updates(1, message))

    def _in_loop(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self.server.get_event_loop()).result(PATIENCE)


def test_a_move_of_the_slider_is_not_undone_by_a_report_that_comes_before_it_is_read(server: Any) -> None:
    """The server's 32 threads for callbacks are busy here, as they may be while a page waits for answers."""
    slider, over = Slider(server), threading.Event()
    slider.answer.set()
    slider.report(2.0)
    assert slider.handle.value == 2.0
    for _ in range(server._thread_executor._max_workers):
        server._thread_executor.submit(over.wait, PATIENCE)
    slider.move(12.0)
    slider.report(3.0)
    over.set()
    assert slider.sought.get(timeout=PATIENCE) == 12.0


def test_the_slider_follows_the_bag_again_as_soon_as_it_is_there(server: Any) -> None:
    """If held for longer, it would still be at 0.0 s when the user moves it there again: no change for a browser."""
    slider = Slider(server)
    slider.report(5.0)
    slider.move(0.0)
    assert slider.sought.get(timeout=PATIENCE) == 0.0
    slider.report(6.0)  # not yet there
    assert slider.handle.value == 0.0
    asked = time.monotonic()
    slider.answer.set()
    end = time.monotonic() + PATIENCE
    while slider.handle.value == 0.0 and time.monotonic() < end:
        slider.report(6.5, asked)  # from before
        assert slider.handle.value == 0.0
        slider.report(0.7)
    assert slider.handle.value == 0.7
    slider.move(0.0)
    assert slider.sought.get(timeout=PATIENCE) == 0.0
