"""The command ``body_tracking doctor``: runs the checks and prints their findings."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from body_tracking.ros.doctor import OK, PROBLEM, WARNING, Finding
from body_tracking.ros.doctor.environment import client_library, clock, environment, libraries


def examine(args: argparse.Namespace) -> Iterator[Finding]:
    """All findings; modules that need ROS are imported only after the libraries were found."""
    if args.bag is not None:
        from body_tracking.ros.doctor.bags import bag

        yield from bag(args.bag)
        return
    yield from environment(os.environ)
    yield clock()
    needed = [*libraries(), client_library()]
    yield from needed
    if all(each.level != PROBLEM for each in needed):
        from body_tracking.ros.doctor.live import domain

        yield from domain([each for each in args.sensors.split(",") if each])


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``doctor`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "doctor",
        description="Why nothing comes: looks at this shell's ROS environment, libraries, clock, and who publishes "
        "what in the ROS domain, or at a recording; says what to do. Exit code 0 without a problem, 1 with one.",
    )
    parser.add_argument("--bag", type=Path, metavar="BAG", help="look at this recording instead")
    parser.add_argument("--sensors", default="", metavar="A,B", help="these must be there; in a namespace: NAMESPACE/A")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking doctor``."""
    counts = Counter[str]()
    for finding in examine(args):
        counts[finding.level] += 1
        print(f"{finding.level:8} {finding.found}", flush=True)
        if finding.remedy:
            print(f"      -> {finding.remedy}")
    print(f"\n{counts[PROBLEM]} problems, {counts[WARNING]} warnings, {counts[OK]} OK")
    return 1 if counts[PROBLEM] else 0
