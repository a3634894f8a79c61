"""Every control of the page in a real browser, at the size of a laptop and of a tablet: from the start page to a
recording and back, with live sensors, one of which is lost, and after the graph's end.

With ``BODY_TRACKING_SCREENSHOTS=docs/images`` it writes the pictures of the documentation there.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from browser import Browser, browsing, need_chromium  # noqa: E402
from rcl_interfaces.srv import GetParameters  # noqa: E402
from running import BAG, Running, stop  # noqa: E402

from body_tracking.core.skeleton import Joint  # noqa: E402
from body_tracking.viewing.page import LAYERS  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # the browser draws in software, on all processors
LAPTOP, TABLET = (1280, 720), (1024, 768)
CONTROLS = ("button", "input", "[role=slider]")
SLOWLY = "viewer: {ros__parameters: {rate: 2.0, plot_rate: 1.0}}\n"
"""For a browser that draws in software."""
NODES = {
    "names": "/filtered/names/",  # before the filtered skeleton is hidden
    "sensors": "/sensors/kinect1/skeleton/joints",
    "frustums": "/sensors/kinect1/view",
    "fused": "/fused/joints",
    "filtered": "/filtered/joints",
    "body": "/body/limbs",
    "uncertainty": "/uncertainty",
    "floor": "/floor",
    "frames": "/segments",  # those of ekf
}
"""The nodes of each layer in the scene."""


@pytest.fixture
def start_page(tmp_path: Path) -> Iterator[Browser]:
    """``body_tracking view`` in a folder with one recording, and a browser that shows its page."""
    need_chromium()
    (tmp_path / "mine").symlink_to(BAG)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "broken_0.mcap").write_bytes(b"nothing")
    (tmp_path / "slowly.yaml").write_text(SLOWLY)
    with Running(tmp_path) as running:
        words = ("view", "--params-file", tmp_path / "slowly.yaml", "--log-dir", tmp_path / "log")
        running.start_module("view", "body_tracking.cli", *words, folder=tmp_path)
        with browsing(running, tmp_path, LAPTOP, 0.5, "view") as page:
            yield Browser(running, page, [], "view")


def at_both_sizes(browser: Browser) -> None:
    """All controls can be reached on a laptop and on a tablet."""
    for width, height in (TABLET, LAPTOP):
        browser.page.set_viewport_size({"width": width, "height": height})
        browser.page.wait_for_timeout(1e3)
        assert browser.out_of_reach(*CONTROLS) == [], (width, height)


def choose(browser: Browser, label: str, option: str) -> None:
    """Choose from a list."""
    field = browser.page.get_by_label(label, exact=True).first
    field.dispatch_event("click")
    browser.page.get_by_role("option", name=option, exact=True).first.dispatch_event("click")


def toggle(browser: Browser, layer: str) -> None:
    """Click on a layer's box for the first time, and wait until the scene follows.

    Of clicks that come within 50 ms of one before, or longer if the page is busy, viser sends only the last.
    """
    label, shown = LAYERS[layer]
    box = browser.page.get_by_label(label, exact=True)
    assert box.is_checked() == shown, layer
    browser.until(lambda: browser.shows(NODES[layer]) == shown, f"{layer}, before the click: {shown}")
    box.dispatch_event("click")
    browser.until(lambda: browser.shows(NODES[layer]) != shown, f"{layer}, after the click: {not shown}")


def test_from_the_start_page_to_a_recording_and_back(start_page: Browser) -> None:
    browser, page = start_page, start_page.page
    browser.reads("no sensor publishes in ROS domain")
    browser.reads(r"mine\s+in this folder: 15\.4 s, sensors kinect1, kinect2\s+play mine")
    browser.reads("broken in this folder: cannot be read")
    browser.reads("play camera_reaching")
    browser.reads("play markers_arm")
    at_both_sizes(browser)
    page.get_by_text("in this folder: 15.4 s").scroll_into_view_if_needed()
    browser.save("viewer_start.png")
    field = page.locator("xpath=//label[.='path']/following::input[1]")
    field.fill("nowhere")
    field.press("Enter")
    browser.press("play the recording at this path")
    browser.reads("failed.*nowhere")

    page.get_by_label("loop").dispatch_event("click")
    browser.press("play mine")
    browser.reads(r"playing mine, [\d.]+ of 15\.4 s, again and again")
    browser.reads(r"calibrated: kinect2 to [\d.]+ degrees and \d+ mm")
    browser.reads(r"fusion\s+\d+ Hz\s+[\d.]+ ms\s+[\d.]+ ms")
    at_both_sizes(browser)

    for button, answer in {
        "pause": "paused at",
        "resume": "playing at",
        "record": "recording into",
        "stop": "messages in",
        "reset": "calibration: reset",
        "calibrate": "calibration: calibrate",
    }.items():
        browser.press(button)
        assert "waits for an answer" not in browser.answer(answer)
        if button == "record":
            browser.reads(r"REC recording into \S*body_tracking_\d+\S*, \d+ messages")
    choose(browser, "show", "left arm")
    browser.until(lambda: page.locator("input[value^='left']").count() >= 3, "the curves of the left arm")
    assert page.locator("xpath=//label[.='person']/following::input[1]").input_value() == "body1"
    page.get_by_role("slider").first.press("Home")
    browser.answer("plays on from 0.0 s")

    page.get_by_text("Show", exact=True).first.dispatch_event("click")
    assert NODES.keys() == LAYERS.keys()
    for layer in NODES:
        if layer == "frames":  # of a filter on a body model
            assert not page.get_by_label(LAYERS[layer][0], exact=True).count()
        else:
            toggle(browser, layer)
    at_both_sizes(browser)

    choose(browser, "filter", "ekf")
    browser.answer("ekf, with angles model")
    toggle(browser, "frames")
    choose(browser, "angles", "isb")
    browser.answer("angles isb")

    page.get_by_label("loop").dispatch_event("click")
    browser.answer("ends at its end")
    browser.reads(r"at the end mine, 15\.\d of 15\.4 s: time plays it again from any place, end leads back to the list")
    assert page.locator("input[value^='left']").count() >= 3  # the curves stay
    page.get_by_role("slider").first.press("Home")
    browser.answer("plays on from 0.0 s")
    browser.reads(r"playing mine, [\d.]+ of 15\.4 s")

    browser.press("end")
    texts: list[str] = []

    def listed() -> bool:
        texts.append(browser.text())
        return "mine has ended; choose again" in texts[-1]

    browser.until(listed, "the list")
    page.wait_for_timeout(3e3)
    texts.append(browser.text())
    assert not [each for each in texts if "nothing here answers" in each or "runs already" in each]
    browser.reads("play body_tracking_")  # what was recorded meanwhile, in the folder of the command
    at_both_sizes(browser)
    assert stop(browser.running.processes.pop("view")) == 0


def test_the_filter_of_the_start_page_and_a_click_on_a_joint(start_page: Browser) -> None:
    browser, page = start_page, start_page.page
    browser.reads("play mine")
    page.get_by_label("loop").dispatch_event("click")  # a busy machine may miss the right seconds once
    choose(browser, "filter", "lkf_zero_velocity")
    browser.press("play mine")
    browser.reads(r"playing mine, [4-9][\d.]+ of 15\.4 s, again")  # the person stands, the arms are up
    field = page.locator("xpath=//label[.='filter']/following::input[1]")
    browser.until(lambda: field.input_value() == "lkf_zero_velocity", "the chosen filter")
    name = GetParameters.Request(names=["filter"])
    (running_filter,) = browser.running.call(GetParameters, "/skeleton_filter/get_parameters", name).values
    assert running_filter.string_value == "lkf_zero_velocity"

    browser.press("pause")
    browser.answer("paused at")
    browser.close_notes()
    page.wait_for_timeout(2e3)  # until the last frame is drawn
    # beyond the origin, which is at the reference sensor, and with no other joint near
    for shown in (True, False):
        browser.click("/filtered/joints", Joint.KNEE_LEFT)
        browser.until(lambda shown=shown: ("left knee" in browser.labels()) == shown, f"the knee's name: {shown}")


def test_live_sensors_one_of_which_is_lost(start_page: Browser) -> None:
    browser, page, running = start_page, start_page.page, start_page.running
    for sensor in ("kinect1", "kinect2"):
        given = {"sensor": sensor, "file": BAG, "loop": True, "start_time": 1.0}
        running.start("kinect_skeleton", f"{sensor}_skeleton", **given)
    browser.reads(r"publish sensors kinect1, kinect2")
    browser.reads("/kinect1_skeleton")
    browser.press("start with these sensors")
    browser.reads(r"sensors kinect1 \d+ Hz, kinect2 \d+ Hz")
    assert not page.get_by_role("button", name="pause", exact=True).count()  # there is no bag
    browser.reads("waiting for a still pose|calibrated")
    at_both_sizes(browser)
    browser.press("record")
    browser.answer("recording into")
    browser.reads("REC recording into")
    browser.press("stop")
    browser.answer("messages in")

    assert stop(running.processes.pop("kinect2_skeleton")) == 0
    browser.reads(r"Nothing comes from kinect2: look at cable")
    browser.save("viewer_lost.png", 170)
    assert stop(running.processes.pop("kinect1_skeleton")) == 0
    browser.reads(r"Nothing comes from kinect1 and kinect2")

    running.processes["view"].send_signal(signal.SIGINT)
    browser.reads("ended The graph has ended; the list of recordings comes back")
    assert not page.get_by_role("button", name=re.compile("^(end|record|calibrate)$")).count()
