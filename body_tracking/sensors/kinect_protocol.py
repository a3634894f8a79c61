"""What goes over the wire between a computer with a Kinect v2 and this one: UDP datagrams of a fixed, versioned layout.

Needs nothing but Python's standard library (3.8 or newer), so that this file and ``kinect_sender.py`` run as they are
on a Windows computer without ROS, numpy and this package.

Every packet is little-endian: header, content, HMAC-SHA256 (RFC 2104, all 32 bytes) of everything before it.

====== ======= ====================================================================================================
offset type    header (64 bytes)
====== ======= ====================================================================================================
0      4 char  ``BTKS``
4      uint8   version, 1
5      uint8   kind: 1 frame, 2 clock request, 3 clock answer
6      uint16  bytes of the whole packet
8      32 char the sensor's name, ASCII, padded with zeros
40     uint64  session: a random number of the sender, new at each of its starts
48     uint64  sequence: of a frame, from 1 in its session; of a request, a random number, which its answer repeats
56     int64   of a frame, when it was sent, by the sender's clock (ns); else 0
====== ======= ====================================================================================================

A frame goes on with the sensor's own time (int64, ns), flags (uint8: 1 the floor is known, 2 the sensor is silent),
the number of bodies (uint8), two zero bytes and the floor (4 float32: unit normal and distance, metres, in camera
space). Then, of each body: the SDK's index (uint8, below 6), 7 zero bytes, its tracking id (uint64), and of its 25
joints in the SDK's order: position (3 float32, metres, Kinect camera space), orientation (4 int16: quaternion x y z w
times 32767, zeros where the SDK has none), tracking state (uint8) and a zero byte.

Clock messages are those of NTP (RFC 5905, section 8): a request holds t1, its answer t1, t2 and t3 (int64, ns), where
t1 is by the clock of the asking side, and t2 and t3, receipt of the request and sending of the answer, by that of the
sender of frames. An answer repeats the sender's session and the random number of the request: whoever has received a
right one knows that this session is alive now, and not one that somebody recorded. A receiver takes no frame of a
session before.

A frame of one body has 690 bytes, one of two still fits into one Ethernet frame; six make 3.5 kB, which IP fragments.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import stat
import struct
from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

VERSION = 1
MAGIC = b"BTKS"
DEFAULT_PORT = 7525

FRAME, CLOCK_REQUEST, CLOCK_ANSWER = 1, 2, 3

N_JOINTS = 25
MAX_BODIES = 6
LEAST_KEY = 16
"""Bytes of the shortest key."""

NO_KEY = b""
"""Signs packets that never leave the machine: they are checked for damage, and anybody can make them."""

_HEADER = struct.Struct("<4sBBH32sQQq")
_FRAME = struct.Struct("<qBBxx4f")
_BODY = struct.Struct("<B7xQ")
_JOINT = struct.Struct("<3f4hBx")
_CLOCK = struct.Struct("<3q")
_TAG = 32
_ORIENTATION_SCALE = 32767
_FLOOR_KNOWN, _SENSOR_SILENT = 1, 2
_BODY_SIZE = _BODY.size + N_JOINTS * _JOINT.size

MIN_PACKET = _HEADER.size + _CLOCK.size + _TAG
MAX_PACKET = _HEADER.size + _FRAME.size + MAX_BODIES * _BODY_SIZE + _TAG
"""Bytes; a receiver reads one more to know a larger packet."""


class ProtocolError(ValueError):
    """A packet, name or key that is none.

    Attributes:
        reason: one of a few words, to be counted; the text says more.
    """

    def __init__(self, reason: str, text: str = "") -> None:
        super().__init__(text or reason)
        self.reason = reason


class Header(NamedTuple):
    """What every packet begins with; ``kind`` and the rest as in the table above."""

    kind: int
    sensor: str
    session: int
    sequence: int
    sent_ns: int


class Body(NamedTuple):
    """A body as the SDK tells it.

    Attributes:
        sdk_index: 0 to 5.
        tracking_id: of the SDK; another one whenever a person is seen anew.
        positions: 25 of (x, y, z), metres, Kinect camera space.
        states: 25 of 0 not tracked, 1 inferred, 2 tracked.
        orientations: 25 of (x, y, z, w), unit quaternions, or zeros.
    """

    sdk_index: int
    tracking_id: int
    positions: tuple[tuple[float, ...], ...]
    states: tuple[int, ...]
    orientations: tuple[tuple[float, ...], ...]


class Frame(NamedTuple):
    """What a sensor sees at one instant.

    Attributes:
        time_ns: by the sensor's own clock.
        bodies: none to six.
        floor: (x, y, z, w) of the plane ``x X + y Y + z Z + w = 0`` in camera space, metres, or None.
        silent: the sender is there, and its sensor delivers nothing; then there are no bodies, and no time.
    """

    time_ns: int
    bodies: tuple[Body, ...]
    floor: tuple[float, ...] | None = None
    silent: bool = False


class ClockTimes(NamedTuple):
    """t1, t2 and t3 of a round trip, ns; of a request t2 and t3 are 0."""

    asked_ns: int
    received_ns: int
    answered_ns: int


# --- writing


def pack_frame(frame: Frame, header: Header, key: bytes) -> bytes:
    """A packet of kind FRAME.

    Raises:
        ProtocolError: it cannot be written: too many bodies, another number of joints, a name that is none.
    """
    if len(frame.bodies) > MAX_BODIES:
        raise ProtocolError("bodies", f"{len(frame.bodies)} bodies, expected at most {MAX_BODIES}")
    flags = (_FLOOR_KNOWN if frame.floor is not None else 0) | (_SENSOR_SILENT if frame.silent else 0)
    parts = [_FRAME.pack(frame.time_ns, flags, len(frame.bodies), *(frame.floor or (0.0, 0.0, 0.0, 0.0)))]
    for body in frame.bodies:
        if not len(body.positions) == len(body.states) == len(body.orientations) == N_JOINTS:
            raise ProtocolError("joints", f"a body of {len(body.positions)} joints, expected {N_JOINTS}")
        parts.append(_BODY.pack(body.sdk_index, body.tracking_id))
        for k in range(N_JOINTS):
            orientation = [_short(value) for value in body.orientations[k]]
            parts.append(_JOINT.pack(*body.positions[k], *orientation, body.states[k]))
    return _packet(header._replace(kind=FRAME), b"".join(parts), key)


def pack_clock(times: ClockTimes, header: Header, key: bytes) -> bytes:
    """A packet of kind CLOCK_REQUEST or CLOCK_ANSWER, as the header says.

    Raises:
        ProtocolError: a name that is none.
    """
    return _packet(header, _CLOCK.pack(*times), key)


def _short(value: float) -> int:
    return round(max(-1.0, min(1.0, value)) * _ORIENTATION_SCALE) if math.isfinite(value) else 0


def _packet(header: Header, content: bytes, key: bytes) -> bytes:
    name = sensor_bytes(header.sensor)
    size = _HEADER.size + len(content) + _TAG
    head = _HEADER.pack(MAGIC, VERSION, header.kind, size, name, header.session, header.sequence, header.sent_ns)
    return head + content + _tag(head + content, key)


def _tag(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()


# --- reading; in this order, the cheap first


def read_header(packet: bytes) -> Header:
    """The header of a packet of whatever origin, of which nothing is believed yet.

    Raises:
        ProtocolError: too long or too short, not ours, another version, an unknown kind, another size than it says.
    """
    if len(packet) > MAX_PACKET:
        raise ProtocolError("too large", f"a packet of more than {MAX_PACKET} bytes")
    if len(packet) < MIN_PACKET:
        raise ProtocolError("too short", f"{len(packet)} bytes, expected {MIN_PACKET} at least")
    magic, version, kind, size, name, session, sequence, sent_ns = _HEADER.unpack_from(packet)
    if magic != MAGIC:
        raise ProtocolError("not ours", "not a packet of this protocol")
    if version != VERSION:
        raise ProtocolError("version", f"version {version}, expected {VERSION}: sender and receiver are not alike")
    if kind not in (FRAME, CLOCK_REQUEST, CLOCK_ANSWER):
        raise ProtocolError("kind", f"kind {kind}")
    if size != len(packet) or (kind != FRAME and size != MIN_PACKET):
        raise ProtocolError("wrong size", f"{len(packet)} bytes of {size}")
    return Header(kind, _name(name), session, sequence, sent_ns)


def check_signature(packet: bytes, key: bytes) -> None:
    """Whether somebody with the key made this packet, as it is.

    Raises:
        ProtocolError: no.
    """
    if not hmac.compare_digest(_tag(packet[:-_TAG], key), packet[-_TAG:]):
        raise ProtocolError("wrong signature", "signed with another key, or changed on its way")


def read_frame(packet: bytes) -> Frame:
    """The content of a packet of kind FRAME whose header was read.

    Raises:
        ProtocolError: sizes that contradict each other, an index or a state out of range, an index twice.
    """
    end = len(packet) - _TAG
    if end < _HEADER.size + _FRAME.size:
        raise ProtocolError("wrong size", f"a frame of {len(packet)} bytes")
    time_ns, flags, count, *floor = _FRAME.unpack_from(packet, _HEADER.size)
    at = _HEADER.size + _FRAME.size
    if count > MAX_BODIES or end - at != count * _BODY_SIZE:
        raise ProtocolError("wrong size", f"{len(packet)} bytes for {count} bodies")
    bodies = []
    for _ in range(count):
        index, tracking_id = _BODY.unpack_from(packet, at)
        at += _BODY.size
        joints = list(_JOINT.iter_unpack(packet[at : at + N_JOINTS * _JOINT.size]))
        at += N_JOINTS * _JOINT.size
        states = tuple(joint[7] for joint in joints)
        if index >= MAX_BODIES or max(states) > 2:
            raise ProtocolError("out of range", f"body {index}, tracking state {max(states)}")
        orientations = tuple(tuple(value / _ORIENTATION_SCALE for value in joint[3:7]) for joint in joints)
        bodies.append(Body(index, tracking_id, tuple(joint[:3] for joint in joints), states, orientations))
    if len({body.sdk_index for body in bodies}) < count:
        raise ProtocolError("out of range", "a body twice")
    known = bool(flags & _FLOOR_KNOWN) and all(math.isfinite(value) for value in floor)
    return Frame(time_ns, tuple(bodies), tuple(floor) if known else None, bool(flags & _SENSOR_SILENT))


def read_clock(packet: bytes) -> ClockTimes:
    """The content of a clock message whose header was read."""
    return ClockTimes(*_CLOCK.unpack_from(packet, _HEADER.size))


# --- names and keys


def sensor_bytes(name: str) -> bytes:
    """A sensor's name as a packet holds it.

    Raises:
        ProtocolError: not 1 to 32 letters, digits and underscores, a letter first.
    """
    data = name.encode("ascii", "replace")
    if not (0 < len(data) <= 32 and data[:1].isalpha() and data.replace(b"_", b"0").isalnum()):
        raise ProtocolError("sensor", f"sensor name {name!r}: letters, digits and _ only, a letter first, at most 32")
    return data.ljust(32, b"\0")


def _name(data: bytes) -> str:
    name = data.rstrip(b"\0").decode("ascii", "replace")
    try:
        sensor_bytes(name)
    except ProtocolError:
        raise ProtocolError("sensor", "a sensor's name that is none") from None
    return name


def read_key(path: str) -> bytes:
    """The key in a file: its bytes without white space around them.

    Raises:
        ProtocolError: no such file, one that others may read, or too short a key; the text never holds the key.
    """
    try:
        mode = Path(path).stat().st_mode
        if not stat.S_ISREG(mode):
            raise ProtocolError("key", f"{path}: no regular file")
        if os.name == "posix" and mode & 0o077:
            raise ProtocolError(
                "key", f"{path}: others may read or write it (chmod 600 {path}); make a new key if they did"
            )
        with Path(path).open("rb") as file:
            key = file.read(4096).strip()
    except OSError as error:
        raise ProtocolError("key", f"{path}: cannot be read ({error.strerror})") from error
    if len(key) < LEAST_KEY:
        raise ProtocolError("key", f"{path}: a key of {len(key)} bytes, expected {LEAST_KEY} at least")
    return key


# --- what protects a socket


class RateLimit:
    """A token bucket per source, of which only so many are kept: the one that was heard longest ago is forgotten.

    Args:
        rate: packets per second that a source may send for long.
        burst: packets at once.
        sources: how many are kept.
    """

    def __init__(self, rate: float, burst: float, sources: int = 256) -> None:
        self._rate, self._burst, self._sources = rate, burst, sources
        self._buckets: OrderedDict[object, tuple[float, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._buckets)

    def allows(self, source: object, now_ns: int) -> bool:
        """Whether one more packet of a source is within its limit; the time must not run backwards."""
        left, since_ns = self._buckets.pop(source, (self._burst, now_ns))
        left = min(self._burst, left + (now_ns - since_ns) * 1e-9 * self._rate)
        allowed = left >= 1.0
        self._buckets[source] = (left - 1.0 if allowed else left, now_ns)
        if len(self._buckets) > self._sources:
            self._buckets.popitem(last=False)
        return allowed


class SequenceWindow:
    """Which sequence numbers came: the newest one and a bit for each of those before it (RFC 4303, section 3.4.3).

    Attributes:
        newest: 0 before the first.
        lost: numbers since the first one that have not come.
    """

    SIZE = 64

    def __init__(self) -> None:
        self.newest = 0
        self.lost = 0
        self._first = 0
        self._seen = 0

    def has(self, sequence: int) -> bool:
        """Whether a number came before, as far as that is known."""
        age = self.newest - sequence
        return age >= 0 and (age >= self.SIZE or bool(self._seen >> age & 1))

    def take(self, sequence: int) -> str:
        """``new`` for one beyond all others, ``late`` for one that was missing, else ``replayed``."""
        if sequence > self.newest:
            self._first = self._first or sequence
            step = sequence - self.newest if self.newest else 1
            self.lost += step - 1
            self._seen = ((self._seen << step) | 1) & ((1 << self.SIZE) - 1) if step < self.SIZE else 1
            self.newest = sequence
            return "new"
        if self.has(sequence):
            return "replayed"
        self._seen |= 1 << self.newest - sequence
        self.lost -= sequence > self._first
        return "late"
