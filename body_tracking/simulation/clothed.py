"""MakeHuman's people driven by the simulator's motions.

Each bone of the rig is rotated as its segment of :class:`~body_tracking.kinematics.upper_body.UpperBody`. Bends of
spine and neck are distributed over their bones, as are the twists of upper arm and forearm, like skin. The true joints
are the rig's own; those of arms and legs are defined as in the tracker's body model, by the same helper cubes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import N_JOINTS, FloatArray, Joint
from body_tracking.mesh.anatomy import bone_frame
from body_tracking.simulation.makehuman import Body
from body_tracking.simulation.people import MODEL, Course, Person, joints

_SIDES: Final = (("left", "L", 0), ("right", "R", 1))
_SEGMENT: Final = {name: number for number, name in enumerate(MODEL.segment_names)}
# bone: the two segments that it interpolates, and the share of the second
_TRUNK: Final = {
    "root": ("pelvis", "pelvis", 0.0),
    "spine05": ("pelvis", "pelvis", 0.0),
    "spine04": ("pelvis", "lower_trunk", 0.5),
    "spine03": ("lower_trunk", "lower_trunk", 0.0),
    "spine02": ("lower_trunk", "upper_trunk", 0.5),
    "spine01": ("upper_trunk", "upper_trunk", 0.0),
    "neck01": ("upper_trunk", "head", 0.25),
    "neck02": ("upper_trunk", "head", 0.5),
    "neck03": ("upper_trunk", "head", 0.75),
    "head": ("head", "head", 0.0),
}
_HEAD_CENTRE: Final = 0.05
"""Height of the head's centre above its joint, as a share of the stature."""
_ARM_JOINTS: Final = (("SHOULDER", "upperarm01"), ("ELBOW", "lowerarm01"), ("WRIST", "wrist"))
_LEG_JOINTS: Final = (("HIP", "upperleg01"), ("KNEE", "lowerleg01"), ("ANKLE", "foot"), ("FOOT", "toe2-1"))
_HAND_JOINTS: Final = (("HAND", "finger3-1"), ("HAND_TIP", "finger3-3"), ("THUMB", "finger1-3"))


@dataclass(frozen=True, slots=True, eq=False)
class ClothedPerson:
    """A person with a surface.

    Attributes:
        body: MakeHuman's.
        person: the simulator's person with the lengths between the body's joints, for its motions.
    """

    body: Body
    person: Person

    @classmethod
    def of(cls, body: Body) -> ClothedPerson:
        """The person with this body."""
        rest = _kinect_joints(body, body.heads, np.eye(3))
        stature = float(body.vertices[:, 2].max())
        lengths = MODEL.default_lengths(stature)

        def between(one: Joint, other: Joint) -> float:
            return float(np.linalg.norm(rest[one] - rest[other]))

        pairs: dict[str, tuple[Joint, Joint]] = {
            "lower_trunk": (Joint.SPINE_BASE, Joint.SPINE_MID),
            "upper_trunk": (Joint.SPINE_MID, Joint.SPINE_SHOULDER),
            "neck": (Joint.SPINE_SHOULDER, Joint.NECK),
            "head": (Joint.NECK, Joint.HEAD),
        }
        for side, _, _ in _SIDES:
            joint = {name: Joint[f"{name}_{side.upper()}"] for name in ("SHOULDER", "ELBOW", "WRIST")}
            pairs[f"clavicle_{side}"] = Joint.SPINE_SHOULDER, joint["SHOULDER"]
            pairs[f"upper_arm_{side}"] = joint["SHOULDER"], joint["ELBOW"]
            pairs[f"forearm_{side}"] = joint["ELBOW"], joint["WRIST"]
            width = abs(rest[Joint[f"HIP_{side.upper()}"]][1])
            lengths[MODEL.length_names.index(f"hip_width_{side}")] = width
        for name, ends in pairs.items():
            lengths[MODEL.length_names.index(name)] = between(*ends)
        hips = 0.5 * (rest[Joint.HIP_LEFT] + rest[Joint.HIP_RIGHT])
        lengths[MODEL.length_names.index("hip_drop")] = max(rest[Joint.SPINE_BASE][2] - hips[2], 0.0)
        legs = [
            np.array([between(Joint[f"{a}_{side.upper()}"], Joint[f"{b}_{side.upper()}"]) for side, _, _ in _SIDES])
            for a, b in (("HIP", "KNEE"), ("KNEE", "ANKLE"))
        ]
        ankle, foot = rest[Joint.ANKLE_LEFT][2], between(Joint.ANKLE_LEFT, Joint.FOOT_LEFT)
        person = Person(body.sex, stature, 25.0 * stature**2, lengths, legs[0], legs[1], float(ankle), foot)
        return cls(body, person)

    def posed(self, course: Course, instant: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The surface at one instant of a course.

        Returns:
            (N, 3) vertices, (25, 3) joints, metres in the course's frame, and (12, 3, 3) rotations of the segments.
        """
        one = Course(*(each[instant : instant + 1] for each in (course.times, course.q, course.ankles, course.toes)))
        segments = MODEL.forward(one.q, self.person.lengths).rotations[0]
        skeleton = joints(self.person, one)[0]
        rotations = self._rotations(segments, skeleton)
        body = self.body
        hips = 0.5 * (body.head_of("upperleg01.L") + body.head_of("upperleg01.R"))
        middle = 0.5 * (skeleton[Joint.HIP_LEFT] + skeleton[Joint.HIP_RIGHT])
        vertices, heads = body.posed(rotations, middle - rotations[0] @ (hips - body.heads[0]))
        return vertices, _kinect_joints(body, heads, rotations[body.rig.names.index("head")]), segments

    def _rotations(self, segments: FloatArray, skeleton: FloatArray) -> FloatArray:
        """(B, 3, 3) rotation of each bone relative to its rest pose."""
        body, found = self.body, dict[str, FloatArray]()
        for bone, (first, second, share) in _TRUNK.items():
            one, other = segments[_SEGMENT[first]], segments[_SEGMENT[second]]
            found[bone] = one @ so3.quat_to_matrix(so3.exp(share * so3.rotation_vectors(one.T @ other)))
        for side, suffix, number in _SIDES:
            clavicle, upper, fore, hand = (
                segments[_SEGMENT[f"{name}_{side}"]] for name in ("clavicle", "upper_arm", "forearm", "hand")
            )
            shoulder, elbow, wrist = (body.head_of(f"{bone}.{suffix}") for _, bone in _ARM_JOINTS)
            flexion = np.cross(elbow - shoulder, wrist - elbow)
            up = (shoulder - elbow) / np.linalg.norm(shoulder - elbow)
            rest_upper = bone_frame(up, np.cross(-flexion, up))
            rest_fore = bone_frame(elbow - wrist, body.across[number])
            found[f"clavicle.{suffix}"] = clavicle
            found[f"upperarm01.{suffix}"] = upper @ _untwisted(clavicle.T @ upper) @ rest_upper.T
            found[f"upperarm02.{suffix}"] = upper @ rest_upper.T
            found[f"lowerarm01.{suffix}"] = fore @ _untwisted(upper.T @ fore) @ rest_fore.T
            found[f"lowerarm02.{suffix}"] = fore @ rest_fore.T
            found[f"wrist.{suffix}"] = hand @ rest_fore.T
            places = {name: skeleton[Joint[f"{name}_{side.upper()}"]] for name, _ in _LEG_JOINTS}
            ahead = (places["FOOT"] - places["ANKLE"]) * [1.0, 1.0, 0.0]
            for a, b, bone, end in (
                ("HIP", "KNEE", "upperleg01", "lowerleg01"),
                ("KNEE", "ANKLE", "lowerleg01", "foot"),
            ):
                rest = bone_frame(body.head_of(f"{bone}.{suffix}") - body.head_of(f"{end}.{suffix}"), np.eye(3)[0])
                found[f"{bone}.{suffix}"] = bone_frame(places[a] - places[b], ahead) @ rest.T
            found[f"foot.{suffix}"] = bone_frame(np.eye(3)[2], ahead)
        rotations = np.empty((len(body.rig.names), 3, 3))
        for number, (name, parent) in enumerate(zip(body.rig.names, body.rig.parents, strict=True)):
            # fingers, toes and the face are rigid
            rotations[number] = found[name] if name in found else rotations[parent]
        return rotations


def _kinect_joints(body: Body, heads: FloatArray, head: FloatArray) -> FloatArray:
    """(25, 3) joints of the Kinect's set from the bones' heads (B, 3); ``head``: rotation of the head bone."""
    place = dict(zip(body.rig.names, heads, strict=True))
    found = np.empty((N_JOINTS, 3))
    found[Joint.SPINE_BASE], found[Joint.SPINE_MID], found[Joint.NECK] = (
        place[bone] for bone in ("spine05", "spine02", "neck01")
    )
    found[Joint.SPINE_SHOULDER] = 0.5 * (place["clavicle.L"] + place["clavicle.R"])
    found[Joint.HEAD] = place["head"] + head @ [0.0, 0.0, _HEAD_CENTRE * body.vertices[:, 2].max()]
    for side, suffix, _ in _SIDES:
        for name, bone in (*_ARM_JOINTS, *_LEG_JOINTS, *_HAND_JOINTS):
            found[Joint[f"{name}_{side.upper()}"]] = place[f"{bone}.{suffix}"]
    return found


def _untwisted(relative: FloatArray) -> FloatArray:
    """(3, 3) rotation that removes half of a joint's twist about its own z; fades out near a half turn of swing."""
    _, _, z, w = so3.matrix_to_quat(relative)
    size = z * z + w * w
    angle = 2.0 * np.arctan2(np.sign(w) * z, abs(w)) * min(1.0, size / 0.25)
    return so3.quat_to_matrix(so3.exp(np.array([0.0, 0.0, -0.5 * angle])))
