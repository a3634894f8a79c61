"""Cameras in a real browser: their images with the people drawn in are taken only while they are shown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from browser import PATIENCE, Browser, browsing, need_chromium, pixels_where  # noqa: E402
from running import RELIABLE, Running  # noqa: E402
from sensor_msgs.msg import CompressedImage  # noqa: E402

from body_tracking.camera.codecs import CompressedColour  # noqa: E402
from body_tracking.camera.topics import people_topic  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_WIRE  # noqa: E402

pytestmark = pytest.mark.alone  # the browser draws in software, on all processors

ORANGE = pixels_where("high - low > 150")


def test_a_browser_shows_the_images_of_a_camera_while_they_are_switched_on(tmp_path: Path) -> None:
    need_chromium()
    picture = np.full((240, 320, 3), 128, np.uint8)
    picture[:120] = [255, 140, 0]
    with Running(tmp_path) as running:
        images = running.node.create_publisher(CompressedImage, people_topic("camera1"), RELIABLE)
        running.start("viewer", port=0, rate=5.0, sensors="['camera1']", camera="['camera1']")
        stamp_ns = 0
        with browsing(running, tmp_path, (900, 560), 0.4) as page:
            browser = Browser(running, page, [])

            def shown() -> bool:
                nonlocal stamp_ns
                stamp_ns += 100_000_000
                images.publish(CompressedColour().encode((stamp_ns, "camera1", picture), BAG_WIRE))
                return any(0.4 < share < 0.6 for _, share in page.evaluate(ORANGE))

            browser.until(shown, "the picture on the page")
            taken: Any = images.get_subscription_count
            assert taken() == 1
            page.get_by_label("camera images").dispatch_event("click")
            browser.until(lambda: taken() == 0, "no more images to be taken")
        assert running.until(lambda: taken() == 0, PATIENCE)
