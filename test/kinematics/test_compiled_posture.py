"""Compiled ranges are those of the arrays, and the derivatives of the priors those of differences."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.compiled_posture import excess_of, prior_rows, prior_table, soft_values
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges

MODEL = CompiledUpperBody()
RANGES = Ranges(MODEL)
TABLE = prior_table(MODEL, RANGES, PosturePrior(MODEL, RANGES))
LENGTHS = MODEL.default_lengths()


def poses(spread: float) -> list[FloatArray]:
    rng = np.random.default_rng(4)
    return [MODEL.integrate(MODEL.neutral(), spread * rng.normal(size=MODEL.nv)) for _ in range(20)]


def rows_at(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    lines = MODEL.linearised(q, LENGTHS)
    return prior_rows(q, lines.posture.rotations[0], lines.rotation_jacobian[0], TABLE)


def test_derivatives_of_the_priors_are_those_of_differences() -> None:
    step = 1e-5
    for q in poses(0.5):
        numeric = [
            (rows_at(MODEL.integrate(q, v))[1] - rows_at(MODEL.integrate(q, -v))[1]) / (2.0 * step)
            for v in step * np.eye(MODEL.nv)
        ]
        assert_allclose(rows_at(q)[2].T, numeric, rtol=0, atol=1e-8)


def test_coordinates_and_their_excess_are_those_of_the_ranges() -> None:
    for q in poses(1.2):
        values = soft_values(q, TABLE)
        assert_allclose(values, RANGES.values(q), rtol=0, atol=1e-12)
        assert_allclose(rows_at(q)[0], values, rtol=0, atol=0)
        assert_allclose(excess_of(values, TABLE), RANGES.excess(q), rtol=0, atol=1e-12)
