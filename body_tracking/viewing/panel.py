"""The controls of the page: state of the graph, buttons, the bag's place, and choices."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final

import viser

from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.messages.node_status import NodeStatus
from body_tracking.pipeline.graph import END
from body_tracking.viewing.handles import show
from body_tracking.viewing.plots import NONE
from body_tracking.viewing.snapshot import Controls, PageError
from body_tracking.viewing.state import CALIBRATION, PLAYER, RECORDER, fresh, state_html

BUTTONS: Final[Mapping[str, tuple[str, Mapping[str, str]]]] = {
    "calibration": (CALIBRATION, {"calibrate": "calibration/start", "reset": "calibration/reset"}),
    "recording": (RECORDER, {"record": "recorder/start", "stop": "recorder/stop"}),
    "bag": (PLAYER, {"pause": "bag_player/pause", "resume": "bag_player/resume"}),
}
"""Groups of buttons: the node that answers, and the service that each button calls."""

_REST_S: Final = 0.4
"""Seconds for which the slider must rest before the bag goes there."""


class ControlPanel:
    """Creates the controls, and shows those of nodes that report.

    Args:
        server: of the page.
        controls: called when a user presses a button or chooses an option.
        filters: options.
        conventions: options.
        sensors: names of the sensors of skeletons.
        start_page: whether the start page returns at this address when the graph ends.
        plays: whether a bag takes the place of the sensors.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        controls: Controls,
        filters: Sequence[str],
        conventions: Sequence[str],
        sensors: Sequence[str] = (),
        start_page: bool = False,
        plays: bool = False,
    ) -> None:
        self._server, self._controls, self._sensors = server, controls, tuple(sensors)
        self._start_page, self._plays = start_page, plays
        gui = server.gui
        self._groups: dict[str, list[Any]] = {}
        with gui.add_folder("Control"):
            for label, (node, services) in BUTTONS.items():
                self._groups.setdefault(node, []).append(self._buttons(label, services))
            self._end = self._buttons("graph", {"end": END})
            self._place: Any = gui.add_slider("time [s]", 0.0, 1.0, 0.1, 0.0, visible=False)
            self._loop: Any = gui.add_checkbox("loop", False, visible=False)
            self._groups[PLAYER] += [self._place, self._loop]
            self._filter = self._choice("filter", filters, self._controls.choose_filter)
            self._convention = self._choice("angles", conventions, self._controls.choose_convention)
            self._body = self._choice("person", (NONE,), self._controls.choose_body)
            self._groups["skeleton_filter"], self._groups["joint_angles"] = [self._filter], [self._convention]
        # Below the buttons: its number of lines changes, and must not move a button under the mouse.
        self._state = gui.add_html(state_html({}, 0.0))
        self._running: dict[str, str] = {}
        """Last reported filter, convention and loop state, by node."""
        # For the server's event loop: only reports after this steady time move the slider.
        self._follows_from, self._resting = -math.inf, threading.Timer(0.0, lambda: None)
        self._place.on_update(self._on_place)
        self._loop.on_update(self._on_loop)

    def draw(self, statuses: Mapping[str, NodeStatus], now: float, ended: bool) -> None:
        """Show the state of the graph, the controls of its nodes and the current choices."""
        self._state.content = state_html(statuses, now, ended, self._sensors, self._start_page, self._plays)
        show(self._end, not ended and self._controls.offers(END))
        there = {} if ended else fresh(statuses, now)
        for node, controls in self._groups.items():
            for each in controls:
                show(each, node in there)
        for node, dropdown in (("skeleton_filter", self._filter), ("joint_angles", self._convention)):
            running = there[node].text.partition(" ")[0] if node in there else ""
            # Only a change: until the node has taken a user's choice, it reports the previous one.
            if running in dropdown.options and running != self._running.get(node):
                dropdown.value = running
                self._running[node] = running
        if (player := there.get(PLAYER)) is not None:
            self._follow(player)

    def _follow(self, player: NodeStatus) -> None:
        """Move the slider to the bag's place, unless the user has moved it and the bag is not yet there."""
        length, place = player.number("duration s") or 0.0, player.number("position s") or 0.0
        last = max(0.1, int(10.0 * length) / 10.0)  # not after the last message
        if self._place.max != last:
            self._place.max = last
        shown = min(max(0.0, round(place, 1)), last)
        self._server.get_event_loop().call_soon_threadsafe(self._show_place, shown, player.received)
        loops = player.values.get("loop", "")
        if loops != self._running.get(PLAYER):
            self._loop.value, self._running[PLAYER] = loops == "True", loops

    def _show_place(self, place: float, reported: float) -> None:
        """Runs in the server's event loop like :meth:`_on_place`, so that a move is read before it is overwritten."""
        if reported > self._follows_from:
            self._place.value = place

    def draw_bodies(self, bodies: Sequence[str], chosen: str) -> None:
        """Update the list of persons with angles."""
        options = tuple(bodies) or (NONE,)
        if self._body.options != options:
            self._body.options = options
        if chosen in options and self._body.value != chosen:
            self._body.value = chosen

    async def _on_place(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # by _show_place
            return
        self._follows_from = math.inf  # until the bag is there
        self._resting.cancel()
        self._resting = threading.Timer(_REST_S, self._seek, (float(self._place.value),))
        self._resting.daemon = True
        self._resting.start()

    def _seek(self, place: float) -> None:
        self._answer("bag: time", lambda: self._controls.seek(place))
        self._server.get_event_loop().call_soon_threadsafe(self._on_sought, threading.current_thread())

    def _on_sought(self, resting: threading.Thread) -> None:
        if resting is self._resting:  # no move since
            self._follows_from = time.monotonic()

    def _on_loop(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            wanted = bool(self._loop.value)
            if not self._answer("bag: loop", lambda: self._controls.loop(wanted)):
                self._running.clear()

    def _buttons(self, label: str, services: Mapping[str, str]) -> Any:
        buttons = self._server.gui.add_button_group(label, tuple(services), visible=False)

        @buttons.on_click
        def _(event: viser.GuiEvent[Any]) -> None:
            pressed = buttons.value
            self._answer(f"{label}: {pressed:.40}", lambda: self._controls.call(services[checked(pressed, services)]))

        return buttons

    def _choice(self, label: str, options: Sequence[str], choose: Callable[[str], str]) -> Any:
        dropdown = self._server.gui.add_dropdown(label, tuple(options))

        @dropdown.on_update
        def _(event: viser.GuiEvent[Any]) -> None:
            if event.client is not None:  # None for updates by draw and draw_bodies
                chosen = dropdown.value
                if not self._answer(label, lambda: choose(checked(chosen, dropdown.options))):
                    self._running.clear()  # so that the lists show again what runs

        return dropdown

    def _answer(self, what: str, ask: Callable[[], str]) -> bool:
        """Show all clients the request, and then its answer or the reason of its refusal; False if it was refused."""
        clients = self._server.get_clients().values()
        notes = [client.add_notification(what, "waits for an answer", loading=True) for client in clients]
        try:
            text, refused = ask(), False
        except BodyTrackingError as error:
            text, refused = str(error), True
        for note in notes:
            note.body, note.color = text, "red" if refused else "teal"
            note.loading, note.auto_close_seconds = False, 8.0
        return not refused


def checked(chosen: str, options: Collection[str]) -> str:
    """The choice, which comes from a browser; PageError where it is none of the options."""
    if chosen not in options:
        raise PageError(f"{chosen!r:.40}, {one_of(chosen[:40], options)}")
    return chosen
