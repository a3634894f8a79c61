"""``body_tracking evaluate``: errors against the truth as tables, CSV, JSON and a page with pictures."""

from __future__ import annotations

import argparse
from pathlib import Path

from body_tracking.evaluation.comparison import EvaluationParameters, evaluate
from body_tracking.evaluation.pictures import pictures
from body_tracking.evaluation.reading import EvaluationError, Recorded, read_estimate, read_markers, read_truth
from body_tracking.evaluation.report import as_csv, as_json, facts, page, text, write
from body_tracking.recording.replay import Progress

_DEFAULTS = EvaluationParameters()


def truth_from(args: argparse.Namespace) -> tuple[Recorded, bool]:
    """The truth from a bag or a C3D file, and whether its clock and frame are its own.

    Raises:
        BagError: neither a C3D file nor a readable bag.
        EvaluationError: the bag has no truth, or an option for C3D files was given with a bag.
        MarkerError: the C3D file is unusable.
    """
    path: Path = args.truth or args.estimate
    if path.suffix.lower() == ".c3d":
        return read_markers(path, args.subject, args.measurements), True
    for name in ("subject", "measurements"):
        if getattr(args, name) is not None:
            raise EvaluationError(f"--{name}: of a C3D file; the truth is {path}")
    return read_truth(path, args.body), args.own_clock


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking evaluate``."""
    parser = subparsers.add_parser(
        "evaluate",
        description="Compare skeletons and joint angles in a recording with the truth: errors of position and angle "
        "as they are, and aligned in time and space as the thesis does (100 Hz, one shift, one rigid transform); "
        "delay, jitter, segment lengths, calibration, and whether the stated standard deviations hold.",
    )
    parser.add_argument("estimate", type=Path, metavar="EST", help="a bag as replay or bag_recorder writes it")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="TRUTH",
        help="a bag with /ground_truth/skeleton (default: EST itself), or a C3D file with Plug-in Gait's markers",
    )
    parser.add_argument("--topic", help="skeletons to judge (default: /filtered/skeleton, else /fused/skeleton)")
    parser.add_argument("--body", metavar="ID", help="whose angles (default: the first in the recording)")
    parser.add_argument(
        "--own-clock",
        action="store_true",
        help="clock and frame of TRUTH are its own, as those of a C3D file always are: find the shift by the movement, "
        "and compare aligned only",
    )
    parser.add_argument("--subject", metavar="NAME", help="whose markers, where a C3D file holds several people's")
    parser.add_argument(
        "--measurements", type=Path, metavar="FILE", help="the subject's, from Vicon (default: those in the C3D file)"
    )
    parser.add_argument(
        "--off-track",
        type=float,
        default=1e3 * _DEFAULTS.beyond,
        metavar="MM",
        help="a joint farther from the truth is off track (default: %(default).0f)",
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every number into this file")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page with tables and pictures")
    parser.add_argument("--json", action="store_true", help="print everything as JSON instead of tables")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if not 0.0 < args.off_track < float("inf"):
        raise EvaluationError(f"--off-track {args.off_track:g}: must be more than 0 mm, and finite")
    progress = Progress(0, 1000)
    try:
        estimate = read_estimate(args.estimate, args.topic, args.body)
        truth, own_clock = truth_from(args)
        parameters = EvaluationParameters(beyond=1e-3 * args.off_track, own_clock=own_clock)
        result = evaluate(estimate, truth, parameters, lambda share: progress.at(int(1000 * share)))
    finally:
        progress.end()
    if args.html is not None:
        write(args.html, page(result, pictures(result)).encode())
    if args.csv is not None:
        write(args.csv, as_csv(result).encode())
    print(as_json(result) if args.json else f"{facts(result)}\n{text(result)}")
    if not args.json:
        for name, path in (("numbers", args.csv), ("report", args.html)):
            if path is not None:
                print(f"\n{name}: {path}")
    return 0
