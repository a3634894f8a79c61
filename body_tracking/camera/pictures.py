"""Pictures of what the network finds in an image, and which of them are published."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.lifting import SEEN
from body_tracking.camera.pose_model import ImageArray, Landmark, Landmarks
from body_tracking.camera.topics import PICTURE_WIDTH, people_topic
from body_tracking.core.parameters import Parameter
from body_tracking.core.qos import RELIABLE
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.core.sources import optical_frame
from body_tracking.pipeline.stage import Output, Port

RATE: Final = Parameter(
    "picture_rate",
    0.0,
    "publish images with the people drawn in at most this often, while there is a subscriber; 0 for never",
    "Hz",
    0.0,
    60.0,
)
_BONES: Final = (
    *(
        (f"{one}_{side}", f"{other}_{side}")
        for side in ("LEFT", "RIGHT")
        for one, other in (
            ("SHOULDER", "ELBOW"),
            ("ELBOW", "WRIST"),
            ("WRIST", "INDEX_FINGER"),
            ("SHOULDER", "HIP"),
            ("HIP", "KNEE"),
            ("KNEE", "ANKLE"),
            ("ANKLE", "TOES"),
        )
    ),
    ("SHOULDER_LEFT", "SHOULDER_RIGHT"),
    ("HIP_LEFT", "HIP_RIGHT"),
)
_LEFT, _RIGHT, _GUESSED = (0, 170, 255), (255, 140, 0), (160, 160, 160)
"""Red, green, blue; left and right as in the pictures of ``show``."""


class Pictures:
    """Pictures of one camera.

    Args:
        camera: its name.
        rate: greatest number of pictures per second; 0 for none.
        wanted: whether a topic has a subscriber.

    Attributes:
        ports: the port of the topic; none where no pictures are published.
    """

    def __init__(self, camera: str, rate: float, wanted: Callable[[str], bool]) -> None:
        self.ports = (Port(people_topic(camera), CompressedColour(), RELIABLE),) * (rate > 0.0)
        self._frame, self._wanted = optical_frame(camera), wanted
        self._period_ns = round(NANOSECONDS / rate) if rate else 0
        self._last_ns: int | None = None

    def of(self, stamp_ns: int, image: ImageArray, people: Iterable[Landmarks]) -> Iterator[Output]:
        """The picture of an image, if one is due and wanted."""
        early = self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._period_ns
        for port in self.ports:
            if not early and self._wanted(port.topic):
                self._last_ns = stamp_ns
                picture = drawn_in(image, people, PICTURE_WIDTH)
                yield Output(port.topic, (stamp_ns, self._frame, picture), stamp_ns)


def draw(image: NDArray[np.uint8], found: Landmarks) -> None:
    """Draw a person into an image (height, width, 3) of red, green, blue: left blue, right orange, guessed grey."""
    thick = max(1, round(found.region.side / 250))

    def place(landmark: Landmark) -> tuple[int, int]:
        x, y = np.round(found.pixels[landmark]).astype(int).tolist()
        return x, y

    def colour(*landmarks: Landmark) -> tuple[int, int, int]:
        if min(found.visible[each] for each in landmarks) < SEEN:
            return _GUESSED
        return _LEFT if landmarks[0].name.endswith("LEFT") else _RIGHT

    for names in _BONES:
        one, other = (Landmark[name] for name in names)
        if min(found.present[one], found.present[other]) > SEEN:
            cv2.line(image, place(one), place(other), colour(one, other), thick, cv2.LINE_AA)
    for landmark in Landmark:
        if found.present[landmark] > SEEN:
            cv2.circle(image, place(landmark), thick + 1, colour(landmark), -1, cv2.LINE_AA)


def drawn_in(image: ImageArray, people: Iterable[Landmarks], width: int) -> ImageArray:
    """A copy of an image (height, width, 3), at most ``width`` pixels wide, with the people drawn in."""
    picture = np.ascontiguousarray(image).copy()
    for each in people:
        draw(picture, each)
    if picture.shape[1] > width:
        height = round(picture.shape[0] * width / picture.shape[1])
        picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return picture
