"""Skeletons as comma-separated values, ``.csv`` or ``.csv.gz``; the format is described in ``docs/recordings.md``.

A row is one body seen by one sensor at one instant: 25 joints in metres, in the sensor's own Kinect camera space.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from body_tracking.core.csv_file import CsvError, CsvFile
from body_tracking.core.skeleton import JOINT_NAMES, MAX_RANGE, N_JOINTS, Skeleton, TrackingState
from body_tracking.core.sources import NOT_FINITE, RecordedFrame, SensorNameError, check_sensor_name, optical_frame
from body_tracking.kinect.axes import camera_space_to_optical

REPEATED = "stamps that repeat"
BACKWARDS = "stamps that run backwards"
IGNORED = "columns that were not read"
FAR = f"joints farther away than {MAX_RANGE:.0f} m, which nothing uses: coordinates must be metres"

_AXES = ("x", "y", "z")
_COORDINATES = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in _AXES]
_BLOCK_LINES = 1024
_MAX_BODY = 2**16 - 1  # the message numbers bodies in 16 bits


@dataclass(slots=True)
class _Frame:
    """The rows of one frame so far."""

    sensor: str
    stamp_ns: int
    received_ns: int
    skeletons: dict[int, Skeleton] = field(default_factory=dict)

    def finished(self) -> RecordedFrame:
        return RecordedFrame(self.sensor, self.received_ns, tuple(self.skeletons.values()))


class CsvRecording:
    """Reads a CSV recording, a block of lines at a time.

    Consecutive rows of one sensor with the same stamp and different persons are one frame. Stamps are kept as written;
    those that repeat or run backwards are counted in :attr:`problems`.

    Args:
        path: the file; gzip is recognised by the suffix ``.gz``.
        sensor: the sensor's name, for a file without that column; replaces the name in a file of one sensor.
        partial: read a truncated file (gzip, or in the middle of its last line) up to its last whole row, with a
            warning, instead of refusing it.

    Raises:
        CsvError: while iterating, if the file violates the format.
        SensorNameError: an invalid name.
    """

    def __init__(self, path: Path | str, sensor: str | None = None, partial: bool = False) -> None:
        self.path = Path(path)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self._sensor = None if sensor is None else check_sensor_name(sensor)
        self._partial = partial
        self._names: set[str] = set()
        self._file = CsvFile(self.path)

    @property
    def progress(self) -> float:
        """How much of the file has been read, 0 to 1."""
        return self._file.progress

    def __iter__(self) -> Iterator[RecordedFrame]:
        file = self._file = CsvFile(self.path)
        counts: Counter[str] = Counter()
        names: list[str] = []
        pending: dict[str, _Frame] = {}
        self._names.clear()
        n_rows = n_lines = 0
        lines = file.lines()
        while block := list(islice(lines, _BLOCK_LINES)):
            rows = file.rows(n_lines + 1, block)
            if not names:
                names, rows[0] = self._checked_names(rows[0]), []
                counts[IGNORED] = sum(not _is_known(name) for name in names)
            if not block[-1].endswith("\n") and 0 < len(rows[-1]) < len(names):
                rows.pop()
                file.cut = "the last line is cut off"
            for line, row in enumerate(rows, n_lines + 1):
                if not row:
                    continue
                n_rows += 1
                if len(row) != len(names):
                    raise file.error(line, f"{len(row)} columns, expected {len(names)}")
                sensor, received_ns, skeleton = self._row(line, dict(zip(names, row, strict=True)), counts)
                frame = pending.get(sensor)
                if frame is None or skeleton.stamp_ns != frame.stamp_ns or skeleton.body in frame.skeletons:
                    if frame is not None:
                        counts[REPEATED] += skeleton.stamp_ns == frame.stamp_ns
                        counts[BACKWARDS] += skeleton.stamp_ns < frame.stamp_ns
                        yield frame.finished()
                    frame = pending[sensor] = _Frame(sensor, skeleton.stamp_ns, received_ns)
                frame.skeletons[skeleton.body] = skeleton
            n_lines += len(block)
        if not names:
            raise CsvError(f"{self.path}: {file.cut or 'the file is empty'}")
        self.warnings = file.check_whole(n_rows, self._partial)
        self.problems = dict(+counts)
        for frame in sorted(pending.values(), key=lambda each: each.received_ns):
            yield frame.finished()

    def _checked_names(self, header: list[str]) -> list[str]:
        """The names of the columns."""
        names = [name.strip() for name in header]
        self._file.check_separator(names)
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise self._file.error(1, f"column {twice!r} is there twice")
        missing = [name for name in ("stamp", *_COORDINATES) if name not in names]
        strange = [name for name in names if not _is_known(name) and _looks_like_a_joint(name)]
        if missing or strange:
            # Both together: a misspelt column is usually also a missing one.
            parts = [_listing("missing column", missing), _listing("unknown joint column", strange)]
            if len(missing) > len(_COORDINATES) // 2:
                parts.append("docs/recordings.md lists the columns of each kind of CSV file")
            raise self._file.error(1, "; ".join(part for part in parts if part))
        return names

    def _row(self, line: int, cells: dict[str, str], counts: Counter[str]) -> tuple[str, int, Skeleton]:
        """Sensor, time of receipt and skeleton of a row."""
        sensor = self._sensor_of(line, cells.get("sensor"))
        stamp_ns = self._file.time_ns(line, cells["stamp"], "stamp")
        received_ns = self._file.time_ns(line, cells["received"], "received") if "received" in cells else stamp_ns
        body = self._number(line, cells, "person") if "person" in cells else 0.0
        if not (body.is_integer() and 0 <= body <= _MAX_BODY):
            raise self._file.error(line, f"person: {cells['person']!r}, expected a whole number from 0 to {_MAX_BODY}")
        points = np.array([self._number(line, cells, name) for name in _COORDINATES]).reshape(N_JOINTS, 3)
        states = np.array([self._state(line, cells, f"{joint}_state") for joint in JOINT_NAMES], dtype=np.uint8)
        lost = ~np.isfinite(points).all(axis=1)
        points[lost], states[lost] = np.nan, TrackingState.NOT_TRACKED
        counts[NOT_FINITE] += int(lost.sum())
        counts[FAR] += int((np.abs(points) >= MAX_RANGE).any(axis=1).sum())
        frame_id = optical_frame(sensor)
        return sensor, received_ns, Skeleton(stamp_ns, frame_id, camera_space_to_optical(points), states, int(body))

    def _number(self, line: int, cells: dict[str, str], name: str) -> float:
        """NaN for an empty cell."""
        try:
            return float(cells[name] or "nan")
        except ValueError:
            if not cells[name].strip():
                return float("nan")
            raise self._file.error(line, f"{name}: {cells[name]!r} is not a number") from None

    def _state(self, line: int, cells: dict[str, str], name: str) -> int:
        if name not in cells:
            return TrackingState.TRACKED
        state = self._number(line, cells, name)
        if state not in tuple(TrackingState):
            raise self._file.error(line, f"{name}: tracking state {cells[name]!r}, expected 0, 1 or 2")
        return int(state)

    def _sensor_of(self, line: int, name: str | None) -> str:
        if name is None:
            if self._sensor is None:
                raise self._file.error(1, "no column 'sensor': give the sensor's name (--sensor NAME)")
            return self._sensor
        try:
            self._names.add(check_sensor_name(name.strip()))
        except SensorNameError as error:
            raise self._file.error(line, str(error)) from error
        if self._sensor is None:
            return name.strip()
        if len(self._names) > 1:
            raise CsvError(f"--sensor {self._sensor}: the file has several sensors ({', '.join(sorted(self._names))})")
        return self._sensor


def sensor_column(path: Path | str) -> bool:
    """Whether the file has a column of sensor names; False if its header cannot be read."""
    try:
        header = next(CsvFile(Path(path)).lines())
        return "sensor" in (name.strip() for name in next(csv.reader([header])))
    except (CsvError, csv.Error, StopIteration):
        return False


def _is_known(name: str) -> bool:
    joint, _, part = name.rpartition("_")
    return name in ("sensor", "stamp", "received", "task", "person") or (
        joint in JOINT_NAMES and part in (*_AXES, "state")
    )


def _looks_like_a_joint(name: str) -> bool:
    joint, _, part = name.rpartition("_")
    known = {joint.lower() for joint in JOINT_NAMES}
    return bool(re.fullmatch(r"[xyz]|state", part.lower()) and joint) or joint.lower() in known or name.lower() in known


def _listing(what: str, names: Sequence[str]) -> str:
    if not names:
        return ""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{what}{'s' if len(names) > 1 else ''} {', '.join(name[:40] for name in names[:5])}{more}"
