"""Points of other motion capture systems from C3D files and Motive exports, in the form of the rig's points.

They replace those of :mod:`body_tracking.markers.triangulation`. Labels are dropped, except for measuring a target.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core import c3d
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import MAX_RANGE, NANOSECONDS, FloatArray
from body_tracking.core.times import MAX_STAMP_NS
from body_tracking.markers.motive_csv import is_motive_csv, read_motive_csv
from body_tracking.markers.observations import Points

C3D_SUFFIX: Final = ".c3d"
FRAME: Final = "mocap"
"""The frame of points from other systems."""
DEFAULT_NOISE: Final = 5e-4
"""Metres, standard deviation of each coordinate: between vendors' specifications (0.2 mm) and balls on skin."""
EMPTY: Final = "frames without a point"
BACKWARDS: Final = "frames whose time does not advance"
FAR: Final = f"points farther away than {MAX_RANGE:.0f} m: is the unit of length right?"


class TrajectoryError(BodyTrackingError):
    """Raised when a file of points lacks the requested content."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """Points over time.

    Attributes:
        labels: of the first points; further points have none.
        positions: (n, p, 3) metres, NaN where a point is unseen; z up if the file states its vertical axis.
        stamps_ns: n capture times in nanoseconds, by the file's clock.
        warnings: one line per irregularity.
    """

    labels: tuple[str, ...]
    positions: FloatArray
    stamps_ns: tuple[int, ...]
    warnings: tuple[str, ...] = ()

    def chosen(self, labels: Collection[str]) -> FloatArray:
        """(n, k, 3) positions of the points with these labels, in their order.

        Raises:
            TrajectoryError: a label of no point or of several; the message lists the file's labels.
        """
        for label in labels:
            if self.labels.count(label) != 1:
                count = self.labels.count(label) or "no"
                there = c3d.listed(sorted(set(self.labels)))
                raise TrajectoryError(f"{count} points with the label {label!r}; the labels are {there}")
        return self.positions[:, [self.labels.index(label) for label in labels]]


def labels_in(text: str) -> tuple[str, ...]:
    """The labels in a comma-separated list."""
    return tuple(each.strip() for each in text.split(",") if each.strip())


def is_trajectory_file(path: Path) -> bool:
    """Whether a file holds points of another motion capture system: ``.c3d``, or an export of Motive.

    Raises:
        CsvError: a ``.csv`` file that cannot be read.
    """
    if not path.is_file():
        return False
    return path.suffix.lower() == C3D_SUFFIX or (
        path.name.lower().endswith((".csv", ".csv.gz")) and is_motive_csv(path)
    )


def read_trajectories(path: Path, partial: bool = False) -> Trajectories:
    """The points in a file.

    Args:
        path: a file for which :func:`is_trajectory_file` holds.
        partial: read a truncated file up to its last whole frame.

    Raises:
        BodyTrackingError: the file cannot be read, or has no points.
    """
    if path.suffix.lower() != C3D_SUFFIX:
        motive = read_motive_csv(path, partial)
        # Motive's y points up
        return Trajectories(motive.labels, motive.positions[..., c3d.UP_FIRST["+Y"]], motive.stamps_ns, motive.warnings)
    file = c3d.read_points(path)
    if file.cut and not partial:
        raise TrajectoryError(f"{path}: {file.cut} (--partial reads these)")
    warnings = [f"{path}: {file.cut}"] if file.cut else []
    if file.up not in c3d.UP_FIRST:
        said = f"says that {file.up} points up" if file.up else "does not say which axis points up"
        warnings.append(f"{path}: {said} (POINT:Y_SCREEN); its axes are kept")
    kept = [
        index
        for index in range(file.data.shape[1])
        if index >= len(file.labels) or file.labels[index] not in file.computed
    ]
    order = c3d.UP_FIRST.get(file.up, (0, 1, 2))
    return Trajectories(
        tuple(file.labels[index] for index in kept if index < len(file.labels)),
        file.scale * file.data[:, kept][..., order],
        tuple(round(stamp * NANOSECONDS) for stamp in file.stamps.tolist()),
        tuple(warnings),
    )


@dataclass(frozen=True, slots=True, eq=False)
class RecordedPoints:
    """The points of one frame; ``received_ns`` is the file's time."""

    sensor: str
    received_ns: int
    points: Points


class TrajectoryRecording:
    """Iterates over the frames of a file, without labels.

    Args:
        path: a file for which :func:`is_trajectory_file` holds.
        labels: of the points to read; if empty all points, also those without a label.
        noise: standard deviation of each coordinate, metres.
        partial: read a truncated file up to its last whole frame.

    Attributes:
        problems: counts of irregularities, by kind.
        warnings: one line per missing part.
        progress: share of the file read, 0 to 1.

    Raises:
        BodyTrackingError: while iterating, if the file cannot be read or lacks a label.
    """

    def __init__(
        self, path: Path, labels: Collection[str] = (), noise: float = DEFAULT_NOISE, partial: bool = False
    ) -> None:
        self._path, self._labels, self._noise, self._partial = path, tuple(labels), noise, partial
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self.progress = 0.0

    def __iter__(self) -> Iterator[RecordedPoints]:
        file = read_trajectories(self._path, self._partial)
        try:
            positions = file.chosen(self._labels) if self._labels else file.positions
        except TrajectoryError as error:
            raise TrajectoryError(f"{self._path}: {error}") from error
        self.problems, self.warnings = {}, list(file.warnings)
        last_ns = -1
        for number, (stamp_ns, points) in enumerate(zip(file.stamps_ns, positions, strict=True)):
            self.progress = number / len(positions)
            if not last_ns < stamp_ns <= MAX_STAMP_NS:
                self._count(BACKWARDS)
                continue
            last_ns = stamp_ns
            seen = points[np.isfinite(points).all(axis=1)]
            near = seen[(np.abs(seen) < MAX_RANGE).all(axis=1)]
            self._count(FAR, len(seen) - len(near))
            self._count(EMPTY, not len(near))
            yield RecordedPoints("markers", stamp_ns, points_of(near, stamp_ns, FRAME, self._noise))

    def _count(self, problem: str, number: int = 1) -> None:
        if number:
            self.problems[problem] = self.problems.get(problem, 0) + number


def points_of(positions: FloatArray, stamp_ns: int, frame_id: str, noise: float) -> Points:
    """(n, 3) positions in metres as points whose coordinates have equal noise (standard deviation, metres)."""
    covariance = np.broadcast_to(noise**2 * np.eye(3), (len(positions), 3, 3))
    return Points(stamp_ns, frame_id, positions, covariance, np.empty((len(positions), 0), dtype=np.intp))
