"""Folders of images as bags: the bag holds the files' contents, and bad files are named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from body_tracking import cli
from body_tracking.camera.codecs import CompressedColour, CompressedDepth
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import COMPRESSED_IMAGE
from body_tracking.messages.codecs import CameraInfo
from body_tracking.recording.image_folder import import_folder
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, deserialize

COLOUR = "/camera1/color/image_raw/compressed"
STAMPS = ("1305031102.175304", "1305031102.211214", "1305031102.243211")


def folder(path: Path, stamps: tuple[str, ...] = STAMPS, size: tuple[int, int] = (64, 48)) -> Path:
    """Three images, with depth at half the size."""
    (path / "rgb").mkdir(parents=True)
    (path / "depth").mkdir()
    width, height = size
    for number, stamp in enumerate(stamps):
        colour = np.full((height, width, 3), 60 * number + 20, np.uint8)
        assert cv2.imwrite(str(path / "rgb" / f"{stamp}.png"), colour)
        depth = np.full((height // 2, width // 2), 5000 + 500 * number, np.uint16)
        assert cv2.imwrite(str(path / "depth" / f"{stamp}.png"), depth)
    info = {
        "image_width": width,
        "image_height": height,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0.0, 0.0, 0.0, 0.0]},
    }
    (path / "camera_info.yaml").write_text(yaml.safe_dump(info))
    return path


def test_images_stamps_and_intrinsics_are_in_the_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images, bag = folder(tmp_path / "images"), tmp_path / "bag"
    assert cli.main(["import", str(images), "-o", str(bag), "--sensor", "cam", "--depth-scale", "5000"]) == 0
    assert "3 colour and 3 depth images of cam, 0.1 s" in capsys.readouterr().out
    colour, depth, infos = {}, {}, {}
    with BagReader(bag) as reader:
        for raw in reader.messages():
            if raw.topic == "/cam/color/image_raw/compressed":
                stamp_ns, frame, pixels = CompressedColour().decode(raw.cdr, BAG_WIRE)
                assert frame == "cam_optical_frame" and raw.log_time_ns == stamp_ns
                colour[stamp_ns] = pixels
                data = bytes(deserialize(COMPRESSED_IMAGE, raw.cdr).data)
                assert data in {path.read_bytes() for path in (images / "rgb").iterdir()}
            elif raw.topic == "/cam/depth/image_raw/compressedDepth":
                stamp_ns, _, metres = CompressedDepth().decode(raw.cdr, BAG_WIRE)
                depth[stamp_ns] = metres
            else:
                infos[raw.topic] = CameraInfo().decode(raw.cdr, BAG_WIRE)
    assert list(colour) == list(depth) == [int(stamp.replace(".", "")) * 1000 for stamp in STAMPS]
    assert [int(pixels[0, 0, 0]) for pixels in colour.values()] == [20, 80, 140]
    assert [float(metres[0, 0]) for metres in depth.values()] == pytest.approx([1.0, 1.1, 1.2])
    own, registered = infos["/cam/color/camera_info"], infos["/cam/depth/camera_info"]
    assert own.distortion[0] == registered.distortion[0] == 0.1
    # the same lines of sight through the pixels of either
    np.testing.assert_allclose(own.rays(np.array([10.5, 20.5])), registered.rays(np.array([5.0, 10.0])), atol=1e-9)


def test_files_without_stamps_come_at_the_rate(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", ("1", "2", "10"))
    import_folder(images, tmp_path / "bag", "camera1", 10.0, 1000.0)
    with BagReader(tmp_path / "bag") as reader:
        found = [CompressedColour().decode(raw.cdr, BAG_WIRE) for raw in reader.messages([COLOUR])]
    assert [stamp_ns for stamp_ns, *_ in found] == [100_000_000, 200_000_000, 300_000_000]
    assert [int(pixels[0, 0, 0]) for *_, pixels in found] == [20, 80, 140], "10.png comes after 2.png"


def test_numbered_files_of_which_some_lack_are_not_paired(tmp_path: Path) -> None:
    images = folder(tmp_path / "images", ("1", "2", "3"))
    (images / "depth" / "2.png").unlink()
    with pytest.raises(BodyTrackingError, match="3 colour and 2 depth images, whose names are no stamps"):
        import_folder(images, tmp_path / "bag", "camera1", 10.0, 1000.0)
    stamped = folder(tmp_path / "stamped")
    next((stamped / "depth").iterdir()).unlink()
    assert import_folder(stamped, tmp_path / "bag", "camera1", 10.0, 1000.0).depth == 2


def info(images: Path) -> Path:
    return images / "camera_info.yaml"


def last(images: Path, kind: str) -> Path:
    return sorted((images / kind).iterdir())[-1]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _cut_jpeg(images: Path) -> None:
    jpeg = last(images, "rgb").rename(images / "rgb" / "2.5.jpg")
    jpeg.write_bytes(cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()[:-20])


def _list_as_matrix(images: Path) -> None:
    known = yaml.safe_load(info(images).read_text())
    info(images).write_text(yaml.safe_dump(known | {"camera_matrix": [1.0] * 9}))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda images: info(images).unlink(), "camera_info.yaml"),
        (lambda images: info(images).write_text("image_width: 64\nimage_height: 48\n"), "camera_matrix is missing"),
        (lambda images: info(images).write_text(info(images).read_text().replace("50.0", "0.0")), "calibrated"),
        (lambda images: info(images).write_text("[" * 1000), "camera_info.yaml"),
        (
            lambda images: cv2.imwrite(str(last(images, "depth")), np.zeros((4, 4, 3), np.uint8)),
            "no PNG image of 16 bits",
        ),
        (lambda images: [path.unlink() for path in (images / "rgb").iterdir()], "no PNG or JPEG images"),
        (lambda images: cut(last(images, "depth")), r"depth/1305031102\.243211\.png: cut off after \d+ bytes"),
        (lambda images: cut(last(images, "rgb")), r"rgb/1305031102\.243211\.png: cut off after \d+ bytes"),
        (_cut_jpeg, r"rgb/2\.5\.jpg: cut off after \d+ bytes"),
        (lambda images: last(images, "rgb").write_bytes(b""), r"243211\.png: the file is empty"),
        (lambda images: last(images, "rgb").write_text("no image"), r"243211\.png: no PNG or JPEG image"),
        (
            lambda images: info(images).write_text("- 1\n"),
            "camera_info.yaml: no intrinsics as ROS's camera_calibration writes them",
        ),
        (
            lambda images: info(images).write_text(info(images).read_text().replace("width: 64", "width: 128")),
            r"camera_info.yaml: of images of 128x48 pixels, 1305031102\.175304\.png has 64x48",
        ),
        (lambda images: (images / "depth").rename(images / "Depth"), "Depth: no depth images; they are taken from"),
        (_list_as_matrix, "camera_info.yaml: camera_matrix: expected rows, cols and data"),
    ],
)
def test_a_folder_that_cannot_be_used_is_named_and_leaves_no_bag(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], spoil: Callable[[Path], object], reason: str
) -> None:
    images = folder(tmp_path / "images")
    spoil(images)
    with pytest.raises(BodyTrackingError, match=reason):
        import_folder(images, tmp_path / "bag", "camera1", 30.0, 1000.0)
    assert not (tmp_path / "bag").exists()
    assert capfd.readouterr().err == ""  # of OpenCV


def test_json_tells_what_was_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images, bag = folder(tmp_path / "images"), tmp_path / "bag"
    assert cli.main(["import", str(images), "-o", str(bag), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.pop("recording_s") == pytest.approx(0.068, abs=1e-3)
    assert found == {"bag": str(bag), "camera": "camera1", "colour": 3, "depth": 3}
