"""The state of the graph in words: the played bag, the recording, advice for the calibration, and the end."""

from __future__ import annotations

from body_tracking.messages.node_status import NodeStatus
from body_tracking.viewing.state import GREY, ORANGE, RED, state_html
from body_tracking.viewing.status import FRESH

PLAYER = {"bag": "/data/walk<1>", "position s": "3.21", "duration s": "20.0", "loop": "True"}
KNOWN = {"kinect2 rotation_stddev_deg": "1.25", "kinect2 translation_stddev_mm": "8.4"}


def said(node: str, text: str, values: dict[str, str], level: int = 0, now: float = 0.0) -> str:
    return state_html({node: NodeStatus(f"{node}: stream", level, text, values)}, now)


def test_it_says_which_bag_plays_and_where() -> None:
    text = said("bag_player", "playing", PLAYER)
    assert "walk&lt;1&gt;</b>, 3.2 of 20.0 s, again and again" in text
    assert "paused" in said("bag_player", "paused", PLAYER)


def test_a_recording_has_a_sign_and_the_name_of_its_folder() -> None:
    text = said("bag_recorder", "recording", {"bag": "session", "messages": "120"})
    assert "REC" in text and "recording into session</b>, 120 messages" in text
    assert "REC" not in said("bag_recorder", "stopped", {"bag": "session", "messages": "120"})


def test_the_calibration_says_how_well_and_what_to_do_next() -> None:
    waiting = said("calibration", "waiting for a still pose seen by a and b", {}, level=1)
    assert "T-pose" in waiting
    rough = said("calibration", "kinect2: roughly calibrated, walk about to refine", KNOWN, level=1)
    assert "kinect2 to 1.2 degrees and 8 mm" in rough and "walk about and turn" in rough
    assert "done" in said("calibration", "calibrated", KNOWN)


def test_the_rate_of_each_sensor_is_there_but_of_no_estimate() -> None:
    rates = {"rate in /lab/kinect1/skeleton": "29.6", "rate in /fused/skeleton": "30.0"}
    text = said("fusion", "OK", rates)
    assert "kinect1 30 Hz" in text and "fused" not in text


def test_a_sensor_that_sends_nothing_is_named() -> None:
    rates = {"rate in /a/skeleton": "0.0", "rate in /b/skeleton": "30.0"}
    fusion = {"fusion": NodeStatus("fusion: stream", 0, "OK", rates)}
    assert "Nothing comes from a</b>" in state_html(fusion, 0.0)
    assert "Nothing comes from a and c</b>" in state_html(fusion, 0.0, sensors=("a", "b", "c"))
    paused = {**fusion, "bag_player": NodeStatus("bag_player: stream", 0, "paused", PLAYER)}
    assert "Nothing comes" not in state_html(paused, 0.0, sensors=("a", "b", "c"))


def test_a_recording_that_has_not_begun_is_no_fault() -> None:
    rates = {"rate in /a/skeleton": "0.0", "rate in /b/skeleton": "0.0"}
    fusion = {"fusion": NodeStatus("fusion: stream", 0, "OK", rates)}
    text = state_html(fusion, 0.0, sensors=("a", "b"), plays=True)
    assert "the recording starts once all nodes have started" in text and "Nothing comes" not in text
    begun, later = (
        NodeStatus("bag_player: stream", 0, "playing", {**PLAYER, "position s": at}) for at in ("0.4", "5.0")
    )
    assert "a, b: the recording starts" in state_html({**fusion, "bag_player": begun}, 0.0, plays=True)
    text = state_html({**fusion, "bag_player": later}, 0.0, plays=True)
    assert "Nothing comes from a and b" in text and "cable" not in text


def test_a_paused_bag_is_no_fault() -> None:
    rates = {"rate in /a/skeleton": "0.0", "rate in /b/skeleton": "0.0"}
    there = {
        "fusion": NodeStatus("fusion: stream", 0, "OK", rates),
        "bag_player": NodeStatus("bag_player: stream", 0, "paused", PLAYER),
    }
    text = state_html(there, 0.0)
    assert "a, b: paused" in text and "0 Hz" not in text
    assert ORANGE not in text and text.count(GREY) == 2


def test_at_the_end_of_a_recording_the_page_says_how_to_go_on() -> None:
    at_end = {"bag_player": NodeStatus("bag_player: stream", 0, "at the end", PLAYER)}
    assert "leads back to the list" in state_html(at_end, 0.0, start_page=True)
    assert "leads back" not in state_html(at_end, 0.0)


def test_the_end_and_the_next_step_are_shown() -> None:
    running = {"fusion": NodeStatus("fusion: stream", 0, "OK", {}, 10.0)}
    assert "has ended" not in state_html(running, 10.5)
    assert "has ended" in state_html(running, 10.5, ended=True)
    assert "body_tracking up --viewer" in state_html(running, 11.0 + FRESH)  # all nodes are silent
    assert "list of recordings comes back" in (text := state_html(running, 10.5, ended=True, start_page=True))
    assert RED not in text and "--viewer" not in text
    assert "no node has reported yet" in state_html({}, 0.0)
