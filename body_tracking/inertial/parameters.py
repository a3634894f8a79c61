"""The parameters of :class:`~body_tracking.inertial.tracking.InertialTracker`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from body_tracking.core.parameters import number_field
from body_tracking.inertial.alignment import Pose

AUTO, T_POSE, ARMS_DOWN = "auto", "t_pose", "arms_down"
OWN, SHARED, REFERENCE = "own", "shared", "reference"
POSES: Final[Mapping[str, Pose]] = {T_POSE: "t", ARMS_DOWN: "n"}
"""Names of poses in parameters, and in ``alignment``."""


def _choice(default: str, doc: str, *choices: str) -> Any:
    return field(default=default, metadata={"doc": doc, "choices": choices})


@dataclass(frozen=True, slots=True)
class TrackingParameters:
    """The settings; each field's metadata has its meaning, unit and range."""

    pose: str = _choice(
        AUTO,
        "pose in which the sensors are aligned with the body: T-pose with palms down, or arms hanging with thumbs "
        "forward; auto: the first of the two that is held for a second",
        AUTO,
        T_POSE,
        ARMS_DOWN,
    )
    camera: bool = field(
        default=True,
        metadata={
            "doc": "estimate headings, slips and clocks from the cameras' skeletons; false: from inertial sensors alone"
        },
    )
    clock: str = _choice(
        OWN,
        "own: each sensor has its own clock; shared: all have the same clock; reference: all have the clock of the "
        "reference sensor",
        OWN,
        SHARED,
        REFERENCE,
    )
    magnetometer: bool = field(default=True, metadata={"doc": "use magnetic fields while they are undisturbed"})
    rate: float = number_field(30.0, "skeletons per second", "Hz", 1.0, 200.0)
    orientation_rate: float = number_field(30.0, "orientations of each segment per second at most", "Hz", 1.0, 1000.0)
    largest_stddev: float = number_field(
        0.6, "publish no orientation with a larger standard deviation about any axis", "rad", 0.01, 2.0
    )
    mounting_stddev: float = number_field(
        0.17, "standard deviation of sensors from their intended mounting, per axis", "rad", 0.001, 2.0
    )
    pose_stddev: float = number_field(
        0.105,
        "standard deviation of the person's joint angles from the ideal pose, per axis; larger for a person who "
        "cannot hold it",
        "rad",
        0.001,
        1.0,
    )
    silent_after: float = number_field(0.5, "a sensor without a reading for longer is silent", "s", 0.05, 60.0)
    stature: float = number_field(
        1.75, "the person's height; used until a camera has measured the segments", "m", 0.5, 2.5
    )
