"""A skinned body model in SMPL's form, one person's body in that model, and a pose.

Loper et al., "SMPL: a skinned multi-person linear model", SIGGRAPH Asia 2015. The shipped model was made from
MakeHuman's data by ``scripts/make_body_model.py``; files of SMPL, SMPL-H and SMPL-X load too. Every model gets two more
shape components, the thickness of the clothes above and below the waist, which move the skin outwards and no joint.
Model axes: x left, y up, z forward, metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.mesh import model_files
from body_tracking.mesh.anatomy import segment_frames
from body_tracking.mesh.model_files import ModelFileError
from body_tracking.mesh.skinning import forward_kinematics, skin, vertex_normals

SHAPES: Final = 10
"""Number of shape components used: the effects of SMPL's further ones are smaller than clothes."""
DATA: Final = Path(__file__).parent / "data"
SHIPPED: Final = {1000: DATA / "body_1000.npz", 1500: DATA / "body_1500.npz"}
"""The shipped models by their approximate number of vertices."""

SMPL_JOINTS: Final = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle"),
    *("spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder"),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
"""The joints that SMPL, SMPL-H and SMPL-X share, in their order; hands, jaw and eyes follow."""
JOINTS: Final = tuple(name for name in SMPL_JOINTS if name not in ("left_foot", "right_foot"))
"""The 20 joints of the project's own model."""
_COUNTS: Final = {24: "SMPL", 52: "SMPL-H", 55: "SMPL-X"}
CLOTHES: Final = (0.008, 0.006)
"""Mean and standard deviation of the clothes' thickness over people, metres: clothes stand off by 5 to 15 mm."""
_BARE: Final = ("head", "neck", "left_wrist", "right_wrist")
"""Joints whose segments wear no clothes, as those of fingers and of the face, which follow :data:`SMPL_JOINTS`."""
_BONES: Final = 8
"""Largest number of bones per vertex; smaller weights are redistributed in proportion."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyModel:
    """A shape space of people: N vertices, J joints, S shape components, K bones per vertex.

    Attributes:
        joint_names: SMPL's names.
        parents: (J,) each before its children; -1 for the first.
        vertices: (N, 3) of the mean shape at rest, in clothes.
        vertex_shapes: (N, 3, S) per standard deviation of each shape component; the last two are the clothes.
        pose_shapes: (N, 3, 9 (J - 1)) per entry of the joints' rotation matrices minus the identity; or (N, 3, 0).
        joints: (J, 3) of the mean shape at rest.
        joint_shapes: (J, 3, S) per standard deviation of each shape component.
        bones: (N, K) joints that move each vertex.
        weights: (N, K) in [0, 1], their sum 1.
        faces: (F, 3) vertices, counter-clockwise from outside.
        frames: (J, 3, 3) anatomical frames at rest, see :mod:`body_tracking.mesh.anatomy`.
    """

    joint_names: tuple[str, ...]
    parents: IntArray
    vertices: FloatArray
    vertex_shapes: FloatArray
    pose_shapes: FloatArray
    joints: FloatArray
    joint_shapes: FloatArray
    bones: IntArray
    weights: FloatArray
    faces: IntArray
    frames: FloatArray

    def body(self, shape: FloatArray | None = None) -> Body:
        """The body of a person with shape components (S,) in standard deviations; None for the mean person.

        Raises:
            ValueError: another number of components, or one that is not finite.
        """
        count = self.vertex_shapes.shape[2]
        beta = np.zeros(count) if shape is None else np.asarray(shape, dtype=float)
        if beta.shape != (count,) or not np.isfinite(beta).all():
            raise ValueError(f"shape of {beta.shape}, expected ({count},) finite numbers")
        return Body(self, beta, self.vertices + self.vertex_shapes @ beta, self.joints + self.joint_shapes @ beta)

    def index(self, joint: str) -> int:
        """Index of a joint by its name."""
        return self.joint_names.index(joint)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One person's body at rest.

    Attributes:
        model: the shape space it comes from.
        shape: (S,) standard deviations.
        vertices: (N, 3) metres.
        joints: (J, 3) metres.
    """

    model: BodyModel
    shape: FloatArray
    vertices: FloatArray
    joints: FloatArray

    def posed(self, pose: Pose) -> PosedBody:
        """The body in a pose."""
        model = self.model
        vertices = self.vertices
        if model.pose_shapes.shape[2]:
            vertices = vertices + model.pose_shapes @ (pose.rotations[1:] - np.eye(3)).ravel()
        turned, placed = forward_kinematics(model.parents, self.joints, pose.rotations, pose.translation)
        return PosedBody(
            vertices, skin(vertices, model.bones, model.weights, self.joints, turned, placed), turned, placed
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A pose of a body model.

    Attributes:
        rotations: (J, 3, 3) of each joint relative to its parent; of the first in the camera's frame.
        translation: (3,) metres: displacement of the first joint from its position at rest.
    """

    rotations: FloatArray
    translation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PosedBody:
    """A body in a pose.

    Attributes:
        rest: (N, 3) vertices at rest, including the pose's blend shapes.
        vertices: (N, 3) in the camera's frame.
        turned: (J, 3, 3) orientations of the joints.
        placed: (J, 3) positions of the joints.
    """

    rest: FloatArray
    vertices: FloatArray
    turned: FloatArray
    placed: FloatArray


def load(path: Path | int = 1000) -> BodyModel:
    """A body model from a file in SMPL's form, or one of :data:`SHIPPED`.

    Raises:
        ModelFileError: not a body model file, damaged, malicious, or with invalid arrays.
    """
    path = SHIPPED[path] if isinstance(path, int) else path
    arrays = model_files.read(path)
    try:
        return _checked(arrays)
    except (ValueError, IndexError, TypeError) as error:
        raise ModelFileError(f"{path}: {error}") from error


def _checked(arrays: dict[str, npt.NDArray[Any]]) -> BodyModel:
    vertices = _numbers(arrays, "v_template", 2)
    count = len(vertices)
    shapes = _numbers(arrays, "shapedirs", 3)[..., :SHAPES]
    weights = _numbers(arrays, "weights", 2)
    regressor = _numbers(arrays, "J_regressor", 2)
    joint_count = len(regressor)
    poses = _numbers(arrays, "posedirs", 3) if "posedirs" in arrays else np.zeros((count, 3, 0))
    expected = {
        "v_template": (vertices, (count, 3)),
        "shapedirs": (shapes, (count, 3, shapes.shape[2])),
        "posedirs": (poses, (count, 3, 9 * (joint_count - 1) if poses.shape[2] else 0)),
        "weights": (weights, (count, joint_count)),
        "J_regressor": (regressor, (joint_count, count)),
    }
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name} is {array.shape}, expected {shape} beside the other arrays")
    if weights.min() < -1e-6 or np.abs(weights.sum(axis=1) - 1.0).max() > 1e-3:
        raise ValueError("weights: those of a vertex have to be at least 0 and add up to 1")
    if np.abs(regressor.sum(axis=1) - 1.0).max() > 1e-3:
        raise ValueError("J_regressor: those of a joint have to add up to 1")
    faces = np.asarray(arrays["f"])
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not len(faces):
        raise ValueError(f"f is {faces.shape} of {faces.dtype}, expected (faces, 3) integers")
    if faces.min() < 0 or faces.max() >= count:
        raise ValueError(f"f: a vertex outside of the {count}")
    names = _names(arrays, joint_count)
    parents = np.asarray(arrays["kintree_table"])
    if parents.ndim != 2 or parents.shape[1] != joint_count or parents.dtype.kind not in "iu":
        raise ValueError(f"kintree_table is {parents.shape} of {parents.dtype}, expected (2, {joint_count}) integers")
    parents = parents[0].astype(np.int64)
    parents[0] = -1  # SMPL's files have 2^32 - 1
    if np.any(parents[1:] < 0) or np.any(parents >= np.arange(joint_count)):
        raise ValueError("kintree_table: each parent has to come before its children")
    joints = regressor @ vertices
    frames = segment_frames(names, joints)
    if "frames" in arrays:
        frames = _numbers(arrays, "frames", 3)
        if frames.shape != (joint_count, 3, 3) or np.abs(frames @ frames.mT - np.eye(3)).max() > 1e-5:
            raise ValueError(f"frames: expected ({joint_count}, 3, 3) orthonormal matrices")
    # vertices without a face only serve the joint regressor, whose results are stored instead
    kept, compact = np.unique(faces, return_inverse=True)
    bones = np.argsort(-weights[kept], axis=1, kind="stable")[:, : min(_BONES, int((weights > 0.0).sum(axis=1).max()))]
    strongest = np.take_along_axis(weights[kept], bones, axis=1)
    skin_vertices, compact = np.ascontiguousarray(vertices[kept]), compact.reshape(-1, 3).astype(np.intp)
    normals = vertex_normals(skin_vertices, compact)
    worn = np.array([_garment(names[bone]) for bone in range(joint_count)])[bones[:, 0]]
    garments = np.stack([np.where(worn[:, None] == k, normals, 0.0) for k in range(2)], axis=2)
    shapes, joint_shapes = shapes[kept], np.einsum("jn,nas->jas", regressor, shapes)
    return BodyModel(
        names,
        parents.astype(np.intp),
        skin_vertices + CLOTHES[0] * garments.sum(axis=2),
        np.concatenate([shapes, CLOTHES[1] * garments], axis=2),
        np.ascontiguousarray(poses[kept]),
        joints,
        np.concatenate([joint_shapes, np.zeros_like(joint_shapes[..., :2])], axis=2),
        np.ascontiguousarray(bones.astype(np.intp)),
        np.ascontiguousarray(strongest / strongest.sum(axis=1, keepdims=True)),
        np.ascontiguousarray(compact),
        np.ascontiguousarray(frames),
    )


def _garment(joint: str) -> int:
    """Number of the garment on a joint's segment: 0 above the waist, 1 below, -1 for bare skin."""
    if joint in _BARE or joint not in SMPL_JOINTS:
        return -1
    return int(joint.partition("_")[2] in ("hip", "knee", "ankle", "foot") or joint == "pelvis")


def _names(arrays: dict[str, npt.NDArray[Any]], count: int) -> tuple[str, ...]:
    if "joint_names" in arrays:
        names = tuple(str(name) for name in arrays["joint_names"].ravel())
        if len(names) != count or not set(JOINTS) <= set(names):
            raise ValueError(f"joint_names: {len(names)} of {count} joints, or one of the {len(JOINTS)} needed missing")
        return names
    if count not in _COUNTS:
        known = ", ".join(f"{kind} {number}" for number, kind in _COUNTS.items())
        raise ValueError(f"J_regressor: {count} joints without joint_names; known are {known}")
    return (*SMPL_JOINTS, *(f"joint{number}" for number in range(len(SMPL_JOINTS), count)))


def _numbers(arrays: dict[str, npt.NDArray[Any]], name: str, dimensions: int) -> FloatArray:
    array = np.asarray(arrays[name])
    if array.ndim != dimensions or array.dtype.kind not in "fiub" or (not array.size and name != "posedirs"):
        raise ValueError(f"{name} is {array.shape} of {array.dtype}, expected numbers in {dimensions} dimensions")
    result = np.ascontiguousarray(array, dtype=float)
    if not np.isfinite(result).all():
        raise ValueError(f"{name}: a number is not finite")
    return result
