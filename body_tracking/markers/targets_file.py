"""Targets as YAML files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.recognition import RecognitionError, check_targets
from body_tracking.markers.targets import Target

MAX_BALLS: Final = 32
"""Largest number of balls of a target; the covariance then has nine thousand numbers."""
_MAX_SIZE: Final = 10.0
"""Largest coordinate and diameter, metres."""

_HEADER = """\
# Targets written by body_tracking: points are the centres of the balls in the target's frame (origin at their
# centroid), metres; covariance is that of all their coordinates x1 y1 z1 x2 ..., square metres, row by
# row, left out where the geometry is known; diameter is that of a ball, metres.
"""


class TargetsFileError(BodyTrackingError):
    """Raised for a file of targets that cannot be read or written."""


def save_targets(targets: Sequence[Target], path: Path) -> None:
    """Write targets; replaces the file atomically.

    Raises:
        RecognitionError: invalid targets.
        TargetsFileError: the file cannot be written.
    """
    check_targets(targets)
    entries: dict[str, Any] = {}
    for target in targets:
        entries[target.name] = {"points": target.points.tolist(), "diameter": float(target.diameter)}
        if target.covariance.any():
            entries[target.name]["covariance"] = target.covariance.tolist()
    files.write_text(path, _HEADER + files.dump_yaml({"targets": entries}), TargetsFileError)


def load_targets(path: Path) -> list[Target]:
    """Read targets.

    Raises:
        TargetsFileError: the file is missing, is not YAML, or lacks or misstates a value; the message names the value.
    """
    data = files.read_yaml(path, error=TargetsFileError)
    entries = data.get("targets") if isinstance(data, dict) else None
    if not isinstance(entries, dict):
        raise TargetsFileError(f"{path}: expected the key targets")
    targets = []
    for name, entry in entries.items():
        try:
            targets.append(_target(str(name), entry))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            text = f"lacks {error}" if isinstance(error, KeyError) else str(error)
            raise TargetsFileError(f"{path}: target {name}: {text}") from error
    try:
        check_targets(targets)
    except RecognitionError as error:
        raise TargetsFileError(f"{path}: {error}") from error
    return targets


def _target(name: str, entry: dict[str, Any]) -> Target:
    points = _array(entry["points"], "points")
    count = len(points)
    if points.shape != (count, 3) or not 3 <= count <= MAX_BALLS or np.abs(points).max() > _MAX_SIZE:
        raise ValueError(f"points {points.shape}, expected 3 to {MAX_BALLS} of 3 coordinates within {_MAX_SIZE:g} m")
    covariance = np.zeros((3 * count, 3 * count))
    if entry.get("covariance") is not None:
        covariance = _array(entry["covariance"], "covariance")
        if covariance.shape != (3 * count, 3 * count):
            raise ValueError(f"covariance {covariance.shape}, expected {(3 * count, 3 * count)}")
        largest = np.abs(covariance).max()
        if np.abs(covariance - covariance.T).max() > 1e-6 * largest:
            raise ValueError("covariance is not symmetric")
        if np.linalg.eigvalsh(covariance)[0] < -1e-6 * largest:
            raise ValueError("covariance has a negative eigenvalue")
    diameter = float(entry.get("diameter", 0.0))
    if not 0.0 <= diameter <= _MAX_SIZE:
        raise ValueError(f"diameter is {diameter}, expected 0 to {_MAX_SIZE:g} m")
    return Target(name, points, covariance, diameter)


def _array(values: Any, key: str) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if array.ndim != 2 or not np.isfinite(array).all():
        raise ValueError(f"{key} must be rows of finite numbers")
    return array
