"""``body_tracking show``: the joint angles in a recording as a table, and as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path

from body_tracking.evaluation.pictures import draw
from body_tracking.evaluation.summary import AngleSummary, read, summaries, table


def summarise(
    bag_path: Path, png_path: Path | None = None, body: str | None = None, truth: Path | None = None
) -> tuple[AngleSummary, ...]:
    """A summary of every joint angle in a bag; the picture too where a path for it is given.

    Raises:
        BagError: no such bag, or nothing of it can be read.
        EvaluationError: it holds no joint angles, or the picture cannot be written.
    """
    tracked = read(bag_path, body, truth)
    if png_path is not None:
        draw(tracked, png_path)
    return summaries(tracked.angles, tracked.true_angles)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking show``."""
    parser = subparsers.add_parser(
        "show",
        description="Print a table of the joint angles in a recording with their standard deviations, and draw them. "
        "Where the recording holds the truth, errors are shown beside.",
    )
    parser.add_argument("bag", type=Path, help="a bag folder with joint angles, such as the output of replay")
    parser.add_argument("-o", "--output", type=Path, metavar="PNG", help="draw a picture into this file")
    parser.add_argument("--body", metavar="ID", help="of which person (default: the first in the recording)")
    parser.add_argument("--truth", type=Path, metavar="BAG", help="the bag that holds the truth (default: the same)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print, and draw."""
    print(table(summarise(args.bag, args.output, args.body, args.truth)))
    if args.output is not None:
        print(f"\npicture: {args.output}")
    return 0
