"""What benchmarks share: options, real recordings, parallel runs, statistics, tables and verdicts.

Imported before numpy: each of several runs beside each other has one thread.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.stats import t as student

from body_tracking.core.skeleton import FloatArray

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BODY_TRACKING_DATA", ROOT.parent / "shared" / "data"))
"""The real recordings."""
ABSENT = 2
"""Exit code where real recordings are absent."""
NORMAL = 1.959964
"""Of a normal distribution 95 % lies within so many standard deviations."""

_Job, _Result = TypeVar("_Job"), TypeVar("_Result")

# --- options


def parser(
    doc: str | None, *, seeds: int = 0, motions: Sequence[str] = (), jobs: bool = False, data: bool = False
) -> argparse.ArgumentParser:
    """A command line with the usual options, those of the arguments that are given.

    Args:
        doc: the benchmark's own text.
        seeds: default of ``--seeds``.
        motions: default of ``--motions``.
        jobs: whether it runs on several processes.
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
    """``A,B`` of a command line."""
    return [name for name in text.split(",") if name]


def assignment(text: str) -> tuple[str, bool | float]:
    """``name=value`` of a command line, a number, ``true`` or ``false``."""
    name, _, value = text.partition("=")
    try:
        found = json.loads(value)
        return name, found if isinstance(found, bool) else float(found)
    except (ValueError, TypeError):
        raise argparse.ArgumentTypeError(f"{text!r}: expected name=number") from None


def add_set(found: argparse.ArgumentParser) -> None:
    """``--set`` of parameters of the filter."""
    found.add_argument(
        "--set",
        type=assignment,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="another value of a parameter of the filter (EkfParameters); may be repeated",
    )


def recordings(folder: Path, names: Iterable[str]) -> list[Path]:
    """The files of real recordings.

    Raises:
        SystemExit: one is absent; the code is ``ABSENT``.
    """
    files = [folder / name for name in names]
    if not files or not all(file.is_file() for file in files):
        print(f"the real recordings are absent ({folder})", file=sys.stderr)
        raise SystemExit(ABSENT)
    return files


# --- runs


def attempt(work: Callable[[_Job], _Result], job: _Job) -> tuple[_Result | None, str]:
    """The result of a job, or what went wrong: whatever a filter raises is a finding, not the end of a benchmark."""
    try:
        return work(job), ""
    except Exception:
        return None, traceback.format_exc()


def progress(text: str) -> None:
    """A line for whoever waits."""
    print(text, file=sys.stderr, flush=True)


def mapped(work: Callable[[_Job], _Result], jobs: Sequence[_Job], processes: int) -> list[_Result]:
    """The results of all jobs, in their order; shows how far it is."""
    began, results = time.monotonic(), []
    # processes that may have children: `replay` runs in two
    with ProcessPoolExecutor(max(1, min(processes, len(jobs))), multiprocessing.get_context("spawn")) as pool:
        for result in pool.map(work, jobs):
            results.append(result)
            left = (time.monotonic() - began) / len(results) * (len(jobs) - len(results))
            print(f"\r{len(results)} of {len(jobs)} runs, {left:.0f} s left ", end="", file=sys.stderr, flush=True)
    progress("")
    return results


# --- statistics


def rms(values: FloatArray) -> float:
    """Root of the mean square of what is finite; NaN of nothing."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt((finite**2).mean())) if finite.size else float("nan")


def rms_deg(radians: FloatArray) -> float:
    """The same of angles, in degrees."""
    return float(np.degrees(rms(radians)))


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """(...) radians between vectors (..., 3)."""
    angle: FloatArray = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))
    return angle


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean, half the width of its 95 % confidence interval (Student; NaN of one alone), and of how many it is."""

    value: float
    half: float
    count: int

    @classmethod
    def of(cls, values: Iterable[float]) -> Mean:
        """Over those that are finite."""
        finite = np.array([value for value in values if np.isfinite(value)])
        count = len(finite)
        half = float("nan")
        if count > 1:
            half = float(student.ppf(0.975, count - 1) * finite.std(ddof=1) / np.sqrt(count))
        return cls(float(finite.mean()) if count else float("nan"), half, count)


# --- what is printed


def report(args: argparse.Namespace, figures: Any, show: Callable[[], None]) -> None:
    """Print tables, or the figures as JSON, or write these to a file, as ``--out`` asks."""
    if not prints_json(args):
        show()
    if args.out is not None:
        text = json.dumps(figures, indent=2, default=_plain)
        print(text) if prints_json(args) else args.out.write_text(text + "\n", encoding="utf-8")


def prints_json(args: argparse.Namespace) -> bool:
    """Whether nothing but JSON is to be printed."""
    return str(args.out) == "-"


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"no JSON of {type(value)}")


def verdicts(args: argparse.Namespace, met: Mapping[str, bool]) -> int:
    """Print each bar, whether it is met; the exit code: 1 where one is missed."""
    for name, is_met in met.items():
        text = f"  {'met   ' if is_met else 'MISSED'}  {name}"
        print(text, file=sys.stderr if prints_json(args) else sys.stdout)
    return 0 if all(met.values()) else 1
