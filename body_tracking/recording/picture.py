"""Files with the pictures of ``camera show`` and ``mesh show``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError


class PictureError(BodyTrackingError):
    """A picture cannot be written."""


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an (h, w, 3) image in red, green, blue, in the format that the name ends with; its folder is made.

    Raises:
        PictureError: an unknown format, or the file cannot be written.
    """
    if not cv2.haveImageWriter(str(path)):
        raise PictureError(f"{path}: no format of pictures ends with {path.suffix or 'nothing'}; call it .png or .jpg")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(path.suffix, image[..., ::-1])[1].tobytes())
    except OSError as error:
        raise PictureError(f"{path}: cannot be written ({error.strerror})") from error
