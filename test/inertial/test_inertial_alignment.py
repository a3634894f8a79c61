"""Poses and movements align sensors: exactly without errors, and within the stated deviations with errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from body_tracking.core import so3
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.inertial.alignment import (
    Alignment,
    AlignmentError,
    Stream,
    align_in_pose,
    pose_covariance,
    pose_of,
    pose_rotations,
    still_periods,
    yaw,
)
from body_tracking.kinematics.upper_body import UpperBody
from draws import draws

MODEL = UpperBody()
WORN = ("pelvis", "upper_trunk", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")
NUMBERS = [MODEL.segment_names.index(name) for name in WORN]
SEEDS = st.integers(0, 2**32 - 1)


def random_rotations(rng: np.random.Generator, count: int, size: float = 2.0) -> FloatArray:
    return so3.quat_to_matrix(so3.exp(size * rng.normal(size=(count, 3))))


def worn(rng: np.random.Generator, pose: FloatArray, covariance: FloatArray, mounting: float) -> tuple[FloatArray, ...]:
    """Intended and true mountings, headings, and measurements of people whose pose errs by a covariance."""
    k = len(pose)
    meant = random_rotations(rng, k)
    true = meant @ random_rotations(rng, k, mounting)
    psi = rng.uniform(-np.pi, np.pi, k)
    off = rng.multivariate_normal(np.zeros(3 * k), covariance).reshape(k, 3)
    held = pose @ so3.quat_to_matrix(so3.exp(off))
    return meant, true, psi, yaw(psi).swapaxes(-1, -2) @ held @ true.swapaxes(-1, -2)


def test_the_poses_are_what_people_call_them() -> None:
    names = MODEL.segment_names
    hanging, t = pose_rotations(MODEL, "n"), pose_rotations(MODEL, "t")
    np.testing.assert_allclose(hanging, np.broadcast_to(np.eye(3), (12, 3, 3)), atol=1e-12)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for part in ("upper_arm", "forearm", "hand"):
            along = t[names.index(f"{part}_{side}")] @ [0.0, 0.0, -1.0]
            np.testing.assert_allclose(along, [0.0, sign, 0.0], atol=1e-12)
            thumb = t[names.index(f"{part}_{side}")] @ [1.0, 0.0, 0.0]
            np.testing.assert_allclose(thumb, [1.0, 0.0, 0.0], atol=1e-12)
    with pytest.raises(AlignmentError, match="expected 't' or 'n'"):
        pose_rotations(MODEL, "x")  # type: ignore[arg-type]


@settings(max_examples=draws(8, 20), deadline=None)
@given(SEEDS, st.sampled_from(["t", "n"]))
def test_a_pose_held_exactly_with_known_mountings_gives_them_back_and_the_headings(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    pose = pose_rotations(MODEL, kind)[NUMBERS]  # type: ignore[arg-type]
    spread = pose_covariance(MODEL, kind, WORN)  # type: ignore[arg-type]
    meant, true, psi, measured = worn(rng, pose, np.zeros_like(spread), 0.0)
    found = align_in_pose(WORN, measured, pose, spread, mountings=meant)
    np.testing.assert_allclose(found.rotations, true, atol=1e-6)
    np.testing.assert_allclose(wrapped(found.headings - psi), 0.0, atol=1e-6)
    for number in range(len(WORN)):
        np.testing.assert_allclose(found.oriented(number, measured[number][None])[0], pose[number], atol=1e-6)


def test_errors_of_alignment_and_heading_agree_with_their_covariance() -> None:
    pose, spread = pose_rotations(MODEL, "t")[NUMBERS], pose_covariance(MODEL, "t", WORN)
    single, together = [], []
    for seed in range(draws(30, 60)):
        rng = np.random.default_rng(seed)
        meant, true, psi, measured = worn(rng, pose, spread, np.radians(10.0))
        found = align_in_pose(WORN, measured, pose, spread, mountings=meant)
        error = np.concatenate(
            [so3.rotation_vectors(found.rotations.swapaxes(-1, -2) @ true), wrapped(psi - found.headings)[:, None]],
            axis=1,
        ).reshape(-1)
        together.append(float(error @ np.linalg.solve(found.covariance, error)))
        single.append(error / found.stddev.reshape(-1))
    inside = float((np.array(together) < chi2.ppf(0.95, 24)).mean())
    assert inside >= 0.85
    assert 0.92 <= float((np.abs(single) < 1.96).mean()) <= 0.98


def test_without_known_mountings_the_pose_is_right_and_the_alignment_up_to_the_heading() -> None:
    rng = np.random.default_rng(2)
    pose, spread = pose_rotations(MODEL, "n")[NUMBERS], pose_covariance(MODEL, "n", WORN)
    _, true, _, measured = worn(rng, pose, np.zeros_like(spread), 0.5)
    found = align_in_pose(WORN, measured, pose, spread)
    for number in range(len(WORN)):
        np.testing.assert_allclose(found.oriented(number, measured[number][None])[0], pose[number], atol=1e-6)
    assert (found.stddev[:, 3] > np.radians(90.0)).all()
    # sensors that share a heading which is known
    measured, k = yaw(-0.7) @ pose @ true.swapaxes(-1, -2), len(WORN)
    known = {"headings": np.full(k, 0.7), "heading_covariance": np.radians(5.0) ** 2 * np.eye(k)}
    np.testing.assert_allclose(align_in_pose(WORN, measured, pose, spread, **known).rotations, true, atol=1e-6)


def stream(segment: str, times: FloatArray, angles: FloatArray, off: float = 0.0) -> Stream:
    """The stream of a segment that turns about x; ``off`` is an error of its rates."""
    rates = np.zeros((len(times), 3))
    rates[:, 0] = np.gradient(angles, times)
    return Stream(segment, times, so3.quat_to_matrix(so3.exp(angles[:, None] * [1.0, 0.0, 0.0])), rates + off)


def test_still_poses_are_found_and_told_apart() -> None:
    times = np.arange(0.0, 12.0, 0.02)
    mounting = np.eye(3)[None]
    # hanging for 4 s, up to the side in 2 s, there for 3 s, and on
    raised = np.interp(times, [0.0, 4.0, 6.0, 9.0, 12.0], [0.0, 0.0, 0.5 * np.pi, 0.5 * np.pi, np.pi])
    arm = stream("upper_arm_left", times, raised, 0.01)
    periods = still_periods([arm])
    assert [pose_of([arm], mounting, each) for each in periods] == ["n", "t"]
    np.testing.assert_allclose([[each.begin, each.end] for each in periods], [[0.0, 4.0], [6.0, 9.0]], atol=0.25)
    assert pose_of([stream("upper_trunk", times, raised)], mounting, periods[0]) is None
    assert still_periods([arm.between(4.2, 5.8)]) == ()


@pytest.mark.parametrize(("sway", "still"), [(2.0, True), (4.0, False)])
def test_who_holds_a_pose_may_sway(sway: float, still: bool) -> None:
    """Degrees to each side, once a second: two make 0.22 rad/s at the fastest."""
    times = np.arange(0.0, 3.0, 0.02)
    swaying = stream("forearm_left", times, np.radians(sway) * np.sin(2.0 * np.pi * times))
    assert bool(still_periods([swaying])) is still


def test_replaced_alignments_are_uncorrelated_with_the_others() -> None:
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(12, 12))
    whole = Alignment(WORN[:3], random_rotations(rng, 3), rng.normal(size=3), spread @ spread.T)
    part = Alignment((WORN[2], WORN[0]), random_rotations(rng, 2), np.array([0.1, 7.0]), 2.0 * np.eye(8))
    found = whole.replaced(part)
    np.testing.assert_array_equal(found.rotations, [part.rotations[1], whole.rotations[1], part.rotations[0]])
    np.testing.assert_allclose(found.headings, [7.0 - 2.0 * np.pi, whole.headings[1], 0.1])
    expected = np.diag(np.repeat([2.0, 0.0, 2.0], 4))
    expected[4:8, 4:8] = whole.covariance[4:8, 4:8]
    np.testing.assert_array_equal(found.covariance, expected)
    with pytest.raises(AlignmentError, match="no sensor on forearm_left"):
        whole.replaced(Alignment(("forearm_left",), part.rotations[:1], part.headings[:1], np.eye(4)))


def test_the_mean_of_rotations_about_one_is_that_one() -> None:
    rng = np.random.default_rng(0)
    middle = random_rotations(rng, 1)[0]
    small = 0.1 * rng.normal(size=(50, 3))
    spread = middle @ so3.quat_to_matrix(so3.exp(np.concatenate([small, -small])))
    np.testing.assert_allclose(so3.mean_rotation(spread), middle, atol=1e-9)


def test_no_readings_are_no_pose_and_an_unknown_segment_is_refused() -> None:
    empty = Stream("forearm_right", np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert still_periods([empty]) == ()
    with pytest.raises(AlignmentError, match="no segment tail"):
        pose_covariance(MODEL, "t", ("tail",))
