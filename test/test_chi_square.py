"""Quantiles of the chi-square distribution are scipy's."""

from __future__ import annotations

import math

import pytest
from scipy.special import chdtrc, chdtri

from body_tracking.core.chi_square import gate, tail


@pytest.mark.parametrize("dimension", [1, 2, 3, 6, 57])
def test_gates_and_tails_are_those_of_scipy(dimension: int) -> None:
    for probability in (1e-12, 1e-4, 0.01, 0.05, 0.5, 0.95):
        assert gate(dimension, probability) == pytest.approx(chdtri(dimension, probability), rel=1e-9, abs=1e-12)
    for value in (0.0, 1e-3, 1.0, 7.8, 200.0):
        assert tail(dimension, value) == pytest.approx(chdtrc(dimension, value), rel=1e-9)


def test_nothing_lies_beyond_the_gate_of_probability_0() -> None:
    assert gate(3, 0.0) == math.inf
