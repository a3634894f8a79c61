"""Occlusion of joints by the body itself and by other people: lines of sight against capsules."""

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
    """The surface of a body: a capsule round each line between two joints, a ball if both are one joint.

    Attributes:
        starts: (k,) :class:`~body_tracking.core.skeleton.Joint` indices.
        ends: (k,) likewise.
        radii: (k,) metres, greater than zero.
    """

    starts: IntArray
    ends: IntArray
    radii: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Obstruction:
    """Self-occlusion of a body's joints.

    Attributes:
        cover: (n, 25) 0 where a joint is seen, to 1 where its line of sight goes through the middle of another part.
        nearer: (n, 25) metres from a joint towards the sensor to the surface that covers it most; 0 where none does.
    """

    cover: FloatArray
    nearer: FloatArray


def obstruction(sight: FloatArray, capsules: Capsules) -> Obstruction:
    """How deep each joint lies behind the body.

    The line of sight ends at the skin over the joint that faces the sensor: in front of its centre by the radius of the
    widest capsule that ends in it. If it passes the axis of another capsule at a distance d, the cover is
    1 - d / radius, times the square of the ratio of the radii where that capsule is thinner than the joint's own. A
    capsule covers neither the joints at its ends nor a joint within half its radius of its axis; from there to its
    surface, the cover of a joint grows to the full value. The trunk does not cover its spine.

    Args:
        sight: (n, 25, 3) metres, the joints in the sensor's optical frame.
        capsules: the surface.
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
    """(n, 25) how deep each joint lies behind another person, 0 to 1; as of :func:`obstruction`.

    Args:
        sight: (n, 25, 3) metres, the joints in the sensor's optical frame.
        capsules: their surface.
        other: (n, 25, 3) metres, the other person's joints.
        flesh: the other person's surface.
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
    """Closest points of the lines of sight from the origin to (..., 3) points and of the segment.

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
