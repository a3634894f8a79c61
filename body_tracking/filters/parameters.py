"""The settings of the linear filters, and what all filters' settings share."""

from __future__ import annotations

from dataclasses import dataclass, field

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.kinematics.motion import ACCELERATION_DENSITIES

T_POSE = (
    "estimate the sensors' offsets of the joint centres from a T-pose that is held still for a second, and subtract "
    "them, so that straight arms are straight; only for skeletons with covariances"
)
"""Description of the parameter of this name, for all filters that have it."""


class FilterError(BodyTrackingError):
    """Raised for an unknown filter or invalid parameters."""


@dataclass(frozen=True, slots=True)
class LinearKalmanParameters:
    """The settings of both linear filters; each field's metadata has its meaning, unit and range.

    Raises:
        FilterError: a value out of its range.
    """

    acceleration_density_trunk: float = number_field(
        ACCELERATION_DENSITIES[0],
        "constant velocity: spectral density of the acceleration of spine, head, shoulders, hips, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    acceleration_density_limb: float = number_field(
        ACCELERATION_DENSITIES[1],
        "constant velocity: spectral density of the acceleration of elbows and knees, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    acceleration_density_extremity: float = number_field(
        ACCELERATION_DENSITIES[2],
        "constant velocity: spectral density of the acceleration of wrists, hands, ankles, feet, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    velocity_density_trunk: float = number_field(
        0.02,
        "zero velocity: spectral density of the velocity of spine, head, shoulders, hips, per axis",
        "m2/s",
        1e-8,
        1e3,
    )
    velocity_density_limb: float = number_field(
        0.06, "zero velocity: spectral density of the velocity of elbows and knees, per axis", "m2/s", 1e-8, 1e3
    )
    velocity_density_extremity: float = number_field(
        0.2,
        "zero velocity: spectral density of the velocity of wrists, hands, ankles, feet, per axis",
        "m2/s",
        1e-8,
        1e3,
    )
    measurement_noise_scale: float = number_field(
        1.0,
        "for skeletons without covariance: factor on each joint's standard deviation, which follows from tracking "
        "state and distance (body_tracking.core.measurement)",
        "",
        0.01,
        100.0,
    )
    white_noise_share: float = number_field(
        0.06,
        "share of the measurement variance that is white, and is filtered; the rest is a slow error that no "
        "filter can remove, and is added to the output covariance",
        "",
        0.001,
        1.0,
    )
    adaptation: float = number_field(
        0.5,
        "increase of the logarithm of a joint's process noise per normalised innovation squared beyond four "
        "times its expectation; 0 keeps the noise constant",
        "",
        0.0,
        10.0,
    )
    adaptation_time: float = number_field(
        0.1, "time constant of the decay of this increase: the duration of a sudden movement", "s", 0.001, 100.0
    )
    initial_velocity_stddev: float = number_field(
        1.0, "standard deviation per axis of the velocity of a joint when it is first seen", "m/s", 1e-3, 100.0
    )
    gate_probability: float = number_field(
        0.9999,
        "a measurement is rejected where its innovation lies beyond this chi-square quantile (3 degrees of "
        "freedom); 1 rejects nothing",
        "",
        0.5,
        1.0,
    )
    reacquire_after: float = number_field(
        0.12,
        "a joint rejected for longer than this restarts at its measurement, and for about as long its deviation "
        "includes the jump; much later the grown variance would accept it as a sudden movement, and overshoot",
        "s",
        0.0,
        60.0,
    )
    predict_for: float = number_field(
        0.5, "a joint without an accepted measurement for longer than this is lost: not tracked, NaN", "s", 0.0, 60.0
    )
    reset_gap: float = number_field(1.0, "a gap between frames longer than this restarts every joint", "s", 0.01, 600.0)

    reorder_window: float = number_field(
        0.1,
        "a frame older than the last one by no more than this is late and ignored; an older one is a backward "
        "jump of time, which restarts every joint",
        "s",
        0.0,
        10.0,
    )
    t_pose: bool = field(default=True, metadata={"doc": T_POSE})

    def __post_init__(self) -> None:
        check_fields(self, "linear filter", FilterError)
