"""The measured person as URDF, for robot_state_publisher, RViz, Pinocchio and planners.

One revolute joint for each angle of the ``model`` convention (the 26 of the model, shoulders as three joints one after
the other), named ``<angle>_<body>``: a ``joint_states`` message in that convention moves it. The root is the pelvis,
link ``pelvis_<body>``; the links are the model's segments, whose frames are the model's own, with links between them
where a joint has several axes, and an empty link ``<joint>_point_<body>`` at each modelled joint of the skeleton.

Masses by de Leva, J. Biomech. 29 (1996) 1223, table 4 (men), of a person with a body mass index of 22. Of the trunk's
mass each clavicle carries a small part. Inertias are those of the drawn cylinders and spheres. The root has no inertia,
which KDL cannot represent: the pelvis' own is in ``hips_<body>``, fixed to it.
"""

from __future__ import annotations

import re
from typing import Final
from xml.etree import ElementTree

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.kinematics.conventions import SHOULDER_USUAL, model_names
from body_tracking.kinematics.ranges import RANGES
from body_tracking.kinematics.upper_body import SHOULDER_AXES, UpperBody

GREATEST_RATE = 30.0
"""rad/s in every joint's limit: the fastest that people turn a joint, but for throwing."""
GREATEST_TORQUE = 150.0
"""N m in every joint's limit: of a strong person's shoulder or trunk."""

_BODY_MASS_INDEX = 22.0
# segment: share of the body's mass, radius as share of the stature, and the points that it carries; its bone runs from
# its joint to the last of them
_SEGMENTS: Final[dict[str, tuple[float, float, tuple[Joint, ...]]]] = {
    "pelvis": (0.1117, 0.05, (Joint.SPINE_BASE, Joint.HIP_LEFT, Joint.HIP_RIGHT)),
    "lower_trunk": (0.1633, 0.06, (Joint.SPINE_MID,)),
    "upper_trunk": (0.1496, 0.06, (Joint.SPINE_SHOULDER, Joint.NECK)),
    "head": (0.0694, 0.055, (Joint.HEAD,)),
} | {
    f"{segment}_{side}": (mass, radius, tuple(Joint[f"{name}_{side.upper()}"] for name in names))
    for side in ("left", "right")
    for segment, mass, radius, names in (
        ("clavicle", 0.005, 0.02, ("SHOULDER",)),
        ("upper_arm", 0.0271, 0.026, ("ELBOW",)),
        ("forearm", 0.0162, 0.021, ("WRIST",)),
        ("hand", 0.0061, 0.015, ("THUMB", "HAND", "HAND_TIP")),
    )
}


class UrdfError(BodyTrackingError):
    """No person's lengths, or a name that URDF or ROS would not take."""


def urdf(model: UpperBody, lengths: FloatArray, body: str) -> str:
    """The person as an XML text.

    Args:
        model: the body model.
        lengths: (nl,) metres.
        body: the body's id, of letters, digits and underscores; every name ends in it.

    Raises:
        UrdfError: lengths that are not positive and finite, or an id with other characters.
    """
    lengths = np.asarray(lengths, dtype=float)
    if lengths.shape != (len(model.length_names),) or not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise UrdfError(f"urdf: lengths {lengths.tolist()}, expected {len(model.length_names)} positive metres")
    if not re.fullmatch(r"\w+", body, re.ASCII):
        raise UrdfError(f"urdf: body id {body!r}, expected letters, digits and underscores")

    zero = model.neutral()
    posture = model.forward(zero, lengths)
    # at zero all frames are aligned with the world: places and axes in world are those in the segments
    axes = model.linearise(zero, lengths).rotation_jacobian
    names = model_names(model)
    places = dict(zip(model.joints.tolist(), posture.positions, strict=True))
    stature = float(lengths.sum() / model.default_lengths(1.0).sum())

    robot = ElementTree.Element("robot", name=f"person_{body}")
    for colour, rgba in (("trunk", "0.35 0.45 0.6 1"), ("limb", "0.85 0.65 0.5 1")):
        ElementTree.SubElement(ElementTree.SubElement(robot, "material", name=colour), "color", rgba=rgba)
    _link(robot, f"pelvis_{body}")
    _fixed(robot, f"hips_{body}", f"pelvis_{body}", f"hips_{body}", np.zeros(3))
    for number, segment in enumerate(model.segment_names):
        mass, radius, points = _SEGMENTS[segment]
        parent = model.parents[number]
        if parent >= 0:
            link = f"{model.segment_names[parent]}_{body}"
            place = posture.origins[number] - posture.origins[parent]
            coordinates = range(model.nv)[model.segment_coordinates[number]]
            side = segment.rsplit("_", 1)[-1]
            for count, coordinate in enumerate(coordinates):
                name = names[coordinate - 6]
                if segment.startswith("upper_arm"):
                    axis, (low, high) = SHOULDER_AXES[side][count], SHOULDER_USUAL[count]
                else:
                    axis = axes[number, :, coordinate]
                    low, high = RANGES[name.removesuffix(f"_{side}")]
                last = count == len(coordinates) - 1
                child = f"{segment}_{body}" if last else f"{name}_link_{body}"
                _revolute(robot, f"{name}_{body}", link, child, place, axis, np.radians([low, high]))
                if not last:
                    _link(robot, child)
                link, place = child, np.zeros(3)
        own = {point: places[point] - posture.origins[number] for point in points}
        solid = _link(robot, f"{segment if parent >= 0 else 'hips'}_{body}")
        start = own[Joint.HIP_LEFT] if segment == "pelvis" else np.zeros(3)
        _draw(solid, start, own[points[-1]], radius * stature, mass * _BODY_MASS_INDEX * stature**2, segment)
        if segment.startswith("hand"):
            _cylinder(solid, np.zeros(3), own[points[0]], 0.5 * radius * stature, "limb")
        for point, offset in own.items():
            name = f"{point.name.lower()}_point_{body}"
            _fixed(robot, name, f"{segment}_{body}", name, offset)
            _link(robot, name)
    ElementTree.indent(robot)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def numbers(values: FloatArray) -> str:
    """Numbers as the text of an attribute."""
    # adding zero makes -0 a 0
    return " ".join(repr(float(value) + 0.0) for value in values)


def _link(robot: ElementTree.Element, name: str) -> ElementTree.Element:
    return ElementTree.SubElement(robot, "link", name=name)


def _connect(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, place: FloatArray
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=numbers(place), rpy="0 0 0")
    return joint


def _fixed(robot: ElementTree.Element, name: str, parent: str, child: str, place: FloatArray) -> None:
    _connect(robot, name, "fixed", parent, child, place)


def _revolute(
    robot: ElementTree.Element,
    name: str,
    parent: str,
    child: str,
    place: FloatArray,
    axis: FloatArray,
    limits: FloatArray,
) -> None:
    joint = _connect(robot, name, "revolute", parent, child, place)
    ElementTree.SubElement(joint, "axis", xyz=numbers(axis))
    ElementTree.SubElement(
        joint,
        "limit",
        lower=repr(float(limits[0])),
        upper=repr(float(limits[1])),
        effort=str(GREATEST_TORQUE),
        velocity=str(GREATEST_RATE),
    )


def _draw(
    link: ElementTree.Element, start: FloatArray, end: FloatArray, radius: float, mass: float, segment: str
) -> None:
    """The shape of a segment and its inertia: a ball at the end for the head, else a cylinder along the bone."""
    colour = "trunk" if segment in ("pelvis", "lower_trunk", "upper_trunk") else "limb"
    if segment == "head":
        centre, rotation, inertia = end, np.zeros(3), np.full(3, 0.4 * mass * radius**2)
        visual = ElementTree.SubElement(link, "visual")
        ElementTree.SubElement(visual, "origin", xyz=numbers(centre), rpy="0 0 0")
        ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), "sphere", radius=repr(radius))
        ElementTree.SubElement(visual, "material", name=colour)
    else:
        length = float(np.linalg.norm(end - start))
        centre, rotation = _cylinder(link, start, end, radius, colour)
        across = mass * (3.0 * radius**2 + length**2) / 12.0
        inertia = np.array([across, across, 0.5 * mass * radius**2])
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=numbers(centre), rpy=numbers(rotation))
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    ixx, iyy, izz = (repr(float(moment)) for moment in inertia)
    ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")


def _cylinder(
    link: ElementTree.Element, start: FloatArray, end: FloatArray, radius: float, colour: str
) -> tuple[FloatArray, FloatArray]:
    """A cylinder between two points; its centre, and the roll, pitch and yaw that turn z along it."""
    bone = end - start
    length = float(np.linalg.norm(bone))
    x, y, z = bone / length
    centre = 0.5 * (start + end)
    rotation = np.array([np.arcsin(-y), np.arctan2(x, z), 0.0])
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=numbers(centre), rpy=numbers(rotation))
    ElementTree.SubElement(
        ElementTree.SubElement(visual, "geometry"), "cylinder", radius=repr(radius), length=repr(length)
    )
    ElementTree.SubElement(visual, "material", name=colour)
    return centre, rotation
