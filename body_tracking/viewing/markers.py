"""Markers for RViz and Foxglove, and transforms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from body_tracking.core import so3
from body_tracking.core.message_types import MARKERS, TF, TRANSFORM
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray
from body_tracking.messages.base import MessageTypes, to_header, to_vector
from body_tracking.messages.markers import marker, to_colour, to_points
from body_tracking.viewing.colours import Colour
from body_tracking.viewing.shapes import Ellipsoids, Figure

# visualization_msgs/Marker types
_SPHERE, _LINE_LIST, _SPHERE_LIST, _TEXT = 2, 5, 7, 9


class Markers:
    """The markers of one message, in one frame at one time.

    Args:
        stamp_ns: of all markers; 0 for the latest transform.
        frame_id: of all markers.
        types: the family of message classes to build.
    """

    def __init__(self, stamp_ns: int, frame_id: str, types: MessageTypes) -> None:
        self._types = types
        self._header = to_header(stamp_ns, frame_id, types)
        self._markers: list[Any] = []

    def figure(self, name: str, shape: Figure, colour: Colour, radius: float, thickness: float) -> None:
        """Skeletons: joints as balls in their colours, bones as lines of one colour."""
        types = self._types
        colours = [self._colour(rgb) for rgb in shape.joint_colours.tolist()]
        points, ends = self._points(shape.joints), self._points(shape.bones.reshape(-1, 3))
        size = types.make("geometry_msgs/msg/Vector3", x=2 * radius, y=2 * radius, z=2 * radius)
        self._add(f"{name}/joints", 0, _SPHERE_LIST, size, self._colour(colour), points=points, colors=colours)
        width = types.make("geometry_msgs/msg/Vector3", x=thickness, y=0.0, z=0.0)
        self._add(f"{name}/bones", 0, _LINE_LIST, width, self._colour(colour), points=ends)

    def ellipsoids(self, name: str, shape: Ellipsoids, colour: Colour, opacity: float) -> None:
        """One marker per ellipsoid."""
        quats = so3.matrix_to_quat(shape.rotations)
        for number, (centre, quat, radii) in enumerate(zip(shape.centres, quats, shape.radii, strict=True)):
            size = to_vector(2.0 * np.maximum(radii, 1e-4), self._types)
            self._add(name, number, _SPHERE, size, self._colour(colour, opacity), self._pose(centre, quat))

    def lines(self, name: str, number: int, ends: FloatArray, pose: SensorPose, colour: Colour) -> None:
        """Lines with (n, 2, 3) ends in a sensor's own frame, and the sensor's name above it."""
        width = self._types.make("geometry_msgs/msg/Vector3", x=0.008, y=0.0, z=0.0)
        placed = self._pose(pose.translation, pose.quat_xyzw)
        self._add(
            name, number, _LINE_LIST, width, self._colour(colour), placed, points=self._points(ends.reshape(-1, 3))
        )
        above = self._pose(pose.translation + np.array([0.0, 0.0, 0.12]), np.array([0.0, 0.0, 0.0, 1.0]))
        height = self._types.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.08)
        self._add(f"{name}/names", number, _TEXT, height, self._colour(colour), above, text=pose.sensor)

    def message(self) -> Any:
        """``visualization_msgs/MarkerArray``."""
        return self._types.make(MARKERS, markers=self._markers)

    def _add(
        self,
        name: str,
        number: int,
        kind: int,
        scale: Any,
        colour: Any,
        pose: Any = None,
        points: Sequence[Any] = (),
        colors: Sequence[Any] = (),
        text: str = "",
    ) -> None:
        placed = self._pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])) if pose is None else pose
        self._markers.append(
            marker(
                *(self._header, name, number, kind, scale, colour, placed, self._types),
                points=points,
                colours=colors,
                text=text,
            )
        )

    def _points(self, points: FloatArray) -> list[Any]:
        return to_points(points, self._types)

    def _colour(self, rgb: Sequence[int], opacity: float = 1.0) -> Any:
        return to_colour(rgb, self._types, opacity)

    def _pose(self, position: FloatArray, quat_xyzw: FloatArray) -> Any:
        x, y, z = position.tolist()
        qx, qy, qz, qw = quat_xyzw.tolist()
        return self._types.make(
            "geometry_msgs/msg/Pose",
            position=self._types.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._types.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )


def segments_to_transforms(message: Any, body: str, segments: Sequence[str], types: MessageTypes) -> Any:
    """``tf2_msgs/TFMessage`` that places a person's segments.

    Args:
        message: ``sensor_msgs/MultiDOFJointState`` of :func:`segments_to_joint_state`.
        body: the id of the person; frames are named ``<segment>_<body>``, as the links of the person's URDF.
        segments: those to place; the others are left out.
        types: the family of message classes to build.
    """
    return types.make(
        TF,
        transforms=[
            types.make(TRANSFORM, header=message.header, child_frame_id=f"{name}_{body}", transform=transform)
            for name, transform in zip(message.joint_names, message.transforms, strict=True)
            if name in segments
        ],
    )
