"""Segmentation of a person in a depth image without a trained classifier.

Three cues, each optional: the static background is farther away, the floor lies below, and the person is near the mesh
predicted from the last frames. The remaining pixels are split into surfaces at depth jumps. Without a prediction, the
nearest surface of a person's size is taken, with the smaller ones beside it. Furniture may have a person's size: the
caller can ask for the next candidate if the body model does not fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera

_TILT: Final = 0.7
"""Largest angle between the floor's normal and the image's upward direction, radians."""
_ON_FLOOR: Final = 0.02
"""Largest distance of a point on the floor from its plane, metres."""
_CLEARANCE: Final = 0.05
"""Least distance of a person from the background or above the floor, metres; 12 standard deviations at 4.8 m."""
_REVEALED, _SMALL, _ABSORBED = 3, 30, 300
"""Frames until a surface becomes background: a farther one, a small one, and one that may be a person."""
_GRAZING: Final = 5.7
"""Largest slope of a surface against the image plane, 80 degrees; steeper steps are jumps between surfaces."""
REACH: Final = 0.25
"""Metres around the predicted mesh within which the person is searched for: 7.5 m/s at 30 Hz."""
_PERSON_AREA: Final = (0.12, 1.6)
"""Visible area of a person, square metres: from a child from the side to a large man with his arms out."""
_TRACKED_AREA: Final = 0.05
"""Least visible area of a tracked person, square metres: 0.08 from the side, from the head to the elbows."""
_PERSON_EXTENT: Final = (0.45, 2.3)
"""Longest side of the box around a person, metres."""
_ATTACHED: Final = 0.3
"""Share of a surface's boundary in contact with known background, above which the surface is background: e.g. wall that
an arm has hidden."""
_LEAST_AREA: Final = 0.0015
"""Least area of a surface that is not noise, square metres: a part of a hand."""
_FRAGMENT: Final = 0.15
"""Metres around a person's box within which smaller surfaces belong to the person, e.g. a hand in front of the
chest."""
_HEAD: Final = 0.3
"""Upward margin of that box, metres: a depth jump at the chin may separate the head from the trunk."""
_COVERED: Final = 0.02
"""Share of pixels with a measured distance, below which the lens counts as covered."""

COVERED = "hardly any pixel has a distance: is the lens covered?"
NOBODY = "nobody is seen"


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A floor plane; ``up . point + height`` is the height of a point above it.

    Attributes:
        up: (3,) unit normal in the optical frame.
        height: of the camera above the floor, metres.
    """

    up: FloatArray
    height: float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The person in one image.

    Attributes:
        mask: (height, width) pixels of the person.
        people: number of surfaces of a person's size; with a prediction 1 if the person is visible, else 0.
        reason: why the mask is empty; "" if it is not.
    """

    mask: BoolArray
    people: int
    reason: str = ""


class PersonFinder:
    """Segments one person in the images of a stationary camera.

    Args:
        view: the camera; the floor is estimated from its first images.
    """

    def __init__(self, view: DepthCamera) -> None:
        self._view = view
        self.reset()

    def reset(self) -> None:
        """Forget the background, e.g. after a backward jump of time or when the camera was moved."""
        shape = self._view.camera.height, self._view.camera.width
        self._background: SingleArray = np.zeros(shape, np.float32)
        self._other: SingleArray = np.zeros(shape, np.float32)
        self._stays = np.zeros(shape, np.int16)
        self.floor: Floor | None = None
        self._looks = 0

    def find(self, depth: SingleArray, predicted: FloatArray | None = None, choice: int = 0) -> Found:
        """Segment the person in an image, and learn the background from the rest.

        Args:
            depth: (height, width) metres, 0 where missing.
            predicted: (n, 3) predicted vertices, metres in the optical frame; None if nobody was tracked.
            choice: without a prediction, rank of the surface to take among those of a person's size, the nearest first;
                wraps around after the last one.

        Raises:
            DepthError: another size than the camera's.
        """
        self._view.check(depth)
        if is_covered(depth):
            return Found(np.zeros(depth.shape, np.bool_), 0, COVERED)
        if self.floor is None and self._looks < 30:
            self._looks += 1
            self.floor = find_floor(self._view, depth)
        up, height = (np.zeros(3), 1.0) if self.floor is None else (self.floor.up, self.floor.height)
        candidates = _candidates(depth, self._view.rays, self._background, up, height, _CLEARANCE)
        if predicted is not None:
            candidates &= near(predicted, depth, self._view.camera, REACH)
        labels, count = _surfaces(depth, candidates, 2.0 * _GRAZING / self._view.camera.matrix[0, 0])
        areas, boxes, attached = _measure(depth, self._view.rays, labels, count, self._background, _CLEARANCE)
        free = attached < _ATTACHED
        chosen = free & (areas > _LEAST_AREA)
        if predicted is None:
            chosen, alike, people = _person_among(areas, boxes, chosen, choice)
        else:
            people, alike = int(areas[chosen].sum() > _TRACKED_AREA), free
            chosen &= bool(people)
        mask = _of_surfaces(labels, chosen)
        frames = np.where(areas < _PERSON_AREA[0], _SMALL, 1)
        frames = np.where(alike, _ABSORBED if predicted is None else 0, np.where(free, frames, 1))
        patience = np.concatenate([[_SMALL], frames]).astype(np.int16)
        _learn(self._background, self._other, self._stays, depth, labels, patience, _CLEARANCE, _REVEALED)
        return Found(mask, people, "" if people else NOBODY)


def is_covered(depth: SingleArray) -> bool:
    """Whether hardly any pixel of an image has a measured distance."""
    return bool(np.count_nonzero(depth) < _COVERED * depth.size)


def _person_among(
    areas: FloatArray, boxes: FloatArray, chosen: BoolArray, choice: int
) -> tuple[BoolArray, BoolArray, int]:
    """Masks (S,) of one person's surfaces and of all surfaces of people, and the number of people.

    Args:
        areas: (S,) square metres of the surfaces.
        boxes: (S, 2, 3) corners of their bounding boxes, metres.
        chosen: (S,) surfaces that may belong to a person.
        choice: rank of the person, the nearest first.
    """
    longest = (boxes[:, 1] - boxes[:, 0]).max(axis=1, initial=0.0)
    alike = chosen & (areas > _PERSON_AREA[0]) & (areas < _PERSON_AREA[1])
    alike &= (longest > _PERSON_EXTENT[0]) & (longest < _PERSON_EXTENT[1])
    numbers = np.flatnonzero(alike)
    if not len(numbers):
        return np.zeros_like(chosen), alike, 0
    nearest = numbers[np.argsort(boxes[numbers].mean(axis=1)[:, 2])][choice % len(numbers)]
    low, high = boxes[nearest, 0] - [_FRAGMENT, _HEAD, _FRAGMENT], boxes[nearest, 1] + _FRAGMENT
    own = chosen & ~alike & (boxes[:, 0] > low).all(axis=1) & (boxes[:, 1] < high).all(axis=1)
    own[nearest] = True
    return own, alike | own, len(numbers)


def find_floor(view: DepthCamera, depth: SingleArray) -> Floor | None:
    """The largest upward plane with nothing below it; None if there is none.

    Random sample consensus (Fischler and Bolles 1981) over 200 triples of points from the lower half of the image, with
    a fixed seed; then a least-squares plane through its inliers.

    Args:
        view: the camera, level within :data:`_TILT`.
        depth: (height, width) metres, 0 where missing.
    """
    points = view.points(depth)[depth.shape[0] // 2 :: 2, ::16].reshape(-1, 3).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        return None
    rng = np.random.default_rng(0)
    a, b, c = points[rng.integers(len(points), size=(3, 200))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    known = lengths > 1e-4
    normals = normals[known] / lengths[known, None]
    normals *= np.where(normals[:, 1] > 0.0, -1.0, 1.0)[:, None]
    origins = a[known][-normals[:, 1] > np.cos(_TILT)]
    normals = normals[-normals[:, 1] > np.cos(_TILT)]
    heights = points @ normals.T - (origins * normals).sum(axis=1)
    on, below = (np.abs(heights) < _ON_FLOOR).mean(axis=0), (heights < -2.0 * _ON_FLOOR).mean(axis=0)
    on = np.where(below < 0.02, on, 0.0)
    if not on.size or on.max() < 0.1:
        return None
    distances = heights[:, np.argmax(on)]
    for within in (_ON_FLOOR, 0.6 * _ON_FLOOR):
        # the second round is stricter, because the lowest points of walls are near the floor too
        chosen = points[np.abs(distances) < within]
        middle = chosen.mean(axis=0)
        up = np.linalg.svd(chosen - middle, full_matrices=False)[2][2]
        up *= -np.sign(up[1])
        distances = (points - middle) @ up
    return Floor(up, float(-up @ middle))


def near(vertices: FloatArray, depth: SingleArray, camera: Camera, reach: float) -> BoolArray:
    """(height, width) mask of pixels whose points are within about ``reach`` metres of a mesh.

    On a grid of every fourth pixel, a box of ``reach`` around each vertex spans an interval of distances; a pixel is
    near if its distance lies within the interval.
    """
    with np.errstate(invalid="ignore"):
        pixels = camera.project(vertices)
    return _near(pixels, vertices[:, 2].copy(), depth, reach, 0.5 * (camera.matrix[0, 0] + camera.matrix[1, 1]))


@compiled
def _near(pixels: FloatArray, distances: FloatArray, depth: SingleArray, reach: float, focal: float) -> BoolArray:
    height, width = depth.shape
    rows, columns = (height + 3) // 4, (width + 3) // 4
    low, high = np.full((rows, columns), np.inf), np.full((rows, columns), -np.inf)
    for k in range(len(distances)):
        z = distances[k]
        if not (z > 0.1 and abs(pixels[k, 0]) < 1e6 and abs(pixels[k, 1]) < 1e6):
            continue
        radius = int(0.25 * reach * focal / z) + 1
        column, row = int(pixels[k, 0] / 4.0), int(pixels[k, 1] / 4.0)
        for i in range(max(row - radius, 0), min(row + radius + 1, rows)):
            for j in range(max(column - radius, 0), min(column + radius + 1, columns)):
                low[i, j] = min(low[i, j], z)
                high[i, j] = max(high[i, j], z)
    found = np.zeros((height, width), dtype=np.bool_)
    for i in range(height):
        for j in range(width):
            z = depth[i, j]
            found[i, j] = z > 0.0 and low[i // 4, j // 4] - reach <= z <= high[i // 4, j // 4] + reach
    return found


@compiled
def _candidates(
    depth: SingleArray, rays: SingleArray, background: SingleArray, up: FloatArray, height: float, clearance: float
) -> BoolArray:
    """Mask of pixels above the floor and nearer than the background, or without known background."""
    rows, columns = depth.shape
    found = np.zeros((rows, columns), dtype=np.bool_)
    for i in range(rows):
        for j in range(columns):
            z = depth[i, j]
            if z <= 0.0 or (background[i, j] > 0.0 and z > background[i, j] - clearance):
                continue
            above = z * (up[0] * rays[i, j, 0] + up[1] * rays[i, j, 1] + up[2]) + height
            found[i, j] = above > clearance
    return found


@compiled
def _learn(
    background: SingleArray,
    other: SingleArray,
    stays: NDArray[np.int16],
    depth: SingleArray,
    labels: NDArray[np.int32],
    patience: NDArray[np.int16],
    clearance: float,
    revealed: int,
) -> None:
    """Update the background of each pixel, in place.

    A surface other than the background replaces it after ``revealed`` frames if it is farther, else after ``patience``
    frames of its label; never for 0. ``other`` is its distance, ``stays`` the number of frames.
    """
    rows, columns = depth.shape
    for i in range(rows):
        for j in range(columns):
            z, known = depth[i, j], background[i, j]
            if z <= 0.0:
                continue
            if known > 0.0 and abs(z - known) <= clearance:
                background[i, j] = known + (z - known) / 16.0
                stays[i, j] = 0
                continue
            frames = patience[labels[i, j]]
            if known > 0.0 and z > known:
                frames = revealed
            if abs(z - other[i, j]) > clearance or frames == 0:
                other[i, j], stays[i, j] = z, 0
            stays[i, j] += 1
            if frames > 0 and stays[i, j] >= frames:
                background[i, j], stays[i, j] = z, 0


@compiled
def _surfaces(depth: SingleArray, candidates: BoolArray, jump: float) -> tuple[NDArray[np.int32], int]:
    """Connected surfaces on every second pixel, by union-find: labels (height, width) from 1, and their number.

    A candidate between these pixels takes the label of the first of four grid pixels around it on the same surface.
    """
    height, width = depth.shape
    rows, columns = height // 2, width // 2
    parent = np.zeros(rows * columns + 1, dtype=np.int32)
    small = np.zeros((rows, columns), dtype=np.int32)
    for i in range(rows):
        for j in range(columns):
            if not candidates[2 * i, 2 * j]:
                continue
            z = depth[2 * i, 2 * j]
            own = i * columns + j + 1
            parent[own] = own
            small[i, j] = own
            for a, b in ((i, j - 1), (i - 1, j - 1), (i - 1, j), (i - 1, j + 1)):
                if a < 0 or b < 0 or b >= columns or small[a, b] == 0:
                    continue
                if abs(depth[2 * a, 2 * b] - z) > jump * z:
                    continue
                first, second = small[a, b], own
                while parent[first] != first:
                    parent[first] = parent[parent[first]]
                    first = parent[first]
                while parent[second] != second:
                    parent[second] = parent[parent[second]]
                    second = parent[second]
                parent[max(first, second)] = min(first, second)
    count = 0
    numbers = np.zeros(rows * columns + 1, dtype=np.int32)
    for own in range(1, len(parent)):
        if parent[own] == own:
            count += 1
            numbers[own] = count
        elif parent[own] > 0:
            # a parent comes before its child
            numbers[own] = numbers[parent[own]]
    labels = np.zeros((height, width), dtype=np.int32)
    for i in range(height):
        for j in range(width):
            if not candidates[i, j]:
                continue
            z = depth[i, j]
            for a, b in ((i // 2, j // 2), (i // 2, j // 2 + 1), (i // 2 + 1, j // 2), (i // 2 + 1, j // 2 + 1)):
                if a < rows and b < columns and small[a, b] > 0 and abs(depth[2 * a, 2 * b] - z) <= jump * z:
                    labels[i, j] = numbers[small[a, b]]
                    break
    return labels, count


@compiled
def _of_surfaces(labels: NDArray[np.int32], chosen: BoolArray) -> BoolArray:
    """The pixels of the chosen surfaces."""
    found = np.zeros(labels.shape, dtype=np.bool_)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            found[i, j] = labels[i, j] > 0 and chosen[labels[i, j] - 1]
    return found


@compiled
def _measure(
    depth: SingleArray,
    rays: SingleArray,
    labels: NDArray[np.int32],
    count: int,
    background: SingleArray,
    clearance: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Area in square metres (count,), corners (count, 2, 3) of each surface's bounding box, and share (count,) of its
    boundary in contact with known background.
    """
    areas, edges, contacts = np.zeros(count), np.zeros(count), np.zeros(count)
    boxes = np.zeros((count, 2, 3))
    boxes[:, 0], boxes[:, 1] = np.inf, -np.inf
    height, width = depth.shape
    # ray difference between neighbouring pixels: one over the focal length
    across = abs(rays[height // 2, width // 2, 0] - rays[height // 2, width // 2 - 1, 0])
    down = abs(rays[height // 2, width // 2, 1] - rays[height // 2 - 1, width // 2, 1])
    point = np.zeros(3)
    for i in range(height):
        for j in range(width):
            label = labels[i, j] - 1
            if label < 0:
                continue
            z = depth[i, j]
            areas[label] += z * z * across * down
            point[0], point[1], point[2] = rays[i, j, 0] * z, rays[i, j, 1] * z, z
            for k in range(3):
                boxes[label, 0, k] = min(boxes[label, 0, k], point[k])
                boxes[label, 1, k] = max(boxes[label, 1, k], point[k])
            for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                if a < 0 or b < 0 or a >= height or b >= width or labels[a, b] == label + 1:
                    continue
                other = depth[a, b]
                if other <= 0.0:
                    continue
                edges[label] += 1.0
                still = background[a, b] > 0.0 and abs(other - background[a, b]) <= clearance
                if labels[a, b] == 0 and still and abs(other - z) <= clearance:
                    contacts[label] += 1.0
    return areas, boxes, contacts / np.maximum(edges, 1.0)
