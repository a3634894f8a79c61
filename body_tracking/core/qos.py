"""Quality of service as a bag stores it, in the YAML form of rosbag2.

rosbag2 writes the names of the policies from metadata version 9 (Jazzy) on, and the numbers of ``rmw`` before.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

from body_tracking.core.files import FileError, dump_yaml, load_yaml
from body_tracking.core.times import NANOSECONDS

INFINITE_NS = 2**63 - 1
"""``RMW_DURATION_INFINITE``: 9223372036 s and 854775807 ns."""

# The values of the rmw enumerations, for metadata before version 9.
_NUMBERED = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available"),
}

_DURATIONS = {
    "deadline": "deadline_ns",
    "lifespan": "lifespan_ns",
    "liveliness_lease_duration": "liveliness_lease_ns",
}


@dataclass(frozen=True, slots=True)
class Qos:
    """The profile that one publisher offers.

    Attributes:
        reliability: ``reliable`` or ``best_effort``.
        durability: ``volatile`` or ``transient_local``.
        depth: messages kept; 0 where discovery did not report it.
        history: ``keep_last``, ``keep_all``, or ``unknown`` where discovery did not report it.
        deadline_ns: nanoseconds.
        lifespan_ns: nanoseconds.
        liveliness: ``automatic`` or ``manual_by_topic``.
        liveliness_lease_ns: nanoseconds.
        avoid_ros_namespace_conventions: as in ``rmw``.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    depth: int = 10
    history: str = "keep_last"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False


RELIABLE = Qos()
SENSOR_DATA = Qos(reliability="best_effort", depth=5)
LATCHED = Qos(durability="transient_local", depth=10)
LATEST = Qos(reliability="best_effort", depth=1)
"""For a subscriber that needs only the newest message and must not hold up the publisher."""


def offer_for(recorded: Sequence[Qos]) -> Qos:
    """The profile under which to play a topic again, so that every subscription that matched then matches now.

    The profile of a single publisher is kept; of several, the strongest of each policy is taken. Where discovery did
    not report history and depth, they become the usual ``keep_last`` 10.
    """
    if not recorded:
        return RELIABLE
    first = recorded[0]
    return Qos(
        reliability="reliable" if any(qos.reliability != "best_effort" for qos in recorded) else "best_effort",
        durability="transient_local" if any(qos.durability == "transient_local" for qos in recorded) else "volatile",
        depth=max(qos.depth for qos in recorded) or RELIABLE.depth,
        history="keep_all" if all(qos.history == "keep_all" for qos in recorded) else "keep_last",
        deadline_ns=min(qos.deadline_ns for qos in recorded),
        lifespan_ns=max(qos.lifespan_ns for qos in recorded),
        liveliness=first.liveliness if first.liveliness in ("automatic", "manual_by_topic") else "automatic",
        liveliness_lease_ns=min(qos.liveliness_lease_ns for qos in recorded),
        avoid_ros_namespace_conventions=first.avoid_ros_namespace_conventions,
    )


def request_for(offered: Sequence[Qos], depth: int) -> Qos:
    """The strongest profile of a subscription that matches every one of these publishers.

    Reliable if every publisher is reliable, transient local if every publisher is; ``depth`` is in messages.
    """
    reliable = all(qos.reliability == "reliable" for qos in offered)
    latched = all(qos.durability == "transient_local" for qos in offered)
    return Qos("reliable" if reliable else "best_effort", "transient_local" if latched else "volatile", depth)


def to_yaml(offers: Sequence[Qos]) -> list[dict[str, Any]]:
    """The value of ``offered_qos_profiles`` in metadata version 9."""
    profiles = []
    for offer in offers:
        profile = asdict(offer)
        for name, field in _DURATIONS.items():
            sec, nsec = divmod(profile.pop(field), NANOSECONDS)
            profile[name] = {"sec": sec, "nsec": nsec}
        profiles.append(profile)
    return profiles


def dump(offers: Sequence[Qos]) -> str:
    """The text that an mcap channel carries under ``offered_qos_profiles``."""
    return dump_yaml(to_yaml(offers)).strip() if offers else ""


def load(value: object) -> tuple[Qos, ...]:
    """The profiles in ``offered_qos_profiles`` of any metadata version, text or list.

    A value that cannot be read falls back to the default of its policy, so that the recording can still be played.
    """
    return _load_text(value) if isinstance(value, str) else _profiles(value)


@lru_cache(maxsize=64)  # most topics of a recording have the same text
def _load_text(text: str) -> tuple[Qos, ...]:
    try:
        return _profiles(load_yaml(text))
    except FileError:
        return ()


def _profiles(value: object) -> tuple[Qos, ...]:
    return tuple(_profile(item) for item in value if isinstance(item, dict)) if isinstance(value, list) else ()


def _profile(item: dict[str, Any]) -> Qos:
    values: dict[str, Any] = {"depth": 0, "history": "unknown"}
    for name, names in _NUMBERED.items():
        value = item.get(name)
        if isinstance(value, int) and 0 <= value < len(names):
            value = names[value]
        if value in names:
            values[name] = value
    for name, field in _DURATIONS.items():
        with contextlib.suppress(TypeError, KeyError, ValueError, OverflowError):
            nanoseconds = int(item[name]["sec"]) * NANOSECONDS + int(item[name]["nsec"])
            # Before Jazzy an infinite duration was 2147483647 s and 4294967295 ns; 0 is "unspecified".
            values[field] = nanoseconds if 0 < nanoseconds < 2147483647 * NANOSECONDS else INFINITE_NS
    if isinstance(item.get("depth"), int):
        values["depth"] = max(0, item["depth"])
    return Qos(**values, avoid_ros_namespace_conventions=bool(item.get("avoid_ros_namespace_conventions", False)))
