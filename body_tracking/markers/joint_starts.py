"""Joints in closed form, from the relative poses of two targets (Gaschler 2011, sections 5.1.1 and 5.2.3).

The centres are the least squares of SCoRE, the axis that of SARA (Ehrig et al., J. Biomech. 39 (2006) 2798 and 40
(2007) 2150).
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.joint_model import SIZE, Joint, JointKind, axis_frame, conventional


def closed_form(
    name: str, parent: str, child: str, kind: JointKind, rotations: FloatArray, translations: FloatArray
) -> Joint:
    """A joint in closed form, without covariance.

    Args:
        name: of the joint.
        parent: name of the target before the joint.
        child: name of the target behind the joint.
        kind: of the joint.
        rotations: (n, 3, 3) and
        translations: (n, 3) metres: poses of the child in the parent.
    """
    parent_centre, child_centre = centres(rotations, translations, kind is JointKind.HINGE)
    parent_rotation, child_rotation = np.eye(3), np.eye(3)
    if kind is not JointKind.BALL:
        parent_axis, child_axis = hinge_axes(rotations) if kind is JointKind.HINGE else universal_axes(rotations)
        parent_rotation, child_rotation = _any_frame(parent_axis), _any_frame(child_axis)
    joint = Joint(
        name, parent, child, kind, parent_rotation, parent_centre, child_rotation, child_centre, np.zeros((SIZE, SIZE))
    )
    return conventional(joint)[0]


def centres(rotations: FloatArray, translations: FloatArray, along_axis: bool) -> tuple[FloatArray, FloatArray]:
    """The centre in the parent and in the child, (3,) each, metres.

    Least squares of c1 - R_i c2 = t_i (Gaschler eq. 5.2-5.4; for a hinge, eq. 5.10).

    Args:
        rotations: (n, 3, 3) of the child in the parent.
        translations: (n, 3) of the child in the parent, metres.
        along_axis: whether the centre may lie anywhere along an axis: the weakest direction is dropped, which gives the
            minimum norm solution (Gaschler eq. 5.10).
    """
    # normal equations: their size does not depend on the number of frames
    n = len(rotations)
    total, mean = rotations.sum(axis=0), translations.sum(axis=0)
    matrix = np.block([[n * np.eye(3), -total], [-total.T, n * np.eye(3)]])
    right = np.concatenate([mean, -np.einsum("nij,ni->j", rotations, translations)])
    values, vectors = np.linalg.eigh(matrix)
    used = slice(1, None) if along_axis else slice(None)
    floor = np.maximum(values[used], 1e-12 * n)
    solution: FloatArray = vectors[:, used] @ ((vectors[:, used].T @ right) / floor)
    return solution[:3], solution[3:]


def hinge_axes(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A hinge's axis in the parent and in the child, (3,) unit vectors, from rotations (n, 3, 3).

    The null space of Gaschler's eq. 5.11 is the first pair of singular vectors of the sum of the rotations.
    """
    left, _, right = np.linalg.svd(rotations.sum(axis=0))
    return left[:, 0], right[0]


def universal_axes(rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The first axis in the parent and the second one in the child, (3,) unit vectors, from rotations (n, 3, 3).

    The axes are perpendicular in every frame: a1 . R_i a2 = 0, linear in the products of their components. The null
    space of this system is exact for large motions; for small ones it is one of several starts over the half sphere,
    from which alternating minimisation over either axis minimises the sum of squares.
    """
    flat = rotations.reshape(-1, 9)
    moments = flat.T @ flat
    null = np.linalg.eigh(moments)[1][:, 0].reshape(3, 3)
    moments = moments.reshape(3, 3, 3, 3)
    count = 40
    height = (np.arange(count) + 0.5) / count
    around = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    first = np.stack([ring * np.cos(around), ring * np.sin(around), height], axis=-1)
    first = np.concatenate([np.linalg.svd(null)[0][:, :1].T, first])
    for _ in range(100):
        second = np.linalg.eigh(np.einsum("si,ijkl,sk->sjl", first, moments, first))[1][:, :, 0]
        values, vectors = np.linalg.eigh(np.einsum("sj,ijkl,sl->sik", second, moments, second))
        first = vectors[:, :, 0]
    best = int(values[:, 0].argmin())
    return first[best], second[best]


def _any_frame(axis: FloatArray) -> FloatArray:
    return axis_frame(axis, np.zeros(3), near_axis=True)
