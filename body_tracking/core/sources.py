"""Where skeletons come from: recordings of other programs, datasets, and the conversion of their coordinates.

Iterating a reader yields :class:`RecordedFrame` in the package's conventions: ``<sensor>_optical_frame`` (x right,
y down, z forward), metres, integer nanoseconds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

from body_tracking.core.errors import BodyTrackingError

if TYPE_CHECKING:
    from body_tracking.core.skeleton import Skeleton

RESERVED_NAMES = ("fused", "filtered", "ground_truth", "imu")
"""First parts of topics that are not sensors."""

NOT_FINITE = "joints without finite coordinates"
"""Counted in :attr:`Recording.problems`: such a joint is NaN and NOT_TRACKED."""


class SensorNameError(BodyTrackingError):
    """Not a valid name of a sensor."""


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """One frame of one sensor.

    Attributes:
        sensor: its name.
        received_ns: when it was received, by the receiver's clock.
        skeletons: the bodies; all with one stamp, in the sensor's own clock. Never empty.
    """

    sensor: str
    received_ns: int
    skeletons: tuple[Skeleton, ...]


_Item = TypeVar("_Item", covariant=True)


class Recording(Protocol[_Item]):
    """A file of recorded items, such as :class:`RecordedFrame`.

    Attributes:
        problems: how often each kind of irregularity was read so far, such as ``stamps that repeat``.
        warnings: a line for each part that is missing.
    """

    problems: dict[str, int]
    warnings: list[str]

    def __iter__(self) -> Iterator[_Item]:
        """The items, in the order of the file."""

    @property
    def progress(self) -> float:
        """How much of the file has been read, 0 to 1."""


def check_sensor_name(name: str) -> str:
    """The name, if it can be the first part of a topic and of a frame.

    Raises:
        SensorNameError: it cannot be.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise SensorNameError(f"sensor name {name!r}: letters, digits and _ only, a letter first")
    if name in RESERVED_NAMES:
        raise SensorNameError(f"sensor name {name!r} is reserved")
    return name


def optical_frame(sensor: str) -> str:
    """The frame of a sensor's skeletons."""
    return f"{sensor}_optical_frame"
