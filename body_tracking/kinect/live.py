"""Backends of the ``kinect_skeleton`` node: their interface, and how they are found by name.

A backend is a class with the methods of :class:`SkeletonSource`: ``recording`` (``recording/source.py``), ``network``
(``network.py``), or one of another package, registered as an entry point of the group ``body_tracking.backends``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Protocol

from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.parameters import described_field, number_field
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect.kinect_protocol import DEFAULT_PORT
from body_tracking.pipeline.system import load


class SourceError(BodyTrackingError):
    """Raised when a backend cannot open or read its sensor."""


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """Settings for all backends; each uses those that concern it. The fields' metadata describe them."""

    sensor: str = described_field(
        "kinect1", "the sensor's name, in its topic /<sensor>/skeleton and its frame <sensor>_optical_frame"
    )
    device: str = described_field("", "network: the sensor's name at kinect_sender; empty for the same name")
    file: str = described_field("", "recording: a .csv, .csv.gz or .skeleton file, or a bag")
    recorded_sensor: str = described_field("", "recording: the sensor's name in the file; empty for the same name")
    rate: float = number_field(1.0, "recording: playback speed, recorded seconds per second", "", 0.01, 100.0)
    loop: bool = described_field(False, "recording: play again from the beginning at the end; the stamps continue")
    start_time: float = number_field(
        0.0,
        "recording: wall time at which the recording begins; 0 for now. Nodes with the same value play in step, also "
        "after a restart",
        "s",
        0.0,
        1e11,
    )
    address: str = described_field(
        "127.0.0.1",
        "network: the IP address of this computer to listen on, 0.0.0.0 for all; every address but a loopback one "
        "needs a key",
    )
    port: int = field(
        default=DEFAULT_PORT,
        metadata={"doc": "network: the UDP port to listen on; one per sensor", "min": 1, "max": 65535},
    )
    key_file: str = described_field("", "network: file with the key, the same as that of kinect_sender")
    least_delay: float = number_field(
        0.0,
        "network: the sensor's shortest delay from capture until its frame can be sent, which cannot be measured",
        "s",
        0.0,
        1.0,
    )


class SkeletonSource(Protocol):
    """A stream of frames of one sensor."""

    @property
    def ended(self) -> bool:
        """Whether there will be no more frames."""

    @property
    def counters(self) -> Mapping[str, object]:
        """Counters for diagnostics, such as dropped frames."""

    @property
    def problem(self) -> str:
        """Why there are no frames at present, in one line; empty for no problem."""

    def read(self, timeout: float) -> RecordedFrame | None:
        """The next frame as soon as it arrives; None after the timeout (seconds).

        Raises:
            BodyTrackingError: the device or file failed; there will be no more frames.
        """

    def close(self) -> None:
        """Release the device or file; a ``read`` in another thread returns."""


Opener = Callable[[SourceSettings], SkeletonSource]

ENTRY_POINTS = "body_tracking.backends"
_BACKENDS = {
    "network": "body_tracking.kinect.network:NetworkSource",
    "recording": "body_tracking.recording.source:RecordingSource",
}
"""Backends of this package; a process imports only the one that it opens."""


def backends() -> tuple[str, ...]:
    """The names of all backends, including those of other installed packages."""
    return tuple(sorted({*_BACKENDS, *entry_points(group=ENTRY_POINTS).names}))


def open_source(backend: str, settings: SourceSettings) -> SkeletonSource:
    """Open a sensor.

    Raises:
        SourceError: no such backend, or one of another package failed.
        BodyTrackingError: the backend cannot open its sensor.
    """
    if backend not in backends():
        raise SourceError(f"unknown backend {backend!r}, {one_of(backend, backends())}")
    opener: Opener
    if backend in _BACKENDS:
        opener = load(_BACKENDS[backend])
        return opener(settings)
    try:
        opener = entry_points(group=ENTRY_POINTS)[backend].load()
        return opener(settings)
    except BodyTrackingError:
        raise
    except Exception as error:  # of another package
        raise SourceError(f"backend {backend!r}: {described(error)}") from error


def described(error: Exception) -> str:
    """An error in one line; with its type unless it is an error of this package."""
    text = " ".join(str(error).split())
    return text if isinstance(error, BodyTrackingError) else f"{type(error).__name__}: {text}"
