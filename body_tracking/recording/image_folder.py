"""Folders of colour and depth images with intrinsics, as a bag of compressed images.

::

    FOLDER/rgb/ (or color/)   JPEG or PNG files
    FOLDER/depth/             PNG files of 16 bits, registered to the colour images; may be absent
    FOLDER/camera_info.yaml   intrinsics of the colour images, as ROS's camera_calibration writes them
    FOLDER/depth_info.yaml    of the depth images; default: those of the colour images at the depth images' size

A file name with a decimal point is the stamp in seconds (``1305031102.175304.png``, as in the RGB-D benchmark of the TU
Munich); other files are numbered at a given rate, in the order of the numbers in their names. Colour files go into the
bag unchanged, depth images are encoded again in millimetres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from body_tracking.camera.codecs import CompressedColour, CompressedDepth
from body_tracking.camera.topics import COMPRESSED, COMPRESSED_DEPTH, DRIVERS
from body_tracking.core import files
from body_tracking.core.camera import MODELS, Camera, CameraError
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import COMPRESSED_IMAGE
from body_tracking.core.qos import LATCHED
from body_tracking.core.skeleton import MAX_STAMP_NS, NANOSECONDS
from body_tracking.core.sources import check_sensor_name, optical_frame
from body_tracking.mesh.topics import IMAGES
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.codecs import CameraInfo
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_WIRE, BagWriter

COLOUR_FOLDERS: Final = ("rgb", "color", "colour")
_SUFFIXES: Final = (".png", ".jpg", ".jpeg")
_MARKS: Final = {"png": (b"\x89PNG\r\n\x1a\n", b"IEND"), "jpeg": (b"\xff\xd8", b"\xff\xd9")}
"""First bytes of an image file, and bytes near its end."""
_MILLIMETRES: Final = 1000.0
_TAIL: Final = 4096
"""Bytes at the end of a file that may contain the end mark: some cameras append their own data to an image."""
_LARGEST: Final = 64 << 20
"""Limit of an image file's size, bytes."""


class ImageFolderError(BodyTrackingError):
    """Raised when a folder has no images or no intrinsics, or a file cannot be used; the text names it."""


@dataclass(frozen=True, slots=True)
class ImportedImages:
    """Result of an import of images.

    Attributes:
        bag: the folder.
        camera: the sensor's name.
        colour, depth: numbers of images.
        recording_s: seconds from the first image to the last.
    """

    bag: Path
    camera: str
    colour: int
    depth: int
    recording_s: float

    def text(self) -> str:
        """The result as one line."""
        images = f"{self.colour} colour and {self.depth} depth images of {self.camera}"
        return f"{self.bag}: {images}, {self.recording_s:.1f} s"

    def as_json(self) -> str:
        """The result as one JSON object."""
        return json.dumps(asdict(self) | {"bag": str(self.bag)}, indent=2)


def is_image_folder(path: Path) -> bool:
    """Whether a path is a folder with a folder of colour images."""
    return any((path / name).is_dir() for name in COLOUR_FOLDERS)


def import_folder(
    folder: Path, bag_folder: Path, camera: str, rate: float, depth_scale: float, *, overwrite: bool = False
) -> ImportedImages:
    """Write the images of a folder as a bag.

    Args:
        folder: of the images.
        bag_folder: the bag to write.
        camera: the sensor's name.
        rate: of images without stamps as names, Hz.
        depth_scale: pixel values per metre in the depth images.
        overwrite: replace an existing bag.

    Raises:
        ImageFolderError: the folder or a file cannot be imported; the incomplete bag is removed.
        SensorNameError: an invalid name.
        BagError: the bag cannot be written.
    """
    names, frame = DRIVERS["plain"].of(check_sensor_name(camera)), optical_frame(camera)
    colour_folder = next((folder / name for name in COLOUR_FOLDERS if (folder / name).is_dir()), None)
    if colour_folder is None:
        raise ImageFolderError(f"{folder}: no folder {' or '.join(COLOUR_FOLDERS)}")
    if not (np.isfinite(rate) and rate > 0.0 and np.isfinite(depth_scale) and depth_scale > 0.0):
        raise ImageFolderError(f"rate {rate} and depth scale {depth_scale}: expected positive numbers")
    colour, depth = _stamped(colour_folder, rate), _stamped(folder / "depth", rate)
    if not colour:
        raise ImageFolderError(f"{colour_folder}: no PNG or JPEG images")
    stamped = all(_stamp(path.stem) is not None for path in (*colour.values(), *depth.values()))
    if depth and len(colour) != len(depth) and not stamped:
        numbers = f"{len(colour)} colour and {len(depth)} depth images"
        raise ImageFolderError(f"{folder}: {numbers}, whose names are no stamps: which belong together?")
    info = _read_info(folder / "camera_info.yaml", frame)
    infos = {names.colour_info: info}
    _check_size(folder / "camera_info.yaml", info, next(iter(colour.values())))
    if not depth:
        others = sorted(
            path.name for path in folder.iterdir() if path.name.lower().startswith("depth") and path.is_dir()
        )
        if others:
            raise ImageFolderError(f"{folder / others[0]}: no depth images; they are taken from the folder 'depth'")
    else:
        infos[names.depth_info] = _depth_info(folder, info, next(iter(depth.values())))
    images = [
        *((stamp_ns, names.colour + COMPRESSED, path) for stamp_ns, path in colour.items()),
        *((stamp_ns, names.depth + COMPRESSED_DEPTH, path) for stamp_ns, path in depth.items()),
    ]
    images.sort()
    first_ns, progress = images[0][0], Progress(0, len(images))
    bag = BagWriter(bag_folder, overwrite=overwrite)
    try:
        for topic in infos:
            bag.add_topic(topic, CAMERA_INFO, LATCHED)
        for topic in dict.fromkeys(topic for _, topic, _ in images):
            bag.add_topic(topic, COMPRESSED_IMAGE, IMAGES)
        for topic, each in infos.items():
            bag.write(topic, CameraInfo().encode((first_ns, each), BAG_WIRE), first_ns)
        for number, (stamp_ns, topic, path) in enumerate(images):
            data = _data(path)
            if topic.endswith(COMPRESSED):
                cdr = CompressedColour.packed(data, stamp_ns, frame, _form(path, data), BAG_WIRE)
            else:
                cdr = CompressedDepth().encode((stamp_ns, frame, _depth(path, data, depth_scale)), BAG_WIRE)
            bag.write(topic, cdr, stamp_ns)
            progress.at(number)
    except BaseException:
        bag.discard()
        raise
    bag.close()
    progress.end()
    return ImportedImages(bag_folder, camera, len(colour), len(depth), (images[-1][0] - first_ns) / NANOSECONDS)


def _stamped(folder: Path, rate: float) -> dict[int, Path]:
    """Image files of a folder by stamp, nanoseconds, in order; empty without the folder."""
    if not folder.is_dir():
        return {}
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file()]
    paths.sort(key=lambda path: files.natural(path.name))
    found: dict[int, Path] = {}
    for number, path in enumerate(paths):
        stamp_ns = _stamp(path.stem)
        stamp_ns = round((number + 1) / rate * NANOSECONDS) if stamp_ns is None else stamp_ns
        if stamp_ns in found:
            raise ImageFolderError(f"{path}: has the stamp of {found[stamp_ns].name}")
        found[stamp_ns] = path
    return dict(sorted(found.items()))


def _stamp(stem: str) -> int | None:
    """Nanoseconds of a name such as ``1305031102.175304``; None for one without a decimal point."""
    if "." not in stem:
        return None
    try:
        stamp_ns = int(Decimal(stem) * NANOSECONDS)
    except (InvalidOperation, ValueError, OverflowError):
        return None
    return stamp_ns if 0 < stamp_ns <= MAX_STAMP_NS else None


def _read_info(path: Path, frame: str) -> Camera:
    try:
        content = files.read_yaml(path, aliases=False)
        if not isinstance(content, Mapping):
            raise ValueError("no intrinsics as ROS's camera_calibration writes them")
        model = str(content.get("distortion_model") or "plumb_bob")
        given = _numbers(content, "distortion_coefficients") if "distortion_coefficients" in content else np.zeros(0)
        distortion = np.zeros(MODELS.get(model, len(given)))
        if len(given) > len(distortion):
            raise ValueError(f"{len(given)} distortion coefficients of {model}")
        distortion[: len(given)] = given
        matrix = _numbers(content, "camera_matrix").reshape(3, 3)
        size = int(content["image_width"]), int(content["image_height"])
        return Camera(frame, *size, matrix, distortion, model)
    except files.FileError as error:
        raise ImageFolderError(f"{path}: {error}") from error
    except KeyError as error:
        raise ImageFolderError(f"{path}: {error.args[0]} is missing") from error
    except (AttributeError, TypeError, ValueError, CameraError) as error:
        raise ImageFolderError(f"{path}: {error}") from error


def _check_size(path: Path, info: Camera, first: Path) -> None:
    """Refuse intrinsics of another size than the first colour image."""
    data = _data(first)
    _form(first, data)  # OpenCV would print a warning about a truncated image
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ImageFolderError(f"{first}: damaged")
    if pixels.shape != (info.height, info.width):
        height, width = pixels.shape
        raise ImageFolderError(
            f"{path}: of images of {info.width}x{info.height} pixels, {first.name} has {width}x{height}"
        )


def _numbers(content: Mapping[str, Any], key: str) -> Any:
    if not (isinstance(content[key], Mapping) and "data" in content[key]):
        raise ValueError(f"{key}: expected rows, cols and data")
    return np.asarray(content[key]["data"], dtype=np.float64).ravel()


def _depth_info(folder: Path, colour: Camera, first: Path) -> Camera:
    """Intrinsics of the depth images: of a file, or of the colour images at the first depth image's size."""
    path = folder / "depth_info.yaml"
    if path.is_file():
        return _read_info(path, colour.frame_id)
    height, width = _decoded(first, _data(first)).shape
    scale = np.array([width / colour.width, height / colour.height])
    matrix = colour.matrix.copy()
    matrix[[0, 1], [0, 1]] *= scale
    # pixel coordinates count from the centre of the first pixel
    matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5
    return replace(colour, width=width, height=height, matrix=matrix)


def _data(path: Path) -> bytes:
    try:
        if path.stat().st_size > _LARGEST:
            raise ImageFolderError(f"{path}: larger than {_LARGEST >> 20} MB")
        return path.read_bytes()
    except OSError as error:
        raise ImageFolderError(f"{path}: {error}") from error


def _form(path: Path, data: bytes) -> str:
    """The format of a complete image, by its data: the name may have another format's suffix."""
    form = next((each for each, (begin, _) in _MARKS.items() if data.startswith(begin)), None)
    if form is None:
        raise ImageFolderError(f"{path}: {'no PNG or JPEG image' if data else 'the file is empty'}")
    if _MARKS[form][1] not in data[-_TAIL:]:
        raise ImageFolderError(f"{path}: cut off after {len(data)} bytes")
    return form


def _decoded(path: Path, data: bytes) -> Any:
    _form(path, data)  # OpenCV would print a warning about a truncated image
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ImageFolderError(f"{path}: no PNG image of 16 bits and one channel")
    return pixels


def _depth(path: Path, data: bytes, scale: float) -> Any:
    """(height, width) millimetres, ``uint16``."""
    pixels = _decoded(path, data)
    if scale == _MILLIMETRES:
        return pixels
    return np.round(np.minimum(pixels * (_MILLIMETRES / scale), 65535.0)).astype(np.uint16)
