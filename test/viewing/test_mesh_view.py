"""Depth cameras on the viewer's page: a mesh is drawn where its camera is, over its own image, and not too often."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed")

from viewer_page import page_with

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.sources import SensorNameError
from body_tracking.mesh.codecs import DepthImage, MeshMarker
from body_tracking.mesh.topics import depth_topic, info_topic, mesh_topic
from body_tracking.messages.codecs import CameraInfo
from body_tracking.recording.rosbag2 import BAG_WIRE
from body_tracking.viewing.mesh_view import MeshView

CAMERA = Camera("camera", 128, 106, np.array([[92.0, 0.0, 64.0], [0.0, 92.0, 53.0], [0.0, 0.0, 1.0]]), np.zeros(5))
IMAGES, INFO, MESH = depth_topic("kinect1"), info_topic("kinect1"), mesh_topic("kinect1")
POSES = {"kinect1_mesh": SensorPose("kinect1_mesh", np.array([1.0, 2.0, 3.0]), so3.exp(np.array([0.4, -1.2, 2.0])))}
PERIOD_NS = 33_333_333
OUTLINE = 240
"""Least brightness of the darkest channel of the outline; no colour of a distance is so white."""


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def view(clock: Clock) -> Iterator[MeshView]:
    made = MeshView(("kinect1",), clock)
    page = page_with(made)
    yield made
    page.close()


def image(number: int, metres: float) -> bytes:
    millimetres = np.full((106, 128), round(1e3 * metres), np.uint16)
    return DepthImage().encode((number * PERIOD_NS, "camera", millimetres), BAG_WIRE)


def square(number: int, side: float = 0.4) -> bytes:
    """Two triangles at 1.5 m, which the camera sees as a square of 92 side / 1.5 pixels in its middle."""
    a, b, c, d = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2.0 + [0.0, 0.0, 1.5]
    return MeshMarker().encode((number * PERIOD_NS, "camera", np.array([[a, b, c], [a, c, d]])), BAG_WIRE)


def draw(view: MeshView, recent: dict[str, list[bytes]], poses: Any = POSES, **hidden: bool) -> None:
    visible = {**dict.fromkeys(view.layers, True), **hidden}
    codecs = view.topics(visible)

    def decode(topic: str, cdr: bytes) -> Any:
        try:
            return codecs[topic].decode(cdr, BAG_WIRE)
        except BodyTrackingError:
            return None

    view.draw(recent, decode, visible, poses)


def shown(view: MeshView) -> np.ndarray:
    return np.asarray(view._shown["kinect1"].image.image, int)


def outline(view: MeshView) -> np.ndarray:
    """(n, 2) rows and columns of the outline, pixels of the camera."""
    return np.argwhere(shown(view).min(axis=2) >= OUTLINE) * 128.0 / shown(view).shape[1]


INFOS = [CameraInfo().encode((0, CAMERA), BAG_WIRE)]


def test_the_mesh_is_outlined_on_the_image_that_it_was_fitted_to(view: MeshView, clock: Clock) -> None:
    assert set(view.topics(dict.fromkeys(view.layers, True))) == {IMAGES, INFO, MESH} and view.held == {INFO}
    near_far = [image(number, 1.0 + number) for number in range(4)]
    draw(view, {IMAGES: near_far[2:3], INFO: INFOS})
    alone = shown(view)
    assert not len(outline(view)) and np.ptp(alone, axis=(0, 1)).max() == 0
    clock.now = 1.0
    draw(view, {IMAGES: near_far, INFO: INFOS, MESH: [square(1), square(2)]})
    found = outline(view)
    # 24.5 pixels about the middle, of a line that is 0.5 pixels wide
    middle, half = np.array([53.0, 64.0]), 0.5 * 92.0 * 0.4 / 1.5
    assert np.abs(np.abs(found - middle).max(axis=1) - half).max() < 1.5 and len(found) > 100
    # not the newest image, but that of the mesh
    np.testing.assert_array_equal(shown(view)[0, 0], alone[0, 0])


def test_the_surface_is_where_the_camera_is_and_keeps_its_vertices(view: MeshView, clock: Clock) -> None:
    draw(view, {MESH: [square(0)]}, {})
    surface = view._shown["kinect1"]._surface
    assert not surface._frame.visible
    for number, side in enumerate((0.4, 0.6), start=1):
        clock.now += 1.0
        draw(view, {MESH: [square(number, side)]})
        assert surface._frame.visible and surface._handle.vertices.shape == (4, 3)
        vertices = np.sort(surface._handle.vertices[surface._handle.faces].reshape(-1, 3), axis=0)
        np.testing.assert_allclose(vertices[[0, -1], :2], [[-side / 2] * 2, [side / 2] * 2], atol=1e-6)
    np.testing.assert_allclose(surface._frame.position, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.roll(surface._frame.wxyz, -1), POSES["kinect1_mesh"].quat_xyzw, atol=1e-6)
    draw(view, {})
    assert not surface._frame.visible


def test_at_most_ten_images_and_meshes_are_sent_in_a_second(view: MeshView, clock: Clock) -> None:
    surface, sent = view._shown["kinect1"]._surface, [0, 0]
    last: list[Any] = [None, None]
    for number in range(60):
        clock.now = number / 60.0
        draw(
            view,
            {IMAGES: [image(number, 1.0 + number / 30.0)], INFO: INFOS, MESH: [square(number, 0.2 + 0.01 * number)]},
        )
        for k, new in enumerate((view._shown["kinect1"].image.image, surface._handle and surface._handle.vertices)):
            sent[k] += new is not None and not np.array_equal(new, last[k])
            last[k] = None if new is None else new.copy()
    assert 5 <= sent[0] <= 11 and 5 <= sent[1] <= 11


def test_what_is_off_is_not_taken_and_what_is_malformed_is_not_drawn(view: MeshView, clock: Clock) -> None:
    off = dict.fromkeys(view.layers, False)
    assert not view.topics(off) and set(view.topics({**off, "mesh": True})) == {MESH}
    draw(view, {MESH: [square(0)]}, mesh=False, depth_images=False)
    assert not view._shown["kinect1"].image.visible and not view._shown["kinect1"]._surface._frame.visible
    for broken in (b"", b"\x00\x01\x00\x00", square(1)[:-3], image(1, 1.0)[:-3]):
        clock.now += 1.0
        draw(view, {MESH: [broken], IMAGES: [broken], INFO: [broken]})
    clock.now += 1.0
    # a calibration of another size
    other = Camera("camera", 64, 53, CAMERA.matrix, np.zeros(5))
    draw(view, {MESH: [square(1)], IMAGES: [image(1, 2.0)], INFO: [CameraInfo().encode((0, other), BAG_WIRE)]})
    assert not len(outline(view))
    with pytest.raises(SensorNameError):
        MeshView(("a/b",))
