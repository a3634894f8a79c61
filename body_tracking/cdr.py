"""The graph's own messages as CDR bytes, made and read without message objects.

A client library in Python spends more on turning a ``PointCloud2`` into objects and back than our nodes do on its
content. What is written here is what ``messages`` and a ROS serialiser would write, but for padding, which Fast CDR
leaves as it is. What is read is only a message of that same layout; anything else is left to ``messages``, which says
what is wrong with it.

Encoding: OMG CDR, little-endian (XCDR1), as ROS 2 sends it; alignment counts from behind the encapsulation header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.model import BodyModel
from body_tracking.messages.imus import orientation_to_message
from body_tracking.messages.model import (
    COVARIANCE_ENCODING,
    coordinates_to_configuration,
    covariance_rows,
    rows_to_covariance,
    stddevs,
)
from body_tracking.messages.skeletons import skeletons_to_cloud
from body_tracking.orientation import SegmentOrientation
from body_tracking.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState

_ENCAPSULATION = b"\x00\x01\x00\x00"
_STAMP_AND_LENGTH = struct.Struct("<iII")
_BODY_BITS = 16
_JOINTS = np.arange(N_JOINTS, dtype=np.uint32)
_UPPER_OF_NINE = np.array([0, 1, 2, 4, 5, 8])
_NINE_OF_UPPER = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


def _padded(data: bytes, to: int = 4) -> bytes:
    return data + bytes(-len(data) % to)


def _string(text: str) -> bytes:
    """Its length with the terminating zero, and itself; not padded behind."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


# --- skeletons


@dataclass(frozen=True, slots=True)
class _Layout:
    """A kind of skeleton message: what stands between its header and its points.

    Attributes:
        table: ``height`` to the length of ``data``, as CDR with zeros as padding.
        padding: 0 where the table has padding, 255 elsewhere.
        words: 32-bit words per point.
        covariance: whether points have one.
        velocity: likewise.
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
        """Whether a message has this table there, whatever another serialiser left in the padding."""
        given = np.frombuffer(cdr, np.uint8, len(self.table), start)
        return cdr.startswith(self.table, start) or bytes(given & self.padding) == self.table


class _Plain:
    """A family of message classes (``messages.MessageTypes``) that only holds the fields."""

    def make(self, _type_name: str, /, **fields: Any) -> Any:
        return SimpleNamespace(**fields)

    def octets(self, data: bytes) -> Any:
        return data

    def floats(self, values: FloatArray) -> Any:
        return values


@cache
def _layout(bodies: int, covariance: bool, velocity: bool) -> _Layout:
    """From the one place that knows the fields."""
    joints = np.zeros((N_JOINTS, 3))
    sample = Skeleton(
        0,
        "",
        joints,
        np.zeros(N_JOINTS, np.uint8),
        0,
        np.zeros((N_JOINTS, 3, 3)) if covariance else None,
        joints if velocity else None,
    )
    cloud = skeletons_to_cloud([sample] * bodies, _Plain())
    table, padding = struct.pack("<III", cloud.height, cloud.width, len(cloud.fields)), b"\xff" * 12
    for field in cloud.fields:
        name = _string(field.name)
        table += _padded(name) + struct.pack("<IB3xI", field.offset, field.datatype, field.count)
        padding += _padded(b"\xff" * len(name)) + b"\xff\xff\xff\xff\xff\x00\x00\x00\xff\xff\xff\xff"
    table += struct.pack("<?3xIII", cloud.is_bigendian, cloud.point_step, cloud.row_step, len(cloud.data))
    padding += b"\xff\x00\x00\x00" + b"\xff" * 12
    return _Layout(table, np.frombuffer(padding, np.uint8), cloud.point_step // 4, covariance, velocity)


def _known_layouts() -> tuple[_Layout, ...]:
    """Those that are read here: one body of each kind, and then some more."""
    kinds = ((True, False), (True, True), (False, False))
    return tuple(_layout(count, *kind) for count in range(1, 7) for kind in kinds)


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
    dense = b"\x01" if np.isfinite(first.positions).all() else b"\x00"
    return _header(first.stamp_ns, first.frame_id) + layout.table + points.tobytes() + dense


def decode_skeletons(cdr: bytes) -> tuple[Skeleton, ...] | None:
    """``cloud_to_skeletons`` of a serialised message, for messages as :func:`encode_skeletons` makes them.

    Returns:
        The bodies; None where the message is anything else, right or wrong.
    """
    header = _read_header(cdr)
    if header is None:
        return None
    stamp_ns, frame_id, start = header
    for layout in _KNOWN:
        end = start + len(layout.table) + layout.size
        if end < len(cdr) <= end + 4 and layout.fits(cdr, start):  # behind it is_dense and, maybe, padding
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


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """Encapsulation and ``std_msgs/Header``, padded to 4."""
    return _ENCAPSULATION + struct.pack("<iI", *divmod(stamp_ns, NANOSECONDS)) + _padded(_string(frame_id))


_KNOWN = _known_layouts()


# --- joint angles


@cache
def _names(names: tuple[str, ...], body: str = "") -> bytes:
    """``name``, padded to 4; with ``_<body>`` behind each, where there is one."""
    table = struct.pack("<I", len(names))
    for name in names:
        table = _padded(table + _string(f"{name}_{body}" if body else name))
    return table


def encode_angles(angles: JointAngles, body: str, frame_id: str) -> tuple[bytes, bytes]:
    """``angles_to_joint_states``, serialised: values, and standard deviations."""
    start = _header(angles.stamp_ns, frame_id) + _names(angles.names, body)
    return (
        start + _doubles(len(start), angles.position, angles.velocity),
        start + _doubles(len(start), angles.position_stddev, angles.velocity_stddev),
    )


def _doubles(position: int, *values: FloatArray) -> bytes:
    """Sequences of ``float64``, aligned to 8 from behind the encapsulation, and an empty one for ``effort``."""
    data = b""
    for value in values:
        data += struct.pack("<I", len(value))
        data += bytes(-(position + len(data) - 4) % 8) if len(value) else b""
        data += value.astype("<f8").tobytes()
    return data + struct.pack("<I", 0)


# --- the state of a body model


def encode_model_state(estimate: ModelEstimate, model: BodyModel) -> bytes:
    """The values of ``estimate_to_joint_states``, serialised."""
    start = _header(estimate.stamp_ns, estimate.frame_id) + _names(model.coordinate_names)
    return start + _doubles(len(start), model.difference(model.neutral(), estimate.q), estimate.velocity)


def encode_model_stddev(estimate: ModelEstimate, model: BodyModel) -> bytes:
    """The standard deviations of ``estimate_to_joint_states``, serialised."""
    start = _header(estimate.stamp_ns, estimate.frame_id) + _names(model.coordinate_names)
    deviations = stddevs(estimate)
    return start + _doubles(len(start), deviations[: model.nv], deviations[model.nv :])


def decode_model_state(cdr: bytes, model: BodyModel) -> tuple[int, str, FloatArray, FloatArray] | None:
    """``joint_state_to_model`` of a serialised message, for messages as :func:`encode_model_state` makes them.

    Returns:
        As there; None where the layout is any other.

    Raises:
        MessageError: numbers that are none.
    """
    header = _read_header(cdr)
    if header is None:
        return None
    stamp_ns, frame_id, start = header
    names, nv = _names(model.coordinate_names), model.nv
    first = start + len(names)
    positions = first + 4 + (-first % 8)
    velocities = positions + 8 * nv + 8
    end = velocities + 8 * nv
    if not cdr.startswith(names, start) or not end + 4 <= len(cdr) < end + 8:
        return None
    if any(
        int.from_bytes(cdr[at : at + 4], "little") != size for at, size in ((first, nv), (velocities - 8, nv), (end, 0))
    ):
        return None
    position, velocity = (np.frombuffer(cdr, "<f8", nv, at).astype(np.float64) for at in (positions, velocities))
    return stamp_ns, frame_id, *coordinates_to_configuration(position, velocity, model)


def encode_covariance(estimate: ModelEstimate) -> bytes:
    """``covariance_to_image``, serialised."""
    rows = covariance_rows(estimate)
    return _header(estimate.stamp_ns, estimate.frame_id) + _image(*rows.shape) + rows.tobytes()


def decode_covariance(cdr: bytes, model: BodyModel) -> tuple[int, FloatArray] | None:
    """``image_to_covariance`` of a serialised message, for messages as :func:`encode_covariance` makes them.

    Returns:
        As there; None where the layout is any other.

    Raises:
        MessageError: numbers that are none.
    """
    header = _read_header(cdr)
    if header is None:
        return None
    stamp_ns, _, start = header
    nv = model.nv
    table = _image(2 * nv, nv)
    data, size = start + len(table), 8 * nv * nv
    if not cdr.startswith(table, start) or not data + size <= len(cdr) < data + size + 4:
        return None
    rows = np.frombuffer(cdr, "<f4", 2 * nv * nv, data).reshape(2 * nv, nv).astype(np.float64)
    return stamp_ns, rows_to_covariance(rows)


@cache
def _image(height: int, width: int) -> bytes:
    """``height`` to the length of ``data``; it begins and ends at a multiple of 4."""
    encoding = _string(COVARIANCE_ENCODING) + b"\0"  # and is_bigendian
    return struct.pack("<II", height, width) + _padded(encoding) + struct.pack("<II", 4 * width, 4 * width * height)


def encode_segments(
    estimate: ModelEstimate, names: tuple[str, ...], origins: FloatArray, quats_xyzw: FloatArray
) -> bytes:
    """``segments_to_joint_state``, serialised."""
    start = _header(estimate.stamp_ns, estimate.frame_id) + _names(names) + struct.pack("<I", len(names))
    data = np.concatenate([origins, quats_xyzw], axis=1).astype("<f8").tobytes()
    return start + bytes(-(len(start) - 4) % 8) + data + struct.pack("<II", 0, 0)


def encode_orientation(measurement: SegmentOrientation) -> bytes:
    """``orientation_to_message``, serialised."""
    message = orientation_to_message(measurement, _Plain())
    numbers: list[Any] = []
    for name in ("orientation", "angular_velocity", "linear_acceleration"):
        numbers += [list(vars(getattr(message, name)).values()), getattr(message, f"{name}_covariance")]
    start = _header(measurement.stamp_ns, measurement.frame_id)
    return start + bytes(-(len(start) - 4) % 8) + np.concatenate(numbers).astype("<f8").tobytes()


def encode_string(text: str) -> bytes:
    """``std_msgs/String``, serialised."""
    return _ENCAPSULATION + _string(text)


def _read_header(cdr: bytes) -> tuple[int, str, int] | None:
    """Stamp, frame and the place behind ``std_msgs/Header``, padded to 4; None where there is none."""
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
