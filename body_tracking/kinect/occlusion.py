"""What of a body a sensor cannot see because the body itself stands before it: rays against capsules of flesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core.skeleton import N_JOINTS, BoolArray, FloatArray, IntArray, Joint


def named(*names: str) -> BoolArray:
    """(25,) which joints are of these kinds, left or right."""
    return np.array([joint.name.removesuffix("_LEFT").removesuffix("_RIGHT") in names for joint in Joint])


_SPINE = named("SPINE_BASE", "SPINE_MID", "SPINE_SHOULDER", "NECK")
_TRUNK: BoolArray = _SPINE | named("SHOULDER", "HIP")


@dataclass(frozen=True, slots=True, eq=False)
class Capsules:
    """The flesh of a body: a capsule round each line between two joints, a ball where both are the same.

    Attributes:
        starts: (k,) :class:`~body_tracking.core.skeleton.Joint` indices.
        ends: (k,) the same.
        radii: (k,) metres, greater than zero.
    """

    starts: IntArray
    ends: IntArray
    radii: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Obstruction:
    """What stands before the joints of a body.

    Attributes:
        cover: (n, 25) 0 where a joint is seen, to 1 where its line of sight goes through the middle of another part.
        nearer: (n, 25) metres from a joint towards the sensor to the surface of what covers it most; 0 where none does.
    """

    cover: FloatArray
    nearer: FloatArray


def obstruction(sight: FloatArray, capsules: Capsules) -> Obstruction:
    """How deep each joint lies behind the body.

    A joint is looked for where the skin over it faces the sensor: as far before its centre as the widest capsule that
    ends in it reaches. The line of sight to there passes the axis of a capsule at a distance d; the joint is covered
    by 1 - d / radius, and where the capsule is thinner than the joint's own, by the square of their ratio less. A
    capsule never covers the joints it ends in, nor the trunk its spine, nor anything a joint that lies within half the
    radius of its axis; from there to its surface the cover grows to the whole.

    Args:
        sight: (n, 25, 3) metres, the joints in the sensor's optical frame.
        capsules: the flesh.
    """
    distance = np.linalg.norm(sight, axis=2, keepdims=True)
    own, reach = _skin(sight, capsules)
    covered, nearer = np.zeros(sight.shape[:2]), np.zeros(sight.shape[:2])
    joints = np.arange(N_JOINTS)
    for start, end, radius in zip(capsules.starts, capsules.ends, capsules.radii, strict=True):
        foreign: BoolArray = (joints != start) & (joints != end)
        if _TRUNK[start] and _TRUNK[end]:
            foreign &= ~_SPINE
        one, other = sight[:, None, start], sight[:, None, end]
        within = _distance_to_segment(sight[:, foreign], one, other)
        miss, along = _nearest_of_rays(reach[:, foreign], one, other)
        share = np.clip(1.0 - miss / radius, 0.0, 1.0) * np.clip(2.0 * within / radius - 1.0, 0.0, 1.0)
        share *= (radius / np.maximum(own[foreign], radius)) ** 2
        surface = along - np.sqrt(np.maximum(radius**2 - miss**2, 0.0))
        more = share > covered[:, foreign]
        covered[:, foreign] = np.where(more, share, covered[:, foreign])
        way = np.maximum(distance[:, foreign, 0] - surface, 0.0)
        nearer[:, foreign] = np.where(more, way, nearer[:, foreign])
    return Obstruction(covered, nearer)


def veil(sight: FloatArray, capsules: Capsules, other: FloatArray, flesh: Capsules) -> FloatArray:
    """(n, 25) how deep each joint lies behind somebody else, 0 to 1; as of :func:`obstruction`.

    Args:
        sight: (n, 25, 3) metres, the joints in the sensor's optical frame.
        capsules: the flesh round them.
        other: (n, 25, 3) metres, the other's joints.
        flesh: round those.
    """
    _, reach = _skin(sight, capsules)
    covered = np.zeros(sight.shape[:2])
    for start, end, radius in zip(flesh.starts, flesh.ends, flesh.radii, strict=True):
        miss, _ = _nearest_of_rays(reach, other[:, None, start], other[:, None, end])
        np.maximum(covered, np.clip(1.0 - miss / radius, 0.0, 1.0), out=covered)
    return covered


def _skin(sight: FloatArray, capsules: Capsules) -> tuple[FloatArray, FloatArray]:
    """(25,) metres, the widest capsule that ends in each joint, and (n, 25, 3) the skin there that faces the sensor."""
    radii = np.zeros(N_JOINTS)
    np.maximum.at(radii, capsules.starts, capsules.radii)
    np.maximum.at(radii, capsules.ends, capsules.radii)
    distance = np.linalg.norm(sight, axis=2, keepdims=True)
    return radii, sight * (1.0 - np.minimum(radii[:, None] / np.maximum(distance, 1e-9), 1.0))


def _distance_to_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(..., 3) points to their (...) distances from the segment."""
    axis = end - start
    square = np.maximum((axis * axis).sum(axis=-1), 1e-12)
    along = np.clip(((points - start) * axis).sum(axis=-1) / square, 0.0, 1.0)
    result: FloatArray = np.linalg.norm(points - start - along[..., None] * axis, axis=-1)
    return result


def _nearest_of_rays(points: FloatArray, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the lines of sight from the origin to (..., 3) points come nearest to the segment.

    Closest points of two segments as Ericson 2005, Real-Time Collision Detection, 5.1.9, with s along the ray and t
    along the segment.

    Returns:
        (...) metres between the two, and (...) metres along the line of sight.
    """
    axis = end - start
    a = np.maximum((points * points).sum(axis=-1), 1e-12)
    e = np.maximum((axis * axis).sum(axis=-1), 1e-12)
    b = (points * axis).sum(axis=-1)
    c = -(points * start).sum(axis=-1)
    f = -(axis * start).sum(axis=-1)
    determinant = a * e - b * b
    parallel = determinant <= 1e-9 * a * e
    s = np.where(parallel, 0.5, np.clip((b * f - c * e) / np.where(parallel, 1.0, determinant), 0.0, 1.0))
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    miss: FloatArray = np.linalg.norm(s[..., None] * points - start - t[..., None] * axis, axis=-1)
    return miss, s * np.sqrt(a)
