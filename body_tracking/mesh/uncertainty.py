"""Joints of a fitted body with their covariance.

The information of a fit counts its points as about 40 independent patches. Errors that persist over frames do not
average out: the person's shape, and the cloth on each segment. Both are considered parameters (Schmidt 1966): they are
not estimated with the pose, but their covariance propagates through the fit into the joints.

Vertices outside of the silhouette, or in front of what was measured, move a limb in the fit, but are no information of
its place: they show where it is not. With them an arm that no point explains had deviations of centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray, Joint
from body_tracking.mesh.body_model import Body, BodyModel, PosedBody
from body_tracking.mesh.energy import Observation
from body_tracking.mesh.skinning import lever_arms
from body_tracking.mesh.solver import Fit, MeshFitter

CLOTH: Final = 0.008
"""Metres: standard deviation of the cloth's thickness on a segment."""
RESIDUAL_SHAPE: Final = 0.004
"""Metres: standard deviation of a joint's position in its segment beyond the shape components."""

_BONES: Final = {
    Joint.SPINE_BASE: "pelvis",
    Joint.SPINE_MID: "spine3",
    Joint.NECK: "neck",
    **{
        getattr(Joint, f"{kinect}_{side.upper()}"): f"{side}_{joint}"
        for side in ("left", "right")
        for kinect, joint in (
            *(("SHOULDER", "shoulder"), ("ELBOW", "elbow"), ("WRIST", "wrist")),
            *(("HIP", "hip"), ("KNEE", "knee"), ("ANKLE", "ankle")),
        )
    },
}
"""Joints of the Kinect's set that exist in the model."""


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Points that are each attached to one bone.

    Attributes:
        bones: (n,) joints of the model that move them.
        places: (n, 3) metres, at rest.
        shapes: (n, 3, S) derivative by the shape components.
    """

    bones: IntArray
    places: FloatArray
    shapes: FloatArray


def kinect_landmarks(body: Body) -> Landmarks:
    """The Kinect's 25 joints on a body.

    Joints are the model's centres of rotation where it has them; a Kinect's lie up to 3 cm nearer to the skin.
    SpineShoulder is the midpoint of the inner ends of the collar bones, Head the centre of the head, Hand the centre of
    the closed hand; the tips of hand and foot and the side of the thumb are points of the skin.
    """
    model = body.model
    vertices, shapes = body.vertices, model.vertex_shapes
    bones = np.zeros(len(Joint), dtype=np.intp)
    places = np.zeros((len(Joint), 3))
    moved = np.zeros((len(Joint), 3, shapes.shape[2]))
    for kinect, name in _BONES.items():
        bone = model.index(name)
        bones[kinect], places[kinect], moved[kinect] = bone, body.joints[bone], model.joint_shapes[bone]
    collars = [model.index(f"{side}_collar") for side in ("left", "right")]
    bones[Joint.SPINE_SHOULDER] = model.index("spine3")
    places[Joint.SPINE_SHOULDER] = body.joints[collars].mean(axis=0)
    moved[Joint.SPINE_SHOULDER] = model.joint_shapes[collars].mean(axis=0)
    strongest = model.bones[np.arange(len(vertices)), model.weights.argmax(axis=1)]
    toes = np.array([0.0, 0.0, 1.0])

    def place(joint: Joint, bone: int, chosen: IntArray) -> None:
        bones[joint], places[joint], moved[joint] = bone, vertices[chosen].mean(axis=0), shapes[chosen].mean(axis=0)

    head = model.index("head")
    place(Joint.HEAD, head, np.flatnonzero(strongest == head))
    for side in ("left", "right"):
        hand, foot = model.index(f"{side}_wrist"), model.index(f"{side}_ankle")
        own = np.flatnonzero(strongest == hand)
        frame = model.frames[hand]
        joints = {name: getattr(Joint, f"{name}_{side.upper()}") for name in ("HAND", "HAND_TIP", "THUMB", "FOOT")}
        place(joints["HAND"], hand, own)
        for name, direction in (("HAND_TIP", -frame[:, 2]), ("THUMB", frame[:, 0])):
            place(joints[name], hand, own[[(vertices[own] @ direction).argmax()]])
        own = np.flatnonzero(strongest == foot)
        place(joints["FOOT"], foot, own[[(vertices[own] @ toes).argmax()]])
    return Landmarks(bones, places, moved)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Points of a fitted body.

    Attributes:
        points: (n, 3) metres in the camera's frame.
        covariance: (n, 3, 3) square metres.
    """

    points: FloatArray
    covariance: FloatArray


def placed(
    fitter: MeshFitter, fit: Fit, observation: Observation, landmarks: Landmarks, shape_covariance: FloatArray
) -> Placed:
    """Landmarks of a fit with their covariance.

    Args:
        fitter: source of the fit.
        fit: of one image.
        observation: of that image.
        landmarks: of the fitter's body.
        shape_covariance: (S, S) of the person's shape components.
    """
    body, model, posed = fitter.body, fitter.body.model, fit.posed
    joints, components = len(model.parents), model.vertex_shapes.shape[2]
    # Jacobians of the data term by the pose, the shape and the cloth on each segment
    corners, shares = fit.matches.corners, fit.matches.shares
    arms = lever_arms(
        *(corners, shares, posed.rest, model.bones, model.weights, model.parents, body.joints),
        *(posed.turned, posed.placed),
    )
    normals = fit.matches.normals
    rows = pose_rows(arms, normals, fit.frames)
    moved_joints = joint_shape_gradients(model, posed)
    moved = point_shape_gradients(
        *(corners, shares, model.vertex_shapes, model.joint_shapes, model.bones, model.weights),
        *(posed.turned, moved_joints),
    )
    segments = model.bones[corners[:, 0], model.weights[corners[:, 0]].argmax(axis=1)]
    cloth = -(segments[:, None] == np.arange(joints)).astype(np.float64)
    others = np.concatenate([np.einsum("na,nas->ns", normals, moved), cloth], axis=1)
    considered = np.zeros((components + joints, components + joints))
    considered[:components, :components] = shape_covariance
    considered[components:, components:] = CLOTH**2 * np.eye(joints)
    known = fit.information - fit.pulled
    own = np.linalg.inv(known + 1e-6 * np.eye(len(known)))
    gain = own @ (rows.T * fit.weights) @ others
    # Jacobians of the landmarks by the pose and by the shape
    bones = landmarks.bones
    turned = posed.turned[bones]
    points = np.einsum("nab,nb->na", turned, landmarks.places - body.joints[bones]) + posed.placed[bones]
    levers = np.where(fitter.ancestors[bones][..., None], points[:, None] - posed.placed, 0.0)
    jacobian = np.stack([pose_rows(levers, np.tile(axis, (len(bones), 1)), fit.frames) for axis in np.eye(3)], axis=1)
    by_shape = turned @ (landmarks.shapes - model.joint_shapes[bones]) + moved_joints[bones]
    through = -jacobian @ gain
    through[..., :components] += by_shape
    covariance = jacobian @ own @ jacobian.mT + through @ considered @ through.mT
    covariance += RESIDUAL_SHAPE**2 * np.eye(3)
    return Placed(points, covariance)


@compiled
def pose_rows(arms: FloatArray, directions: FloatArray, frames: FloatArray) -> FloatArray:
    """(n, 3 + 3 J) derivatives of points along directions (n, 3) by the pose; arms: (n, J, 3) lever arms."""
    count, joints = arms.shape[0], arms.shape[1]
    rows = np.zeros((count, 3 + 3 * joints))
    for n in range(count):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        rows[n, 0], rows[n, 1], rows[n, 2] = dx, dy, dz
        for j in range(joints):
            sx, sy, sz = arms[n, j, 0], arms[n, j, 1], arms[n, j, 2]
            if sx == 0.0 and sy == 0.0 and sz == 0.0:
                continue
            cx, cy, cz = sy * dz - sz * dy, sz * dx - sx * dz, sx * dy - sy * dx
            for a in range(3):
                rows[n, 3 + 3 * j + a] = frames[j, 0, a] * cx + frames[j, 1, a] * cy + frames[j, 2, a] * cz
    return rows


def joint_shape_gradients(model: BodyModel, posed: PosedBody) -> FloatArray:
    """(J, 3, S) derivative of the posed joints by the shape components at a fixed pose, metres."""
    moved = np.empty_like(model.joint_shapes)
    moved[0] = model.joint_shapes[0]
    for joint in range(1, len(moved)):
        parent = model.parents[joint]
        bone = model.joint_shapes[joint] - model.joint_shapes[parent]
        moved[joint] = moved[parent] + posed.turned[parent] @ bone
    return moved


@compiled
def point_shape_gradients(
    corners: IntArray,
    shares: FloatArray,
    vertex_shapes: FloatArray,
    joint_shapes: FloatArray,
    bones: IntArray,
    weights: FloatArray,
    turned: FloatArray,
    moved_joints: FloatArray,
) -> FloatArray:
    """(P, 3, S) derivative of points on the surface by the shape components at a fixed pose, metres.

    Args:
        corners: (P, C) vertices that define each point, with ``shares`` (P, C).
        shares: see ``corners``.
        vertex_shapes: (N, 3, S) of the model.
        joint_shapes: (J, 3, S) of the model.
        bones: (N, K), with ``weights`` (N, K).
        weights: see ``bones``.
        turned: (J, 3, 3) orientations of the joints.
        moved_joints: (J, 3, S) from :func:`joint_shape_gradients`.
    """
    components = vertex_shapes.shape[2]
    moved = np.zeros((len(corners), 3, components))
    for n in range(len(corners)):
        for c in range(corners.shape[1]):
            v = corners[n, c]
            for i in range(bones.shape[1]):
                w = weights[v, i] * shares[n, c]
                if w == 0.0:
                    continue
                k = bones[v, i]
                for s in range(components):
                    x = vertex_shapes[v, 0, s] - joint_shapes[k, 0, s]
                    y = vertex_shapes[v, 1, s] - joint_shapes[k, 1, s]
                    z = vertex_shapes[v, 2, s] - joint_shapes[k, 2, s]
                    for a in range(3):
                        turn = turned[k, a, 0] * x + turned[k, a, 1] * y + turned[k, a, 2] * z
                        moved[n, a, s] += w * (turn + moved_joints[k, a, s])
    return moved
