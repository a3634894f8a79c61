"""Simulated stereo measurements of targets: noisy pixels, triangulated linearly, with covariance.

The rig of Gaschler 2011, section 6.1: f 834 pixels, baseline 0.48 m, toed in by 13 degrees, 0.1 pixel noise. Its frame
is midway between the cameras, z forward.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.distinct import TargetsAlikeError, check_distinct
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.pose import balls_covariance, maximum_likelihood
from body_tracking.markers.targets import Target

PIXEL_NOISE = 0.1
_FOCAL = 834.0
_TURNED = Rotation.from_rotvec(np.deg2rad([[0.0, -13.0, 0.0], [0.0, 13.0, 0.0]])).as_matrix()
_CENTRES = np.array([[0.24, 0.0, 0.0], [-0.24, 0.0, 0.0]])
# toed in: the optical axis of the right camera points left, x_cam = R (x - centre)
ROTATIONS = _TURNED.transpose(0, 2, 1)
TRANSLATIONS = -np.einsum("cij,cj->ci", ROTATIONS, _CENTRES)

TARGET_POINTS = np.array(
    [[0.0, 0.0, 0.0], [0.098, 0.0, 0.0], [0.029, 0.061, 0.0], [0.062, 0.032, 0.038], [0.012, 0.028, 0.047]]
)
TARGET_POINTS = TARGET_POINTS - TARGET_POINTS.mean(axis=0)


def project(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (2, n, 2) relative to the principal point, and Jacobians (2, n, 2, 3)."""
    inside = np.einsum("cij,nj->cni", ROTATIONS, points) + TRANSLATIONS[:, None]
    depth = inside[..., 2]
    pixels = _FOCAL * inside[..., :2] / depth[..., None]
    by_camera = np.zeros((*pixels.shape, 3))
    by_camera[..., 0, 0] = by_camera[..., 1, 1] = _FOCAL / depth
    by_camera[..., 2] = -pixels / depth[..., None]
    return pixels, by_camera @ ROTATIONS[:, None]


def measure(true: FloatArray, rng: np.random.Generator, stamp_ns: int = 0, pixel_noise: float = PIXEL_NOISE) -> Points:
    """Noisy points with covariance, in the order of the true ones, by linear triangulation (Gaschler eq. 3.4-3.5)."""
    pixels, _ = project(true)
    poses = np.concatenate([ROTATIONS, TRANSLATIONS[..., None]], axis=2)
    flat = (pixels + rng.normal(0.0, pixel_noise, pixels.shape)) / _FOCAL
    homogeneous = np.asarray(cv2.triangulatePoints(*poses, *flat.swapaxes(1, 2)), dtype=np.float64)
    positions = (homogeneous[:3] / homogeneous[3]).T
    _, jacobian = project(positions)
    information = np.einsum("cnij,cnik->njk", jacobian, jacobian) / pixel_noise**2
    covariance = np.linalg.inv(information)
    return Points(stamp_ns, "rig", positions, covariance, np.zeros((len(true), 0), dtype=np.int64))


def random_rotation(rng: np.random.Generator) -> FloatArray:
    """(3, 3) uniformly distributed random rotation."""
    return np.asarray(Rotation.random(random_state=rng).as_matrix())


def random_targets(rng: np.random.Generator, count: int, noise: float = 8e-4) -> list[Target]:
    """Targets of 98 mm, not flat, with five balls at least 25 mm apart, distinguishable at this noise (metres)."""
    targets: list[Target] = []
    while len(targets) < count:
        points = rng.uniform(-1.0, 1.0, (5, 3))
        distances = np.linalg.norm(points[:, None] - points[None], axis=2)
        points *= 0.098 / distances.max()
        distances *= 0.098 / distances.max()
        off = distances[np.triu_indices(5, 1)]
        widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if off.min() < 0.025 or widths[2] < 0.015:
            continue
        points = points - points.mean(axis=0)
        target = Target(f"target{len(targets)}", points, np.zeros((15, 15)), 0.012)
        try:
            check_distinct([*targets, target], noise)
        except TargetsAlikeError:
            continue
        targets.append(target)
    return targets


@lru_cache(maxsize=100)
def target_set(number: int, count: int = 5) -> list[Target]:
    """A set of targets of five balls, determined by the number."""
    return random_targets(np.random.default_rng([number, 1]), count)


def scene(
    targets: list[Target], distance: float, rng: np.random.Generator, spurious: int = 80, hidden: int = 1
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray]], list[FloatArray]]:
    """Shuffled true points, owners (n, 2): target and ball (-1: spurious), poses, and point indices (k,) per target."""
    poses: list[tuple[FloatArray, FloatArray]] = []
    rows: list[FloatArray] = []
    owners: list[tuple[int, int]] = []
    centres: list[FloatArray] = []
    while len(centres) < len(targets):
        centre = np.array([0.0, 0.0, distance]) + rng.uniform(-1.0, 1.0, 3) * np.array([0.25, 0.2, 0.1]) * distance
        if all(np.linalg.norm(centre - other) > 0.13 for other in centres):
            centres.append(centre)
    for index, (target, centre) in enumerate(zip(targets, centres, strict=True)):
        rotation = random_rotation(rng)
        poses.append((rotation, centre))
        seen = np.sort(rng.permutation(len(target.points))[hidden:])
        rows.extend(target.points[seen] @ rotation.T + centre)
        owners.extend((index, ball) for ball in seen)
    for number in range(spurious):
        if number % 2:
            where = centres[rng.integers(len(centres))] + rng.normal(0.0, 0.05, 3)
        else:
            where = np.array([0.0, 0.0, distance]) + rng.uniform(-1.0, 1.0, 3) * np.array([0.3, 0.25, 0.15]) * distance
        rows.append(where)
        owners.append((-1, -1))
    order = rng.permutation(len(rows))
    points, owner = np.array(rows)[order], np.array(owners)[order]
    assignments = []
    for index, target in enumerate(targets):
        assignment = np.full(len(target.points), -1)
        for row in np.flatnonzero(owner[:, 0] == index):
            assignment[owner[row, 1]] = row
        assignments.append(assignment)
    return points, owner, poses, assignments


def moving(
    targets: list[Target], distance: float, rng: np.random.Generator, frames: int, spurious: int
) -> Iterator[tuple[int, FloatArray, list[tuple[FloatArray, FloatArray]], list[FloatArray]]]:
    """Frames at 60 Hz of targets that swing about a position and turn: stamp, and points, poses, indices of
    :func:`scene`.

    Amplitudes of 4 cm and 0.6 rad at up to 1 Hz. One ball of each target is hidden; it changes every 20 frames. Half of
    the spurious points are near the targets, and all of them are stationary.
    """
    count = len(targets)
    _, owner, poses, _ = (first := scene(targets, distance, rng, spurious, 0))
    clutter = first[0][owner[:, 0] < 0]
    axes, frequencies = rng.normal(size=(count, 2, 3)), rng.uniform(0.3, 1.0, (count, 2))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    hidden = np.zeros(count, dtype=int)
    for frame in range(frames):
        if frame % 20 == 0:
            hidden = np.array([rng.integers(len(target.points)) for target in targets])
        phase = 2.0 * np.pi * frequencies * frame / 60.0
        now, rows, owners = [], [], []
        for index, target in enumerate(targets):
            turned = Rotation.from_rotvec(0.6 * np.sin(phase[index, 0]) * axes[index, 0]).as_matrix() @ poses[index][0]
            centre = poses[index][1] + 0.04 * np.sin(phase[index, 1]) * axes[index, 1]
            now.append((turned, centre))
            for ball, point in enumerate(target.points):
                if ball != hidden[index]:
                    rows.append(turned @ point + centre)
                    owners.append((index, ball))
        rows.extend(clutter)
        owners.extend([(-1, -1)] * len(clutter))
        order = rng.permutation(len(rows))
        assignments = [np.full(len(target.points), -1) for target in targets]
        for row, source in enumerate(order):
            if owners[source][0] >= 0:
                assignments[owners[source][0]][owners[source][1]] = row
        yield round(frame / 60.0 * 1e9), np.array(rows)[order], now, assignments


def fit_pose(target: Target, points: Points, assignment: IntArray) -> TargetPose:
    """The maximum likelihood pose of a target from the points (k,) of its balls, -1 if unseen."""
    seen = np.flatnonzero(assignment >= 0)
    chosen = assignment[seen]
    model, measured, noise = target.points[seen], points.positions[chosen], points.covariance[chosen]
    fits = maximum_likelihood(model[None], measured[None], noise[None], balls_covariance(target, seen)[None])
    return TargetPose(
        target.name,
        points.stamp_ns,
        points.frame_id,
        fits.rotation[0],
        fits.translation[0],
        fits.covariance[0],
        assignment,
        float(fits.residual[0]),
    )


def rotation_error(first: FloatArray, second: FloatArray) -> FloatArray:
    """(3,) rotation vector v with ``first = exp(v) @ second``."""
    return np.asarray(Rotation.from_matrix(first @ second.T).as_rotvec())
