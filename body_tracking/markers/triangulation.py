"""From balls in images to points in space (Gaschler 3.2): correspondence by epipolar lines, and triangulation.

Two cameras: the optimal correction of Hartley and Sturm (1997), then one Gauss-Newton step that weights each centroid
by its covariance. More cameras: weighted least squares over all rays of a point. The covariance of a point is from the
centroids' noise, without the calibration's error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers import hartley_sturm
from body_tracking.markers.observations import ImageBalls, Points
from body_tracking.markers.rays import Rays, RigRays, TriangulationError, make_rays, rig_rays
from body_tracking.markers.rig import Rig, parallel_cameras

_STEPS: Final = 3
"""Gauss-Newton steps for three or more cameras: from the intersection of two rays, each reduces the error to about a
thousandth."""


@dataclass(frozen=True, slots=True)
class TriangulationSettings:
    """Limits of correspondence between balls of several cameras.

    Attributes:
        gate: largest distance of a ball from another's epipolar line, or from its prediction by other cameras, in
            standard deviations of noise and calibration.
        alternatives: largest number of partners of a ball in another camera, the nearest first.
        nearest: least depth in each camera, metres.
        farthest: largest depth in each camera, metres.
    """

    gate: float = field(
        default=4.0,
        metadata={"doc": "largest distance of a ball from another's epipolar line, standard deviations"},
    )
    alternatives: int = 3
    nearest: float = field(
        default=0.1, metadata={"doc": "shortest distance of a ball from each camera, along its axis", "unit": "m"}
    )
    farthest: float = field(
        default=20.0, metadata={"doc": "longest distance of a ball from each camera, along its axis", "unit": "m"}
    )

    def __post_init__(self) -> None:
        if not (self.gate > 0.0 and self.alternatives > 0 and 0.0 < self.nearest < self.farthest):
            raise TriangulationError(f"{self}: expected positive numbers, nearest before farthest")


_DEFAULT: Final = TriangulationSettings()


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Possibly corresponding balls of two cameras: indices among all balls, and epipolar distances.

    Attributes:
        first: (n,) and
        second: (n,) indices.
        distance: (n,) signed, in standard deviations.
    """

    first: IntArray
    second: IntArray
    distance: FloatArray


def triangulate(rig: Rig, balls: Sequence[ImageBalls], settings: TriangulationSettings = _DEFAULT) -> Points:
    """Triangulate the balls of a rig's cameras at one time.

    A ball on the epipolar lines of several others belongs to several points. Where three or more cameras agree on a
    point, its balls are reserved for it; otherwise all alternatives are returned, with shared indices in
    :attr:`Points.balls`.

    Args:
        rig: the cameras.
        balls: of the cameras, at one time; cameras may be missing.
        settings: limits of correspondence.

    Returns:
        Points in the frame of the rig's first camera, with the stamp of the first image.

    Raises:
        TriangulationError: no images, a camera unknown or given twice, other shapes, or numbers that are not finite.
    """
    if not balls:
        raise TriangulationError("no images to triangulate from")
    geometry = rig_rays(rig)
    rays = make_rays(geometry, balls)
    count = len(rig.cameras)
    found = [(a, b, epipolar_pairs(geometry, rays, a, b, settings)) for a in range(count) for b in range(a + 1, count)]
    members = np.full((sum(len(pairs.first) for _, _, pairs in found), count), -1, dtype=np.intp)
    positions, row = np.zeros((len(members), 3)), 0
    for a, b, pairs in found:
        rows = slice(row, row + len(pairs.first))
        members[rows, a], members[rows, b] = pairs.first, pairs.second
        positions[rows] = _two_rays(geometry, rays, a, b, pairs, optimal=count == 2)
        row = rows.stop
    near = _in_range(geometry, positions, members >= 0, settings)
    members, positions = members[near], positions[near]
    if count == 2:
        positions, covariance = _refined(geometry, rays, members, positions, 1)
    else:
        members, positions, covariance = _agreed(geometry, rays, members, positions, settings)
    indices = np.where(members >= 0, rays.balls[members] if len(rays.balls) else -1, -1)
    return Points(balls[0].stamp_ns, rig.cameras[0].frame_id, positions, covariance, indices)


def prepare() -> None:
    """Compile the loops, or load them, before the first images: a point in front of two parallel cameras."""
    rig = parallel_cameras()
    balls = [
        ImageBalls(0, camera.frame_id, np.array([[column, 240.0]]), np.ones(1), np.eye(2)[None])
        for camera, column in zip(rig.cameras, (420.0, 220.0), strict=True)
    ]
    triangulate(rig, balls)


def epipolar_pairs(geometry: RigRays, rays: Rays, a: int, b: int, settings: TriangulationSettings) -> Pairs:
    """Balls of cameras a and b within the gate of each other's epipolar lines, at most ``alternatives`` per ball.

    Gaschler (2011): figure 3.2.
    """
    of_a, of_b = slice(rays.first[a], rays.first[a + 1]), slice(rays.first[b], rays.first[b + 1])
    shift = geometry.rotations[a].T @ geometry.translation_factor[a]
    shift -= geometry.rotations[b].T @ geometry.translation_factor[b]  # (3, r) of the baseline
    distance = np.empty((of_a.stop - of_a.start, of_b.stop - of_b.start))
    _epipolar_distances(
        geometry.positions[b] - geometry.positions[a],
        shift,
        (geometry.rotations[a], rays.directions[of_a], rays.spread[of_a], rays.flat_factor[of_a]),
        (geometry.rotations[b], rays.directions[of_b], rays.spread[of_b], rays.flat_factor[of_b]),
        distance,
    )
    size = np.where(np.isfinite(distance), np.abs(distance), np.inf)
    good = size < settings.gate
    if max(good.sum(axis=0).max(initial=0), good.sum(axis=1).max(initial=0)) > settings.alternatives:
        # keep pairs that are among the nearest of both balls
        by_row = np.argsort(np.argsort(size, axis=1), axis=1) < settings.alternatives
        by_column = np.argsort(np.argsort(size, axis=0), axis=0) < settings.alternatives
        good &= by_row & by_column
    first, second = np.nonzero(good)
    return Pairs(first + of_a.start, second + of_b.start, distance[first, second])


@compiled
def _epipolar_distances(
    baseline: FloatArray,
    shift: FloatArray,
    a: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    b: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    distance: FloatArray,
) -> None:
    """Write the epipolar distances (n_a, n_b) of two cameras' balls, in standard deviations.

    Args:
        baseline: (3,) from the first camera to the second, metres.
        shift: (3, r) effect of the calibration's unknowns on the baseline.
        a: rotation (3, 3) of the first camera; directions, spread and flat_factor of its balls.
        b: the same of the second camera.
        distance: written.
    """
    a_turn, a_directions, a_spread, a_factor = a
    b_turn, b_directions, b_spread, b_factor = b
    by_b, by_a, across = np.empty(3), np.empty(3), np.empty(3)
    for i in range(len(a_directions)):
        # the volume spanned by two rays and the baseline c, d_b . (c x d_a), and its derivative by each direction
        _cross(baseline, a_directions[i], by_b)
        b0 = by_b[0] * b_turn[0, 0] + by_b[1] * b_turn[0, 1] + by_b[2] * b_turn[0, 2]
        b1 = by_b[0] * b_turn[1, 0] + by_b[1] * b_turn[1, 1] + by_b[2] * b_turn[1, 2]
        for j in range(len(b_directions)):
            direction = b_directions[j]
            _cross(direction, baseline, by_a)
            a0 = by_a[0] * a_turn[0, 0] + by_a[1] * a_turn[0, 1] + by_a[2] * a_turn[0, 2]
            a1 = by_a[0] * a_turn[1, 0] + by_a[1] * a_turn[1, 1] + by_a[2] * a_turn[1, 2]
            variance = 0.0
            for k in range(2):
                variance += (a0 * a_spread[i, 0, k] + a1 * a_spread[i, 1, k]) ** 2
                variance += (b0 * b_spread[j, 0, k] + b1 * b_spread[j, 1, k]) ** 2
            # with a fixed pixel, the ray moves opposite to the image of a fixed point
            _cross(a_directions[i], direction, across)
            for k in range(shift.shape[1]):
                moves = across[0] * shift[0, k] + across[1] * shift[1, k] + across[2] * shift[2, k]
                moves -= a0 * a_factor[i, 0, k] + a1 * a_factor[i, 1, k]
                moves -= b0 * b_factor[j, 0, k] + b1 * b_factor[j, 1, k]
                variance += moves * moves
            volume = by_b[0] * direction[0] + by_b[1] * direction[1] + by_b[2] * direction[2]
            distance[i, j] = volume / math.sqrt(variance)


@compiled
def _cross(a: FloatArray, b: FloatArray, product: FloatArray) -> None:
    """Write the cross product (3,)."""
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]


def _two_rays(geometry: RigRays, rays: Rays, a: int, b: int, pairs: Pairs, optimal: bool) -> FloatArray:
    """(n, 3) intersections of two rays: after their optimal correction, or midpoints of their shortest distance."""
    if not len(pairs.first):
        return np.zeros((0, 3))
    first, second = rays.directions[pairs.first], rays.directions[pairs.second]
    if optimal:
        matrix, *epipoles = geometry.epipolar
        focal, centre = geometry.focal, geometry.centre
        one, other = hartley_sturm.correct(
            matrix,
            (epipoles[0], epipoles[1]),
            rays.flat[pairs.first] * focal[0] + centre[0],
            rays.flat[pairs.second] * focal[1] + centre[1],
        )
        first = _directions(geometry, a, (one - centre[0]) / focal[0])
        second = _directions(geometry, b, (other - centre[1]) / focal[1])
    middle = np.empty((len(first), 3))
    _meet(geometry.positions[a], geometry.positions[b], first, second, middle)
    return middle


@compiled
def _meet(start: FloatArray, other: FloatArray, first: FloatArray, second: FloatArray, middle: FloatArray) -> None:
    """Write the midpoints (n, 3) of the shortest segments between rays.

    NaN behind the cameras and for parallel rays; NaN fails every range check.
    """
    for n in range(len(first)):
        ff = fs = ss = fb = sb = 0.0
        for k in range(3):
            baseline = other[k] - start[k]
            ff += first[n, k] * first[n, k]
            fs += first[n, k] * second[n, k]
            ss += second[n, k] * second[n, k]
            fb += first[n, k] * baseline
            sb += second[n, k] * baseline
        determinant = ff * ss - fs * fs
        along, other_along = (ss * fb - fs * sb) / determinant, (fs * fb - ff * sb) / determinant
        for k in range(3):
            ends = start[k] + along * first[n, k] + other[k] + other_along * second[n, k]
            middle[n, k] = 0.5 * ends if along > 0.0 and other_along > 0.0 else math.nan


def _directions(geometry: RigRays, camera: int, flat: FloatArray) -> FloatArray:
    turn = geometry.rotations[camera]
    directions: FloatArray = flat @ turn[:2] + turn[2]
    return directions


def _in_range(geometry: RigRays, positions: FloatArray, seen: BoolArray, settings: TriangulationSettings) -> BoolArray:
    """(n,) whether points are within the depth range of all cameras that see them."""
    depth = positions @ geometry.rotations[:, 2].T + geometry.translations[:, 2]
    return np.asarray((~seen | ((depth > settings.nearest) & (depth < settings.farthest))).all(axis=1))


def _refined(
    geometry: RigRays, rays: Rays, members: IntArray, positions: FloatArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) after Gauss-Newton on weighted reprojection errors, and their covariance (n, 3, 3)."""
    positions, covariance = np.array(positions), np.empty((len(members), 3, 3))
    pose = geometry.rotations, geometry.translations
    _gauss_newton(*pose, rays.flat, rays.weight, members, steps, positions, covariance)
    return positions, covariance


@compiled
def _gauss_newton(
    rotations: FloatArray,
    translations: FloatArray,
    flat: FloatArray,
    weight: FloatArray,
    members: IntArray,
    steps: int,
    positions: FloatArray,
    covariance: FloatArray,
) -> None:
    """Move the positions (n, 3) by Gauss-Newton steps; write their covariance (n, 3, 3) at the last linearisation."""
    information, gradient, derivative = np.empty((3, 3)), np.empty(3), np.empty((2, 3))
    for n in range(len(members)):
        for _ in range(steps):
            information[:], gradient[:] = 0.0, 0.0
            for c in range(members.shape[1]):
                ball = members[n, c]
                if ball < 0:
                    continue
                turn, point = rotations[c], positions[n]
                x = turn[0, 0] * point[0] + turn[0, 1] * point[1] + turn[0, 2] * point[2] + translations[c, 0]
                y = turn[1, 0] * point[0] + turn[1, 1] * point[1] + turn[1, 2] * point[2] + translations[c, 1]
                z = turn[2, 0] * point[0] + turn[2, 1] * point[1] + turn[2, 2] * point[2] + translations[c, 2]
                x, y = x / z, y / z
                for k in range(3):
                    derivative[0, k] = (turn[0, k] - x * turn[2, k]) / z
                    derivative[1, k] = (turn[1, k] - y * turn[2, k]) / z
                x, y, w = flat[ball, 0] - x, flat[ball, 1] - y, weight[ball]
                for i in range(3):
                    one = derivative[0, i] * w[0, 0] + derivative[1, i] * w[1, 0]
                    other = derivative[0, i] * w[0, 1] + derivative[1, i] * w[1, 1]
                    gradient[i] += one * x + other * y
                    for j in range(3):
                        information[i, j] += one * derivative[0, j] + other * derivative[1, j]
            _invert(information, covariance[n])
            for i in range(3):
                for j in range(3):
                    positions[n, i] += covariance[n, i, j] * gradient[j]


@compiled
def _invert(matrix: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse of a symmetric matrix (3, 3)."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * first + b * second + c * third)
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = first * scale, (a * f - c * c) * scale, (a * d - b * b) * scale
    inverse[0, 1] = inverse[1, 0] = second * scale
    inverse[0, 2] = inverse[2, 0] = third * scale
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) * scale


def _projected(geometry: RigRays, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (n, c, 2) of points in all cameras, and their derivative (n, c, 2, 3) by the points."""
    inside = (geometry.rotations @ positions[:, None, :, None])[..., 0] + geometry.translations
    depth = inside[..., 2:]
    flat = inside[..., :2] / depth
    by_point = (geometry.rotations[:, :2] - flat[..., None] * geometry.rotations[:, 2:]) / depth[..., None]
    return flat, by_point


def _agreed(
    geometry: RigRays, rays: Rays, members: IntArray, positions: FloatArray, settings: TriangulationSettings
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points of three or more cameras: pairs of balls, completed by balls near the predicted image in other cameras.

    A point of three or more cameras reserves its balls; points with most cameras, then the most likely ones, come
    first.
    """
    positions, covariance = _refined(geometry, rays, members, positions, 1)
    members = _completed(geometry, rays, members, positions, covariance, settings)
    if len(members):
        members, kept = np.unique(members, axis=0, return_index=True)
        positions = positions[kept]
    positions, covariance = _refined(geometry, rays, members, positions, _STEPS)
    near = _in_range(geometry, positions, members >= 0, settings)
    members, positions, covariance = members[near], positions[near], covariance[near]
    views = (members >= 0).sum(axis=1)
    errors = _errors(geometry, rays, members, positions)
    free = np.ones(len(rays.balls) + 1, dtype=np.bool_)  # the last entry is for index -1, a missing ball
    chosen = []
    for row in np.lexsort((errors / np.maximum(views, 1), -views)):
        mine = members[row]
        if free[mine].all():
            chosen.append(row)
            if views[row] > 2:
                free[mine[mine >= 0]] = False
    order = np.array(sorted(chosen), dtype=np.intp)
    return members[order], positions[order], covariance[order]


def _completed(
    geometry: RigRays,
    rays: Rays,
    members: IntArray,
    positions: FloatArray,
    covariance: FloatArray,
    settings: TriangulationSettings,
) -> IntArray:
    """Members (n, c) with the most likely ball of each other camera added if it is within the gate."""
    members = np.array(members)
    if not len(members):
        return members
    made, by_point = _projected(geometry, positions)
    depth = positions @ geometry.rotations[:, 2].T + geometry.translations[:, 2]  # (n, c)
    # derivative of the point by the calibration's unknowns, through its balls
    pulls = np.zeros((len(members), 3, geometry.translation_factor.shape[2]))
    for camera in range(members.shape[1]):
        rows = np.flatnonzero(members[:, camera] >= 0)
        mine = members[rows, camera]
        moves = _moves(geometry, rays, mine, camera, made[rows, camera], depth[rows, camera])
        pulls[rows] -= by_point[rows, camera].transpose(0, 2, 1) @ rays.weight[mine] @ moves
    pulls = covariance @ pulls
    completed = np.array(members)
    for camera in range(members.shape[1]):
        rows = np.flatnonzero((members[:, camera] < 0) & (depth[:, camera] > settings.nearest))
        balls = np.arange(rays.first[camera], rays.first[camera + 1])
        if not len(rows) or not len(balls):
            continue
        derivative = by_point[rows, camera]
        root = derivative @ np.linalg.cholesky(covariance[rows])
        spread = rays.spread[balls]
        variance = (root @ root.transpose(0, 2, 1))[:, None] + spread @ spread.transpose(0, 2, 1)
        if pulls.shape[2]:
            moves = _moves(
                geometry,
                rays,
                np.tile(balls, len(rows)),
                camera,
                np.repeat(made[rows, camera], len(balls), axis=0),
                np.repeat(depth[rows, camera], len(balls)),
            ).reshape(len(rows), len(balls), 2, -1)
            moves = moves + (derivative @ pulls[rows])[:, None]
            variance = variance + moves @ moves.transpose(0, 1, 3, 2)
        missed = rays.flat[balls] - made[rows, camera][:, None]
        likely = (missed[:, :, None] @ np.linalg.solve(variance, missed[..., None]))[..., 0, 0]
        likely = np.where(np.isfinite(likely), likely, np.inf)
        best = likely.argmin(axis=1)
        good = likely[np.arange(len(rows)), best] < settings.gate**2
        completed[rows[good], camera] = balls[best[good]]
    return completed


def _moves(
    geometry: RigRays, rays: Rays, balls: IntArray, camera: int, flat: FloatArray, depth: FloatArray
) -> FloatArray:
    """(n, 2, r) effect of the calibration's unknowns on a point's image relative to the ball's pixel."""
    shift = geometry.translation_factor[camera]
    result: FloatArray = (
        rays.flat_factor[balls] + (shift[None, :2] - flat[:, :, None] * shift[None, 2:]) / depth[:, None, None]
    )
    return result


def _errors(geometry: RigRays, rays: Rays, members: IntArray, positions: FloatArray) -> FloatArray:
    """(n,) sums of squared reprojection errors, in standard deviations."""
    if not len(members):
        return np.zeros(0)
    made, _ = _projected(geometry, positions)
    missed = np.where((members >= 0)[:, :, None], rays.flat[members] - made, 0.0)
    errors: FloatArray = (missed[:, :, None] @ rays.weight[members] @ missed[..., None])[..., 0, 0].sum(axis=1)
    return errors
