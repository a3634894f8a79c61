"""Rigs as YAML files, with the covariance of their calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.core import files, so3
from body_tracking.core.camera import MODELS, Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.rig import LENS, POSE, Rig

MAX_CAMERAS: Final = 16
"""Each camera adds 15 to 18 parameters, and the covariance has their number squared."""

_HEADER: Final = """\
# Cameras of a marker system, written by body_tracking: a point x of the rig's frame is at R x + t in a camera (axes x
# right, y down, z forward; metres; unit quaternion x y z w). Lens: fx fy cx cy, pixels from the centre of the upper
# left one; distortion in the order of sensor_msgs/CameraInfo. The covariance's lower triangle row by row, of, camera
# by camera, fx fy cx cy, the coefficients, a rotation vector (the true rotation is exp(w) R) and the translation.
"""


class RigFileError(BodyTrackingError):
    """Raised for a rig file that cannot be read or written."""


def rig_in(folder: object) -> Rig | None:
    """The rig of a setup; None if it has none, because another motion capture system measures the points.

    Raises:
        RigFileError: as :func:`load_rig`.
    """
    path = Path(str(folder)).expanduser() / setup.RIG
    return load_rig(path) if folder and path.is_file() else None


def save_rig(rig: Rig, path: Path) -> None:
    """Write a rig; replaces the file atomically.

    Raises:
        RigFileError: more than :data:`MAX_CAMERAS` cameras, or the file cannot be written.
    """
    if len(rig.cameras) > MAX_CAMERAS:
        raise RigFileError(f"{path}: {len(rig.cameras)} cameras, at most {MAX_CAMERAS} in a file")
    content = {
        "cameras": [
            {
                "frame": camera.frame_id,
                "size": [camera.width, camera.height],
                "lens": camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
                "model": camera.model,
                "distortion": camera.distortion.tolist(),
                "quat_xyzw": so3.matrix_to_quat(rotation).tolist(),
                "translation": translation.tolist(),
            }
            for camera, rotation, translation in zip(rig.cameras, rig.rotations, rig.translations, strict=True)
        ],
        "covariance": rig.covariance[np.tril_indices(rig.size)].tolist(),
    }
    files.write_text(path, _HEADER + files.dump_yaml(content, width=120), RigFileError)


def load_rig(path: Path) -> Rig:
    """Read a rig.

    Raises:
        RigFileError: the file cannot be read or holds no valid rig; the message names the problem.
    """
    content = files.read_yaml(path, aliases=False, error=RigFileError)
    try:
        entries = content["cameras"]
        if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_CAMERAS:
            raise ValueError(f"cameras must be a list of 1 to {MAX_CAMERAS}")
        cameras = tuple(_camera(entry) for entry in entries)
        quaternions = np.stack([_numbers(entry, "quat_xyzw", 4) for entry in entries])
        norms = np.linalg.norm(quaternions, axis=-1, keepdims=True)
        if (np.abs(norms - 1.0) > 1e-3).any():
            raise ValueError("a quat_xyzw has not the length 1")
        translations = np.stack([_numbers(entry, "translation", 3) for entry in entries])
        size = sum(LENS + len(camera.distortion) + POSE for camera in cameras)
        lower = _numbers(content, "covariance", size * (size + 1) // 2)
        covariance = np.zeros((size, size))
        covariance[np.tril_indices(size)] = lower
        covariance += np.tril(covariance, -1).T
        variances = np.diag(covariance)
        # positive semidefinite; checked on correlations, because units differ by orders of magnitude
        scale = np.where(variances > 0.0, 1.0 / np.sqrt(np.abs(variances) + 1e-300), 1.0)
        if (variances < 0.0).any() or np.linalg.eigvalsh(covariance * np.outer(scale, scale)).min() < -1e-6:
            raise ValueError("covariance is none: a variance is negative")
        return Rig(cameras, so3.quat_to_matrix(quaternions / norms), translations, covariance)
    except KeyError as error:
        raise RigFileError(f"{path}: {error.args[0]} is missing") from error
    except (TypeError, ValueError, BodyTrackingError) as error:
        raise RigFileError(f"{path}: {error}") from error


def _numbers(entry: dict[str, Any], key: str, count: int) -> FloatArray:
    values = np.asarray(entry[key], dtype=np.float64)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{key} must be {count} finite numbers")
    return values


def _camera(entry: Any) -> Camera:
    if not isinstance(entry, dict):
        raise ValueError("a camera must be a mapping")
    frame, model, size = entry["frame"], entry["model"], entry["size"]
    if not isinstance(frame, str) or not isinstance(model, str) or model not in MODELS:
        raise ValueError(f"frame and model must be names, a model one of {', '.join(MODELS)}")
    if not isinstance(size, list) or len(size) != 2 or not all(type(each) is int for each in size):
        raise ValueError("size must be width and height, pixels")
    fx, fy, cx, cy = _numbers(entry, "lens", 4).tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(frame, size[0], size[1], matrix, _numbers(entry, "distortion", MODELS[model]), model)
