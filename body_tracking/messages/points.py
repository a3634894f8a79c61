"""``geometry_msgs/PoseArray`` of points; the orientations have no meaning."""

from __future__ import annotations

from typing import Any

import numpy as np

from body_tracking.core.message_types import POSE_ARRAY
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageError, MessageTypes, to_header, to_nanoseconds


def points_to_pose_array(points: FloatArray, stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """The message of points (n, 3), metres."""
    still = types.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    poses = [
        types.make(
            "geometry_msgs/msg/Pose",
            position=types.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=still,
        )
        for x, y, z in points.tolist()
    ]
    return types.make(POSE_ARRAY, header=to_header(stamp_ns, frame_id, types), poses=poses)


def pose_array_to_points(message: Any) -> tuple[int, FloatArray]:
    """Stamp in nanoseconds, and points (n, 3), metres.

    Raises:
        MessageError: a number is not finite, or the stamp is invalid.
    """
    places = [pose.position for pose in message.poses]
    points = np.array([[place.x, place.y, place.z] for place in places], dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(points).all():
        raise MessageError(f"a position is not finite: {points.tolist()}")
    return to_nanoseconds(message.header.stamp), points
