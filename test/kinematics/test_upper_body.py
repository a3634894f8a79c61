"""The default body model: laws of its kinematics, and the observability of its coordinates."""

from __future__ import annotations

import numpy as np
import pytest

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS, ModelError
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UNOBSERVED, UpperBody

MODEL = UpperBody()
LENGTHS = MODEL.default_lengths()
STEP = 1e-5


def _poses(count: int, seed: int = 3) -> FloatArray:
    """(count, 35) anywhere within the ranges of motion, bases anywhere."""
    rng = np.random.default_rng(seed)
    ranges = Ranges(MODEL)
    v = np.empty((count, MODEL.nv))
    v[:, :6] = rng.normal(size=(count, 6))
    v[:, 6:] = rng.uniform(ranges.low, ranges.high, size=(count, MODEL.nv - 6))
    return MODEL.integrate(MODEL.neutral(), v)


def _lengths(count: int, seed: int = 4) -> FloatArray:
    return LENGTHS * np.random.default_rng(seed).uniform(0.7, 1.3, size=(count, len(LENGTHS)))


def _point(joint: Joint) -> int:
    return int(np.flatnonzero(MODEL.joints == joint)[0])


def _moved(name: str, angle: float) -> FloatArray:
    v = np.zeros(MODEL.nv)
    v[MODEL.coordinate_names.index(name)] = angle
    return MODEL.integrate(MODEL.neutral(), v)


def _place(q: FloatArray, joint: Joint) -> FloatArray:
    place: FloatArray = MODEL.forward(q, LENGTHS).positions[_point(joint)]
    return place


def _null_space(q: FloatArray) -> FloatArray:
    """(k, 32) orthonormal directions that move none of the 19 points."""
    jacobian = MODEL.linearise(q, LENGTHS).jacobian.reshape(-1, MODEL.nv)
    _, values, directions = np.linalg.svd(jacobian)
    null: FloatArray = directions[int((values > 1e-9 * values[0]).sum()) :]
    return null


def test_neutral_is_a_person_who_stands_upright_and_faces_x() -> None:
    posture = MODEL.forward(MODEL.neutral(), LENGTHS)
    np.testing.assert_array_equal(posture.rotations, np.broadcast_to(np.eye(3), (12, 3, 3)))
    length = dict(zip(MODEL.length_names, LENGTHS, strict=True))
    trunk = length["lower_trunk"] + length["upper_trunk"]
    places = dict(zip(MODEL.joints.tolist(), posture.positions, strict=True))
    np.testing.assert_allclose(places[Joint.SPINE_SHOULDER], [0, 0, trunk], atol=1e-15)
    np.testing.assert_allclose(places[Joint.HEAD], [0, 0, trunk + length["neck"] + length["head"]], atol=1e-15)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        y = side * length[f"clavicle_{name}"]
        wrist = trunk - length[f"upper_arm_{name}"] - length[f"forearm_{name}"]
        np.testing.assert_allclose(places[Joint[f"SHOULDER_{name.upper()}"]], [0, y, trunk], atol=1e-15)
        np.testing.assert_allclose(places[Joint[f"WRIST_{name.upper()}"]], [0, y, wrist], atol=1e-15)
        assert places[Joint[f"THUMB_{name.upper()}"]][0] > 0.0  # thumbs forward


@pytest.mark.parametrize(
    ("name", "joint", "direction"),
    [
        ("lumbar_flexion", Joint.SPINE_SHOULDER, (1, 0, 0)),
        ("lumbar_lateral", Joint.SPINE_SHOULDER, (0, -1, 0)),
        ("lumbar_axial", Joint.SHOULDER_RIGHT, (1, 0, 0)),
        ("thoracic_flexion", Joint.SPINE_SHOULDER, (1, 0, 0)),
        ("thoracic_lateral", Joint.SPINE_SHOULDER, (0, -1, 0)),
        ("thoracic_axial", Joint.SHOULDER_RIGHT, (1, 0, 0)),
        ("neck_flexion", Joint.HEAD, (1, 0, 0)),
        ("neck_lateral", Joint.HEAD, (0, -1, 0)),
        ("clavicle_protraction_left", Joint.SHOULDER_LEFT, (1, 0, 0)),
        ("clavicle_protraction_right", Joint.SHOULDER_RIGHT, (1, 0, 0)),
        ("clavicle_elevation_left", Joint.SHOULDER_LEFT, (0, 0, 1)),
        ("clavicle_elevation_right", Joint.SHOULDER_RIGHT, (0, 0, 1)),
        ("elbow_flexion_left", Joint.WRIST_LEFT, (1, 0, 0)),
        ("elbow_flexion_right", Joint.WRIST_RIGHT, (1, 0, 0)),
        ("forearm_pronation_left", Joint.THUMB_LEFT, (0, -1, 0)),
        ("forearm_pronation_right", Joint.THUMB_RIGHT, (0, 1, 0)),
        ("wrist_flexion_left", Joint.HAND_TIP_LEFT, (0, -1, 0)),
        ("wrist_flexion_right", Joint.HAND_TIP_RIGHT, (0, 1, 0)),
        ("wrist_deviation_left", Joint.HAND_TIP_LEFT, (1, 0, 0)),
        ("wrist_deviation_right", Joint.HAND_TIP_RIGHT, (1, 0, 0)),
    ],
)
def test_an_angle_is_positive_in_the_direction_of_its_name(name: str, joint: Joint, direction: tuple[int, ...]) -> None:
    step = _place(_moved(name, 0.01), joint) - _place(MODEL.neutral(), joint)
    assert step @ np.array(direction) / np.linalg.norm(step) > 0.99


def test_mirrored_angles_are_the_mirrored_person() -> None:
    rng = np.random.default_rng(8)
    v = np.zeros(MODEL.nv)
    v[6:] = rng.uniform(-0.6, 0.6, MODEL.nv - 6)
    mirrored = np.zeros(MODEL.nv)
    names = MODEL.coordinate_names
    for number, name in enumerate(names[6:], start=6):
        other = name.replace("left", "*").replace("right", "left").replace("*", "right")
        # about x and z a mirrored rotation has the other sense; the named angles say so already, but the trunk's do not
        flips = name.startswith(("shoulder_x", "shoulder_z")) or name.endswith(("lateral", "axial"))
        mirrored[names.index(other)] = -v[number] if flips else v[number]
    one = MODEL.forward(MODEL.integrate(MODEL.neutral(), v), LENGTHS).positions
    two = MODEL.forward(MODEL.integrate(MODEL.neutral(), mirrored), LENGTHS).positions
    order = [
        _point(Joint[Joint(j).name.replace("LEFT", "*").replace("RIGHT", "LEFT").replace("*", "RIGHT")])
        for j in MODEL.joints
    ]
    np.testing.assert_allclose(two[order], one * [1.0, -1.0, 1.0], atol=1e-14)


def test_jacobians_of_positions_and_rotations_against_differences() -> None:
    q, lengths = _poses(20), _lengths(20)
    analytic = MODEL.linearise(q, lengths)
    step = STEP * np.eye(MODEL.nv)
    plus, minus = (MODEL.forward(MODEL.integrate(q[:, None], s * step), lengths[:, None]) for s in (1.0, -1.0))
    moved = (plus.positions - minus.positions) / (2.0 * STEP)
    turned = so3.rotation_vectors(plus.rotations @ minus.rotations.swapaxes(-1, -2)) / (2.0 * STEP)
    np.testing.assert_allclose(analytic.jacobian, np.moveaxis(moved, 1, -1), rtol=0, atol=1e-7)
    np.testing.assert_allclose(analytic.rotation_jacobian, np.moveaxis(turned, 1, -1), rtol=0, atol=1e-7)


def test_one_segment_turns_as_it_does_among_all() -> None:
    q = _poses(10)
    lines = MODEL.linearise(q, LENGTHS)
    for segment in range(len(SEGMENTS)):
        rotation, turning = MODEL.turning(q, segment)
        np.testing.assert_array_equal(rotation, lines.posture.rotations[:, segment])
        np.testing.assert_array_equal(turning, lines.rotation_jacobian[:, segment])
        np.testing.assert_allclose(MODEL.turning(q[3], segment)[1], turning[3], rtol=0, atol=1e-14)


def test_positions_are_linear_in_the_lengths() -> None:
    q, lengths = _poses(20), _lengths(20)
    linear = MODEL.linearise(q, lengths)
    from_lengths = (linear.length_jacobian @ lengths[:, None, :, None])[..., 0]
    np.testing.assert_allclose(linear.posture.positions - q[:, None, :3], from_lengths, rtol=0, atol=1e-14)
    step = 1e-3 * np.eye(len(LENGTHS))
    plus = MODEL.forward(q[:, None], lengths[:, None] + step).positions
    minus = MODEL.forward(q[:, None], lengths[:, None] - step).positions
    numeric = np.moveaxis((plus - minus) / 2e-3, 1, -1)
    np.testing.assert_allclose(linear.length_jacobian, numeric, rtol=0, atol=1e-11)


def test_integrate_and_difference_are_inverse_to_each_other() -> None:
    q0, q1 = _poses(200, seed=1), _poses(200, seed=2)
    v = MODEL.difference(q0, q1)
    back = MODEL.integrate(q0, v)
    np.testing.assert_allclose(MODEL.difference(q1, back), 0.0, atol=1e-12)
    small = np.random.default_rng(9).uniform(-1.5, 1.5, size=(200, MODEL.nv))
    np.testing.assert_allclose(MODEL.difference(q0, MODEL.integrate(q0, small)), small, rtol=0, atol=1e-12)
    np.testing.assert_allclose(MODEL.integrate(q0, np.zeros(MODEL.nv)), q0, rtol=0, atol=1e-15)


def test_configurations_keep_unit_quaternions() -> None:
    q = MODEL.neutral()
    rng = np.random.default_rng(12)
    for _ in range(500):
        q = MODEL.integrate(q, rng.normal(size=MODEL.nv))
    for segment in ("pelvis", "upper_arm_left", "upper_arm_right"):
        assert np.linalg.norm(q[MODEL.quaternion_of(segment)]) == pytest.approx(1.0, abs=1e-14)


def test_many_at_once_are_each_alone() -> None:
    q, lengths = _poses(6).reshape(2, 3, -1), _lengths(6).reshape(2, 3, -1)
    v = np.random.default_rng(1).normal(size=(2, 3, MODEL.nv))
    together, moved, apart = MODEL.linearise(q, lengths), MODEL.integrate(q, v), MODEL.difference(q, q[::-1])
    for index in np.ndindex(2, 3):
        alone, forward = MODEL.linearise(q[index], lengths[index]), MODEL.forward(q[index], lengths[index])
        for name in ("positions", "origins", "rotations"):
            many = getattr(together.posture, name)[index]
            np.testing.assert_allclose(many, getattr(alone.posture, name), rtol=0, atol=1e-14)
            np.testing.assert_allclose(many, getattr(forward, name), rtol=0, atol=1e-14)
        for name in ("jacobian", "length_jacobian", "rotation_jacobian"):
            np.testing.assert_allclose(getattr(together, name)[index], getattr(alone, name), rtol=0, atol=1e-14)
        # lengths without the dimensions of time go with configurations that have them
        shared = MODEL.linearise(q, lengths[0, 0]).jacobian
        np.testing.assert_allclose(shared[index], MODEL.linearise(q[index], lengths[0, 0]).jacobian, rtol=0, atol=1e-14)
        np.testing.assert_allclose(moved[index], MODEL.integrate(q[index], v[index]), rtol=0, atol=1e-14)
        np.testing.assert_allclose(apart[index], MODEL.difference(q[index], q[::-1][index]), rtol=0, atol=1e-14)


def test_the_points_determine_30_of_32_directions() -> None:
    jacobian = MODEL.linearise(_poses(100), LENGTHS).jacobian.reshape(100, 57, MODEL.nv)
    values = np.linalg.svd(jacobian, compute_uv=False)
    assert (values[:, 29] > 1e-4).all()
    assert (values[:, 30] < 1e-12).all()


def _straightened(q: FloatArray, *starts: str) -> FloatArray:
    """The same pose with flexion and lateral angles of these joints at zero."""
    v = np.zeros(MODEL.nv)
    for number, name in enumerate(MODEL.coordinate_names):
        if name.startswith(starts) and name.endswith(("flexion", "lateral")):
            v[number] = -MODEL.difference(MODEL.neutral(), q)[number]
    return MODEL.integrate(q, v)


def _touched(null: FloatArray) -> set[str]:
    return {MODEL.coordinate_names[number] for number in np.flatnonzero(np.abs(null).max(axis=0) > 1e-9)}


@pytest.mark.parametrize("bent", [(), ("neck",)], ids=["straight", "neck bent"])
def test_the_undetermined_directions_touch_exactly_the_unobserved_angles(bent: tuple[str, ...]) -> None:
    """Of a straight trunk, whatever the arms do and however it is twisted; a bent neck's angles depend on the twist."""
    straight = [part for part in ("lumbar", "thoracic", "neck") if part not in bent]
    for q in _poses(20):
        null = _null_space(_straightened(q, *straight))
        assert null.shape == (2, MODEL.nv)
        assert _touched(null) == {
            *UNOBSERVED,
            *(f"{part}_{angle}" for part in bent for angle in ("flexion", "lateral")),
        }


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_straight_elbow_adds_the_humerus_turning_against_pronation(side: str) -> None:
    other = "right" if side == "left" else "left"
    null = _null_space(_moved(f"elbow_flexion_{other}", np.pi / 2))
    touched = _touched(null)
    assert null.shape == (3, MODEL.nv)
    assert f"forearm_pronation_{side}" in touched
    assert f"shoulder_z_{side}" in touched
    assert f"forearm_pronation_{other}" not in touched


@pytest.mark.parametrize(("nq", "nl"), [(34, 21), (35, 20)])
def test_configurations_of_wrong_shape_raise(nq: int, nl: int) -> None:
    with pytest.raises(ModelError, match=r"upper_body: .* expected"):
        MODEL.forward(np.zeros(nq), np.zeros(nl))
    with pytest.raises(ModelError, match=r"upper_body: .* expected"):
        MODEL.linearise(np.zeros(nq), np.zeros(nl))


def test_compiled_kinematics_of_one_configuration_are_those_of_many() -> None:
    compiled, lengths = CompiledUpperBody(), _lengths(20)
    tangents = np.random.default_rng(8).normal(size=(20, MODEL.nv))
    for q, own, v in zip(_poses(20), lengths, tangents, strict=True):
        np.testing.assert_allclose(compiled.integrate(q, v), MODEL.integrate(q, v), rtol=0, atol=1e-14)
        one, many = compiled.linearise(q, own), MODEL.linearise(q, own)
        for posture in (one.posture, compiled.forward(q, own)):
            for name in ("positions", "origins", "rotations"):
                np.testing.assert_allclose(getattr(posture, name), getattr(many.posture, name), rtol=0, atol=1e-14)
        for name in ("jacobian", "length_jacobian", "rotation_jacobian"):
            np.testing.assert_allclose(getattr(one, name), getattr(many, name), rtol=0, atol=1e-14)
        spread = np.cov(tangents.T)
        np.testing.assert_allclose(compiled.curvature(one, spread), MODEL.curvature(many, spread), rtol=0, atol=1e-13)
    for segment in range(len(SEGMENTS)):
        for own, other in zip(compiled.turning(q, segment), MODEL.turning(q, segment), strict=True):
            np.testing.assert_allclose(own, other, rtol=0, atol=1e-14)
