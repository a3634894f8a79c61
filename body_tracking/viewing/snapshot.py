"""Input and callbacks of the page, without viser."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Skeleton


class PageError(BodyTrackingError):
    """Raised when the page cannot be served, or a request cannot be carried out."""


class Controls(Protocol):
    """Callbacks for the user's requests; each blocks until it returns one line to show.

    Raises:
        BodyTrackingError: the request was refused; the text is the reason.
    """

    def call(self, service: str) -> str:
        """Call a ``std_srvs/Trigger``."""

    def choose_filter(self, name: str) -> str:
        """Switch the filter."""

    def choose_convention(self, name: str) -> str:
        """Switch the convention of the angles."""

    def choose_body(self, name: str) -> str:
        """Switch to another person's angles."""


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
        quats_xyzw: (n, 4) their orientations.
        layers: the payloads of further layers, by name.
    """

    sensors: Mapping[str, Seen]
    poses: Mapping[str, SensorPose]
    fused: Seen
    filtered: Seen
    origins: FloatArray
    quats_xyzw: FloatArray
    layers: Mapping[str, Any] = field(default_factory=dict)
