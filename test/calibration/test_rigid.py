"""The registration recovers a rigid motion, and never returns a reflection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from body_tracking.calibration.rigid import CalibrationError, rigid_registration
from walkers import performed


@given(st.integers(0, 2**32 - 1))
def test_recovers_any_rigid_motion(seed: int) -> None:
    """Points without weight do not count."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(12, 3))
    rotation, translation = Rotation.random(None, rng).as_matrix(), rng.normal(size=3)
    target, weights = source @ rotation.T + translation, rng.uniform(0.1, 1.0, 12)
    target[0] += 100.0
    weights[0] = 0.0
    found, moved = rigid_registration(target, source, weights)
    assert_allclose(found, rotation, atol=1e-9)
    assert_allclose(moved, translation, atol=1e-9)


def test_a_noisy_t_pose_is_never_reflected() -> None:
    """Without the determinant check 0.6-18 % of T-poses with 20-40 mm noise come out mirrored."""
    rng = np.random.default_rng(1)
    pose = performed("two_handed_wave", np.array([1.0]))[0]
    pose = (pose - pose.mean(axis=0)) * [0.3, 1.0, 1.0]
    reflected = 0
    for _ in range(500):
        source, target = (pose + rng.normal(scale=0.03, size=pose.shape) for _ in range(2))
        rotation, _ = rigid_registration(target, source)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert Rotation.from_matrix(rotation).magnitude() < 0.3
        u, _, vt = np.linalg.svd((target - target.mean(0)).T @ (source - source.mean(0)))
        reflected += np.linalg.det(u @ vt) < 0.0
    assert reflected > 0  # the case occurs in this sample


@pytest.mark.parametrize("points", [np.zeros((2, 3)), np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), np.ones((5, 3))])
def test_too_few_or_collinear_points_are_refused(points: np.ndarray) -> None:
    with pytest.raises(CalibrationError, match="points"):
        rigid_registration(points, points)
