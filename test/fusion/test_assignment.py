"""The assignment of bodies to people at the least cost."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linear_sum_assignment

from body_tracking.fusion.assignment import least_cost_assignment
from draws import draws
from patience import PATIENCE


@pytest.mark.parametrize("seed", range(draws(40, 2000)))
def test_the_sum_is_the_least(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.normal(0.0, 3.0, rng.integers(1, 9, 2))
    costs[rng.random(costs.shape) < 0.3] = 1e6  # impossible pairs
    if seed % 4 == 0:
        costs = np.round(costs)  # with ties
    rows, columns = least_cost_assignment(costs)
    expected = costs[linear_sum_assignment(costs)]
    assert len(rows) == len(set(columns.tolist())) == min(costs.shape)
    assert (np.diff(rows) > 0).all()
    assert_allclose(costs[rows, columns].sum(), expected.sum(), rtol=1e-12)


def test_fusion_starts_without_scipy() -> None:
    """Scipy takes as long to import as all the rest of the node."""
    code = "import sys, body_tracking.fusion.stage; assert 'scipy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE)
