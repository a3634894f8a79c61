"""The thesis's weights: by its text and by its formula."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

from body_tracking.fusion.weights import thesis_formula, thesis_text

STATES = arrays(np.uint8, st.tuples(st.integers(1, 5), st.just(25)), elements=st.integers(0, 2))


@pytest.mark.parametrize(
    ("states", "text", "formula"),
    [
        ((2, 2), (0.5, 0.5), (0.5, 0.5)),
        ((1, 1), (0.5, 0.5), (0.5, 0.5)),
        ((2, 1), (1.0, 0.0), (2 / 3, 1 / 3)),
        ((2, 0), (1.0, 0.0), (1.0, 0.0)),
        ((0, 1), (0.0, 1.0), (0.0, 1.0)),
        ((0, 0), (0.0, 0.0), (0.0, 0.0)),
    ],
)
def test_two_sensors(states: tuple[int, int], text: tuple[float, float], formula: tuple[float, float]) -> None:
    both = np.repeat(np.array(states)[:, None], 25, axis=1)
    assert_allclose(thesis_text(both)[:, 0], text)
    assert_allclose(thesis_formula(both)[:, 0], formula)


@given(STATES)
def test_weights_sum_to_one_where_any_sensor_has_the_joint(states: np.ndarray) -> None:
    for weigh in (thesis_text, thesis_formula):
        weights = weigh(states)
        assert (weights >= 0.0).all()
        assert_allclose(weights.sum(axis=0), states.any(axis=0).astype(float))
        assert (weights[states == 0] == 0.0).all()
