"""Calibration of the cameras of a rig from images of a board (Gaschler 4.1), with the covariance of the result.

Each camera is first calibrated alone (Zhang 2000, by OpenCV; eq. 4.8), boards give the relative poses of the cameras,
and a bundle adjustment fits everything together (eq. 4.9). Boards that contradict the others (corners counted from
another end, false detections, another instant) are rejected and named: by the homography of a plane, by each camera's
fit, by where other cameras see the board, and by the residuals of the adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers import bundle, projection
from body_tracking.markers.boards import CharucoBoard, Chessboard, Image
from body_tracking.markers.bundle import Adjusted, Corners
from body_tracking.markers.rig import Rig

MIN_CORNERS: Final = 6
"""Least number of a board's corners in an image: four determine its pose, without redundancy to check it."""
MIN_BOARDS: Final = 3
"""Least number of boards in a camera's images: two determine a camera's matrix (Zhang 2000), one more checks it."""
_PLANE: Final = (4.0, 2.0)
"""A board is rejected if its RMS about its homography exceeds the first number times the camera's median plus the
second number of pixels: lens distortion, which a homography does not model, bends rows by pixels."""
_SINGLE: Final = (4.0, 0.3)
"""Bound of a board's RMS in its camera's own calibration; same form."""
_ACROSS: Final = (5.0, 3.0)
"""Bound of the distance between a board and its prediction from another camera, median over corners; same form."""
_ADJUSTED: Final = (2.0, 0.1)
"""Bound of a board's RMS in the bundle adjustment; same form."""
_CV: Any = cv2


class CalibrationError(BodyTrackingError):
    """Raised when cameras cannot be calibrated from their images."""


@dataclass(frozen=True, slots=True)
class Rejected:
    """A board that was left out.

    Attributes:
        view: index of the instant.
        camera: frame of the camera whose board it is; None where two cameras contradict each other and the wrong one is
            unknown.
        reason: in words.
    """

    view: int
    camera: str | None
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """Calibrated cameras.

    Attributes:
        rig: with its covariance.
        adjusted: the bundle adjustment.
        corners: the corners used, in the order of the residuals.
        rejected: boards left out.
    """

    rig: Rig
    adjusted: Adjusted
    corners: Corners
    rejected: tuple[Rejected, ...]

    def rms(self) -> FloatArray:
        """(c,) root mean square of each camera's 2D residual norm, pixels, as OpenCV defines it."""
        return np.array([self.adjusted.rms(self.corners.cameras == index) for index in range(len(self.rig.cameras))])

    def rms_by_axis(self) -> FloatArray:
        """(c, 2) root mean square of each camera's residuals in x and in y, pixels, as in Gaschler's table 4.1."""
        return np.stack(
            [
                np.sqrt((self.adjusted.residuals[self.corners.cameras == index] ** 2).mean(axis=0))
                for index in range(len(self.rig.cameras))
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A board in an image: row indices of its corners, and its pose in the camera's frame."""

    rows: IntArray
    rotation: FloatArray
    translation: FloatArray


def find_boards(board: Chessboard | CharucoBoard, images: Sequence[Sequence[Image | None]]) -> Corners:
    """Corners of a board in images.

    Args:
        board: the board.
        images: per camera a sequence of grey images, one per instant; None where a camera has none.

    Raises:
        BoardError: an image of another shape or type.
        CalibrationError: cameras with different numbers of images, or no board in any image.
    """
    if len({len(each) for each in images}) != 1:
        raise CalibrationError(f"{', '.join(str(len(each)) for each in images)} images; each camera needs one a view")
    parts: list[tuple[int, int, IntArray, FloatArray]] = []
    for camera, series in enumerate(images):
        for view, image in enumerate(series):
            found = None if image is None else board.find(image)
            if found is not None:
                parts.append((camera, view, *found))
    if not parts:
        hint = "; columns and rows count the inner corners, not the squares" if isinstance(board, Chessboard) else ""
        raise CalibrationError(f"the board is in none of the images{hint}")
    counts = [len(numbers) for _, _, numbers, _ in parts]
    return Corners(
        np.repeat(np.array([camera for camera, *_ in parts], dtype=np.intp), counts),
        np.repeat(np.array([view for _, view, *_ in parts], dtype=np.intp), counts),
        board.corners[np.concatenate([numbers for _, _, numbers, _ in parts])],
        np.concatenate([pixels for *_, pixels in parts]),
    )


def calibrate_cameras(
    frames: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    corners: Corners,
) -> CameraCalibration:
    """Calibrate one camera or more, and their poses to each other.

    Gaschler (2011): eq. 4.8.

    Args:
        frames: of the cameras; the first one is the rig's frame.
        sizes: width and height of each camera's images, pixels.
        corners: of a flat board (z = 0), seen at instants common to the cameras.

    Raises:
        CalibrationError: a camera sees too few good boards or shares none with the others, or a pixel is not finite.
    """
    if len(frames) != len(sizes):
        raise CalibrationError(f"{len(frames)} frames, {len(sizes)} sizes of images")
    _check(corners, len(frames))
    rejected: list[Rejected] = []
    seen: list[dict[int, _Seen]] = []
    cameras: list[Camera] = []
    for index, (frame, size) in enumerate(zip(frames, sizes, strict=True)):
        camera, boards = _single_camera(frame, size, index, corners, rejected)
        cameras.append(camera)
        seen.append(boards)
    rotations, translations = _camera_poses(cameras, seen, corners)
    count = sum(projection.size(camera) for camera in cameras)
    placed = Rig(tuple(cameras), rotations, translations, np.zeros((count, count)))
    _reject_contradictions(placed, seen, corners, rejected)
    return _adjusted(placed, seen, corners, rejected)


def _check(corners: Corners, cameras: int) -> None:
    if not (np.isfinite(corners.pixels).all() and np.isfinite(corners.board).all()) or corners.board[:, 2].any():
        raise CalibrationError("a corner is not finite, or the board not flat (z = 0 in its own frame)")
    if len(corners) and not 0 <= corners.cameras.min() <= corners.cameras.max() < cameras:
        raise CalibrationError(f"corners in camera {corners.cameras.max()} of {cameras} cameras")


def _too_large(values: FloatArray, bound: tuple[float, float]) -> BoolArray:
    return np.asarray(values > bound[0] * np.median(values) + bound[1])


def _planar(rows: IntArray, corners: Corners) -> float:
    """RMS of a board's corners about their homography, pixels; infinite if OpenCV finds no homography."""
    homography, _ = _CV.findHomography(corners.board[rows, :2], corners.pixels[rows])
    if homography is None:
        return float("inf")
    mapped = np.column_stack([corners.board[rows, :2], np.ones(len(rows))]) @ np.asarray(homography).T
    missed = mapped[:, :2] / mapped[:, 2:] - corners.pixels[rows]
    return float(np.sqrt((missed**2).sum(axis=-1).mean()))


def _planar_boards(frame: str, index: int, corners: Corners, rejected: list[Rejected]) -> dict[int, IntArray]:
    """Rows of the corners of each board in a camera's images; boards whose corners are not coplanar are rejected."""
    of_camera = corners.cameras == index
    boards = {int(view): np.flatnonzero(of_camera & (corners.views == view)) for view in np.unique(corners.views)}
    # fewer than MIN_CORNERS, and collinear corners, determine no homography
    boards = {
        view: rows
        for view, rows in boards.items()
        if len(rows) >= MIN_CORNERS
        and np.linalg.svd(corners.board[rows, :2] - corners.board[rows, :2].mean(axis=0))[1][1] > 1e-9
    }
    _check_count(frame, boards)
    errors = np.array([_planar(rows, corners) for rows in boards.values()])
    return _without(boards, _too_large(errors, _PLANE), frame, errors, "its corners are not of a plane", rejected)


def _single_camera(
    frame: str, size: tuple[int, int], index: int, corners: Corners, rejected: list[Rejected]
) -> tuple[Camera, dict[int, _Seen]]:
    """A camera's own calibration (eq. 4.8) and its boards, without those that are not planar or do not fit."""
    boards = _planar_boards(frame, index, corners, rejected)
    while True:
        _check_count(frame, boards)
        flags = _CV.CALIB_ZERO_TANGENT_DIST | _CV.CALIB_FIX_K3
        try:
            _, matrix, distortion, turns, shifts = _CV.calibrateCamera(
                [corners.board[rows].astype(np.float32) for rows in boards.values()],
                [corners.pixels[rows].astype(np.float32) for rows in boards.values()],
                size,
                None,
                None,
                flags=flags,
            )
        except cv2.error as error:
            raise CalibrationError(f"camera {frame}: OpenCV finds no calibration ({error.err})") from error
        camera = Camera(frame, *size, np.asarray(matrix), np.asarray(distortion).ravel()[:5])
        found = {
            view: _Seen(rows, np.asarray(_CV.Rodrigues(turn)[0]), np.asarray(shift).ravel())
            for (view, rows), turn, shift in zip(boards.items(), turns, shifts, strict=True)
        }
        errors = np.sqrt([(_missed(camera, each, each, corners) ** 2).mean() for each in found.values()])
        wrong = _too_large(errors, _SINGLE) & (errors == errors.max())
        if not wrong.any():
            return camera, found
        boards = _without(boards, wrong, frame, errors, "its corners do not fit the camera", rejected)


def _check_count(frame: str, boards: dict[int, IntArray]) -> None:
    if len(boards) < MIN_BOARDS:
        raise CalibrationError(
            f"camera {frame}: {len(boards)} usable boards of {MIN_CORNERS} corners or more, expected {MIN_BOARDS}"
        )


def _without(
    boards: dict[int, IntArray], wrong: BoolArray, frame: str, errors: FloatArray, reason: str, log: list[Rejected]
) -> dict[int, IntArray]:
    kept = {}
    for (view, rows), bad, error in zip(boards.items(), wrong, errors, strict=True):
        if bad:
            log.append(Rejected(view, frame, f"{reason}: RMS {error:.2f} px, others {np.median(errors):.2f}"))
        else:
            kept[view] = rows
    return kept


def _missed(camera: Camera, pose: _Seen, board: _Seen, corners: Corners) -> FloatArray:
    """(n,) distances between a board's corners in an image and their projections by a pose, pixels; inf if invalid."""
    points = corners.board[board.rows] @ pose.rotation.T + pose.translation
    missed: FloatArray = np.linalg.norm(camera.project(points) - corners.pixels[board.rows], axis=-1)
    return np.where(np.isfinite(missed), missed, np.inf)


def _camera_poses(
    cameras: list[Camera], seen: list[dict[int, _Seen]], corners: Corners
) -> tuple[FloatArray, FloatArray]:
    """Poses (c, 3, 3), (c, 3) of the cameras: a tree from the first camera along pairs that share most boards."""
    count = len(cameras)
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    known, rest = [0], set(range(1, count))
    while rest:
        shared, best, new = max((len(seen[old].keys() & seen[new].keys()), -old, -new) for old in known for new in rest)
        old, new = -best, -new
        if not shared:
            names = ", ".join(cameras[each].frame_id for each in sorted(rest))
            raise CalibrationError(f"cameras {names} share no good board with {cameras[0].frame_id}")
        turn, shift = _relative_pose(cameras[new], seen[old], seen[new], corners)
        rotations[new], translations[new] = turn @ rotations[old], turn @ translations[old] + shift
        known.append(new)
        rest.remove(new)
    return rotations, translations


def _relative_pose(
    camera: Camera, first: dict[int, _Seen], second: dict[int, _Seen], corners: Corners
) -> tuple[FloatArray, FloatArray]:
    """Pose of the second camera in the first: the candidate of one board with the least median reprojection error."""
    views = sorted(first.keys() & second.keys())
    candidates = []
    for view in views:
        turn = second[view].rotation @ first[view].rotation.T
        candidates.append((turn, second[view].translation - turn @ first[view].translation))
    costs = [
        np.median([np.median(_missed(camera, _moved(first[each], *pose), second[each], corners)) for each in views])
        for pose in candidates
    ]
    return candidates[int(np.argmin(costs))]


def _moved(board: _Seen, rotation: FloatArray, translation: FloatArray) -> _Seen:
    return _Seen(board.rows, rotation @ board.rotation, rotation @ board.translation + translation)


def _reject_contradictions(rig: Rig, seen: list[dict[int, _Seen]], corners: Corners, rejected: list[Rejected]) -> None:
    """Reject boards that are not where other cameras see them; both boards if only two contradict each other."""
    distances: dict[tuple[int, int, int], float] = {}
    for a in range(len(seen)):
        for b in range(len(seen)):
            turn = rig.rotations[b] @ rig.rotations[a].T
            shift = rig.translations[b] - turn @ rig.translations[a]
            for view in seen[a].keys() & seen[b].keys() if a != b else ():
                missed = _missed(rig.cameras[b], _moved(seen[a][view], turn, shift), seen[b][view], corners)
                distances[view, a, b] = float(np.median(missed))
    if not distances:
        return
    usual = float(np.median(list(distances.values())))
    bound = _ACROSS[0] * usual + _ACROSS[1]
    for view in sorted({view for view, _, _ in distances}):
        while True:
            present = [index for index, boards in enumerate(seen) if view in boards]
            against = {
                a: sum(max(distances[view, a, b], distances[view, b, a]) > bound for b in present if b != a)
                for a in present
            }
            most = max(against.values(), default=0)
            if not most:
                break
            worst = [a for a, number in against.items() if number == most]
            far = max(distances[view, a, b] for a in worst for b in present if a != b)
            reason = f"not where other cameras see it: {far:.1f} px off, others {usual:.1f}"
            alone = worst[0] if len(worst) == 1 else None
            rejected.append(Rejected(view, None if alone is None else rig.cameras[alone].frame_id, reason))
            for a in worst:
                del seen[a][view]


def _adjusted(
    rig: Rig,
    seen: list[dict[int, _Seen]],
    corners: Corners,
    rejected: list[Rejected],
) -> CameraCalibration:
    """Bundle adjustment; rejects the board with the largest residuals until none exceeds the bound."""
    views = int(corners.views.max()) + 1
    turns, shifts = np.tile(np.eye(3), (views, 1, 1)), np.zeros((views, 3))
    for index in reversed(range(len(seen))):  # the first camera that sees a board gives its initial pose
        for view, board in seen[index].items():
            turns[view] = rig.rotations[index].T @ board.rotation
            shifts[view] = rig.rotations[index].T @ (board.translation - rig.translations[index])
    free = bundle.free_parameters(rig, lenses=True)
    while True:
        for index, camera in enumerate(rig.cameras):
            _check_count(camera.frame_id, {view: board.rows for view, board in seen[index].items()})
        rows = np.concatenate([board.rows for boards in seen for board in boards.values()])
        used = corners.where(np.isin(np.arange(len(corners)), rows))
        adjusted = bundle.adjust(rig, turns, shifts, used, free)
        rig, turns, shifts = adjusted.rig, adjusted.rotations, adjusted.translations
        keys = [(index, view) for index, boards in enumerate(seen) for view in boards]
        errors = np.array([adjusted.rms((used.cameras == index) & (used.views == view)) for index, view in keys])
        worst = int(errors.argmax())
        if not _too_large(errors, _ADJUSTED)[worst]:
            return CameraCalibration(rig, adjusted, used, tuple(rejected))
        index, view = keys[worst]
        present = [each for each, boards in enumerate(seen) if view in boards]
        # with two cameras, one wrong board raises the residuals of both
        alone = len(present) != 2
        reason = f"does not fit the other boards: RMS {errors[worst]:.2f} px, others {np.median(errors):.2f}"
        rejected.append(Rejected(view, rig.cameras[index].frame_id if alone else None, reason))
        for each in [index] if alone else present:
            del seen[each][view]
