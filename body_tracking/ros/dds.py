"""Settings of the middleware that quality of service does not cover.

Fast DDS, the default of ROS 2, reads them from profile files. Other middlewares keep their defaults, and so does Fast
DDS where the user has chosen profiles (``FASTDDS_DEFAULT_PROFILES_FILE`` and the like).

A busy receiver loses messages when its buffers are full; a reliable writer sends them again after the receiver answers
its next heartbeat. Fast DDS has a heartbeat period of 3 s, for which all messages after a lost one wait. Ours is 0.1 s,
while there is something to be acknowledged.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from body_tracking.core.errors import BodyTrackingError

PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Environment variables that name a file of profiles for Fast DDS; the second is the older name."""

_FOLDER = Path(__file__).parent / "fastdds"
_RESEND, _LOOPBACK = _FOLDER / "resend.xml", _FOLDER / "loopback.xml"
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


class DomainError(BodyTrackingError):
    """``ROS_DOMAIN_ID`` is no domain; of some values the middleware ends the process."""


def domain(variables: Mapping[str, str]) -> str:
    """The ROS domain.

    Raises:
        DomainError: it is no number, or has no UDP ports.
    """
    text = variables.get("ROS_DOMAIN_ID") or "0"
    if not (text.isdecimal() and int(text) <= 232):
        raise DomainError(f"ROS_DOMAIN_ID is {text!r}, expected 0 to 232")
    return text


def prepare() -> None:
    """Use the short heartbeat period, in this process, which must not have used ROS yet, and its children.

    Raises:
        DomainError: no node can be made in the chosen domain.
    """
    domain(os.environ)
    if not any(os.environ.get(name) for name in PROFILES):
        os.environ.update(dict.fromkeys(PROFILES, str(_RESEND)))


def stay_on_this_machine() -> None:
    """Restrict this process and its children to the loopback interface, unless the user chose otherwise.

    A killed node leaves shared memory behind that the others go on writing to; until they notice, up to 3 s, its
    successor receives nothing. So shared memory is not used. With the range ``LOCALHOST`` rmw_fastrtps insists on it;
    the profile restricts discovery to this machine without it. (A short lease would remove dead nodes sooner, but on a
    busy machine also living ones, which may then never be discovered again.)
    """
    chosen = os.environ.get(_RANGE)
    if chosen is None and "ROS_LOCALHOST_ONLY" not in os.environ:
        chosen = os.environ[_RANGE] = "LOCALHOST"
    others = [name for name in PROFILES if os.environ.get(name) != str(_RESEND)]
    others += ["FASTDDS_BUILTIN_TRANSPORTS", "ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS"]
    fast_dds = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") == "rmw_fastrtps_cpp"
    if chosen != "LOCALHOST" or not fast_dds or any(name in os.environ for name in others):
        return
    os.environ.update(loopback())


def loopback() -> dict[str, str]:
    """The variables by which Fast DDS uses the loopback interface alone, and no shared memory."""
    return {_RANGE: "SUBNET", **dict.fromkeys(PROFILES, str(_LOOPBACK))}


def is_local() -> bool:
    """Whether this process discovers nodes of this machine only."""
    return os.environ.get(_RANGE) == "LOCALHOST" or os.environ.get(PROFILES[0]) == str(_LOOPBACK)
