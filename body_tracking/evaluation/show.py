"""``body_tracking show``: the joint angles in a recording as a table, as a picture, and as numbers in a CSV file."""

from __future__ import annotations

import argparse
import csv
import io
import shutil
from pathlib import Path

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.metrics import angle_errors
from body_tracking.evaluation.pictures import ENOUGH, are_fine, draw
from body_tracking.evaluation.reading import AngleSeries, EvaluationError, read, true_at
from body_tracking.evaluation.report import Column, Table, make_folder, write


def summary(angles: AngleSeries, truth: AngleSeries | None = None) -> Table:
    """Table with a row per angle, degrees.

    Args:
        angles: estimated.
        truth: at any stamps within 20 ms of the estimated ones; None omits its columns.
    """
    known, true = angles.known, true_at(angles, truth)
    shares = np.isfinite(known).mean(axis=0)
    known = np.where(shares >= ENOUGH, known, np.nan)
    final = np.array([next(iter(column[np.isfinite(column)][::-1]), np.nan) for column in known.T])
    columns = [
        *_range("", known),
        Column("final", "final", "deg", np.degrees(final)),
        Column("stddev", "stddev", "deg", np.degrees(np.median(angles.stddev, axis=0))),
        Column("known", "finite", "%", 1e2 * shares),
    ]
    error = wrapped(known - true)
    if np.isfinite(error).any():
        errors = angle_errors(known, true)
        within = np.where(np.isfinite(error), np.abs(error) <= 2.0 * angles.stddev, np.nan)
        share = np.nansum(within, axis=0) / np.maximum(errors.frames, 1)
        scarce = errors.frames < ENOUGH * len(known)
        columns += [
            *_range("true ", np.where(np.isfinite(error), true, np.nan)),
            Column("rms_error", "rms err", "deg", np.where(scarce, np.nan, np.degrees(errors.rmse))),
            Column("max_error", "max err", "deg", np.where(scarce, np.nan, np.degrees(errors.largest))),
            Column("within_2_stddev", "in 2 sd", "%", np.where(scarce, np.nan, 1e2 * share)),
        ]
    if are_fine(angles):
        columns = [each._replace(digits=3) if each.unit == "deg" else each for each in columns]
    columns = [each._replace(digits=0) if each.unit == "%" else each for each in columns]
    note = "final: the last known angle\nstddev: median" + (
        "; inf if unknown in most frames" if np.isinf(columns[3].values).any() else ""
    )
    note += "\nfinite: frames with an angle, however large its stddev\n-: known in less than 2 % of the frames"
    if np.isfinite(error).any():
        note += "\nfrom true min on: over the frames with a truth\nin 2 sd: errors within two stddev; 95 % is ideal"
    return Table("angles", "angle", angles.names, tuple(columns), note)


def _range(whose: str, values: FloatArray) -> tuple[Column, Column]:
    """Minimum and maximum of (n, m) angles in degrees, ignoring NaN."""
    known = np.isfinite(values)
    least, most = np.where(known, values, np.inf).min(axis=0), np.where(known, values, -np.inf).max(axis=0)
    least, most = (np.degrees(np.where(known.any(axis=0), each, np.nan)) for each in (least, most))
    key = whose.replace(" ", "_")
    return Column(f"{key}min", f"{whose}min", "deg", least), Column(f"{key}max", f"{whose}max", "deg", most)


def summarise(bag: Path, png: Path | None = None, body: str | None = None, truth: Path | None = None) -> Table:
    """Table of all joint angles in a bag; with ``png``, also draws a picture.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: it holds no joint angles, or the picture cannot be written.
    """
    tracked = read(bag, body, truth)
    if png is not None:
        make_folder(png)
        draw(tracked, png)
    return summary(tracked.angles, tracked.true_angles)


def write_csv(angles: AngleSeries, file: Path) -> None:
    """Write the angles with a row per frame: capture time, then each angle and its standard deviation in degrees.

    The time is ROS time in seconds, to the nanosecond. Where an angle is unknown both cells are empty.

    Raises:
        EvaluationError: the file cannot be written.
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["time", *(f"{name}{what}" for name in angles.names for what in ("", "_stddev"))])
    known = np.isfinite(angles.known)
    both = np.degrees(np.stack([angles.known, angles.stddev], axis=-1))
    for stamp_ns, row, there in zip(angles.stamps_ns.tolist(), both, known, strict=True):
        cells = ((f"{a:.3f}", f"{b:.3f}") if seen else ("", "") for (a, b), seen in zip(row, there, strict=True))
        rows.writerow([f"{stamp_ns // NANOSECONDS}.{stamp_ns % NANOSECONDS:09d}", *(c for pair in cells for c in pair)])
    write(file, text.getvalue().encode())


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking show``."""
    parser = subparsers.add_parser(
        "show",
        description="Print a table of the joint angles in a recording with their standard deviations, and draw them. "
        "Where the recording holds the truth, errors are shown too.",
    )
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="a bag folder with joint angles, such as the output of replay"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="PNG", help="draw a picture into this file")
    parser.add_argument(
        "--csv", type=Path, metavar="FILE", help="write each frame's angles and standard deviations, in degrees"
    )
    parser.add_argument("--body", metavar="ID", help="id of the person (default: the first in the recording)")
    parser.add_argument("--truth", type=Path, metavar="BAG", help="the bag with the truth (default: the same)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.output is not None and args.output.suffix.lower() != ".png":
        raise EvaluationError(f"{args.output}: expected a name that ends in .png")
    tracked = read(args.bag, args.body, args.truth)
    table = summary(tracked.angles, tracked.true_angles)
    width = shutil.get_terminal_size((120, 24)).columns
    print(f"{table.text(width)}\n\n{table.note}\n", flush=True)  # drawing takes seconds
    if args.truth is not None and not any(each.key == "rms_error" for each in table.columns):
        print(f"no errors: {args.truth} holds no truth of these angles at these times")
    if args.csv is not None:
        write_csv(tracked.angles, args.csv)
        print(f"angles: {args.csv}")
    if args.output is not None:
        make_folder(args.output)
        draw(tracked, args.output)
        print(f"picture: {args.output}")
    return 0
