"""The landmarks of people in a colour image, by the two networks of MediaPipe's pose landmarker (BlazePose).

A detector finds people in the whole image (224 x 224 pixels); a second network finds 33 landmarks in a square region
that is turned upright (256 x 256). Where a person was in the last image, the region follows from their landmarks there
and the detector is not needed.

Bazarevsky et al. (2020): "BlazePose: on-device real-time body pose tracking", arXiv:2006.10204. The networks are
Google's, under the Apache licence 2.0; ``body_tracking camera model`` fetches them. The numbers below are properties of
these networks.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray

DETECTOR_FILE: Final = "pose_detection.tflite"
LANDMARKS_FILE: Final = "pose_landmark_full.tflite"

_DETECTOR_PIXELS: Final = 224
_LANDMARK_PIXELS: Final = 256
_HEATMAP_PIXELS: Final = 64
_STRIDES: Final = ((8, 2), (16, 2), (32, 6))
"""Pixels between the anchors of each layer of the detector, and anchors at each place."""
_REGION_SCALE: Final = 1.25
"""Side of a region, in diameters of the circle around a person that the networks state."""
_REFINED_FROM: Final = 0.5
"""Least peak of a landmark's heat map that moves the landmark."""
_REFINED_OVER: Final = 3
"""Cells of the heat map to each side of a landmark."""
_SAME_PERSON: Final = 0.5
"""Overlap (intersection over union) of two regions from which on they are of one person."""

ImageArray = NDArray[np.uint8]


class PoseModelError(BodyTrackingError):
    """Raised when the networks cannot be fetched or read, or the library that runs them is not installed."""


class Landmark(IntEnum):
    """The landmarks in their order; left and right are the person's."""

    NOSE = 0
    EYE_INNER_LEFT = 1
    EYE_LEFT = 2
    EYE_OUTER_LEFT = 3
    EYE_INNER_RIGHT = 4
    EYE_RIGHT = 5
    EYE_OUTER_RIGHT = 6
    EAR_LEFT = 7
    EAR_RIGHT = 8
    MOUTH_LEFT = 9
    MOUTH_RIGHT = 10
    SHOULDER_LEFT = 11
    SHOULDER_RIGHT = 12
    ELBOW_LEFT = 13
    ELBOW_RIGHT = 14
    WRIST_LEFT = 15
    WRIST_RIGHT = 16
    LITTLE_FINGER_LEFT = 17
    LITTLE_FINGER_RIGHT = 18
    INDEX_FINGER_LEFT = 19
    INDEX_FINGER_RIGHT = 20
    THUMB_LEFT = 21
    THUMB_RIGHT = 22
    HIP_LEFT = 23
    HIP_RIGHT = 24
    KNEE_LEFT = 25
    KNEE_RIGHT = 26
    ANKLE_LEFT = 27
    ANKLE_RIGHT = 28
    HEEL_LEFT = 29
    HEEL_RIGHT = 30
    TOES_LEFT = 31
    TOES_RIGHT = 32


_CENTRE, _RIM = len(Landmark), len(Landmark) + 1
"""Two further points of the second network: the centre of the circle around the person, and its uppermost point."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A square of an image in which a person stands upright.

    Attributes:
        centre: (2,) pixels.
        side: pixels.
        angle: radians by which it is turned clockwise in the image.
    """

    centre: FloatArray
    side: float
    angle: float

    @classmethod
    def around(cls, centre: FloatArray, rim: FloatArray) -> Region:
        """The region of a person whose circle has this centre and uppermost point, both (2,) pixels."""
        along = rim - centre
        return cls(centre, 2.0 * _REGION_SCALE * float(np.hypot(*along)), float(np.arctan2(along[0], -along[1])))

    @property
    def to_image(self) -> FloatArray:
        """(2, 3) affine map from the unit square (its middle at 0.5, 0.5) to pixels of the image."""
        c, s = np.cos(self.angle) * self.side, np.sin(self.angle) * self.side
        turned = np.array([[c, -s], [s, c]])
        return np.column_stack([turned, self.centre - turned @ [0.5, 0.5]])

    def overlap(self, other: Region) -> float:
        """Intersection over union of the two squares, taken as upright."""
        least = np.minimum(self.centre + self.side / 2.0, other.centre + other.side / 2.0)
        most = np.maximum(self.centre - self.side / 2.0, other.centre - other.side / 2.0)
        common = float(np.prod(np.maximum(least - most, 0.0)))
        return common / (self.side**2 + other.side**2 - common)


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """The landmarks of one person.

    Attributes:
        pixels: (33, 2) in the image.
        visible: (33,) probability that the landmark is in the image and not hidden.
        present: (33,) probability that the landmark is in the image.
        world: (33, 3) metres from the middle of the hips, by a statistical model of bodies: x right, y down, z away
            from the camera.
        presence: probability that there is a person in the region.
        region: in which they were found.
        next_region: in which to look in the next image.
    """

    pixels: FloatArray
    visible: FloatArray
    present: FloatArray
    world: FloatArray
    presence: float
    region: Region
    next_region: Region


def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + np.exp(-np.clip(x, -60.0, 60.0)))


class PoseModel:
    """The two networks.

    Args:
        folder: with :data:`DETECTOR_FILE` and :data:`LANDMARKS_FILE`.
        threads: processors that a network may use.

    Raises:
        PoseModelError: a file is missing or no network of this kind, or the library that runs them is not installed.
    """

    def __init__(self, folder: Path, threads: int = 1) -> None:
        self._detector = _Network(folder / DETECTOR_FILE, threads, _DETECTOR_PIXELS, 2)
        self._landmarks = _Network(folder / LANDMARKS_FILE, threads, _LANDMARK_PIXELS, 5)
        self._anchors = _anchors()

    def detect(self, image: ImageArray, least: float = 0.5) -> list[Region]:
        """The regions of people in an image, the surest first.

        Args:
            image: (height, width, 3) red, green, blue.
            least: least probability.
        """
        height, width = image.shape[:2]
        scale = _DETECTOR_PIXELS / max(height, width)
        # centred in a black square
        shift = (_DETECTOR_PIXELS - scale * np.array([width, height])) / 2.0
        to_square = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
        square = cv2.warpAffine(image, to_square, (_DETECTOR_PIXELS, _DETECTOR_PIXELS), flags=cv2.INTER_LINEAR)
        boxes, scores = self._detector(square.astype(np.float32) / np.float32(127.5) - np.float32(1.0))
        probable = _sigmoid(scores[0, :, 0].astype(np.float64))
        chosen = np.flatnonzero(probable > least)
        # after the four numbers of the box come the detector's points, of which the first two are centre and rim
        points = boxes[0, chosen, 4:8].astype(np.float64).reshape(-1, 2, 2) / _DETECTOR_PIXELS
        points = ((points + self._anchors[chosen, None]) * _DETECTOR_PIXELS - shift) / scale
        regions: list[Region] = []
        for k in np.argsort(-probable[chosen]):
            region = Region.around(points[k, 0], points[k, 1])
            if region.side > 0.0 and all(region.overlap(each) < _SAME_PERSON for each in regions):
                regions.append(region)
        return regions

    def find(self, image: ImageArray, region: Region) -> Landmarks:
        """The landmarks of the person in a region of an image (height, width, 3) of red, green, blue."""
        to_image = region.to_image
        to_crop = cv2.invertAffineTransform(to_image) * _LANDMARK_PIXELS
        crop = cv2.warpAffine(image, to_crop, (_LANDMARK_PIXELS, _LANDMARK_PIXELS), flags=cv2.INTER_LINEAR)
        found, presence, _, heat, world = self._landmarks(crop.astype(np.float32) / np.float32(255.0))
        each = found.reshape(-1, 5).astype(np.float64)
        flat = _refined(each[:, :2] / _LANDMARK_PIXELS, heat[0])
        pixels = flat @ to_image[:, :2].T + to_image[:, 2]
        count = len(Landmark)
        # the model's axes are those of the turned region
        c, s = np.cos(region.angle), np.sin(region.angle)
        positions = world.reshape(-1, 3)[:count].astype(np.float64)
        positions = positions @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return Landmarks(
            pixels[:count],
            _sigmoid(each[:count, 3]),
            _sigmoid(each[:count, 4]),
            positions,
            float(presence.ravel()[0]),
            region,
            Region.around(pixels[_CENTRE], pixels[_RIM]),
        )


def _anchors() -> FloatArray:
    """(2254, 2) centres of the detector's anchors, in sides of its image."""
    layers = []
    for stride, count in _STRIDES:
        cells = _DETECTOR_PIXELS // stride
        rows, columns = np.mgrid[:cells, :cells]
        centres = (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5) / cells
        layers.append(np.repeat(centres, count, axis=0))
    return np.concatenate(layers)


def _refined(flat: FloatArray, heat: SingleArray) -> FloatArray:
    """Landmarks moved to the centre of mass of their heat maps around them.

    Args:
        flat: (n, 2) in sides of the region.
        heat: (64, 64, n) logits.
    """
    cells = np.floor(flat * _HEATMAP_PIXELS).astype(int)
    reach = np.arange(-_REFINED_OVER, _REFINED_OVER + 1)
    columns, rows = cells[:, :1] + reach, cells[:, 1:] + reach  # (n, 2 over + 1)
    there = _in_heatmap(rows)[:, :, None] & _in_heatmap(columns)[:, None]
    taken = np.clip(rows, 0, _HEATMAP_PIXELS - 1)[:, :, None], np.clip(columns, 0, _HEATMAP_PIXELS - 1)[:, None]
    patches = np.where(there, _sigmoid(heat[(*taken, np.arange(len(flat))[:, None, None])].astype(np.float64)), 0.0)
    total = patches.sum(axis=(1, 2))
    sure = _in_heatmap(cells).all(axis=1) & (patches.max(axis=(1, 2)) >= _REFINED_FROM) & (total > 0.0)
    moments = np.stack([(patches.sum(axis=1) * columns).sum(axis=1), (patches.sum(axis=2) * rows).sum(axis=1)], axis=1)
    centres = moments / np.where(sure, total, 1.0)[:, None] / _HEATMAP_PIXELS
    return np.where(sure[:, None], centres, flat)


def _in_heatmap(cells: IntArray) -> BoolArray:
    return (cells >= 0) & (cells < _HEATMAP_PIXELS)


@contextmanager
def _quiet() -> Iterator[None]:
    """Drop the lines about itself that TensorFlow Lite writes to the process's stderr; its errors are exceptions."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class _Network:
    """A file of TensorFlow Lite: called with an image, returns its outputs."""

    def __init__(self, file: Path, threads: int, pixels: int, outputs: int) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError as error:
            raise PoseModelError(f"{error}: pip install ai-edge-litert") from error
        if not file.is_file():
            raise PoseModelError(f"no file {file}: `body_tracking camera model` fetches it")
        try:
            with _quiet():
                self._interpreter = Interpreter(str(file), num_threads=threads)
                self._interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            raise PoseModelError(f"{file}: {' '.join(str(error).split())}") from error
        (given,) = self._interpreter.get_input_details()
        found = self._interpreter.get_output_details()
        if tuple(given["shape"]) != (1, pixels, pixels, 3) or len(found) != outputs:
            raise PoseModelError(
                f"{file}: a network from {tuple(given['shape'])} to {len(found)} arrays, expected "
                f"{(1, pixels, pixels, 3)} and {outputs}"
            )
        self._input = given["index"]
        self._outputs = [each["index"] for each in found]

    def __call__(self, image: SingleArray) -> list[Any]:
        self._interpreter.set_tensor(self._input, image[None])
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index) for index in self._outputs]
