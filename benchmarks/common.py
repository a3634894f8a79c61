"""Shared by the benchmarks: options, real recordings, parallel runs, statistics, tables and verdicts.

Import it before numpy: it limits numpy to one thread per process, as several runs work in parallel.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import json
import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.stats import t as student

from body_tracking.core.skeleton import FloatArray

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BODY_TRACKING_DATA", ROOT.parent / "shared" / "data"))
"""Folder of the real recordings."""
ABSENT = 2
"""Exit code where real recordings are absent."""
NORMAL = 1.959964
"""A normal distribution has 95 % of its mass within this number of standard deviations."""

_Job, _Result = TypeVar("_Job"), TypeVar("_Result")

# --- options


def parser(
    doc: str | None, *, seeds: int = 0, motions: Sequence[str] = (), jobs: bool = False, data: bool = False
) -> argparse.ArgumentParser:
    """A command line with the shared options that the arguments select.

    Args:
        doc: docstring of the benchmark, for its help.
        seeds: default of ``--seeds``; 0 for no such option.
        motions: default of ``--motions``; empty for no such option.
        jobs: whether the benchmark runs in several processes.
        data: whether it reads real recordings.
    """
    found = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if seeds:
        found.add_argument(
            "--seeds", type=int, default=seeds, metavar="N", help="people per case (default: %(default)s)"
        )
    if motions:
        found.add_argument(
            "--motions", type=names, default=list(motions), metavar="A,B", help=f"default: {','.join(motions)}"
        )
    if jobs:
        cores = os.cpu_count() or 1
        found.add_argument("--jobs", "--workers", type=int, default=cores, metavar="N", help="processes (default: all)")
    if data:
        found.add_argument(
            "--data", type=Path, default=DATA, metavar="FOLDER", help="real recordings (default: %(default)s)"
        )
    found.add_argument(
        "--out",
        "--json",
        type=Path,
        nargs="?",
        const=Path("-"),
        metavar="FILE",
        help="write all figures there as JSON; without FILE, print them instead of tables",
    )
    return found


def names(text: str) -> list[str]:
    """Parse ``A,B`` of a command line."""
    return [name for name in text.split(",") if name]


def assignment(text: str) -> tuple[str, bool | float]:
    """Parse ``name=value`` of a command line; the value is a number, ``true`` or ``false``."""
    name, _, value = text.partition("=")
    try:
        found = json.loads(value)
        return name, found if isinstance(found, bool) else float(found)
    except (ValueError, TypeError):
        raise argparse.ArgumentTypeError(f"{text!r}: expected name=number") from None


def add_set(found: argparse.ArgumentParser) -> None:
    """Add ``--set`` for parameters of the filter."""
    found.add_argument(
        "--set",
        type=assignment,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="another value of a parameter of the filter (EkfParameters); may be repeated",
    )


def recordings(folder: Path, names: Iterable[str]) -> list[Path]:
    """Paths of real recordings.

    Raises:
        SystemExit: a file is missing; the exit code is ``ABSENT``.
    """
    files = [folder / name for name in names]
    if not files or not all(file.is_file() for file in files):
        print(f"the real recordings are absent ({folder})", file=sys.stderr)
        raise SystemExit(ABSENT)
    return files


# --- runs


def attempt(work: Callable[[_Job], _Result], job: _Job) -> tuple[_Result | None, str]:
    """The result of a job, or its traceback: an exception in a filter is a finding and must not end the benchmark."""
    try:
        return work(job), ""
    except Exception:
        return None, traceback.format_exc()


def progress(text: str) -> None:
    """Print a line about the progress to stderr."""
    print(text, file=sys.stderr, flush=True)


def mapped(work: Callable[[_Job], _Result], jobs: Sequence[_Job], processes: int) -> list[_Result]:
    """The results of all jobs, in their order; prints the progress."""
    began, results = time.monotonic(), []
    # no daemonic processes: `replay` starts a child process
    with ProcessPoolExecutor(max(1, min(processes, len(jobs))), multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(work, jobs):
            results.append(result)
            left = (time.monotonic() - began) / len(results) * (len(jobs) - len(results))
            print(f"\r{len(results)} of {len(jobs)} runs, {left:.0f} s left ", end="", file=sys.stderr, flush=True)
    progress("")
    return results


# --- statistics


def rms(values: FloatArray) -> float:
    """Root mean square of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt((finite**2).mean())) if finite.size else float("nan")


def rms_deg(radians: FloatArray) -> float:
    """RMS of angles in radians, as degrees."""
    return float(np.degrees(rms(radians)))


def bone_correlation(errors: FloatArray, joints: Sequence[int]) -> float:
    """Correlation of the errors at the two ends of a bone, over its axes, as ``joint_angles`` assumes it.

    Args:
        errors: (n, k, 3); NaN where a joint is not tracked.
        joints: indices into ``errors`` of shoulder, elbow and wrist, one arm after the other.
    """
    pairs = [(a, b) for arm in zip(*[iter(joints)] * 3, strict=True) for a, b in itertools.pairwise(arm)]
    one, other = (np.concatenate([errors[:, pair[end]].ravel() for pair in pairs]) for end in (0, 1))
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known], other[known]
    return float((one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum()))


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(...) angles between vectors (..., 3), radians."""
    angle: FloatArray = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))
    return angle


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean, half the width of its 95 % confidence interval (Student; NaN for one value), and the number of values."""

    value: float
    half: float
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Mean:
        """Mean over the finite values."""
        finite = np.array([value for value in values if np.isfinite(value)])
        count = len(finite)
        half = float("nan")
        if count > 1:
            half = float(student.ppf(0.975, count - 1) * finite.std(ddof=1) / np.sqrt(count))
        return cls(float(finite.mean()) if count else float("nan"), half, count)


# --- what is printed


def report(
    args: argparse.Namespace, figures: Any, show: Callable[[], None] | None = None, unshown: Sequence[str] = ()
) -> None:
    """Print figures as tables (or by ``show``), but for those ``unshown``, or as JSON, or write them to ``--out``."""
    text = json.dumps(figures, indent=2, default=_plain)
    if prints_json(args):
        print(text)
        return
    if show is not None:
        show()
    else:
        shown = json.loads(text)
        for name in unshown:
            del shown[name]
        print("\n".join(tables(shown)))
    if args.out is not None:
        args.out.write_text(text + "\n", encoding="utf-8")


def tables(figures: Any, title: str = "") -> Iterator[str]:
    """Lines of tables of figures (from JSON): mappings of values as rows, deeper levels below titles."""
    if isinstance(figures, list):
        figures = {str(number): each for number, each in enumerate(figures, 1)}
    figures = {name: each for name, each in figures.items() if each != {}}
    deep = {name: each for name, each in figures.items() if not _is_value(each)}
    if values := {name: each for name, each in figures.items() if name not in deep}:
        yield f"{title}{': ' * bool(title)}{', '.join(f'{name} {_cell(each)}' for name, each in values.items())}"
    flat = {name: each for name, each in deep.items() if isinstance(each, dict) and all(map(_is_value, each.values()))}
    groups: list[dict[str, dict[str, Any]]] = []
    for name, row in flat.items():
        if not groups or not any(row.keys() & other.keys() for other in groups[-1].values()):
            groups.append({})
        groups[-1][name] = row
    for group in groups:
        yield from _table(title, group)
    for name, each in deep.items():
        if name not in flat:
            yield from tables(each, f"{title}{', ' * bool(title)}{name}")


def _table(title: str, rows: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """An empty line, title and column names, and the rows; numbers aligned right, texts left."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    cells = [
        [title, *columns],
        *([name, *(_cell(row.get(column)) for column in columns)] for name, row in rows.items()),
    ]
    texts = [any(type(row.get(column)) is str for row in rows.values()) for column in columns]
    sides = ["<" if is_text else ">" for is_text in (True, *texts)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    yield ""
    for line in cells:
        yield "  ".join(f"{c:{side}{width}}" for c, side, width in zip(line, sides, widths, strict=True)).rstrip()


def _is_value(each: Any) -> bool:
    """Whether this is a number, a text, a mean, or a list of numbers and texts."""
    if isinstance(each, dict):
        return each.keys() == {"value", "half", "count"}
    return not isinstance(each, list) or not any(isinstance(item, dict | list) for item in each)


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return f"{_cell(value['value'])} ± {_cell(value['half'])}"
    if isinstance(value, list):
        return " ".join(map(_cell, value))
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.4g}"
    return "-" if value is None else str(value)


def write_section(page: Path, name: str, by: str, lines: Iterable[str]) -> None:
    """Replace the section of a page in docs that this benchmark writes, between its two comments.

    Args:
        page: the file.
        name: of the section.
        by: file name of the benchmark.
        lines: without the empty ones around them.
    """
    begin, end = f"<!-- {name}: written by benchmarks/{by} -->\n", f"<!-- end of {name} -->\n"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    assert found and end in rest, f"{page} has no section {name}"
    text = "\n".join(lines)
    page.write_text(f"{before}{begin}\n{text}\n\n{end}{rest.partition(end)[2]}", encoding="utf-8")


def prints_json(args: argparse.Namespace) -> bool:
    """Whether only JSON is printed."""
    return str(args.out) == "-"


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"no JSON of {type(value)}")


def verdicts(args: argparse.Namespace, met: Mapping[str, bool]) -> int:
    """Print for each bar whether it is met; returns the exit code, 1 if one is missed."""
    for name, is_met in met.items():
        text = f"  {'met   ' if is_met else 'MISSED'}  {name}"
        print(text, file=sys.stderr if prints_json(args) else sys.stdout)
    return 0 if all(met.values()) else 1
