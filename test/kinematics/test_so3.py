"""Rotations: the laws of the group, and scipy as the second opinion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray

_DIRECTIONS = arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 0.1)
# near 0 and near pi, where formulas divide by small numbers, as well as in between
_ANGLES = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(-12.0, -1.0).map(lambda e: 10.0**e),
    st.floats(-12.0, -1.0).map(lambda e: np.pi - 10.0**e),
)


def _rotation_vector(direction: FloatArray, angle: float) -> FloatArray:
    vector: FloatArray = direction / np.linalg.norm(direction) * angle
    return vector


_VECTORS = st.builds(_rotation_vector, _DIRECTIONS, _ANGLES)


@given(_VECTORS)
def test_exponential_is_scipys(vector: FloatArray) -> None:
    np.testing.assert_allclose(
        so3.quat_to_matrix(so3.exp(vector)), Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=1e-14
    )


@given(_VECTORS)
@example(np.full(3, np.pi / np.sqrt(3.0)))
def test_logarithm_is_the_inverse_of_the_exponential(vector: FloatArray) -> None:
    for found in (so3.log(so3.exp(vector)), so3.log(-so3.exp(vector))):  # the same rotation
        if np.linalg.norm(vector) > np.pi - 1e-14 and found @ vector < 0.0:
            found = -found  # half a turn about an axis is one about its opposite
        np.testing.assert_allclose(found, vector, rtol=0, atol=1e-14)


def test_logarithm_of_a_tiny_rotation_keeps_all_its_digits() -> None:
    vector = np.array([3e-12, -4e-13, 1e-15])
    np.testing.assert_allclose(so3.log(so3.exp(vector)), vector, rtol=1e-12)
    np.testing.assert_array_equal(so3.log(np.array([0.0, 0.0, 0.0, 1.0])), np.zeros(3))


@given(_VECTORS)
@example(np.array([np.pi, 0.0, 0.0]))
@example(np.array([0.0, -np.pi, 0.0]))
@example(np.array([0.0, 0.0, np.pi]))
def test_matrix_and_quaternion_are_the_same_rotation(vector: FloatArray) -> None:
    matrix = Rotation.from_rotvec(vector).as_matrix()
    quat = so3.matrix_to_quat(matrix)
    assert quat[3] >= 0.0
    assert np.linalg.norm(quat) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(so3.quat_to_matrix(quat), matrix, rtol=0, atol=1e-14)


@given(_VECTORS, _VECTORS)
def test_product_turns_by_the_second_first_and_the_inverse_undoes(a: FloatArray, b: FloatArray) -> None:
    one, other = so3.exp(a), so3.exp(b)
    expected = (Rotation.from_rotvec(a) * Rotation.from_rotvec(b)).as_matrix()
    np.testing.assert_allclose(so3.quat_to_matrix(so3.quat_multiply(one, other)), expected, rtol=0, atol=1e-14)
    identity = so3.quat_multiply(so3.quat_inverse(one), one)
    np.testing.assert_allclose(identity, [0.0, 0.0, 0.0, 1.0], rtol=0, atol=1e-15)


@given(_VECTORS, _VECTORS)
def test_skew_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(so3.skew(a) @ b, np.cross(a, b), rtol=0, atol=1e-14)


@given(_DIRECTIONS, st.floats(0.0, 3.1))
def test_right_jacobian_inverse_is_the_derivative_of_the_logarithm(direction: FloatArray, angle: float) -> None:
    vector = _rotation_vector(direction, angle)
    step = 1e-6
    numeric = np.stack(
        [
            (
                so3.log(so3.quat_multiply(so3.exp(vector), so3.exp(step * e)))
                - so3.log(so3.quat_multiply(so3.exp(vector), so3.exp(-step * e)))
            )
            / (2.0 * step)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(so3.right_jacobian_inverse(vector), numeric, rtol=0, atol=2e-8)


@given(_DIRECTIONS, st.floats(0.0, 3.1))
def test_right_jacobian_is_the_inverse_of_its_inverse(direction: FloatArray, angle: float) -> None:
    vector = _rotation_vector(direction, angle)
    product = so3.right_jacobian(vector) @ so3.right_jacobian_inverse(vector)
    np.testing.assert_allclose(product, np.eye(3), rtol=0, atol=1e-9)


def test_right_jacobian_inverse_has_no_step_at_its_series() -> None:
    """On either side of the angle where the series takes over the values agree."""
    direction = np.array([0.6, -0.48, 0.64])
    below, above = (so3.right_jacobian_inverse(direction * 1e-4 * factor) for factor in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(below, above, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "function",
    [so3.exp, so3.log, so3.quat_to_matrix, so3.matrix_to_quat, so3.quat_multiply, so3.skew, so3.right_jacobian_inverse],
)
def test_many_at_once_are_each_alone(function: Callable[..., FloatArray]) -> None:
    vectors = np.random.default_rng(5).normal(size=(2, 4, 6, 3))
    quats = so3.exp(vectors)
    given_ones = {so3.log: quats[:1], so3.quat_to_matrix: quats[:1], so3.quat_multiply: quats}
    given_ones[so3.matrix_to_quat] = so3.quat_to_matrix(quats[:1])
    many = given_ones.get(function, vectors[:1])
    together = function(*many)
    for index in np.ndindex(4, 6):
        alone = function(*(each[index] for each in many))
        np.testing.assert_allclose(together[index], alone, rtol=0, atol=1e-14)
