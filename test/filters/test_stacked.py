"""A stack of matrices obeys, matrix by matrix, the rules of one."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from body_tracking.filters.stacked import Stacked

RNG = np.random.default_rng(7)


def test_dot_multiplies_each_matrix_with_its_partner() -> None:
    a, b = RNG.normal(size=(5, 3, 6)), RNG.normal(size=(5, 6, 2))
    product = np.dot(Stacked.of(a), Stacked.of(b))
    assert isinstance(product, Stacked)
    for one, left, right in zip(product, a, b, strict=True):
        assert_array_equal(one, left @ right)


def test_a_shared_matrix_meets_every_matrix_of_the_stack() -> None:
    shared, stack = RNG.normal(size=(6, 6)), RNG.normal(size=(5, 6, 6))
    assert_array_equal(np.dot(shared, Stacked.of(stack)), np.matmul(shared, stack))


def test_transpose_leaves_the_stack_in_order() -> None:
    stack = RNG.normal(size=(5, 3, 6))
    assert_array_equal(np.asarray(Stacked.of(stack).T), np.stack([one.T for one in stack]))


def test_the_inverse_stays_a_stack() -> None:
    stack = RNG.normal(size=(5, 3, 3)) + 5.0 * np.eye(3)
    inverse = np.linalg.inv(Stacked.of(stack))
    assert isinstance(inverse, Stacked)
    np.testing.assert_allclose(
        np.asarray(np.dot(inverse, Stacked.of(stack))), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-12
    )
