"""``visualization_msgs/Marker``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.messages.base import MessageTypes

MARKER: Final = "visualization_msgs/msg/Marker"
MARKER_LIFETIME_NS: Final = NANOSECONDS // 2
"""Markers vanish after this time unless they are published again."""


def marker(
    header: Any,
    name: str,
    number: int,
    kind: int,
    scale: Any,
    colour: Any,
    pose: Any,
    types: MessageTypes,
    *,
    points: Sequence[Any] = (),
    colours: Sequence[Any] = (),
    text: str = "",
) -> Any:
    """A marker that is added or replaced.

    Args:
        header: ``std_msgs/Header``.
        name: namespace, unique together with ``number``.
        number: see ``name``.
        kind: ``type`` of the message.
        scale: ``geometry_msgs/Vector3``.
        colour: ``std_msgs/ColorRGBA``.
        pose: ``geometry_msgs/Pose``.
        types: the family of message classes to build.
        points: ``geometry_msgs/Point``.
        colours: ``std_msgs/ColorRGBA`` of each point.
        text: content of a text marker.
    """
    return types.make(
        MARKER,
        header=header,
        ns=name,
        id=number,
        type=kind,
        action=0,
        pose=pose,
        scale=scale,
        color=colour,
        lifetime=types.make("builtin_interfaces/msg/Duration", sec=0, nanosec=MARKER_LIFETIME_NS),
        frame_locked=False,
        points=list(points),
        colors=list(colours),
        texture_resource="",
        texture=types.make("sensor_msgs/msg/CompressedImage", header=header, format="", data=types.octets(b"")),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=types.make("visualization_msgs/msg/MeshFile", filename="", data=types.octets(b"")),
        mesh_use_embedded_materials=False,
    )


def to_points(points: FloatArray, types: MessageTypes) -> list[Any]:
    """``geometry_msgs/Point`` of (n, 3) metres."""
    return [types.make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in points.tolist()]


def to_colour(rgb: Sequence[int], types: MessageTypes, opacity: float = 1.0) -> Any:
    """``std_msgs/ColorRGBA`` of three bytes and an opacity from 0 to 1."""
    r, g, b = (value / 255.0 for value in rgb)
    return types.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=opacity)
