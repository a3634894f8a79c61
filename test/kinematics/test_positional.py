"""Angles from positions: known poses, invariances, derivatives, and consistent standard deviations."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import joint_correlation
from body_tracking.core.skeleton import MIRROR, N_JOINTS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.kinematics import positional
from body_tracking.kinematics.motion import ACCELERATION_DENSITIES, JOINT_CLASSES, joint_densities
from body_tracking.kinematics.positional import ANGLE_NAMES, angles_over_time, positional_angles
from draws import draws

TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
UP, FORWARD, LEFT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def arm(positions: FloatArray, side: str, upper: FloatArray, forearm: FloatArray) -> None:
    """Lay an arm along two directions (unit vectors)."""
    shoulder, elbow, wrist = (Joint[f"{name}_{side}"] for name in ("SHOULDER", "ELBOW", "WRIST"))
    positions[elbow] = positions[shoulder] + 0.3 * upper
    positions[wrist] = positions[elbow] + 0.25 * forearm


def t_pose() -> FloatArray:
    """(25, 3) metres; facing x, z up, shoulders on the level of SpineShoulder."""
    positions = np.zeros((N_JOINTS, 3))
    positions[[Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER], 2] = 1.0, 1.25, 1.5
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        positions[Joint[f"HIP_{side}"]] = [0.0, 0.1 * sign, 0.95]
        positions[Joint[f"SHOULDER_{side}"]] = [0.0, 0.18 * sign, 1.5]
        arm(positions, side, sign * LEFT, sign * LEFT)
    return positions


def bent_pose(seed: int) -> FloatArray:
    """A pose of a moving person, away from every singularity."""
    rng = np.random.default_rng(seed)
    positions = t_pose()
    upper = Rotation.from_rotvec(rng.uniform(-0.35, 0.35, 3))
    for joint in range(N_JOINTS):
        if Joint(joint).name.split("_")[0] not in ("HIP", "KNEE", "ANKLE", "FOOT") and joint != Joint.SPINE_BASE:
            positions[joint] = upper.apply(positions[joint] - UP) + UP
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        direction = sign * LEFT + rng.uniform(-0.6, 0.6, 3)
        bend = FORWARD + rng.uniform(-0.6, 0.6, 3)
        arm(positions, side, direction / np.linalg.norm(direction), bend / np.linalg.norm(bend))
    return positions + rng.normal(size=3)


def skeleton(positions: FloatArray, stddev: float | None = None, velocities: FloatArray | None = None) -> Skeleton:
    covariances = None if stddev is None else np.broadcast_to(stddev**2 * np.eye(3), (N_JOINTS, 3, 3))
    return Skeleton(5, "world", positions, TRACKED, 0, covariances, velocities)


def angle(angles: JointAngles, name: str) -> float:
    return float(np.degrees(angles.position[angles.names.index(name)]))


def both(angles: JointAngles, name: str) -> tuple[float, float]:
    return angle(angles, f"{name}_left"), angle(angles, f"{name}_right")


def wrapped(difference: FloatArray) -> FloatArray:
    return (difference + np.pi) % (2 * np.pi) - np.pi


def test_arms_down_forward_up_and_back() -> None:
    for direction, elevation, plane in (
        (-UP, 0.0, None),
        (FORWARD, 90.0, 90.0),
        (UP, 180.0, None),
        (-FORWARD, 90.0, -90.0),
    ):
        positions = t_pose()
        for side in ("LEFT", "RIGHT"):
            arm(positions, side, direction, direction)
        angles = positional_angles(skeleton(positions, 0.01))
        assert both(angles, "shoulder_elevation") == pytest.approx((elevation, elevation), abs=1e-6)
        assert both(angles, "elbow_flexion") == pytest.approx((0.0, 0.0), abs=1e-6)
        planes = [angles.names.index(f"shoulder_plane_{side}") for side in ("left", "right")]
        if plane is None:  # an arm along the trunk has no plane of elevation
            assert np.isinf(angles.position_stddev[planes]).all()
        else:
            assert both(angles, "shoulder_plane") == pytest.approx((plane, plane))
            assert (angles.position_stddev[planes] < 0.2).all()


@given(
    plane=st.floats(-60.0, 100.0),
    elevation=st.floats(15.0, 145.0),
    rotation=st.floats(-85.0, 85.0),
    flexion=st.floats(10.0, 140.0),
)
def test_an_arm_has_the_angles_that_it_is_made_of(
    plane: float, elevation: float, rotation: float, flexion: float
) -> None:
    """The upper arm raised in a plane, turned about itself from where the elbow bends forward, and bent."""
    positions = t_pose()
    for side, sign in (("LEFT", 1.0), ("RIGHT", -1.0)):
        outward, (p, e, r, f) = sign * LEFT, np.radians([plane, elevation, rotation, flexion])
        upper = -np.cos(e) * UP + np.sin(e) * (np.cos(p) * outward + np.sin(p) * FORWARD)
        # to the front of the plane, and up in it: both across the upper arm
        front = np.cos(p) * FORWARD - np.sin(p) * outward
        rise = np.sin(e) * UP + np.cos(e) * (np.cos(p) * outward + np.sin(p) * FORWARD)
        across = np.cos(r) * front - np.sin(r) * rise
        arm(positions, side, upper, np.cos(f) * upper + np.sin(f) * across)
    angles = positional_angles(skeleton(positions, 0.01))
    for name, value in (
        ("shoulder_plane", plane),
        ("shoulder_elevation", elevation),
        ("humeral_rotation", rotation),
        ("elbow_flexion", flexion),
    ):
        assert both(angles, name) == pytest.approx((value, value), abs=1e-6), name


@pytest.mark.parametrize(
    ("flexion", "lateral", "axial"), [(30, 0, 0), (0, 20, 0), (0, 0, -40), (50, -25, 30), (-15, 10, 80)]
)
def test_the_trunk_is_a_cardan_sequence(flexion: float, lateral: float, axial: float) -> None:
    """Flexion about the left, lateral lean about the forward, axial about the upward axis, in this order."""
    turn = Rotation.from_euler("YXZ", [flexion, lateral, axial], degrees=True)
    positions = t_pose()
    above = np.flatnonzero(positions[:, 2] > 1.1)
    positions[above] = turn.apply(positions[above] - UP) + UP
    angles = positional_angles(skeleton(positions))
    assert angle(angles, "trunk_flexion") == pytest.approx(flexion)
    assert angle(angles, "trunk_lateral_flexion") == pytest.approx(lateral)
    assert angle(angles, "trunk_axial_rotation") == pytest.approx(axial)
    assert both(angles, "shoulder_elevation") == pytest.approx((90.0, 90.0))
    assert both(angles, "shoulder_plane") == pytest.approx((0.0, 0.0), abs=1e-9)


@given(seed=st.integers(0, 10_000), turn=st.floats(-np.pi, np.pi), shift=st.tuples(*[st.floats(-5, 5)] * 3))
@settings(max_examples=draws(12, 40), deadline=None)
def test_turning_and_moving_the_person_changes_nothing(seed: int, turn: float, shift: tuple[float, ...]) -> None:
    positions = bent_pose(seed)
    velocities = np.random.default_rng(seed).normal(size=positions.shape)
    rotation = Rotation.from_euler("z", turn)
    moved = rotation.apply(positions) + shift
    here = positional_angles(skeleton(positions, 0.01, velocities))
    there = positional_angles(skeleton(moved, 0.01, rotation.apply(velocities)))
    assert_allclose(wrapped(here.position - there.position), 0.0, atol=1e-9)
    assert_allclose(here.velocity, there.velocity, atol=1e-8)
    assert_allclose(here.position_stddev, there.position_stddev, rtol=1e-7)
    assert_allclose(here.velocity_stddev, there.velocity_stddev, rtol=1e-7)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=draws(12, 40), deadline=None)
def test_the_mirror_exchanges_left_and_right(seed: int) -> None:
    positions = bent_pose(seed)
    here = positional_angles(skeleton(positions, 0.01))
    there = positional_angles(replace(skeleton(positions * [1, -1, 1], 0.01)).mirrored())
    for name, value, stddev in zip(here.names, there.position, there.position_stddev, strict=True):
        other = name.replace("left", "LEFT").replace("right", "left").replace("LEFT", "right")
        sign = -1.0 if name in ("trunk_lateral_flexion", "trunk_axial_rotation") else 1.0
        index = here.names.index(other)
        assert wrapped(sign * value - here.position[index]) == pytest.approx(0.0, abs=1e-9), name
        assert stddev == pytest.approx(here.position_stddev[index])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=draws(10, 30))
def test_velocities_and_standard_deviations_are_by_the_derivatives_of_the_angles(seed: int) -> None:
    """Against central differences: J v, and the diagonal of J C J^T, of independent and of correlated joints.

    The spine's bend is no error of the measured joints, and left out here.
    """
    rng = np.random.default_rng(seed)
    positions, velocities = bent_pose(seed), rng.normal(size=(N_JOINTS, 3))
    roots = 1e-6 * rng.normal(size=(N_JOINTS, 3, 3))
    covariances = roots @ roots.swapaxes(1, 2)
    steps = 1e-6 * np.eye(3 * N_JOINTS).reshape(-1, N_JOINTS, 3)
    ahead, behind = ([positional_angles(skeleton(positions + s * step)).position for step in steps] for s in (1, -1))
    jacobian = wrapped(np.subtract(ahead, behind)).T.reshape(-1, N_JOINTS, 3) / 2e-6
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(positional, "_bend_variance", lambda _positions: 0.0)
        measured = replace(skeleton(positions, None, velocities), covariances=covariances)
        found = positional_angles(measured, of_bones=0.0)
        correlated = positional_angles(skeleton(positions, 1e-6), of_bones=0.7)
    assert_allclose(found.velocity, np.einsum("ajx,jx->a", jacobian, velocities), rtol=1e-5, atol=1e-6)
    variances = np.einsum("ajx,jxy,ajy->a", jacobian, covariances, jacobian)
    assert_allclose(found.position_stddev, np.sqrt(variances), rtol=1e-4, atol=1e-13)
    variances = 1e-12 * np.einsum("ajx,jk,akx->a", jacobian, joint_correlation(0.7), jacobian)
    assert_allclose(correlated.position_stddev, np.sqrt(variances), rtol=1e-4, atol=1e-13)


def test_a_spine_that_a_camera_shows_straight_is_in_the_deviations() -> None:
    """Exact joints but for SpineMid, which lies on the straight line; thoraces bent as in five people beside Vicon."""
    rng = np.random.default_rng(6)
    inside: dict[str, list[bool]] = {"shoulder_elevation": [], "clavicle_elevation": []}
    for _ in range(300):
        tilt = np.append(np.radians(15.0) * rng.normal(size=2), 0.0)
        shown = Rotation.from_rotvec(tilt).apply(t_pose() - UP) + UP
        for side in ("LEFT", "RIGHT"):
            arm(shown, side, *(each / np.linalg.norm(each) for each in rng.normal(size=(2, 3))))
        bend = np.radians([1.7, 3.7, 0.0]) * rng.normal(size=3) + [0.15, 0.07, 0.0] * tilt  # about x sideways
        true, top = shown.copy(), shown[Joint.SPINE_SHOULDER]
        true[Joint.SPINE_MID] = top + Rotation.from_rotvec(bend).apply(shown[Joint.SPINE_MID] - top)
        truth, found = positional_angles(skeleton(true)), positional_angles(skeleton(shown, 1e-4))
        for name, covered in inside.items():
            for side in ("left", "right"):
                column = ANGLE_NAMES.index(f"{name}_{side}")
                error = abs(found.position[column] - truth.position[column])
                covered.append(bool(error < 1.96 * found.position_stddev[column]))
    assert 0.90 <= np.mean(inside["shoulder_elevation"]) <= 0.99
    assert np.mean(inside["clavicle_elevation"]) >= 0.90  # which only a bend to the side changes, the smaller one


def test_a_straight_elbow_keeps_its_band_and_hides_the_rotation() -> None:
    """At the fold: 0 deg is within two stated deviations in 95 % of draws, and the rotation is unknown."""
    rng = np.random.default_rng(3)
    stddev, count, root = 0.01, 1200, np.linalg.cholesky(joint_correlation())
    pose = t_pose()
    elbow, rotation = (ANGLE_NAMES.index(name) for name in ("elbow_flexion_left", "humeral_rotation_left"))
    errors = stddev * root @ rng.normal(size=(count, *pose.shape))
    covariances = np.broadcast_to(stddev**2 * np.eye(3), (count, N_JOINTS, 3, 3))
    found, stated = angles_over_time(pose + errors, covariances)
    assert 0.92 < (found[:, elbow] < 2 * stated[:, elbow]).mean() < 0.97
    assert np.isinf(stated[:, rotation]).mean() > 0.99


@pytest.mark.parametrize("stated", [True, False])
def test_angles_of_many_bodies_are_those_of_each(stated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where joints are unknown or at one place, and covariances unknown, singular or none."""
    monkeypatch.setattr(positional, "_AT_ONCE", 16)
    rng = np.random.default_rng(4)
    positions = np.stack([bent_pose(seed) if seed % 3 else t_pose() for seed in range(40)])
    positions[rng.random(positions.shape[:2]) < 0.02] = np.nan
    positions[7, Joint.ELBOW_LEFT] = positions[7, Joint.SHOULDER_LEFT]
    roots = 0.01 * rng.normal(size=(*positions.shape, 3))
    covariances = roots @ roots.swapaxes(-1, -2)
    covariances[8, 4], covariances[10], covariances[11], covariances[12, :, 2] = np.inf, 0.0, -covariances[11], 0.0
    bodies = [
        Skeleton(5, "world", each, TRACKED, 0, covariances[k] if stated else None) for k, each in enumerate(positions)
    ]
    one_by_one = [positional_angles(each) for each in bodies]
    at_once = angles_over_time(positions, covariances if stated else None)
    for name, found in zip(("position", "position_stddev"), at_once, strict=True):
        assert_allclose(found, [getattr(each, name) for each in one_by_one], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("twist", [40.0, 60.0, 90.0, 150.0])
def test_a_twist_that_no_person_can_do_has_the_excess_as_an_error(twist: float) -> None:
    """A Kinect at the side of a person swaps left and right of hips or shoulders for some frames."""
    body = t_pose()
    upper = [joint for joint in Joint if body[joint, 2] > body[Joint.SPINE_MID, 2]]
    body[upper] = Rotation.from_euler("z", twist, degrees=True).apply(body[upper])
    found = positional_angles(skeleton(body, 0.01))
    column = found.names.index("trunk_axial_rotation")
    assert np.degrees(abs(found.position[column])) == pytest.approx(twist, abs=1.0)
    straight = positional_angles(skeleton(t_pose(), 0.01)).position_stddev[column]
    stated = np.degrees(np.hypot(straight, np.radians(max(twist - 70.0, 0.0))))
    assert np.degrees(found.position_stddev[column]) == pytest.approx(stated, rel=0.1)


def test_an_unknown_joint_hides_its_own_angles_and_no_other() -> None:
    positions = bent_pose(0)
    positions[Joint.WRIST_LEFT] = np.nan
    states = TRACKED.copy()
    states[Joint.ELBOW_RIGHT] = TrackingState.NOT_TRACKED
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angles = positional_angles(replace(skeleton(positions, 0.01, positions), states=states))
    hidden = {"elbow_flexion_left", "humeral_rotation_left"} | {
        f"{name}_right" for name in ("shoulder_elevation", "shoulder_plane", "humeral_rotation", "elbow_flexion")
    }
    for index, name in enumerate(angles.names):
        assert np.isnan(angles.position[index]) == (name in hidden), name
        assert np.isnan(angles.velocity[index]) == (name in hidden), name
        assert np.isinf(angles.position_stddev[index]) == (name in hidden), name
        assert np.isinf(angles.velocity_stddev[index]) == (name in hidden), name


@pytest.mark.parametrize("fill", [0.0, np.nan, np.inf, 1e300, -1e-300])
def test_impossible_bodies_are_unknown_and_do_not_warn(fill: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angles = positional_angles(skeleton(np.full((N_JOINTS, 3), fill), 0.01, np.full((N_JOINTS, 3), fill)))
    assert np.isnan(angles.position).all() and np.isinf(angles.position_stddev).all()
    assert np.isinf(angles.velocity_stddev).all()


def test_without_covariances_or_velocities_the_deviations_are_infinite() -> None:
    angles = positional_angles(skeleton(bent_pose(0)))
    assert np.isfinite(angles.position).all() and np.isnan(angles.velocity).all()
    assert np.isinf(angles.position_stddev).all() and np.isinf(angles.velocity_stddev).all()


@pytest.mark.parametrize("density", ACCELERATION_DENSITIES)
@pytest.mark.parametrize("noise", [0.005, 0.02, 0.06])
@pytest.mark.parametrize("step", [1 / 60, 1 / 30, 1 / 15])
def test_the_velocity_bound_covers_a_kalman_filter(density: float, noise: float, step: float) -> None:
    """(3 q^2 p)^(1/3) against the steady state (Riccati), and against predictions that start there."""
    transition, observe = np.array([[1.0, step], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    q = Q_continuous_white_noise(2, step, density)
    prior = solve_discrete_are(transition.T, observe.T, q, np.array([[noise**2]]))
    gain = prior @ observe.T / (prior[0, 0] + noise**2)
    covariance = (np.eye(2) - gain @ observe) @ prior
    for _ in range(15):
        # 8 %: where one step's own motion exceeds the noise, sampling leaves the velocity a little less known
        assert covariance[1, 1] < 1.08 * (3.0 * density**2 * covariance[0, 0]) ** (1 / 3)
        covariance = transition @ covariance @ transition.T + q


def test_joint_classes_cover_every_joint() -> None:
    densities = joint_densities()
    assert densities[Joint.SPINE_SHOULDER] < densities[Joint.ELBOW_LEFT] < densities[Joint.HAND_TIP_RIGHT]
    assert (JOINT_CLASSES[MIRROR] == JOINT_CLASSES).all()


def test_a_raised_arm_keeps_its_plane_where_a_hanging_one_has_none() -> None:
    """The criterion is whether the elevation is significant, not the accuracy of the plane."""
    for elevation, known in ((8.0, False), (80.0, True)):
        positions = t_pose()
        direction = np.sin(np.radians(elevation)) * LEFT - np.cos(np.radians(elevation)) * UP
        arm(positions, "LEFT", direction, direction)
        angles = positional_angles(skeleton(positions, 0.035))
        plane = angles.position_stddev[ANGLE_NAMES.index("shoulder_plane_left")]
        assert np.isfinite(plane) == known
