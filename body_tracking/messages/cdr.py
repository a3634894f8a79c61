"""Skeletons, the most frequent messages, written and read as CDR bytes without message objects.

CPU microseconds per message, including the conversion to and from our own types (rosbags 0.11.9, rclpy 7.1.6):

======================================  =====  ===============  ==============
message                                  here  rosbags          rclpy
======================================  =====  ===============  ==============
skeleton of a sensor, written             8.6   22.1 (2.6 x)     34.3 (4.0 x)
skeleton of a sensor, read               14.1   43.7 (3.1 x)     66.0 (4.7 x)
with covariance and velocity, written    12.4   43.0 (3.5 x)    62.1 (5.0 x)
with covariance and velocity, read       17.3   84.1 (4.9 x)    121.4 (7.0 x)
======================================  =====  ===============  ==============

The bytes are those of the other modules of this package and a ROS serialiser, except for padding, which Fast CDR does
not initialise. Only messages of exactly this layout are read here; the other modules read all others and report their
errors. Encoding: OMG CDR, little-endian (XCDR1); alignment counts from the end of the encapsulation header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Skeleton, TrackingState
from body_tracking.messages.base import BagMessages
from body_tracking.messages.skeletons import skeletons_to_cloud

_ENCAPSULATION = b"\x00\x01\x00\x00"
_STAMP_AND_LENGTH = struct.Struct("<iII")
_BODY_BITS = 16
_JOINTS = np.arange(N_JOINTS, dtype=np.uint32)
_UPPER_OF_NINE = np.array([0, 1, 2, 4, 5, 8])
_NINE_OF_UPPER = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _string(text: str) -> bytes:
    """A CDR string: length with the terminating zero, then the text; without trailing padding."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


@dataclass(frozen=True, slots=True)
class _Layout:
    """The bytes between header and points of one kind of skeleton message.

    Attributes:
        table: ``height`` to the length of ``data``, as CDR with zeros as padding.
        padding: 0 where the table has padding, 255 elsewhere.
        words: 32-bit words per point.
        covariance: whether points have one.
        velocity: whether points have one.
    """

    table: bytes
    padding: NDArray[np.uint8]
    words: int
    covariance: bool
    velocity: bool

    @property
    def size(self) -> int:
        """Bytes of points."""
        return int.from_bytes(self.table[-4:], "little")

    def fits(self, cdr: bytes, start: int) -> bool:
        """Whether a message has this table at ``start``, with any padding bytes."""
        given = np.frombuffer(cdr, np.uint8, len(self.table), start)
        return cdr.startswith(self.table, start) or bytes(given & self.padding) == self.table


@cache
def _layout(bodies: int, covariance: bool, velocity: bool) -> _Layout:
    """The layout of a message that :func:`skeletons_to_cloud` makes."""
    joints, states = np.zeros((N_JOINTS, 3)), np.zeros(N_JOINTS, np.uint8)
    covariances = np.zeros((N_JOINTS, 3, 3)) if covariance else None
    sample = Skeleton(0, "", joints, states, 0, covariances, joints if velocity else None)
    cloud = skeletons_to_cloud([sample] * bodies, BagMessages(lambda type_name: SimpleNamespace))
    table, padding = struct.pack("<III", cloud.height, cloud.width, len(cloud.fields)), b"\xff" * 12
    for field in cloud.fields:
        name = _string(field.name)
        table += _padded(name) + struct.pack("<IB3xI", field.offset, field.datatype, field.count)
        padding += _padded(b"\xff" * len(name)) + b"\xff\xff\xff\xff\xff\x00\x00\x00\xff\xff\xff\xff"
    table += struct.pack("<?3xIII", cloud.is_bigendian, cloud.point_step, cloud.row_step, len(cloud.data))
    padding += b"\xff\x00\x00\x00" + b"\xff" * 12
    return _Layout(table, np.frombuffer(padding, np.uint8), cloud.point_step // 4, covariance, velocity)


def encode_skeletons(skeletons: tuple[Skeleton, ...] | list[Skeleton]) -> bytes:
    """``skeletons_to_cloud``, serialised.

    Args:
        skeletons: at least one; all with the same stamp, frame and kind.
    """
    first = skeletons[0]
    layout = _layout(len(skeletons), first.covariances is not None, first.velocities is not None)
    points = np.empty((len(skeletons), N_JOINTS, layout.words), dtype="<f4")
    labels = points.view("<u4")[:, :, 3]
    for row, label, skeleton in zip(points, labels, skeletons, strict=True):
        row[:, :3] = skeleton.positions
        label[:] = _JOINTS | skeleton.states.astype(np.uint32) << 8 | np.uint32(skeleton.body << _BODY_BITS)
        if skeleton.covariances is not None:
            row[:, 4:10] = skeleton.covariances.reshape(N_JOINTS, 9)[:, _UPPER_OF_NINE]
        if skeleton.velocities is not None:
            row[:, -3:] = skeleton.velocities
    dense = b"\x01" if all(np.isfinite(each.positions).all() for each in skeletons) else b"\x00"
    stamp = struct.pack("<iI", *divmod(first.stamp_ns, NANOSECONDS))
    header = _ENCAPSULATION + stamp + _padded(_string(first.frame_id))
    return header + layout.table + points.tobytes() + dense


def decode_skeletons(cdr: bytes) -> tuple[Skeleton, ...] | None:
    """The bodies in a message of the layout of :func:`encode_skeletons`; None for any other message."""
    header = _read_header(cdr)
    if header is None:
        return None
    stamp_ns, frame_id, start = header
    for layout in _KNOWN:
        end = start + len(layout.table) + layout.size
        if end < len(cdr) <= end + 4 and layout.fits(cdr, start):  # is_dense and padding follow
            break
    else:
        return None
    points: NDArray[np.float32] = np.frombuffer(cdr, "<f4", layout.size // 4, end - layout.size)
    points = points.reshape(-1, N_JOINTS, layout.words)
    skeletons: list[Skeleton] = []
    for value, label in zip(points.astype(np.float64), points.view("<u4")[:, :, 3].tolist(), strict=True):
        body = label[0] >> _BODY_BITS
        states = bytes([word >> 8 & 0xFF for word in label])
        expected = [number | state << 8 | body << _BODY_BITS for number, state in enumerate(states)]
        if label != expected or max(states) > TrackingState.TRACKED or (skeletons and body <= skeletons[-1].body):
            return None
        skeletons.append(
            Skeleton(
                stamp_ns,
                frame_id,
                value[:, :3],
                np.frombuffer(states, np.uint8),
                body,
                value[:, 4:10].take(_NINE_OF_UPPER, axis=1).reshape(N_JOINTS, 3, 3) if layout.covariance else None,
                value[:, -3:] if layout.velocity else None,
            )
        )
    return tuple(skeletons)


def stamp_of(cdr: bytes) -> int:
    """Stamp in nanoseconds of a serialised message whose first field is a header; 0 where there is none."""
    if len(cdr) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


_KINDS = ((True, False), (True, True), (False, False))
_KNOWN = tuple(_layout(count, *kind) for count in range(1, 7) for kind in _KINDS)
"""The layouts that are read here: 1 to 6 bodies of each kind."""


def _read_header(cdr: bytes) -> tuple[int, str, int] | None:
    """Stamp, frame and offset of the end of ``std_msgs/Header``, padded to 4; None where it is invalid."""
    if len(cdr) < 16 or cdr[:4] != _ENCAPSULATION:
        return None
    sec, nanosec, length = _STAMP_AND_LENGTH.unpack_from(cdr, 4)
    if sec < 0 or nanosec >= NANOSECONDS or cdr[15 + length : 16 + length] != b"\0":  # the end of the frame's name
        return None
    try:
        frame_id = cdr[16 : 15 + length].decode()
    except UnicodeDecodeError:
        return None
    return sec * NANOSECONDS + nanosec, frame_id, 16 + (length + 3 & ~3)
