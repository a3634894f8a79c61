"""The state of the graph in words, from the nodes' diagnostics: playback, recording and calibration."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from body_tracking.calibration.advice import next_step, quality
from body_tracking.messages.node_status import NodeStatus
from body_tracking.viewing.status import FRESH

PLAYER, RECORDER, CALIBRATION = "bag_player", "bag_recorder", "calibration"
RED, GREEN, ORANGE, GREY = "#e03131", "#2f9e44", "#f08c00", "#868e96"
_ENDED: Final = (
    "The graph has ended; nothing here answers any more. Start it again, and this page comes back by itself: "
    "<code>body_tracking up --viewer</code>, or with <code>--bag BAG</code> to play a recording."
)
_RETURNS: Final = (
    "The graph has ended; the list of recordings comes back here in some seconds. If it does not, "
    "<code>body_tracking view</code> has ended too: start it again."
)

_STARTED_S: Final = 3.0
"""Seconds of a bag after which each of its sensors has been heard and reported."""
_NOTHING: Final = (
    "look at cable and program, and whether it publishes in this ROS domain (<code>body_tracking doctor</code>)"
)


def fresh(statuses: Mapping[str, NodeStatus], now: float) -> dict[str, NodeStatus]:
    """The nodes that have reported within :data:`FRESH`."""
    return {name: status for name, status in statuses.items() if now - status.received <= FRESH}


def state_html(
    statuses: Mapping[str, NodeStatus],
    now: float,
    ended: bool = False,
    sensors: Sequence[str] = (),
    start_page: bool = False,
    plays: bool = False,
) -> str:
    """The state as HTML.

    Args:
        statuses: by node name.
        now: steady time, seconds.
        ended: the graph has ended.
        sensors: names of the sensors of skeletons.
        start_page: whether the start page returns at this address when the graph ends.
        plays: whether a bag takes the place of the sensors.
    """
    there = {} if ended else fresh(statuses, now)
    if ended or (statuses and not there):
        return block([line(GREY, "ended", _RETURNS) if start_page else line(RED, "ended", _ENDED)])
    if not there:
        return block([line(ORANGE, "waiting", "no node has reported yet")])
    if plays and PLAYER not in there:
        return block([line(GREY, "waiting", "the recording starts once all nodes have started")])
    lines = [*_input(there, sensors, start_page), _calibration(there), _recording(there)]
    return block([each for each in lines if each])


def _input(there: Mapping[str, NodeStatus], sensors: Sequence[str], start_page: bool) -> list[str]:
    """The bag, and the rate of each sensor while it plays; with a bag only of the sensors in diagnostics."""
    lines = []
    if (player := there.get(PLAYER)) is not None:
        bag = Path(player.values.get("bag", "")).name
        position, duration = player.number("position s") or 0.0, player.number("duration s") or 0.0
        then = ", again and again" if player.values.get("loop") == "True" else ""
        if start_page and player.text == "at the end":
            then = ": <i>time</i> plays it again from any place, <i>end</i> leads back to the list"
        words = f"<b>{html.escape(bag)}</b>, {position:.1f} of {duration:.1f} s{then}"
        colour = {"playing": GREEN, "paused": GREY, "at the end": GREY}.get(player.text, ORANGE)
        lines.append(line(colour, html.escape(player.text), words))
    rates: dict[str, float] = {} if PLAYER in there else dict.fromkeys(sensors, 0.0)
    for status in there.values():
        for key in status.values:
            if key.startswith("rate in ") and key.endswith("/skeleton"):
                sensor = key.removeprefix("rate in ").split("/")[-2]
                rate = status.number(key) or 0.0
                if sensor not in ("fused", "filtered"):
                    rates[sensor] = max(rate, rates.get(sensor, 0.0))
    if rates and player is not None and player.text != "playing":
        lines.append(line(GREY, "sensors", f"{', '.join(map(html.escape, sorted(rates)))}: {html.escape(player.text)}"))
    elif rates and player is not None and not any(rates.values()) and position < _STARTED_S:
        lines.append(line(GREY, "sensors", f"{', '.join(map(html.escape, sorted(rates)))}: the recording starts"))
    elif rates:
        words = ", ".join(f"{html.escape(sensor)} {rate:.0f} Hz" for sensor, rate in sorted(rates.items()))
        silent = [html.escape(sensor) for sensor, rate in sorted(rates.items()) if not rate]
        if silent:
            words += f". <b>Nothing comes from {' and '.join(silent)}</b>"
            words += ": the recording has nothing of it at this time" if player is not None else f": {_NOTHING}"
        lines.append(line(ORANGE if silent else GREEN, "sensors", words))
    return lines


def _calibration(there: Mapping[str, NodeStatus]) -> str:
    """The standard deviations of each sensor's pose, and the next step for the user."""
    status = there.get(CALIBRATION)
    if status is None:
        return ""
    known, todo = quality(status), next_step(status)
    if known and not status.level:
        todo = "done; start again after a sensor has moved"
    text = f"{status.text}{': ' if known else ''}{known}{f' ({todo})' if todo else ''}"
    return line(ORANGE if status.level else GREEN, "calibration", html.escape(text))


def _recording(there: Mapping[str, NodeStatus]) -> str:
    """Whether a recording runs, and the name of its folder."""
    status = there.get(RECORDER)
    if status is None:
        return ""
    folder, messages = status.values.get("bag", ""), status.number("messages") or 0.0
    if status.text == "recording":
        where = html.escape(folder) if folder not in ("", "None") else "a new folder"
        return line(RED, "REC", f"<b>recording into {where}</b>, {messages:.0f} messages")
    return line(RED if status.level == 2 else GREY, "recording", html.escape(status.text))


def line(colour: str, what: str, text: str) -> str:
    """A line of the page: a dot, a word in bold, and a text in HTML."""
    return f"<div><span style='color:{colour}'>&#9679; <b>{what}</b></span> {text}</div>"


def block(lines: list[str]) -> str:
    """Lines in small type."""
    return f"<div style='font-size:0.8em;line-height:1.35;padding:0.3em 0.6em'>{''.join(lines)}</div>"
