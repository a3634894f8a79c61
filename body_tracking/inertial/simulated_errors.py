"""Errors of simulated inertial sensors, and sets of them for known devices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import check_fields, number_field

STANDARD_GRAVITY: Final = 9.80665


class ImuSimulationError(BodyTrackingError):
    """Raised for parameters or segments that a simulated inertial sensor cannot have."""


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """Errors of an inertial sensor; each field's metadata has its meaning, unit and range.

    Noise densities are those of IEEE Std 952 (Allan deviation N / sqrt(tau), N sqrt(rate) per sample). Constant errors
    are drawn per axis for each recording, biases at each switching on. The defaults are :data:`CONSUMER`.

    Raises:
        ImuSimulationError: a value out of its range.
    """

    gyro_noise: float = number_field(0.01, "noise density of the angular rate", "deg/s/sqrt(Hz)", 0.0, 1.0)
    gyro_bias: float = number_field(0.3, "stddev of the turn-on bias of the angular rate", "deg/s", 0.0, 20.0)
    gyro_instability: float = number_field(0.006, "stddev of the in-run bias of the angular rate", "deg/s", 0.0, 5.0)
    gyro_scale: float = number_field(0.01, "stddev of the scale of the angular rate", "1", 0.0, 0.2)
    gyro_axes: float = number_field(0.005, "stddev of each cross-axis sensitivity of the angular rate", "1", 0.0, 0.2)
    gyro_range: float = number_field(
        2000.0, "greatest angular rate, of 16 bits; inf: unlimited, exact", "deg/s", 1.0, np.inf
    )
    acc_noise: float = number_field(0.003, "noise density of the acceleration", "m/s2/sqrt(Hz)", 0.0, 1.0)
    acc_bias: float = number_field(0.1, "stddev of the turn-on bias of the acceleration", "m/s2", 0.0, 5.0)
    acc_instability: float = number_field(0.003, "stddev of the in-run bias of the acceleration", "m/s2", 0.0, 1.0)
    acc_scale: float = number_field(0.005, "stddev of the scale of the acceleration", "1", 0.0, 0.2)
    acc_axes: float = number_field(0.005, "stddev of each cross-axis sensitivity of the acceleration", "1", 0.0, 0.2)
    acc_range: float = number_field(
        16.0 * STANDARD_GRAVITY,
        "greatest acceleration, of 16 bits; inf: unlimited, exact",
        "m/s2",
        1.0,
        np.inf,
    )
    mag_noise: float = number_field(0.05, "noise density of the magnetic field", "uT/sqrt(Hz)", 0.0, 10.0)
    mag_bias: float = number_field(1.0, "stddev of hard iron after calibration", "uT", 0.0, 100.0)
    mag_scale: float = number_field(0.01, "stddev of scale and cross-axis sensitivities of the field", "1", 0.0, 0.5)
    mag_range: float = number_field(4912.0, "greatest field, of 16 bits; inf: unlimited, exact", "uT", 50.0, np.inf)
    instability_time: float = number_field(300.0, "correlation time of the in-run biases", "s", 1.0, 1e5)

    tilt_time: float = number_field(3.0, "time constant of the driver's levelling", "s", 0.01, 1e3)
    heading_time: float = number_field(9.0, "time constant of the driver's heading", "s", 0.01, 1e4)
    driver_bias: float = number_field(
        0.03, "stddev of the turn-on bias after the driver's own estimate", "deg/s", 0.0, 5.0
    )
    stated_tilt: float = number_field(1.5, "stddev of the tilt that the driver states", "deg", 0.0, 90.0)
    stated_heading: float = number_field(
        4.0, "stddev of the heading that the driver states, besides drift", "deg", 0.0, 180.0
    )

    misalignment: float = number_field(5.0, "stddev of the mounting's rotation per axis", "deg", 0.0, 90.0)
    tissue_sag: float = number_field(
        0.003, "static displacement over soft tissue by the sensor's weight; 0: bone", "m", 0.0, 0.02
    )
    tissue_frequency: float = number_field(8.0, "natural frequency of the sensor on soft tissue", "Hz", 1.0, 12.0)
    tissue_damping: float = number_field(0.25, "damping ratio of the sensor on soft tissue", "1", 0.01, 2.0)
    tissue_turn: float = number_field(
        15.0, "rotation of the sensor per displacement: one over the radius of the limb", "rad/m", 0.0, 100.0
    )
    twist_share: float = number_field(0.2, "share of a segment's twist that the skin does not follow", "1", 0.0, 1.0)

    jitter: float = number_field(0.0002, "stddev of the instants of sampling", "s", 0.0, 0.1)
    stamp_jitter: float = number_field(0.0005, "stddev of the stamps about these instants", "s", 0.0, 0.1)
    packet: int = field(
        default=2, metadata={"doc": "samples sent together, lost together", "unit": "1", "min": 1, "max": 100}
    )
    lost: float = number_field(0.005, "probability that a packet is lost", "1", 0.0, 1.0)
    outages: float = number_field(0.2, "outages of the radio", "1/min", 0.0, 60.0)
    outage_time: float = number_field(0.5, "mean duration of an outage", "s", 0.0, 60.0)
    delay: float = number_field(0.015, "least time from sampling to receipt", "s", 0.0, 10.0)
    delay_jitter: float = number_field(0.005, "mean of the additional random delay", "s", 0.0, 10.0)

    def __post_init__(self) -> None:
        check_fields(self, "IMU errors", ImuSimulationError)


CONSUMER: Final = ImuErrors()
"""A chip like the MPU-9250 on a strap, over Bluetooth.

Data sheet PS-MPU-9250A-01: 0.01 deg/s and 300 ug per root hertz, ranges; 3 % scale and 2 % cross-axis tolerance are
taken as three standard deviations and less, for a sensor that was calibrated once. Turn-on biases are those by a change
of temperature of 1 to 7 K since the calibration (0.24 deg/s and 1.5 mg per kelvin).
"""
