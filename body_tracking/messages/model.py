"""The state of a body model and its segments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from body_tracking.core.body_model import BodyModel
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.message_types import JOINT_STATE, SEGMENTS
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds, to_transform
from body_tracking.messages.images import array_to_image, image_to_array


def estimate_to_joint_state(estimate: ModelEstimate, model: BodyModel, types: MessageTypes) -> Any:
    """The coordinates of a body model as a ``sensor_msgs/JointState``.

    Positions are the tangent vector from the neutral pose, in which a free rotation is a rotation vector; velocities
    the tangent velocity.
    """
    return _joint_state(estimate, model, model.difference(model.neutral(), estimate.q), estimate.velocity, types)


def estimate_to_stddevs(estimate: ModelEstimate, model: BodyModel, types: MessageTypes) -> Any:
    """As :func:`estimate_to_joint_state`, but the standard deviations of the tangent vector at the estimate."""
    deviations = np.sqrt(np.maximum(estimate.covariance.diagonal(), 0.0))
    return _joint_state(estimate, model, deviations[: model.nv], deviations[model.nv :], types)


def _joint_state(
    estimate: ModelEstimate, model: BodyModel, position: FloatArray, velocity: FloatArray, types: MessageTypes
) -> Any:
    return types.make(
        JOINT_STATE,
        header=to_header(estimate.stamp_ns, estimate.frame_id, types),
        name=list(model.coordinate_names),
        position=types.floats(position),
        velocity=types.floats(velocity),
        effort=types.floats(np.empty(0)),
    )


def joint_state_to_model(message: Any, model: BodyModel) -> tuple[int, str, FloatArray, FloatArray]:
    """The inverse of :func:`estimate_to_joint_state`, without uncertainty and lengths.

    Returns:
        Stamp in nanoseconds, frame, (nq,) configuration, (nv,) tangent velocity; NaN where unknown.

    Raises:
        MessageError: other names, other sizes, a position that is not finite, an infinite velocity.
    """
    names = tuple(message.name)
    if names != model.coordinate_names:
        other = next((name for name in names if name not in model.coordinate_names), None)
        what = f"unknown name {other!r}" if other is not None else f"{len(names)} names, or in another order"
        raise MessageError(f"{what}; expected the {model.nv} coordinates of {model.name}")
    position, velocity = (np.array(values, dtype=np.float64) for values in (message.position, message.velocity))
    return (
        to_nanoseconds(message.header.stamp),
        str(message.header.frame_id),
        *coordinates_to_configuration(position, velocity, model),
    )


def coordinates_to_configuration(
    position: FloatArray, velocity: FloatArray, model: BodyModel
) -> tuple[FloatArray, FloatArray]:
    """(nq,) configuration and (nv,) tangent velocity from a message's positions and velocities.

    Raises:
        MessageError: other sizes, a position that is not finite, an infinite velocity.
    """
    for name, values, unsound in (
        ("position", position, ~np.isfinite(position)),
        ("velocity", velocity, np.isinf(velocity)),
    ):
        if len(values) != model.nv:
            raise MessageError(f"{len(values)} {name} values, expected {model.nv}")
        if unsound.any():
            first = int(unsound.argmax())
            raise MessageError(f"{name} of {model.coordinate_names[first]} is {values[first]}")
    return model.integrate(model.neutral(), position), velocity


COVARIANCE_ENCODING = "32FC1"
"""Encoding of the image that holds covariances: one float32 per pixel."""


def covariance_to_image(estimate: ModelEstimate, types: MessageTypes) -> Any:
    """``sensor_msgs/Image`` of 2 nv rows of nv: the covariance of the coordinates, then that of the rates."""
    nv = len(estimate.velocity)
    rows = np.concatenate([estimate.covariance[:nv, :nv], estimate.covariance[nv:, nv:]]).astype("<f4")
    return array_to_image(rows, estimate.stamp_ns, estimate.frame_id, types, COVARIANCE_ENCODING)


def image_to_covariance(message: Any, model: BodyModel) -> tuple[int, FloatArray]:
    """(stamp in nanoseconds, (2 nv, 2 nv) covariance), the inverse of :func:`covariance_to_image`.

    The cross covariance of coordinates and rates is not in the message, and zero here.

    Raises:
        MessageError: another encoding or size, a NaN, a negative variance.
    """
    nv = model.nv
    stamp_ns, _, rows = image_to_array(message, {COVARIANCE_ENCODING: "f4"})
    if rows.shape != (2 * nv, nv):
        raise MessageError(f"covariance of {rows.shape[0]} x {rows.shape[1]}, expected {2 * nv} x {nv}")
    covariance = np.zeros((2 * nv, 2 * nv))
    covariance[:nv, :nv], covariance[nv:, nv:] = rows[:nv], rows[nv:]
    if np.isnan(covariance).any():
        raise MessageError("a covariance is NaN")
    if (covariance.diagonal() < 0.0).any():
        raise MessageError("a variance is negative")
    return stamp_ns, covariance


def segments_to_joint_state(
    estimate: ModelEstimate, names: Sequence[str], origins: FloatArray, quats_xyzw: FloatArray, types: MessageTypes
) -> Any:
    """``sensor_msgs/MultiDOFJointState``: the poses of s segments in the estimate's frame.

    ``origins`` are (s, 3) metres, ``quats_xyzw`` (s, 4) unit quaternions.
    """
    return types.make(
        SEGMENTS,
        header=to_header(estimate.stamp_ns, estimate.frame_id, types),
        joint_names=list(names),
        transforms=[
            to_transform(origin, quat_xyzw, types) for origin, quat_xyzw in zip(origins, quats_xyzw, strict=True)
        ],
        twist=[],
        wrench=[],
    )


def joint_state_to_segments(message: Any) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """The inverse of :func:`segments_to_joint_state`.

    Returns:
        Names of s segments, (s, 3) origins in metres, (s, 4) unit quaternions xyzw.

    Raises:
        MessageError: another number of transforms than of names, or an invalid pose.
    """
    names = tuple(message.joint_names)
    if len(message.transforms) != len(names):
        raise MessageError(f"{len(message.transforms)} transforms for {len(names)} segments")
    rows = np.array(
        [
            (t.translation.x, t.translation.y, t.translation.z, t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w)
            for t in message.transforms
        ]
    ).reshape(-1, 7)
    lengths = np.linalg.norm(rows[:, 3:], axis=1)
    unsound = ~np.isfinite(rows).all(axis=1) | (np.abs(lengths - 1.0) > 1e-3)
    if unsound.any():
        raise MessageError(f"the pose of {names[int(unsound.argmax())]} is {rows[int(unsound.argmax())]}")
    return names, rows[:, :3], rows[:, 3:] / lengths[:, None]
