"""The backend ``recording``: plays the frames of a recording in real time, as if they were captured now."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.core.sources import RecordedFrame, check_sensor_name, optical_frame
from body_tracking.kinect.csv_recording import sensor_column
from body_tracking.kinect.live import SourceError, SourceSettings
from body_tracking.messages.base import MessageError
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.importer import CSV_SUFFIXES, open_recording
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagError, deserialize
from body_tracking.recording.stamps import RecordedClock

LATE_NS = 500_000_000
"""A frame this late is skipped, so that a restarted node continues at the recording's present position."""

LOOP_GAP_NS = 33_333_333
"""Between the last frame and the first one of the next loop."""


class RecordingSource:
    """Plays one sensor of a recording (CSV, NTU RGB+D, bag) in real time.

    The recording's zero is the receipt of its first frame of any sensor, so that the sensors of one recording, each
    played by its own process with the same ``start_time``, stay in step. A frame is stamped with its playing time minus
    its recorded delay (see :mod:`body_tracking.recording.stamps`); in a loop, stamps continue.

    Args:
        settings: uses ``file``, ``sensor``, ``recorded_sensor``, ``rate``, ``loop`` and ``start_time``.

    Raises:
        BodyTrackingError: the file cannot be read, or has no such sensor.
    """

    def __init__(self, settings: SourceSettings) -> None:
        if not settings.file:
            raise SourceError("the backend 'recording' needs the parameter 'file'")
        if not settings.rate > 0.0:
            raise SourceError(f"rate {settings.rate}: expected a number above 0")
        check_sensor_name(settings.sensor)
        self._settings = settings
        self._wanted = settings.recorded_sensor or settings.sensor
        self._counters: Counter[str] = Counter()
        self._closed = threading.Event()
        self._file = Path(settings.file)
        self._clock = None if _is_bag(self._file) else _clock(_frames(self._file, self._wanted))
        self._frames = _frames(self._file, self._wanted)
        self._zero_ns: int | None = None
        self._last_ns = 0
        self._rounds_ns = 0
        self._next: RecordedFrame | None = self._advance()
        if self._next is None:
            raise SourceError(f"{settings.file}: no frame of sensor {self._wanted!r}")
        self._start_ns = round(settings.start_time * NANOSECONDS) or time.time_ns()

    @property
    def ended(self) -> bool:
        return self._next is None

    @property
    def counters(self) -> Mapping[str, object]:
        """Frames skipped because they were late."""
        return self._counters

    @property
    def problem(self) -> str:
        return ""

    def close(self) -> None:
        self._closed.set()

    def read(self, timeout: float) -> RecordedFrame | None:
        """See :class:`body_tracking.kinect.live.SkeletonSource`."""
        deadline_ns = time.time_ns() + round(timeout * NANOSECONDS)
        while self._next is not None and not self._closed.is_set():
            due_ns = self._wall_ns(self._next.received_ns)
            now_ns = time.time_ns()
            if now_ns - due_ns > LATE_NS:
                self._counters["left out, late"] += 1
                if self._rounds_ns and self._zero_ns is not None:  # skip whole loops at once: their length is known
                    length = self._last_ns - self._zero_ns + LOOP_GAP_NS
                    self._rounds_ns += int((now_ns - due_ns) * self._settings.rate) // length * length
                self._next = self._advance()
                continue
            self._closed.wait(max(0, min(due_ns, deadline_ns) - now_ns) / NANOSECONDS)
            if due_ns > deadline_ns:
                return None
            frame = self._now(self._next)
            self._next = self._advance()
            return frame
        self._closed.wait(timeout)
        return None

    def _wall_ns(self, recorded_ns: int) -> int:
        """Wall time of an instant of the present loop, nanoseconds."""
        assert self._zero_ns is not None
        elapsed = self._rounds_ns + recorded_ns - self._zero_ns
        return self._start_ns + round(elapsed / self._settings.rate)

    def _now(self, frame: RecordedFrame) -> RecordedFrame:
        """A frame with the sensor's name, and with times as if it were captured and received now."""
        name, stamp_ns = self._settings.sensor, frame.skeletons[0].stamp_ns
        if self._clock is not None:
            stamp_ns = self._clock.to_ros(stamp_ns, frame.received_ns)
        stamp_ns = self._wall_ns(stamp_ns)
        skeletons = [replace(each, stamp_ns=stamp_ns, frame_id=optical_frame(name)) for each in frame.skeletons]
        return RecordedFrame(name, self._wall_ns(frame.received_ns), tuple(skeletons))

    def _advance(self) -> RecordedFrame | None:
        """The next frame of the wanted sensor."""
        for _ in range(2):
            for received_ns, frame in self._frames:
                if self._zero_ns is None:
                    self._zero_ns = received_ns
                self._last_ns = max(self._last_ns, received_ns)
                if frame is not None:
                    return frame
            if not self._settings.loop or self._zero_ns is None:
                return None
            self._rounds_ns += self._last_ns - self._zero_ns + LOOP_GAP_NS
            self._frames = _frames(self._file, self._wanted)
        return None


def _is_bag(path: Path) -> bool:
    return path.is_dir() or path.suffix == ".mcap"


def _clock(frames: Iterator[tuple[int, RecordedFrame | None]]) -> RecordedClock | None:
    """The sensor's clock against the clock of receipt; None without frames."""
    times = sorted((received_ns, frame.skeletons[0].stamp_ns) for received_ns, frame in frames if frame is not None)
    if not times:
        return None
    log_ns, stamps_ns = np.array(times, dtype=np.int64).T
    return RecordedClock(stamps_ns, log_ns)


def _frames(path: Path, sensor: str) -> Iterator[tuple[int, RecordedFrame | None]]:
    """Receipt time of every frame of a recording, and the frame itself if it is of the wanted sensor."""
    if _is_bag(path):
        yield from _bag_frames(path, sensor)
        return
    # A file without sensor names belongs to the wanted sensor.
    names_itself = path.name.lower().endswith(CSV_SUFFIXES) and path.is_file() and sensor_column(path)
    for frame in open_recording(path, None if names_itself else sensor):
        yield frame.received_ns, frame if frame.sensor == sensor else None


def _bag_frames(path: Path, sensor: str) -> Iterator[tuple[int, RecordedFrame | None]]:
    topic = f"/{sensor}/skeleton"
    with RigReader(path) as reader:
        if topic not in reader.topics:
            raise BagError(f"{path}: no topic {topic}; it has {', '.join(reader.topics) or 'none'}")
        type_name = reader.topics[topic].type_name
        yield reader.start_ns, None
        for message in reader.messages([topic]):
            try:
                skeletons = cloud_to_skeletons(deserialize(type_name, message.cdr))
            except (BagError, MessageError):
                continue  # counts as a lost frame
            yield message.log_time_ns, RecordedFrame(sensor, message.log_time_ns, skeletons)
        yield reader.end_ns, None
