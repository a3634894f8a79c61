"""Calibration of cameras from boards: real images, boards that are wrong, and stated deviations over seeds."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from rigs import rig, seen_boards

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import bundle
from body_tracking.markers.boards import BoardError, CharucoBoard, Chessboard
from body_tracking.markers.bundle import Corners
from body_tracking.markers.bundle_points import Lengths, Sightings, adjust_points
from body_tracking.markers.calibration_report import table
from body_tracking.markers.camera_calibration import (
    CalibrationError,
    CameraCalibration,
    calibrate_cameras,
    find_boards,
)
from body_tracking.markers.rig import Rig
from body_tracking.markers.wand import intersect
from draws import draws, some

BOARD = Chessboard(9, 6, 0.025)
FRAMES, SIZES = ("left", "right"), ((640, 480), (640, 480))


@lru_cache
def chessboards(folder: Path) -> Corners:
    """The corners of the nine real pairs."""
    images = [
        [cv2.imread(str(folder / f"{side}{view:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for view in range(1, 10)]
        for side in FRAMES
    ]
    return find_boards(BOARD, images)


@lru_cache
def from_chessboards(folder: Path) -> CameraCalibration:
    return calibrate_cameras(FRAMES, SIZES, chessboards(folder))


def edge_errors(rig: Rig, corners: Corners) -> FloatArray:
    """Relative errors (n,) of the triangulated edges of the board's squares, from all cameras that see both ends."""
    index = np.rint(corners.board[:, :2] / BOARD.square).astype(np.intp)
    numbers = index[:, 0] + BOARD.columns * index[:, 1]
    sightings = Sightings(corners.cameras, corners.views, numbers, corners.pixels)
    points, edges = intersect(rig, sightings, BOARD.columns * BOARD.rows), BOARD.edges()
    known = np.asarray(points.any(axis=-1))
    lengths = np.linalg.norm(points[:, edges[:, 1]] - points[:, edges[:, 0]], axis=-1)
    return (lengths / BOARD.square - 1.0)[known[:, edges].all(axis=-1)]


def left_out_edge_errors(corners: Corners) -> FloatArray:
    """As :func:`edge_errors`, but each view by the calibration from all other views."""
    errors = []
    for view in np.unique(corners.views):
        here = corners.views == view
        errors.append(edge_errors(calibrate_cameras(FRAMES, SIZES, corners.where(~here)).rig, corners.where(here)))
    return np.concatenate(errors)


def test_nine_real_pairs_are_calibrated_to_a_fifth_of_a_pixel(shared_data: Path) -> None:
    folder = shared_data / "stereo_chessboard"
    corners, calibration = chessboards(folder), from_chessboards(folder)
    inside = np.abs(edge_errors(calibration.rig, corners)).mean()
    outside = np.abs(left_out_edge_errors(corners)).mean()
    rms = calibration.adjusted.rms()
    print(f"RMS {rms:.3f} px, edges {100 * inside:.2f} %, of boards left out {100 * outside:.2f} %")
    assert len(corners) == 972 and not calibration.rejected
    assert rms < 0.23 and inside < 0.0062 and outside < 0.0065
    text = table(calibration)  # printed by `markers calibrate`
    assert re.search(r"camera left\n  fx +533\.\d\d \+- 0\.3\d px\n", text)
    assert re.search(r"t +\[-83\.\d\d .* mm, 83\.\d\d \+- 0\.0\d mm\n", text)
    place = re.search(r"at +(\S+) (\S+) (\S+) mm in the first camera's frame", text)  # as `markers wand` prints it
    rig = calibration.rig
    assert place and np.allclose(
        -1e3 * rig.rotations[1].T @ rig.translations[1], [*map(float, place.groups())], atol=0.06
    )
    assert re.search(r"residual +x 0\.1\d\d px, y 0\.1\d\d px; as OpenCV gives it, of the 2D norm: 0\.2\d\d px", text)


def wrong(corners: Corners, kind: str, view: int, camera: int, rng: np.random.Generator) -> Corners:
    """Corners with one board in one image that is wrong."""
    pixels = np.array(corners.pixels)
    mine = np.flatnonzero((corners.views == view) & (corners.cameras == camera))
    grid = pixels[mine].reshape(6, 9, 2)
    other = np.flatnonzero((corners.views == (view + 1) % 9) & (corners.cameras == camera))
    made = {
        "turned": grid[::-1, ::-1],
        "mirrored": grid[:, ::-1],
        "a column off": np.concatenate([grid[:, 1:], 2.0 * grid[:, -1:] - grid[:, -2:-1]], axis=1),
        "of another pair": pixels[other].reshape(6, 9, 2),
        "scattered": grid + 8.0 * rng.normal(size=grid.shape),
        "a little scattered": grid + 1.5 * rng.normal(size=grid.shape),
        "one corner wrong": grid + (np.arange(54) == 21).reshape(6, 9, 1) * np.array([15.0, 8.0]),
        "swapped": pixels[other].reshape(6, 9, 2),
    }[kind]
    if kind == "swapped":
        pixels[other] = pixels[mine]
    pixels[mine] = made.reshape(-1, 2)
    return replace(corners, pixels=pixels)


@pytest.mark.parametrize(
    "kind",
    some(
        [
            "turned",
            "mirrored",
            "a little scattered",
            "scattered",
            "one corner wrong",
            "of another pair",
            "swapped",
            "a column off",
        ],
        4,
    ),
)
def test_a_wrong_board_is_named_and_left_out(shared_data: Path, kind: str) -> None:
    folder = shared_data / "stereo_chessboard"
    corners = chessboards(folder)
    usual = np.abs(edge_errors(from_chessboards(folder).rig, corners)).mean()
    for view in some(range(9), 2):
        camera = view % 2
        bad = wrong(corners, kind, view, camera, np.random.default_rng(view))
        calibration = calibrate_cameras(FRAMES, SIZES, bad)
        expected = {view, (view + 1) % 9} if kind == "swapped" else {view}
        assert {each.view for each in calibration.rejected} == expected
        assert f"left out: view {view}" in table(calibration)
        edges = np.abs(edge_errors(calibration.rig, corners)).mean()
        assert abs(edges - usual) < 0.0005


def test_three_cameras_identify_the_wrong_board() -> None:
    truth, rng = rig(3), np.random.default_rng(0)
    corners = seen_boards(truth, rng)
    # a view that all cameras see
    view = next(view for view in range(13) if len(np.unique(corners.cameras[corners.views == view])) == 3)
    mine = np.flatnonzero((corners.views == view) & (corners.cameras == 1))
    pixels = np.array(corners.pixels)
    pixels[mine] = pixels[mine[::-1]]
    calibration = calibrate_cameras("abc", [(640, 480)] * 3, replace(corners, pixels=pixels))
    assert [(each.view, each.camera) for each in calibration.rejected] == [(view, "b")]


def errors(truth: Rig, made: Rig) -> FloatArray:
    """(p,) corrections that turn a calibration's parameters into the true ones."""
    parts = []
    for index, (there, here) in enumerate(zip(truth.cameras, made.cameras, strict=True)):
        turn = so3.rotation_vectors(truth.rotations[index] @ made.rotations[index].T)
        parts += [
            (there.matrix - here.matrix)[[0, 1, 0, 1], [0, 1, 2, 2]],
            there.distortion - here.distortion,
            turn,
            truth.translations[index] - made.translations[index],
        ]
    return np.concatenate(parts)


@pytest.mark.slow
@pytest.mark.parametrize("count", some([2, 3]))
def test_errors_of_parameters_are_within_their_stated_deviations(count: int) -> None:
    truth, standard = rig(count), []
    for seed in range(20 if count == 2 else draws(8, 20)):
        calibration = calibrate_cameras(
            "abc"[:count], [(640, 480)] * count, seen_boards(truth, np.random.default_rng(seed))
        )
        deviation = np.sqrt(np.diag(calibration.rig.covariance))
        free = deviation > 0.0
        assert free.sum() == 6 * count + 6 * (count - 1)
        standard.append(errors(truth, calibration.rig)[free] / deviation[free])
        assert not calibration.rejected and 0.09 < calibration.adjusted.noise < 0.11
    share = (np.abs(standard) < 1.96).mean()
    print(f"{count} cameras: {100 * share:.1f} % of errors within 1.96 deviations")
    assert 0.90 < share < 0.99  # as a rule 95; the parameters of one calibration go together


def charuco(folder: Path) -> tuple[Corners, Rig]:
    """The corners of the real recording, and the rig that caliscope made of it."""
    with (folder / "camera_array.toml").open("rb") as file:
        entries = tomllib.load(file)["cameras"]
    cameras = tuple(
        Camera(f"camera{key}", *entry["size"], np.array(entry["matrix"]), np.array(entry["distortions"]))
        for key, entry in sorted(entries.items())
    )
    turns = np.array([entry["rotation"] for _, entry in sorted(entries.items())])
    shifts = np.array([entry["translation"] for _, entry in sorted(entries.items())])
    rotations = turns @ turns[0].T
    theirs = Rig(cameras, rotations, shifts - rotations @ shifts[0], np.zeros((60, 60)))
    rows = np.genfromtxt(folder / "xy.csv", delimiter=",", names=True)
    corners = Corners(
        rows["cam_id"].astype(np.intp),
        np.unique(rows["sync_index"], return_inverse=True)[1],
        np.column_stack([rows["board_loc_x"], rows["board_loc_y"], np.zeros(len(rows))]),
        np.column_stack([rows["img_loc_x"], rows["img_loc_y"]]),
    )
    return corners, theirs


@pytest.mark.slow
def test_four_real_cameras_fit_a_charuco_board_better_than_in_the_calibration_that_came_with_them(
    shared_data: Path,
) -> None:
    corners, theirs = charuco(shared_data / "multi_camera_charuco")
    # from cameras some degrees and centimetres from theirs
    start = np.zeros((4, 15))
    start[1:, 9:] = np.random.default_rng(0).normal(0.0, 0.03, (3, 6))
    placed = theirs.changed(start.ravel())
    # the board is no plane: its corners are free points, its squares have their edges
    column, row = np.rint(corners.board[:, :2].T / 0.054).astype(np.intp) - 1
    seen = Sightings(corners.cameras, corners.views, column + 3 * row, corners.pixels)
    key = seen.views * 12 + seen.points
    seen = seen.where(np.bincount(key)[key] > 1)
    edges = Lengths(Chessboard(3, 4, 0.054).edges(), np.full(17, 0.054), 5e-4)
    poses = bundle.free_parameters(placed, lenses=False)
    mine = adjust_points(placed, intersect(placed, seen, 12), seen, edges, poses, 0.5)
    # their cameras fixed, with points of our own (one focal length is free, and moves by its last digits)
    free = np.arange(60) == 0
    other = adjust_points(theirs, intersect(theirs, seen, 12), seen, edges, free, 0.5)
    print(f"RMS {mine.rms():.3f} px, of caliscope's cameras {other.rms():.3f}")
    assert mine.rms() <= other.rms()
    turn = so3.rotation_vectors(mine.rig.rotations @ theirs.rotations.transpose(0, 2, 1))
    assert np.linalg.norm(turn, axis=-1).max() < np.radians(0.5)
    assert np.linalg.norm(mine.rig.translations - theirs.translations, axis=-1).max() < 0.01


def test_boards_are_found_in_drawn_images() -> None:
    square, board = 24, Chessboard(7, 5, 0.03)
    colour = (np.add.outer(np.arange(6), np.arange(8)) % 2 * 255).astype(np.uint8)
    image = np.pad(np.kron(colour, np.ones((square, square), np.uint8)), 40, constant_values=255)
    found = board.find(cv2.GaussianBlur(image, (5, 5), 1.0))
    assert found is not None
    expected = board.corners[:, :2] / 0.03 * square + 40 + square - 0.5
    turned = expected[::-1]  # the board looks the same from the other end
    missed = min(np.abs(found[1] - each).max() for each in (expected, turned))
    assert missed < 0.05
    assert board.find(np.full((200, 200), 128, np.uint8)) is None
    with pytest.raises(BoardError, match="expected"):
        board.find(np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(BoardError, match="at least 3 x 3"):
        Chessboard(2, 6, 0.03)


def test_a_charuco_board_is_found_with_a_part_hidden() -> None:
    board = CharucoBoard(7, 5, 0.04, 0.03, "DICT_4X4_50")
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    if hasattr(cv2.aruco, "CharucoDetector"):
        image = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary).generateImage((7 * 60, 5 * 60))
    else:  # before OpenCV 4.7
        image = cv2.aruco.CharucoBoard_create(7, 5, 0.04, 0.03, dictionary).draw((7 * 60, 5 * 60))
    image = np.pad(image, 50, constant_values=255)
    image[:140, :200] = 255
    found = board.find(cv2.GaussianBlur(image, (5, 5), 1.0))
    assert found is not None
    numbers, pixels = found
    assert 12 <= len(numbers) < 24
    np.testing.assert_allclose(pixels, board.corners[numbers, :2] / 0.04 * 60 + 49.5, atol=0.2)
    with pytest.raises(BoardError, match="dictionary"):
        CharucoBoard(7, 5, 0.04, 0.03, "DICT_NONE")


def test_what_is_missing_is_named() -> None:
    truth, rng = rig(), np.random.default_rng(0)
    corners = seen_boards(truth, rng)
    with pytest.raises(CalibrationError, match=r"camera b: 2 usable boards"):
        calibrate_cameras("ab", SIZES, corners.where((corners.cameras == 0) | (corners.views < 2)))
    apart = replace(corners, views=corners.views + 20 * corners.cameras)
    with pytest.raises(CalibrationError, match="cameras b share no good board with a"):
        calibrate_cameras("ab", SIZES, apart)
    broken = np.array(corners.pixels)
    broken[0] = np.nan
    with pytest.raises(CalibrationError, match="not finite"):
        calibrate_cameras("ab", SIZES, replace(corners, pixels=broken))
    with pytest.raises(CalibrationError, match="2 frames, 1 sizes"):
        calibrate_cameras("ab", SIZES[:1], corners)
    with pytest.raises(CalibrationError, match="in none"):
        find_boards(BOARD, [[None], [np.full((100, 100), 9, np.uint8)]])
