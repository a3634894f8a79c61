"""Input and callbacks of the page, without viser."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Skeleton
from body_tracking.messages.codecs import Codec


class PageError(BodyTrackingError):
    """Raised when the page cannot be served, or a request cannot be carried out."""


class Controls(Protocol):
    """Callbacks for the user's requests; each blocks until it returns one line to show.

    Raises:
        BodyTrackingError: the request was refused; the text is the reason.
    """

    def call(self, service: str) -> str:
        """Call a ``std_srvs/Trigger``."""

    def offers(self, service: str) -> bool:
        """Whether a node offers this service; returns at once."""

    def seek(self, place_s: float) -> str:
        """Continue the bag at this place, seconds from its beginning."""

    def loop(self, on: bool) -> str:
        """Switch the loop of the bag on or off."""

    def choose_filter(self, name: str) -> str:
        """Switch the filter."""

    def choose_convention(self, name: str) -> str:
        """Switch the convention of the angles."""

    def choose_body(self, name: str) -> str:
        """Switch to another person's angles."""


Decode: TypeAlias = Callable[[str, bytes], Any]
"""Returns the payload of a message, given its topic and CDR; None for one that is malformed."""


class SystemView(Protocol):
    """A system's part of the page, from several topics; :class:`~body_tracking.pipeline.system.View` names its class.

    Attributes:
        layers: label and initial visibility of each layer, by name; of the page's own, too, where these get in the way.
        body: the person whose angles are shown without sensors of skeletons; empty for none.
        held: topics whose last message is valid until the next one, at any age, such as calibrations of cameras.
    """

    layers: Mapping[str, tuple[str, bool]]
    body: str
    held: Collection[str]

    def topics(self, visible: Mapping[str, bool]) -> Mapping[str, Codec]:
        """Topics of the visible layers, with the codecs of their messages."""

    def start(self, server: Any) -> None:
        """Create its parts of viser's scene and panels."""

    def draw(
        self,
        recent: Mapping[str, Sequence[bytes]],
        decode: Decode,
        visible: Mapping[str, bool],
        poses: Mapping[str, SensorPose],
    ) -> FloatArray | None:
        """Draw the latest messages.

        Args:
            recent: the latest messages of each topic, in the order of their arrival, without old ones.
            decode: returns the payload of a message of a topic, None for one that is malformed.
            visible: which layers are switched on.
            poses: of calibrated sensors, by name.

        Returns:
            (3,) point to look at, metres in world, or None.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Skeletons of one source.

    Attributes:
        skeletons: of one instant; empty before the first message.
        stale: the last message is old.
    """

    skeletons: tuple[Skeleton, ...] = ()
    stale: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The content of the scene at one moment.

    Attributes:
        sensors: each sensor's skeletons, in its own optical frame.
        poses: of calibrated sensors.
        fused: in world.
        filtered: in world.
        origins: (n, 3) metres, of the model's segments in world.
        quats_xyzw: (n, 4) orientations of the segments.
        layers: the payloads of further layers, by name.
    """

    sensors: Mapping[str, Seen]
    poses: Mapping[str, SensorPose]
    fused: Seen
    filtered: Seen
    origins: FloatArray
    quats_xyzw: FloatArray
    layers: Mapping[str, Any] = field(default_factory=dict)
