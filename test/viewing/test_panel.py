"""The control panel, without a browser: what it does with a choice while the nodes still report what ran before."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

pytest.importorskip("viser", reason="viser is not installed")

from body_tracking.messages.node_status import NodeStatus
from body_tracking.viewing.panel import ControlPanel
from body_tracking.viewing.snapshot import PageError


class Dropdown(SimpleNamespace):
    """A list of the page, in which a user can choose."""

    def on_update(self, called: Any) -> None:
        self.called = called

    def receive(self, value: str) -> None:
        """The user's choice arrives."""
        self.value = value

    def handle(self) -> None:
        """The server calls back, in a thread of its own, a moment later."""
        self.called(SimpleNamespace(client="a browser"))


@pytest.fixture
def page() -> SimpleNamespace:
    """A panel with the lists of filters and conventions, and the controls that it calls."""
    lists: dict[str, Dropdown] = {}

    def add_dropdown(label: str, options: tuple[str, ...]) -> Dropdown:
        return lists.setdefault(label, Dropdown(options=options, value=options[0], visible=True))

    server, controls = MagicMock(), MagicMock()
    server.gui.add_dropdown.side_effect = add_dropdown
    server.get_clients.return_value = {}
    panel = ControlPanel(server, controls, ("lkf", "ekf"), ("positional", "model", "isb"))

    def report(convention: str) -> None:
        panel.draw({"joint_angles": NodeStatus("joint_angles: angles", 0, f"{convention} angles")}, 0.0, False)

    return SimpleNamespace(angles=lists["angles"], controls=controls, report=report)


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


def test_after_a_refusal_the_list_shows_what_runs(page: SimpleNamespace) -> None:
    page.report("model")
    page.controls.choose_convention.side_effect = PageError("refused")
    page.angles.receive("isb")
    page.angles.handle()
    page.report("model")
    assert page.angles.value == "model"
