"""Report of an evaluation: tables on a terminal, JSON and one HTML page."""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from body_tracking.core.skeleton import BONES, JOINT_NAMES, NANOSECONDS, FloatArray, IntArray, Joint
from body_tracking.evaluation.comparison import AS_IT_IS, BEYOND, AngleComparison, Comparison, Evaluation
from body_tracking.evaluation.overview import coverage_in_words, errors_in_words
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.kinematics.labels import UNKNOWN

THESIS_JOINTS = (
    *(Joint.SPINE_MID, Joint.SPINE_SHOULDER),
    *(Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT, Joint.WRIST_LEFT, Joint.HAND_TIP_LEFT),
    *(Joint.SHOULDER_RIGHT, Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT, Joint.HAND_TIP_RIGHT),
)
"""The ten joints over which the thesis averages (section 5.7.2, tables 5.3 and E.1)."""


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        key: in JSON.
        title: in text.
        unit: mm, deg, % or ms.
        values: (rows,) in the unit; NaN for no value.
        pool: function that combines rows into one.
        digits: decimals in text.
    """

    key: str
    title: str
    unit: str
    values: FloatArray
    pool: Callable[[FloatArray], float] = np.mean
    digits: int = 1

    def text(self, row: int) -> str:
        """The formatted value of a row."""
        value = self.values[row]
        return "-" if np.isnan(value) else f"{value:z.{self.digits}f}"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of numbers; ``key`` is used in JSON, ``title`` and ``note`` in text."""

    key: str
    title: str
    names: tuple[str, ...]
    columns: tuple[Column, ...]
    note: str = ""

    def row(self, name: str) -> dict[str, float]:
        """The numbers of a row by column key."""
        return {column.key: float(column.values[self.names.index(name)]) for column in self.columns}

    def text(self, width: int = 120) -> str:
        """Titles, units, a line and the rows; columns beyond the width follow below."""
        first = max(map(len, (self.title, *self.names)))
        names = [f"{name:<{first}}" for name in (self.title, "", *self.names)]
        blocks, used = [[names]], first
        for column in self.columns:
            cells = [column.title, column.unit, *map(column.text, range(len(self.names)))]
            own = max(6, *map(len, cells))
            used += 2 + own
            if used > width:
                blocks.append([names])
                used = first + 2 + own
            blocks[-1].append([f"{cell:>{own}}" for cell in cells])
        lines = []
        for block in blocks:
            header, units, *rows = map("  ".join, zip(*block, strict=True))
            lines += ["", header, units, "-" * len(header), *rows]
        return "\n".join(lines[1:])

    def pooled(self, groups: dict[str, IntArray], rows: IntArray) -> Table:
        """A table of the given rows, plus a pooled row per group."""

        def values(column: Column) -> FloatArray:
            known = [column.values[group][np.isfinite(column.values[group])] for group in groups.values()]
            return np.append(column.values[rows], [column.pool(each) if len(each) else np.nan for each in known])

        columns = tuple(column._replace(values=values(column)) for column in self.columns)
        return Table(self.key, self.title, (*(self.names[row] for row in rows), *groups), columns, self.note)


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The results of an evaluation, for output.

    Attributes:
        name: of the estimate.
        facts: names and values for the whole recording.
        content: the facts for JSON.
        tables: all results.
        hidden: keys of the tables omitted in text.
    """

    name: str
    facts: tuple[tuple[str, str], ...]
    content: Mapping[str, object]
    tables: tuple[Table, ...]
    hidden: frozenset[str] = frozenset()

    def lines(self) -> str:
        """The facts, one per line."""
        return "\n".join(f"{name:<9} {value}" for name, value in self.facts)

    def text(self) -> str:
        """The tables as text."""
        return "\n".join(f"\n{each.text()}\n{each.note}" for each in self.tables if each.key not in self.hidden)

    def json(self) -> str:
        """Facts and tables; null for NaN."""
        by_key = {
            table.key: {
                "units": {column.key: column.unit for column in table.columns},
                "rows": {
                    name: {key: numbered(value) for key, value in table.row(name).items()} for name in table.names
                },
            }
            for table in self.tables
        }
        return json.dumps({**self.content, "tables": by_key}, indent=1)

    def page(self, pictures: Iterable[tuple[str, str]]) -> str:
        """One self-contained HTML page; ``pictures`` are captions and ``data:`` addresses."""
        title = html.escape(self.name)
        shown = "".join(f'<h2>{html.escape(caption)}</h2>\n<img alt="" src="{data}">\n' for caption, data in pictures)
        return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>body {{ max-width: 1250px; margin: auto; padding: 1em; }}
 h2 {{ font: 16px sans-serif; }} img {{ max-width: 100%; }}</style>
</head><body><h1>{title}</h1>
<pre>{html.escape(self.lines())}</pre>
{shown}<pre>{html.escape(self.text())}</pre>
</body></html>
"""


def report_of(result: Evaluation) -> Report:
    """The report of an evaluation; its text omits named angles that repeat those of the skeletons."""
    content = {
        "estimate": str(result.estimate.source),
        "topic": result.estimate.topic,
        "truth": str(result.truth.source),
        "span_s": [numbered(each) for each in result.span],
        "delay_ms": numbered(1e3 * result.delay),
        "notes": list(result.notes),
    }
    made = tables(result)
    hidden = [each.key for each in made if each.key.startswith("named") and named_are_positional(result)]
    return Report(f"{result.estimate.source.name}: accuracy", _facts(result), content, made, frozenset(hidden))


def tables(result: Evaluation) -> tuple[Table, ...]:
    """All results as tables."""
    made = [_joint_table(result, comparison) for comparison in result.comparisons]
    title = "angles of both skeletons"
    if named_are_positional(result):
        title += ", which are those by name"
    for each in result.comparisons:
        made.append(_angle_table(each.positional, each.name, "angles", title))
        if each.named is not None:
            made.append(_angle_table(each.named, each.name, "named", "angles by name, as the estimate states them"))
    return (*made, _length_table(result), *([_calibration_table(result)] if result.calibration else []))


def named_are_positional(result: Evaluation) -> bool:
    """Whether the estimate's own angles are those computed from skeletons."""
    angles = result.estimate.angles
    return angles is not None and set(angles.names) == set(result.comparisons[0].positional.names)


def _joint_table(result: Evaluation, comparison: Comparison) -> Table:
    errors = comparison.joints
    axes = list(enumerate("xyz"))
    columns = (
        *(Column(f"mae_{axis}", f"MAE {axis}", "mm", 1e3 * errors.mae[:, n]) for n, axis in axes),
        *(Column(f"max_{axis}", f"max {axis}", "mm", 1e3 * errors.largest[:, n], np.max) for n, axis in axes),
        Column("mean", "mean 3D", "mm", 1e3 * errors.mean),
        Column("rms", "RMS 3D", "mm", 1e3 * errors.rms, _rms),
        Column("max", "max 3D", "mm", 1e3 * errors.farthest, np.max),
        Column("offset", "offset", "mm", 1e3 * np.linalg.norm(errors.offset, axis=1)),
        Column("fixed_mean", "mean-o", "mm", 1e3 * errors.fixed_mean),
        Column("fixed_rms", "RMS-o", "mm", 1e3 * errors.fixed_rms, _rms),
        Column("jitter", "jitter", "mm", 1e3 * result.jitter, _rms),
        Column("off_track", "off", "%", 1e2 * comparison.off_track),
        Column("covered", "in 95%", "%", 1e2 * errors.covered),
    )
    note = (
        "offset: constant in the frame of the joint's segment; mean-o, RMS-o: without it. jitter: as white noise along "
        f"an axis.\noff: missing or more than {1e3 * BEYOND:.0f} mm away. in 95%: the truth lies in "
        "the stated 95 % ellipsoid."
    )
    table = Table(
        f"joints_{comparison.name.replace(' ', '_')}", f"joints, {comparison.name}", JOINT_NAMES, columns, note
    )
    compared = np.flatnonzero(errors.frames)
    ten = np.intersect1d(compared, THESIS_JOINTS)
    return table.pooled({f"of the thesis's ten ({len(ten)})": ten, f"all ({len(compared)})": compared}, compared)


def _angle_table(angles: AngleComparison, comparison: str, key: str, title: str) -> Table:
    errors = angles.errors
    columns = (
        Column("rmse", "RMSE", "deg", np.degrees(errors.rmse)),
        Column("offset", "offset", "deg", np.degrees(errors.offset)),
        Column("fixed_rmse", "RMSE-o", "deg", np.degrees(errors.fixed_rmse)),
        Column("mae", "MAE", "deg", np.degrees(errors.mae)),
        Column("max", "max", "deg", np.degrees(errors.largest)),
        Column("covered", "in 95%", "%", 1e2 * errors.covered),
        Column("compared", "frames", "%", 1e2 * errors.frames / max(len(angles.times), 1)),
    )
    note = "offset: mean error; RMSE-o: without it. frames: share in which the angle is stated and the truth shows it."
    return Table(f"{key}_{comparison.replace(' ', '_')}", f"{title}, {comparison}", angles.names, columns, note)


def _length_table(result: Evaluation) -> Table:
    lengths = result.lengths
    names = tuple(f"{JOINT_NAMES[parent]}-{JOINT_NAMES[child]}" for parent, child in BONES)
    columns = (
        Column("spread", "spread", "mm", 1e3 * lengths.spread, _rms),
        Column("true_spread", "true spread", "mm", 1e3 * lengths.true_spread, _rms),
        Column("error", "mean error", "mm", 1e3 * lengths.error),
    )
    rows = np.flatnonzero(np.isfinite(lengths.spread))
    table = Table("lengths", "segment lengths", names, columns, "spread: standard deviation over time.")
    return table.pooled({f"all ({len(rows)})": rows}, rows)


def _calibration_table(result: Evaluation) -> Table:
    def last(errors: Iterable[FloatArray], scale: float) -> FloatArray:
        return np.array([scale * each[-1] if len(each) else np.nan for each in errors])

    found = result.calibration
    columns = (
        Column("rotation", "rotation", "deg", last((each.poses.rotation for each in found), float(np.degrees(1.0)))),
        Column("translation", "translation", "mm", last((each.poses.translation for each in found), 1e3)),
        Column("displacement", "at the person", "mm", last((each.poses.displacement for each in found), 1e3)),
        Column("clock", "clock", "ms", last((each.clock for each in found), 1e3)),
    )
    title = "calibration, the last one against the true one"
    note = "translation: of the sensor; at the person: by how much it shows the base of the spine elsewhere."
    return Table("calibration", title, tuple(each.sensor for each in found), columns, note)


def _facts(result: Evaluation) -> tuple[tuple[str, str], ...]:
    estimate, truth = result.estimate, result.truth
    first, last = result.span
    length = float(truth.stamps_ns[-1] - truth.stamps_ns[0]) / NANOSECONDS
    delay = f"{1e3 * result.delay:z.1f} ms of the estimate after the truth"
    rows = [
        ("estimate", f"{estimate.source} {estimate.topic}: {len(estimate.stamps_ns)} frames"),
        ("truth", f"{truth.source} {truth.topic}".rstrip() + f": {len(truth.stamps_ns)} frames"),
        ("compared", f"{last - first:.2f} s, from {first:.2f} s on, of the truth's {length:.2f} s"),
        ("delay", "unknown" if np.isnan(result.delay) else delay),
        *(("" if number else "angles", text) for number, text in enumerate(_angles_in_words(result))),
        *(("" if number else "joints", text) for number, text in enumerate(_joints_in_words(result))),
    ]
    notes = list(result.notes)
    if _other_frame(result) and estimate.frame_id == truth.frame_id:
        off = 1e3 * np.nanmedian(result.comparisons[0].joints.rms)
        notes.append(
            f"as they are, joints are {off:.0f} mm off in the median: the truth has another origin or other axes, or "
            "the calibration is wrong"
        )
    return (*rows, *(("note", note) for note in notes))


def _other_frame(result: Evaluation) -> bool:
    """Whether alignment brings distant joints close."""
    first, last = (each.joints.rms[each.joints.frames > 0] for each in (result.comparisons[0], result.comparisons[-1]))
    return bool(np.median(first) > BEYOND > np.median(last))


def _headline(result: Evaluation) -> Comparison:
    """The comparison to summarise: as it is, or aligned if estimate and truth have different frames."""
    return result.comparisons[-1 if _other_frame(result) else 0]


def _angles_in_words(result: Evaluation) -> list[str]:
    """Summary lines of the angles that the estimate states by name, else of its skeletons' angles."""
    comparison = _headline(result)
    compared = comparison.named or comparison.positional
    errors = compared.errors
    known, count = errors.frames > 0, f"{len(compared.names)}"
    stated = np.where(np.isfinite(compared.stddev), compared.stddev, np.inf)
    if np.isfinite(stated).any():
        # the same criterion as in the output of replay
        known &= np.median(stated, axis=0) < np.radians(UNKNOWN)
        count = f"{known.sum()} of {count} known (standard deviation below {UNKNOWN:.0f} deg in most frames)"
    names = [name for name, there in zip(compared.names, known, strict=True) if there]
    lines = [count + ("" if comparison.named else ", computed from both skeletons")]
    if names:
        lines += [
            errors_in_words(names, np.degrees(errors.rmse[known]), "deg"),
            coverage_in_words("truth within 1.96 standard deviations", errors.covered[known], errors.frames[known]),
        ]
    if not known.all():
        lines.append(f"not known: {', '.join(name for name in compared.names if name not in names)}")
    return lines


def _joints_in_words(result: Evaluation) -> list[str]:
    def median(rms: FloatArray) -> str:
        return f"{1e3 * np.median(rms[np.isfinite(rms)]):.1f} mm"

    shown, aligned = _headline(result), result.comparisons[-1]
    errors, there = shown.joints, shown.joints.frames > 0
    names = [name for name, known in zip(JOINT_NAMES, there, strict=True) if known]
    count, more = f"{len(names)}", f"median {median(errors.fixed_rms)} without each joint's own offset"
    if shown.name != AS_IT_IS:
        count += ", after alignment in time and space"
    elif aligned is not shown:
        more += f", {median(aligned.joints.rms)} after alignment in time and space"
    return [
        count,
        errors_in_words(names, 1e3 * errors.rms[there], "mm"),
        coverage_in_words("truth within the stated 95 % ellipsoid", errors.covered[there], errors.frames[there]),
        more,
    ]


def numbered(value: float) -> float | None:
    """A number for JSON; null for NaN and infinity."""
    return round(float(value), 6) if np.isfinite(value) else None


def make_folder(path: Path) -> None:
    """Create the folder of an output file, before the slow computation of its content.

    Raises:
        EvaluationError: the folder cannot be created.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}") from error


def write(path: Path, content: bytes) -> None:
    """Write a file, creating its folder if needed.

    Raises:
        EvaluationError: the file cannot be written.
    """
    make_folder(path)
    try:
        path.write_bytes(content)
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}") from error
