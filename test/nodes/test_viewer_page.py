"""The viewer in a real browser: it draws the graph's messages, and its buttons work.

With ``BODY_TRACKING_SCREENSHOTS=docs/images`` it writes a picture of the documentation there.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from browser import Browser, browsing, need_chromium  # noqa: E402
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from running import Running, stop  # noqa: E402
from scipy.spatial.distance import cdist  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402

from body_tracking.messages.skeletons import cloud_to_skeletons  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.recording.rosbag2 import BagReader  # noqa: E402
from body_tracking.viewing.shapes import figure  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # the browser draws in software, on all processors

BAG = Path(__file__).resolve().parent.parent.parent / "bags" / "tpose_torso_twist"
EVERY = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
CURVES = """() => Object.values(window.__viserTestpoints?.uplots ?? {})
  .map(plot => plot.chart.data.slice(0, 4).map(series => Array.from(series)))"""


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    """The whole graph over a bag that plays again and again, and a browser that shows it."""
    need_chromium()
    with Running(tmp_path) as running:
        running.start("bag_recorder", folder=tmp_path / "recorded", start_recording=False, use_sim_time=True)
        running.start("joint_angles", use_sim_time=True)
        running.start("skeleton_filter", use_sim_time=True)
        running.start("fusion", use_sim_time=True)
        running.start("calibration", use_sim_time=True)
        running.start("viewer", port=0, rate=5.0, use_sim_time=True)
        topics = "['/kinect1/skeleton', '/kinect2/skeleton']"
        waited = "['/kinect1/skeleton:3', '/kinect2/skeleton:3']"
        clouds = running.collect(PointCloud2, graph.FILTERED, EVERY)
        running.start("bag_player", bag=BAG, topics=topics, loop=True, clock_rate=20.0, wait_for_subscribers=waited)
        with browsing(running, tmp_path, (900, 560), 0.4) as page:
            listener = threading.Thread(target=_spin, args=(running.executor,), daemon=True)
            listener.start()
            yield Browser(running, page, clouds)
            running.executor.shutdown()
            listener.join(10.0)


def test_a_browser_shows_the_graph_and_its_buttons_work(browser: Browser, tmp_path: Path) -> None:
    running, page, clouds = browser.running, browser.page, browser.clouds

    # All joints of one of the messages are drawn, to the last digit of the float.
    def drawn() -> bool:
        joints = browser.joints("/filtered/joints")
        if joints is None or not len(clouds):
            return False
        sent = [figure(cloud_to_skeletons(cloud), (0, 0, 0)).joints for cloud in clouds[-1000:]]
        # a filter's skeleton without legs is drawn with those that a sensor sees
        return any(len(each) and cdist(each, joints).min(axis=1).max() < 1e-6 for each in sent)

    browser.until(drawn, "the filtered skeleton as it was published")
    first = browser.joints("/filtered/joints")
    browser.until(lambda: not np.allclose(browser.joints("/filtered/joints"), first, atol=1e-3), "it to move")
    for name in ("/sensors/kinect1/skeleton/joints", "/sensors/kinect2/skeleton/joints"):
        browser.until(lambda name=name: browser.joints(name) is not None, name)

    # Curves grow, and their bands enclose them.
    def curves() -> list[Any]:
        return [plot for plot in page.evaluate(CURVES) if len(plot[0]) > 20]

    browser.until(curves, "curves of joint angles")
    for times, values, low, high in curves():
        assert (np.diff(times) > 0.0).all() and times[-1] == 0.0
        assert (np.array(low) <= values).all() and (np.array(values) <= high).all()

    for label in ("left elbow flexion", "right shoulder elevation"):
        browser.until(lambda label=label: page.locator(f"input[value='{label}']").count(), label)
    browser.until(lambda: page.locator("input[value='elbows and shoulders']").count(), "the heading of the curves")

    # The page shows the nodes' reports, and the state in words.
    browser.until(lambda: re.search(r"playing tpose_torso_twist, [\d.]+ of", page.inner_text("body")), "the bag's name")
    browser.until(lambda: re.search(r"skeleton_filter\s+\d+ Hz", page.inner_text("body")), "rates of the nodes")

    # A paused bag stands still on the page, and moves again.
    browser.press("pause")
    assert "paused at" in browser.answer("bag: pause")
    still = [browser.picture()]

    def stands_still() -> bool:
        still.append(browser.picture())
        return still[-1] == still[-2]

    browser.until(stands_still, "two equal pictures of a paused bag")
    page.wait_for_timeout(1.5e3)  # what is paused does not become old
    assert browser.joints("/uncertainty") is None
    page.get_by_label("95 % ellipsoids").dispatch_event("click")
    browser.until(lambda: browser.joints("/uncertainty") is not None, "ellipsoids in a paused bag")
    still.append(browser.picture())
    browser.press("resume")
    browser.answer("bag: resume")
    browser.until(lambda: browser.picture() != still[-1], "the picture to move again")

    # Buttons.
    browser.press("calibrate")
    assert "calibration/start" not in browser.answer("calibration: calibrate")
    browser.until(lambda: "recording stopped" in browser.text(), "no recording")
    places = browser.places("calibrate", "record", "pause")
    browser.press("record")
    assert "recording into" in browser.answer("recording: record")
    recorded, before = "bag_recorder", len(clouds)
    browser.until(
        lambda: int(running.diagnostics.get(recorded, {}).get("messages", 0)) > 100 and len(clouds) > before + 20,
        "messages in the recording, twice as many filtered skeletons as are asked for",
    )
    browser.until(lambda: "REC recording into" in browser.text(), "the recording in words")
    assert browser.places("calibrate", "record", "pause") == places  # under a mouse that clicks twice
    browser.press("stop")
    assert "messages in" in browser.answer("recording: stop")
    with BagReader(tmp_path / "recorded") as reader:
        assert {graph.skeleton_topic("kinect1"), graph.FILTERED, graph.DIAGNOSTICS_TOPIC} <= set(reader.topics)
        assert sum(1 for _ in reader.messages([graph.FILTERED])) > 10

    # The bag goes where its slider is moved.
    def follows() -> bool:
        return float(running.diagnostics.get("bag_player", {}).get("position s", 0)) > 12.0

    browser.press("pause")
    browser.until(lambda: re.search(r"paused tpose_torso_twist", page.inner_text("body")), "a paused bag")
    page.get_by_role("slider").first.press("End")
    browser.answer("plays on from")
    browser.until(follows, "the bag at its end")

    # Services that no node offers are not on the page, and the end is reported.
    assert stop(running.processes.pop("bag_recorder")) == 0
    browser.until(lambda: not page.get_by_role("button", name="record", exact=True).count(), "no button without a node")
    assert stop(running.processes.pop("viewer")) == 0
    browser.until(lambda: "The graph has ended" in page.inner_text("body"), "the end in words")
    assert not page.get_by_role("button", name="calibrate", exact=True).count()
    browser.save("viewer_ended.png", 130)


def _spin(executor: SingleThreadedExecutor) -> None:
    with contextlib.suppress(ExternalShutdownException, ShutdownException):
        executor.spin()
