"""Intended mountings of inertial sensors: the direction of a sensor's axes on each segment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.skeleton import FloatArray

_USUAL: Final = {
    "pelvis": "+z-x",
    "lower_trunk": "+z-x",
    "upper_trunk": "+z+x",
    "head": "+z-x",
    "clavicle": "+z-x",
    "upper_arm": "-z+y",
    "forearm": "-z+y",
    "hand": "-z+y",
}
"""Directions of the sensor's x and z in the frame of each (left) segment: sacrum, sternum, back of the head, scapula,
outside of the arm, back of the hand. z points away from the body, x up on the trunk and to the fingers on the arm."""


class MountingError(BodyTrackingError):
    """Raised when the mounting axes are unknown or not two different ones."""


def mounting(segment: str, axes: str = "") -> FloatArray:
    """(3, 3) segment to sensor.

    Args:
        segment: of ``UpperBody.segment_names``.
        axes: directions of the sensor's x and z in the segment's frame, such as ``-z+y``; empty for the usual ones.

    Raises:
        MountingError: no such segment, or not two different axes.
    """
    if segment not in SEGMENTS:
        raise MountingError(f"segment {segment!r}, {one_of(segment, SEGMENTS)}")
    mirror = np.ones(3)
    if not axes:
        axes = _USUAL[segment.removesuffix("_left").removesuffix("_right")]
        mirror[1] = -1.0 if segment.endswith("_right") else 1.0
    signs, names = axes[::2], axes[1::2]
    if len(axes) != 4 or not set(signs) <= set("+-") or not set(names) <= set("xyz") or names[0] == names[1]:
        raise MountingError(f"mounting {axes!r} on {segment}: expected where x and z of the sensor point, as in -z+y")
    x, z = (float(f"{sign}1") * np.eye(3)["xyz".index(name)] * mirror for sign, name in zip(signs, names, strict=True))
    return np.stack([x, np.cross(z, x), z])


def mountings(segments: Sequence[str], given: Sequence[str] = ()) -> FloatArray:
    """(k, 3, 3) segment to sensor of k segments.

    Args:
        segments: k names.
        given: ``segment:axes`` of sensors that are not worn in the usual way.

    Raises:
        MountingError: an entry of another form, or of a segment that is not among these.
    """
    axes = dict.fromkeys(segments, "")
    for entry in given:
        segment, _, own = entry.partition(":")
        if segment not in axes or not own:
            raise MountingError(f"mounting {entry!r}: expected SEGMENT:AXES, of {', '.join(segments) or 'no segment'}")
        axes[segment] = own
    return np.array([mounting(segment, own) for segment, own in axes.items()]).reshape(-1, 3, 3)
