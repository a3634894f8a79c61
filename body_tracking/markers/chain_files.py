"""Chains as YAML files, and as URDF."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from body_tracking.core import files, so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import MAX_RANGE, FloatArray
from body_tracking.kinematics.urdf import GREATEST_RATE, GREATEST_TORQUE, numbers
from body_tracking.markers.chain import Chain
from body_tracking.markers.joint_model import SIZE, Joint, JointKind

_HEADER = """\
# Kinematic chain written by body_tracking. Of each joint its frame in the parent target and in the child target: centre
# (metres) and orientation (unit quaternion x y z w); a hinge turns about z of both, a universal joint first about z of
# the parent's, then about z of the child's. covariance: lower triangle, row by row, of all joints' parameters: parent
# centre, parent rotation, child centre, child rotation (metres, radians), joint by joint. scale: errors of the fit in
# units of the poses' noise. sensitivity: derivative of the parameters by those of the cameras' calibration.
"""


class ChainFileError(BodyTrackingError):
    """Raised for a chain file that cannot be written or read or has an invalid value, or a chain without a URDF."""


def save_chain(chain: Chain, path: Path) -> None:
    """Write a chain; replaces the file atomically.

    Raises:
        ChainFileError: the file cannot be written.
    """
    content = {
        "scale": float(chain.scale),
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind.value,
                "parent": joint.parent,
                "child": joint.child,
                "parent_centre": joint.parent_centre.tolist(),
                "parent_quat_xyzw": so3.matrix_to_quat(joint.parent_rotation).tolist(),
                "child_centre": joint.child_centre.tolist(),
                "child_quat_xyzw": so3.matrix_to_quat(joint.child_rotation).tolist(),
            }
            for joint in chain.joints
        ],
        "sensitivity": chain.sensitivity.tolist(),
        "covariance": [row[: index + 1].tolist() for index, row in enumerate(chain.covariance)],
    }
    text = _HEADER + files.dump_yaml(content, default_flow_style=None, width=120)
    files.write_text(path, text, ChainFileError)


def load_chain(path: Path) -> Chain:
    """Read a chain.

    Raises:
        ChainFileError: the file is missing, is not YAML, or lacks or misstates a value; the message names the value.
    """
    data = files.read_yaml(path, aliases=False, error=ChainFileError)
    if not isinstance(data, dict) or not isinstance(data.get("joints"), list):
        raise ChainFileError(f"{path}: expected the keys scale, joints, covariance and sensitivity")
    try:
        count = SIZE * len(data["joints"])
        covariance = _triangle(data["covariance"], count)
        joints = tuple(
            _joint(entry, covariance[SIZE * index : SIZE * (index + 1), SIZE * index : SIZE * (index + 1)])
            for index, entry in enumerate(data["joints"])
        )
        sensitivity = np.asarray(data["sensitivity"], dtype=float)
        return Chain(joints, covariance, sensitivity, float(data["scale"]))
    except BodyTrackingError as error:
        raise ChainFileError(f"{path}: {error}") from error
    except KeyError as error:
        raise ChainFileError(f"{path}: lacks {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ChainFileError(f"{path}: {error}") from error


def _triangle(rows: Any, count: int) -> FloatArray:
    if not isinstance(rows, list) or [len(row) for row in rows] != list(range(1, count + 1)):
        raise ValueError(f"covariance: expected {count} rows of 1 to {count} numbers")
    covariance = np.zeros((count, count))
    for index, row in enumerate(rows):
        covariance[index, : index + 1] = covariance[: index + 1, index] = _numbers(row, "covariance", index + 1)
    values = np.linalg.eigvalsh(covariance) if count else np.zeros(1)
    if values[0] < -1e-9 * max(values[-1], 0.0):
        raise ValueError("covariance: has a negative eigenvalue")
    return covariance


def _joint(entry: Any, covariance: FloatArray) -> Joint:
    if not isinstance(entry, dict):
        raise ValueError(f"joint {entry!r}: expected keys and values")
    name = str(entry["name"])
    rotations, centres = [], []
    for side in ("parent", "child"):
        quaternion = _numbers(entry[f"{side}_quat_xyzw"], f"joint {name}: {side}_quat_xyzw", 4)
        norm = float(np.linalg.norm(quaternion))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"joint {name}: {side}_quat_xyzw has length {norm:.3g}, not 1")
        rotations.append(so3.quat_to_matrix(quaternion / norm))
        centre = _numbers(entry[f"{side}_centre"], f"joint {name}: {side}_centre", 3)
        if (np.abs(centre) > MAX_RANGE).any():
            raise ValueError(f"joint {name}: {side}_centre {centre}, expected at most {MAX_RANGE:g} m")
        centres.append(centre)
    return Joint(
        name,
        str(entry["parent"]),
        str(entry["child"]),
        JointKind(entry["kind"]),
        rotations[0],
        centres[0],
        rotations[1],
        centres[1],
        covariance,
    )


def _numbers(values: Any, what: str, count: int) -> FloatArray:
    result = np.asarray(values, dtype=float)
    if result.shape != (count,) or not np.isfinite(result).all():
        raise ValueError(f"{what}: expected {count} finite numbers")
    return result


def to_urdf(chain: Chain, body: str) -> str:
    """The chain as URDF: a link per target, in the target's own frame, the root target first.

    A revolute joint per angle, named ``<angle>_<body>`` as in the ``joint_states`` of :data:`setup.BODY`. Empty links
    ``<angle>_link`` connect the revolute joints of one joint; a fixed joint ``<joint>_mounting`` leads from the last
    one to the child target. Masses are not measured, so there are none.

    Raises:
        ChainFileError: a name with characters other than letters, digits and underscores, or a name used twice among
            the links or the joints.
    """
    robot = ElementTree.Element("robot", name=body)
    for target in chain.targets:
        ElementTree.SubElement(robot, "link", name=target)
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for joint in chain.joints:
        link, centre, rotation = joint.parent, joint.parent_centre, joint.parent_rotation
        axes = np.eye(3) if joint.kind is JointKind.BALL else np.tile([0.0, 0.0, 1.0], (joint.kind.coordinates, 1))
        for angle, axis in zip(joint.angle_names, axes, strict=True):
            element = _connect(robot, f"{angle}_{body}", "revolute", link, f"{angle}_link", centre, rotation)
            ElementTree.SubElement(element, "axis", xyz=numbers(axis))
            limits = {"lower": -2.0 * np.pi, "upper": 2.0 * np.pi, "effort": GREATEST_TORQUE, "velocity": GREATEST_RATE}
            ElementTree.SubElement(element, "limit", {key: repr(float(value)) for key, value in limits.items()})
            link = f"{angle}_link"
            ElementTree.SubElement(robot, "link", name=link)
            centre, rotation = np.zeros(3), quarter if joint.kind is JointKind.UNIVERSAL else np.eye(3)
        back = joint.child_rotation.T
        _connect(robot, f"{joint.name}_mounting", "fixed", link, joint.child, -back @ joint.child_centre, back)
    for kind in ("link", "joint"):
        found = [element.attrib["name"] for element in robot.iter(kind)]
        wrong = [each for each in [body, *found] if not re.fullmatch(r"\w+", each, re.ASCII)]
        wrong += [each for each in found if found.count(each) > 1]
        if wrong:
            raise ChainFileError(
                f"urdf: {kind} {wrong[0]!r}, expected a name of its own of letters, digits and underscores"
            )
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _connect(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, place: FloatArray, rotation: FloatArray
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=numbers(place), rpy=numbers(_roll_pitch_yaw(rotation)))
    return joint


def _roll_pitch_yaw(rotation: FloatArray) -> FloatArray:
    """(3,) radians, in URDF's convention ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
    level = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])
