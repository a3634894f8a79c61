"""Simulated orientation and covariance by the driver of an inertial sensor."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.inertial.simulated_errors import STANDARD_GRAVITY, ImuErrors
from body_tracking.inertial.surroundings import Surroundings

Z: Final = np.array([0.0, 0.0, 1.0])


def fuse(
    errors: ImuErrors,
    rate_hz: float,
    times: FloatArray,
    drift: FloatArray,
    force: FloatArray,
    magnetic: FloatArray | None,
    where: Surroundings,
    heading: float,
) -> FloatArray:
    """(n, 4) quaternions from the true orientation in world to the reported one.

    To first order the error e, a rotation vector in world, of a complementary filter (Mahony 2008) is
    ``e' = u - (e - e_ref) / tau``, with the errors u of the angular rate and the reference e_ref by acceleration and
    magnetic field.

    Args:
        errors: of the sensor.
        rate_hz: samples per second.
        times: (n,) seconds.
        drift: (n, 3) rad/s, errors of the angular rate in world.
        force: (n, 3) m/s2, the measured specific force, rotated to world by the true orientation.
        magnetic: (n, 3) tesla likewise, or None.
        where: for the direction of magnetic north.
        heading: radians, initial heading of a driver without magnetometer.
    """
    steps = np.diff(times, prepend=times[:1])
    moved = drift * steps[:, None]
    # the rotation of the force to the vertical: e x f = g z - f
    level = np.stack([force[:, 1], -force[:, 0]], axis=-1) / STANDARD_GRAVITY
    fades = np.exp(-1.0 / (rate_hz * errors.tilt_time))
    tilt = _low_pass((1.0 - fades) * level + moved[:, :2], fades, level[0])
    tilted = so3.exp(np.concatenate([tilt, np.zeros((len(tilt), 1))], axis=1))
    turned = np.cumsum(moved[:, 2])
    if magnetic is None:
        turned += heading
    else:
        # relative to the heading by the gyroscope, as unit complex numbers without a jump at half a turn
        seen = rotate(so3.quat_to_matrix(tilted), magnetic)
        north = (seen[:, 0] + 1j * seen[:, 1]) * np.exp(-1j * where.north)
        to_north = np.exp(-1j * (np.angle(north) + turned))
        fades = np.exp(-1.0 / (rate_hz * errors.heading_time))
        turned = turned + np.angle(_low_pass((1.0 - fades) * to_north, fades, to_north[0]))
    # world to east-north-up
    turned = turned + 0.5 * np.pi - where.north
    return so3.quat_multiply(so3.exp(turned[:, None] * Z), tilted)


def stated_covariance(
    errors: ImuErrors, magnetometer: bool, times: FloatArray, rotations: FloatArray, rates: FloatArray
) -> FloatArray:
    """(n, 3, 3) rad2: the driver's stated covariance.

    Constants of the data sheet; without magnetometer also the variance of the heading's drift by noise, biases and
    scales (each of known deviation) over the motion since the start.
    """
    tilt, heading = np.radians([errors.stated_tilt, errors.stated_heading]) ** 2
    variance = np.full(len(times), heading)
    if not magnetometer:
        since, correlated = times - times[0], errors.instability_time
        up = rotations[:, 2]
        noise, left, in_run = np.radians([errors.gyro_noise, errors.driver_bias, errors.gyro_instability]) ** 2
        variance += noise * since
        variance += left * (cumulative_trapezoid(up, times, axis=0, initial=0.0) ** 2).sum(axis=1)
        variance += 2.0 * in_run * correlated * (since + correlated * np.expm1(-since / correlated))
        swept = cumulative_trapezoid(up[:, :, None] * rates[:, None, :], times, axis=0, initial=0.0)
        scales = np.where(np.eye(3, dtype=bool), errors.gyro_scale, errors.gyro_axes) ** 2
        variance += (scales * swept**2).sum(axis=(1, 2))
    covariance = np.zeros((len(times), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = tilt
    covariance[:, 2, 2] = variance
    return covariance


def rotate(rotations: FloatArray, vectors: FloatArray) -> FloatArray:
    """(n, 3) vectors rotated by (n, 3, 3)."""
    result: FloatArray = (rotations @ vectors[..., None])[..., 0]
    return result


def _low_pass(values: NDArray[Any], fades: float, first: Any) -> NDArray[Any]:
    """x[k] = fades x[k-1] + values[k] along the first axis, real or complex, with x[0] = first."""
    driven = np.concatenate([np.asarray(first)[None], values[1:]])
    result: NDArray[Any] = lfilter([1.0], [1.0, -fades], driven, axis=0)
    return result
