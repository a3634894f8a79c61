"""``body_tracking evaluate``: errors against the truth as a summary, tables, JSON and a page with pictures."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from body_tracking.core.files import check_new
from body_tracking.evaluation import reference_report
from body_tracking.evaluation.comparison import Evaluation, evaluate
from body_tracking.evaluation.estimated_segments import read_segments
from body_tracking.evaluation.marker_reference import (
    is_marker_reference,
    load_mountings,
    read_marker_reference,
    save_mountings,
)
from body_tracking.evaluation.mutual_comparison import compare_estimates
from body_tracking.evaluation.pictures import pictures, reference_pictures
from body_tracking.evaluation.reading import (
    EvaluationError,
    Recorded,
    check_same_recording,
    read_estimate,
    read_markers,
    read_truth,
)
from body_tracking.evaluation.reference_comparison import ReferenceEvaluation, evaluate_by_markers
from body_tracking.evaluation.report import make_folder, report_of, write
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rig import RigReader


def truth_from(args: argparse.Namespace) -> tuple[Recorded, bool]:
    """The truth from a bag or a C3D file, and whether it has its own clock and frame.

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
        epilog="`body_tracking evaluate baseline` is another command: a camera's test by a robot arm or a pendulum.",
    )
    parser.add_argument("estimate", type=Path, metavar="EST", help="a bag as replay or bag_recorder writes it")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="TRUTH",
        help="a bag with /ground_truth/skeleton (default: EST itself), a C3D file with Plug-in Gait's markers, a "
        "recording of the marker system, with poses of targets, or another estimate of the same person",
    )
    parser.add_argument("--topic", help="the skeletons to compare (default: /filtered/skeleton, else /fused/skeleton)")
    parser.add_argument(
        "--body", metavar="ID", help="id of the person whose angles are compared (default: the first in the recording)"
    )
    parser.add_argument(
        "--own-clock",
        action="store_true",
        help="TRUTH has another clock and frame, as a C3D file always has: find the time shift by the motion, and "
        "compare after alignment only",
    )
    parser.add_argument("--subject", metavar="NAME", help="the subject, if a C3D file has the markers of several")
    parser.add_argument(
        "--measurements",
        type=Path,
        metavar="FILE",
        help="body measurements of the subject, from Vicon (default: those in the C3D file)",
    )
    parser.add_argument(
        "--mounted",
        action="append",
        default=[],
        metavar="TARGET=SEGMENT",
        help="for a recording of the marker system: the segment that carries a target; may be repeated (default: the "
        "segment of the target's name)",
    )
    parser.add_argument(
        "--mountings",
        type=Path,
        metavar="FILE",
        help="likewise: mountings of the targets, written by --save-mountings; without them constant offsets of EST "
        "do not show",
    )
    parser.add_argument(
        "--save-mountings", type=Path, metavar="FILE", help="likewise: write the mountings of the targets that fit EST"
    )
    parser.add_argument("--overwrite", action="store_true", help="with --save-mountings: replace an existing FILE")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page with tables and pictures")
    parser.add_argument("--json", action="store_true", help="print all results as JSON")
    parser.add_argument("-v", "--verbose", action="store_true", help="also print tables with all joints and angles")
    parser.set_defaults(run=run)


def _by_markers(args: argparse.Namespace) -> bool:
    """Whether the truth is a recording of the marker system.

    Raises:
        BagError: the truth is not a readable bag.
        EvaluationError: an option for marker recordings was given with another kind of truth.
    """
    found = False
    if args.truth is not None and args.truth.suffix.lower() != ".c3d":
        with RigReader(args.truth) as bag:
            found = is_marker_reference(bag)
    if not found:
        for name in ("mounted", "mountings", "save_mountings"):
            if getattr(args, name):
                option = name.replace("_", "-")
                raise EvaluationError(
                    f"--{option}: of a recording of the marker system; the truth is {args.truth or args.estimate}"
                )
    return found


def _by_estimate(args: argparse.Namespace) -> bool:
    """Whether the truth is a bag with estimates and without ground truth."""
    if args.truth is None or args.truth.suffix.lower() == ".c3d":
        return False
    with RigReader(args.truth) as bag:
        estimated = any(topic in bag.topics for topic in (graph.MODEL_STATE, graph.FILTERED, graph.FUSED))
        return estimated and graph.TRUE_SKELETON not in bag.topics


def _judge_by_markers(args: argparse.Namespace) -> ReferenceEvaluation:
    for name in ("subject", "measurements"):
        if getattr(args, name) is not None:
            raise EvaluationError(f"--{name}: of a C3D file; the truth is {args.truth}")
    reference = read_marker_reference(args.truth, args.mounted)
    known = None if args.mountings is None else load_mountings(args.mountings, reference.segments)
    result = evaluate_by_markers(read_segments(args.estimate, args.topic, args.body), reference, known)
    if args.save_mountings is not None:
        save_mountings(args.save_mountings, result.mountings, reference.segments)
    return result


def run(args: argparse.Namespace) -> int:
    if args.save_mountings is not None:
        check_new(args.save_mountings, overwrite=args.overwrite)
    if _by_markers(args):
        judged = _judge_by_markers(args)
        report = reference_report.report_of(judged)
        draw: Callable[[], list[tuple[str, str]]] = partial(reference_pictures, judged.curves)
    elif _by_estimate(args):
        if not args.own_clock:
            check_same_recording(args.estimate, args.truth)
        mutual = compare_estimates(read_segments(args.estimate, args.topic, args.body), read_segments(args.truth))
        report, draw = reference_report.mutual_report_of(mutual), list
    else:
        result = _compare(args)
        report, draw = report_of(result), partial(pictures, result)
    if args.html is not None:
        make_folder(args.html)
        write(args.html, report.page(draw()).encode())
    if args.json:
        print(report.json())
    else:
        print(report.lines())
        print(report.text() if args.verbose else "-v prints tables with all joints and angles")
        for name, path in (("report", args.html), ("mountings", args.save_mountings)):
            if path is not None:
                print(f"{name}: {path}")
    return 0


def _compare(args: argparse.Namespace) -> Evaluation:
    progress = Progress(0, 1000)
    try:
        estimate = read_estimate(args.estimate, args.topic, args.body)
        truth, own_clock = truth_from(args)
        if args.truth is not None and not own_clock:
            check_same_recording(args.estimate, args.truth)
        return evaluate(estimate, truth, own_clock, lambda share: progress.at(int(1000 * share)))
    finally:
        progress.end()
