"""Image pairs for the marker system: from the topics of cameras' drivers, from a folder of files, or rendered."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import natural
from body_tracking.core.message_types import IMAGE
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import LATCHED, Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.markers import setup
from body_tracking.markers.codecs import CameraImage
from body_tracking.markers.pairing import FrameSets
from body_tracking.markers.rig_storage import load_rig
from body_tracking.messages.codecs import CameraInfo, Codec, Wire
from body_tracking.messages.images import to_mono
from body_tracking.pipeline.stage import Now, Output, Port, Stage
from body_tracking.pipeline.system import load

IMAGES: Final = Qos(reliability="reliable", depth=10)
"""Best effort loses 7 % of 640x480 pairs at 60 Hz."""
RENDER: Final = "render"
FOLDER: Final = "folder:"
_RENDERED: Final = "body_tracking.simulation.marker_bags:RenderedImages"
_LATE_NS: Final = NANOSECONDS
"""Nanoseconds: a source that falls further behind skips sets."""
CONVERTED: Final = "colour images"
SIZES: Final = "images of another size"


class CameraError(BodyTrackingError):
    """Raised for images that do not match the rig, or a folder without images."""


class ImageSets(Protocol):
    """Sets of images of all cameras from another source than drivers.

    Attributes:
        unpaired: number of images without a counterpart in the other cameras.
    """

    unpaired: int

    def __len__(self) -> int:
        """Number of sets."""

    def images(self, index: int) -> Sequence[NDArray[Any]]:
        """The (h, w) ``uint8`` or ``uint16`` images of a set, in the order of the cameras."""


class FolderImages:
    """Image files in one folder per camera; files of equal names form a set, in the order of the names.

    Colour images become grey; PNG files may have 16 bits.

    Args:
        folder: contains one folder per camera.
        cameras: their names.

    Raises:
        CameraError: a folder is missing, or no name is in all of them.
    """

    def __init__(self, folder: Path, cameras: Sequence[str]) -> None:
        names = []
        for camera in cameras:
            if not (folder / camera).is_dir():
                raise CameraError(f"{folder / camera}: no such folder; each camera has one, with files of equal names")
            names.append({path.name for path in (folder / camera).iterdir() if path.is_file()})
        self._folders = [folder / camera for camera in cameras]
        self._names = sorted(set.intersection(*names), key=natural)
        self.unpaired = sum(len(each) for each in names) - len(names) * len(self._names)
        if not self._names:
            counts = ", ".join(f"{len(each)} in {camera}" for camera, each in zip(cameras, names, strict=True))
            raise CameraError(f"{folder}: no file has the same name in all folders ({counts})")

    def __len__(self) -> int:
        return len(self._names)

    def images(self, index: int) -> list[NDArray[Any]]:
        """As :meth:`ImageSets.images`; raises CameraError for a file that is no image."""
        found = []
        for folder in self._folders:
            path = folder / self._names[index]
            image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
            if image is None or image.dtype not in (np.uint8, np.uint16):
                raise CameraError(f"{path}: no image of 8 or 16 bits")
            found.append(np.asarray(image))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class DriverImage:
    """An image of a driver: stamp, (h, w) pixels, and whether it was in colour."""

    stamp_ns: int
    pixels: NDArray[Any]
    colour: bool


class DriverCodec(Codec):
    """``sensor_msgs/Image`` of one brightness per pixel, or in colour, which becomes grey."""

    type_name = IMAGE

    def decode(self, cdr: bytes, wire: Wire) -> DriverImage:
        return DriverImage(*to_mono(wire.deserialize(IMAGE, cdr)))

    def stamp_ns(self, payload: DriverImage) -> int:
        return payload.stamp_ns


class CameraImagesStage(Stage):
    """Publishes sets of images with equal stamps on ``/<camera>/image_raw``, and the cameras' calibration."""

    NAME = "marker_cameras"
    PARAMETERS = (
        Parameter("setup", "", "folder with rig.yaml (body_tracking markers)"),
        Parameter(
            "images",
            RENDER,
            "source of the images: the drivers' topics with commas, in the order of the rig's cameras; folder:PATH, a "
            "folder of files per camera, equal names for images taken together; render, the simulated arm of "
            "config/marker_setup",
        ),
        Parameter("rate", 30.0, "sets of images per second, of files and rendered ones", "Hz", 0.1, 200.0),
        Parameter("loop", False, "begin again at the end of the files"),
        Parameter("best_effort", False, "true if the drivers publish their images best effort"),
        Parameter("tolerance", 0.002, "largest difference between the drivers' stamps of one set", "s", 0.0, 0.1),
        Parameter("max_wait", 0.05, "longest wait of a set for a driver's missing image", "s", 0.0, 1.0),
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self._rig = load_rig(setup.file_of(values["setup"], setup.RIG, "calibrate"))
        self._cameras = {camera.frame_id: camera for camera in self._rig.cameras}
        self._counters: Counter[str] = Counter()
        self._problems: dict[str, str] = {}
        self._source: ImageSets | None = None
        self._topics: dict[str, str] = {}
        self._period_ns = round(NANOSECONDS / float(str(values["rate"])))
        self._begun: Now | None = None
        self._number = 0
        frames, given = list(self._cameras), str(values["images"])
        ns = [round(float(str(values[name])) * NANOSECONDS) for name in ("tolerance", "max_wait")]
        self._sets: FrameSets[DriverImage] = FrameSets(frames, *ns)
        if given == RENDER:
            self._source = load(_RENDERED)(frames)
        elif given.startswith(FOLDER):
            names = [setup.camera_name(frame) for frame in frames]
            self._source = FolderImages(Path(given.removeprefix(FOLDER)).expanduser(), names)
        else:
            topics = [topic.strip() for topic in given.split(",") if topic.strip()]
            if len(set(topics)) != len(frames):
                raise CameraError(
                    f"images: {len(set(topics))} topics ({given}), the rig has the cameras {', '.join(frames)}"
                )
            self._topics = dict(zip(topics, frames, strict=True))
        qos = Qos(reliability="best_effort", depth=10) if values["best_effort"] else IMAGES
        self.inputs = tuple(Port(topic, DriverCodec(), qos, perishable=True, absolute=True) for topic in self._topics)
        self.outputs = tuple(Port(setup.image_topic(frame), CameraImage(), IMAGES, measured=True) for frame in frames)
        self.outputs += tuple(Port(setup.info_topic(frame), CameraInfo(), LATCHED) for frame in frames)

    def start(self, now: Now) -> Iterable[Output]:
        self._begun = now
        for frame, camera in self._cameras.items():
            yield Output(setup.info_topic(frame), (now.ros_ns, camera))

    # --- drivers

    def take(self, topic: str, payload: DriverImage, now: Now) -> Iterable[Output]:
        frame = self._topics[topic]
        self._counters[CONVERTED] += payload.colour
        self._check(frame, payload.pixels)
        return self._paired(self._sets.push(frame, payload.stamp_ns, payload, now.steady_ns))

    def _paired(self, sets: Iterable[Mapping[str, DriverImage]]) -> Iterator[Output]:
        for images in sets:
            self._counters["sets of images"] += 1
            stamp_ns = min(image.stamp_ns for image in images.values())
            for frame, image in images.items():
                yield Output(setup.image_topic(frame), (stamp_ns, frame, image.pixels), stamp_ns)

    @property
    def deadline_ns(self) -> int | None:
        return self._sets.deadline_ns

    def reset(self, topic: str) -> None:
        self._sets.reset()

    # --- files and rendered images

    @property
    def due_ns(self) -> int | None:
        if self._source is None or self._begun is None:
            return None
        if self._number >= len(self._source) and not self.values["loop"] and self.values["images"] != RENDER:
            return None
        return self._begun.steady_ns + self._number * self._period_ns

    def poll(self, steady_ns: int) -> Iterable[Output]:
        yield from self._paired(self._sets.poll(steady_ns))
        due_ns = self.due_ns
        if self._source is None or self._begun is None or due_ns is None or steady_ns < due_ns:
            return
        if steady_ns - due_ns > _LATE_NS:
            behind = (steady_ns - due_ns) // self._period_ns
            self._counters["sets left out to keep up"] += behind
            self._number += behind
        index, stamp_ns = self._index(), self._begun.ros_ns + self._number * self._period_ns
        self._number += 1
        images = self._source.images(index)
        for frame, image in zip(self._cameras, images, strict=True):
            self._check(frame, image)
        self._counters["sets of images"] += 1
        for frame, image in zip(self._cameras, images, strict=True):
            yield Output(setup.image_topic(frame), (stamp_ns, frame, image), stamp_ns)

    def _index(self) -> int:
        """Index of the next set; the rendered motion goes back and forth, so that it does not jump."""
        assert self._source is not None
        count = len(self._source)
        if self.values["images"] != RENDER or count == 1:
            return self._number % count
        there = self._number % (2 * count - 2)
        return min(there, 2 * count - 2 - there)

    # --- both

    def _check(self, frame: str, pixels: NDArray[Any]) -> None:
        """Raise CameraError for an image whose size differs from the calibrated one."""
        camera = self._cameras[frame]
        self._problems.pop(frame, None)
        if pixels.shape != (camera.height, camera.width):
            self._counters[SIZES] += 1
            height, width = pixels.shape
            text = f"{frame}: images of {width} x {height} pixels, calibrated were {camera.width} x {camera.height}"
            self._problems[frame] = text
            raise CameraError(text)

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn of images of another size, unsynchronised drivers, or missing images."""
        problems = [*self._problems.values(), *([self._sets.problem()] if self._sets.problem() else [])]
        if self._topics and not problems and not self._counters["sets of images"]:
            problems.append(f"no set of images of {', '.join(self._topics)} yet")
        return (1, "; ".join(problems), {}) if problems else (0, "", {})

    @property
    def counters(self) -> Mapping[str, int]:
        own = {**self._counters, "incomplete sets": self._sets.incomplete, "late images": self._sets.late}
        return own if self._source is None else {**own, "unpaired files": self._source.unpaired}
