"""The environment of a shell: which ROS it finds, and which variables contradict each other or what is there."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding

DISTRO = "jazzy"
RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
SAFE_DOMAIN, LAST_DOMAIN = 101, 232
"""Domains up to the first stay below the ports that Linux gives to anybody; those beyond the second have none."""

_PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_ENVIRONMENT_FILE")
_TRANSPORTS = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS_DISCOVERY_SERVER")
_BOOTSTRAP = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


def domain_of(environment: Mapping[str, str]) -> int | None:
    """The ROS domain; None where it is none."""
    text = environment.get("ROS_DOMAIN_ID") or "0"
    return int(text) if text.isdecimal() and int(text) <= LAST_DOMAIN else None


def range_of(environment: Mapping[str, str]) -> str:
    """How far discovery goes, as rmw takes the variables."""
    if environment.get("ROS_LOCALHOST_ONLY") == "1":
        return "LOCALHOST"
    return environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"


def environment(environment: Mapping[str, str], path: Sequence[str] | None = None) -> Iterator[Finding]:
    """All of it, without importing anything of ROS.

    Args:
        environment: the variables.
        path: where Python looks for packages; ``sys.path`` when None.
    """
    yield from _installs(environment, sys.path if path is None else path)
    yield from _domain(environment)
    yield from _discovery(environment)
    yield from _fast_dds(environment)


def _installs(environment: Mapping[str, str], path: Sequence[str]) -> Iterator[Finding]:
    places = dict.fromkeys(
        str(Path(folder).resolve()) for folder in path if folder and (Path(folder) / "rclpy" / "__init__.py").exists()
    )
    if not places:
        yield Finding(
            "ros",
            PROBLEM,
            "no rclpy: recordings can be processed, nothing can run live",
            "pip install 'body_tracking[ros]', or source a ROS install: . /opt/ros/jazzy/setup.bash",
        )
        return
    found, *others = places
    sourced = environment.get("AMENT_PREFIX_PATH", "")
    wheels = not any(found.startswith(prefix) for prefix in sourced.split(os.pathsep) if prefix)
    if others or (wheels and sourced):
        yield Finding(
            "ros",
            PROBLEM,
            f"two ROS installs mix: rclpy of {found}, and {', '.join(others) or sourced}",
            "use a shell without setup.bash for a virtual environment: "
            "env -u AMENT_PREFIX_PATH -u PYTHONPATH -u LD_LIBRARY_PATH body_tracking doctor",
        )
    else:
        yield Finding("ros", OK, f"rclpy of {found}")
    distro = environment.get("ROS_DISTRO", DISTRO)
    if distro != DISTRO:
        yield Finding("ros", WARNING, f"ROS_DISTRO is {distro}", f"the package is written for {DISTRO}")
    libraries = environment.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    if wheels and environment.get(_BOOTSTRAP) and not any(each.startswith(found) for each in libraries):
        yield Finding(
            "ros",
            PROBLEM,
            f"{_BOOTSTRAP} is set by another environment's Python: ROS's libraries are not found",
            f"unset {_BOOTSTRAP} LD_LIBRARY_PATH",
        )


def _domain(environment: Mapping[str, str]) -> Iterator[Finding]:
    text = environment.get("ROS_DOMAIN_ID") or ""
    domain = domain_of(environment)
    if domain is None:
        yield Finding(
            "domain",
            PROBLEM,
            f"ROS_DOMAIN_ID is {text!r}, expected 0 to {LAST_DOMAIN}",
            "export ROS_DOMAIN_ID=0, or another number that all computers of the lab share",
        )
    else:
        yield Finding("domain", OK, f"ROS_DOMAIN_ID is {domain}{'' if text else ', as it is not set'}")


def _discovery(environment: Mapping[str, str]) -> Iterator[Finding]:
    chosen, peers = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE"), environment.get("ROS_STATIC_PEERS")
    only = environment.get("ROS_LOCALHOST_ONLY")
    if only is not None:
        yield Finding(
            "range",
            WARNING,
            f"ROS_LOCALHOST_ONLY={only} is out of date; set to 1 it overrides ROS_AUTOMATIC_DISCOVERY_RANGE and "
            "ROS_STATIC_PEERS",
            "unset ROS_LOCALHOST_ONLY; export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
        )
    if chosen is not None and chosen not in RANGES:
        yield Finding(
            "range",
            PROBLEM,
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is {chosen!r}, expected {', '.join(RANGES)}",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
        )
    elif range_of(environment) == "OFF":
        yield Finding(
            "range",
            PROBLEM,
            "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF: no node finds another",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
        )
    elif range_of(environment) == "LOCALHOST":
        yield Finding("range", OK, "discovery stays on this machine; sensors on others need the range SUBNET")
    else:
        unset = "" if chosen else ", as nothing is set (body_tracking up stays on this machine by itself)"
        yield Finding("range", OK, f"discovery goes over the local network{unset}")
    if peers is not None:
        ignored = only == "1" or chosen == "OFF"
        text = f"ROS_STATIC_PEERS is {peers!r}"
        if ignored:
            yield Finding("range", WARNING, f"{text}, which is ignored with the range above", "unset ROS_STATIC_PEERS")
        else:
            yield Finding("range", OK, f"{text}: these machines are looked for besides")


def _fast_dds(environment: Mapping[str, str]) -> Iterator[Finding]:
    for name in _PROFILES:
        file = environment.get(name)
        if file and not Path(file).is_file():
            yield Finding("fast dds", PROBLEM, f"{name} is {file!r}: no such file", f"unset {name}")
        elif file:
            yield Finding(
                "fast dds",
                WARNING,
                f"{name}={file} replaces the profile of body_tracking up: a node that is killed takes longer to return",
                f"unset {name}, unless you mean it",
            )
    for name in _TRANSPORTS:
        if environment.get(name):
            yield Finding(
                "fast dds",
                WARNING,
                f"{name}={environment[name]} decides who hears whom",
                f"it must be the same in every shell; or unset {name}",
            )
