"""Calibration boards in images: chessboards and ChArUco boards, with corners to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray

WINDOW: Final = 0.3
"""Half width of the window of a corner's subpixel search, in squares. A window that reaches the next corner pulls the
estimate to it (11 px on squares of 20 px: RMS 0.50 px instead of 0.21)."""
_MIN_HALF: Final = 2
"""Pixels: OpenCV's search needs a window of five."""
_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)

Image = NDArray[np.uint8]
_CV: Any = cv2


class BoardError(BodyTrackingError):
    """Raised for an impossible board, an unreadable image, or an OpenCV without the detector."""


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard.

    Attributes:
        columns: inner corners per row.
        rows: number of rows of inner corners.
        square: width of a square, metres.

    Raises:
        BoardError: fewer than three corners either way (OpenCV's limit), or squares without a width.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0.0 < self.square < np.inf:
            raise BoardError(
                f"board of {self.columns} x {self.rows} inner corners, squares of {self.square} m; "
                "expected at least 3 x 3 and a width"
            )

    @property
    def corners(self) -> FloatArray:
        """(n, 3) the inner corners in the board's frame, metres, row by row; z is 0."""
        return _grid(self.columns, self.rows) * self.square

    def edges(self) -> IntArray:
        """(e, 2) indices of neighbouring corners."""
        index = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=-1)
        down = np.stack([index[:-1].ravel(), index[1:].ravel()], axis=-1)
        return np.concatenate([across, down]).astype(np.intp)

    def find(self, image: Image) -> tuple[IntArray, FloatArray] | None:
        """Indices (n,) and pixels (n, 2) of all corners of the board in a grey image; None if the board is not found.

        Raises:
            BoardError: not a grey image of 8 bits.
        """
        _check(image)
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = _CV.findChessboardCorners(image, (self.columns, self.rows), flags=flags)
        if not found:
            return None
        grid = np.asarray(corners, dtype=np.float64).reshape(self.rows, self.columns, 2)
        spacing = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
        return np.arange(self.columns * self.rows, dtype=np.intp), _refined(
            image, grid.reshape(-1, 2), WINDOW * spacing
        )


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares: corners are numbered, and some may be hidden.

    Attributes:
        columns: squares per row.
        rows: number of rows of squares.
        square: width of a square, metres.
        marker: width of a marker, metres.
        dictionary: of the markers, by OpenCV's name ("DICT_4X4_1000").

    Raises:
        BoardError: fewer than three squares either way, widths that do not fit, an unknown dictionary.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0.0 < self.marker < self.square < np.inf:
            raise BoardError(
                f"board of {self.columns} x {self.rows} squares of {self.square} m with markers of {self.marker} m; "
                "expected at least 3 x 3, markers smaller than squares"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(_CV.aruco, self.dictionary):
            raise BoardError(f"dictionary of markers {self.dictionary!r}, which OpenCV does not have")

    @property
    def corners(self) -> FloatArray:
        """(n, 3) the inner corners in the board's frame, metres, row by row; z is 0."""
        return (_grid(self.columns - 1, self.rows - 1) + [1.0, 1.0, 0.0]) * self.square

    def find(self, image: Image) -> tuple[IntArray, FloatArray] | None:
        """Indices (n,) and pixels (n, 2) of the corners in a grey image; None if fewer than four are found.

        Raises:
            BoardError: not a grey image of 8 bits.
        """
        _check(image)
        aruco, size = _CV.aruco, (self.columns, self.rows)
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, self.dictionary))
        if hasattr(aruco, "CharucoDetector"):  # since OpenCV 4.7
            board = aruco.CharucoBoard(size, self.square, self.marker, dictionary)
            corners, ids, _, _ = aruco.CharucoDetector(board).detectBoard(image)
        else:
            board = aruco.CharucoBoard_create(*size, self.square, self.marker, dictionary)
            markers, marker_ids, _ = aruco.detectMarkers(image, dictionary)
            if marker_ids is None:
                return None
            _, corners, ids = aruco.interpolateCornersCharuco(markers, marker_ids, image, board)
        if ids is None or len(ids) < 4:
            return None
        numbers, pixels = np.asarray(ids, dtype=np.intp).ravel(), np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        board_width = np.linalg.norm(self.corners[numbers, None] - self.corners[None, numbers], axis=-1)
        pixel_width = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
        neighbours = np.abs(board_width - self.square) < 1e-3 * self.square
        spacing = float(pixel_width[neighbours].min()) if neighbours.any() else 0.0
        # the window must not reach the markers either
        reach = min(WINDOW, 0.5 * (1.0 - self.marker / self.square))
        return numbers, _refined(image, pixels, reach * spacing)


def _grid(columns: int, rows: int) -> FloatArray:
    grid = np.zeros((rows, columns, 3))
    grid[:, :, 0], grid[:, :, 1] = np.arange(columns), np.arange(rows)[:, None]
    return grid.reshape(-1, 3)


def _check(image: Image) -> None:
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        raise BoardError(f"image {image.shape} {image.dtype}, expected (height, width) uint8")


def _refined(image: Image, corners: FloatArray, reach: float) -> FloatArray:
    """Subpixel corners (n, 2) from the image within ``reach`` pixels."""
    half = max(_MIN_HALF, int(reach))
    start = np.ascontiguousarray(corners.reshape(-1, 1, 2), dtype=np.float32)
    refined = _CV.cornerSubPix(image, start, (half, half), (-1, -1), _CRITERIA)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)
