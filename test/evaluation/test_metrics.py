"""Laws of comparing an estimated movement with the true one."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from body_tracking.core.skeleton import BONES, N_JOINTS, NANOSECONDS, FloatArray, Joint
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.metrics import (
    Curve,
    MetricsError,
    Trajectory,
    align,
    angle_errors,
    find_delay,
    grid,
    jitter,
    joint_errors,
    length_errors,
    off_track,
    pose_errors,
    position_coverage,
)
from body_tracking.evaluation.reading import read_skeletons
from body_tracking.evaluation.segments import segment_frames
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader
from draws import draws

TWIST = Path(__file__).resolve().parents[2] / "bags" / "tpose_torso_twist"
WRIST = Joint.WRIST_LEFT


@cache
def samples() -> tuple[FloatArray, FloatArray]:
    """(n,) s from 0 and (n, 25, 3) m of a person who twists the trunk."""
    with BagReader(TWIST) as bag:
        skeletons = read_skeletons(bag, graph.TRUE_SKELETON)
    first = skeletons[0].stamp_ns
    times = np.array([(each.stamp_ns - first) / NANOSECONDS for each in skeletons])
    return times, np.stack([each.positions for each in skeletons])


@cache
def truth() -> Curve:
    return Curve(*samples())


def noise(shape: tuple[int, ...], scale: float, seed: int = 3) -> FloatArray:
    return scale * np.random.default_rng(seed).standard_normal(shape)


# --- time and space


def test_a_curve_goes_through_its_samples_and_follows_a_cubic_between() -> None:
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    values = np.stack([times**3, 1.0 - times], axis=1)
    curve = Curve(times, values)
    at = np.linspace(0.0, 0.5, 23)
    assert_allclose(curve.at(at), np.stack([at**3, 1.0 - at], axis=1), atol=1e-12)
    assert np.isnan(curve.at(np.array([-0.01, 0.51]))).all()
    assert curve.span == (0.0, 0.5)


def test_a_curve_invents_nothing_in_gaps() -> None:
    times = np.arange(0.0, 2.0, 0.1)
    values = np.stack([np.sin(times), np.cos(times)], axis=1)
    values[5:10, 1] = np.nan  # 0.4 to 1.0 s
    values[15, 0] = np.nan  # one sample
    curve = Curve(times, values, max_gap=0.25)
    inside = curve.at(np.array([0.41, 0.7, 0.99]))
    assert np.isfinite(inside[:, 0]).all() and np.isnan(inside[:, 1]).all()
    assert_allclose(curve.at(np.array([1.5]))[0], [np.sin(1.5), np.cos(1.5)], atol=1e-4)


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0], [2.0, 1.0, 0.0]])
def test_times_that_make_no_curve_are_refused(times: list[float]) -> None:
    with pytest.raises(MetricsError, match="do not increase"):
        Curve(np.array(times), np.zeros((3, 2)))


def test_an_estimate_is_interpolated_linearly_and_not_across_gaps() -> None:
    times = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    positions = np.zeros((5, N_JOINTS, 3))
    positions[:, :, 0] = times[:, None] ** 2
    between = Trajectory(times, positions).at(np.array([0.05, 0.2, 0.4, 0.65, 0.8]), max_gap=0.15)
    assert_allclose(between.positions[[0, 1, 3], 4, 0], [0.005, 0.04, 0.425])
    assert np.isnan(between.positions[[2, 4]]).all()


@settings(deadline=None, max_examples=draws(5, 12))
@given(delay=st.floats(-0.3, 0.3), turn=st.floats(-3.0, 3.0), seed=st.integers(0, 1000))
def test_delay_and_transform_are_recovered_for_any_frames_and_offsets(delay: float, turn: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, truth().span[1], 400))
    shift = Rotation.from_euler("zyx", [turn, 0.3, -0.2]).as_matrix()
    shown = truth().at(times - delay)
    inside = np.isfinite(shown).all(axis=(1, 2))
    moved = (shown[inside] - [1.0, -2.0, 0.5]) @ shift
    found = find_delay(Trajectory(times[inside], moved + rng.normal(0.0, 0.1, (N_JOINTS, 3))), truth())
    assert found == pytest.approx(delay, abs=1e-3)
    alignment = align(Trajectory(times[inside], moved), truth(), delay)
    assert_allclose(alignment.rotation, shift, atol=1e-6)
    back = alignment.apply(Trajectory(times[inside], moved))
    assert_allclose(back.positions, truth().at(back.times), atol=1e-6)


def test_noise_and_missing_joints_do_not_bias_the_delay() -> None:
    times = grid(0.5, truth().span[1], 30.0)
    positions = truth().at(times - 0.02)
    positions += noise(positions.shape, 0.03)
    positions[np.random.default_rng(1).random(positions.shape[:2]) < 0.2] = np.nan
    assert find_delay(Trajectory(times, positions), truth()) == pytest.approx(0.02, abs=0.004)


def test_no_delay_without_motion_or_beyond_the_search_window() -> None:
    times, positions = samples()
    still = np.broadcast_to(positions[0], positions.shape)
    assert np.isnan(find_delay(Trajectory(times, still + noise(still.shape, 0.01)), Curve(times, still)))
    late = Trajectory(times + 0.7, positions)
    assert np.isnan(find_delay(late, truth()))
    assert find_delay(late, truth(), around=0.6) == pytest.approx(0.7, abs=1e-3)
    assert np.isnan(find_delay(Trajectory(times[:20], positions[:20]), truth()))


def test_points_on_a_line_have_no_alignment() -> None:
    times, positions = samples()
    line = np.full_like(positions, np.nan)
    line[:, [0, 1, 2]] = np.arange(9.0).reshape(3, 3)
    with pytest.raises(MetricsError, match="alignment in space"):
        align(Trajectory(times, line), Curve(times, line), 0.0)


# --- joints


def test_added_errors_are_measured() -> None:
    _, true = samples()
    added = noise(true.shape, 0.02)
    errors = joint_errors(true + added, true)
    assert_allclose(errors.mae, np.abs(added).mean(axis=0))
    assert_allclose(errors.largest, np.abs(added).max(axis=0))
    distance = np.linalg.norm(added, axis=2)
    assert_allclose(errors.mean, distance.mean(axis=0))
    assert_allclose(errors.rms, np.sqrt((distance**2).mean(axis=0)))
    assert_allclose(errors.farthest, distance.max(axis=0))
    assert (errors.frames == len(true)).all()


def test_an_offset_that_turns_with_the_segment_is_taken_off_and_one_of_the_room_is_not() -> None:
    _, true = samples()
    offsets = noise((N_JOINTS, 3), 0.03)
    carried = true + (segment_frames(true) @ offsets[..., None])[..., 0]
    errors = joint_errors(carried, true)
    assert_allclose(errors.offset, offsets, atol=1e-12)
    assert_allclose(errors.fixed_rms, 0.0, atol=1e-12)
    assert_allclose(errors.rms, np.linalg.norm(offsets, axis=1))
    room = joint_errors(true + [0.05, 0.0, 0.0], true)
    assert room.fixed_rms[WRIST] > 0.02


@given(st.floats(0.0, 0.9), st.integers(0, 100))
def test_only_positions_known_in_both_are_compared(share: float, seed: int) -> None:
    true = samples()[1][::10]
    rng = np.random.default_rng(seed)
    found = true + noise(true.shape, 0.02, seed)
    missing = rng.random(found.shape[:2]) < share
    found[missing] = np.nan
    errors = joint_errors(found, true)
    assert (errors.frames == (~missing).sum(axis=0)).all()
    known = ~missing[:, WRIST]
    if known.any():
        assert errors.mean[WRIST] == pytest.approx(np.linalg.norm((found - true)[known, WRIST], axis=1).mean())
    else:
        assert np.isnan(errors.mean[WRIST])


def test_ellipsoids_and_bands_that_are_right_cover_95_percent() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 3, 3))
    covariances = np.broadcast_to(root @ np.swapaxes(root, -1, -2), (20_000, 4, 3, 3))
    error = (root @ rng.standard_normal((20_000, 4, 3, 1)))[..., 0]
    assert_allclose(position_coverage(error, covariances), 0.95, atol=0.006)
    assert_allclose(position_coverage(error, 0.25 * covariances), chi2.cdf(chi2.ppf(0.95, 3) / 4.0, 3), atol=0.015)
    stddev = rng.uniform(0.01, 0.1, (20_000, 3))
    angles = wrapped(3.0 + stddev * rng.standard_normal((20_000, 3)))
    assert_allclose(angle_errors(angles, np.full((20_000, 3), 3.0), stddev).covered, 0.95, atol=0.006)


def test_jitter_is_the_white_noise_that_was_added_and_nothing_else() -> None:
    times, true = samples()
    rotation = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    assert_allclose(jitter(times, true + noise(true.shape, 0.004), true), 0.004, rtol=0.15)
    slow = 0.05 * np.sin(times)[:, None, None]
    assert jitter(times, true @ rotation.T + [1.0, 2.0, 3.0] + slow, true).max() < 2e-4
    late = truth().at(times - 0.05)
    assert jitter(times, late, true).max() < 4e-4


def test_jitter_ignores_differences_across_a_gap() -> None:
    times = grid(0.0, 10.0, 30.0)
    kept = np.random.default_rng(0).random(len(times)) < 0.8
    position = np.broadcast_to((50.0 * np.sin(3.0 * times))[:, None, None], (len(times), 1, 3))
    assert jitter(times[kept], np.zeros_like(position[kept]), position[kept]) == pytest.approx(0.0)
    shaken = position + noise(position.shape, 0.1)
    assert jitter(times[kept], shaken[kept], position[kept]) == pytest.approx(0.1, rel=0.3)


def test_a_joint_is_off_track_where_it_is_missing_or_far() -> None:
    true = np.zeros((10, 2, 3))
    found = true.copy()
    found[:3, 0] = np.nan
    found[3:5, 0, 2] = 0.2
    true[0, 1] = np.nan  # unknown
    found[1:4, 1] = np.nan
    assert_allclose(off_track(found, true, 0.15), [0.5, 3 / 9])


def test_lengths_that_breathe_have_spread_and_those_that_are_wrong_an_error() -> None:
    times, true = samples()
    found = true.copy()
    bone = BONES.index((Joint.ELBOW_LEFT, WRIST))
    direction = true[:, WRIST] - true[:, Joint.ELBOW_LEFT]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    found[:, WRIST] += (0.01 + 0.02 * np.sqrt(2.0) * np.sin(2.0 * np.pi * times * 4.0 / times[-1]))[:, None] * direction
    errors = length_errors(found, true)
    assert errors.spread[bone] == pytest.approx(0.02, rel=0.02)
    assert errors.error[bone] == pytest.approx(0.01, abs=1e-3)
    assert errors.true_spread[bone] < 1e-6


# --- angles, calibration


@given(st.lists(st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)), min_size=2, max_size=20), st.integers(-3, 3))
def test_angles_differ_by_less_than_half_a_turn(pairs: list[tuple[float, float]], turns: int) -> None:
    found, true = np.array(pairs).T[..., None]
    errors, other = angle_errors(found, true), angle_errors(found + 2.0 * np.pi * turns, true)
    assert errors.largest[0] <= np.pi
    assert np.sin(0.5 * other.largest[0]) == pytest.approx(np.sin(0.5 * errors.largest[0]), abs=1e-6)
    assert errors.rmse[0] ** 2 == pytest.approx(errors.offset[0] ** 2 + errors.fixed_rmse[0] ** 2)


@given(st.floats(0.0, 3.1), st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)))
def test_pose_errors_are_the_turn_and_the_way(angle: float, way: tuple[float, float, float]) -> None:
    true = Rotation.from_euler("xyz", [0.3, -0.4, 1.0]).as_matrix()
    axis = np.array([0.6, 0.0, 0.8])
    place, position = np.array([2.0, 0.5, -0.3]), np.array([0.1, 0.2, 0.3])
    turned = Rotation.from_rotvec(angle * axis).as_matrix() @ true
    errors = pose_errors(turned[None], (position + way)[None], true, position, place)
    assert errors.rotation[0] == pytest.approx(angle, abs=1e-7)
    assert errors.translation[0] == pytest.approx(np.linalg.norm(way))
    arm = place - position
    expected = np.linalg.norm(Rotation.from_rotvec(angle * axis).apply(arm) + way - arm)
    assert errors.displacement[0] == pytest.approx(expected)
