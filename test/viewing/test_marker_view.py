"""The marker system on the viewer's page: images, balls and poses that are drawn together are of one time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed")

from target_points import measure
from viewer_page import page_with

from body_tracking.core.errors import BodyTrackingError
from body_tracking.markers import setup
from body_tracking.markers.chain_files import save_chain
from body_tracking.markers.codecs import Balls, CameraImage, PoseOfTarget, SpacePoints
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.targets_file import save_targets
from body_tracking.messages.cdr import stamp_of
from body_tracking.recording.rosbag2 import BAG_WIRE
from body_tracking.simulation.marker_scene import MarkerScene, marker_scene
from body_tracking.viewing.marker_view import MarkerView
from body_tracking.viewing.page import Page
from body_tracking.viewing.snapshot import Seen, Snapshot

START_NS, PERIOD_NS = 1_750_000_000_000_000_000, 33_333_333
NOBODY = Seen((), stale=True)


@pytest.fixture(scope="module")
def scene() -> MarkerScene:
    return marker_scene("slow_down", seed=1, rate=30.0, seconds=0.2)


@pytest.fixture(scope="module")
def folder(scene: MarkerScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lab")
    save_rig(scene.rig, path / setup.RIG)
    save_targets(scene.targets, path / setup.TARGETS)
    save_chain(scene.chain, path / setup.CHAIN)
    return path


@pytest.fixture(scope="module")
def view(folder: Path) -> MarkerView:
    return MarkerView(str(folder))


@pytest.fixture(scope="module")
def page(view: MarkerView) -> Iterator[Page]:
    made = page_with(view)
    yield made
    made.close()


def messages(scene: MarkerScene, index: int, brightness: int = 80) -> dict[str, bytes]:
    """All messages of the nodes for one time; images are evenly bright, but for the balls."""
    stamp_ns, found = START_NS + index * PERIOD_NS, {}
    points = scene.balls(index)
    for number, camera in enumerate(scene.rig.cameras):
        image = np.full((camera.height, camera.width), brightness, np.uint8)
        pixels = scene.rig.project(points)[number]
        balls = ImageBalls(
            stamp_ns,
            camera.frame_id,
            pixels,
            np.full(len(pixels), 30.0),
            np.tile(0.01 * np.eye(2), (len(pixels), 1, 1)),
        )
        found[setup.image_topic(camera.frame_id)] = CameraImage().encode((stamp_ns, camera.frame_id, image), BAG_WIRE)
        found[setup.balls_topic(camera.frame_id)] = Balls().encode(balls, BAG_WIRE)
    seen = measure(points, np.random.default_rng(index), stamp_ns)
    found[setup.POINTS] = SpacePoints().encode(seen, BAG_WIRE)
    for pose in scene.poses(index, stamp_ns):
        found[setup.pose_topic(pose.name)] = PoseOfTarget(pose.name).encode(pose, BAG_WIRE)
    return found


def show(page: Page, view: MarkerView, recent: dict[str, list[bytes]]) -> None:
    codecs = view.topics(page.visible)

    def decode(topic: str, cdr: bytes) -> Any:
        try:
            return codecs[topic].decode(cdr, BAG_WIRE)
        except BodyTrackingError:
            return None

    nothing = np.empty((0, 3)), np.empty((0, 4))
    page.draw(Snapshot({}, {}, NOBODY, NOBODY, *nothing))
    page.draw_views(recent, decode, {})


def coloured(view: MarkerView) -> list[int]:
    """How many pixels of each camera's image have a target's colour."""
    images = [np.asarray(handle.image, dtype=int) for handle in view._images]
    return [int(((image.max(axis=2) - image.min(axis=2)) > 40).sum()) for image in images]


def test_what_is_drawn_together_is_of_one_time(scene: MarkerScene, page: Page, view: MarkerView) -> None:
    # poses come later than images: of the third time there are none yet
    first, second, third = (messages(scene, index, 80 + 40 * index) for index in range(3))
    assert set(first) == set(view.topics(page.visible))
    recent = {topic: [first[topic], second[topic]] for topic in first}
    for topic in first:
        if topic.endswith("image_raw"):
            recent[topic].append(third[topic])
    show(page, view, recent)
    assert all(np.median(handle.image) == 120 for handle in view._images)
    assert all(count > 300 for count in coloured(view))  # 15 circles and three names
    for pose in scene.poses(1, 0):
        frame = view._poses[pose.name]
        assert frame.visible
        np.testing.assert_allclose(frame.position, pose.translation, atol=1e-6)
    assert view._lines is not None and view._lines.visible
    # balls of another time are not drawn into an image
    show(page, view, {topic: [third[topic] if topic.endswith("image_raw") else first[topic]] for topic in first})
    assert all(np.median(handle.image) == 160 for handle in view._images) and coloured(view) == [0, 0]


def test_what_is_absent_malformed_or_switched_off_is_not_drawn(
    scene: MarkerScene, page: Page, view: MarkerView
) -> None:
    whole = {topic: [cdr] for topic, cdr in messages(scene, 0).items()}
    name = scene.targets[0].name
    show(page, view, {**whole, setup.pose_topic(name): [whole[setup.pose_topic(name)][0][:40]]})
    assert [view._poses[target.name].visible for target in scene.targets] == [False, True, True]
    for hidden in view.layers:
        page.visible[hidden] = False
    try:
        assert not [topic for topic in view.topics(page.visible) if topic.endswith(("image_raw", "balls", "points"))]
        show(page, view, whole)
        drawn = [*view._poses.values(), *view._cameras, *view._images, view._lines]
        assert not any(handle.visible for handle in drawn if handle is not None)
    finally:
        page.visible.update(dict.fromkeys(view.layers, True))
    show(page, view, {})
    assert not any(frame.visible for frame in view._poses.values())
    show(page, view, {topic: [b"", b"\x00\x01\x00\x00", cdr[0][:-3]] for topic, cdr in whole.items()})


def test_a_stamp_is_read_from_the_bytes(scene: MarkerScene) -> None:
    assert {stamp_of(cdr) for cdr in messages(scene, 3).values()} == {START_NS + 3 * PERIOD_NS}
    assert stamp_of(b"") == 0


def test_a_setup_that_is_begun_is_shown_as_far_as_it_is_there(scene: MarkerScene, tmp_path: Path) -> None:
    with pytest.raises(BodyTrackingError, match=r"rig\.yaml: no such file"):
        MarkerView(str(tmp_path))
    save_rig(scene.rig, tmp_path / setup.RIG)
    on = dict.fromkeys(MarkerView.layers, True)
    assert [topic for topic in MarkerView(str(tmp_path)).topics(on) if topic.endswith("pose")] == []
