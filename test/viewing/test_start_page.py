"""The start page, on a server without a browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("viser", reason="viser is not installed")

from body_tracking.viewing.start_page import DEFAULT, Choice, StartPage
from body_tracking.viewing.state import GREEN, RED

FILTERS, CONVENTIONS = ("lkf_constant_velocity", "ekf"), ("model", "isb")


@pytest.mark.parametrize("before", [None, Choice(Path("wave"), True, "ekf", "isb"), Choice(None, False, DEFAULT)])
def test_loop_filter_and_convention_are_offered_again(before: Choice | None) -> None:
    """After a recording has ended, or a graph did not start, the user need not set them anew."""
    with StartPage("127.0.0.1", 18080, FILTERS, CONVENTIONS, lambda choice: None, before) as page:
        found = page._choice(None)
    assert found == (Choice(None, False, DEFAULT) if before is None else replace(before, bag=None))


def test_the_page_is_not_ready_while_another_graph_runs() -> None:
    with StartPage("127.0.0.1", 18080, FILTERS, CONVENTIONS, lambda choice: None) as page:
        page.say("wave has ended; choose again.", GREEN)
        page.draw_domain("", ("/fusion",), True, "none")
        assert "runs already" in page._state.content and ">ready<" not in page._state.content
        assert "runs already" not in page._nodes.content
        page.say("cannot be read", RED)
        assert "cannot be read" in page._state.content and "runs already" in page._state.content
        page.say("wave has ended; choose again.", GREEN)
        page.draw_domain("", (), False, "none")
        assert "wave has ended" in page._state.content


def test_a_recording_elsewhere_needs_a_path() -> None:
    chosen: list[Choice] = []
    with StartPage("127.0.0.1", 18080, FILTERS, CONVENTIONS, chosen.append) as page:
        page._path.value = " "
        page._on_open()
        assert not chosen and "path of a recording" in page._state.content
        page._path.value = " wave "
        page._on_open()
    assert [each.bag for each in chosen] == [Path("wave")]
