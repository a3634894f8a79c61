"""A rig: calibrated cameras with fixed relative poses, and the covariance of their calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray

POSE: Final = 6
"""Parameters of a camera's pose: a rotation vector and a translation."""
LENS: Final = 4
"""Parameters of a camera's matrix: fx, fy, cx, cy."""


class RigError(BodyTrackingError):
    """Raised for cameras and poses that do not match."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras and their poses.

    The rig's frame is that of its first camera, unless a caller chooses another.

    Attributes:
        cameras: one or more, each with a frame of its own.
        rotations: (n, 3, 3) and
        translations: (n, 3) metres: a point x of the rig's frame is at ``rotations[i] @ x + translations[i]`` in
            camera i.
        covariance: (p, p) of :attr:`size` parameters; per camera fx, fy, cx, cy, the distortion coefficients, and its
            pose: a rotation vector w (the true rotation is ``exp(w) @ rotations[i]``) and an increment of the
            translation. Zeros for exactly known parameters.

    Raises:
        RigError: no camera, other shapes, a duplicate frame.
    """

    cameras: tuple[Camera, ...]
    rotations: FloatArray
    translations: FloatArray
    covariance: FloatArray

    def __post_init__(self) -> None:
        count, frames = len(self.cameras), [camera.frame_id for camera in self.cameras]
        if count < 1 or len(set(frames)) < count:
            raise RigError(f"cameras {', '.join(frames) or 'none'}: each needs a frame of its own")
        expected = (count, 3, 3), (count, 3), (self.size, self.size)
        given = self.rotations.shape, self.translations.shape, self.covariance.shape
        if given != expected:
            raise RigError(f"rotations, translations, covariance {given} of {count} cameras, expected {expected}")

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(LENS + len(camera.distortion) + POSE for camera in self.cameras)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, ..., 2) in each camera of points (..., 3) in the rig's frame; NaN for points behind a camera.

        Gaschler (2011): figure 4.1; eq. 4.1-4.6.
        """
        return np.stack(
            [
                camera.project(points @ rotation.T + translation)
                for camera, rotation, translation in zip(self.cameras, self.rotations, self.translations, strict=True)
            ]
        )

    def changed(self, parameters: Sequence[float] | FloatArray) -> Rig:
        """The rig with increments (p,) added to its parameters."""
        rest = np.asarray(parameters, dtype=np.float64)
        if rest.shape != (self.size,):
            raise RigError(f"{rest.shape} parameters, expected ({self.size},)")
        cameras, rotations, translations = [], np.array(self.rotations), np.array(self.translations)
        for index, camera in enumerate(self.cameras):
            count = len(camera.distortion)
            lens, distortion, pose, rest = np.split(rest, [LENS, LENS + count, LENS + count + POSE])
            matrix = camera.matrix + np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 0.0]])
            cameras.append(replace(camera, matrix=matrix, distortion=camera.distortion + distortion))
            rotations[index] = so3.quat_to_matrix(so3.exp(pose[:3])) @ rotations[index]
            translations[index] += pose[3:]
        return Rig(tuple(cameras), rotations, translations, self.covariance)


def parallel_cameras() -> Rig:
    """A rig of two exactly known cameras with parallel axes, half a metre apart, for compiling loops."""
    matrix = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    cameras = tuple(Camera(name, 640, 480, matrix, np.zeros(5)) for name in ("left", "right"))
    size = 2 * (LENS + 5 + POSE)
    translations = np.array([[0.0, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    return Rig(cameras, np.tile(np.eye(3), (2, 1, 1)), translations, np.zeros((size, size)))
