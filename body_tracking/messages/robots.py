"""Commands to the joints of robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from body_tracking.core.message_types import FLOAT_ARRAY, JOINT_TRAJECTORY
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.messages.base import MessageTypes, to_header


def command_to_trajectory(
    joints: Sequence[str], position: FloatArray, stamp_ns: int, from_start: float, types: MessageTypes
) -> Any:
    """``trajectory_msgs/JointTrajectory`` with one point, for ``joint_trajectory_controller``.

    Without velocities, because that controller refuses a trajectory that ends in motion (its parameter
    ``allow_nonzero_velocity_at_trajectory_end``, false from Jazzy on).

    The n joints shall reach ``position`` (n,), radians, ``from_start`` seconds after ``stamp_ns``, or after the arrival
    of the message if ``stamp_ns`` is 0.
    """
    sec, nanosec = divmod(round(from_start * NANOSECONDS), NANOSECONDS)
    none = types.floats(np.empty(0))
    return types.make(
        JOINT_TRAJECTORY,
        header=to_header(stamp_ns, "", types),
        joint_names=list(joints),
        points=[
            types.make(
                "trajectory_msgs/msg/JointTrajectoryPoint",
                positions=types.floats(position),
                velocities=none,
                accelerations=none,
                effort=none,
                time_from_start=types.make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec),
            )
        ],
    )


def command_to_array(position: FloatArray, types: MessageTypes) -> Any:
    """``std_msgs/Float64MultiArray`` of (n,) radians in the controller's order, for ``forward_command_controller``."""
    layout = types.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return types.make(FLOAT_ARRAY, layout=layout, data=types.floats(position))
