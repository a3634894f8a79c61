"""The thesis's model is the one of its tables (Schlagenhauf 2017, chapter 3), written out here once more."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from body_tracking.core.body_model import ModelError
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from draws import draws

LENGTHS = np.array([0.24, 0.26, 0.18, 0.32, 0.25, 0.17, 0.19, 0.33, 0.26, 0.16])
TO_WORLD = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""x left, y backward, z up to x forward, y left, z up."""
PLACE = np.array([2.0, -0.3, 0.1])
TURN = Rotation.from_euler("zyx", [2.2, 0.1, -0.2]).as_matrix()
PLACED = Schlagenhauf26(PLACE, TURN)

angles = arrays(np.float64, 26, elements=st.floats(-3.2, 3.2))
lengths = arrays(np.float64, 10, elements=st.floats(0.02, 0.6))


def dh_frames(theta: FloatArray, length: FloatArray) -> list[FloatArray]:
    """Eq. 3.1 and 3.3 with the rows of tables 3.1 and 3.2: 27 (4, 4) poses in her base frame, which is the first."""
    quarter = np.pi / 2
    l1, l2, l3, l4, l5, l6, l7, l8, l9, l10 = length
    t = np.concatenate([[np.nan], theta])
    rows = [  # the frame before, theta_i, d_i, a_i, alpha_i
        (0, t[1] + quarter, 0, 0, quarter),
        (1, t[2] + quarter, 0, 0, quarter),
        (2, t[3], 0, l1, 0),
        (3, t[4] + quarter, 0, 0, quarter),
        (4, t[5] + quarter, 0, 0, quarter),
        (5, t[6] + quarter, 0, l2, quarter),
        (6, t[7] + quarter, 0, 0, quarter),
        (7, t[8] + quarter, 0, 0, quarter),
        (8, t[9] + quarter, l3, 0, quarter),
        (6, t[10] + quarter, 0, 0, quarter),
        (10, t[11] + quarter, 0, 0, quarter),
        (11, t[12] + quarter, -l7, 0, quarter),
        (9, t[13] + quarter, 0, 0, quarter),
        (13, t[14] + quarter, 0, 0, quarter),
        (14, t[15], l4, 0, 0),
        (15, t[16], 0, 0, -quarter),
        (16, t[17] - quarter, 0, l5, 0),
        (17, t[18], 0, 0, -quarter),
        (18, t[19], 0, l6, 0),
        (12, t[20] + quarter, 0, 0, quarter),
        (20, t[21] + quarter, 0, 0, quarter),
        (21, t[22], -l8, 0, 0),
        (22, t[23], 0, 0, -quarter),
        (23, t[24] - quarter, 0, -l9, 0),
        (24, t[25], 0, 0, -quarter),
        (25, t[26], 0, -l10, 0),
    ]
    frames = [np.eye(4)]
    for before, turn, d, a, twist in rows:
        c, s, ca, sa = np.cos(turn), np.sin(turn), np.cos(twist), np.sin(twist)
        step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        frames.append(frames[before] @ np.array(step))
    return frames


# where the ten joints and the eleven segments are in the chain
JOINT_FRAMES = (3, 6, 9, 15, 17, 19, 12, 22, 24, 26)
SEGMENT_FRAMES = {
    "pelvis": 0,
    "lower_trunk": 3,
    "upper_trunk": 6,
    "clavicle_left": 9,
    "clavicle_right": 12,
    "upper_arm_left": 15,
    "upper_arm_right": 22,
    "forearm_left": 17,
    "forearm_right": 24,
    "hand_left": 19,
    "hand_right": 26,
}


def test_segments_of_the_t_pose_have_their_palms_down() -> None:
    """x forward, y left, z up of a hanging arm with the palm inwards, raised sideways."""
    posture = Schlagenhauf26().forward(np.zeros(26), LENGTHS)
    for name, rotation in zip(SEGMENT_FRAMES, posture.rotations, strict=True):
        arm = name.startswith(("upper_arm", "forearm", "hand"))
        raised = (90.0 if name.endswith("left") else -90.0) if arm else 0.0
        assert_allclose(rotation, Rotation.from_euler("x", raised, degrees=True).as_matrix(), atol=1e-15)


@pytest.mark.parametrize(
    ("angle", "axis"),
    # in world at the T-pose: her x is the left (+y), her y backward (-x), her z up
    [(1, "+z"), (2, "+y"), (3, "-x"), (4, "-x"), (5, "+z"), (6, "+y"), (7, "-x"), (8, "+z"), (9, "+y"), (10, "-x")]
    + [(11, "+z"), (12, "+y"), (13, "-x"), (14, "+z"), (15, "+y"), (16, "+y"), (17, "+z"), (18, "+z"), (19, "-x")]
    + [(20, "-x"), (21, "+z"), (22, "+y"), (23, "+y"), (24, "+z"), (25, "+z"), (26, "-x")],
)
def test_axes_at_the_t_pose_are_those_of_the_tables_not_of_table_3_4(angle: int, axis: str) -> None:
    """theta1 is axial and theta2 flexion, whatever table 3.4 calls them; theta15 and theta16 share their axis."""
    turning = Schlagenhauf26().linearise(np.zeros(26), LENGTHS).rotation_jacobian[:, :, angle - 1]
    moved = turning[np.abs(turning).max(axis=1) > 0.0]
    expected = np.eye(3)["xyz".index(axis[1])] * (1.0 if axis[0] == "+" else -1.0)
    assert len(moved) > 0
    assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=1e-15)


@given(theta=angles, length=lengths)
@settings(max_examples=draws(12, 50), deadline=None)
def test_it_is_the_product_of_her_matrices(theta: FloatArray, length: FloatArray) -> None:
    """Positions are eq. 5.18; each segment is rigid with its DH frame and stands on the joint that turns it."""
    frames, at_zero = np.array(dh_frames(theta, length)), np.array(dh_frames(np.zeros(26), length))
    base = TURN @ TO_WORLD
    posture, zero = PLACED.forward(theta, length), PLACED.forward(np.zeros(26), length)
    joints = frames[list(JOINT_FRAMES), :3, 3]
    assert_allclose(posture.positions, PLACE + joints @ base.T, rtol=0, atol=1e-14)

    assert PLACED.segment_names == tuple(SEGMENT_FRAMES)
    chosen = list(SEGMENT_FRAMES.values())
    turned = base @ frames[chosen, :3, :3] @ at_zero[chosen, :3, :3].swapaxes(1, 2) @ base.T
    assert_allclose(posture.rotations, turned @ zero.rotations, rtol=0, atol=1e-14)

    starts = dict.fromkeys(SEGMENT_FRAMES, 0) | {"upper_trunk": 3, "clavicle_left": 6, "clavicle_right": 6}
    starts |= {"upper_arm_left": 9, "forearm_left": 15, "hand_left": 17}
    starts |= {"upper_arm_right": 12, "forearm_right": 22, "hand_right": 24}
    origins = frames[[starts[name] for name in SEGMENT_FRAMES], :3, 3]
    assert_allclose(posture.origins, PLACE + origins @ base.T, rtol=0, atol=1e-14)


@given(theta=angles, length=lengths)
@settings(max_examples=draws(12, 50), deadline=None)
def test_the_jacobians_are_the_central_differences(theta: FloatArray, length: FloatArray) -> None:
    result = PLACED.linearise(theta, length)
    step = 1e-5
    ahead = PLACED.forward(PLACED.integrate(theta, step * np.eye(26)), length)
    behind = PLACED.forward(PLACED.integrate(theta, -step * np.eye(26)), length)
    slopes = (ahead.positions - behind.positions) / (2.0 * step)  # (26, 10, 3)
    assert_allclose(result.jacobian, slopes.transpose(1, 2, 0), rtol=0, atol=1e-7)

    turning = Rotation.from_matrix((ahead.rotations @ behind.rotations.swapaxes(-1, -2)).reshape(-1, 3, 3))
    rates = turning.as_rotvec().reshape(26, 11, 3) / (2.0 * step)
    assert_allclose(result.rotation_jacobian, rates.transpose(1, 2, 0), rtol=0, atol=1e-7)

    longer = PLACED.forward(theta, length + step * np.eye(10)).positions
    shorter = PLACED.forward(theta, length - step * np.eye(10)).positions
    stretch = ((longer - shorter) / (2.0 * step)).transpose(1, 2, 0)
    assert_allclose(result.length_jacobian, stretch, rtol=0, atol=1e-7)

    alone = PLACED.forward(theta, length)
    assert_array_equal(result.posture.positions, alone.positions)
    assert_array_equal(result.posture.origins, alone.origins)
    assert_array_equal(result.posture.rotations, alone.rotations)


def rank(theta: FloatArray) -> int:
    values = np.linalg.svd(PLACED.linearise(theta, LENGTHS).jacobian.reshape(30, 26), compute_uv=False)
    return int((values > 1e-9 * values[0]).sum())


def test_her_ten_joints_observe_20_of_26_angles_and_18_in_the_t_pose() -> None:
    rng = np.random.default_rng(0)
    assert {rank(theta) for theta in rng.uniform(-1.5, 1.5, size=(200, 26))} == {20}
    assert rank(np.zeros(26)) == 18


@given(theta=angles, turn=st.floats(-3.0, 3.0))
@settings(max_examples=draws(12, 25), deadline=None)
def test_theta15_and_theta16_are_redundant(theta: FloatArray, turn: float) -> None:
    """Not even the forearm's and the hand's rotations do: one turns as much as the other turns back."""
    opposite = np.zeros(26)
    opposite[[14, 21]], opposite[[15, 22]] = turn, -turn
    posture, other = PLACED.forward(theta, LENGTHS), PLACED.forward(theta + opposite, LENGTHS)
    assert_allclose(other.positions, posture.positions, rtol=0, atol=1e-14)
    outer = [k for k, name in enumerate(PLACED.segment_names) if name.startswith(("forearm", "hand"))]
    assert_allclose(other.rotations[outer], posture.rotations[outer], rtol=0, atol=1e-14)


def test_leading_dimensions_are_as_many_single_calls() -> None:
    rng = np.random.default_rng(1)
    theta, length = rng.normal(size=(2, 3, 26)), rng.uniform(0.1, 0.4, size=(3, 10))
    many, one_pose = PLACED.linearise(theta, length), PLACED.linearise(theta[0, 0], length)
    for i, j in np.ndindex(2, 3):
        single = PLACED.linearise(theta[i, j], length[j])
        for name in ("positions", "origins", "rotations"):
            together = getattr(many.posture, name)[i, j]
            assert_allclose(together, getattr(single.posture, name), rtol=0, atol=1e-14)
        for name in ("jacobian", "length_jacobian", "rotation_jacobian"):
            assert_allclose(getattr(many, name)[i, j], getattr(single, name), rtol=0, atol=1e-14)
    assert_allclose(one_pose.jacobian[0], many.jacobian[0, 0], rtol=0, atol=1e-14)
    assert one_pose.posture.rotations.shape == (3, 11, 3, 3)


def test_default_lengths_are_those_of_a_person() -> None:
    default = Schlagenhauf26().default_lengths(1.8)
    assert_allclose(default, 1.8 / 1.75 * Schlagenhauf26().default_lengths())
    assert_array_equal(default[2:6], default[6:])
    span = 2.0 * default[2:6].sum()
    assert 0.9 * 1.8 < span < 1.1 * 1.8  # the span of the arms is about the stature


def test_arrays_of_wrong_shape_raise() -> None:
    with pytest.raises(ModelError, match=r"angles \(25,\)"):
        PLACED.forward(np.zeros(25), LENGTHS)
    with pytest.raises(ModelError, match=r"lengths \(4, 9\)"):
        PLACED.linearise(np.zeros(26), np.zeros((4, 9)))
    with pytest.raises(ModelError, match="base position"):
        Schlagenhauf26(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ModelError, match="base rotation"):
        Schlagenhauf26(base_rotation=-np.eye(3))
    with pytest.raises(ModelError, match="base rotation"):
        Schlagenhauf26(base_rotation=np.eye(2))
