"""The UDP packets between a computer with a Kinect v2 and this one: a fixed, versioned, signed layout.

Needs only Python's standard library (3.8 or newer), so that this file and ``kinect_sender.py`` run as they are on a
Windows computer without ROS, numpy and this package.

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

The content of a frame is the sensor's own time (int64, ns), flags (uint8: 1 the floor is known, 2 the sensor is
silent), the number of bodies (uint8), two zero bytes and the floor (4 float32: unit normal and distance, metres, in
camera space). For each body follow the SDK's index (uint8, below 6), 7 zero bytes, its tracking id (uint64), and for
each of its 25 joints in the SDK's order: position (3 float32, metres, Kinect camera space), orientation (4 int16:
quaternion x y z w times 32767, zeros where the SDK has none), tracking state (uint8) and a zero byte.

Clock messages are those of NTP (RFC 5905, section 8): a request holds t1, its answer t1, t2 and t3 (int64, ns), where
t1 is by the clock of the receiver of frames, and t2 and t3, receipt of the request and sending of the answer, by that
of their sender. An answer repeats session and random number of the request, which proves that the session is alive.

A frame of one body has 690 bytes, one of two still fits into one Ethernet frame; six make 3.5 kB, which IP fragments.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import os
import stat
import struct
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
"""Signs packets that never leave the machine: detects damage, but authenticates nothing."""

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
"""Bytes; a receiver reads one more to detect larger packets."""


class ProtocolError(ValueError):
    """Raised for an invalid packet, name or key; ``reason`` is a key for counters."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


class Header(NamedTuple):
    """The variable fields of the header in the table above."""

    kind: int
    sensor: str
    session: int
    sequence: int
    sent_ns: int


class Body(NamedTuple):
    """A body of the SDK.

    Attributes:
        sdk_index: 0 to 5.
        tracking_id: of the SDK; a new one whenever a person reappears.
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
    """The bodies that a sensor sees at one instant.

    Attributes:
        time_ns: by the sensor's own clock.
        bodies: none to six.
        floor: (x, y, z, w) of the plane ``x X + y Y + z Z + w = 0`` in camera space, metres, or None.
        silent: the sender runs, but its sensor delivers no frames; then there are no bodies, and no time.
    """

    time_ns: int
    bodies: tuple[Body, ...]
    floor: tuple[float, ...] | None = None
    silent: bool = False


class ClockTimes(NamedTuple):
    """t1, t2 and t3 of a round trip, ns; in a request t2 and t3 are 0."""

    asked_ns: int
    received_ns: int
    answered_ns: int


# --- writing


def pack_frame(frame: Frame, header: Header, key: bytes) -> bytes:
    """A packet of kind FRAME.

    Raises:
        ProtocolError: too many bodies, another number of joints, an invalid name.
    """
    if len(frame.bodies) > MAX_BODIES:
        raise ProtocolError("bodies", f"{len(frame.bodies)} bodies, expected at most {MAX_BODIES}")
    flags = (_FLOOR_KNOWN if frame.floor is not None else 0) | (_SENSOR_SILENT if frame.silent else 0)
    parts = [_FRAME.pack(frame.time_ns, flags, len(frame.bodies), *(frame.floor or (0.0, 0.0, 0.0, 0.0)))]
    for body in frame.bodies:
        if not len(body.positions) == len(body.states) == len(body.orientations) == N_JOINTS:
            raise ProtocolError("joints", f"a body of {len(body.positions)} joints, expected {N_JOINTS}")
        parts.append(_BODY.pack(body.sdk_index, body.tracking_id))
        parts += [
            _JOINT.pack(*body.positions[k], *map(_short, body.orientations[k]), body.states[k]) for k in range(N_JOINTS)
        ]
    return _packet(header._replace(kind=FRAME), b"".join(parts), key)


def pack_clock(times: ClockTimes, header: Header, key: bytes) -> bytes:
    """A packet of the header's kind, CLOCK_REQUEST or CLOCK_ANSWER.

    Raises:
        ProtocolError: an invalid name.
    """
    return _packet(header, _CLOCK.pack(*times), key)


def _short(value: float) -> int:
    return round(max(-1.0, min(1.0, value)) * _ORIENTATION_SCALE) if math.isfinite(value) else 0


def _packet(header: Header, content: bytes, key: bytes) -> bytes:
    kind, sensor, *numbers = header
    size = _HEADER.size + len(content) + _TAG
    data = _HEADER.pack(MAGIC, VERSION, kind, size, sensor_bytes(sensor), *numbers) + content
    return data + _tag(data, key)


def _tag(data: bytes, key: bytes) -> bytes:
    return hmac.new(key, data, hashlib.sha256).digest()


# --- reading, in this order: cheap checks first


def read_header(packet: bytes) -> Header:
    """The header of an untrusted packet, before its signature is checked.

    Raises:
        ProtocolError: too long or too short, another protocol or version, an unknown kind, a wrong size field.
    """
    if len(packet) > MAX_PACKET:
        raise ProtocolError("too large", f"a packet of more than {MAX_PACKET} bytes")
    if len(packet) < MIN_PACKET:
        raise ProtocolError("too short", f"{len(packet)} bytes, expected {MIN_PACKET} at least")
    magic, version, kind, size, padded, *numbers = _HEADER.unpack_from(packet)
    if magic != MAGIC:
        raise ProtocolError("not ours", "not a packet of this protocol")
    if version != VERSION:
        raise ProtocolError(
            "version", f"version {version}, expected {VERSION}: sender and receiver have different versions"
        )
    if kind not in (FRAME, CLOCK_REQUEST, CLOCK_ANSWER):
        raise ProtocolError("kind", f"kind {kind}")
    if size != len(packet) or (kind != FRAME and size != MIN_PACKET):
        raise ProtocolError("wrong size", f"{len(packet)} bytes of {size}")
    name = padded.rstrip(b"\0").decode("ascii", "replace")
    sensor_bytes(name)
    return Header(kind, name, *numbers)


def check_signature(packet: bytes, key: bytes) -> None:
    """Check the signature.

    Raises:
        ProtocolError: it is wrong.
    """
    if not hmac.compare_digest(_tag(packet[:-_TAG], key), packet[-_TAG:]):
        raise ProtocolError("wrong signature", "signed with another key, or changed in transit")


def read_frame(packet: bytes) -> Frame:
    """The content of a packet of kind FRAME whose header was read.

    Raises:
        ProtocolError: inconsistent sizes, an index or a state out of range, a duplicate index.
    """
    at, end = _HEADER.size + _FRAME.size, len(packet) - _TAG
    if end < at:
        raise ProtocolError("wrong size", f"a frame of {len(packet)} bytes")
    time_ns, flags, count, *floor = _FRAME.unpack_from(packet, _HEADER.size)
    if count > MAX_BODIES or end - at != count * _BODY_SIZE:
        raise ProtocolError("wrong size", f"{len(packet)} bytes for {count} bodies")
    bodies = []
    for start in range(at, end, _BODY_SIZE):
        index, tracking_id = _BODY.unpack_from(packet, start)
        joints = list(_JOINT.iter_unpack(packet[start + _BODY.size : start + _BODY_SIZE]))
        states = tuple(joint[7] for joint in joints)
        if index >= MAX_BODIES or max(states) > 2:
            raise ProtocolError("out of range", f"body {index}, tracking state {max(states)}")
        orientations = tuple(tuple(value / _ORIENTATION_SCALE for value in joint[3:7]) for joint in joints)
        bodies.append(Body(index, tracking_id, tuple(joint[:3] for joint in joints), states, orientations))
    if len({body.sdk_index for body in bodies}) < count:
        raise ProtocolError("out of range", "a body twice")
    known = bool(flags & _FLOOR_KNOWN) and all(map(math.isfinite, floor))
    return Frame(time_ns, tuple(bodies), tuple(floor) if known else None, bool(flags & _SENSOR_SILENT))


def read_clock(packet: bytes) -> ClockTimes:
    """The content of a clock message whose header was read."""
    return ClockTimes(*_CLOCK.unpack_from(packet, _HEADER.size))


# --- names and keys


def sensor_bytes(name: str) -> bytes:
    """A sensor's name, padded for the header.

    Raises:
        ProtocolError: not 1 to 32 letters, digits and underscores, a letter first.
    """
    data = name.encode("ascii", "replace")
    if not (0 < len(data) <= 32 and data[:1].isalpha() and data.replace(b"_", b"0").isalnum()):
        raise ProtocolError("sensor", f"sensor name {name!r}: letters, digits and _ only, a letter first, at most 32")
    return data.ljust(32, b"\0")


def read_key(path: str) -> bytes:
    """The key in a file: its bytes without white space around them.

    Raises:
        ProtocolError: not a regular file, readable by others, or too short a key; the text never contains the key.
    """
    try:
        mode = Path(path).stat().st_mode
        if not stat.S_ISREG(mode):
            raise ProtocolError("key", f"{path}: no regular file")
        if os.name == "posix" and mode & 0o077:
            text = f"{path}: others may read or write it (chmod 600 {path}); make a new key if they did"
            raise ProtocolError("key", text)
        with Path(path).open("rb") as file:
            key = file.read(4096).strip()
    except OSError as error:
        raise ProtocolError("key", f"{path}: cannot be read ({error.strerror})") from error
    if len(key) < LEAST_KEY:
        raise ProtocolError("key", f"{path}: a key of {len(key)} bytes, expected {LEAST_KEY} at least")
    return key
