"""Writes recordings of skeletons: CSV, and NTU RGB+D ``.skeleton`` files as the data set has them."""

from __future__ import annotations

import csv
import gzip
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from body_tracking.core.skeleton import JOINT_NAMES

COORDINATES = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in "xyz"]
FIRST_ID = 72057594037944738


def csv_row(stamp: object, offset: float = 0.0, **more: object) -> dict[str, object]:
    """A row of a CSV recording whose 75 coordinates are all different."""
    return {"stamp": stamp, **{name: offset + index / 100 for index, name in enumerate(COORDINATES)}, **more}


def write_csv(path: Path, rows: Sequence[dict[str, object]], columns: list[str] | None = None) -> Path:
    """Write a CSV recording of these rows, compressed if the suffix is ``.gz``."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    data = text.getvalue().encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def joint_line(position: Sequence[float], state: int) -> str:
    x, y, z = position
    depth_and_colour = "277.4 191.8 1036.6 519.1"
    orientation = "-0.2059 0.0501 0.9723 0.0992"
    return f"{x:.7g} {y:.7g} {z:.7g} {depth_and_colour} {orientation} {state}"


def skeleton_text(frames: Sequence[Sequence[tuple[int, np.ndarray, np.ndarray]]]) -> str:
    """Args: frames: per frame its bodies: (tracking id, (25, 3) camera space, (25,) states)."""
    lines = [str(len(frames))]
    for bodies in frames:
        lines.append(str(len(bodies)))
        for identity, positions, states in bodies:
            lines.append(f"{identity} 0 1 1 1 1 0 0.02764709 0.05745083 2")
            lines.append("25")
            lines += [joint_line(position, state) for position, state in zip(positions, states, strict=True)]
    return "\r\n".join(lines) + "\r\n"
