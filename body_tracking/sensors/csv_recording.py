"""Skeletons as comma-separated values, ``.csv`` or ``.csv.gz``; the format is described in ``docs/recordings.md``.

A row is one body seen by one sensor at one instant: 25 joints in metres, in the sensor's own Kinect camera space.
"""

from __future__ import annotations

import csv
import gzip
import os
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from body_tracking.errors import BodyTrackingError
from body_tracking.files import open_regular
from body_tracking.sensors import NOT_FINITE, RecordedFrame, SensorNameError, check_sensor_name, optical_frame
from body_tracking.sensors.kinect import camera_space_to_optical
from body_tracking.skeleton import JOINT_NAMES, N_JOINTS, NANOSECONDS, FloatArray, IntArray, Skeleton, TrackingState

REPEATED = "stamps that repeat"
BACKWARDS = "stamps that run backwards"
IGNORED = "columns that were not read"

_AXES = ("x", "y", "z")
_BLOCK_LINES = 1024
_MAX_SECONDS = 2**31  # builtin_interfaces/Time counts seconds in 32 bits
_MAX_BODY = 2**16 - 1  # and the message numbers bodies in 16


class CsvError(BodyTrackingError):
    """A CSV recording does not have its format; the text names file and line."""


@dataclass(frozen=True, slots=True)
class _Columns:
    """Where things are in a row; None for what the file does not have."""

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
    """The rows of one frame, as far as they have come."""

    stamp_ns: int
    received_ns: int
    skeletons: dict[int, Skeleton] = field(default_factory=dict)


class CsvRecording:
    """Reads a CSV recording, a block of lines at a time.

    Consecutive rows of one sensor with the same stamp and different persons are one frame. Stamps are taken as they are
    written, also where they repeat or run backwards, and counted in :attr:`problems`.

    Args:
        path: the file; gzip is recognised by the suffix ``.gz``.
        sensor: the sensor's name where the file has no column for it, and instead of it where it has one sensor only.
        partial: read a file that is cut off (gzip, or in the middle of its last line) up to its last whole row, with
            a warning, instead of refusing it.

    Raises:
        CsvError: while iterating, if anything about the file is not as the format says.
        SensorNameError: the name cannot be a sensor's.
    """

    def __init__(self, path: Path | str, sensor: str | None = None, partial: bool = False) -> None:
        self.path = Path(path)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self._sensor = None if sensor is None else check_sensor_name(sensor)
        self._partial = partial
        self._cut: str | None = None
        self._size, self._position = 1, 0

    @property
    def progress(self) -> float:
        """How much of the file has been read, 0 to 1."""
        return min(1.0, self._position / self._size)

    def __iter__(self) -> Iterator[RecordedFrame]:
        self.warnings, self._cut = [], None
        counts: Counter[str] = Counter()
        columns: _Columns | None = None
        frames = _Frames(self._sensor, counts)
        n_rows = 0
        for number, lines in self._blocks():
            rows = self._cells(number, lines)
            if columns is None:
                columns = self._columns(rows.pop(0))
                number += 1
                counts[IGNORED] = len(columns.names) - sum(_is_known(name) for name in columns.names)
            self._drop_cut_line(lines, rows, columns)
            where = [number + index for index, row in enumerate(rows) if row]
            rows = [row for row in rows if row]
            n_rows += len(rows)
            if rows:
                yield from frames.take(self._parse(where, rows, columns))
            self.problems = {name: count for name, count in counts.items() if count}
        cut = self._cut_off()
        if columns is None:
            raise CsvError(f"{self.path}: {cut or 'the file is empty'}")
        if cut is not None:
            text = f"{self.path}: {cut}; {n_rows} row(s) before that are whole"
            if not self._partial:
                raise CsvError(f"{text} (--partial reads these)")
            self.warnings.append(text)
        elif n_rows == 0:
            raise CsvError(f"{self.path}: no rows follow the header")
        yield from frames.rest()
        self.problems = {name: count for name, count in counts.items() if count}

    # --- lines and cells

    def _cut_off(self) -> str | None:
        return self._cut

    def _error(self, line: int, text: str) -> CsvError:
        return CsvError(f"{self.path}, line {line}: {text}")

    def _blocks(self) -> Iterator[tuple[int, list[str]]]:
        """The lines of the file in blocks, with the number of each block's first line."""
        number = 1
        block: list[str] = []
        try:
            with open_regular(self.path) as file:
                self._size = max(1, os.fstat(file.fileno()).st_size)
                source = cast(BinaryIO, gzip.GzipFile(fileobj=file)) if self.path.suffix == ".gz" else file
                with TextIOWrapper(source, encoding="utf-8-sig") as text:
                    for line in text:
                        block.append(line)
                        if len(block) == _BLOCK_LINES:
                            self._position = file.tell()
                            yield number, block
                            number, block = number + len(block), []
        except EOFError:
            self._cut = "the gzip stream is cut off"
        except (gzip.BadGzipFile, zlib.error) as error:
            raise self._error(number + len(block), f"the gzip stream is damaged ({error})") from error
        except UnicodeDecodeError as error:
            raise self._error(number + len(block), "not UTF-8 text") from error
        except OSError as error:
            raise CsvError(f"{self.path}: {error.strerror or error}") from error
        if block:
            yield number, block
        self._position = self._size

    def _cells(self, number: int, lines: list[str]) -> list[list[str]]:
        """The cells of each line; none for an empty line."""
        reader = csv.reader(lines, strict=True)
        try:
            rows = list(reader)
        except csv.Error as error:
            raise self._error(number + max(0, reader.line_num - 1), str(error)) from error
        if len(rows) != len(lines):
            raise self._error(number, "a quoted cell goes on over several lines")
        return rows

    def _drop_cut_line(self, lines: list[str], rows: list[list[str]], columns: _Columns) -> None:
        """A last line without its end and with too few cells was cut off while it was written."""
        if rows and not lines[-1].endswith("\n") and 0 < len(rows[-1]) < len(columns.names):
            rows.pop()
            self._cut = "the last line is cut off"

    # --- the header

    def _columns(self, names: list[str]) -> _Columns:
        names = [name.strip() for name in names]
        place = {name: index for index, name in enumerate(names)}
        if len(place) < len(names):
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise self._error(1, f"column {twice!r} is there twice")
        wanted = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in _AXES]
        missing = [name for name in ("stamp", *wanted) if name not in place]
        strange = [name for name in names if not _is_known(name) and _looks_like_a_joint(name)]
        if missing or strange:
            # Both together, since a misspelt column is usually also a missing one.
            parts = [_listing("missing column", missing), _listing("unknown joint column", strange)]
            raise self._error(1, "; ".join(part for part in parts if part))
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

    def _parse(self, where: list[int], rows: list[list[str]], columns: _Columns) -> _Rows:
        """Args: where: the line of each row; rows: their cells."""
        width = len(columns.names)
        for line, row in zip(where, rows, strict=True):
            if len(row) != width:
                raise self._error(line, f"{len(row)} columns, expected {width}")
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
                raise self._error(where[row], f"{name}: tracking state {text!r}, expected 0, 1 or 2")
            states[:, columns.state_joints] = given.astype(np.uint8)
        lost = ~np.isfinite(positions).all(axis=2)
        positions[lost] = np.nan
        states[lost] = TrackingState.NOT_TRACKED
        stamps = [self._time(line, row[columns.stamp], "stamp") for line, row in zip(where, rows, strict=True)]
        return _Rows(
            sensors=self._sensors(where, rows, columns),
            stamps_ns=stamps,
            received_ns=stamps
            if columns.received is None
            else [self._time(line, row[columns.received], "received") for line, row in zip(where, rows, strict=True)],
            persons=[0] * len(rows)
            if columns.person is None
            else [self._person(line, row[columns.person]) for line, row in zip(where, rows, strict=True)],
            positions=camera_space_to_optical(positions),
            states=states,
            not_finite=int(lost.sum()),
        )

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
                    raise self._error(where[row], f"{name}: {str(text)!r} is not a number") from None
            raise

    def _time(self, line: int, text: str, name: str) -> int:
        """Seconds as text to nanoseconds, exactly: a double would round stamps that count from 1970."""
        try:
            seconds = Decimal(text.strip())
        except InvalidOperation:
            raise self._error(line, f"{name}: {text!r} is not a number") from None
        if not seconds.is_finite() or not 0 <= seconds < _MAX_SECONDS:  # as a ROS message holds it
            raise self._error(line, f"{name}: {text!r} is not a time in seconds")
        return int((seconds * NANOSECONDS).to_integral_value())

    def _person(self, line: int, text: str) -> int:
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not (number.is_integer() and 0 <= number <= _MAX_BODY):
            raise self._error(line, f"person: {text!r}, expected a whole number from 0 to {_MAX_BODY}")
        return int(number)

    def _sensors(self, where: list[int], rows: list[list[str]], columns: _Columns) -> list[str]:
        if columns.sensor is None:
            if self._sensor is None:
                raise self._error(1, "no column 'sensor': give the sensor's name (--sensor NAME)")
            return [self._sensor] * len(rows)
        names = [row[columns.sensor].strip() for row in rows]
        for name in dict.fromkeys(names):
            try:
                check_sensor_name(name)
            except SensorNameError as error:
                raise self._error(where[names.index(name)], str(error)) from error
        return names


def sensor_column(path: Path | str) -> bool:
    """Whether the file names its sensors itself; also False if its header cannot be read."""
    try:
        _, lines = next(CsvRecording(path)._blocks())
        return "sensor" in (name.strip() for name in next(csv.reader(lines[:1])))
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


@dataclass(frozen=True, slots=True)
class _Rows:
    """The rows of a block: positions (n, 25, 3) in the optical frame, states (n, 25)."""

    sensors: list[str]
    stamps_ns: list[int]
    received_ns: list[int]
    persons: list[int]
    positions: FloatArray
    states: NDArray[Any]
    not_finite: int


class _Frames:
    """Puts rows together to frames; those of several sensors may alternate as they like."""

    def __init__(self, rename: str | None, counts: Counter[str]) -> None:
        self._rename = rename
        self._counts = counts
        self._pending: dict[str, _Frame] = {}
        self._names: set[str] = set()

    def take(self, rows: _Rows) -> Iterator[RecordedFrame]:
        self._counts[NOT_FINITE] += rows.not_finite
        for index, (name, stamp_ns, person) in enumerate(zip(rows.sensors, rows.stamps_ns, rows.persons, strict=True)):
            sensor = self._named(name)
            frame = self._pending.get(sensor)
            if frame is None or stamp_ns != frame.stamp_ns or person in frame.skeletons:
                if frame is not None:
                    self._counts[REPEATED] += stamp_ns == frame.stamp_ns
                    self._counts[BACKWARDS] += stamp_ns < frame.stamp_ns
                    yield _finished(sensor, frame)
                frame = self._pending[sensor] = _Frame(stamp_ns, rows.received_ns[index])
            frame.skeletons[person] = Skeleton(
                stamp_ns, optical_frame(sensor), rows.positions[index], rows.states[index], person
            )

    def rest(self) -> Iterator[RecordedFrame]:
        for sensor, frame in sorted(self._pending.items(), key=lambda item: item[1].received_ns):
            yield _finished(sensor, frame)

    def _named(self, name: str) -> str:
        if self._rename is None:
            return name
        self._names.add(name)
        if len(self._names) > 1:
            raise CsvError(f"--sensor {self._rename}: the file has several sensors ({', '.join(sorted(self._names))})")
        return self._rename


def _finished(sensor: str, frame: _Frame) -> RecordedFrame:
    return RecordedFrame(sensor, frame.received_ns, tuple(frame.skeletons.values()))
