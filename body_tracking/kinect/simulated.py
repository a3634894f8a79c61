"""Parameters of the errors of a simulated Kinect v2 (``simulated_sensor``), read from ``config/simulator.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import (
    Parameter,
    ParameterError,
    as_yaml,
    check_all,
    check_fields,
    number_field,
    parameters_from,
    read_file,
)

SECTION: Final = "simulated_kinect"
"""Section of a parameters file with these parameters."""


class SimulatedKinectError(BodyTrackingError):
    """Raised for a parameter out of its range, or a file without these parameters."""


@dataclass(frozen=True, slots=True)
class KinectErrors:
    """Parameters of the errors of a simulated Kinect v2; the fields' metadata have units and ranges.

    Lengths hold for a joint of the trunk of a person who faces the sensor at 2 m; ``simulated_joints`` has the
    multiples for the other joints.

    Raises:
        SimulatedKinectError: a value out of its range.
    """

    white: float = number_field(0.00015, "standard deviation of the white noise, across the ray", "m", 0.0, 0.1)
    bias: float = number_field(0.007, "standard deviation of the error of pose and view, across the ray", "m", 0.0, 0.2)
    bias_turn: float = number_field(
        0.8, "turn of a limb or of the view after which that error is another one", "rad", 0.05, 10.0
    )
    drift: float = number_field(0.003, "standard deviation of the error that wanders with time", "m", 0.0, 0.2)
    drift_time: float = number_field(1.0, "time for which it persists", "s", 0.02, 100.0)
    length_spread: float = number_field(
        0.035, "standard deviation of the length of a limb or of the trunk", "1", 0.0, 0.5
    )
    anatomical: float = number_field(
        1.0, "share of the common offset between reported and anatomical joints", "1", 0.0, 5.0
    )
    offset: float = number_field(0.010, "standard deviation of a person's own offset besides", "m", 0.0, 0.2)
    depth_offset: float = number_field(
        0.018, "root mean square over the joints of their offset along the ray", "m", 0.0, 0.2
    )
    distance_growth: float = number_field(1.5, "power of the distance with which errors grow", "1", 0.0, 4.0)
    growth_60: float = number_field(0.3, "growth of the errors from a yaw of 30 degrees to 60", "1", 0.0, 10.0)
    growth_90: float = number_field(2.2, "growth of the errors from a yaw of 30 degrees to 90", "1", 0.0, 20.0)
    turn_loss: float = number_field(
        0.3, "share of the yaw of shoulders and hips that is missing at 90 deg", "1", 0.0, 1.0
    )
    straightening: float = number_field(
        1.0, "share of the way by which SpineMid is moved to the line from SpineBase to SpineShoulder", "1", 0.0, 1.0
    )
    lift_damping: float = number_field(0.4, "share of a shoulder's lift that is missing", "1", 0.0, 1.0)
    hidden_from: float = number_field(
        0.5, "cover from which a joint is inferred: 0 at a rim, 1 in the middle", "1", 0.01, 1.0
    )
    given_up: float = number_field(0.1, "share of the joints behind a middle that are not tracked", "1", 0.0, 1.0)
    hang_over: float = number_field(0.2, "time constant of hiding, and duration of exchanged limbs", "s", 0.0, 10.0)
    drag: float = number_field(0.35, "pull of a hidden joint towards the surface before it", "1", 0.0, 1.0)
    guess: float = number_field(0.04, "standard deviation of a hidden joint, across the ray", "m", 0.0, 0.5)
    mislabelled: float = number_field(0.3, "share of the hidden joints that are said to be tracked", "1", 0.0, 1.0)
    flicker: float = number_field(
        0.01, "share of the frames in which a visible hand or foot is inferred", "1", 0.0, 1.0
    )
    mirrored: float = number_field(1.0, "share of the turns of the back that are taken for the front", "1", 0.0, 1.0)
    mirror_hysteresis: float = number_field(
        1.1, "turn beyond the side view after which left and right swap", "rad", 0.0, 1.5
    )
    mirror_rate: float = number_field(0.04, "rate of swaps of left and right in a side view", "1/s", 0.0, 10.0)
    mirror_time: float = number_field(1.3, "mean duration of such a swap", "s", 0.01, 60.0)
    limb_swap_rate: float = number_field(0.003, "how often the arms, or the legs, are exchanged", "1/s", 0.0, 10.0)
    outlier_rate: float = number_field(0.01, "how often a joint jumps away for a few frames", "1/s", 0.0, 10.0)
    outlier_size: float = number_field(0.2, "how far, on average", "m", 0.0, 2.0)
    jitter: float = number_field(0.0002, "standard deviation of the instant of a capture", "s", 0.0, 0.01)
    lost: float = number_field(0.09, "share of the frames that are lost", "1", 0.0, 0.9)
    stall_rate: float = number_field(
        0.03, "rate of stalls, which lose their frames or, as often, delay them", "1/s", 0.0, 10.0
    )
    stall_time: float = number_field(0.25, "for how long, on average", "s", 0.0, 10.0)
    delay: float = number_field(0.022, "time from capture to receipt, at least", "s", 0.0, 10.0)
    delay_jitter: float = number_field(0.003, "time added to it on average", "s", 0.0, 1.0)

    def __post_init__(self) -> None:
        check_fields(self, "simulated Kinect", SimulatedKinectError)

    def offsets_alone(self) -> KinectErrors:
        """Only the constant offsets from the anatomical joint centres."""
        return replace(self.none(), anatomical=self.anatomical, offset=self.offset)

    @classmethod
    def none(cls) -> KinectErrors:
        """No errors of position or time; hidden joints are still inferred or not tracked."""
        return cls(**{item.name: 0.0 for item in parameters() if item.min == 0.0})

    def scaled(self, factor: float, names: tuple[str, ...] | None = None) -> KinectErrors:
        """All parameters, or those named, times the factor, clipped to their ranges."""
        changes = {
            item.name: float(np.clip(factor * getattr(self, item.name), item.min, item.max))
            for item in parameters()
            if names is None or item.name in names
        }
        return replace(self, **changes)


def parameters() -> tuple[Parameter, ...]:
    return parameters_from(KinectErrors)


def read_errors(path: Path) -> KinectErrors:
    """Errors from the section ``simulated_kinect`` of a parameters file, with defaults for missing parameters.

    Raises:
        SimulatedKinectError: no such file or section, an unknown name, a value out of its range.
    """
    try:
        sections = read_file(path)
        given = sections.get(SECTION, sections.get(f"/{SECTION}"))
        if given is None:
            found = ", ".join(name.strip("/") for name in sections) or "none"
            raise ParameterError(f"{path}: no section {SECTION}; found: {found}")
        values = check_all(parameters(), given)
    except ParameterError as error:
        raise SimulatedKinectError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    return KinectErrors(**{name: float(value) for name, value in values.items() if isinstance(value, int | float)})


def errors_as_yaml(errors: KinectErrors | None = None) -> str:
    """A commented parameters file of these errors, or of the defaults."""
    values = errors or KinectErrors()
    return as_yaml({SECTION: [replace(item, default=getattr(values, item.name)) for item in parameters()]})
