"""Chains as files: reading inverts writing, errors are named; URDF moves as the chain does."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from marker_people import random_joint, random_posture
from scipy.spatial.transform import Rotation

from body_tracking.core import files
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.chain import Chain
from body_tracking.markers.chain_files import ChainFileError, load_chain, save_chain, to_urdf
from body_tracking.markers.joint_model import JointKind, turn_angles
from body_tracking.markers.joint_tree import place, tree_of
from body_tracking.markers.stages import CONVENTION
from body_tracking.messages.codecs import Angles
from body_tracking.recording.rosbag2 import BAG_WIRE, deserialize


def a_chain(rng: np.random.Generator) -> Chain:
    joints = [
        random_joint(rng, JointKind.BALL, "shoulder", "torso", "upper_arm"),
        random_joint(rng, JointKind.HINGE, "elbow", "upper_arm", "forearm"),
        random_joint(rng, JointKind.UNIVERSAL, "neck", "torso", "head"),
    ]
    tree = tree_of(joints)
    root = 1e-4 * rng.normal(size=(36, 20))
    covariance = root @ root.T
    return Chain(tree.joints, covariance, rng.normal(size=(36, 5)), 1.25)


def test_a_chain_is_read_as_it_was_written(tmp_path: Path) -> None:
    chain = a_chain(np.random.default_rng(1))
    save_chain(chain, tmp_path / "chain.yaml")
    read = load_chain(tmp_path / "chain.yaml")
    assert read.names == chain.names and read.targets == chain.targets and read.scale == chain.scale
    assert np.array_equal(read.sensitivity, chain.sensitivity)
    assert np.allclose(read.covariance, chain.covariance, rtol=0, atol=1e-20)
    for a, b in zip(read.joints, chain.joints, strict=True):
        assert a.kind is b.kind
        assert np.abs(a.difference(b)).max() < 1e-12


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda data: data.pop("covariance"), "covariance"),
        (lambda data: data["covariance"].pop(), "36 rows"),
        (lambda data: data["covariance"][3].__setitem__(3, -1.0), "negative eigenvalue"),
        (lambda data: data["sensitivity"].pop(), "sensitivity"),
        (lambda data: data["joints"][1].pop("kind"), "kind"),
        (lambda data: data["joints"][1].__setitem__("kind", "slider"), "slider"),
        (lambda data: data["joints"][1].__setitem__("parent_centre", [0.0, float("nan"), 0.0]), "parent_centre"),
        (lambda data: data["joints"][1].__setitem__("child_quat_xyzw", [1.0, 1.0, 0.0, 0.0]), "child_quat_xyzw"),
        (lambda data: data["joints"][1].__setitem__("name", "el bow"), "el bow"),
        (lambda data: data["joints"][1].__setitem__("child", "head"), "two parents"),
        (lambda data: data["joints"].__setitem__(0, 3), "joint 3"),
        (lambda data: data.__setitem__("scale", "wide"), "wide"),
        (lambda data: data.__setitem__("joints", 5), "joints"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, change, named: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "chain.yaml"
    save_chain(a_chain(np.random.default_rng(2)), path)
    data = files.read_yaml(path)
    change(data)
    path.write_text(files.dump_yaml(data), encoding="utf-8")
    with pytest.raises(ChainFileError, match=named) as caught:
        load_chain(path)
    assert str(path) in str(caught.value)


def urdf_places(text: str, angles: dict[str, float]) -> dict[str, FloatArray]:
    """(4, 4) of each link in the root's frame."""
    robot = ElementTree.fromstring(text)
    joints = {joint.find("child").attrib["link"]: joint for joint in robot.iter("joint")}  # type: ignore[union-attr]

    def numbers(element: ElementTree.Element, key: str) -> FloatArray:
        return np.array([float(value) for value in element.attrib[key].split()])

    def pose(link: str) -> FloatArray:
        if link not in joints:
            return np.eye(4)
        joint = joints[link]
        origin, axis = joint.find("origin"), joint.find("axis")
        assert origin is not None
        local = np.eye(4)
        local[:3, :3] = Rotation.from_euler("xyz", numbers(origin, "rpy")).as_matrix()
        local[:3, 3] = numbers(origin, "xyz")
        if axis is not None:
            local[:3, :3] @= Rotation.from_rotvec(angles[joint.attrib["name"]] * numbers(axis, "xyz")).as_matrix()
        return pose(joint.find("parent").attrib["link"]) @ local  # type: ignore[union-attr]

    return {link.attrib["name"]: pose(link.attrib["name"]) for link in robot.iter("link")}


def test_the_urdf_moves_as_the_chain_does() -> None:
    rng = np.random.default_rng(3)
    chain = a_chain(rng)
    posture = random_posture(rng, chain.tree, 3)
    rotations, translations = place(chain.tree, posture)
    for frame in range(3):
        angles = {}
        for joint, turns in zip(chain.joints, posture.turns, strict=True):
            turn = turns[frame : frame + 1]
            if joint.kind is JointKind.BALL:
                values = Rotation.from_matrix(turn[0]).as_euler("XYZ")
            else:
                values = turn_angles(joint.kind, turn)[0]
            angles |= dict(zip((f"{name}_person" for name in joint.angle_names), values, strict=True))
        links = urdf_places(to_urdf(chain, "person"), angles)
        for index, target in enumerate(chain.targets):
            inverse = rotations[frame, 0].T
            assert np.allclose(links[target][:3, :3], inverse @ rotations[frame, index], atol=1e-9)
            arm = translations[frame, index] - translations[frame, 0]
            assert np.allclose(links[target][:3, 3], inverse @ arm, atol=1e-9)


def test_the_published_joint_states_move_the_urdf() -> None:
    chain = a_chain(np.random.default_rng(5))
    count = len(chain.angle_names)
    angles = JointAngles(0, chain.angle_names, *np.zeros((4, count)))
    message = deserialize(JOINT_STATE, Angles(setup.BODY, 0, lambda: CONVENTION).encode(angles, BAG_WIRE))
    robot = ElementTree.fromstring(to_urdf(chain, setup.BODY))
    moving = [joint.attrib["name"] for joint in robot.iter("joint") if joint.attrib["type"] == "revolute"]
    assert moving == list(message.name)


def test_no_urdf_of_a_name_that_ros_would_not_take() -> None:
    with pytest.raises(ChainFileError, match="a person"):
        to_urdf(a_chain(np.random.default_rng(4)), "a person")
