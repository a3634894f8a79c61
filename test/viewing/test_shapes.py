"""Shapes: ellipsoids contain their share, capsules join joints, lost joints are red."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from body_tracking.core.sensor_poses import level_pose
from body_tracking.core.skeleton import BONES, N_JOINTS, FloatArray, Joint, Skeleton
from body_tracking.viewing import shapes
from body_tracking.viewing.colours import INFERRED, NOT_TRACKED, PALETTE, joint_colours, linear
from draws import draws

SEEDS = st.integers(0, 2**32 - 1)


def standing(
    rng: np.random.Generator, states: int | FloatArray = 2, covariances: FloatArray | None = None, body: int = 0
) -> Skeleton:
    """Joints at random positions."""
    positions = rng.normal(size=(N_JOINTS, 3))
    return Skeleton(0, "world", positions, np.broadcast_to(np.uint8(states), N_JOINTS).copy(), body, covariances)


def spread(rng: np.random.Generator, scale: float = 0.05) -> FloatArray:
    factors = rng.normal(scale=scale, size=(N_JOINTS, 3, 3))
    return factors @ factors.transpose(0, 2, 1) + 1e-8 * np.eye(3)


# --- uncertainty


@given(SEEDS)
@settings(max_examples=draws(12, 30))
def test_an_ellipsoid_is_the_surface_of_its_covariance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    covariances = spread(rng)
    drawn = shapes.ellipsoids([standing(rng, covariances=covariances)])
    assert (drawn.radii < shapes.LARGEST_RADIUS).all()
    assert np.linalg.det(drawn.rotations) == pytest.approx(1.0)
    directions = rng.normal(size=(N_JOINTS, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = np.einsum("nij,nj->ni", drawn.rotations, drawn.radii * directions)
    distances = np.einsum("ni,nij,nj->n", points, np.linalg.inv(covariances), points)
    assert distances == pytest.approx(chi2.ppf(0.95, 3), rel=1e-5)


def test_no_ellipsoid_without_covariance_and_a_limited_one_with_a_huge_covariance() -> None:
    rng = np.random.default_rng(1)
    covariances = spread(rng)
    covariances[Joint.HEAD] = np.nan
    covariances[Joint.NECK] = np.inf
    covariances[Joint.HAND_LEFT] = 1e6 * np.eye(3)
    skeleton = standing(rng, covariances=covariances)
    drawn = shapes.ellipsoids([skeleton, standing(rng)])
    assert len(drawn.centres) == N_JOINTS - 2
    assert np.isfinite(drawn.radii).all()
    assert drawn.radii.max() == shapes.LARGEST_RADIUS
    assert shapes.ellipsoids([]).radii.shape == (0, 3)


def test_a_covariance_without_thickness_is_a_disc() -> None:
    flat = np.tile(np.diag([1e-4, 1e-4, -1e-12]), (N_JOINTS, 1, 1))
    drawn = shapes.ellipsoids([standing(np.random.default_rng(0), covariances=flat)])
    assert np.sort(drawn.radii, axis=1)[:, 0] == pytest.approx(0.0)


# --- colours


def test_joints_that_are_not_well_seen_are_red_and_no_sensor_is() -> None:
    states = np.array([0, 1, 2], np.uint8)
    assert joint_colours(states, PALETTE[0]).tolist() == [list(NOT_TRACKED), list(INFERRED), list(PALETTE[0])]
    for red, green, blue in PALETTE:
        assert not (red > 2 * green and red > 2 * blue)
    for red, green, blue in (NOT_TRACKED, INFERRED):
        assert red > 2 * green and red > 2 * blue


def test_intensities_give_the_colour_back_as_a_screen_shows_them() -> None:
    grey = np.arange(256, dtype=np.uint8)
    intensities = linear(np.stack([grey] * 3, axis=1)) / 255.0
    shown = np.where(intensities <= 0.0031308, 12.92 * intensities, 1.055 * intensities ** (1 / 2.4) - 0.055)
    assert np.abs(255.0 * shown - grey[:, None])[30:].max() < 5.0  # 8 bits resolve dark ones poorly
    assert (linear((0, 0, 0)) == 0).all() and (linear((255, 255, 255)) == 255).all()


# --- skeletons


def test_a_figure_has_every_body_and_only_joints_with_a_position() -> None:
    rng = np.random.default_rng(2)
    one, two = standing(rng), standing(rng, body=1)
    one.positions[Joint.WRIST_LEFT] = np.nan
    one.states[Joint.KNEE_LEFT] = 0
    drawn = shapes.figure([one, two], PALETTE[0])
    assert len(drawn.joints) == 2 * N_JOINTS - 1
    assert np.isfinite(drawn.joints).all() and np.isfinite(drawn.bones).all()
    lost = [bone for bone in BONES if Joint.WRIST_LEFT in bone]
    assert len(drawn.bones) == 2 * len(BONES) - len(lost)
    assert (drawn.joint_colours == NOT_TRACKED).all(axis=1).sum() == 1
    assert shapes.figure([], PALETTE[0]).bones.shape == (0, 2, 3)


def test_a_capsule_lies_along_its_bone() -> None:
    rng = np.random.default_rng(3)
    skeleton = standing(rng)
    skeleton.positions[Joint.HEAD] = skeleton.positions[Joint.NECK] - [0.0, 0.0, 0.2]  # straight down
    skeleton.states[Joint.FOOT_LEFT] = 0
    drawn = shapes.capsules([skeleton])
    assert len(drawn.radii) == len(BONES) - 1
    along = Rotation.from_quat(drawn.quats_xyzw).apply([0.0, 0.0, 1.0])
    assert drawn.centres + 0.5 * drawn.lengths[:, None] * along == pytest.approx(drawn.ends[:, 1])
    assert drawn.centres - 0.5 * drawn.lengths[:, None] * along == pytest.approx(drawn.ends[:, 0])


# --- sensors


def test_a_frustum_has_the_angles_of_its_view_and_looks_along_z() -> None:
    view = (1.2, 0.9)
    edges = shapes.frustum(2.0, view)
    corners = edges[:4, 1]
    assert (edges[:4, 0] == 0.0).all()
    assert corners[:, 2] == pytest.approx(2.0)
    assert np.degrees(2.0 * np.arctan2(np.abs(corners[:, 0]), corners[:, 2])) == pytest.approx(np.degrees(view[0]))
    assert np.degrees(2.0 * np.arctan2(np.abs(corners[:, 1]), corners[:, 2])) == pytest.approx(np.degrees(view[1]))
    # the last four go once around
    assert (edges[4:, 1] == np.roll(edges[4:, 0], -1, axis=0)).all()
    assert {tuple(corner) for corner in edges[4:, 0]} == {tuple(corner) for corner in corners}


def test_points_ahead_of_a_level_sensor_are_ahead_in_world() -> None:
    pose = level_pose("kinect1", height=1.0)
    seen = Skeleton(
        7, "kinect1_optical_frame", np.tile([0.0, -0.5, 2.0], (N_JOINTS, 1)), np.full(N_JOINTS, 2, np.uint8)
    )
    placed = shapes.in_world(seen, pose)
    assert placed.positions == pytest.approx(np.tile([2.0, 0.0, 1.5], (N_JOINTS, 1)))
    assert (placed.frame_id, placed.stamp_ns) == ("world", 7)


# --- the floor


def feet_at(height: float) -> Skeleton:
    positions = np.zeros((N_JOINTS, 3))
    positions[:, 2] = height + 1.0
    positions[[Joint.FOOT_LEFT, Joint.FOOT_RIGHT], 2] = height
    return Skeleton(0, "world", positions, np.full(N_JOINTS, 2, np.uint8))


def test_the_floor_is_under_the_feet_and_keeps_still() -> None:
    assert shapes.floor_height([], None) is None
    floor = shapes.floor_height([feet_at(-0.9)], None)
    assert floor == pytest.approx(-0.9)
    assert shapes.floor_height([feet_at(-0.92)], floor) == floor  # a tremor
    assert shapes.floor_height([feet_at(-1.0)], floor) == pytest.approx(-1.0)
    assert shapes.floor_height([feet_at(-0.3)], floor) == pytest.approx(-0.9, abs=0.002)  # a jump
    inferred = feet_at(-5.0)
    inferred.states[:] = 1
    assert shapes.floor_height([inferred], floor) == floor


def test_a_filter_without_legs_gets_those_of_the_same_body() -> None:
    whole = standing(np.random.default_rng(5))
    positions = whole.positions.copy()
    positions[Joint.HIP_LEFT : Joint.FOOT_RIGHT + 1] = np.nan
    upper = Skeleton(0, "world", positions + 0.02, whole.states)
    far = Skeleton(0, "world", whole.positions + 1.0, whole.states)
    drawn = shapes.with_legs(upper, [far, whole])
    assert drawn.positions[Joint.KNEE_LEFT] == pytest.approx(whole.positions[Joint.KNEE_LEFT])
    assert drawn.positions[Joint.HEAD] == pytest.approx(upper.positions[Joint.HEAD])
    assert shapes.with_legs(upper, [far]) is upper and shapes.with_legs(whole, [far]) is whole
