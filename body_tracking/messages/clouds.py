"""``sensor_msgs/PointCloud2`` to and from numpy records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final, TypeAlias

import numpy as np

from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError, MessageTypes, to_header

# sensor_msgs/PointField datatypes
UINT8, UINT16, INT32, FLOAT32 = 2, 4, 5, 7
_NUMPY: Final = {UINT8: "u1", UINT16: "<u2", INT32: "<i4", FLOAT32: "<f4"}

Fields: TypeAlias = tuple[tuple[str, int], ...]
"""Names and datatypes."""
POSITION: Final[Fields] = (("x", FLOAT32), ("y", FLOAT32), ("z", FLOAT32))
COVARIANCE: Final[Fields] = tuple((name, FLOAT32) for name in ("xx", "xy", "xz", "yy", "yz", "zz"))
_UPPER = np.triu_indices(3)
_LARGEST_STEP: Final = 2**31 - 1
"""Bytes of numpy's largest record: an empty cloud may state more."""


@cache
def record_of(fields: Fields) -> np.dtype[Any]:
    """The packed record of these fields."""
    return np.dtype([(name, _NUMPY[kind]) for name, kind in fields])


def make_cloud(points: Any, fields: Fields, stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """The message of an array of records of these fields, in one row (height 1) for any shape of the array."""
    offsets = points.dtype.fields
    finite = [bool(np.isfinite(points[name]).all()) for name, kind in fields[:3] if kind == FLOAT32]
    return types.make(
        POINT_CLOUD,
        header=to_header(stamp_ns, frame_id, types),
        height=1,
        width=points.size,
        fields=[
            types.make("sensor_msgs/msg/PointField", name=name, offset=int(offsets[name][1]), datatype=kind, count=1)
            for name, kind in fields
        ],
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * points.size,
        data=types.octets(points.tobytes()),
        is_dense=all(finite),
    )


def read_cloud(cloud: Any, wanted: Mapping[str, int], needed: Sequence[str], most: int) -> Any:
    """The points of a message as an array of records, with those of the wanted fields that it has.

    Args:
        cloud: the message; fields that are not wanted are ignored.
        wanted: datatypes by name.
        needed: fields without which the message is malformed.
        most: largest number of points.

    Raises:
        MessageError: fields missing or of another type, big-endian data, sizes that contradict each other, too many
            points.
    """
    if cloud.is_bigendian:
        raise MessageError("big-endian point data (the layout is little-endian)")
    count = int(cloud.width) * int(cloud.height)
    if count > most:
        raise MessageError(f"{count} points, expected at most {most}")
    record = _described(cloud, wanted, needed)
    row_step = int(cloud.width) * record.itemsize
    if int(cloud.row_step) != row_step or len(cloud.data) != row_step * int(cloud.height):
        raise MessageError(
            f"{len(cloud.data)} bytes of data for {count} points of {record.itemsize} bytes (row_step {cloud.row_step})"
        )
    return np.frombuffer(memoryview(cloud.data), dtype=record)


def _described(cloud: Any, wanted: Mapping[str, int], needed: Sequence[str]) -> np.dtype[Any]:
    """The numpy record that the message's own field table describes."""
    found: dict[str, tuple[str, int]] = {}
    step = int(cloud.point_step)
    if step > (len(cloud.data) or _LARGEST_STEP):
        raise MessageError(f"point_step {step} of {len(cloud.data)} bytes of data")
    for field in cloud.fields:
        if field.name not in wanted or field.name in found:
            continue
        if field.datatype != wanted[field.name] or field.count != 1:
            raise MessageError(
                f"field {field.name!r} has datatype {field.datatype} x {field.count}, expected {wanted[field.name]} x 1"
            )
        if field.offset + np.dtype(_NUMPY[field.datatype]).itemsize > step:
            raise MessageError(f"field {field.name!r} at offset {field.offset} ends beyond point_step {step}")
        found[field.name] = _NUMPY[field.datatype], int(field.offset)
    missing = [name for name in needed if name not in found]
    if missing:
        raise MessageError(f"missing field(s) {', '.join(missing)}")
    formats, offsets = zip(*found.values(), strict=True)
    return np.dtype({"names": [*found], "formats": formats, "offsets": offsets, "itemsize": step})


def has(points: Any, fields: Fields) -> bool:
    """Whether an array of records has these optional fields, such as :data:`COVARIANCE`.

    Raises:
        MessageError: it has only some of them.
    """
    there = [name for name, _ in fields if name in points.dtype.names]
    if there and len(there) < len(fields):
        raise MessageError(f"of {', '.join(name for name, _ in fields)} only the fields {', '.join(there)}")
    return bool(there)


def columns(points: Any, names: Sequence[str]) -> FloatArray:
    """(n, m) numbers of these fields."""
    return np.stack([points[name] for name in names], axis=1).astype(np.float64)


def put_covariance(points: Any, covariance: FloatArray) -> None:
    """Write (n, 3, 3) matrices into the fields :data:`COVARIANCE`."""
    upper = covariance[..., _UPPER[0], _UPPER[1]]
    for column, (name, _) in enumerate(COVARIANCE):
        points[name] = upper[..., column]


def covariance_of(points: Any) -> FloatArray:
    """The inverse of :func:`put_covariance`."""
    upper = columns(points, [name for name, _ in COVARIANCE])
    full = np.empty((len(points), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = upper
    full[:, _UPPER[1], _UPPER[0]] = upper
    return full
