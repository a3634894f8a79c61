"""Rendered scenes of balls in front of one camera, and errors of their detection, for tests and benchmarks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.detection import detect
from body_tracking.markers.rendering import Capsule, Rendered, Sensor, render

DIAMETER = 0.014
CAMERA = Camera(
    "left",
    640,
    480,
    np.array([[834.0, 0.0, 319.5], [0.0, 834.0, 239.5], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.1, 1e-3, -1e-3, 0.0]),
)
HERE = np.eye(3), np.zeros(3)
NOISELESS = Sensor(bits=16, background=0.0, read_noise=0.0, full_well=1e30)
_GRID = np.stack(np.meshgrid(np.arange(40, 620, 58), np.arange(40, 450, 58)), axis=-1).reshape(-1, 2)


def at(pixels: FloatArray, depths: FloatArray) -> FloatArray:
    """Points (n, 3) that project to pixels (n, 2) at depths (n,), metres."""
    rays = CAMERA.rays(pixels)
    return rays / rays[:, 2:] * depths[:, None]


def apart(seed: int, low: float, high: float, sensor: Sensor, count: int = 15, glints: int = 0) -> Rendered:
    """Balls that do not touch, at depths from ``low`` to ``high``, metres."""
    random = np.random.default_rng(seed)
    pixels = random.permutation(_GRID)[:count] + random.uniform(-8.0, 8.0, (count, 2))
    points = at(pixels, random.uniform(low, high, count))
    return render(CAMERA, *HERE, points, DIAMETER, sensor, seed, glints=glints)


def overlapping(seed: int, depth: float, behind: float, sensor: Sensor, offset: float = 0.81) -> Rendered:
    """Two balls, the second ``behind`` metres behind the first; ``offset``: centre distance in radii (0.81 hides
    half).
    """
    random = np.random.default_rng(seed)
    angle = random.uniform(0.0, 2.0 * np.pi)
    step = offset * 834.0 * 0.5 * DIAMETER / depth * np.array([np.cos(angle), np.sin(angle)])
    pixels = np.array([300.0, 200.0]) + random.uniform(-0.5, 0.5, 2) + np.array([[0.0], [1.0]]) * step
    return render(CAMERA, *HERE, at(pixels, depth + np.array([0.0, behind])), DIAMETER, sensor, seed)


def three_touching(seed: int, depth: float, sensor: Sensor) -> Rendered:
    """Three balls that touch in the image, each 20 mm behind the previous one."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0.0, 2.0 * np.pi) + np.arange(3) * 2.0 * np.pi / 3.0
    side = DIAMETER / np.sqrt(3.0) * 834.0 / depth
    middle = np.array([300.0, 200.0]) + random.uniform(-0.5, 0.5, 2)
    points = at(middle + side * np.stack([np.cos(angle), np.sin(angle)], axis=1), depth + np.array([0.0, 0.02, 0.04]))
    return render(CAMERA, *HERE, points, DIAMETER, sensor, seed)


def cut_by_border(seed: int, depth: float, sensor: Sensor) -> Rendered:
    """A ball whose centre is up to 0.7 radii inside the image's border."""
    random = np.random.default_rng(seed)
    radius = 834.0 * 0.5 * DIAMETER / depth
    along, into = random.uniform(100.0, 380.0), random.uniform(0.0, 0.7) * radius
    place = [(along, into), (into, along), (along, 479.0 - into), (639.0 - into, along)][int(random.integers(4))]
    return render(CAMERA, *HERE, at(np.array([place]), np.array([depth])), DIAMETER, sensor, seed)


def half_hidden(seed: int, depth: float, sensor: Sensor) -> Rendered:
    """A ball half hidden by a limb in front of it."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0.0, 2.0 * np.pi)
    ball = at(np.array([[300.0, 200.0]]) + random.uniform(-0.5, 0.5, 2), np.array([depth]))
    towards, along = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    middle = ball[0] * (depth - 0.1) / depth + 0.04 * towards
    limb = Capsule(middle - 0.3 * along, middle + 0.3 * along, 0.04)
    return render(CAMERA, *HERE, ball, DIAMETER, sensor, seed, limbs=[limb])


def found(scenes: Sequence[Rendered]) -> tuple[FloatArray, FloatArray, int, int]:
    """Errors (n, 2), stated standard deviations (n, 2), and numbers of missed balls and false detections."""
    wrong, stated, missed, extra = [], [], 0, 0
    for scene in scenes:
        balls = detect(scene.image)
        distance = np.linalg.norm(balls.pixels[:, None] - scene.centroids, axis=2)
        near = distance < 2.0
        seen = near.any(axis=0)
        missed += int((~seen).sum())
        extra += int((~near.any(axis=1)).sum())
        for index in np.flatnonzero(seen):
            nearest = distance[:, index].argmin()
            wrong.append(balls.pixels[nearest] - scene.centroids[index])
            stated.append(np.sqrt(np.diagonal(balls.covariance[nearest])))
    return np.array(wrong).reshape(-1, 2), np.array(stated).reshape(-1, 2), missed, extra
