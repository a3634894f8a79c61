"""What inertial sensors are taken for: the parameters of :class:`~body_tracking.inertial.tracking.InertialTracker`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from body_tracking.core.parameters import number_field
from body_tracking.inertial.alignment import Pose

AUTO, T_POSE, ARMS_DOWN = "auto", "t_pose", "arms_down"
OWN, SHARED, REFERENCE = "own", "shared", "reference"
POSES: Final[Mapping[str, Pose]] = {T_POSE: "t", ARMS_DOWN: "n"}
"""What poses are called in parameters, and by ``alignment``."""


def _choice(default: str, doc: str, *choices: str) -> Any:
    return field(default=default, metadata={"doc": doc, "choices": choices})


@dataclass(frozen=True, slots=True)
class TrackingParameters:
    """What inertial sensors are taken for; each field's metadata says what it is, its unit and its range."""

    pose: str = _choice(
        AUTO,
        "in which pose the sensors are aligned with the body: T-pose with palms down, or arms hanging with thumbs "
        "forward; auto: the first of the two that is held for a second",
        AUTO,
        T_POSE,
        ARMS_DOWN,
    )
    camera: bool = field(
        default=True,
        metadata={"doc": "take headings, slips and clocks from a camera's skeletons; false: inertial sensors alone"},
    )
    clock: str = _choice(
        OWN,
        "own: each sensor has a clock of its own; shared: all have the same; reference: stamps are as those of world",
        OWN,
        SHARED,
        REFERENCE,
    )
    magnetometer: bool = field(
        default=True, metadata={"doc": "use magnetic fields, where there are any and while they are undisturbed"}
    )
    swap_exchanged: bool = field(
        default=True,
        metadata={"doc": "take sensors that are found on each other's segments for what they are; false: only tell"},
    )
    rate: float = number_field(30.0, "skeletons per second", "Hz", 1.0, 200.0)
    orientation_rate: float = number_field(30.0, "orientations of each segment per second at most", "Hz", 1.0, 1000.0)
    largest_stddev: float = number_field(
        0.6, "tell no orientation that is known less well than this about any axis", "rad", 0.01, 2.0
    )
    mounting_stddev: float = number_field(
        0.17, "by how much sensors are put on otherwise than meant, per axis", "rad", 0.001, 2.0
    )
    pose_stddev: float = number_field(
        0.105,
        "by how much the person's joints are off the pose, per axis; more for one who cannot hold it",
        "rad",
        0.001,
        1.0,
    )
    movement: bool = field(
        default=False,
        metadata={
            "doc": "half a minute after a pose, learn once from how elbows bend and turn how their sensors sit; "
            "it tells less than a pose that is held well"
        },
    )
    silent_after: float = number_field(0.5, "a sensor that says nothing for longer is silent", "s", 0.05, 60.0)
    stature: float = number_field(1.75, "of the person, until a camera has measured the segments", "m", 0.5, 2.5)
