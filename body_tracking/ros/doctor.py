"""``body_tracking doctor``: finds out why no data arrive, and states a remedy.

The checks of the shell and of a bag are here, those of the ROS domain in ``doctor_live``; each yields findings.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final, Literal

from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.extras import pip_install
from body_tracking.core.message_types import IMU, JOINT_STATE, POINT_CLOUD
from body_tracking.pipeline import graph
from body_tracking.ros import dds

OK: Final = "OK"
WARNING: Final = "warning"
PROBLEM: Final = "problem"

NEEDED = ("filterpy", "vqf", "mcap", "lz4", "zstandard", "rosbags")
"""Required libraries that no ROS install contains."""
OPTIONAL = {
    "viser": ("no live page", pip_install("viewer")),
    "ezc3d": ("no import of C3D files", pip_install("c3d")),
}
OF_ROS = {
    "tf2_msgs": ("no /tf, so no frames in RViz", "sudo apt install ros-jazzy-tf2-msgs"),
    "hri_msgs": ("no /humans/bodies/tracked (REP-155)", "sudo apt install ros-jazzy-hri-msgs"),
}
"""Message packages that only a ROS install can have."""
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_FAST_DDS = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_REMEDIES = {
    "No module named 'rclpy'": f"{pip_install('ros')}, or . /opt/ros/jazzy/setup.bash",
    "ROS_DOMAIN_ID": "export ROS_DOMAIN_ID=0",
    "RMW": "unset RMW_IMPLEMENTATION, or install the middleware that it names",
    "shared object file": "unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH, in a shell without another ROS",
}
"""By a part of the client library's error message."""
LEAST_RATE = {POINT_CLOUD: 20.0, JOINT_STATE: 20.0, IMU: 50.0}
"""Hertz: a Kinect has 30, and 15 in the dark; with less than 50 the orientation of an IMU drifts."""
GAP = 0.5
"""Seconds without a frame after which calibration and filter have lost the person."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check, with a remedy; a problem keeps the graph from working."""

    level: Literal["OK", "warning", "problem"]
    found: str
    remedy: str = ""


# --- the shell


def environment(variables: Mapping[str, str]) -> Iterator[Finding]:
    """Contradictory variables, and domain and discovery range, which must be the same on all computers."""
    try:
        domain = f"ROS domain {dds.domain(variables)}, "
    except dds.DomainError as error:
        yield Finding(PROBLEM, str(error), "export ROS_DOMAIN_ID=0")
        domain = ""
    reach = "LOCALHOST" if variables.get("ROS_LOCALHOST_ONLY") == "1" else variables.get(_RANGE) or "SUBNET"
    if reach not in ("SUBNET", "LOCALHOST", "SYSTEM_DEFAULT"):
        yield Finding(PROBLEM, f"{_RANGE} is {reach!r}: nodes do not find each other", f"export {_RANGE}=SUBNET")
    elif not several_machines(variables) and reach == "SUBNET":
        others = "body_tracking up stays on this machine, other nodes reach the network"
        yield Finding(OK, f"{domain}discovery range not set: {others}")
    else:
        peers = variables.get("ROS_STATIC_PEERS") or ("none" if reach == "LOCALHOST" else "those of the network")
        yield Finding(OK, f"{domain}discovery range {reach}, other machines: {peers}")
    for peer in filter(None, variables.get("ROS_STATIC_PEERS", "").split(";")):
        try:
            socket.getaddrinfo(peer, None)
        except OSError:
            remedy = "export ROS_STATIC_PEERS='192.168.0.2;192.168.0.3', with the other computers' addresses"
            yield Finding(PROBLEM, f"ROS_STATIC_PEERS has {peer!r}, which is no address and no known name", remedy)
    for name in ("ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER", *_FAST_DDS):
        if variables.get(name):
            remedy = f"unset {name}, or set it alike in every shell"
            yield Finding(WARNING, f"{name}={variables[name]} limits which nodes find each other", remedy)


def client_library() -> Finding:
    """Whether a node can be made; in a child process, because a broken client library may end it."""
    code = "import rclpy; rclpy.init(); rclpy.create_node('doctor'); print(rclpy.get_rmw_implementation_identifier())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode == 0:
        return Finding(OK, f"rclpy works, on {done.stdout.strip()}")
    lines = [f"exit code {done.returncode}", *(line for line in done.stderr.splitlines() if line[:1].strip())]
    reason, remedy = cause(lines)
    return Finding(PROBLEM, f"no ROS node can be made: {reason}", remedy)


def cause(lines: Sequence[str]) -> tuple[str, str]:
    """The line of an error message for which there is a remedy, else its last one, and the remedy."""
    for line in reversed(lines):
        for part, remedy in _REMEDIES.items():
            if part in line:
                return line, remedy
    return lines[-1], "see docs/troubleshooting.md"


def several_machines(variables: Mapping[str, str]) -> bool:
    """Whether the user chose that nodes find those of other machines."""
    return variables.get(_RANGE) in ("SUBNET", "SYSTEM_DEFAULT") or bool(variables.get("ROS_STATIC_PEERS"))


def libraries(variables: Mapping[str, str]) -> Iterator[Finding]:
    """Libraries that are not installed."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        yield Finding(PROBLEM, f"not installed: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    for name, (lack, remedy) in (OPTIONAL | (OF_ROS if variables.get("ROS_DISTRO") else {})).items():
        if find_spec(name) is None:
            yield Finding(WARNING, f"{name} is not installed: {lack}", remedy)


def clock(variables: Mapping[str, str]) -> Finding:
    """The real-time clock, which stamps messages."""
    if time.time() < Path(__file__).stat().st_mtime:
        return Finding(PROBLEM, f"the clock is in the past: {time.ctime()}", "sudo timedatectl set-ntp true")
    if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(1024)) == 5:  # TIME_ERROR
        if not several_machines(variables):
            return Finding(OK, "the clock is not synchronised, which only sensors on several machines need")
        return Finding(WARNING, "the clock is not synchronised", "sudo timedatectl set-ntp true, on every machine")
    return Finding(OK, "the clock is synchronised")


# --- a recording


def bag(path: Path) -> Iterator[Finding]:
    """Findings on a folder or a single mcap file."""
    # these need libraries whose absence the doctor has to name
    from body_tracking.recording.finding import advice_for, options_for_topic
    from body_tracking.recording.info import bag_info
    from body_tracking.recording.rosbag2 import UnsupportedBagError

    recover = f"body_tracking bag recover {path}"
    try:
        info = bag_info(path)
    except UnsupportedBagError as error:
        yield Finding(PROBLEM, str(error), "ros2 bag convert, to storage mcap and without compression")
        return
    except BodyTrackingError as error:
        yield Finding(PROBLEM, str(error), "give the folder that the recorder made; of this one nothing can be read")
        return
    yield Finding(OK, f"{path}: {info.messages} messages in {info.duration_s:.1f} s")
    for warning in info.warnings:
        yield Finding(WARNING, warning, f"{recover}; its whole messages are played as it is, too")
    namespace = names.rig_namespace(topic.name for topic in info.topics)
    clouds = (topic.name for topic in info.topics if topic.type == POINT_CLOUD and topic.count)
    sensors = graph.sensors_among(names.within(name, namespace) or name for name in clouds)
    others = {
        topic.name: topic.type for topic in info.topics if topic.count and options_for_topic(topic.name, topic.type)
    }
    if not sensors and others:
        found = f"no skeletons on /<sensor>/skeleton, but {', '.join(others)}"
        yield Finding(WARNING, f"{path}: {found}", advice_for(others, "up or replay"))
    elif not sensors:
        found = f"no skeletons on /<sensor>/skeleton; topics: {', '.join(topic.name for topic in info.topics)}"
        yield Finding(PROBLEM, f"{path}: {found}", "record the sensors' topics; docs/recordings.md has other formats")
    skeletons = {names.resolved(graph.skeleton_topic(sensor), namespace) for sensor in sensors}
    for topic in info.topics:
        if topic.name in skeletons or topic.name in others:
            rate, gap = topic.rate or 0.0, topic.longest_gap or 0.0
            text, remedy = f"{topic.name}: {topic.count} messages, {rate:.1f} Hz, longest gap {gap:.2f} s", ""
            if gap > GAP and topic.name in others:
                remedy = "check the driver and the cable: in a gap nothing is measured"
            elif gap > GAP:
                remedy = "keep the person in view: in a gap angles are predicted, then lost"
            elif rate < LEAST_RATE.get(topic.type, 0.0):
                remedy = "more light, USB 3, the driver's settings: at this rate estimates are less certain"
            yield Finding(WARNING if remedy else OK, text, remedy)


# --- the command


def examine(args: argparse.Namespace) -> Iterator[Finding]:
    """All findings; modules that need ROS are imported only after the libraries were found."""
    if args.bag is not None:
        yield from bag(args.bag)
        return
    yield from environment(os.environ)
    yield clock(os.environ)
    needed = [*libraries(os.environ), client_library()]
    yield from needed
    if all(each.level != PROBLEM for each in needed):
        from body_tracking.ros.doctor_live import domain

        yield from domain([each for each in args.sensors.split(",") if each])


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``doctor`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "doctor",
        description="Find out why nothing arrives: checks this shell's ROS environment, libraries and clock, and the "
        "publishers and subscribers in the ROS domain, or a recording, and says what to do. Exit code 1 "
        "if there is a problem.",
    )
    parser.add_argument("bag", nargs="?", type=Path, metavar="BAG", help="check this recording instead")
    parser.add_argument("--bag", dest="named", type=Path, metavar="BAG", help=argparse.SUPPRESS)
    parser.add_argument(
        "--sensors", default="", metavar="A,B", help="sensors that must publish; in a namespace: NAMESPACE/A"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking doctor``."""
    args.bag = args.bag or args.named
    counts = Counter[str]()
    for finding in examine(args):
        counts[finding.level] += 1
        print(f"{finding.level:8} {finding.found}", flush=True)
        if finding.remedy:
            print(f"      -> {finding.remedy}")
    verdict = "solve the problems first" if counts[PROBLEM] else "nothing here prevents tracking"
    if counts[WARNING] and not counts[PROBLEM]:
        verdict = "if no angles arrive, see the warnings"
    print(f"\nproblems: {counts[PROBLEM]}, warnings: {counts[WARNING]}, OK: {counts[OK]}: {verdict}")
    return 1 if counts[PROBLEM] else 0
