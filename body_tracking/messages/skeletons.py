"""Skeletons, as ``sensor_msgs/PointCloud2``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.skeleton import N_JOINTS, FloatArray, Skeleton, TrackingState
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds

# sensor_msgs/PointField datatypes
_UINT8, _UINT16, _FLOAT32 = 2, 4, 7
_NUMPY = {_UINT8: "u1", _UINT16: "<u2", _FLOAT32: "<f4"}

_BASE_FIELDS = (
    ("x", _FLOAT32),
    ("y", _FLOAT32),
    ("z", _FLOAT32),
    ("joint", _UINT8),
    ("tracking_state", _UINT8),
    ("body", _UINT16),
)
_COVARIANCE_FIELDS = tuple((name, _FLOAT32) for name in ("xx", "xy", "xz", "yy", "yz", "zz"))
_VELOCITY_FIELDS = tuple((name, _FLOAT32) for name in ("vx", "vy", "vz"))

_UPPER = np.triu_indices(3)
MAX_BODIES = 64
"""A message with more bodies is malformed."""


@cache
def _cloud_layout(with_covariance: bool, with_velocity: bool) -> tuple[np.dtype[Any], tuple[tuple[str, int], ...]]:
    """The packed record and its fields; 16, 40 or 52 bytes per point."""
    fields = (
        _BASE_FIELDS + (_COVARIANCE_FIELDS if with_covariance else ()) + (_VELOCITY_FIELDS if with_velocity else ())
    )
    return np.dtype([(name, _NUMPY[kind]) for name, kind in fields]), fields


def skeletons_to_cloud(skeletons: Sequence[Skeleton], types: MessageTypes) -> Any:
    """Bodies seen at one instant as one ``sensor_msgs/PointCloud2``.

    Args:
        skeletons: at least one; all with the same stamp, frame and kind (covariances and velocities or not).
        types: the family of message classes to build.

    Returns:
        The message; a point per joint and body, joints in SDK order.
    """
    first = skeletons[0]
    record, fields = _cloud_layout(first.covariances is not None, first.velocities is not None)
    points = np.empty((len(skeletons), N_JOINTS), dtype=record)
    points["joint"] = np.arange(N_JOINTS, dtype=np.uint8)
    for row, skeleton in zip(points, skeletons, strict=True):
        row["x"], row["y"], row["z"] = skeleton.positions.T
        row["tracking_state"] = skeleton.states
        row["body"] = skeleton.body
        if skeleton.covariances is not None:
            upper = skeleton.covariances[:, _UPPER[0], _UPPER[1]]
            for column, (name, _) in enumerate(_COVARIANCE_FIELDS):
                row[name] = upper[:, column]
        if skeleton.velocities is not None:
            row["vx"], row["vy"], row["vz"] = skeleton.velocities.T
    offsets = record.fields
    assert offsets is not None
    return types.make(
        POINT_CLOUD,
        header=to_header(first.stamp_ns, first.frame_id, types),
        height=1,
        width=points.size,
        fields=[
            types.make("sensor_msgs/msg/PointField", name=name, offset=int(offsets[name][1]), datatype=kind, count=1)
            for name, kind in fields
        ],
        is_bigendian=False,
        point_step=record.itemsize,
        row_step=record.itemsize * points.size,
        data=types.octets(points.tobytes()),
        is_dense=bool(np.isfinite(first.positions).all()),
    )


def _record_of(cloud: Any) -> np.dtype[Any]:
    """The numpy record that the message's own field table describes."""
    wanted = dict(_BASE_FIELDS + _COVARIANCE_FIELDS + _VELOCITY_FIELDS)
    names: list[str] = []
    formats: list[str] = []
    offsets: list[int] = []
    step = int(cloud.point_step)
    if step > len(cloud.data):
        raise MessageError(f"point_step {step} of {len(cloud.data)} bytes of data")
    for field in cloud.fields:
        if field.name not in wanted or field.name in names:
            continue
        if field.datatype != wanted[field.name] or field.count != 1:
            raise MessageError(
                f"field {field.name!r} has datatype {field.datatype} x {field.count}, expected {wanted[field.name]} x 1"
            )
        if field.offset + np.dtype(_NUMPY[field.datatype]).itemsize > step:
            raise MessageError(f"field {field.name!r} at offset {field.offset} ends beyond point_step {step}")
        names.append(field.name)
        formats.append(_NUMPY[field.datatype])
        offsets.append(int(field.offset))
    missing = [name for name, _ in _BASE_FIELDS if name not in names]
    if missing:
        raise MessageError(f"missing field(s) {', '.join(missing)}")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def cloud_to_skeletons(cloud: Any) -> tuple[Skeleton, ...]:
    """The bodies in one ``sensor_msgs/PointCloud2``, by number.

    Joints may come in any order; unknown fields are ignored.

    Raises:
        MessageError: fields missing or of another type, big-endian data, sizes that contradict each other, no
            points, a joint missing, repeated or unknown, a tracking state above 2.
    """
    if cloud.is_bigendian:
        raise MessageError("big-endian point data (the skeleton layout is little-endian)")
    count = int(cloud.width) * int(cloud.height)
    if count == 0:
        raise MessageError("0 points")
    if count % N_JOINTS or count > N_JOINTS * MAX_BODIES:
        raise MessageError(f"{count} points, expected a multiple of {N_JOINTS} and at most {N_JOINTS * MAX_BODIES}")
    record = _record_of(cloud)
    if int(cloud.row_step) != int(cloud.width) * record.itemsize or len(cloud.data) != int(cloud.row_step) * int(
        cloud.height
    ):
        raise MessageError(
            f"{len(cloud.data)} bytes of data for {count} points of {record.itemsize} bytes (row_step {cloud.row_step})"
        )
    points = np.frombuffer(memoryview(cloud.data), dtype=record)
    worst = int(points["tracking_state"].max())
    if worst > TrackingState.TRACKED:
        raise MessageError(f"tracking_state {worst}, expected 0, 1 or 2")
    order = np.lexsort((points["joint"], points["body"]))
    points = points[order].reshape(-1, N_JOINTS)
    if (points["joint"] != np.arange(N_JOINTS)).any() or (points["body"] != points["body"][:, :1]).any():
        raise MessageError(f"a joint is missing, repeated or above {N_JOINTS - 1}")
    stamp_ns, frame_id = to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id)
    names = record.names or ()
    return tuple(
        Skeleton(
            stamp_ns,
            frame_id,
            _columns(row, ("x", "y", "z")),
            row["tracking_state"].copy(),
            int(row["body"][0]),
            _symmetric(row) if "xx" in names else None,
            _columns(row, ("vx", "vy", "vz")) if "vx" in names else None,
        )
        for row in points
    )


def markers_to_points(message: Any) -> tuple[int, list[int], FloatArray]:
    """Stamp in nanoseconds, ids and (n, 3) positions of the added markers of a ``visualization_msgs/MarkerArray``.

    Raises:
        MessageError: no such marker, or markers with different stamps.
    """
    shown = [marker for marker in message.markers if marker.action == 0]  # ADD
    stamps = {to_nanoseconds(marker.header.stamp) for marker in shown}
    if len(stamps) != 1:
        raise MessageError(f"{len(shown)} markers of {len(stamps)} times, expected those of one")
    places = [marker.pose.position for marker in shown]
    points = np.array([(place.x, place.y, place.z) for place in places])
    return stamps.pop(), [int(marker.id) for marker in shown], points


def _columns(row: Any, names: Sequence[str]) -> FloatArray:
    return np.stack([row[name] for name in names], axis=1).astype(np.float64)


def _symmetric(row: Any) -> FloatArray:
    upper = _columns(row, [name for name, _ in _COVARIANCE_FIELDS])
    full = np.empty((len(row), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = upper
    full[:, _UPPER[1], _UPPER[0]] = upper
    return full
