"""Joint angles, as ``sensor_msgs/JointState``."""

from __future__ import annotations

from typing import Any

import numpy as np

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds


def angles_to_joint_state(
    angles: JointAngles, body: str, frame_id: str, types: MessageTypes, *, stddev: bool = False
) -> Any:
    """Values, or with ``stddev`` standard deviations, as ``sensor_msgs/JointState``.

    Every name ends in ``_<body>``, the REP-155 body id. ``frame_id`` is the convention, because conventions share names
    of angles.
    """
    return types.make(
        JOINT_STATE,
        header=to_header(angles.stamp_ns, frame_id, types),
        name=[f"{name}_{body}" for name in angles.names],
        position=types.floats(angles.position_stddev if stddev else angles.position),
        velocity=types.floats(angles.velocity_stddev if stddev else angles.velocity),
        effort=types.floats(np.empty(0)),
    )


def angles_to_joint_states(angles: JointAngles, body: str, frame_id: str, types: MessageTypes) -> tuple[Any, Any]:
    """Values and standard deviations by :func:`angles_to_joint_state`."""
    values, stddevs = (angles_to_joint_state(angles, body, frame_id, types, stddev=which) for which in (False, True))
    return values, stddevs


def joint_states_to_angles(values: Any, deviations: Any, body: str) -> JointAngles:
    """The inverse of :func:`angles_to_joint_states`.

    Raises:
        MessageError: different names, stamps or frames, a name without that suffix, sizes that do not match.
    """
    names, stamp_ns = tuple(values.name), to_nanoseconds(values.header.stamp)
    if deviations.header != values.header or tuple(deviations.name) != names:
        raise MessageError("joint states and their standard deviations have other names, stamps or frames")
    other = next((name for name in names if not name.endswith(f"_{body}")), None)
    if other is not None:
        raise MessageError(f"name {other!r} does not end in _{body}")
    columns = [
        np.array(numbers, dtype=np.float64)
        for message in (values, deviations)
        for numbers in (message.position, message.velocity)
    ]
    if any(len(column) != len(names) for column in columns):
        raise MessageError(f"{', '.join(str(len(column)) for column in columns)} numbers of {len(names)} names")
    position, velocity, position_stddev, velocity_stddev = columns
    short = tuple(name.removesuffix(f"_{body}") for name in names)
    return JointAngles(stamp_ns, short, position, velocity, position_stddev, velocity_stddev)


def joint_state_values(message: Any) -> tuple[int, tuple[str, ...], FloatArray]:
    """Stamp in nanoseconds, n names and (n,) positions of a ``sensor_msgs/JointState``.

    Raises:
        MessageError: another number of positions than of names.
    """
    names, values = tuple(message.name), np.array(message.position, dtype=np.float64)
    if len(values) != len(names):
        raise MessageError(f"{len(values)} positions for {len(names)} names")
    return to_nanoseconds(message.header.stamp), names, values
