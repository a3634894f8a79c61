"""``body_tracking bag info`` and ``bag recover``: the content of a bag, and closing a truncated one."""

from __future__ import annotations

import argparse
import json
import sys
from array import array
from collections import defaultdict
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.arguments import Parser
from body_tracking.core.qos import Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.recording.rosbag2 import BagError, BagReader, TopicInfo, recover

_OWN_CLOCK_S = 1e9
"""An earlier start, before 2001, is that of a clock that began at some time of its own, and no date; seconds."""


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """A topic of a bag: its readable messages, and its publishers' QoS.

    Attributes:
        rate: mean, in hertz, between the first and the last message; None with fewer than two.
        longest_gap: between two messages, seconds; None with fewer than two.
    """

    name: str
    type: str
    count: int
    rate: float | None
    qos: tuple[Qos, ...]
    longest_gap: float | None


@dataclass(frozen=True, slots=True)
class BagInfo:
    """Content of a bag.

    Attributes:
        path: of the bag.
        files: mcap files with their sizes in bytes.
        start_ns: earliest log time.
        duration_s: seconds from the first to the last message.
        messages: number of readable messages.
        topics: by name.
        warnings: missing or damaged parts.
    """

    path: Path
    files: dict[str, int]
    start_ns: int
    duration_s: float
    messages: int
    topics: tuple[TopicSummary, ...]
    warnings: list[str]


def bag_info(path: Path | str) -> BagInfo:
    """Read a whole bag, a folder or a single mcap file, and count its readable messages.

    Raises:
        BagError: no readable recording.
    """
    with BagReader(path) as reader:
        found: defaultdict[str, array[int]] = defaultdict(lambda: array("Q"))
        for message in reader.messages():
            found[message.topic].append(message.log_time_ns)
        start_ns = min((times[0] for times in found.values()), default=0)
        return BagInfo(
            path=Path(path),
            files={file.path.name: file.path.stat().st_size for file in reader.files},
            start_ns=start_ns,
            duration_s=(max((times[-1] for times in found.values()), default=0) - start_ns) / NANOSECONDS,
            messages=sum(map(len, found.values())),
            topics=tuple(_summary(name, topic, np.array(found.get(name, ()))) for name, topic in reader.topics.items()),
            warnings=reader.warnings,
        )


def _summary(name: str, topic: TopicInfo, times_ns: NDArray[np.uint64]) -> TopicSummary:
    rate = gap = None
    if len(times_ns) and times_ns[-1] > times_ns[0]:
        rate = (len(times_ns) - 1) * NANOSECONDS / int(times_ns[-1] - times_ns[0])
        gap = int(np.diff(times_ns).max()) / NANOSECONDS
    return TopicSummary(name, topic.type_name, len(times_ns), rate, topic.offered, gap)


def _qos_text(offers: tuple[Qos, ...]) -> str:
    """``best_effort 5``, ``reliable transient_local 10``; the durability is omitted if volatile."""
    texts = []
    for qos in offers:
        durability = "" if qos.durability == "volatile" else f" {qos.durability}"
        depth = "" if qos.history == "unknown" else f" {qos.depth}"
        texts.append(qos.reliability + durability + depth)
    return ", ".join(dict.fromkeys(texts)) or "-"


def _print(info: BagInfo) -> None:
    size = sum(info.files.values())
    start_s = round(info.start_ns / NANOSECONDS, 3)
    date = f" ({datetime.fromtimestamp(start_s, UTC):%Y-%m-%d %H:%M:%S} UTC)" if start_s > _OWN_CLOCK_S else ""
    print(f"bag       {info.path}")
    print(f"files     {', '.join(info.files)} ({size / 1e6:.2f} MB)")
    print(f"start     {start_s:.3f} s{date}")
    print(f"duration  {info.duration_s:.3f} s")
    print(f"messages  {info.messages}")
    rows = [("topic", "type", "count", "rate", "qos")]
    for topic in info.topics:
        rate = "-" if topic.rate is None else f"{topic.rate:.1f} Hz"
        rows.append((topic.name, topic.type, str(topic.count), rate, _qos_text(topic.qos)))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    print()
    for name, kind, count, rate, qos in rows:
        print(f"{name:<{widths[0]}}  {kind:<{widths[1]}}  {count:>{widths[2]}}  {rate:>{widths[3]}}  {qos}")
    for warning in info.warnings:
        print(f"warning: {warning}", file=sys.stderr)


# --- command line


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bag info`` and ``bag recover`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser("bag")
    if isinstance(parser, Parser):
        parser.about_bag = "'bag info BAG' lists what a recording holds"
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    text = "list the contents of a bag, and what is missing"
    info = verbs.add_parser("info", help=text, description=text)
    info.add_argument("bag", type=Path, metavar="BAG", help="a folder, or a single mcap file")
    info.add_argument("--json", action="store_true", help="print the result as JSON")
    info.set_defaults(run=run)
    text = "close a bag whose recorder died, so that ros2 bag opens it too"
    closing = verbs.add_parser("recover", help=text, description=text)
    closing.add_argument("bag", type=Path, metavar="BAG", help="the folder")
    closing.add_argument("--json", action="store_true", help="print its contents afterwards as JSON")
    closing.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking bag info`` and ``body_tracking bag recover``."""
    before = _recovered(args.bag) if args.verb == "recover" else None
    info = bag_info(args.bag)
    if args.json:
        content = asdict(info) | {"path": str(info.path)}
        print(json.dumps(content if before is None else content | {"before": before}, indent=2))
        return 0
    for line in before or ():
        print(f"before    {line}")
    if before == []:
        print("before    nothing was missing: the bag is left as it was")
    _print(info)
    return 0


def _recovered(folder: Path) -> list[str]:
    """Close a bag unless nothing is missing; returns the warnings about missing or damaged parts."""
    try:
        before = bag_info(folder).warnings
    except BagError as error:
        before = [str(error)]
    if before or not folder.is_dir():  # recover() rejects a file
        recover(folder).close()
    return before
