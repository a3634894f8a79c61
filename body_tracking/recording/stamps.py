"""Converts the header stamps of a recording to ROS time, the time of its log.

If a sensor stamps by its own clock, log time minus stamp is the offset of the two clocks, which drifts, plus a delay.
Delays are positive, so the relation of the clocks is the line that lies below all differences d and nearest to them, a
linear program:

    min over a, b of sum(d_i - a - b stamp_i)  with  a + b stamp_i <= d_i for all i                                  (1)

(Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew from network delay measurements"). Its solution is
the edge of the lower convex hull of the points over their mean. The least delay is unobservable and set to 0: the
fastest message counts as captured when it was logged.
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from body_tracking.core.message_types import TIME_REFERENCE
from body_tracking.core.skeleton import MAX_STAMP_NS, NANOSECONDS, FloatArray, IntArray
from body_tracking.kinect.ros_time import OTHER_CLOCK_NS
from body_tracking.pipeline import graph
from body_tracking.recording.mcap_file import BagError, McapFile
from body_tracking.recording.rosbag2 import RawMessage, deserialize, first_field, serialize

SAME_CLOCK_NS: Final = NANOSECONDS // 10
"""Sensors whose median differences from the log are this close share a clock: their stamps keep their distances."""

SET_NS: Final = NANOSECONDS
"""A larger step of a clock means that it was set, or its sensor was restarted."""

MAX_DRIFT: Final = 1e-3
"""Seconds per second. Crystals drift by 1e-4, NTP slews the log's clock by up to 5e-4."""

_HEADER = "std_msgs/msg/Header"
_NEAR_NS = 5 * NANOSECONDS
"""Results are logged within this time of their capture."""
_SAMPLES = 100

_RESULT = re.compile(
    r"(/\w+)*/(ground_truth|fused|filtered|humans|calibration|tf|tf_static|imu/(skeleton|\w+/orientation))(/.*)?"
)
"""Topics stamped by the reference sensor's clock; the others have the clocks of their sensors."""

_TIMES: Final = {0: struct.Struct(">iI"), 1: struct.Struct("<iI")}
"""``builtin_interfaces/Time`` in CDR, by the second byte of the encapsulation."""

_Series = tuple[IntArray, IntArray]  # stamps and log times, nanoseconds


@dataclass(frozen=True, slots=True)
class _Run:
    """A clock between two times at which it was set: ROS time is stamp + offset + drift (stamp - anchor).

    Attributes:
        log_ns: log time of its first message.
        anchor_ns: a stamp.
        offset_ns: ROS time minus stamp at the anchor.
        drift: seconds per second.
    """

    log_ns: int
    anchor_ns: int = 0
    offset_ns: int = 0
    drift: float = 0.0


class RecordedClock:
    """The clock of a recording's stamps against the clock of its log.

    Args:
        stamps_ns: (n,) of messages, n >= 1.
        log_ns: (n,) their log times, ascending.

    Attributes:
        is_ros_time: stamps are ROS time, and remain unchanged.
        steady: the clock was never set.
    """

    def __init__(self, stamps_ns: IntArray, log_ns: IntArray) -> None:
        differences = log_ns - stamps_ns
        back = np.diff(stamps_ns) < -SET_NS
        # Set ahead: the difference falls below all earlier ones. After a stall it only falls back to its former level.
        ahead = (differences[1:] < np.minimum.accumulate(differences)[:-1] - SET_NS) & (np.diff(differences) < -SET_NS)
        edges = [0, *(np.flatnonzero(back | ahead) + 1).tolist(), len(stamps_ns)]
        self._runs = [
            _fitted(stamps_ns[start:stop], differences[start:stop], int(log_ns[start]))
            for start, stop in pairwise(edges)
        ]
        self._starts = [run.log_ns for run in self._runs]
        self.is_ros_time = not any(run.offset_ns for run in self._runs)
        self.steady = len(self._runs) == 1

    def to_ros(self, stamp_ns: int, log_ns: int) -> int:
        """ROS time of a stamp in a message with this log time, nanoseconds."""
        run = self._runs[max(0, bisect_right(self._starts, log_ns) - 1)]
        ros_ns = stamp_ns + run.offset_ns + round(run.drift * (stamp_ns - run.anchor_ns))
        return min(max(0, ros_ns), MAX_STAMP_NS)


def _fitted(stamps_ns: IntArray, differences_ns: IntArray, log_ns: int) -> _Run:
    """Equation 1, with a drift of at most :data:`MAX_DRIFT`."""
    lasted_ns = int(np.ptp(stamps_ns))
    # Log times that were not recorded live, as some converters write them, carry no information.
    if np.abs(differences_ns).min() <= OTHER_CLOCK_NS or 2 * np.ptp(stamps_ns + differences_ns) < lasted_ns > SET_NS:
        return _Run(log_ns)
    anchor_ns, least_ns = int(stamps_ns.min()), int(differences_ns.min())
    # Relative to these, because floats cannot represent nanoseconds since 1970.
    x, y = (stamps_ns - anchor_ns).astype(np.float64), (differences_ns - least_ns).astype(np.float64)
    drift = float(np.clip(_slope(x, y), -MAX_DRIFT, MAX_DRIFT))
    return _Run(log_ns, anchor_ns, least_ns + int(np.floor((y - drift * x).min())), drift)


def _slope(x: FloatArray, y: FloatArray) -> float:
    """Slope of the lower convex hull over the mean of x (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for cx, cy in sorted(zip(x.tolist(), y.tolist(), strict=True)):
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2:]
            if (bx - ax) * (cy - ay) > (by - ay) * (cx - ax):
                break
            hull.pop()
        hull.append((cx, cy))
    middle = float(x.mean())
    for (ax, ay), (bx, by) in pairwise(hull):
        if ax < bx and middle <= bx:
            return (by - ay) / (bx - ax)
    return 0.0


class RecordedStamps:
    """Converts the header stamps of a recording's messages to ROS time.

    If the first stamp of any topic is not ROS time, each sensor's clock is fitted to all of its messages; topics that
    share a clock are fitted together. A topic of results gets the clock of the sensor with the nearest stamps.

    Args:
        files: of the recording.
        names: of the topics, by their names in the files.
    """

    def __init__(self, files: Iterable[McapFile], names: Mapping[str, str]) -> None:
        files = list(files)
        self._clocks: dict[str, RecordedClock] = {}
        self._types = {
            names[channel.topic]: file.schemas[channel.schema_id].name
            for file in files
            for channel in file.channels.values()
            if channel.topic in names and channel.schema_id in file.schemas
        }
        places = {topic: place for topic, kind in self._types.items() if (place := _stamp_at(kind))}
        first = _read(files, names, places, first=True)
        if not all(RecordedClock(*series).is_ros_time for series in first.values()):
            self._fit(_read(files, names, places, first=False))

    def in_ros_time(self, message: RawMessage) -> RawMessage:
        """The message with its stamps in ROS time; stamps of 0 remain 0."""
        clock = self._clocks.get(message.topic)
        form = _TIMES.get(message.cdr[1]) if len(message.cdr) >= 12 else None
        if clock is None or form is None:
            return message
        kind, log_ns = self._types[message.topic], message.log_time_ns
        if kind != TIME_REFERENCE and _stamp_at(kind) == 4:
            stamp_ns = _nanoseconds(form.unpack_from(message.cdr, 4))
            if not stamp_ns:
                return message
            cdr = bytearray(message.cdr)
            form.pack_into(cdr, 4, *divmod(clock.to_ros(stamp_ns, log_ns), NANOSECONDS))
            return message._replace(cdr=bytes(cdr))
        try:
            content = deserialize(kind, message.cdr)
            self._restamp(content, clock, log_ns)
            return message._replace(cdr=serialize(content))
        except BagError:
            return message  # malformed; reported by its reader

    def _restamp(self, content: Any, clock: RecordedClock, log_ns: int) -> None:
        """Convert all stamps of a message in place."""
        name, _, sequence = first_field(content.__msgtype__)
        for each in getattr(content, name) if sequence else (content,):
            _set(each.header.stamp, clock, log_ns)
        if content.__msgtype__ == TIME_REFERENCE:  # the same instant by the clock of the sensor that it names
            _set(content.time_ref, self._clocks.get(graph.skeleton_topic(content.source), clock), log_ns)

    def _fit(self, found: Mapping[str, _Series]) -> None:
        own = {topic: RecordedClock(*series) for topic, series in found.items()}
        other = [topic for topic in found if not own[topic].is_ros_time]
        sensors = [topic for topic in other if not _RESULT.fullmatch(topic)]
        for topics in _of_one_clock({topic: found[topic] for topic in sensors if own[topic].steady}):
            stamps_ns, log_ns = (np.concatenate([found[topic][k] for topic in topics]) for k in range(2))
            order = np.argsort(log_ns, kind="stable")
            self._clocks |= dict.fromkeys(topics, RecordedClock(stamps_ns[order], log_ns[order]))
        self._clocks |= {topic: own[topic] for topic in sensors if not own[topic].steady}
        clocks = list(self._clocks.values())
        for topic in other:
            if topic not in self._clocks:
                ages = [_age_ns(clock, found[topic]) for clock in clocks]
                near = int(np.argmin(ages)) if ages else 0
                self._clocks[topic] = clocks[near] if ages and ages[near] < _NEAR_NS else own[topic]


def _of_one_clock(found: Mapping[str, _Series]) -> list[list[str]]:
    """Groups of topics whose median differences from the log agree within :data:`SAME_CLOCK_NS`."""
    off = {topic: float(np.median(log_ns - stamps_ns)) for topic, (stamps_ns, log_ns) in found.items()}
    groups: list[list[str]] = []
    for topic in sorted(off, key=lambda topic: (off[topic], topic)):
        if groups and off[topic] - off[groups[-1][0]] <= SAME_CLOCK_NS:
            groups[-1].append(topic)
        else:
            groups.append([topic])
    return groups


def _age_ns(clock: RecordedClock, series: _Series) -> float:
    """Median distance of stamps from their log times by a clock, nanoseconds, over a sample."""
    step = max(1, len(series[0]) // _SAMPLES)
    stamps_ns, log_ns = (values[::step].tolist() for values in series)
    return float(np.median([abs(log - clock.to_ros(stamp, log)) for stamp, log in zip(stamps_ns, log_ns, strict=True)]))


def _read(
    files: Iterable[McapFile], names: Mapping[str, str], places: Mapping[str, int], *, first: bool
) -> dict[str, _Series]:
    """Nonzero stamps and their log times by topic, in the order of log times.

    Args:
        files: to read.
        names: of the topics, by their names in the files.
        places: offset of the stamp, by topic.
        first: only the block with the first stamp of each topic.
    """
    found: dict[str, list[tuple[int, int]]] = {}
    for file in files:
        wanted = {
            number: (names[channel.topic], places[names[channel.topic]])
            for number, channel in file.channels.items()
            if channel.topic in names and names[channel.topic] in places
        }
        missing = set(wanted)
        for block in file.blocks:
            if block.channels is not None and (missing if first else wanted.keys()).isdisjoint(block.channels):
                continue
            for message in file.read(block):
                if message.channel in wanted:
                    topic, place = wanted[message.channel]
                    stamp_ns = _stamp_of(message.data, place)
                    if stamp_ns and message.log_time_ns <= MAX_STAMP_NS:
                        found.setdefault(topic, []).append((message.log_time_ns, stamp_ns))
                        missing.discard(message.channel)
    series = {}
    for topic, pairs in found.items():
        log_ns, stamps_ns = np.array(pairs, dtype=np.int64).T
        order = np.argsort(log_ns, kind="stable")
        series[topic] = stamps_ns[order], log_ns[order]
    return series


def _stamp_at(kind: str) -> int:
    """Offset of the first header stamp in a serialised message of this type; 0 for none."""
    _, inner, sequence = first_field(kind)
    if not sequence:
        return 4 if inner == _HEADER else 0
    return 8 if first_field(inner)[1:] == (_HEADER, False) else 0


def _stamp_of(cdr: bytes, place: int) -> int:
    form = _TIMES.get(cdr[1]) if len(cdr) >= place + 8 else None
    return _nanoseconds(form.unpack_from(cdr, place)) if form is not None else 0


def _nanoseconds(time: tuple[int, int]) -> int:
    """Nanoseconds of a time; 0 for an invalid one."""
    seconds, nanoseconds = time
    return seconds * NANOSECONDS + nanoseconds if nanoseconds < NANOSECONDS else 0


def _set(time: Any, clock: RecordedClock, log_ns: int) -> None:
    stamp_ns = _nanoseconds((time.sec, time.nanosec))
    if stamp_ns:
        time.sec, time.nanosec = divmod(clock.to_ros(stamp_ns, log_ns), NANOSECONDS)
