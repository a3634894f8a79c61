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
    own, skin = _skin(sight, capsules)
    places, reach = _by_coordinate(sight), _by_coordinate(skin)
    distance = _length(places)
    covered, nearer = np.zeros(distance.shape), np.zeros(distance.shape)
    joints = np.arange(N_JOINTS)
    for start, end, radius in zip(capsules.starts, capsules.ends, capsules.radii, strict=True):
        foreign: BoolArray = (joints != start) & (joints != end)
        if _TRUNK[start] and _TRUNK[end]:
            foreign &= ~_SPINE
        one, other = places[:, start, None], places[:, end, None]
        within = _distance_to_segment(places[:, foreign], one, other)
        miss, along = _nearest_of_rays(reach[:, foreign], one, other)
        share = np.clip(1.0 - miss / radius, 0.0, 1.0) * np.clip(2.0 * within / radius - 1.0, 0.0, 1.0)
        share *= (radius / np.maximum(own[foreign, None], radius)) ** 2
        surface = along - np.sqrt(np.maximum(radius**2 - miss**2, 0.0))
        more = share > covered[foreign]
        covered[foreign] = np.where(more, share, covered[foreign])
        way = np.maximum(distance[foreign] - surface, 0.0)
        nearer[foreign] = np.where(more, way, nearer[foreign])
    return Obstruction(np.ascontiguousarray(covered.T), np.ascontiguousarray(nearer.T))


def veil(sight: FloatArray, capsules: Capsules, other: FloatArray, flesh: Capsules) -> FloatArray:
    """(n, 25) how deep each joint lies behind another person, 0 to 1; as of :func:`obstruction`.

    Args:
        sight: (n, 25, 3) metres, the joints in the sensor's optical frame.
        capsules: their surface.
        other: (n, 25, 3) metres, the other person's joints.
        flesh: the other person's surface.
    """
    _, skin = _skin(sight, capsules)
    reach, places = _by_coordinate(skin), _by_coordinate(other)
    covered = np.zeros(reach.shape[1:])
    for start, end, radius in zip(flesh.starts, flesh.ends, flesh.radii, strict=True):
        miss, _ = _nearest_of_rays(reach, places[:, start, None], places[:, end, None])
        np.maximum(covered, np.clip(1.0 - miss / radius, 0.0, 1.0), out=covered)
    return np.ascontiguousarray(covered.T)


def _by_coordinate(points: FloatArray) -> FloatArray:
    """(3, 25, n) of (n, 25, 3): numpy takes longer for many rows of three numbers than for a few long ones."""
    return np.ascontiguousarray(points.T)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    result: FloatArray = (a * b).sum(axis=0)
    return result


def _length(vectors: FloatArray) -> FloatArray:
    return np.sqrt(_dot(vectors, vectors))


def _skin(sight: FloatArray, capsules: Capsules) -> tuple[FloatArray, FloatArray]:
    """(25,) metres, the widest capsule that ends in each joint, and (n, 25, 3) the skin there that faces the sensor."""
    radii = np.zeros(N_JOINTS)
    np.maximum.at(radii, capsules.starts, capsules.radii)
    np.maximum.at(radii, capsules.ends, capsules.radii)
    distance = np.linalg.norm(sight, axis=2, keepdims=True)
    return radii, sight * (1.0 - np.minimum(radii[:, None] / np.maximum(distance, 1e-9), 1.0))


def _distance_to_segment(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """(3, ...) points to their (...) distances from the segment."""
    axis = end - start
    square = np.maximum(_dot(axis, axis), 1e-12)
    along = np.clip(_dot(points - start, axis) / square, 0.0, 1.0)
    return _length(points - start - along * axis)


def _nearest_of_rays(points: FloatArray, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Closest points of the lines of sight from the origin to (3, ...) points and of the segment.

    Closest points of two segments as Ericson 2005, Real-Time Collision Detection, 5.1.9, with s along the ray and t
    along the segment.

    Returns:
        (...) metres between the two, and (...) metres along the line of sight.
    """
    axis = end - start
    a = np.maximum(_dot(points, points), 1e-12)
    e = np.maximum(_dot(axis, axis), 1e-12)
    b = _dot(points, axis)
    c = -_dot(points, start)
    f = -_dot(axis, start)
    determinant = a * e - b * b
    parallel = determinant <= 1e-9 * a * e
    s = np.where(parallel, 0.5, np.clip((b * f - c * e) / np.where(parallel, 1.0, determinant), 0.0, 1.0))
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    return _length(s * points - start - t * axis), s * np.sqrt(a)
