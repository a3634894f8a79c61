"""One orientation of one segment: invalid ones are refused with a clear text."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from body_tracking.core.orientation import OrientationError, SegmentOrientation

GOOD: dict[str, Any] = {
    "stamp_ns": 1,
    "source": "wrist",
    "segment": "forearm_left",
    "rotation": np.eye(3),
    "covariance": 0.01 * np.eye(3),
    "angular_velocity": np.zeros(3),
    "angular_velocity_variance": 0.01,
}


def test_valid_orientations_are_accepted() -> None:
    assert SegmentOrientation(**GOOD).frame_id == "world"
    assert SegmentOrientation(**GOOD | {"angular_velocity": None, "angular_velocity_variance": 0.0}).stamp_ns == 1


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("segment", "forearm", "segment 'forearm', expected one of pelvis, "),
        ("segment", "forearm_letf", "; did you mean 'forearm_left'?"),
        ("rotation", np.zeros((3, 3)), "rotation is no rotation matrix"),
        ("rotation", 1.001 * np.eye(3), "rotation is no rotation matrix"),
        ("rotation", np.diag([1.0, 1.0, -1.0]), "rotation is no rotation matrix"),
        ("rotation", np.full((3, 3), np.nan), "rotation is not finite"),
        ("rotation", np.eye(4), "rotation of shape (4, 4), expected (3, 3)"),
        ("covariance", np.zeros((3, 3)), "covariance is not positive definite"),
        ("covariance", np.diag([1.0, 1.0, -1.0]), "covariance is not positive definite"),
        ("covariance", np.diag([-1.0, 0.0, 0.0]), "covariance is not "),
        ("covariance", np.diag([1.0, np.inf, 1.0]), "covariance is not finite"),
        ("covariance", np.eye(3) + np.triu(np.ones((3, 3)), 1), "covariance is not symmetric"),
        ("covariance", np.ones(3), "covariance of shape (3,), expected (3, 3)"),
        ("angular_velocity", np.zeros(4), "angular velocity of shape (4,), expected (3,)"),
        ("angular_velocity", np.array([0.0, np.nan, 0.0]), "angular velocity "),
        ("angular_velocity", np.array([0.0, 200.0, 0.0]), "expected at most 70"),
        ("angular_velocity_variance", 0.0, "variance of the angular velocity of 0.0"),
        ("angular_velocity_variance", np.nan, "variance of the angular velocity of nan"),
    ],
)
def test_invalid_orientations_are_refused(field: str, value: object, text: str) -> None:
    with pytest.raises(OrientationError) as caught:
        SegmentOrientation(**GOOD | {field: value})
    assert str(caught.value).startswith("orientation by 'wrist' at 1 ns: ")
    assert text in str(caught.value) and "\n" not in str(caught.value)
