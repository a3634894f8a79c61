"""The page before a graph runs: recordings and sensors to choose from, and the nodes in the ROS domain."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import viser

from body_tracking.pipeline.roles import DEFAULT_FILTER
from body_tracking.viewing.server import address_of, serve, stop
from body_tracking.viewing.state import GREEN, GREY, ORANGE, RED, block, line

DEFAULT: Final = "default"
"""Choice of the graph's default filter."""
_RUNS: Final = "A graph of <code>body_tracking up</code> runs already; end it before you start another one here."
_LEFT, _RIGHT = 540, 380
"""Widths of the panels, pixels: both fit a tablet of 1024."""
_LAST: Final = 1e6
"""Place in the panel behind all recordings."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording to choose.

    Attributes:
        path: of the bag.
        where: in words, such as "in this folder".
        content: its length and sensors in words.
        refusal: reason why it cannot be played, or empty.
        results: whether its angles were computed offline, from another recording.
    """

    path: Path
    where: str
    content: str
    refusal: str = ""
    results: bool = False


@dataclass(frozen=True, slots=True)
class Choice:
    """The user's choice.

    Attributes:
        bag: to play; None for the publishing sensors.
        loop: play it in a loop.
        filter: a name, or :data:`DEFAULT`.
        convention: of the angles; a name, or :data:`DEFAULT` for the filter's.
    """

    bag: Path | None
    loop: bool
    filter: str
    convention: str = DEFAULT


class StartPage:
    """Serves the page until it is closed; its methods must be called from one thread.

    Args:
        host: address to listen on.
        port: the first one to try.
        filters: options.
        conventions: options.
        choose: called with the user's choice, in a thread of the server.
        before: the user's previous choice, whose loop, filter and convention are offered again.

    Raises:
        PageError: as of :func:`serve`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        filters: Sequence[str],
        conventions: Sequence[str],
        choose: Callable[[Choice], None],
        before: Choice | None = None,
    ) -> None:
        self._choose = choose
        before = before or Choice(None, False, DEFAULT)
        self._server = serve(host, port)
        scene, gui = self._server.scene, self._server.gui
        scene.set_up_direction("+z")
        scene.add_grid("/floor", 12.0, 12.0, cell_color=(228, 230, 234), section_color=(205, 209, 215))
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_RIGHT)
        self._state = gui.add_html("")
        self._said, self._ready, self._runs = "", False, False
        self.say("Choose a recording on the left, or start with sensors.", GREEN)
        with gui.add_folder("Sensors"):
            self._sensors = gui.add_html("")
            self._start: Any = gui.add_button("start with these sensors", visible=False)
        with gui.add_folder("How"):
            self._filter: Any = gui.add_dropdown(
                "filter",
                (DEFAULT, *filters),
                initial_value=before.filter,
                hint=f"default: {DEFAULT_FILTER}, or ekf where all sensors are colour cameras or inertial ones",
            )
            self._convention: Any = gui.add_dropdown(
                "angles",
                (DEFAULT, *conventions),
                initial_value=before.convention,
                hint="default: those of the filter; isb suits arms raised sideways",
            )
            self._loop: Any = gui.add_checkbox("loop", before.loop, hint="play the recording again at its end")
        with gui.add_folder("Nodes"):
            self._nodes = gui.add_html("")
        self._start.on_click(lambda _: self._choose(self._choice(None)))
        panel = gui.add_panel()
        self._recordings = panel.add_tab("Recordings", viser.Icon.PLAYER_PLAY)
        with self._recordings:
            # below the list, of which it is the last entry
            where = "<b>a recording elsewhere</b>: the path of its folder, or of its mcap file"
            gui.add_divider(order=_LAST)
            gui.add_html(block([where]), order=_LAST + 1)
            self._path: Any = gui.add_text("path", "", order=_LAST + 2)
            self._open: Any = gui.add_button("play the recording at this path", order=_LAST + 3)
        self._open.on_click(lambda _: self._on_open())
        self._listed: tuple[Recording, ...] = ()
        self._parts: list[Any] = []
        panel.dock_left()
        panel.set_width(_LEFT)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.flush()
        stop(self._server)

    @property
    def address(self) -> str:
        """URL of the page."""
        return address_of(self._server)

    @property
    def port(self) -> int:
        """Port of the page."""
        return int(self._server.get_port())

    def say(self, text: str, colour: str) -> None:
        """Show a line at the top; one that says ready is hidden while another graph runs."""
        word = {RED: "failed", GREEN: "ready", ORANGE: "wait"}.get(colour, "")
        self._ready = colour == GREEN
        self._said = line(colour, word, html.escape(text))
        self._show_state()

    def _show_state(self) -> None:
        lines = [line(ORANGE, "wait", _RUNS)] if self._runs else []
        self._set(self._state, block(lines if self._runs and self._ready else [self._said, *lines]))

    def draw_recordings(self, recordings: Sequence[Recording]) -> None:
        """Show the recordings, those that can be played with a button."""
        if tuple(recordings) == self._listed:
            return
        self._listed = tuple(recordings)
        gui = self._server.gui
        with self._server.atomic(), self._recordings:
            for part in self._parts:
                part.remove()
            self._parts = []
            for each in self._listed:
                name = html.escape(each.path.name)
                said = f"<b>{name}</b> {html.escape(each.where)}: {_whole_options(each.content)}"
                self._parts.append(gui.add_divider())
                if each.refusal:
                    self._parts.append(gui.add_html(block([line(GREY, "", f"{said}. {_whole_options(each.refusal)}")])))
                    continue
                self._parts.append(gui.add_html(block([said])))
                button: Any = gui.add_button(f"play {each.path.name}")
                button.on_click(lambda _, path=each.path: self._choose(self._choice(path)))
                self._parts.append(button)
            if not self._listed:
                self._parts.append(gui.add_html(block([line(ORANGE, "none", "no recordings here")])))

    def draw_domain(self, sensors: str, nodes: Sequence[str], runs: bool, absent: str) -> None:
        """Show what is in the ROS domain.

        Args:
            sensors: publishing sensors, in words; empty for none.
            nodes: their names.
            runs: whether a graph runs already.
            absent: text if no sensor publishes.
        """
        words = line(GREEN, "publish", html.escape(sensors)) if sensors else line(ORANGE, "none", html.escape(absent))
        self._set(self._sensors, block([words]))
        if self._start.visible != bool(sensors and not runs):
            self._start.visible = bool(sensors and not runs)
        self._runs = runs
        self._show_state()
        lines = [html.escape(name) for name in nodes] or ["none"]
        self._set(self._nodes, block([f"<div>{each}</div>" for each in lines]))

    @staticmethod
    def _set(part: Any, content: str) -> None:
        if part.content != content:
            part.content = content

    def _choice(self, bag: Path | None) -> Choice:
        return Choice(bag, bool(self._loop.value), str(self._filter.value), str(self._convention.value))

    def _on_open(self) -> None:
        if path := self._path.value.strip():
            self._choose(self._choice(Path(path).expanduser()))
        else:
            self.say("Write the path of a recording into the field above the button first.", RED)


def _whole_options(text: str) -> str:
    """A text in HTML whose options are not broken at a hyphen."""
    return re.sub(r"--[a-z-]+", r"<span style='white-space:nowrap'>\g<0></span>", html.escape(text))
