"""What an evaluation found, for people and programs: tables on a terminal, CSV, JSON and one page of HTML."""

from __future__ import annotations

import csv
import html
import io
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from body_tracking.evaluation.comparison import AngleComparison, Comparison, Evaluation
from body_tracking.evaluation.summary import EvaluationError
from body_tracking.skeleton import BONES, JOINT_NAMES, NANOSECONDS, FloatArray, IntArray, Joint

THESIS_JOINTS = (
    Joint.SPINE_MID,
    Joint.SPINE_SHOULDER,
    Joint.SHOULDER_LEFT,
    Joint.ELBOW_LEFT,
    Joint.WRIST_LEFT,
    Joint.HAND_TIP_LEFT,
    Joint.SHOULDER_RIGHT,
    Joint.ELBOW_RIGHT,
    Joint.WRIST_RIGHT,
    Joint.HAND_TIP_RIGHT,
)
"""The ten over which the thesis averages (section 5.7.2, tables 5.3 and E.1)."""

_NAMED = "named"
_UNITS = {"mm": 1e3, "deg": float(np.degrees(1.0)), "%": 1e2, "ms": 1e3, "s": 1.0, "": 1.0}
_DIGITS = {"mm": 1, "deg": 1, "%": 1, "ms": 1, "s": 2, "": 0}


def _average(values: FloatArray) -> float:
    return float(values.mean())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def _largest(values: FloatArray) -> float:
    return float(values.max())


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """A number for each row of a table.

    Attributes:
        key: for programs.
        title: for people.
        unit: shown; one of mm, deg, %, ms, s or none.
        values: (rows,) in SI units, shares from 0 to 1; NaN where there is nothing to say.
        pool: how rows become one.
    """

    key: str
    title: str
    unit: str
    values: FloatArray
    pool: Callable[[FloatArray], float] = _average

    @property
    def shown(self) -> FloatArray:
        """(rows,) in the unit."""
        return np.asarray(self.values, dtype=np.float64) * _UNITS[self.unit]

    def text(self, row: int) -> str:
        """One number for people."""
        value = self.shown[row]
        return "-" if np.isnan(value) else f"{value:.{_DIGITS[self.unit]}f}"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of numbers.

    Attributes:
        key: for programs.
        title: for people.
        names: of the rows.
        columns: at least one.
        note: what the columns mean.
        pools: how many of the last rows are made of the others.
    """

    key: str
    title: str
    names: tuple[str, ...]
    columns: tuple[Column, ...]
    note: str = ""
    pools: int = 0

    def pooled(self, groups: Sequence[tuple[str, IntArray]], rows: IntArray) -> Table:
        """The given rows, and one more for each group of rows."""
        columns = []
        for column in self.columns:
            values = np.asarray(column.values, dtype=np.float64)
            known = [values[group][np.isfinite(values[group])] for _, group in groups]
            pools = [column.pool(each) if len(each) else np.nan for each in known]
            columns.append(replace(column, values=np.concatenate([values[rows], pools])))
        names = (*(self.names[row] for row in rows), *(name for name, _ in groups))
        return replace(self, names=names, columns=tuple(columns), pools=len(groups))


def _key(name: str) -> str:
    return name.replace(" ", "_")


def tables(result: Evaluation) -> tuple[Table, ...]:
    """Everything that was found, as tables."""
    made = [_joint_table(result, comparison) for comparison in result.comparisons]
    for comparison in result.comparisons:
        made.append(_angle_table(comparison.positional, comparison, "angles", "angles of both skeletons"))
        if comparison.named is not None:
            made.append(
                _angle_table(comparison.named, comparison, _NAMED, "angles by name, as the estimate states them")
            )
    made.append(_length_table(result))
    if result.calibration:
        made.append(_calibration_table(result))
    return tuple(made)


def shown(result: Evaluation) -> tuple[Table, ...]:
    """The tables for people: without angles by name that are those of the skeletons once more."""
    return tuple(
        table for table in tables(result) if not (table.key.startswith(_NAMED) and named_are_positional(result))
    )


def named_are_positional(result: Evaluation) -> bool:
    """Whether the angles that the estimate states are those that are computed from its skeletons anyway."""
    angles = result.estimate.angles
    return angles is not None and set(angles.names) == set(result.comparisons[0].positional.names)


def _joint_table(result: Evaluation, comparison: Comparison) -> Table:
    errors = comparison.joints
    columns = [
        *(Column(f"mae_{axis}", f"MAE {axis}", "mm", errors.mae[:, n]) for n, axis in enumerate("xyz")),
        *(Column(f"max_{axis}", f"max {axis}", "mm", errors.largest[:, n], _largest) for n, axis in enumerate("xyz")),
        Column("mean", "mean 3D", "mm", errors.mean),
        Column("rms", "RMS 3D", "mm", errors.rms, _rms),
        Column("max", "max 3D", "mm", errors.farthest, _largest),
        Column("offset", "offset", "mm", np.linalg.norm(errors.offset, axis=1)),
        Column("fixed_mean", "mean-o", "mm", errors.fixed_mean),
        Column("fixed_rms", "RMS-o", "mm", errors.fixed_rms, _rms),
        Column("jitter", "jitter", "mm", result.jitter, _rms),
        Column("off_track", "off", "%", comparison.off_track),
        Column("covered", "in 95%", "%", errors.covered),
    ]
    table = Table(
        f"joints_{_key(comparison.name)}",
        f"joints, {comparison.name}",
        JOINT_NAMES,
        tuple(columns),
        "offset: constant in the frame of the joint's segment; mean-o, RMS-o: without it. jitter: as white noise along "
        f"an axis. off: missing or more than {1e3 * result.parameters.beyond:.0f} mm away. in 95%: the truth lies in "
        "the stated 95 % ellipsoid.",
    )
    compared = np.flatnonzero(errors.frames)
    ten = np.intersect1d(compared, THESIS_JOINTS)
    return table.pooled([(f"of the thesis's ten ({len(ten)})", ten), (f"all ({len(compared)})", compared)], compared)


def _angle_table(angles: AngleComparison, comparison: Comparison, key: str, title: str) -> Table:
    errors = angles.errors
    columns = (
        Column("rmse", "RMSE", "deg", errors.rmse, _rms),
        Column("offset", "offset", "deg", errors.offset),
        Column("fixed_rmse", "RMSE-o", "deg", errors.fixed_rmse, _rms),
        Column("mae", "MAE", "deg", errors.mae),
        Column("max", "max", "deg", errors.largest, _largest),
        Column("covered", "in 95%", "%", errors.covered),
        Column("compared", "frames", "%", errors.frames / max(len(angles.times), 1)),
    )
    note = "offset: mean error; RMSE-o: without it. frames: share in which the angle is stated and the truth shows it."
    return Table(f"{key}_{_key(comparison.name)}", f"{title}, {comparison.name}", angles.names, columns, note)


def _length_table(result: Evaluation) -> Table:
    lengths = result.lengths
    names = tuple(f"{JOINT_NAMES[parent]}-{JOINT_NAMES[child]}" for parent, child in BONES)
    table = Table(
        "lengths",
        "segment lengths",
        names,
        (
            Column("spread", "spread", "mm", lengths.spread, _rms),
            Column("true_spread", "true spread", "mm", lengths.true_spread, _rms),
            Column("error", "mean error", "mm", lengths.error),
        ),
        "spread: standard deviation over time.",
    )
    rows = np.flatnonzero(np.isfinite(lengths.spread))
    return table.pooled([(f"all ({len(rows)})", rows)], rows)


def _calibration_table(result: Evaluation) -> Table:
    last = [
        (
            each.poses.rotation[-1],
            each.poses.translation[-1],
            each.poses.displacement[-1],
            each.clock[-1] if len(each.clock) else np.nan,
        )
        for each in result.calibration
    ]
    rotation, translation, displacement, clock = np.array(last).T
    return Table(
        "calibration",
        "calibration, the last one against the true one",
        tuple(each.sensor for each in result.calibration),
        (
            Column("rotation", "rotation", "deg", rotation, _rms),
            Column("translation", "translation", "mm", translation, _rms),
            Column("displacement", "at the person", "mm", displacement, _rms),
            Column("clock", "clock", "ms", clock),
        ),
        "translation: of the sensor; at the person: by how much it shows the base of the spine elsewhere.",
    )


def facts(result: Evaluation) -> tuple[tuple[str, str], ...]:
    """Name and value of what is true of the whole recording."""
    estimate, truth = result.estimate, result.truth
    first, last = result.span
    length = float(truth.stamps_ns[-1] - truth.stamps_ns[0]) / NANOSECONDS
    rows = [
        ("estimate", f"{estimate.source} {estimate.topic}: {len(estimate.stamps_ns)} frames"),
        ("truth", f"{truth.source} {truth.topic}".rstrip() + f": {len(truth.stamps_ns)} frames"),
        ("compared", f"{last - first:.2f} s, from {first:.2f} s on, of the truth's {length:.2f} s"),
        ("delay", _delay(result.delay)),
    ]
    for comparison in result.comparisons:
        table = _joint_table(result, comparison)
        all_rms, fixed = (next(c for c in table.columns if c.key == key).text(-1) for key in ("rms", "fixed_rms"))
        rows.append((comparison.name, f"RMS 3D {all_rms} mm; {fixed} mm without each joint's own offset"))
    if named_are_positional(result):
        rows.append(("angles", "those that the estimate states by name are those of its skeletons"))
    return (*rows, *(("note", note) for note in result.notes))


def _delay(seconds: float) -> str:
    if np.isnan(seconds):
        return "cannot be told"
    return f"{1e3 * seconds:.1f} ms: the estimate {'follows' if seconds > 0.0 else 'is ahead of'} the truth"


def text(result: Evaluation) -> str:
    """For a terminal."""
    lines = [f"{name:<9} {value}" for name, value in facts(result)]
    for table in shown(result):
        width = max(len(name) for name in (*table.names, table.title))
        widths = [max(len(column.title), 6) for column in table.columns]
        units = [column.unit for column in table.columns]
        header = f"{table.title:<{width}} " + " ".join(
            f"{column.title:>{size}}" for column, size in zip(table.columns, widths, strict=True)
        )
        under = " " * width + " " + " ".join(f"{unit:>{size}}" for unit, size in zip(units, widths, strict=True))
        lines += ["", header, under, "-" * len(header)]
        lines += [
            f"{name:<{width}} "
            + " ".join(f"{column.text(row):>{size}}" for column, size in zip(table.columns, widths, strict=True))
            for row, name in enumerate(table.names)
        ]
    return "\n".join(lines)


def write_csv(result: Evaluation, path: Path) -> None:
    """A line per number: table, row, column, unit, value.

    Raises:
        EvaluationError: the file cannot be written.
    """
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(("table", "row", "column", "unit", "value"))
    writer.writerow(("recording", "all", "delay", "ms", _plain(1e3 * result.delay)))
    for table in tables(result):
        for row, name in enumerate(table.names):
            for column in table.columns:
                writer.writerow((table.key, name, column.key, column.unit, _plain(column.shown[row])))
    write(path, lines.getvalue())


def _plain(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.6g}"


def as_json(result: Evaluation) -> str:
    """For programs: facts, and tables of rows of columns; null where there is nothing to say."""

    def number(value: float) -> float | None:
        return round(float(value), 6) if np.isfinite(value) else None

    content: dict[str, Any] = {
        "estimate": str(result.estimate.source),
        "topic": result.estimate.topic,
        "truth": str(result.truth.source),
        "span_s": [number(each) for each in result.span],
        "delay_ms": number(1e3 * result.delay),
        "notes": list(result.notes),
        "tables": {
            table.key: {
                "units": {column.key: column.unit for column in table.columns},
                "rows": {
                    name: {column.key: number(column.shown[row]) for column in table.columns}
                    for row, name in enumerate(table.names)
                },
            }
            for table in tables(result)
        },
    }
    return json.dumps(content, indent=1)


_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1250px; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 2px 9px; text-align: right; border-bottom: 1px solid #e4e4e4; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 1px solid #888; } tr.pooled td { font-weight: 600; border-top: 1px solid #aaa; }
.wide { overflow-x: auto; } p.note { color: #666; font-size: 13px; max-width: 75em; } img { max-width: 100%; }
dl { display: grid; grid-template-columns: max-content auto; gap: 2px 1.2em; } dt { color: #666; } dd { margin: 0; }
""".strip()


def page(result: Evaluation, pictures: Iterable[tuple[str, str, str]]) -> str:
    """One HTML page that needs nothing else.

    Args:
        result: what was found.
        pictures: title, explanation and ``data:`` address of each.
    """
    title = f"{result.estimate.source.name}: accuracy"
    parts = [
        "<!DOCTYPE html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        "<dl>" + "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd>" for k, v in facts(result)) + "</dl>",
    ]
    for caption, explanation, address in pictures:
        parts += [
            f"<h2>{html.escape(caption)}</h2>",
            f'<p class="note">{html.escape(explanation)}</p>',
            f'<img alt="{html.escape(caption)}" src="{address}">',
        ]
    parts += [_html_table(table) for table in shown(result)]
    return "\n".join([*parts, "</body></html>", ""])


def _html_table(table: Table) -> str:
    head = "".join(
        f"<th>{html.escape(column.title)}{f'<br>{column.unit}' if column.unit else ''}</th>" for column in table.columns
    )
    pooled = len(table.names) - table.pools
    rows = "".join(
        ("<tr>" if row < pooled else '<tr class="pooled">')
        + f"<td>{html.escape(name)}</td>"
        + "".join(f"<td>{column.text(row)}</td>" for column in table.columns)
        + "</tr>\n"
        for row, name in enumerate(table.names)
    )
    return (
        f'<h2>{html.escape(table.title)}</h2><p class="note">{html.escape(table.note)}</p>'
        f'<div class="wide"><table><thead><tr><th></th>{head}</tr></thead><tbody>\n{rows}</tbody></table></div>'
    )


def check_writable(path: Path) -> None:
    """Make the folder of a file to come, and find out early what would be in its way.

    Raises:
        EvaluationError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}") from error
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise EvaluationError(f"{path}: {'is a folder' if path.is_dir() else 'may not be written'}")


def write(path: Path, content: str) -> None:
    """A text file; its folder is made where it is missing.

    Raises:
        EvaluationError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}") from error
