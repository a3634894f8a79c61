"""Readings of inertial sensors as separated values, ``.csv`` or ``.csv.gz``: three layouts, recognised by the header.

``own``, a row per reading of a sensor, columns found by name: ``stamp`` (seconds, the sensor's clock); optional
``received`` (seconds, the receiver's clock) and ``sensor`` (its name); and any of these groups, each complete:
``orientation_x _y _z _w`` (sensor to earth, z up), ``angular_velocity_x _y _z`` (rad/s), ``linear_acceleration_x _y
_z`` (m/s2, specific force) and ``magnetic_field_x _y _z`` (tesla). An empty group means that this reading lacks the
quantity. The names are those of ``sensor_msgs``.

``LPMS``, the log of LP-Research's software for n sensors: columns ``IMU_TIMESTAMP(0)_0``, ``IMU_GYROSCOPE(0)_0``... in
degrees per second, g, microtesla. The acceleration points down at rest, and the quaternion (w, x, y, z) rotates earth
to sensor: both are inverted. The first sensor's stamp is the time of receipt of a row.

``RepoIMU``, of Szczesna et al., "Reference data set for accuracy evaluation of orientation estimation algorithms for
inertial motion capture systems", 2016: two lines of header, semicolons, ``Time``, the reference's orientation, and
acceleration, rate and magnetic field of one sensor. The latter is normalised; it is scaled by 50 microtesla. Rows were
written faster than the sensor's rate: those that repeat a reading are ignored. On the pendulum, rows come every 11 ms,
rates at 50 Hz and accelerations at 26 Hz; ``Time`` has five digits, so from 100 s on steps of 10 ms.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.core.csv_file import CsvError, CsvFile
from body_tracking.core.imu import STANDARD_GRAVITY, ImuSample, ImuSampleError, RecordedImu, imu_frame
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.sources import SensorNameError, check_sensor_name

IGNORED: Final = "columns that were not read"
HELD: Final = "rows that repeat the reading before"
BAD: Final = "readings that no inertial sensor can have made"
BACKWARDS: Final = "stamps that repeat or run backwards"

_GROUPS: Final = {
    "orientation": ("orientation", "xyzw"),
    "angular_velocity": ("angular_velocity", "xyz"),
    "acceleration": ("linear_acceleration", "xyz"),
    "magnetic_field": ("magnetic_field", "xyz"),
}
"""For each quantity of a sample: the prefix of its columns' names, and the axes that follow."""
_REPO_HEADER: Final = [
    *("Time", "Vicon Orientation", "", "", "", "IMU Acceleration", "", "", "IMU Gyroscope", "", ""),
    "IMU Magnetometer",
]
_REPO_COLUMNS: Final = 14
_REPO_FIELD: Final = 50e-6
_LPMS: Final = re.compile(r"IMU_TIMESTAMP\((\d+)\)_0")


@dataclass(frozen=True, slots=True)
class _Group:
    """A quantity of a sensor: its columns, and the factor of each."""

    columns: tuple[int, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Source:
    """A sensor's name or the column of the name, and its other columns; groups by names of the sample's fields."""

    name: str | int
    stamp: int
    received: int
    groups: dict[str, _Group]


@dataclass(frozen=True, slots=True)
class _Layout:
    sources: tuple[_Source, ...]
    width: int
    header_lines: int
    held: bool
    ignored: int


def is_imu_csv(path: Path) -> bool:
    """Whether a ``.csv`` or ``.csv.gz`` file has a header of inertial readings.

    Raises:
        CsvError: the file cannot be read.
    """
    names = [name.strip() for name in re.split("[;,\t]", next(CsvFile(path).lines(), ""))]
    return (
        names[: len(_REPO_HEADER)] == _REPO_HEADER
        or any(_LPMS.fullmatch(name) for name in names)
        or any(f"{columns}_x" in names for columns, _ in _GROUPS.values())
    )


class ImuCsvRecording:
    """Reads inertial readings, a line at a time.

    Stamps that repeat or run backwards are kept, and counted. A reading that :class:`~body_tracking.core.imu.ImuSample`
    rejects is ignored and counted; the first one adds a warning.

    Args:
        path: the file; gzip is recognised by the suffix ``.gz``.
        names: of the file's sensors, in its order, for files without names; None: ``imu1``, ``imu2``, ...
        partial: read a truncated file up to its last complete row, with a warning, instead of raising an error.

    Raises:
        CsvError: while iterating, if the file violates its layout.
        SensorNameError: an invalid sensor name.
    """

    def __init__(self, path: Path | str, names: Sequence[str] | None = None, partial: bool = False) -> None:
        self.path = Path(path)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self._names = None if names is None else [check_sensor_name(name) for name in names]
        self._partial = partial
        self._file = CsvFile(self.path)

    @property
    def progress(self) -> float:
        """How much of the file has been read, 0 to 1."""
        return self._file.progress

    def __iter__(self) -> Iterator[RecordedImu]:
        file = self._file = CsvFile(self.path)
        self.warnings = []
        counts: Counter[str] = Counter()
        layout: _Layout | None = None
        latest: dict[str, int] = {}
        held: list[str] = []
        rows = 0
        separator = ","
        for number, line in enumerate(file.lines(), 1):
            if layout is None:
                separator = ";" if line.startswith(f"{_REPO_HEADER[0]};") else ","
            (cells,) = file.rows(number, [line], separator)
            if layout is None:
                layout = self._layout(cells)
                counts[IGNORED] = layout.ignored
                continue
            if not cells or number <= layout.header_lines:
                continue
            if len(cells) != layout.width:
                if not line.endswith("\n") and len(cells) < layout.width:
                    file.cut = "the last line is cut off"
                    break
                raise file.error(number, f"{len(cells)} columns, expected {layout.width}")
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
        if layout is None and not file.cut:
            raise CsvError(f"{self.path}: the file is empty")
        self.warnings += file.check_whole(rows, self._partial)
        self.problems = {name: count for name, count in counts.items() if count}

    # --- the header

    def _layout(self, names: list[str]) -> _Layout:
        names = [name.strip() for name in names]
        if names[: len(_REPO_HEADER)] == _REPO_HEADER:
            return self._repo_layout(names)
        self._file.check_separator(names)
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise self._file.error(1, f"column {twice[0]!r} is there twice")
        indices = [int(match[1]) for name in names if (match := _LPMS.fullmatch(name))]
        return self._lpms_layout(names, indices) if indices else self._own_layout(names)

    def _repo_layout(self, names: list[str]) -> _Layout:
        if len(names) != _REPO_COLUMNS:
            raise self._file.error(1, f"{len(names)} columns, expected {_REPO_COLUMNS}")
        groups = {
            "angular_velocity": _Group((8, 9, 10), (1.0,) * 3),
            "acceleration": _Group((5, 6, 7), (1.0,) * 3),
            "magnetic_field": _Group((11, 12, 13), (_REPO_FIELD,) * 3),
        }
        return _Layout((_Source(self._named(1)[0], 0, 0, groups),), _REPO_COLUMNS, 2, True, 4)

    def _lpms_layout(self, names: list[str], indices: list[int]) -> _Layout:
        quantities = {
            "orientation": ("QUATERNION", (1, 2, 3, 0), (-1.0, -1.0, -1.0, 1.0)),
            "angular_velocity": ("GYROSCOPE", (0, 1, 2), (float(np.radians(1.0)),) * 3),
            "acceleration": ("ACCELEROMETER", (0, 1, 2), (-STANDARD_GRAVITY,) * 3),
            "magnetic_field": ("MAGNETOMETER", (0, 1, 2), (1e-6,) * 3),
        }
        first = names.index(f"IMU_TIMESTAMP({indices[0]})_0")
        sources, used = [], 0
        for name, index in zip(self._named(len(indices)), indices, strict=True):
            groups = {
                quantity: _Group(places, factors)
                for quantity, (columns, order, factors) in quantities.items()
                if (places := self._places(names, [f"IMU_{columns}({index})_{k}" for k in order]))
            }
            used += 1 + sum(len(group.columns) for group in groups.values())
            sources.append(_Source(name, names.index(f"IMU_TIMESTAMP({index})_0"), first, groups))
        return _Layout(tuple(sources), len(names), 1, False, len(names) - used)

    def _own_layout(self, names: list[str]) -> _Layout:
        if "stamp" not in names:
            raise self._file.error(1, "missing column stamp")
        groups = {
            quantity: _Group(places, (1.0,) * len(places))
            for quantity, (columns, axes) in _GROUPS.items()
            if (places := self._places(names, [f"{columns}_{axis}" for axis in axes]))
        }
        if not groups:
            raise self._file.error(1, f"no column of {', '.join(f'{columns}_x' for columns, _ in _GROUPS.values())}")
        stamp = names.index("stamp")
        received = names.index("received") if "received" in names else stamp
        sensor: str | int = names.index("sensor") if "sensor" in names else self._named(1)[0]
        used = {stamp, received, *([sensor] if isinstance(sensor, int) else [])}
        used.update(place for group in groups.values() for place in group.columns)
        return _Layout((_Source(sensor, stamp, received, groups),), len(names), 1, False, len(names) - len(used))

    def _places(self, names: list[str], wanted: list[str]) -> tuple[int, ...]:
        """Indices of a group's columns; empty if the file has none of them.

        Raises:
            CsvError: some of them are missing.
        """
        missing = [name for name in wanted if name not in names]
        if missing and len(missing) < len(wanted):
            raise self._file.error(1, f"missing column {missing[0]}")
        return () if missing else tuple(names.index(name) for name in wanted)

    def _named(self, count: int) -> list[str]:
        if self._names is None:
            return [f"imu{number + 1}" for number in range(count)]
        if len(self._names) != count:
            raise CsvError(f"{self.path}: {len(self._names)} sensor name(s) for {count} sensor(s)")
        return self._names

    # --- rows

    def _reading(self, number: int, cells: list[str], source: _Source, counts: Counter[str]) -> RecordedImu | None:
        try:
            sensor = source.name if isinstance(source.name, str) else check_sensor_name(cells[source.name].strip())
        except SensorNameError as error:
            raise self._file.error(number, str(error)) from None
        stamp_ns = self._file.time_ns(number, cells[source.stamp], "stamp")
        received_ns = self._file.time_ns(number, cells[source.received], "received")
        quantities: dict[str, Any] = {name: self._vector(number, cells, group) for name, group in source.groups.items()}
        try:
            sample = ImuSample(stamp_ns, imu_frame(sensor), **quantities)
        except ImuSampleError as error:
            if not counts[BAD]:
                self.warnings.append(f"{self.path}, line {number}: {error}")
            counts[BAD] += 1
            return None
        return RecordedImu(sensor, received_ns, sample)

    def _vector(self, number: int, cells: list[str], group: _Group) -> FloatArray | None:
        texts = [cells[column].strip() for column in group.columns]
        if not any(texts):
            return None
        values = []
        for text in texts:
            try:
                values.append(float(text))
            except ValueError:
                raise self._file.error(number, f"{text!r} is not a number") from None
        return np.array(values) * group.factors
