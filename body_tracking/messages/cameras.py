"""``sensor_msgs/CameraInfo`` and the camera model."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from body_tracking.core.camera import MODELS, Camera, CameraError
from body_tracking.messages.base import MessageError, MessageTypes, to_header

CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"

_MOST_PIXELS: Final = 8192 * 4096
"""Cameras of motion capture have up to 26 million; a receiver may keep a table of all pixels."""


def camera_to_info(camera: Camera, stamp_ns: int, types: MessageTypes) -> Any:
    """``sensor_msgs/CameraInfo`` of a full, unrectified image."""
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    region = types.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types.make(
        CAMERA_INFO,
        header=to_header(stamp_ns, camera.frame_id, types),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        d=types.floats(camera.distortion),
        k=types.floats(camera.matrix.ravel()),
        r=types.floats(np.eye(3).ravel()),
        p=types.floats(projection.ravel()),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def info_to_camera(message: Any) -> Camera:
    """The camera in a ``sensor_msgs/CameraInfo``; missing coefficients of ``plumb_bob`` are zero.

    Raises:
        MessageError: not calibrated (zero focal lengths), another distortion model, a binned or cropped image, or one
            of more pixels than any camera has.
    """
    frame_id = message.header.frame_id
    if message.width * message.height > _MOST_PIXELS:
        size = f"{message.width} x {message.height}"
        raise MessageError(f"camera {frame_id}: {size} pixels, expected at most {_MOST_PIXELS}")
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.x_offset or message.roi.y_offset:
        raise MessageError(f"camera {frame_id}: a binned or cut image; its matrix is of the whole one")
    model, given = str(message.distortion_model) or "plumb_bob", np.asarray(message.d, dtype=np.float64)
    distortion = np.zeros(MODELS.get(model, len(given)))
    if len(given) > len(distortion):
        raise MessageError(f"camera {frame_id}: {len(given)} coefficients of {model}, expected {len(distortion)}")
    distortion[: len(given)] = given
    matrix = np.asarray(message.k, dtype=np.float64).reshape(3, 3)
    try:
        return Camera(frame_id, int(message.width), int(message.height), matrix, distortion, model)
    except CameraError as error:
        raise MessageError(str(error)) from error
