"""Points of a C3D file, read with ezc3d; the points of one subject by name, in metres, z up."""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.extras import pip_install
from body_tracking.core.files import open_regular
from body_tracking.core.skeleton import FloatArray

_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
UP_FIRST = {"+X": (1, 2, 0), "+Y": (2, 0, 1), "+Z": (0, 1, 2)}
"""The cyclic permutation that makes an axis of the file z, by the axis that points up."""
_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters of the group POINT that list labels of points with other quantities (https://www.c3d.org, POINT)."""

_BLOCK = 512
_BIG_ENDIAN = 86
"""C3D's code for big-endian processors."""


class MarkerError(BodyTrackingError):
    """Raised when a file lacks the required marker trajectories; the text names those that it has."""


@dataclass(frozen=True, slots=True, eq=False)
class C3dPoints:
    """All points of a file.

    Attributes:
        labels: of the first points; further ones have none.
        data: (n, p, 3) in the file's axes and in ``scale`` metres (points in ``computed``: in other units), NaN where a
            point is not seen.
        scale: metres per unit of length.
        up: the axis that points up (POINT:Y_SCREEN), such as ``+Z``; empty where the file does not say.
        rate: frames per second.
        stamps: (n,) seconds.
        cut: how the file is truncated; empty where it is whole.
        computed: labels of points that are angles, forces, moments, powers or scalars.
        processing: the numbers in the group PROCESSING.
    """

    labels: tuple[str, ...]
    data: FloatArray
    scale: float
    up: str
    rate: float
    stamps: FloatArray
    cut: str
    computed: frozenset[str]
    processing: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One subject of a file: (n, 3) metres per point, z up, NaN where it is not seen."""

    points: dict[str, FloatArray]
    rate: float
    stamps: FloatArray
    processing: dict[str, float]

    @property
    def frames(self) -> int:
        return len(self.stamps)


def read_points(path: Path) -> C3dPoints:
    """All points of a C3D file, also of one that is cut off after its parameters.

    Raises:
        MarkerError: the file cannot be read, has no points, or an unknown unit of length.
    """
    frames = _announced_frames(path)
    try:
        ezc3d: Any = importlib.import_module("ezc3d")
    except ImportError as error:
        raise MarkerError(f"{path}: C3D files need ezc3d ({error}): {pip_install('c3d')}") from error
    try:
        file = ezc3d.c3d(str(path))
        parameters = file["parameters"]
        header = file["header"]["points"]
        data = np.asarray(file["data"]["points"], dtype=float)[:3].transpose(2, 1, 0)
        residuals = np.asarray(file["data"]["meta_points"]["residuals"], dtype=float)[0].T
    # a damaged file raises any of these
    except (OSError, RuntimeError, ValueError, LookupError, MemoryError, TypeError) as error:
        raise MarkerError(f"{path}: not a C3D file that can be read ({error})") from error

    def values(group: str, name: str) -> list[Any]:
        return list(parameters[group][name]["value"]) if group in parameters and name in parameters[group] else []

    def value(group: str, name: str, default: Any) -> Any:
        return next(iter(values(group, name)), default)

    def all_of(name: str) -> list[str]:
        found = values("POINT", name)
        for number in range(2, 100):  # a parameter holds at most 255 names
            found += values("POINT", f"{name}{number}")
        return [str(each).strip() for each in found]

    labels = all_of("LABELS")[: data.shape[1]]
    if not data.size:
        raise MarkerError(f"{path}: {data.shape[1]} points in {len(data)} frames: there are no trajectories in it")
    rate = float(value("POINT", "RATE", header["frame_rate"]))
    unit = value("POINT", "UNITS", "mm").strip()
    if not rate > 0.0:
        raise MarkerError(f"{path}: {rate} frames per second")
    if unit not in _UNITS:
        raise MarkerError(f"{path}: unit of length {unit!r}, expected one of {', '.join(_UNITS)}")
    seen = np.isfinite(data).all(axis=-1) & (data != 0.0).any(axis=-1) & (residuals >= 0.0)
    numbers = {name: value("PROCESSING", name, None) for name in parameters.get("PROCESSING", {}) if name[0] != "_"}
    return C3dPoints(
        tuple(labels),
        np.where(seen[..., None], data, np.nan),
        _UNITS[unit],
        str(value("POINT", "Y_SCREEN", "")).strip().upper(),
        rate,
        (int(header["first_frame"]) + np.arange(len(data))) / rate,
        f"cut off after {len(data)} of {frames} frames" if len(data) < frames else "",
        frozenset(label for name in _COMPUTED for label in all_of(name)),
        {name: float(number) for name, number in numbers.items() if isinstance(number, int | float | np.number)},
    )


def read_trial(path: Path, subject: str | None, wanted: Collection[str]) -> Trial:
    """One subject of a C3D file.

    Args:
        path: of the file.
        subject: the prefix of the points' names; required where several subjects have wanted points.
        wanted: names of points, without prefix.

    Raises:
        MarkerError: the file cannot be read, or lacks the subject.
    """
    file = read_points(path)
    if file.cut:
        raise MarkerError(f"{path}: {file.cut}")
    if not file.labels:
        raise MarkerError(f"{path}: no point has a label")
    up = file.up or "+Z"
    if up not in UP_FIRST:
        raise MarkerError(f"{path}: the axis that points up (POINT:Y_SCREEN) is {up!r}, expected +X, +Y or +Z")
    chosen = _of_subject(path, list(file.labels), subject, wanted)
    points = {name: file.scale * file.data[:, index][:, UP_FIRST[up]] for name, index in chosen.items()}
    return Trial(points, file.rate, file.stamps, file.processing)


def _announced_frames(path: Path) -> int:
    """Number of frames by the file's header; refuses files that crash ezc3d: folders, truncated parameters."""
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise MarkerError(f"{path}: not a file")
        with open_regular(path) as stream:
            head = stream.read(256 * _BLOCK)
    except OSError as error:
        raise MarkerError(f"{path}: {error.strerror or error}") from error
    if not size:
        raise MarkerError(f"{path}: the file is empty")
    if size < _BLOCK or head[1] != 0x50 or head[0] < 2:
        raise MarkerError(f"{path}: not a C3D file ({size} bytes that do not begin as one)")
    start = (head[0] - 1) * _BLOCK
    if size < start + 4 or size < start + head[start + 2] * _BLOCK:
        raise MarkerError(f"{path}: cut off after {size} bytes, before the end of its parameters")
    order = ">u2" if head[start + 3] == _BIG_ENDIAN else "<u2"
    first, last = np.frombuffer(head[6:10], dtype=order)
    return int(last) - int(first) + 1


def _of_subject(path: Path, labels: list[str], subject: str | None, wanted: Collection[str]) -> dict[str, int]:
    """Indices of a subject's points by their names without prefix."""
    split = [tuple(label.rpartition(":")[::2]) for label in labels]
    named = {prefix for prefix, name in split if name in wanted}
    if subject is not None and subject not in named:
        raise MarkerError(f"{path}: no subject {subject!r}; found {listed(sorted(named))}")
    if subject is None and len(named) > 1:
        raise MarkerError(f"{path}: {len(named)} subjects, choose one of {listed(sorted(named))}")
    if not named:
        return {name: index for index, (_, name) in enumerate(split)}
    chosen = subject if subject is not None else next(iter(named))
    places = {name: index for index, (prefix, name) in enumerate(split) if prefix == chosen}
    counts = Counter(name for prefix, name in split if prefix == chosen)
    twice = [name for name in wanted if counts[name] > 1]
    if twice:
        raise MarkerError(f"{path}: more than one point is called {listed(sorted(twice))}")
    return places


def listed(names: Iterable[str], most: int = 100) -> str:
    listed = [name or "(no prefix)" for name in names]
    return (", ".join(listed[:most]) + (", ..." if len(listed) > most else "")) or "none"
