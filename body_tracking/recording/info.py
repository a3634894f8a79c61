"""``body_tracking bag info`` and ``bag recover``: what is in a recording, and closing one that was cut off."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from body_tracking.recording.qos import Qos
from body_tracking.recording.rosbag2 import BagReader, recover
from body_tracking.skeleton import NANOSECONDS


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        type: of its messages.
        count: messages that can be read.
        rate: mean rate in hertz, between its first and its last message; None with fewer than two.
        qos: what its publishers offered.
        longest_gap: seconds between two messages at most; None with fewer than two.
    """

    name: str
    type: str
    count: int
    rate: float | None
    qos: tuple[Qos, ...]
    longest_gap: float | None = None


@dataclass(frozen=True, slots=True)
class BagInfo:
    """What is in a bag.

    Attributes:
        path: of the bag.
        files: mcap files with their sizes in bytes.
        start_ns: earliest log time.
        duration_s: seconds from the first to the last message.
        messages: that can be read.
        topics: by name.
        warnings: what is missing or damaged.
    """

    path: Path
    files: dict[str, int]
    start_ns: int
    duration_s: float
    messages: int
    topics: tuple[TopicSummary, ...]
    warnings: list[str]


def bag_info(path: Path | str) -> BagInfo:
    """Look through a whole bag, a folder or a single mcap file; what is counted is what can really be read.

    Raises:
        BagError: nothing there can be read as a recording.
    """
    with BagReader(path) as reader:
        spans: dict[str, _Span] = {}
        for message in reader.messages():
            span = spans.setdefault(message.topic, _Span(message.log_time_ns, message.log_time_ns))
            span.add(message.log_time_ns)
        topics = []
        for name, topic in reader.topics.items():
            span = spans.get(name, _Span(0, 0))
            known = span.last > span.first
            rate = (span.count - 1) * NANOSECONDS / (span.last - span.first) if known else None
            gap = span.longest / NANOSECONDS if known else None
            topics.append(TopicSummary(name, topic.type_name, span.count, rate, topic.offered, gap))
        start_ns = min((span.first for span in spans.values()), default=0)
        return BagInfo(
            path=Path(path),
            files={file.path.name: file.path.stat().st_size for file in reader.files},
            start_ns=start_ns,
            duration_s=(max((span.last for span in spans.values()), default=0) - start_ns) / NANOSECONDS,
            messages=sum(span.count for span in spans.values()),
            topics=tuple(topics),
            warnings=reader.warnings,
        )


@dataclass(slots=True)
class _Span:
    """Log times of a topic, nanoseconds."""

    first: int
    last: int
    count: int = 0
    longest: int = 0

    def add(self, time_ns: int) -> None:
        self.count += 1
        self.longest = max(self.longest, time_ns - self.last)
        self.last = max(self.last, time_ns)


def _as_json(info: BagInfo) -> str:
    return json.dumps(asdict(info) | {"path": str(info.path)}, indent=2)


def _qos_text(offers: tuple[Qos, ...]) -> str:
    """``best_effort 5``, ``reliable transient_local 10``; the durability only where it is not the usual one."""
    texts = dict.fromkeys(
        " ".join(
            (
                qos.reliability,
                *(() if qos.durability == "volatile" else (qos.durability,)),
                *(() if qos.history == "unknown" else (str(qos.depth),)),
            )
        )
        for qos in offers
    )
    return ", ".join(texts) or "-"


def _print(info: BagInfo) -> None:
    size = sum(info.files.values())
    start = datetime.fromtimestamp(info.start_ns / NANOSECONDS, UTC)
    print(f"bag       {info.path}")
    print(f"files     {', '.join(info.files)} ({size / 1e6:.2f} MB)")
    print(f"start     {info.start_ns / NANOSECONDS:.3f} s ({start:%Y-%m-%d %H:%M:%S} UTC)")
    print(f"duration  {info.duration_s:.3f} s")
    print(f"messages  {info.messages}")
    rows = [("topic", "type", "count", "rate", "qos")] + [
        (
            topic.name,
            topic.type,
            str(topic.count),
            "-" if topic.rate is None else f"{topic.rate:.1f} Hz",
            _qos_text(topic.qos),
        )
        for topic in info.topics
    ]
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
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    info = verbs.add_parser("info", help="what is in a bag, and what is missing")
    info.add_argument("bag", type=Path, metavar="BAG", help="a folder, or a single mcap file")
    info.add_argument("--json", action="store_true", help="print it as JSON")
    info.set_defaults(run=run)
    closing = verbs.add_parser("recover", help="close a bag whose recorder died, so that ros2 bag opens it too")
    closing.add_argument("bag", type=Path, metavar="BAG", help="the folder")
    closing.add_argument("--json", action="store_true", help="print what is in it then as JSON")
    closing.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking bag info`` and ``body_tracking bag recover``."""
    if args.verb == "recover":
        recover(args.bag).close()
    info = bag_info(args.bag)
    if args.json:
        print(_as_json(info))
    else:
        _print(info)
    return 0
