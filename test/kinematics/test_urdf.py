"""The person as URDF: Pinocchio reads it, and finds everything where the model has it."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.kinematics.conventions import angles_of, model_names
from body_tracking.kinematics.ranges import RANGES, Ranges
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.kinematics.urdf import UrdfError, urdf

MODEL = UpperBody()
NAMES = model_names(MODEL)


def _lengths(seed: int) -> FloatArray:
    lengths: FloatArray = MODEL.default_lengths() * np.random.default_rng(seed).uniform(0.7, 1.3, 21)
    return lengths


def _poses(count: int) -> FloatArray:
    ranges = Ranges(MODEL)
    rng = np.random.default_rng(2)
    v = np.zeros((count, MODEL.nv))
    v[:, 6:] = rng.uniform(ranges.low, ranges.high, size=(count, MODEL.nv - 6))
    return MODEL.integrate(MODEL.neutral(), v)


def _angles(q: FloatArray, lengths: FloatArray) -> dict[str, float]:
    estimate = ModelEstimate(0, "world", 0, q, np.zeros(32), np.zeros((64, 64)), lengths, np.zeros(21))
    angles = angles_of(estimate, MODEL, "model")
    return dict(zip(angles.names, angles.position.tolist(), strict=True))


def test_pinocchio_finds_every_segment_and_point_where_the_model_has_it() -> None:
    for number, q in enumerate(_poses(20)):
        lengths = _lengths(number)
        robot = pinocchio.buildModelFromXML(urdf(MODEL, lengths, "12"))
        data = robot.createData()
        assert robot.nq == 26
        angles = _angles(q, lengths)
        configuration = np.zeros(26)
        for name in NAMES:
            configuration[robot.joints[robot.getJointId(f"{name}_12")].idx_q] = angles[name]
        pinocchio.framesForwardKinematics(robot, data, configuration)
        posture = MODEL.forward(q, lengths)
        for segment, origin, rotation in zip(SEGMENTS, posture.origins, posture.rotations, strict=True):
            placement = data.oMf[robot.getFrameId(f"{segment}_12", pinocchio.FrameType.BODY)]
            np.testing.assert_allclose(placement.translation, origin, rtol=0, atol=1e-9, err_msg=segment)
            np.testing.assert_allclose(placement.rotation, rotation, rtol=0, atol=1e-9, err_msg=segment)
        for joint, position in zip(MODEL.joints.tolist(), posture.positions, strict=True):
            name = f"{Joint(joint).name.lower()}_point_12"
            placement = data.oMf[robot.getFrameId(name, pinocchio.FrameType.BODY)]
            np.testing.assert_allclose(placement.translation, position, rtol=0, atol=1e-9, err_msg=name)


def test_pinocchio_agrees_on_a_free_base_and_on_the_jacobian() -> None:
    q, lengths = _poses(1)[0], _lengths(0)
    q[:3] = 1.0, -2.0, 0.9
    q[MODEL.quaternion_of("pelvis")] = so3.exp(np.array([0.2, -0.4, 2.0]))
    robot = pinocchio.buildModelFromXML(urdf(MODEL, lengths, "12"), pinocchio.JointModelFreeFlyer())
    data = robot.createData()
    angles = _angles(q, lengths)
    configuration = np.zeros(33)
    configuration[:7] = q[:7]
    for name in NAMES:
        configuration[robot.joints[robot.getJointId(f"{name}_12")].idx_q] = angles[name]
    frame = robot.getFrameId("hand_tip_left_point_12", pinocchio.FrameType.BODY)
    jacobian = pinocchio.computeFrameJacobian(
        robot, data, configuration, frame, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    )
    pinocchio.framesForwardKinematics(robot, data, configuration)
    linear = MODEL.linearise(q, lengths)
    point = MODEL.joints.tolist().index(Joint.HAND_TIP_LEFT)
    np.testing.assert_allclose(data.oMf[frame].translation, linear.posture.positions[point], rtol=0, atol=1e-9)
    for coordinate in ("lumbar_flexion", "thoracic_axial", "clavicle_elevation_left", "elbow_flexion_left"):
        column = robot.joints[robot.getJointId(f"{coordinate}_12")].idx_v
        ours = linear.jacobian[point, :, MODEL.coordinate_names.index(coordinate)]
        np.testing.assert_allclose(jacobian[:3, column], ours, rtol=0, atol=1e-9)


def test_a_link_has_one_joint_above_it_and_the_pelvis_none() -> None:
    robot = ElementTree.fromstring(urdf(MODEL, MODEL.default_lengths(), "p7"))
    links = [link.get("name") for link in robot.findall("link")]
    joints = [joint.get("name") for joint in robot.findall("joint")]
    children = [joint.find("child").get("link") for joint in robot.findall("joint")]  # type: ignore[union-attr]
    parents = {joint.find("parent").get("link") for joint in robot.findall("joint")}  # type: ignore[union-attr]
    assert len(set(links)) == len(links)
    assert len(set(joints)) == len(joints)
    assert len(set(children)) == len(children)
    assert set(links) - set(children) == {"pelvis_p7"}
    assert parents <= set(links)
    assert all(str(name).endswith("_p7") for name in (*links, *joints))
    assert robot.find("link[@name='pelvis_p7']/inertial") is None  # KDL takes no inertia at the root


def test_every_angle_is_a_revolute_joint_with_its_range() -> None:
    robot = ElementTree.fromstring(urdf(MODEL, MODEL.default_lengths(), "p7"))
    revolute = {joint.get("name"): joint for joint in robot.findall("joint") if joint.get("type") == "revolute"}
    assert set(revolute) == {f"{name}_p7" for name in NAMES}
    for name in NAMES:
        limit = revolute[f"{name}_p7"].find("limit")
        assert limit is not None
        low, high = (np.degrees(float(limit.get(key, "nan"))) for key in ("lower", "upper"))
        assert low < 0.0 < high
        kind = name.removesuffix("_left").removesuffix("_right")
        if kind in RANGES:
            assert (low, high) == pytest.approx(RANGES[kind])
        assert float(limit.get("velocity", "nan")) > 0.0
        assert float(limit.get("effort", "nan")) > 0.0


def test_it_weighs_what_an_upper_body_weighs_and_its_inertias_are_possible() -> None:
    """A man of 1.75 m and 67 kg: head, trunk and arms are 60 % of it (de Leva)."""
    text = urdf(MODEL, MODEL.default_lengths(1.75), "0")
    robot = pinocchio.buildModelFromXML(text)
    free = pinocchio.buildModelFromXML(text, pinocchio.JointModelFreeFlyer())
    assert pinocchio.computeTotalMass(free) == pytest.approx(0.6028 * 22.0 * 1.75**2, rel=0.01)
    for inertia in robot.inertias[1:]:
        if inertia.mass > 0.0:
            moments = np.linalg.eigvalsh(inertia.inertia)
            assert moments[0] > 0.0
            assert moments[2] <= moments[0] + moments[1] + 1e-12  # triangle inequality
    height = pinocchio.centerOfMass(robot, robot.createData(), pinocchio.neutral(robot))
    assert abs(height[1]) < 1e-12


@pytest.mark.parametrize(
    ("body", "lengths", "said"),
    [(body, MODEL.default_lengths(), "body id") for body in ("", "a b", "a/b", "<", "ä")]
    + [("0", lengths, "positive metres") for lengths in (np.ones(20), np.zeros(21), np.full(21, np.nan))],
)
def test_ids_that_ros_would_not_take_and_lengths_of_nobody_are_refused(
    body: str, lengths: FloatArray, said: str
) -> None:
    with pytest.raises(UrdfError, match=said):
        urdf(MODEL, lengths, body)
