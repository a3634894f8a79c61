"""Compiled priors and inverse kinematics are those of the arrays, and their derivatives those of differences."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.compiled_posture import CompiledInverse, excess_of, prior_rows, prior_table, soft_values
from body_tracking.kinematics.inverse import InverseKinematics
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
        assert_allclose(excess_of(values, TABLE), RANGES.excess_of(values), rtol=0, atol=1e-12)


def test_the_compiled_fit_is_the_fit() -> None:
    rng = np.random.default_rng(5)
    compiled, plain = CompiledInverse(MODEL, RANGES, TABLE), InverseKinematics(MODEL, RANGES)
    stddev = np.full(len(MODEL.joints), 0.02)
    for q in poses(0.3):
        points = MODEL.forward(q, LENGTHS).positions + 0.02 * rng.normal(size=(len(stddev), 3))
        points[rng.integers(len(stddev))] += 0.5  # an outlier, whose influence is bounded
        points[rng.integers(len(stddev))] = np.nan
        one, other = (each.solve(points, stddev, LENGTHS, q) for each in (compiled, plain))
        assert_allclose(one.cost, other.cost, rtol=1e-9)
        assert_allclose(MODEL.difference(one.q, other.q), 0.0, atol=1e-6)
        assert_allclose(one.covariance, other.covariance, rtol=1e-5, atol=1e-9)
