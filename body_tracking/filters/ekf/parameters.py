"""The settings of the extended filter."""

from __future__ import annotations

from dataclasses import dataclass, field

from body_tracking.core import chi_square
from body_tracking.core.measurement import BONE_CORRELATION
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.filters.ekf.sources import OrientationParameters
from body_tracking.filters.parameters import T_POSE, FilterError


@dataclass(frozen=True, slots=True)
class EkfParameters(OrientationParameters):
    """The settings of the extended filter; each field's metadata says what it is, its unit and its range.

    Raises:
        FilterError: a value out of its range.
    """

    velocity_time: float = number_field(
        0.8, "time constant of the decay of velocities without measurements", "s", 0.05, 100.0
    )
    slow_scale: float = number_field(
        0.3,
        "variance of the slow errors of a sensor that states covariances, as a share of these, before it is learnt",
        "1",
        0.0,
        9.0,
    )
    offset_scale: float = number_field(
        1.1,
        "distance of the joints' centres by a sensor that states covariances from the anatomical ones, in standard "
        "deviations of core/measurement.py; only a T-pose measures it, and what it leaves is added to what goes out",
        "1",
        0.0,
        10.0,
    )
    bone_correlation: float = number_field(
        BONE_CORRELATION,
        "correlation of the errors of the two joints of a bone, for the deviations of angles: the default is a "
        "Kinect's; 0 for joints with independent errors, as those of cameras",
        "1",
        0.0,
        0.99,
    )
    slow_time: float = number_field(3.0, "time for which a sensor's slow errors persist", "s", 0.05, 1000.0)
    gate_probability: float = number_field(
        0.9999,
        "a point is rejected where its innovation lies beyond this chi-square quantile (3 degrees of freedom)",
        "1",
        0.5,
        1.0,
    )
    reacquire_after: float = number_field(
        0.12,
        "points rejected without a break for longer than this may start the pose anew, where it fits them; for about "
        "as long the deviations include how far the new pose is from the one before",
        "s",
        0.0,
        60.0,
    )
    settle_time: float = number_field(60.0, "at the latest lengths stay as they are from this time on", "s", 0.1, 1e5)
    late_window: float = number_field(0.2, "frames that come late by no more than this still count", "s", 0.0, 2.0)
    predict_for: float = number_field(
        2.0, "a person without any measurement for longer than this is lost", "s", 0.0, 60.0
    )

    posture: bool = field(
        default=True,
        metadata={"doc": "use a posture prior for what points do not show, such as how the spine shares a bend"},
    )
    t_pose: bool = field(default=True, metadata={"doc": T_POSE})

    def __post_init__(self) -> None:
        check_fields(self, "extended filter", FilterError)

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance (3 degrees of freedom) from which on a measurement is rejected."""
        return chi_square.gate(3, 1.0 - self.gate_probability)
