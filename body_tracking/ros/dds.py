"""What this package asks of the middleware beyond quality of service, which says nothing of it.

Fast DDS, the default of ROS 2, is told by files of profiles; other middlewares are left as they are, and so is it where
somebody else has chosen (``FASTDDS_DEFAULT_PROFILES_FILE`` and the like).

Where a receiver is too busy to empty its buffers, messages are lost; a reliable writer sends them again when the
receiver's answer to its next heartbeat says so. Fast DDS has one every three seconds, and for so long all that comes
after a lost message waits for it. Ours have one every tenth of a second, while there is something to be acknowledged.
"""

from __future__ import annotations

import os
from pathlib import Path

PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Environment variables that name a file of profiles for Fast DDS; the second is the older name."""

_FOLDER = Path(__file__).parent / "fastdds"
_RESEND, _LOOPBACK = _FOLDER / "resend.xml", _FOLDER / "loopback.xml"
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


def prepare() -> None:
    """Send again soon what was lost: for this process, which has not used ROS yet, and those that it starts."""
    if not any(os.environ.get(name) for name in PROFILES):
        _use(_RESEND)


def stay_on_this_machine() -> None:
    """Let this process and those that it starts talk over the loopback interface, unless the user chose otherwise.

    A node that was killed leaves shared memory behind that the others go on writing to; until they notice, up to 3 s,
    whoever takes its place hears nothing. So no shared memory here. With the range ``LOCALHOST`` rmw_fastrtps insists
    on it; the profile does the same without. (A short lease would let the others forget the dead sooner, and also the
    living, where the machine is busy: of these they may then never hear again.)
    """
    chosen = os.environ.get(_RANGE)
    if chosen is None and "ROS_LOCALHOST_ONLY" not in os.environ:
        chosen = os.environ[_RANGE] = "LOCALHOST"
    others = [name for name in PROFILES if os.environ.get(name) != str(_RESEND)]
    others += ["FASTDDS_BUILTIN_TRANSPORTS", "ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS"]
    fast_dds = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") == "rmw_fastrtps_cpp"
    if chosen != "LOCALHOST" or not fast_dds or any(name in os.environ for name in others):
        return
    os.environ[_RANGE] = "SUBNET"  # of the loopback interface
    _use(_LOOPBACK)


def _use(file: Path) -> None:
    for name in PROFILES:
        os.environ[name] = str(file)
