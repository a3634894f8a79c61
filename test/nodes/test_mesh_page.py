"""Depth cameras in a real browser: the mesh is that of the messages, and images are taken only while they are shown."""

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
from geometry_msgs.msg import TransformStamped  # noqa: E402
from running import LATCHED, RELIABLE, ROOT, Running  # noqa: E402

from body_tracking.core.parameters import check_all  # noqa: E402
from body_tracking.core.sensor_poses import level_pose  # noqa: E402
from body_tracking.mesh.codecs import MeshMarker  # noqa: E402
from body_tracking.mesh.stage import MeshStage  # noqa: E402
from body_tracking.mesh.topics import depth_topic, info_topic, mesh_sensor, mesh_topic  # noqa: E402
from body_tracking.messages.calibration import pose_to_transform  # noqa: E402
from body_tracking.messages.cdr import stamp_of  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.pipeline.offline import OfflineRunner  # noqa: E402
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagReader  # noqa: E402
from body_tracking.ros.bag_topics import message_class  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # the browser draws in software, on all processors

BAG, CAMERA = ROOT / "bags" / "mesh_reaching", "kinect1"
INFO, IMAGES, MESH, SKELETONS = (
    info_topic(CAMERA),
    depth_topic(CAMERA),
    mesh_topic(CAMERA),
    graph.skeleton_topic(mesh_sensor(CAMERA)),
)
COUNT = 8
VERTICES = """() => {
  const node = window.__viserSceneTree?.getState()["/mesh/kinect1/surface"];
  const vertices = node?.effectiveVisibility ? node.message.props.vertices : null;
  return vertices ? Array.from(new Float32Array(vertices.buffer, vertices.byteOffset, vertices.byteLength / 4)) : null;
}"""
COLOURED, WHITE = pixels_where("high - low > 100"), pixels_where("low > 200")


def frames() -> list[dict[str, bytes]]:
    """The first images of the shipped recording, with the skeletons and the meshes that are fitted to them."""
    found: dict[int, dict[str, bytes]] = {}

    def keep(topic: str, cdr: bytes, at_ns: int) -> None:
        found.setdefault(stamp_of(cdr), {})[topic] = cdr

    values = {"depth": (CAMERA,), "mesh_rate": 10.0, "personalise_from": 0}
    runner = OfflineRunner((MeshStage(check_all(MeshStage.PARAMETERS, values)),), BAG_WIRE, keep)
    with BagReader(BAG) as bag:
        for raw in itertools.islice(bag.messages([INFO, IMAGES]), COUNT + 1):
            keep(raw.topic, raw.cdr, raw.log_time_ns)
            runner.push(raw.topic, raw.cdr, raw.log_time_ns)
    return [found[stamp_ns] for stamp_ns in sorted(found)]


def test_a_browser_shows_the_mesh_and_its_image(tmp_path: Path) -> None:
    need_chromium()
    played = frames()
    meshes = [MeshMarker().decode(frame[MESH], BAG_WIRE)[2] for frame in played if MESH in frame]
    assert len(meshes) > 1
    vertices = [{tuple(each) for each in mesh.reshape(-1, 3).astype(np.float32).tolist()} for mesh in meshes]
    types = {INFO: "CameraInfo", IMAGES: "Image", SKELETONS: "PointCloud2"}
    kinds = {topic: message_class(f"sensor_msgs/msg/{name}") for topic, name in types.items()}
    kinds[MESH] = message_class(MeshMarker.type_name)
    with Running(tmp_path) as running:
        node = running.node
        # a bag has the calibration once, before any browser
        profiles = {topic: LATCHED if topic == INFO else RELIABLE for topic in kinds}
        publishers = {topic: node.create_publisher(kind, topic, profiles[topic]) for topic, kind in kinds.items()}
        publishers[INFO].publish(next(frame[INFO] for frame in played if INFO in frame))
        poses = node.create_publisher(TransformStamped, graph.CALIBRATION, LATCHED)
        pose = level_pose(mesh_sensor(CAMERA), pitch=0.03)
        poses.publish(
            BAG_WIRE.serialize("geometry_msgs/msg/TransformStamped", pose_to_transform(pose, "world", BAG_MESSAGES))
        )
        running.start("viewer", port=0, rate=5.0, sensors=f"['{mesh_sensor(CAMERA)}']", depth=f"['{CAMERA}']")
        endless = itertools.cycle([frame for frame in played if IMAGES in frame])
        with browsing(running, tmp_path, (900, 560), 0.4) as page:
            browser = Browser(running, page, [])

            def publish() -> None:
                for topic, cdr in next(endless).items():
                    if topic != INFO:
                        publishers[topic].publish(cdr)

            def surface() -> bool:
                publish()
                numbers = page.evaluate(VERTICES)
                return numbers is not None and any(
                    {tuple(each) for each in np.array(numbers).reshape(-1, 3).tolist()} == each for each in vertices
                )

            browser.until(surface, "a mesh as it was published")

            def coloured() -> bool:
                publish()
                images = zip(
                    page.evaluate(COLOURED), page.evaluate(WHITE), strict=False
                )  # another one may come between
                return any(share > 0.5 and white > 300 for (_, share), (white, _) in images)

            browser.until(coloured, "an image in false colours with an outline")
            assert not page.get_by_label("body", exact=True).is_checked()  # capsules, which would cover the mesh

            # The images are taken only while they are shown, and the mesh while it or they are.
            taken: Any = publishers[IMAGES].get_subscription_count
            drawn: Any = publishers[MESH].get_subscription_count
            assert (taken(), drawn()) == (1, 1)
            page.get_by_label("depth images").dispatch_event("click")
            browser.until(lambda: taken() == 0, "no more images to be taken")
            assert drawn() == 1
        assert running.until(lambda: drawn() == 0, PATIENCE)
