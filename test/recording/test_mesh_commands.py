"""``body_tracking mesh``: pictures of the mesh over depth images, and the shape of a recorded person."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from body_tracking import cli
from body_tracking.core.camera import Camera
from body_tracking.core.message_types import IMAGE
from body_tracking.core.qos import LATCHED, RELIABLE
from body_tracking.mesh import body_model
from body_tracking.mesh.codecs import DepthImage, MeshMarker
from body_tracking.mesh.picture import overlay
from body_tracking.mesh.raster import render
from body_tracking.mesh.solver import MeshFitter
from body_tracking.mesh.storage import load
from body_tracking.mesh.topics import IMAGES, depth_topic, info_topic, mesh_topic
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.codecs import CameraInfo
from body_tracking.messages.markers import MARKER
from body_tracking.recording.picture import PictureError, write_picture
from body_tracking.recording.rosbag2 import BAG_WIRE, BagWriter

ROOT = Path(__file__).resolve().parents[2]
CAMERA = Camera("camera", 128, 106, np.array([[92.0, 0.0, 64.0], [0.0, 92.0, 53.0], [0.0, 0.0, 1.0]]), np.zeros(5))


def standing() -> np.ndarray:
    """(F, 3, 3) metres."""
    body = body_model.load().body()
    vertices = body.posed(MeshFitter(body).neutral(np.array([0.0, 0.0, 2.5]), 0.6)).vertices
    return vertices[body.model.faces]


def test_the_mesh_is_drawn_where_it_is_seen_and_leaves_the_rest_as_it_was() -> None:
    corners = standing()
    depth = np.full((CAMERA.height, CAMERA.width), 3.5, np.float32)
    person = render(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3), CAMERA).depth > 0.0
    drawn, plain = overlay(depth, corners, CAMERA), overlay(depth, corners[:0], CAMERA)
    assert np.array_equal(drawn[~person], plain[~person])
    # the colour of skin: more red than blue; the image itself is grey
    assert (drawn[person][:, 0] > drawn[person][:, 2]).all() and (plain[..., 0] == plain[..., 2]).all()


def test_show_draws_images_that_have_a_mesh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners, folder = standing(), tmp_path / "bag"
    depth = np.full((CAMERA.height, CAMERA.width), 3500, np.uint16)
    with BagWriter(folder) as bag:
        bag.add_topic(info_topic("kinect1"), CAMERA_INFO, LATCHED)
        bag.add_topic(depth_topic("kinect1"), IMAGE, IMAGES)
        bag.add_topic(mesh_topic("kinect1"), MARKER, RELIABLE)
        bag.write(info_topic("kinect1"), CameraInfo().encode((0, CAMERA), BAG_WIRE), 1)
        for stamp in range(10, 15):
            bag.write(depth_topic("kinect1"), DepthImage().encode((stamp, "camera", depth), BAG_WIRE), stamp)
        for stamp in (10, 12, 14):
            bag.write(mesh_topic("kinect1"), MeshMarker().encode((stamp, "camera", corners), BAG_WIRE), stamp)
    out = tmp_path / "pictures" / "mesh.png"
    assert cli.main(["mesh", "show", str(folder), "-o", str(out), "--images", "2"]) == 0
    picture = cv2.imread(str(out)).astype(int)
    assert picture.shape == (720, 720, 3)
    upper, lower = picture[:360], picture[360:]
    assert (lower[..., 2] > lower[..., 0] + 20).mean() > 0.1 > (upper[..., 2] > upper[..., 0] + 20).mean()
    capsys.readouterr()
    assert cli.main(["mesh", "show", str(folder), "-o", str(out), "--depth", "kinect2"]) != 0
    assert "/kinect2/depth/camera_info" in capsys.readouterr().err


def test_a_picture_is_written_into_a_new_folder_or_refused_in_a_line(tmp_path: Path) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0] = 200
    for _ in range(2):  # a picture may be replaced
        write_picture(tmp_path / "new" / "folder" / "red.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "folder" / "red.png"))[..., ::-1], image)
    for name, said in (
        ("red", r"no format of pictures ends with nothing; call it \.png"),
        ("red.xyz", r"no format of pictures ends with \.xyz"),
        ("file/red.png", "cannot be written"),
    ):
        (tmp_path / "file").write_text("")
        with pytest.raises(PictureError, match=said):
            write_picture(tmp_path / name, image)


def test_a_recording_without_depth_images_or_with_too_few_poses_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "person.yaml"
    assert cli.main(["mesh", "personalise", str(ROOT / "bags" / "tpose_wave"), "-o", str(out)]) != 0
    assert "no topic /kinect1/depth/camera_info" in capsys.readouterr().err
    assert cli.main(["mesh", "show", str(ROOT / "bags" / "mesh_reaching"), "-o", str(tmp_path / "mesh.png")]) != 0
    assert "no topic /kinect1_mesh/mesh, which replay --depth kinect1 makes; it has" in capsys.readouterr().err
    folder = tmp_path / "empty_room"
    with BagWriter(folder) as bag:
        bag.add_topic(info_topic("kinect1"), CAMERA_INFO, LATCHED)
        bag.add_topic(depth_topic("kinect1"), IMAGE, IMAGES)
        bag.write(info_topic("kinect1"), CameraInfo().encode((0, CAMERA), BAG_WIRE), 1)
        wall = np.full((CAMERA.height, CAMERA.width), 3500, np.uint16)
        bag.write(depth_topic("kinect1"), DepthImage().encode((2, "camera", wall), BAG_WIRE), 2)
    assert cli.main(["mesh", "personalise", str(folder), "-o", str(out)]) != 0
    assert "nobody was tracked (images: 1, nobody is seen: 1)" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_the_shape_of_the_shipped_recordings_person(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "person.yaml"
    assert cli.main(["mesh", "personalise", str(ROOT / "bags" / "mesh_reaching"), "-o", str(out)]) == 0
    assert "body of 1.7" in capsys.readouterr().out
    _, covariance = load(out, body_model.load())
    assert np.sqrt(covariance[0, 0]) < 0.3  # the stature, of which a standard deviation is 7 cm
