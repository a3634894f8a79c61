"""The marker system in a real browser: points, targets and the cameras' images are those of the messages."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from browser import PATIENCE, Browser, browsing, need_chromium, pixels_where  # noqa: E402
from running import RELIABLE, ROOT, Running  # noqa: E402

from body_tracking.core.parameters import check_all  # noqa: E402
from body_tracking.markers import setup  # noqa: E402
from body_tracking.markers.chain_files import load_chain  # noqa: E402
from body_tracking.markers.codecs import PoseOfTarget, SpacePoints  # noqa: E402
from body_tracking.markers.overlay import chain_places  # noqa: E402
from body_tracking.markers.stages import (  # noqa: E402
    AnglesOfTargetsStage,
    DetectorStage,
    TrackerStage,
    TriangulationStage,
)
from body_tracking.messages.cdr import stamp_of  # noqa: E402
from body_tracking.pipeline.offline import OfflineRunner  # noqa: E402
from body_tracking.pipeline.stage import Stage  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader  # noqa: E402
from body_tracking.ros.bag_topics import message_class  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # the browser draws in software, on all processors

BAG, LAB = ROOT / "bags" / "markers_arm", ROOT / "config" / "marker_setup"
STAGES = (DetectorStage, TriangulationStage, TrackerStage, AnglesOfTargetsStage)
PAIRS = 5
SHOWN = """name => window.__viserSceneTree?.getState()[name]?.effectiveVisibility"""
LINES = """() => {
  const points = window.__viserSceneTree?.getState()["/markers/chain/lines"]?.message.props.points;
  return points ? Array.from(new Float32Array(points.buffer, points.byteOffset, points.byteLength / 4)) : null;
}"""
COLOURED = pixels_where("high - low > 40")


def messages(stages: list[Stage]) -> list[dict[str, bytes]]:
    """The nodes' messages for the first pairs of images of the shipped recording, by time and topic."""
    frames: dict[int, dict[str, bytes]] = {}

    def keep(topic: str, cdr: bytes, at_ns: int) -> None:
        frames.setdefault(stamp_of(cdr), {})[topic] = cdr

    runner = OfflineRunner(stages, BAG_WIRE, keep)
    with BagReader(BAG) as bag:
        images = [setup.image_topic(camera) for camera in setup.camera_names(LAB)]
        for raw in itertools.islice(bag.messages(images), 2 * PAIRS):
            keep(raw.topic, raw.cdr, raw.log_time_ns)
            runner.push(raw.topic, raw.cdr, raw.log_time_ns)
        runner.finish(raw.log_time_ns)
    return [frames[stamp_ns] for stamp_ns in sorted(frames)]


def test_a_browser_shows_balls_points_and_targets(tmp_path: Path) -> None:
    need_chromium()
    stages: list[Stage] = [stage(check_all(stage.PARAMETERS, {"setup": str(LAB)})) for stage in STAGES]
    frames, chain = messages(stages), load_chain(LAB / setup.CHAIN)
    types = {port.topic: port.codec.type_name for stage in stages for port in (*stage.inputs, *stage.outputs)}
    with Running(tmp_path) as running:
        node = running.node
        publishers = {
            topic: node.create_publisher(message_class(types[topic]), topic, RELIABLE)
            for topic in {topic for frame in frames for topic in frame}
        }
        running.start("viewer", port=0, rate=5.0, sensors="['']", marker_setup=LAB)
        image = publishers[setup.image_topic("left")]
        endless = itertools.cycle(frames)
        with browsing(running, tmp_path, (900, 560), 0.4) as page:
            browser = Browser(running, page, [])

            def publish() -> bool:
                for topic, cdr in next(endless).items():
                    publishers[topic].publish(cdr)
                return True

            def drawn() -> Any:
                """Whether one of the published sets of points is drawn."""
                publish()
                points = browser.joints("/markers/points")
                sent = [SpacePoints().decode(frame[setup.POINTS], BAG_WIRE).positions for frame in frames]
                return points is not None and any(np.allclose(points[: len(s)], s, atol=1e-6) for s in sent if len(s))

            browser.until(drawn, "the points as they were published")
            # The chain runs from target to target, at the poses of one time.
            posed = [
                [PoseOfTarget(name).decode(frame[setup.pose_topic(name)], BAG_WIRE) for name in chain.targets]
                for frame in frames
                if all(setup.pose_topic(name) in frame for name in chain.targets)
            ]
            expected = [chain_places(chain, poses)[1].reshape(-1, 3) for poses in posed]

            def placed() -> bool:
                publish()
                numbers = page.evaluate(LINES)
                found = None if numbers is None else np.array(numbers).reshape(-1, 3)
                return found is not None and any(np.allclose(found, each, atol=1e-6) for each in expected)

            browser.until(placed, "the chain at the poses of one time")

            def shown() -> bool:
                publish()
                return all(page.evaluate(SHOWN, f"/markers/targets/{name}") for name in chain.targets)

            browser.until(shown, "all targets")

            def coloured() -> bool:
                publish()
                return sum(count > 100 for count, _ in page.evaluate(COLOURED)) == 2

            browser.until(coloured, "two images with circles in the colours of targets")
            # The images are taken only while they are shown.
            assert image.get_subscription_count() == 1
            page.get_by_label("images of cameras").dispatch_event("click")
            browser.until(lambda: image.get_subscription_count() == 0, "no more images to be taken")
            assert publishers[setup.pose_topic("forearm")].get_subscription_count() == 1
        assert running.until(lambda: publishers[setup.pose_topic("forearm")].get_subscription_count() == 0, PATIENCE)
