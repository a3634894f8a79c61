"""Depth images as the colour camera sees them."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from body_tracking.camera.pose_model import Landmarks, Region
from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.mesh.depth import DepthCamera, check_size

_UNLIKE: Final = 0.02
"""Difference of focal length or principal point, as a share of the image's width, from which on depth images are not
registered to the colour images."""


class Registration:
    """Moves depth images into the view of a colour camera beside the depth camera.

    Args:
        depth: intrinsics of the depth camera.
        colour: intrinsics of the colour camera.
        pose: of the depth camera in the frame of the colour camera; None where the driver has registered the images
            already, or there is one optical centre.

    Attributes:
        camera: of the registered images: the colour camera with the depth camera's number of pixels.
    """

    def __init__(self, depth: Camera, colour: Camera, pose: SensorPose | None = None) -> None:
        self._pose = pose
        if pose is None:
            self.camera = depth
            return
        self._view = DepthCamera(depth)
        scale = np.diag([depth.width / colour.width, depth.width / colour.width, 1.0])
        matrix = scale @ colour.matrix
        # the origin of pixel coordinates is the centre of the first pixel
        matrix[:2, 2] += (scale[0, 0] - 1.0) / 2.0
        height = max(1, round(colour.height * scale[0, 0]))
        self.camera = Camera(colour.frame_id, depth.width, height, matrix, colour.distortion, colour.model)

    def __call__(self, depth: SingleArray) -> SingleArray:
        """The depth image (height, width), metres, at the pixels of :attr:`camera`; 0 where nothing was measured.

        Raises:
            DepthError: another size than the depth camera's.
        """
        if self._pose is None:
            check_size(depth, self.camera)
            return depth
        points = self._view.points(depth).reshape(-1, 3)
        moved = self._pose.apply(points[np.isfinite(points[:, 2])].astype(np.float64))
        pixels = self.camera.project(moved)
        return _splat(pixels, moved[:, 2].copy(), self.camera.height, self.camera.width)


@compiled
def _splat(pixels: FloatArray, distances: FloatArray, height: int, width: int) -> SingleArray:
    """(height, width) least distance of the points around each pixel; each point covers two pixels in each direction,
    so that a near surface has no holes through which the background shows.
    """
    image = np.zeros((height, width), np.float32)
    for k in range(len(distances)):
        if not (distances[k] > 0.0 and np.isfinite(pixels[k, 0]) and np.isfinite(pixels[k, 1])):
            continue
        column, row = int(np.floor(pixels[k, 0])), int(np.floor(pixels[k, 1]))
        for i in range(max(row, 0), min(row + 2, height)):
            for j in range(max(column, 0), min(column + 2, width)):
                if image[i, j] == 0.0 or distances[k] < image[i, j]:
                    image[i, j] = distances[k]
    return image


def is_registered(colour: Camera, depth: Camera) -> bool:
    """Whether two calibrations are of one camera, whose images may differ in their number of pixels."""
    scale = np.array([depth.width / colour.width, depth.height / colour.height])
    off = depth.matrix[:2] - colour.matrix[:2] * scale[:, None]
    return bool(np.abs(off).max() < _UNLIKE * depth.width)


def moved(found: Landmarks, source: Camera, target: Camera) -> Landmarks:
    """Landmarks in the image of one camera as those in the image of another one with the same optical centre."""
    if source is target:
        return found
    ratio = float(target.matrix[0, 0] / source.matrix[0, 0])

    there = np.vstack([found.pixels, found.region.centre])
    there = target.to_pixels(target.distort(source.undistort(there)))
    region = Region(there[-1], found.region.side * ratio, found.region.angle)
    return replace(found, pixels=there[:-1], region=region)


def prepare() -> None:
    """Compile the loop, or load it, before the first image."""
    _splat(np.zeros((1, 2)), np.ones(1), 2, 2)
