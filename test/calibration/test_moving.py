"""Moving sums and minima are scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import correlate1d, minimum_filter1d

from body_tracking.calibration import moving


@pytest.mark.parametrize("shape", [(7,), (2, 3), (4, 100)])
def test_windows_are_those_of_scipy(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    values, weights = rng.normal(size=shape), rng.normal(size=5)
    expected = correlate1d(values, weights, axis=-1, mode="nearest")
    assert_allclose(moving.weighted(values, weights), expected, rtol=0.0, atol=1e-12)
    flags = rng.random(shape[-1]) < 0.7
    assert_array_equal(moving.all_in(flags, 5), minimum_filter1d(flags, 5))
