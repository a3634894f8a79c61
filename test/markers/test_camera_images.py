"""``marker_cameras``: images of drivers, of files and rendered ones become sets with equal stamps, or are refused."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from body_tracking import systems
from body_tracking.core.message_types import IMAGE
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.markers import setup
from body_tracking.markers.camera_images import CameraError, CameraImagesStage
from body_tracking.markers.codecs import CameraImage
from body_tracking.markers.rendering import RenderingError
from body_tracking.markers.rig_storage import save_rig
from body_tracking.messages.base import to_header
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.stage import Now
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE
from body_tracking.simulation.marker_scene import stereo_rig

ROOT = Path(__file__).resolve().parents[2]
START_NS, MS = 1_750_000_000 * NANOSECONDS, 1_000_000
SIZE = (480, 640)
DRIVERS = {"/cam_a/image": "left", "/cam_b/image": "right"}


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    save_rig(stereo_rig(), tmp_path / setup.RIG)
    return tmp_path


def made(lab: Path, images: str, **values: Any) -> CameraImagesStage:
    return CameraImagesStage(check_all(CameraImagesStage.PARAMETERS, {"setup": str(lab), "images": images, **values}))


def picture(seed: int, kind: type = np.uint8, size: tuple[int, int] = SIZE) -> NDArray[Any]:
    return np.random.default_rng(seed).integers(0, np.iinfo(kind).max, size, dtype=kind)


def polled(stage: CameraImagesStage, period_ns: int, count: int) -> list[dict[str, tuple[int, NDArray[Any]]]]:
    """The sets that are due one after the other: stamp and pixels by topic."""
    assert {output.topic for output in stage.start(Now(START_NS, 0))} == {"/left/camera_info", "/right/camera_info"}
    sets = []
    for number in range(count):
        outputs = list(stage.poll(number * period_ns))
        if outputs:
            sets.append({output.topic: (output.payload[0], output.payload[2]) for output in outputs})
    return sets


# --- files


def write(folder: Path, camera: str, name: str, image: NDArray[Any]) -> None:
    (folder / camera).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / camera / name), image)


def test_files_of_equal_names_are_a_set_with_one_stamp(lab: Path) -> None:
    folder = lab / "images"
    for number in range(3):
        write(folder, "left", f"{8 + number}.png", picture(number))
        write(folder, "right", f"{8 + number}.png", picture(10 + number, np.uint16))
    write(folder, "left", "03.png", picture(3))
    stage = made(lab, f"folder:{folder}", rate=100.0)
    sets = polled(stage, 10 * MS, 6)
    assert len(sets) == 3 and stage.counters["unpaired files"] == 1
    for number, each in enumerate(sets):
        stamps = {stamp for stamp, _ in each.values()}
        assert stamps == {START_NS + number * 10 * MS}
        np.testing.assert_array_equal(each["/left/image_raw"][1], picture(number))
        np.testing.assert_array_equal(each["/right/image_raw"][1], picture(10 + number, np.uint16))
    assert len(polled(made(lab, f"folder:{folder}", rate=100.0, loop=True), 10 * MS, 6)) == 6


def test_a_source_that_is_too_late_leaves_sets_out(lab: Path) -> None:
    for camera in ("left", "right"):
        for number in range(400):
            (lab / camera).mkdir(exist_ok=True)
            (lab / camera / f"{number:03d}.png").write_bytes(b"")
        write(lab, camera, "300.png", picture(0))
    stage = made(lab, f"folder:{lab}", rate=100.0)
    list(stage.start(Now(START_NS, 0)))
    (first, _) = stage.poll(3 * NANOSECONDS)
    assert first.stamp_ns == START_NS + 3 * NANOSECONDS and stage.counters["sets left out to keep up"] == 300


@pytest.mark.parametrize(
    ("images", "said"),
    [
        ("folder:{lab}/none", "none/left: no such folder"),
        ("folder:{lab}", "no file has the same name in all folders (1 in left, 1 in right)"),
        (
            "/one/topic",
            "images: 1 topics (/one/topic), the rig has the cameras left_optical_frame, right_optical_frame",
        ),
        ("/a,/a", "images: 1 topics"),
    ],
)
def test_an_invalid_source_is_refused_with_its_name(lab: Path, images: str, said: str) -> None:
    write(lab, "left", "a.png", picture(0))
    write(lab, "right", "b.png", picture(0))
    with pytest.raises(CameraError) as caught:
        made(lab, images.format(lab=lab))
    assert said in str(caught.value)


@pytest.mark.parametrize("damage", ["text", "size"])
def test_a_file_that_cannot_be_used_costs_one_set(lab: Path, damage: str) -> None:
    for number in range(3):
        for camera in ("left", "right"):
            write(lab, camera, f"{number}.png", picture(number))
    if damage == "text":
        (lab / "right" / "1.png").write_text("no image")
    else:
        write(lab, "right", "1.png", picture(0, size=(240, 320)))
    stage = made(lab, f"folder:{lab}", rate=100.0)
    list(stage.start(Now(START_NS, 0)))
    assert len(list(stage.poll(0))) == 2
    with pytest.raises(CameraError, match=r"right/1\.png" if damage == "text" else "320 x 240 pixels, calibrated"):
        list(stage.poll(10 * MS))
    if damage == "size":
        level, text, _ = stage.state(0)
        assert level == 1 and "right_optical_frame: images of 320 x 240" in text
    assert len(list(stage.poll(20 * MS))) == 2 and stage.state(0)[0] == 0


# --- drivers


def colour(pixels: NDArray[Any], encoding: str) -> Any:
    channels = len(encoding) - 1
    message = array_to_image(np.repeat(pixels, channels, axis=1), 0, "", BAG_MESSAGES)
    message.width, message.encoding = pixels.shape[1], encoding
    return message


def pushed(
    stage: CameraImagesStage, messages: Sequence[tuple[str, int, Any]]
) -> tuple[list[tuple[str, int, NDArray[Any]]], int]:
    """(camera, stamp, pixels) of the outputs for inputs (topic, stamp after the start, message), and refusals."""
    found: list[tuple[str, int, NDArray[Any]]] = []

    def sink(topic: str, cdr: bytes, at_ns: int) -> None:
        if topic.endswith("image_raw"):
            stamp_ns, frame, pixels = CameraImage().decode(cdr, BAG_WIRE)
            found.append((setup.camera_name(frame), stamp_ns - START_NS, pixels))

    runner = OfflineRunner([stage], BAG_WIRE, sink)
    runner.start(START_NS)
    for topic, after_ns, message in messages:
        message.header = to_header(START_NS + after_ns, "anything", BAG_MESSAGES)
        runner.push(topic, BAG_WIRE.serialize(IMAGE, message), START_NS + after_ns)
    runner.finish(START_NS + 10 * NANOSECONDS)
    return found, sum(runner.counters.values())


def grey(seed: int, **kind: Any) -> Any:
    return array_to_image(picture(seed, **kind), 0, "", BAG_MESSAGES)


def test_images_of_drivers_become_pairs_with_one_stamp_in_the_rigs_frames(lab: Path) -> None:
    a, b = DRIVERS
    found, refused = pushed(
        made(lab, f"{a},{b}"), [(b, 1 * MS, grey(0)), (a, 0, grey(1)), (a, 33 * MS, grey(2)), (b, 34 * MS, grey(3))]
    )
    assert [(camera, stamp) for camera, stamp, _ in found] == [
        *(("right", 0), ("left", 0)),
        *(("left", 33 * MS), ("right", 33 * MS)),
    ]
    for (_, _, pixels), seed in zip(found, range(4), strict=True):
        np.testing.assert_array_equal(pixels, picture(seed))
    assert not refused


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_colour_images_become_grey_and_are_counted(lab: Path, encoding: str) -> None:
    a, b = DRIVERS
    stage = made(lab, f"{a},{b}")
    found, refused = pushed(stage, [(a, 0, colour(picture(0), encoding)), (b, 0, grey(1))])
    np.testing.assert_array_equal(found[0][2], picture(0))  # of equal channels the mean is the channel
    assert (stage.counters["colour images"], refused) == (1, 0)


def test_images_that_cannot_be_used_are_refused_by_name_and_survived(lab: Path) -> None:
    a, b = DRIVERS
    float_image = array_to_image(picture(0), 0, "", BAG_MESSAGES)
    float_image.encoding, float_image.width = "32FC1", 160
    short = colour(picture(0), "rgb8")
    short.step = 640
    stage = made(lab, f"{a},{b}")
    bad = [float_image, short, grey(0, size=(240, 320))]
    messages = [(a, k * 100 * MS, message) for k, message in enumerate(bad)]
    found, refused = pushed(stage, [*messages, (a, 900 * MS, grey(1)), (b, 900 * MS, grey(2))])
    assert (len(found), refused, stage.counters["images of another size"]) == (2, 3, 1)


@pytest.mark.parametrize(("delay_ms", "said"), [(16.7, "16.7 ms after"), (-8.0, "8.0 ms before")])
def test_drivers_out_of_step_are_named_with_the_difference_of_their_stamps(
    lab: Path, delay_ms: float, said: str
) -> None:
    a, b = DRIVERS
    stage = made(lab, f"{a},{b}")
    small = grey(0)
    frames = [(topic, 200 * k + late, small) for k in range(15) for topic, late in ((a, 20), (b, 20 + delay_ms))]
    frames.sort(key=lambda each: each[1])
    found, _ = pushed(stage, [(topic, round(at * MS), message) for topic, at, message in frames])
    level, text, _ = stage.state(0)
    assert not found and level == 1
    assert "right_optical_frame lacks in" in text and said in text and "of left_optical_frame" in text
    assert stage.counters["incomplete sets"] == 30


def test_a_driver_of_which_nothing_comes_is_named(lab: Path) -> None:
    a, b = DRIVERS
    stage = made(lab, f"{a},{b}")
    assert "no set of images of /cam_a/image, /cam_b/image yet" in stage.state(0)[1]
    pushed(stage, [(a, 100 * k * MS, grey(0)) for k in range(15)])
    assert stage.state(0)[1] == "right_optical_frame lacks in 15 of 15 sets of images: nothing comes from it"


# --- rendered


def test_rendered_motion_goes_back_and_forth(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = made(ROOT / "config" / "marker_setup", "render")
    indices = []
    monkeypatch.setattr(stage._source, "images", lambda index: indices.append(index) or [np.zeros(SIZE, np.uint8)] * 2)
    polled(stage, NANOSECONDS // 30, 400)
    assert set(indices) == set(range(150)) and np.abs(np.diff(indices)).max() == 1


def test_another_rig_cannot_be_rendered(lab: Path) -> None:
    rig = stereo_rig()
    frames = [type(camera)(f"other_{k}", *camera_rest(camera)) for k, camera in enumerate(rig.cameras)]
    save_rig(type(rig)(tuple(frames), rig.rotations, rig.translations, rig.covariance), lab / setup.RIG)
    with pytest.raises(RenderingError, match="the simulated scene has the cameras left_optical_frame"):
        made(lab, "render")


def camera_rest(camera: Any) -> tuple[Any, ...]:
    return camera.width, camera.height, camera.matrix, camera.distortion, camera.model


def test_the_option_starts_the_node() -> None:
    given = {"sensors": (), "marker_setup": "config/marker_setup", "marker_images": "/a,/b"}
    specs = {spec.name: spec for spec in systems.nodes_for(systems.options_of(**given))}
    assert specs["marker_cameras"].parameters["images"] == "/a,/b" and "marker_detector" in specs
    assert "marker_cameras" not in {s.name for s in systems.nodes_for(systems.options_of(**given, bag="bag"))}
