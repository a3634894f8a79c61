"""Checks of the shell: ROS variables, client library, other libraries, and the clock."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

from body_tracking.ros.doctor import OK, PROBLEM, WARNING, Finding

NEEDED = ("filterpy", "vqf", "mcap", "lz4", "zstandard", "rosbags")
"""Required libraries that no ROS install contains."""
OPTIONAL = {
    "viser": ("no live page", "pip install 'body_tracking[viewer]'"),
    "ezc3d": ("no import of C3D files", "pip install 'body_tracking[c3d]'"),
    "tf2_msgs": ("no /tf, so no frames in RViz", "sudo apt install ros-jazzy-tf2-msgs"),
    "hri_msgs": ("no /humans/bodies/tracked (REP-155)", "sudo apt install ros-jazzy-hri-msgs"),
}
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_FAST_DDS = ("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_REMEDIES = {
    "No module named 'rclpy'": "pip install 'body_tracking[ros]', or . /opt/ros/jazzy/setup.bash",
    "RMW": "unset RMW_IMPLEMENTATION, or install the middleware that it names",
    "shared object file": "unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH, in a shell without another ROS",
}
"""By a part of the client library's error message."""


def environment(variables: Mapping[str, str]) -> Iterator[Finding]:
    """Contradictory variables, and domain and discovery range, which must be the same on all computers."""
    domain = variables.get("ROS_DOMAIN_ID") or "0"
    if not (domain.isdecimal() and int(domain) <= 232):  # those beyond have no UDP ports
        yield Finding(PROBLEM, f"ROS_DOMAIN_ID is {domain!r}, expected 0 to 232", "export ROS_DOMAIN_ID=0")
    reach = "LOCALHOST" if variables.get("ROS_LOCALHOST_ONLY") == "1" else variables.get(_RANGE) or "SUBNET"
    if reach not in ("SUBNET", "LOCALHOST", "SYSTEM_DEFAULT"):
        yield Finding(PROBLEM, f"{_RANGE} is {reach!r}: nodes do not find each other", f"export {_RANGE}=SUBNET")
    else:
        peers = variables.get("ROS_STATIC_PEERS") or ("none" if reach == "LOCALHOST" else "those of the network")
        yield Finding(OK, f"ROS domain {domain}, discovery range {reach}, other machines: {peers}")
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
    reason = [f"exit code {done.returncode}", *(line for line in done.stderr.splitlines() if line[:1].strip())][-1]
    remedy = next((remedy for part, remedy in _REMEDIES.items() if part in reason), "see docs/troubleshooting.md")
    return Finding(PROBLEM, f"no ROS node can be made: {reason}", remedy)


def libraries() -> Iterator[Finding]:
    """Libraries that are not installed."""
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        yield Finding(PROBLEM, f"not installed: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    for name, (lack, remedy) in OPTIONAL.items():
        if find_spec(name) is None:
            yield Finding(WARNING, f"{name} is not installed: {lack}", remedy)


def clock() -> Finding:
    """The real-time clock, which stamps messages."""
    if time.time() < Path(__file__).stat().st_mtime:
        return Finding(PROBLEM, f"the clock is in the past: {time.ctime()}", "sudo timedatectl set-ntp true")
    if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(1024)) == 5:  # TIME_ERROR
        remedy = "sudo timedatectl set-ntp true, where sensors are on several machines"
        return Finding(WARNING, "the clock is not synchronised", remedy)
    return Finding(OK, "the clock is synchronised")
