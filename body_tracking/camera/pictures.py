"""Which images of a camera are published with the people drawn in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.picture import drawn_in
from body_tracking.camera.pose_model import ImageArray, Landmarks
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


class Pictures:
    """Pictures of one camera.

    Args:
        camera: its name.
        rate: at most so many a second; 0 for none.
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
