"""Soft ranges of motion: no push inside, and the right derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.ranges import RANGES, SHOULDER_SWING, SHOULDER_TWIST, Ranges
from body_tracking.kinematics.upper_body import UpperBody

MODEL = UpperBody()
RANGE = Ranges(MODEL)
NAMES = MODEL.coordinate_names[6:]


def _poses(count: int, scale: float, seed: int = 3) -> FloatArray:
    """(count, 35) with every angle up to ``scale`` of the way from its centre to its bounds, shoulders about theirs."""
    rng = np.random.default_rng(seed)
    values = RANGE.centre + scale * rng.uniform(-1, 1, size=(count, 26)) * (RANGE.high - RANGE.centre)
    v = np.zeros((count, MODEL.nv))
    v[:, 6:] = values
    q = MODEL.integrate(MODEL.neutral(), v)
    for side in ("left", "right"):
        # the arm straight to the middle of its reach without turning about itself, then moved
        rows = [NAMES.index(f"shoulder_{axis}_{side}") for axis in "xyz"]
        y = 1.0 if side == "left" else -1.0
        reach = np.array([1.0, y, 0.0]) / np.sqrt(2.0)
        swing = values[:, rows] * [1 / np.sqrt(2.0), 1 / np.sqrt(2.0), 1.0]
        centre = so3.exp(0.5 * np.pi * np.cross([0.0, 0.0, -1.0], reach))
        q[:, MODEL.quaternion_of(f"upper_arm_{side}")] = so3.quat_multiply(centre, so3.exp(swing))
    return q


def test_every_angle_has_a_range_around_its_zero_and_both_sides_the_same() -> None:
    assert (RANGE.low < RANGE.high).all()
    for name, low, high in zip(NAMES, RANGE.low, RANGE.high, strict=True):
        if name.startswith("shoulder"):
            continue
        assert low < 0.0 < high
        np.testing.assert_allclose(np.degrees([low, high]), RANGES[name.removesuffix("_left").removesuffix("_right")])


def test_the_prior_of_a_range_has_its_limits_at_three_standard_deviations() -> None:
    np.testing.assert_allclose(RANGE.centre + 3.0 * RANGE.stddev, RANGE.high)
    np.testing.assert_allclose(RANGE.centre - 3.0 * RANGE.stddev, RANGE.low)


def test_soft_coordinates_gradient_against_differences() -> None:
    q = _poses(40, 0.95)
    step = 1e-6
    v = np.zeros((26, MODEL.nv))
    v[:, 6:] = step * np.eye(26)
    plus = RANGE.soft_coordinates(MODEL.integrate(q[:, None], v)).values
    minus = RANGE.soft_coordinates(MODEL.integrate(q[:, None], -v)).values
    numeric = np.moveaxis((plus - minus) / (2 * step), 1, -1)
    np.testing.assert_allclose(RANGE.soft_coordinates(q).gradients, numeric, rtol=0, atol=1e-7)


def test_nothing_pushes_inside() -> None:
    np.testing.assert_array_equal(RANGE.excess(_poses(500, 1.0 - 1e-9)), 0.0)


def test_usual_poses_are_inside() -> None:
    """Arms hanging, to the sides, forwards, up, and a hand on the other shoulder."""
    for pitch, roll in ((0, 0), (0, 90), (90, 0), (175, 0), (0, 170), (-50, 0), (90, -30)):
        q = MODEL.neutral()
        for side, sign in (("left", 1.0), ("right", -1.0)):
            flexion = so3.exp(np.radians(pitch) * np.array([0.0, -1.0, 0.0]))
            abduction = so3.exp(np.radians(roll) * np.array([sign, 0.0, 0.0]))
            q[MODEL.quaternion_of(f"upper_arm_{side}")] = so3.quat_multiply(flexion, abduction)
        assert np.degrees(np.abs(RANGE.excess(q)).max()) < 1e-9, (pitch, roll)


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("shoulder")])
def test_the_excess_is_how_far_an_angle_is_outside(name: str) -> None:
    number = NAMES.index(name)
    for bound, sign in ((RANGE.high, 1.0), (RANGE.low, -1.0)):
        v = np.zeros(MODEL.nv)
        v[6 + number] = bound[number] + sign * 0.1
        excess = RANGE.excess(MODEL.integrate(MODEL.neutral(), v))
        expected = np.zeros(26)
        expected[number] = sign * 0.1
        np.testing.assert_allclose(excess, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_shoulder_leaves_its_cone_as_a_whole(side: str) -> None:
    rows = [NAMES.index(f"shoulder_{axis}_{side}") for axis in "xyz"]
    centre = _poses(1, 0.0)[0]
    for direction in np.random.default_rng(2).normal(size=(20, 2)):
        v = np.zeros(MODEL.nv)
        unit = direction / np.linalg.norm(direction)
        v[6 + np.array(rows[:2])] = np.radians(SHOULDER_SWING + 10.0) * unit
        excess = RANGE.excess(MODEL.integrate(centre, v))[rows]
        np.testing.assert_allclose(excess, [*np.radians(10.0) * unit, 0.0], rtol=0, atol=1e-12)
    v = np.zeros(MODEL.nv)
    v[6 + rows[2]] = -np.radians(SHOULDER_TWIST + 10.0)
    np.testing.assert_allclose(RANGE.excess(MODEL.integrate(centre, v))[rows], [0, 0, -np.radians(10.0)], atol=1e-12)


def test_soft_coordinates_of_both_sides_mirror_each_other() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        turn = rng.normal(size=3)
        q = MODEL.neutral()
        q[MODEL.quaternion_of("upper_arm_left")] = so3.exp(turn)
        q[MODEL.quaternion_of("upper_arm_right")] = so3.exp(turn * [-1.0, 1.0, -1.0])
        values = RANGE.soft_coordinates(q).values
        left, right = (values[[NAMES.index(f"shoulder_{a}_{side}") for a in "xyz"]] for side in ("left", "right"))
        np.testing.assert_allclose(right, left * [-1.0, 1.0, -1.0], rtol=0, atol=1e-12)


def test_many_at_once_are_each_alone() -> None:
    q = _poses(6, 1.5).reshape(2, 3, -1)
    together, excess = RANGE.soft_coordinates(q), RANGE.excess(q)
    for index in np.ndindex(2, 3):
        alone = RANGE.soft_coordinates(q[index])
        np.testing.assert_allclose(together.values[index], alone.values, rtol=0, atol=1e-14)
        np.testing.assert_allclose(together.gradients[index], alone.gradients, rtol=0, atol=1e-14)
        np.testing.assert_allclose(excess[index], RANGE.excess(q[index]), rtol=0, atol=1e-14)
