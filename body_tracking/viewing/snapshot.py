"""What the page is given to show, and what it hands on of what people press; needs no viser."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Skeleton


class PageError(BodyTrackingError):
    """The page cannot be served, or what was pressed cannot be done."""


class Controls(Protocol):
    """What people can ask for; each answer is one line to show.

    Every method takes as long as its answer, and raises a :class:`BodyTrackingError` with the reason of a refusal.
    """

    def call(self, service: str) -> str:
        """Call a ``std_srvs/Trigger``."""

    def choose_filter(self, name: str) -> str:
        """Another filter."""

    def choose_convention(self, name: str) -> str:
        """Other angles."""

    def choose_body(self, name: str) -> str:
        """Another person's angles."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Skeletons of one source.

    Attributes:
        skeletons: those of one instant; none where nothing has come yet.
        stale: nothing has come for a while.
    """

    skeletons: tuple[Skeleton, ...] = ()
    stale: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """What is to be shown at one moment.

    Attributes:
        sensors: what each sensor sees, in its own optical frame.
        poses: of those that are calibrated.
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
