"""``body_tracking doctor``: all checks, and what they say."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

from body_tracking.doctor import bags, live
from body_tracking.doctor import environment as variables
from body_tracking.doctor import machine as hardware
from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding
from body_tracking.errors import BodyTrackingError

LISTEN = 3.0
"""Seconds for which the graph is listened to: three reports of each node."""
BAG_SECONDS = 2.0
"""For which a bag is read at most."""


class DoctorError(BodyTrackingError):
    """The command was asked for what cannot be."""


def examine(args: argparse.Namespace, environment: Mapping[str, str]) -> Iterator[Finding]:
    """All findings, as they come."""
    if args.bag is not None:
        yield from bags.bag(args.bag, time.monotonic() + BAG_SECONDS)
        if args.bag_only:
            return
    before = hardware.snapshot()
    yield from variables.environment(environment)
    yield hardware.shared_memory()
    local = variables.range_of(environment) == "LOCALHOST"
    domain = variables.domain_of(environment)
    if domain is not None:
        yield from hardware.ports(domain, local)
    yield _multicast(local)
    sensors = tuple(name for name in args.sensors.split(",") if name)
    progress = _progress(args.seconds + args.timeout + live.LONGEST_WAIT) if sys.stderr.isatty() else None
    seen = live.observe(environment, args.seconds, progress, args.timeout, sensors)
    if progress is not None:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    yield live.discovery(seen, environment, local)
    if not isinstance(seen, str):
        yield from live.sensors(seen, sensors)
        yield from live.nodes(seen)
    after = hardware.snapshot()
    yield from hardware.machine(before, after)
    yield from hardware.clock(before, after)
    yield hardware.buffers(before, after)


def _progress(total: float) -> live.Tick:
    def show(elapsed: float) -> None:
        text = f"listening to the ROS domain: {elapsed:.0f} s of at most {total:.0f} s"
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    return show


def _multicast(local: bool) -> Finding:
    if hardware.multicast("127.0.0.1" if local else ""):
        return Finding("multicast", OK, f"works on {'the loopback interface' if local else 'the network'}")
    if local:
        return Finding("multicast", OK, "does not work on the loopback interface; the range LOCALHOST does without")
    return Finding(
        "multicast",
        WARNING,
        "does not work on the network: other machines are not found",
        "name them: export ROS_STATIC_PEERS='192.168.0.2;192.168.0.3'; or alone: "
        "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
    )


def _line(finding: Finding) -> str:
    text = f"{finding.level:8} {finding.check:14} {finding.found}"
    return f"{text}\n{'':24}-> {finding.remedy}" if finding.remedy else text


# --- command line


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``doctor`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "doctor",
        description="Checks this machine, the ROS environment of this shell, whether nodes find each other, the clock, "
        "the sensors and nodes that run in the domain, network buffers and ports, and with --bag a recording. Each "
        "check says OK, warning or problem, what was found, and what to do. Takes 5 seconds, 15 at most.",
        epilog="Exit code 0 without a problem, 1 with one.",
    )
    parser.add_argument("--bag", type=Path, metavar="BAG", help="look at this recording, too")
    parser.add_argument("--bag-only", action="store_true", help="look at the recording alone")
    parser.add_argument(
        "--sensors",
        default="",
        metavar="A,B",
        help="these must be publishing, or begin to soon; of a rig in a namespace as NAMESPACE/A",
    )
    parser.add_argument(
        "--seconds", type=float, default=LISTEN, metavar="S", help="to listen to the graph (default %(default)g)"
    )
    parser.add_argument(
        "--timeout",
        type=float,
        default=live.START_TIMEOUT,
        metavar="S",
        help="that a ROS process may take to start (default %(default)g)",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking doctor``."""
    if not 0.5 <= args.seconds <= 60.0:
        raise DoctorError(f"--seconds {args.seconds:g}: expected 0.5 to 60")
    if not 1.0 <= args.timeout <= 600.0:
        raise DoctorError(f"--timeout {args.timeout:g}: expected 1 to 600")
    if args.bag_only and args.bag is None:
        raise DoctorError("--bag-only: which one? give --bag too")
    findings = []
    for finding in examine(args, os.environ):
        findings.append(finding)
        if not args.json:
            print(_line(finding), flush=True)
    counts = {level: sum(each.level == level for each in findings) for level in (PROBLEM, WARNING, OK)}
    if args.json:
        print(json.dumps({"counts": counts, "findings": [asdict(each) for each in findings]}, indent=2))
    else:
        print(f"\n{counts[PROBLEM]} problems, {counts[WARNING]} warnings, {counts[OK]} OK")
    return 1 if counts[PROBLEM] else 0
