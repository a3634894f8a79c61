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
from numpy.typing import NDArray

from body_tracking.core.csv_file import CsvError, CsvFile
from body_tracking.core.skeleton import JOINT_NAMES, N_JOINTS, FloatArray, IntArray, Skeleton, TrackingState
from body_tracking.core.sources import NOT_FINITE, RecordedFrame, SensorNameError, check_sensor_name, optical_frame
from body_tracking.kinect.axes import camera_space_to_optical

REPEATED = "stamps that repeat"
BACKWARDS = "stamps that run backwards"
IGNORED = "columns that were not read"

_AXES = ("x", "y", "z")
_BLOCK_LINES = 1024
_MAX_BODY = 2**16 - 1  # the message numbers bodies in 16 bits


@dataclass(frozen=True, slots=True)
class _Columns:
    """Indices of the columns; None for those that the file lacks."""

    names: tuple[str, ...]
    stamp: int
    sensor: int | None
    received: int | None
    person: int | None
    positions: IntArray  # (75,) x, y, z of each joint in SDK order
    states: IntArray  # (n,) the states that the file has
    state_joints: IntArray  # (n,) the joints they belong to


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
        columns: _Columns | None = None
        pending: dict[str, _Frame] = {}
        self._names.clear()
        n_rows = n_lines = 0
        lines = file.lines()
        while block := list(islice(lines, _BLOCK_LINES)):
            cells = file.rows(n_lines + 1, block)
            if columns is None:
                columns = self._columns(cells[0])
                cells[0] = []
                counts[IGNORED] = len(columns.names) - sum(_is_known(name) for name in columns.names)
            if not block[-1].endswith("\n") and 0 < len(cells[-1]) < len(columns.names):
                cells.pop()
                file.cut = "the last line is cut off"
            rows = {n_lines + index: row for index, row in enumerate(cells, 1) if row}
            n_lines += len(block)
            n_rows += len(rows)
            for sensor, received_ns, skeleton in self._parse(list(rows), list(rows.values()), columns, counts):
                frame = pending.get(sensor)
                if frame is None or skeleton.stamp_ns != frame.stamp_ns or skeleton.body in frame.skeletons:
                    if frame is not None:
                        counts[REPEATED] += skeleton.stamp_ns == frame.stamp_ns
                        counts[BACKWARDS] += skeleton.stamp_ns < frame.stamp_ns
                        yield frame.finished()
                    frame = pending[sensor] = _Frame(sensor, skeleton.stamp_ns, received_ns)
                frame.skeletons[skeleton.body] = skeleton
            self.problems = {name: count for name, count in counts.items() if count}
        if columns is None:
            raise CsvError(f"{self.path}: {file.cut or 'the file is empty'}")
        self.warnings = file.check_whole(n_rows, self._partial)
        for frame in sorted(pending.values(), key=lambda each: each.received_ns):
            yield frame.finished()
        self.problems = {name: count for name, count in counts.items() if count}

    # --- the header

    def _columns(self, names: list[str]) -> _Columns:
        names = [name.strip() for name in names]
        place = {name: index for index, name in enumerate(names)}
        if len(place) < len(names):
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise self._file.error(1, f"column {twice!r} is there twice")
        wanted = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in _AXES]
        missing = [name for name in ("stamp", *wanted) if name not in place]
        strange = [name for name in names if not _is_known(name) and _looks_like_a_joint(name)]
        if missing or strange:
            # Both together: a misspelt column is usually also a missing one.
            parts = [_listing("missing column", missing), _listing("unknown joint column", strange)]
            raise self._file.error(1, "; ".join(part for part in parts if part))
        state_joints = [joint for joint in range(N_JOINTS) if f"{JOINT_NAMES[joint]}_state" in place]
        return _Columns(
            names=tuple(names),
            stamp=place["stamp"],
            sensor=place.get("sensor"),
            received=place.get("received"),
            person=place.get("person"),
            positions=np.array([place[name] for name in wanted], dtype=np.intp),
            states=np.array([place[f"{JOINT_NAMES[joint]}_state"] for joint in state_joints], dtype=np.intp),
            state_joints=np.array(state_joints, dtype=np.intp),
        )

    # --- rows

    def _parse(
        self, where: list[int], rows: list[list[str]], columns: _Columns, counts: Counter[str]
    ) -> list[tuple[str, int, Skeleton]]:
        """Sensor, time of receipt and skeleton of each row.

        Args:
            where: the line of each row.
            rows: their cells.
            columns: of the file.
            counts: of problems, updated in place.
        """
        if not rows:
            return []
        width = len(columns.names)
        for line, row in zip(where, rows, strict=True):
            if len(row) != width:
                raise self._file.error(line, f"{len(row)} columns, expected {width}")
        cells = np.array(rows)
        positions = self._numbers(where, cells, columns.positions, columns).reshape(-1, N_JOINTS, 3)
        states = np.full((len(rows), N_JOINTS), TrackingState.TRACKED, dtype=np.uint8)
        if columns.states.size:
            given = self._numbers(where, cells, columns.states, columns)
            wrong = np.argwhere(~np.isin(given, [state.value for state in TrackingState]))
            if wrong.size:
                row, column = wrong[0]
                name = columns.names[columns.states[column]]
                text = rows[row][columns.states[column]]
                raise self._file.error(where[row], f"{name}: tracking state {text!r}, expected 0, 1 or 2")
            states[:, columns.state_joints] = given.astype(np.uint8)
        lost = ~np.isfinite(positions).all(axis=2)
        positions[lost] = np.nan
        states[lost] = TrackingState.NOT_TRACKED
        counts[NOT_FINITE] += int(lost.sum())
        positions = camera_space_to_optical(positions)
        found = []
        for line, row, sensor, points, own in zip(
            where, rows, self._sensors(where, rows, columns), positions, states, strict=True
        ):
            stamp_ns = received_ns = self._file.time_ns(line, row[columns.stamp], "stamp")
            if columns.received is not None:
                received_ns = self._file.time_ns(line, row[columns.received], "received")
            person = 0 if columns.person is None else self._person(line, row[columns.person])
            found.append((sensor, received_ns, Skeleton(stamp_ns, optical_frame(sensor), points, own, person)))
        return found

    def _numbers(self, where: list[int], cells: NDArray[np.str_], places: IntArray, columns: _Columns) -> FloatArray:
        """(rows, places) numbers; NaN for an empty cell."""
        texts = np.char.strip(cells[:, places])
        texts[texts == ""] = "nan"
        try:
            return texts.astype(np.float64)
        except ValueError:
            for (row, column), text in np.ndenumerate(texts):
                try:
                    float(text)
                except ValueError:
                    name = columns.names[places[column]]
                    raise self._file.error(where[row], f"{name}: {str(text)!r} is not a number") from None
            raise

    def _person(self, line: int, text: str) -> int:
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not (number.is_integer() and 0 <= number <= _MAX_BODY):
            raise self._file.error(line, f"person: {text!r}, expected a whole number from 0 to {_MAX_BODY}")
        return int(number)

    def _sensors(self, where: list[int], rows: list[list[str]], columns: _Columns) -> list[str]:
        if columns.sensor is None:
            if self._sensor is None:
                raise self._file.error(1, "no column 'sensor': give the sensor's name (--sensor NAME)")
            return [self._sensor] * len(rows)
        names = [row[columns.sensor].strip() for row in rows]
        for name in dict.fromkeys(names):
            try:
                check_sensor_name(name)
            except SensorNameError as error:
                raise self._file.error(where[names.index(name)], str(error)) from error
        if self._sensor is None:
            return names
        self._names.update(names)
        if len(self._names) > 1:
            raise CsvError(f"--sensor {self._sensor}: the file has several sensors ({', '.join(sorted(self._names))})")
        return [self._sensor] * len(rows)


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
    return f"{what}{'s' if len(names) > 1 else ''} {', '.join(names[:5])}{more}"
