"""Skeletons, as ``sensor_msgs/PointCloud2``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from body_tracking.core.skeleton import N_JOINTS, BoolArray, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.messages.base import MessageError, MessageTypes, to_nanoseconds
from body_tracking.messages.clouds import (
    COVARIANCE,
    FLOAT32,
    POSITION,
    UINT8,
    UINT16,
    Fields,
    columns,
    covariance_of,
    has,
    make_cloud,
    put_covariance,
    read_cloud,
    record_of,
)

_FIELDS = (*POSITION, ("joint", UINT8), ("tracking_state", UINT8), ("body", UINT16))
_VELOCITY = tuple((name, FLOAT32) for name in ("vx", "vy", "vz"))
MAX_BODIES = 64
"""A message with more bodies is malformed."""
_DIAGONAL = np.arange(3)
_ROUNDING = 1e-5
"""Of correlations, whose covariances are float32."""


def skeletons_to_cloud(skeletons: Sequence[Skeleton], types: MessageTypes) -> Any:
    """Bodies seen at one instant as one ``sensor_msgs/PointCloud2``: a point per joint and body, in SDK order.

    At least one body; all with the same stamp, frame and kind (with or without covariances and velocities).
    """
    first = skeletons[0]
    fields: Fields = _FIELDS
    fields += COVARIANCE if first.covariances is not None else ()
    fields += _VELOCITY if first.velocities is not None else ()
    points = np.empty((len(skeletons), N_JOINTS), dtype=record_of(fields))
    points["joint"] = np.arange(N_JOINTS, dtype=np.uint8)
    for row, skeleton in zip(points, skeletons, strict=True):
        row["x"], row["y"], row["z"] = skeleton.positions.T
        row["tracking_state"] = skeleton.states
        row["body"] = skeleton.body
        if skeleton.covariances is not None:
            put_covariance(row, skeleton.covariances)
        if skeleton.velocities is not None:
            row["vx"], row["vy"], row["vz"] = skeleton.velocities.T
    return make_cloud(points, fields, first.stamp_ns, first.frame_id, types)


def cloud_to_skeletons(cloud: Any) -> tuple[Skeleton, ...]:
    """The bodies in one ``sensor_msgs/PointCloud2``, by number.

    Joints may come in any order; unknown fields are ignored.

    Raises:
        MessageError: fields missing or of another type, only a part of a covariance or a velocity, big-endian data,
            sizes that contradict each other, no points, a joint missing, repeated or unknown, a tracking state above 2.
    """
    points = read_cloud(
        cloud, dict(_FIELDS + COVARIANCE + _VELOCITY), [name for name, _ in _FIELDS], N_JOINTS * MAX_BODIES
    )
    if not len(points) or len(points) % N_JOINTS:
        raise MessageError(f"{len(points)} points, expected a multiple of {N_JOINTS}")
    worst = int(points["tracking_state"].max())
    if worst > TrackingState.TRACKED:
        raise MessageError(f"tracking_state {worst}, expected 0, 1 or 2")
    order = np.lexsort((points["joint"], points["body"]))
    points = points[order].reshape(-1, N_JOINTS)
    if (points["joint"] != np.arange(N_JOINTS)).any() or (points["body"] != points["body"][:, :1]).any():
        raise MessageError(f"a joint is missing, repeated or above {N_JOINTS - 1}")
    stamp_ns, frame_id = to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id)
    covariances, velocities = has(points, COVARIANCE), has(points, _VELOCITY)
    return tuple(
        Skeleton(
            stamp_ns,
            frame_id,
            columns(row, ("x", "y", "z")),
            row["tracking_state"].copy(),
            int(row["body"][0]),
            covariance_of(row) if covariances else None,
            columns(row, ("vx", "vy", "vz")) if velocities else None,
        )
        for row in points
    )


def checked_covariances(skeletons: tuple[Skeleton, ...]) -> tuple[Skeleton, ...]:
    """The bodies, without covariances where all are zero: in ROS, zero stands for an unknown covariance.

    Raises:
        MessageError: the covariance of a joint that has a position has a negative variance, NaN, or correlations that
            are impossible. A variance of zero is possible, as of a position along a ray, but nothing takes a joint for
            exact: :func:`~body_tracking.core.measurement.joint_variance` has a lower bound, and ``ekf`` puts its own
            variance in the place of zeros.
    """
    if skeletons[0].covariances is None or all(_positive_definite(each.covariances) for each in skeletons):
        return skeletons
    if not any(np.any(each.covariances) for each in skeletons):
        return tuple(replace(each, covariances=None) for each in skeletons)
    for each in skeletons:
        assert each.covariances is not None
        wrong = each.valid & ~_possible(each.covariances)
        if wrong.any():
            joint = int(wrong.argmax())
            given = " ".join(f"{value:.3g}" for value in each.covariances[joint][np.triu_indices(3)])
            raise MessageError(f"covariance of {Joint(joint).name} is impossible (xx xy xz yy yz zz): {given}")
    return skeletons


def _positive_definite(covariances: FloatArray | None) -> bool:
    """Whether all (n, 3, 3) symmetric matrices are; four times as fast as :func:`_possible`, which takes others too."""
    assert covariances is not None
    try:
        return math.isfinite(np.linalg.cholesky(covariances).sum())
    except np.linalg.LinAlgError:
        return False


def _possible(covariances: FloatArray) -> BoolArray:
    """(n,) whether (n, 3, 3) matrices have no negative variance, and correlations without a negative eigenvalue."""
    variance = covariances[:, _DIAGONAL, _DIAGONAL]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where((variance > 0.0) & (variance < np.inf), 1.0 / np.sqrt(variance), 1.0)
        yz, xz, xy = (covariances[:, i, j] * scale[:, i] * scale[:, j] for i, j in ((1, 2), (0, 2), (0, 1)))
        possible: BoolArray = (
            (variance >= 0.0).all(axis=1)
            & (np.maximum(np.maximum(abs(yz), abs(xz)), abs(xy)) <= 1.0 + _ROUNDING)
            & (1.0 + 2.0 * xy * xz * yz - xy * xy - xz * xz - yz * yz >= -_ROUNDING)
        )
    return possible


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
