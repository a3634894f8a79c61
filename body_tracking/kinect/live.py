"""The place for live sensors: what a backend offers to the ``kinect_skeleton`` node, and how it is found by name.

A new backend is a class with the methods of :class:`SkeletonSource`; the node, its topics and everything after them
stay as they are. There are ``recording`` (``recording/source.py``) and ``network`` (``network.py``). Another package
brings one by an entry point of the group ``body_tracking.backends``: its name, and what opens it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect.kinect_protocol import DEFAULT_PORT
from body_tracking.pipeline.system import load


class SourceError(BodyTrackingError):
    """A sensor, or what takes its place, cannot be opened or read."""


@dataclass(frozen=True, slots=True)
class SourceSettings:
    """What a backend is told; each uses what concerns it.

    Attributes:
        sensor: the name under which its skeletons are published.
        device: which of several devices, such as a serial number; empty for the only one.
        file: what is played by ``recording``.
        recorded_sensor: the sensor's name in that file; empty for the same name.
        rate: seconds of the recording per second.
        loop: begin again at the end.
        start_time: wall time, seconds, at which the recording's first frame of any sensor plays; 0 for now.
        address: on which ``network`` listens: an IP address of this computer.
        port: likewise.
        key_file: holds the key that senders share; empty for none, on a loopback address.
        least_delay: seconds that the sensor takes at least from capture until its frame can be sent.
    """

    sensor: str
    device: str = ""
    file: str = ""
    recorded_sensor: str = ""
    rate: float = 1.0
    loop: bool = False
    start_time: float = 0.0
    address: str = "127.0.0.1"
    port: int = DEFAULT_PORT
    key_file: str = ""
    least_delay: float = 0.0


class SkeletonSource(Protocol):
    """A stream of frames of one sensor, in the package's conventions (see ``sensors``)."""

    @property
    def ended(self) -> bool:
        """Whether no frame will ever come again."""

    @property
    def counters(self) -> Mapping[str, object]:
        """What was met so far, such as frames that were dropped."""

    @property
    def problem(self) -> str:
        """What keeps frames from coming, in a line, although they may come again; empty if nothing does."""

    def read(self, timeout: float) -> RecordedFrame | None:
        """The next frame as soon as it is there; None when none is within the timeout (seconds).

        Raises:
            BodyTrackingError: the device or file failed; there will be no more frames.
        """

    def close(self) -> None:
        """Let go of the device or file; a ``read`` in another thread returns."""


Opener = Callable[[SourceSettings], SkeletonSource]

ENTRY_POINTS = "body_tracking.backends"
_BACKENDS = {
    "network": "body_tracking.kinect.network:NetworkSource",
    "recording": "body_tracking.recording.source:RecordingSource",
}
"""Those of this package; a process loads the one that it opens."""


def backends() -> tuple[str, ...]:
    """The names of the backends, with those of other packages that are installed."""
    return tuple(sorted({*_BACKENDS, *entry_points(group=ENTRY_POINTS).names}))


def open_source(backend: str, settings: SourceSettings) -> SkeletonSource:
    """Open a sensor.

    Raises:
        SourceError: no such backend, or it is of another package and something is wrong with it.
        BodyTrackingError: the backend cannot open it.
    """
    if backend not in backends():
        raise SourceError(f"unknown backend {backend!r}, expected one of {', '.join(backends())}")
    opener: Opener
    if backend in _BACKENDS:
        opener = load(_BACKENDS[backend])
        return opener(settings)
    try:
        opener = entry_points(group=ENTRY_POINTS)[backend].load()
        return opener(settings)
    except BodyTrackingError:
        raise
    except Exception as error:  # whatever others write
        raise SourceError(f"backend {backend!r}: {described(error)}") from error


def described(error: Exception) -> str:
    """What went wrong, in a line: an error of this package says that by itself."""
    text = " ".join(str(error).split())
    return text if isinstance(error, BodyTrackingError) else f"{type(error).__name__}: {text}"
