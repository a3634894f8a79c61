"""Markers in a CSV export of OptiTrack Motive: a column per coordinate, a row per frame.

The first line holds pairs of name and value (``Format Version,1.23,...,Length Units,Meters,...``). Then follow rows of
types, names and, depending on the version, identifiers and parents; a row that distinguishes rotations from positions;
and ``Frame,Time (Seconds),X,Y,Z,...``. The cell of an invisible marker is empty. Columns of type ``Marker`` are
measured; ``Rigid Body Marker`` and ``Bone Marker`` are positions expected by the solved body, which say nothing of the
cameras' errors. Format: OptiTrack's documentation, "Data Export: CSV" (versions 1.2 to 1.25).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.csv_file import CsvFile
from body_tracking.core.skeleton import FloatArray, IntArray

_FIRST: Final = "Format Version"
_UNITS: Final = {"meters": 1.0, "centimeters": 1e-2, "millimeters": 1e-3}
_MEASURED: Final = "Marker"
_SOLVED: Final = ("Rigid Body Marker", "Bone Marker")
_HEADER_LINES: Final = 12
"""The row of axes is within this number of lines."""


@dataclass(frozen=True, slots=True, eq=False)
class MotiveMarkers:
    """Markers of an export.

    Attributes:
        labels: as named in the file.
        positions: (n, p, 3) metres, in the file's axes, NaN where a marker is invisible.
        stamps_ns: n times in nanoseconds, in the file's clock.
        warnings: one line per irregularity.
    """

    labels: tuple[str, ...]
    positions: FloatArray
    stamps_ns: tuple[int, ...]
    warnings: tuple[str, ...]


def is_motive_csv(path: Path) -> bool:
    """Whether a ``.csv`` or ``.csv.gz`` file begins as an export of Motive.

    Raises:
        CsvError: the file cannot be read.
    """
    return next(CsvFile(path).lines(), "").startswith(f"{_FIRST},")


def read_motive_csv(path: Path, partial: bool = False) -> MotiveMarkers:
    """Read the markers of an export.

    Args:
        path: ``.csv``, or ``.csv.gz``.
        partial: read a truncated file up to its last whole row.

    Raises:
        CsvError: the file violates the format, has no markers, or an unknown unit of length; the message names the
            line.
    """
    file = CsvFile(path)
    header: list[list[str]] = []
    columns: IntArray | None = None
    labels: tuple[str, ...] = ()
    warnings: list[str] = []
    stamps, rows, scale = [], [], 1.0
    for number, line in enumerate(file.lines(), 1):
        cells = [cell.strip() for cell in file.rows(number, [line])[0]]
        if columns is None:
            header.append(cells)
            if cells[:1] == ["Frame"]:
                scale = _scale(file, header[0])
                labels, columns = _columns(file, header, warnings)
            elif number >= _HEADER_LINES:
                break
        elif any(cells):
            if len(cells) != len(header[-1]):
                if not line.endswith("\n"):
                    file.cut = f"line {number} is cut off"
                    break
                raise file.error(number, f"{len(cells)} cells, expected {len(header[-1])}")
            stamps.append(file.time_ns(number, cells[1], "Time (Seconds)"))
            rows.append([_number(file, number, cells[int(column)]) for column in columns.flat])
    if columns is None:
        raise file.error(len(header), "no line Frame,Time (Seconds),X,Y,Z,... within the header")
    warnings += file.check_whole(len(rows), partial)
    positions = scale * np.array(rows).reshape(len(rows), len(labels), 3)
    return MotiveMarkers(labels, positions, tuple(stamps), tuple(warnings))


def _scale(file: CsvFile, first: list[str]) -> float:
    said = dict(zip(first[::2], first[1::2], strict=False))
    unit = said.get("Length Units", "")
    if unit.lower() not in _UNITS:
        expected = "Meters, Centimeters or Millimeters"
        raise file.error(1, f"Length Units is {unit!r}, expected {expected}")
    return _UNITS[unit.lower()]


def _columns(file: CsvFile, header: list[list[str]], warnings: list[str]) -> tuple[tuple[str, ...], IntArray]:
    """Labels, and (p, 3) columns of their coordinates."""
    axes, width, kinds_of = header[-1], len(header[-1]), (_MEASURED, *_SOLVED)
    whole = [row + [""] * (width - len(row)) for row in header[1:-1]]
    kinds = next((row for row in whole if any(cell in kinds_of for cell in row)), None)
    line = len(header)
    if kinds is None:
        raise file.error(line, f"no column of type {', '.join(kinds_of)}: export markers, too")
    # versions before 1.2x omit the word Name
    after = whole[whole.index(kinds) + 1 :]
    names = next((row for row in after if "Name" in row[:2]), after[0] if after else kinds)
    quantities = next((row for row in whole if "Position" in row), None)
    if quantities is None:
        raise file.error(line, "no column of a Position")
    measured = _MEASURED in kinds
    if not measured:
        warnings.append(
            f"{file.path}: no column of type Marker; where the solved bodies expect their markers is taken, whose "
            "errors are others"
        )
    wanted = [
        k for k in range(width) if kinds[k] in ((_MEASURED,) if measured else _SOLVED) and quantities[k] == "Position"
    ]
    if len(wanted) % 3 or any(axes[k] != "XYZ"[place % 3] for place, k in enumerate(wanted)):
        raise file.error(line, "the columns of a marker's position are not X, Y, Z")
    columns = np.array(wanted, dtype=np.intp).reshape(-1, 3)
    return tuple(names[first].strip('"') for first in columns[:, 0].tolist()), columns


def _number(file: CsvFile, line: int, cell: str) -> float:
    try:
        return float(cell) if cell else float("nan")
    except ValueError:
        raise file.error(line, f"{cell!r} is not a number") from None
