"""``body_tracking markers`` from recordings of points to a setup, and refused input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rigs import images, rig
from target_points import TARGET_POINTS, measure, random_rotation

from body_tracking import cli
from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.qos import RELIABLE
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import Balls, SpacePoints
from body_tracking.markers.rig import Rig
from body_tracking.markers.rig_storage import load_rig, save_rig
from body_tracking.markers.targets import Target
from body_tracking.markers.targets_file import load_targets, save_targets
from body_tracking.recording.marker_commands import found_boards
from body_tracking.recording.rosbag2 import BAG_WIRE, BagWriter
from body_tracking.simulation.marker_bags import WAND as RENDERED_WAND
from body_tracking.simulation.marker_bags import write_wand
from body_tracking.simulation.marker_scene import DIAMETER, stereo_rig

WAND = (0.0, 0.1, 0.3)
START_NS, PERIOD_NS = 1_750_000_000_000_000_000, 16_666_667


def distances(points: FloatArray) -> FloatArray:
    return np.sort(np.linalg.norm(points[:, None] - points, axis=2)[np.triu_indices(len(points), 1)])


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, and a recording of the points of one target that is turned before it."""
    folder = tmp_path_factory.mktemp("target")
    save_rig(stereo_rig(), folder / setup.RIG)
    rng = np.random.default_rng(0)
    with BagWriter(folder / "bag") as bag:
        bag.add_topic(setup.POINTS, POINT_CLOUD, RELIABLE)
        for number in range(60):
            stamp_ns = START_NS + number * PERIOD_NS
            points = TARGET_POINTS @ random_rotation(rng).T + np.array([0.0, 0.0, 1.0])
            bag.write(setup.POINTS, SpacePoints().encode(measure(points, rng, stamp_ns), BAG_WIRE), stamp_ns)
    return folder


def test_a_target_is_measured_from_a_recording(turned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["target", str(turned / "bag"), "--setup", str(turned), "--name", "hand", "--balls", "5", "--json"]
    assert cli.main(["markers", *words]) == 0
    report = json.loads(capsys.readouterr().out)
    (found,) = load_targets(turned / setup.TARGETS)
    assert (found.name, report["name"]) == ("hand", "hand")
    assert np.abs(distances(found.points) - distances(TARGET_POINTS)).max() < 2e-4
    assert report["views"] > 50 and report["stddev_mm"] < 0.1
    # the same target again replaces it if asked to; another of the same shape is refused
    assert cli.main(["markers", *words]) == 2
    assert "has a target hand already; --overwrite replaces it" in capsys.readouterr().err
    assert cli.main(["markers", *words, "--overwrite"]) == 0
    assert cli.main(["markers", *[word if word != "hand" else "twin" for word in words]]) == 2
    assert [each.name for each in load_targets(turned / setup.TARGETS)] == ["hand"]


@pytest.fixture(scope="module")
def waved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the balls of a wand in the images of three cameras, and the lenses in two folders."""
    folder, truth, rng = tmp_path_factory.mktemp("wand"), rig(3), np.random.default_rng(0)
    for name, cameras in (("first", truth.cameras[:2]), ("second", truth.cameras[2:])):
        (folder / name).mkdir()
        count = len(cameras)
        alone = Rig(cameras, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((15 * count,) * 2))
        save_rig(alone, folder / name / setup.RIG)
    with BagWriter(folder / "bag") as bag:
        for camera in truth.cameras:
            bag.add_topic(setup.balls_topic(camera.frame_id), POINT_CLOUD, RELIABLE)
        for number in range(60):
            stamp_ns = START_NS + number * PERIOD_NS
            along = random_rotation(rng)[0]
            places = rng.uniform([0.1, -0.2, 0.9], [0.4, 0.2, 1.5]) + np.array(WAND)[:, None] * along
            balls, _ = images(truth, [places] * 3, rng, 0.05, stamp_ns)
            for each in balls:
                bag.write(setup.balls_topic(each.camera), Balls().encode(each, BAG_WIRE), stamp_ns)
    return folder


def test_a_wand_calibrates_three_cameras(waved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lenses = [word for name in ("first", "second") for word in ("--lenses", str(waved / name))]
    words = ["wand", str(waved / "bag"), "--setup", str(tmp_path / "lab"), "--places", "0,0.1,0.3", *lenses]
    assert cli.main(["markers", *words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    truth, found = rig(3), load_rig(tmp_path / "lab" / setup.RIG)
    assert [camera.frame_id for camera in found.cameras] == list(report["cameras"]) == ["a", "b", "c"]
    # 0.05 px at 1.2 m are 0.07 mm across a ray; after 60 places an error of some millimetres along it remains
    np.testing.assert_allclose(found.translations, truth.translations, atol=3e-3)
    for index, each in enumerate(report["cameras"].values()):
        expected = -1e3 * truth.rotations[index].T @ truth.translations[index]
        assert np.linalg.norm(expected - each["position_mm"]) <= 4.0 * each["translation_stddev_mm"] + 1e-9
        assert each["images"] == 60 and each["with_wand"] > 30 and each["rms_px"] < 0.1
    assert cli.main(["markers", *words]) == 2
    assert "rig.yaml: exists already; --overwrite replaces it" in capsys.readouterr().err
    assert cli.main(["markers", *words, "--overwrite"]) == 0
    out = capsys.readouterr().out
    assert "b: at " in out and " mm (± " in out and " deg (± " in out


@pytest.mark.slow
def test_a_rendered_wand_calibrates_the_rig(tmp_path: Path) -> None:
    truth = stereo_rig()
    write_wand(truth, tmp_path / "bag", 30, 0)
    (tmp_path / "lab").mkdir()
    unplaced = replace(truth, rotations=np.tile(np.eye(3), (2, 1, 1)), translations=np.zeros((2, 3)))
    save_rig(unplaced, tmp_path / "lab" / setup.RIG)
    words = ["wand", str(tmp_path / "bag"), "--setup", str(tmp_path / "lab"), "--diameter", str(DIAMETER)]
    assert cli.main(["markers", *words, "--places", ",".join(map(str, RENDERED_WAND))]) == 0
    found = load_rig(tmp_path / "lab" / setup.RIG)
    # the wand's length is stated to 0.1 mm of 300, which is 0.16 mm of the distance of the cameras
    np.testing.assert_allclose(found.translations, truth.translations, atol=0.5e-3)
    np.testing.assert_allclose(found.rotations, truth.rotations, atol=0.5e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--places", "0,a"], "--places '0,a': expected metres along the wand"),
        (["--places", "0,0.1,0.2"], "balls of the wand at even distances have no order"),
        (["--places", "0,0.1,0.3", "--lenses", "{waved}/first"], "camera a is in another folder too"),
    ],
)
def test_a_wand_that_does_not_serve_is_refused_in_one_line(
    waved: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [word.format(waved=waved) for word in words]
    base = ["markers", "wand", str(waved / "bag"), "--setup", str(waved / "first"), "--lenses", str(waved / "first")]
    assert cli.main([*base, *given]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["target", "{bag}", "--name", "a", "--balls", "4"], "no frame with 4 points; 5 in 60 frames"),
        (["fit", "{bag}", "--joint", "elbow:knee:a:b"], "joint 'elbow:knee:a:b': expected NAME:KIND:PARENT:CHILD"),
        (
            ["fit", "{bag}", "--joint", "wrist:hinge:hand:hnad"],
            "joint wrist: no target 'hnad' in {folder}/targets.yaml",
        ),
        (["angles", "{bag}", "-o", "{folder}/out"], "chain.yaml: no such file; body_tracking markers fit makes it"),
        (["calibrate", "--camera", "left", "--columns", "9", "--rows", "6", "--square", "0.1"], "expected NAME=FOLDER"),
        (
            ["calibrate", "--camera", "left={folder}/x", "--columns", "9", "--rows", "6", "--square", "0.1"],
            "camera left: no file in {folder}/x, or no such folder",
        ),
    ],
)
def test_unusable_recordings_are_refused_in_one_line(
    turned: Path, tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    save_rig(stereo_rig(), tmp_path / setup.RIG)
    save_targets([Target("hand", TARGET_POINTS, np.zeros((15, 15)))], tmp_path / setup.TARGETS)
    given = [word.format(bag=turned / "bag", folder=tmp_path) for word in words]
    assert cli.main(["markers", *given, "--setup", str(tmp_path)]) == 2
    out = capsys.readouterr()
    assert said.format(folder=tmp_path) in out.err and out.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_rig_that_a_wand_has_placed_is_not_replaced_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_rig(stereo_rig(), tmp_path / setup.RIG)
    before = (tmp_path / setup.RIG).read_bytes()
    (tmp_path / "boards").mkdir()
    cv2.imwrite(str(tmp_path / "boards" / "0.png"), np.zeros((48, 64), np.uint8))
    board = ["--camera", f"left={tmp_path / 'boards'}", "--columns", "9", "--rows", "6", "--square", "0.1"]
    words = ["markers", "calibrate", "--setup", str(tmp_path), *board]
    assert cli.main(words) == 2
    assert "rig.yaml: exists already; --overwrite replaces it" in capsys.readouterr().err
    assert cli.main([*words, "--overwrite"]) == 2
    assert "exists already" not in capsys.readouterr().err
    assert (tmp_path / setup.RIG).read_bytes() == before


def test_a_chain_is_not_replaced_without_a_word(
    turned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / setup.CHAIN).write_text("kept")
    words = ["fit", str(turned / "bag"), "--setup", str(tmp_path), "--joint", "wrist:hinge:hand:arm"]
    assert cli.main(["markers", *words]) == 2
    assert "chain.yaml: exists already; --overwrite replaces it" in capsys.readouterr().err
    assert (tmp_path / setup.CHAIN).read_text() == "kept"


def test_few_boards_are_a_warning() -> None:
    """Of a board of 9 x 6 corners, 8 x 6 were found in a third of the images, and gave a wrong rig."""
    assert found_boards(["left", "right"], [12, 7], 12) == ["boards: left in 12 of 12 images, right in 7 of 12 images"]
    _, warning = found_boards(["left", "right"], [4, 6], 12)
    assert warning.endswith("columns and rows count the inner corners, not the squares")


def test_images_without_a_rig_are_refused_with_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = Path(__file__).resolve().parents[2] / "bags" / "markers_arm"
    save_targets([Target("hand", TARGET_POINTS, np.zeros((15, 15)))], tmp_path / setup.TARGETS)
    assert cli.main(["markers", "angles", str(shipped), "--setup", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert f"Images need {tmp_path / setup.RIG}, which is not there" in capsys.readouterr().err
