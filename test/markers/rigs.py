"""Rigs, boards and balls to test the marker system's cameras with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.bundle import Corners
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.rig import Rig

ROTATIONS = ((0.0, 0.0, 0.0), (0.021, 0.227, -0.013), (-0.25, 0.11, 0.03), (0.1, -0.3, 0.0))
TRANSLATIONS = ((0.0, 0.0, 0.0), (-0.47436, -0.00149, 0.05103), (-0.2, -0.45, 0.08), (0.4, 0.1, 0.05))
"""Of the cameras; the first two are those of Gaschler's table 4.1."""


def rig(count: int = 2) -> Rig:
    """Cameras as Gaschler's, f 834 px, 0.48 m apart and toed in by 13 deg, whose calibration is exact."""
    matrix = np.array([[834.0, 0.0, 318.0], [0.0, 834.0, 245.0], [0.0, 0.0, 1.0]])
    lens = np.array([-0.236, 0.304, 0.0, 0.0, 0.0])
    cameras = tuple(Camera("abcd"[index], 640, 480, matrix, lens) for index in range(count))
    turns = so3.quat_to_matrix(so3.exp(np.array(ROTATIONS[:count])))
    return Rig(cameras, turns, np.array(TRANSLATIONS[:count]), np.zeros((15 * count, 15 * count)))


def seen_boards(truth: Rig, rng: np.random.Generator, views: int = 13, noise: float = 0.1) -> Corners:
    """Corners of a board of 9 x 6, squares of 40 mm, at so many places where the cameras see it."""
    board = np.zeros((6, 9, 3))
    board[:, :, 0], board[:, :, 1] = 0.04 * np.arange(9), 0.04 * np.arange(6)[:, None]
    board = board.reshape(-1, 3)
    parts: list[tuple[FloatArray, FloatArray]] = []
    while len(parts) < views:
        turn = so3.quat_to_matrix(so3.exp(rng.uniform([-0.6, -0.6, -0.6], [0.6, 0.6, 0.6])))
        place = rng.uniform([-0.1, -0.25, 0.85], [0.5, 0.25, 1.5]) - turn @ board.mean(axis=0)
        pixels = truth.project(board @ turn.T + place)
        inside = [camera.contains(pixels[index]).all() for index, camera in enumerate(truth.cameras)]
        if sum(inside) >= min(2, len(truth.cameras)):
            parts.append((pixels, np.array(inside)))
    cameras, numbers, corners, seen = [], [], [], []
    for view, (pixels, inside) in enumerate(parts):
        for index in np.flatnonzero(inside):
            cameras.append(np.full(len(board), index))
            numbers.append(np.full(len(board), view))
            corners.append(board)
            seen.append(pixels[index] + noise * rng.normal(size=pixels[index].shape))
    return Corners(np.concatenate(cameras), np.concatenate(numbers), np.concatenate(corners), np.concatenate(seen))


def turned(truth: Rig, camera: int, turn: FloatArray) -> Rig:
    """The rig after a camera was turned about itself by a rotation vector in its own frame."""
    change = so3.quat_to_matrix(so3.exp(turn))
    rotations, translations = np.array(truth.rotations), np.array(truth.translations)
    rotations[camera], translations[camera] = change @ rotations[camera], change @ translations[camera]
    return Rig(truth.cameras, rotations, translations, truth.covariance)


def images(
    truth: Rig, points: Sequence[FloatArray], rng: np.random.Generator, noise: float = 0.1, stamp_ns: int = 0
) -> tuple[list[ImageBalls], list[FloatArray]]:
    """Balls in any order in the images of each camera, and the number of each ball's point.

    The points (n, 3) are those at each camera's own time.
    """
    balls, numbers = [], []
    for index, camera in enumerate(truth.cameras):
        pixels = truth.project(points[index])[index]
        pixels = pixels + noise * rng.normal(size=pixels.shape)
        order = rng.permutation(np.flatnonzero(camera.contains(pixels)))
        covariance = np.tile(max(noise, 1e-3) ** 2 * np.eye(2), (len(order), 1, 1))
        balls.append(ImageBalls(stamp_ns, camera.frame_id, pixels[order], np.full(len(order), 60.0), covariance))
        numbers.append(order)
    return balls, numbers
