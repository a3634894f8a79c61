"""Laws of lines of sight past capsules."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from standing import HANGING, flesh, placed, standing

from body_tracking.core.skeleton import MIRROR, FloatArray, Joint
from body_tracking.kinect.occlusion import Capsules, obstruction
from draws import draws

OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""World axes into those of a sensor that looks along x."""
SEEDS = st.integers(0, 2**32 - 1)


def in_sight(body: FloatArray, yaw: float = np.pi, distance: float = 2.0) -> FloatArray:
    """(1, 25, 3) before a level sensor at the height of 1.1 m, facing it unless turned."""
    sight: FloatArray = placed(body, np.array([distance, 0.0, -1.1]), yaw) @ OPTICAL.T
    return sight


def cover(sight: FloatArray, capsules: Capsules) -> FloatArray:
    return obstruction(sight, capsules).cover


def capsule(start: Joint, end: Joint, radius: float) -> Capsules:
    return Capsules(np.array([start], dtype=np.intp), np.array([end], dtype=np.intp), np.array([radius]))


def test_a_person_facing_the_sensor_with_arms_apart_is_fully_visible() -> None:
    covered = cover(in_sight(standing()), flesh())
    assert covered.max() < 0.2


@pytest.mark.parametrize("joint", [Joint.WRIST_LEFT, Joint.HAND_TIP_RIGHT, Joint.ELBOW_LEFT])
def test_a_joint_behind_the_trunk_is_covered_and_one_before_it_is_not(joint: Joint) -> None:
    body = standing()
    body[joint] = body[Joint.SPINE_MID] + [-0.3, 0.0, 0.0]
    assert cover(in_sight(body), flesh())[0, joint] > 0.8
    body[joint] = body[Joint.SPINE_MID] + [0.3, 0.0, 0.0]
    assert cover(in_sight(body), flesh())[0, joint] == 0.0


def test_from_the_side_the_trunk_covers_the_far_arm_only() -> None:
    # the person faces left of the sensor's view, its left arm towards it
    sight = in_sight(standing(HANGING), yaw=np.pi / 2)
    assert sight[0, Joint.WRIST_LEFT, 2] < sight[0, Joint.WRIST_RIGHT, 2]
    near, far = (
        cover(sight, flesh())[0, [Joint[f"ELBOW_{side}"], Joint[f"WRIST_{side}"]]] for side in ("LEFT", "RIGHT")
    )
    assert near.max() < 0.2 and far.min() > 0.4


def test_the_trunk_never_covers_the_spine() -> None:
    spine = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.NECK]
    whole = flesh()
    trunk = [Joint.HIP_LEFT, Joint.HIP_RIGHT, Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT, *spine]
    of_it = np.isin(whole.starts, trunk) & np.isin(whole.ends, trunk)
    parts = Capsules(whole.starts[of_it], whole.ends[of_it], whole.radii[of_it])
    for yaw in np.linspace(0.0, 2.0 * np.pi, 9):
        assert cover(in_sight(standing(), yaw), parts)[0, spine].max() == 0.0


@given(SEEDS)
@settings(max_examples=draws(5, 12), deadline=None)
def test_a_segment_never_covers_the_joints_at_its_ends(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sight = rng.normal([0.0, 0.0, 2.5], 0.4, (5, 25, 3))
    start, end = (Joint(int(k)) for k in rng.integers(0, 25, 2))
    covered = cover(sight, capsule(start, end, rng.uniform(0.02, 0.5)))
    assert (covered[:, [start, end]] == 0.0).all()


@given(SEEDS)
@settings(max_examples=draws(5, 12), deadline=None)
def test_cover_agrees_with_a_search_over_points_on_ray_and_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.05, 0.3)
    sight = rng.normal([0.0, 0.0, 2.5], 0.5, (1, 25, 3))
    joint, shares = Joint.HEAD, np.linspace(0.0, 1.0, 401)
    axis = sight[0, Joint.HIP_LEFT] + shares[:, None] * (sight[0, Joint.KNEE_LEFT] - sight[0, Joint.HIP_LEFT])
    ray = shares[:, None] * sight[0, joint]
    miss = np.linalg.norm(axis[:, None] - ray[None], axis=2).min()
    within = np.linalg.norm(axis - sight[0, joint], axis=1).min()
    expected = np.clip(1.0 - miss / radius, 0.0, 1.0) * np.clip(2.0 * within / radius - 1.0, 0.0, 1.0)
    found = cover(sight, capsule(Joint.HIP_LEFT, Joint.KNEE_LEFT, radius))[0, joint]
    assert found == pytest.approx(expected, abs=0.01 / radius)


@given(SEEDS)
@settings(max_examples=draws(5, 12), deadline=None)
def test_cover_does_not_depend_on_where_the_sensor_looks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sight = rng.normal([0.0, 0.0, 2.5], 0.4, (4, 25, 3))
    turned = sight @ Rotation.random(random_state=seed).as_matrix().T
    assert np.allclose(cover(turned, flesh()), cover(sight, flesh()), atol=1e-6)


def test_cover_of_a_mirrored_scene_is_mirrored() -> None:
    sight = in_sight(standing((0.5, 0.4, -0.6)), yaw=2.2)
    assert np.allclose(cover((sight * [-1.0, 1.0, 1.0])[:, MIRROR], flesh())[:, MIRROR], cover(sight, flesh()))


def test_the_ray_ends_at_the_covering_surface() -> None:
    sight = np.tile([5.0, 0.0, 9.0], (1, 25, 1))
    sight[0, Joint.HEAD], sight[0, Joint.HAND_LEFT] = (0.0, 0.0, 2.0), (0.0, 0.0, 3.0)
    found = obstruction(sight, capsule(Joint.HEAD, Joint.HEAD, 0.1))
    assert found.cover[0, Joint.HAND_LEFT] == pytest.approx(1.0)
    assert found.nearer[0, Joint.HAND_LEFT] == pytest.approx(1.1)
    assert found.nearer[0, Joint.HAND_RIGHT] == 0.0


def test_thin_parts_cover_thick_parts_partially() -> None:
    body = standing()
    body[Joint.WRIST_LEFT], body[Joint.HAND_TIP_LEFT] = ([0.4, y, 1.2] for y in (0.05, -0.05))
    covered = cover(in_sight(body), flesh())[0, Joint.SPINE_MID]
    assert 0.0 < covered <= (0.04 / 0.12) ** 2
