"""``body_tracking compare``: pairwise comparison of all systems that recorded a person."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core import files
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.evaluation.estimated_segments import EstimatedSegments, read_segments, read_true_segments
from body_tracking.evaluation.hand_eye import MAX_GAP
from body_tracking.evaluation.marker_reference import MarkerReference, has_targets, read_marker_reference
from body_tracking.evaluation.mutual_comparison import USABLE, compare_estimates
from body_tracking.evaluation.reading import EvaluationError, check_same_recording
from body_tracking.evaluation.reference_comparison import evaluate_by_markers
from body_tracking.evaluation.reference_error import Judged
from body_tracking.evaluation.report import Column, Report, Table
from body_tracking.pipeline import graph
from body_tracking.recording import replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, check_new_bag

TRUTH: Final = "truth"
Side = EstimatedSegments | MarkerReference


@dataclass(frozen=True, slots=True)
class Pair:
    """The differences between two systems; radians.

    Attributes:
        angles: by name, of angles known to both.
        measured: RMS difference of all these angles.
        covered: share of the differences within 1.96 standard deviations, combined from both.
    """

    angles: Mapping[str, Judged]
    measured: float
    covered: float


def read_side(path: Path) -> Side:
    """A recording of one system: segments and angles computed by the graph, or poses of infrared targets.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: it holds neither.
    """
    with RigReader(path) as bag:
        estimated = any(topic in bag.topics for topic in (graph.MODEL_STATE, graph.FILTERED, graph.FUSED))
        targets = has_targets(bag)
    return read_marker_reference(path) if targets and not estimated else read_segments(path)


def compare_pair(one: Side, other: Side) -> Pair:
    """Compare two systems.

    Raises:
        EvaluationError: two recordings of the marker system, too little overlap, or no angle known to both.
    """
    if isinstance(one, MarkerReference):
        one, other = other, one
    if isinstance(one, MarkerReference):
        raise EvaluationError(f"{one.source} and {other.source}: both are of the marker system")
    if isinstance(other, MarkerReference):
        judged = evaluate_by_markers(one, other, one_clock=True)
        rows = judged.angles
        count = np.array([row.samples for row in rows], dtype=np.float64)
        if not count.sum():
            raise EvaluationError(f"{one.source} and {other.source}: the targets determine no angle that both know")
        measured = float(np.sqrt(count @ np.square([row.measured for row in rows]) / count.sum()))
        covered = float(count @ np.array([row.covered for row in rows]) / count.sum())
    else:
        found = compare_estimates(one, other)
        rows, measured, covered = found.angles, found.measured, found.covered
    return Pair({row.name: row for row in rows}, measured, covered)


def known_shares(side: Side, seconds: float) -> dict[str, float]:
    """By angle, the share of the duration with a stated deviation below :data:`USABLE`; empty for targets."""
    if isinstance(side, MarkerReference):
        return {}
    angles = side.angles
    # each frame counts until the next one, at most MAX_GAP, because a system without the person has long gaps
    steps = np.minimum(np.diff(angles.stamps_ns) / NANOSECONDS, MAX_GAP)
    shares = np.minimum(steps @ (angles.stddev[:-1] < USABLE) / seconds, 1.0)
    return dict(zip(angles.names, shares.tolist(), strict=True))


def report_of(sides: Mapping[str, Side]) -> Report:
    """The tables of all pairs, and of every angle against the truth if there is a side of that name.

    Args:
        sides: two or more, by name.

    Raises:
        EvaluationError: no two of them can be compared.
    """
    pairs: dict[tuple[str, str], Pair] = {}
    facts: list[tuple[str, str]] = []
    for one, other in combinations(sides, 2):
        try:
            check_same_recording(sides[one].source, sides[other].source)
            pairs[one, other] = pairs[other, one] = compare_pair(sides[one], sides[other])
        except EvaluationError as error:
            facts.append(("note", f"{one} and {other} are not compared: {error}"))
    if not pairs:
        raise EvaluationError("; ".join(text for _, text in facts))
    names = tuple(sides)
    seconds = max(_seconds(side) for side in sides.values())
    about = _PAIRS + (_TARGETS if any(isinstance(side, MarkerReference) for side in sides.values()) else "")
    facts = [*((name, f"{side.source}, {_seconds(side):.1f} s") for name, side in sides.items()), *facts]
    tables = [
        Table("differences", "RMS difference", names, _matrix(names, pairs, "measured", "deg", np.degrees(1.0)), about),
        Table("covered", "in 95%", names, _matrix(names, pairs, "covered", "%", 100.0), _COVERED),
    ]
    order = [name for side in sides.values() if isinstance(side, EstimatedSegments) for name in side.angles.names]
    angles = tuple(dict.fromkeys(order))
    systems = [name for name in names if name != TRUTH]
    if TRUTH in sides:
        tables.append(Table("errors", "error of each angle", angles, _errors(angles, systems, pairs), _ERRORS))
    known = {name: known_shares(sides[name], seconds) for name in systems}
    columns = tuple(
        Column(name, name, "%", 100.0 * np.array([share.get(angle, np.nan) for angle in angles]), digits=0)
        for name, share in known.items()
        if share
    )
    tables.append(Table("known", "known", angles, columns, _KNOWN))
    content = {"sides": {name: str(side.source) for name, side in sides.items()}, "seconds": round(seconds, 3)}
    return Report("systems against each other", tuple(facts), content, tuple(tables))


_PAIRS = "of all angles that both know."
_TARGETS = (
    " The mountings of infrared targets are fitted to the other half of the recording; "
    "constant\ndifferences do not show in their rows and columns."
)
_COVERED = "share of the differences within 1.96 of the deviation that both state together; 95 where these are true."
_ERRORS = "RMS difference to the truth where the system states the angle; - where it never does."
_KNOWN = f"share of the recording in which the stated deviation is below {np.degrees(USABLE):.0f} degrees."


def _seconds(side: Side) -> float:
    if isinstance(side, MarkerReference):
        return max(float(track.times[-1]) for track in side.tracks.values())
    return float(side.seconds[-1])


def _matrix(
    names: tuple[str, ...], pairs: Mapping[tuple[str, str], Pair], part: str, unit: str, scale: float
) -> tuple[Column, ...]:
    return tuple(
        Column(
            other,
            other,
            unit,
            np.array(
                [
                    scale * float(getattr(pairs[name, other], part)) if (name, other) in pairs else np.nan
                    for name in names
                ]
            ),
        )
        for other in names
    )


def _errors(angles: tuple[str, ...], systems: list[str], pairs: Mapping[tuple[str, str], Pair]) -> tuple[Column, ...]:
    def errors(name: str) -> FloatArray:
        found = pairs[name, TRUTH].angles if (name, TRUTH) in pairs else {}
        return np.degrees([found[angle].measured if angle in found else np.nan for angle in angles])

    return tuple(Column(name, name, "deg", errors(name)) for name in systems)


# --- the command


def read_systems(path: Path) -> dict[str, list[str]]:
    """The arguments of ``replay`` for each system, from a YAML mapping of names to lists.

    Raises:
        EvaluationError: it is unreadable or of another format.
    """
    content = files.read_yaml(path, error=EvaluationError)
    if not isinstance(content, dict) or not content:
        raise EvaluationError(f"{path}: expected a mapping of the systems' names to arguments of replay")
    for name, arguments in content.items():
        if not isinstance(arguments, list) or not str(name).isidentifier() or name == TRUTH:
            raise EvaluationError(f"{path}: {name}: expected a name and a list of arguments of replay")
    return {str(name): [str(each) for each in arguments] for name, arguments in content.items()}


def replay_systems(bag: Path, systems: Mapping[str, list[str]], output: Path, *, overwrite: bool) -> list[Path]:
    """Replay a recording once with each system, each into a folder of its name.

    Raises:
        EvaluationError: arguments that replay does not accept, or what they name is missing.
        BodyTrackingError: as replay.
    """
    parser = argparse.ArgumentParser(exit_on_error=False)
    replay.add_parser(parser.add_subparsers())
    options = ["--overwrite"] if overwrite else []
    parsed = {}
    for name, arguments in systems.items():  # check all before the first replay, which takes long
        try:
            given = ["replay", str(bag), "-o", str(output / name), *options, *arguments]
            parsed[name], unknown = parser.parse_known_args(given)
        except argparse.ArgumentError as error:
            raise EvaluationError(f"{name}: {error}") from error
        if unknown:
            raise EvaluationError(f"{name}: replay does not take {' '.join(unknown)}")
    with BagReader(bag) as reader:
        for name, args in parsed.items():
            check_new_bag(args.output, overwrite=overwrite)
            try:
                replay.inputs(replay.settings_from(args), reader)
            except BodyTrackingError as error:
                raise EvaluationError(f"{name}: {error}") from error
    for name, args in parsed.items():
        print(f"{name}: replay {' '.join(systems[name])}", file=sys.stderr)
        with contextlib.redirect_stdout(sys.stderr):
            args.run(args)
    return [output / name for name in systems]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking compare``."""
    parser = subparsers.add_parser(
        "compare",
        description="Compare every system that recorded a person with every other one, and with the truth where a "
        "recording holds it: RMS differences of the joint angles, whether the stated deviations account for them, and "
        "which angles each system knows. RECORDINGs are those of the single systems, as replay and bag_recorder write "
        "them; or, with --systems, one recording of all sensors, which is replayed once with each system.",
    )
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="a bag")
    parser.add_argument(
        "--systems",
        type=Path,
        metavar="FILE",
        help="a YAML file with the arguments of replay for each system, such as config/five_systems.yaml",
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="with --systems: where the replays go, a bag each"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="BAG", help="a simulated bag (default: the RECORDING, with --systems)"
    )
    parser.add_argument("--overwrite", action="store_true", help="with --systems: replace existing replays")
    parser.add_argument("--json", action="store_true", help="print all results as JSON instead of tables")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    recordings: list[Path] = args.recordings
    truth: Path | None = args.truth
    if args.systems is not None:
        if len(recordings) != 1 or args.output is None:
            raise EvaluationError("--systems: expected one RECORDING and -o FOLDER")
        truth = truth or recordings[0]
        recordings = replay_systems(recordings[0], read_systems(args.systems), args.output, overwrite=args.overwrite)
    names = [path.resolve().name for path in recordings]
    if len(recordings) < 2 or len(set(names)) < len(names) or TRUTH in names:
        raise EvaluationError(
            f"{', '.join(map(str, recordings))}: expected two or more recordings with different names"
        )
    sides: dict[str, Side] = {name: read_side(path) for name, path in zip(names, recordings, strict=True)}
    true = None if truth is None else read_true_segments(truth)
    if true is not None:
        sides[TRUTH] = true
    report = report_of(sides)
    print(report.json() if args.json else f"{report.lines()}\n{report.text()}")
    return 0
