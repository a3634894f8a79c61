"""Readings of inertial sensors as separated values, ``.csv`` or ``.csv.gz``: three layouts, told by their header.

``own``, a row per reading of a sensor, columns found by name: ``stamp`` (seconds, the sensor's clock); optional
``received`` (seconds, the receiver's clock) and ``sensor`` (its name); and of ``orientation_x _y _z _w`` (sensor to
earth, z up), ``angular_velocity_x _y _z`` (rad/s), ``linear_acceleration_x _y _z`` (m/s2, specific force) and
``magnetic_field_x _y _z`` (tesla) those that there are, each group whole. An empty group is a quantity that this
reading does not have. The names are those of ``sensor_msgs``.

``LPMS``, what LP-Research's software logs of n sensors side by side: ``IMU_TIMESTAMP(0)_0``, ``IMU_GYROSCOPE(0)_0``...
Degrees per second, g, microtesla; the acceleration points down at rest, and the quaternion (w, x, y, z) is of the earth
in the sensor's frame: both are turned about. A row was received when the first sensor's clock showed its stamp.

``RepoIMU``, of Szczesna et al., "Reference data set for accuracy evaluation of orientation estimation algorithms for
inertial motion capture systems", 2016: two lines of header, semicolons, ``Time``, the reference's orientation, and
acceleration, rate and magnetic field of one sensor. The latter is normalised, and taken for shares of 50 microtesla.
Rows were written faster than the sensor spoke: those that repeat its reading are left out. On the pendulum they come
every 11 ms, rates at 50 Hz and accelerations at 26 Hz; ``Time`` has five digits, so from 100 s on steps of 10 ms.
"""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO, Final, cast

import numpy as np

from body_tracking.errors import BodyTrackingError
from body_tracking.files import open_regular
from body_tracking.sensors import SensorNameError, check_sensor_name
from body_tracking.sensors.imu import STANDARD_GRAVITY, ImuSample, ImuSampleError, RecordedImu, imu_frame
from body_tracking.skeleton import NANOSECONDS, FloatArray

IGNORED: Final = "columns that were not read"
HELD: Final = "rows that repeat the reading before"
BAD: Final = "readings that no inertial sensor can have made"
BACKWARDS: Final = "stamps that repeat or run backwards"

_GROUPS: Final = {
    "orientation": "xyzw",
    "angular_velocity": "xyz",
    "linear_acceleration": "xyz",
    "magnetic_field": "xyz",
}
_REPO_HEADER: Final = [
    "Time",
    "Vicon Orientation",
    "",
    "",
    "",
    "IMU Acceleration",
    "",
    "",
    "IMU Gyroscope",
    "",
    "",
    "IMU Magnetometer",
]
_REPO_COLUMNS: Final = 14
_REPO_FIELD: Final = 50e-6
_LPMS: Final = re.compile(r"IMU_TIMESTAMP\((\d+)\)_0")
_MAX_SECONDS: Final = 2**31


class ImuCsvError(BodyTrackingError):
    """A file of inertial readings does not have its format; the text names file and line."""


@dataclass(frozen=True, slots=True)
class _Group:
    """A quantity of a sensor: its columns, and by what its numbers are multiplied (a sign for each)."""

    columns: tuple[int, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Source:
    """A sensor's columns; the sensor's name, or the column that holds it."""

    name: str | int
    stamp: int
    received: int
    orientation: _Group | None
    angular_velocity: _Group | None
    acceleration: _Group | None
    magnetic_field: _Group | None


@dataclass(frozen=True, slots=True)
class _Layout:
    sources: tuple[_Source, ...]
    width: int
    header_lines: int
    held: bool
    ignored: int


def is_imu_csv(path: Path) -> bool:
    """Whether the header of a ``.csv`` or ``.csv.gz`` file is one of inertial readings.

    Raises:
        ImuCsvError: the file cannot be read, or ends before its first line does.
    """
    for _, line, _ in _lines(path):
        names = [name.strip() for name in re.split("[;,]", line)]
        return (
            names[: len(_REPO_HEADER)] == _REPO_HEADER
            or any(_LPMS.fullmatch(name) for name in names)
            or any(f"{group}_x" in names for group in _GROUPS)
        )
    return False


class ImuCsvRecording:
    """Reads inertial readings, a line at a time.

    Stamps are taken as they are written, also where they repeat or run backwards, and counted. A reading that
    :class:`~body_tracking.sensors.imu.ImuSample` refuses is left out, counted, and the first of them is a warning.

    Args:
        path: the file; gzip is recognised by the suffix ``.gz``.
        names: of the file's sensors, in its order, where the file does not tell them; None: ``imu1``, ``imu2``, ...
        partial: read a file that is cut off up to its last whole row, with a warning, instead of refusing it.

    Raises:
        ImuCsvError: while iterating, if anything about the file is not as its layout says.
        SensorNameError: a name cannot be a sensor's.
    """

    def __init__(self, path: Path | str, names: Sequence[str] | None = None, partial: bool = False) -> None:
        self.path = Path(path)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self.progress = 0.0
        self._names = None if names is None else [check_sensor_name(name) for name in names]
        self._partial = partial

    def __iter__(self) -> Iterator[RecordedImu]:
        self.warnings = []
        counts: Counter[str] = Counter()
        layout: _Layout | None = None
        latest: dict[str, int] = {}
        held: list[str] = []
        rows = 0
        lines = _lines(self.path)
        separator = ","
        while True:
            try:
                number, line, self.progress = next(lines)
            except StopIteration:
                break
            except _CutOff as cut:
                self._cut(str(cut), rows)
                break
            if layout is None:
                separator = ";" if line.startswith(f"{_REPO_HEADER[0]};") else ","
            cells = self._cells(number, line, separator)
            if layout is None:
                layout = self._layout(cells)
                counts[IGNORED] = layout.ignored
                continue
            if not cells or number <= layout.header_lines:
                continue
            if len(cells) != layout.width:
                if not line.endswith("\n") and len(cells) < layout.width:
                    self._cut("the last line is cut off", rows)
                    break
                raise self._error(number, f"{len(cells)} columns, expected {layout.width}")
            rows += 1
            if layout.held and cells[5:] == held:
                counts[HELD] += 1
                continue
            held = cells[5:]
            for source in layout.sources:
                reading = self._reading(number, cells, source, counts)
                if reading is None:
                    continue
                stamp_ns = reading.sample.stamp_ns
                counts[BACKWARDS] += stamp_ns <= latest.get(reading.sensor, stamp_ns - 1)
                latest[reading.sensor] = stamp_ns
                yield reading
            self.problems = {name: count for name, count in counts.items() if count}
        if layout is None:
            raise ImuCsvError(f"{self.path}: the file is empty")
        if not rows and not self.warnings:
            raise ImuCsvError(f"{self.path}: no rows follow the header")
        self.problems = {name: count for name, count in counts.items() if count}
        self.progress = 1.0

    def _error(self, line: int, text: str) -> ImuCsvError:
        return ImuCsvError(f"{self.path}, line {line}: {text}")

    def _cut(self, how: str, rows: int) -> None:
        text = f"{self.path}: {how}; {rows} row(s) before that are whole"
        if not self._partial:
            raise ImuCsvError(f"{text} (--partial reads these)")
        self.warnings.append(text)

    def _cells(self, number: int, line: str, separator: str) -> list[str]:
        try:
            return next(csv.reader([line], delimiter=separator, strict=True), [])
        except csv.Error as error:
            raise self._error(number, str(error)) from error

    # --- the header

    def _layout(self, names: list[str]) -> _Layout:
        names = [name.strip() for name in names]
        if names[: len(_REPO_HEADER)] == _REPO_HEADER:
            return self._repo_layout(names)
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise self._error(1, f"column {twice[0]!r} is there twice")
        indices = [int(match[1]) for name in names if (match := _LPMS.fullmatch(name))]
        return self._lpms_layout(names, indices) if indices else self._own_layout(names)

    def _repo_layout(self, names: list[str]) -> _Layout:
        if len(names) != _REPO_COLUMNS:
            raise self._error(1, f"{len(names)} columns, expected {_REPO_COLUMNS}")
        return _Layout(
            (
                _Source(
                    self._named(1)[0],
                    0,
                    0,
                    None,
                    _Group((8, 9, 10), (1.0,) * 3),
                    _Group((5, 6, 7), (1.0,) * 3),
                    _Group((11, 12, 13), (_REPO_FIELD,) * 3),
                ),
            ),
            _REPO_COLUMNS,
            2,
            True,
            4,
        )

    def _lpms_layout(self, names: list[str], indices: list[int]) -> _Layout:
        used: set[int] = set()

        def group(quantity: str, index: int, factors: tuple[float, ...], order: tuple[int, ...]) -> _Group | None:
            wanted = [f"IMU_{quantity}({index})_{k}" for k in order]
            found = [name for name in wanted if name in names]
            if not found:
                return None
            if len(found) < len(wanted):
                raise self._error(1, f"missing column {next(name for name in wanted if name not in names)}")
            used.update(places := [names.index(name) for name in wanted])
            return _Group(tuple(places), factors)

        axes, first = (0, 1, 2), names.index(f"IMU_TIMESTAMP({indices[0]})_0")
        sources = []
        for name, index in zip(self._named(len(indices)), indices, strict=True):
            stamp = names.index(f"IMU_TIMESTAMP({index})_0")
            used.add(stamp)
            sources.append(
                _Source(
                    name,
                    stamp,
                    first,
                    group("QUATERNION", index, (-1.0, -1.0, -1.0, 1.0), (1, 2, 3, 0)),
                    group("GYROSCOPE", index, (float(np.radians(1.0)),) * 3, axes),
                    group("ACCELEROMETER", index, (-STANDARD_GRAVITY,) * 3, axes),
                    group("MAGNETOMETER", index, (1e-6,) * 3, axes),
                )
            )
        return _Layout(tuple(sources), len(names), 1, False, len(names) - len(used))

    def _own_layout(self, names: list[str]) -> _Layout:
        if "stamp" not in names:
            raise self._error(1, "missing column stamp")
        groups: list[_Group | None] = []
        for group, axes in _GROUPS.items():
            wanted = [f"{group}_{axis}" for axis in axes]
            missing = [name for name in wanted if name not in names]
            if missing and len(missing) < len(wanted):
                raise self._error(1, f"missing column {missing[0]}")
            groups.append(
                None if missing else _Group(tuple(names.index(name) for name in wanted), (1.0,) * len(wanted))
            )
        if all(group is None for group in groups):
            raise self._error(1, f"no column of {', '.join(f'{group}_x' for group in _GROUPS)}")
        sensor: str | int = names.index("sensor") if "sensor" in names else self._named(1)[0]
        stamp = names.index("stamp")
        known = {"stamp", "received", "sensor"} | {
            f"{group}_{axis}" for group, axes in _GROUPS.items() for axis in axes
        }
        return _Layout(
            (_Source(sensor, stamp, names.index("received") if "received" in names else stamp, *groups),),
            len(names),
            1,
            False,
            sum(name not in known for name in names),
        )

    def _named(self, count: int) -> list[str]:
        if self._names is None:
            return [f"imu{number + 1}" for number in range(count)]
        if len(self._names) != count:
            raise ImuCsvError(f"{self.path}: {len(self._names)} sensor name(s) for {count} sensor(s)")
        return self._names

    # --- rows

    def _reading(self, number: int, cells: list[str], source: _Source, counts: Counter[str]) -> RecordedImu | None:
        try:
            sensor = source.name if isinstance(source.name, str) else check_sensor_name(cells[source.name].strip())
        except SensorNameError as error:
            raise self._error(number, str(error)) from None
        stamp_ns = self._time(number, cells[source.stamp])
        received_ns = self._time(number, cells[source.received])
        try:
            sample = ImuSample(
                stamp_ns,
                imu_frame(sensor),
                self._vector(number, cells, source.orientation),
                None,
                self._vector(number, cells, source.angular_velocity),
                self._vector(number, cells, source.acceleration),
                self._vector(number, cells, source.magnetic_field),
            )
        except ImuSampleError as error:
            if not counts[BAD]:
                self.warnings.append(f"{self.path}, line {number}: {error}")
            counts[BAD] += 1
            return None
        return RecordedImu(sensor, received_ns, sample)

    def _vector(self, number: int, cells: list[str], group: _Group | None) -> FloatArray | None:
        if group is None:
            return None
        texts = [cells[column].strip() for column in group.columns]
        if not any(texts):
            return None
        try:
            return np.array([float(text) for text in texts]) * group.factors
        except ValueError:
            wrong = next(text for text in texts if not _is_number(text))
            raise self._error(number, f"{wrong!r} is not a number") from None

    def _time(self, number: int, text: str) -> int:
        """Seconds as text to nanoseconds, exactly."""
        try:
            seconds = Decimal(text.strip())
        except InvalidOperation:
            raise self._error(number, f"{text!r} is not a time") from None
        if not seconds.is_finite() or not 0 <= seconds < _MAX_SECONDS:  # as a ROS message holds it
            raise self._error(number, f"{text!r} is not a time in seconds")
        return int((seconds * NANOSECONDS).to_integral_value())


class _CutOff(Exception):
    """The gzip stream ends in the middle."""


def _lines(path: Path) -> Iterator[tuple[int, str, float]]:
    """The lines of a file with their numbers, and how much of it has been read."""
    number = 0
    try:
        size = max(1, path.stat().st_size)
        with open_regular(path) as raw:
            source = cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if path.suffix == ".gz" else raw
            with TextIOWrapper(source, encoding="utf-8-sig") as file:
                for line in file:
                    number += 1
                    yield number, line, min(1.0, raw.tell() / size)
    except EOFError:
        raise _CutOff("the gzip stream is cut off") from None
    except (gzip.BadGzipFile, zlib.error) as error:
        raise ImuCsvError(f"{path}, line {number + 1}: the gzip stream is damaged ({error})") from error
    except UnicodeDecodeError as error:
        raise ImuCsvError(f"{path}, line {number + 1}: not UTF-8 text") from error
    except OSError as error:
        raise ImuCsvError(f"{path}: {error.strerror or error}") from error


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
