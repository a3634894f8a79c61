"""Access to the extended filter's estimate, and comparison of two estimates, for its tests."""

from __future__ import annotations

from numpy.testing import assert_allclose

from body_tracking.core.estimate import ModelEstimate
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter


def known(estimator: ExtendedKalmanFilter) -> ModelEstimate:
    estimate = estimator.estimate
    assert estimate is not None
    return estimate


def assert_same(one: ModelEstimate, other: ModelEstimate, tolerance: float) -> None:
    assert one.stamp_ns == other.stamp_ns
    for name in ("q", "velocity", "covariance", "lengths", "lengths_stddev"):
        assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=tolerance, err_msg=name)
