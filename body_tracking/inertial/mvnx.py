"""Recordings of Xsens MVN suits: ``.mvnx`` or ``.mvnx.gz``, version 4.

XML, read as a stream. A ``normal`` frame has each sensor's orientation (quaternions w, x, y, z, sensor to the suit's
earth frame with z up), its free acceleration (m/s2 in the earth frame, without gravity), orientation and position of 23
segments and 22 joints' angles (degrees; x abduction, y rotation, z flexion, as ISB recommends). Before these come the
poses ``identity``, ``tpose`` and ``tpose-isb``. Frames come at the subject's frame rate; stamps are index over rate.

The reader yields orientation and specific force of each sensor of the upper body, under the name of its segment, and
the file's joint angles. The file has no angular rate of sensors; its normalised magnetic field is not read.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final, cast
from xml.etree import ElementTree

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import open_regular
from body_tracking.core.imu import (
    STANDARD_GRAVITY,
    ImuSample,
    ImuSampleError,
    RecordedAngles,
    RecordedImu,
    imu_frame,
)
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.times import MAX_STAMP_NS

SEGMENT_OF_SENSOR: Final = {
    "Pelvis": "pelvis",
    "T8": "upper_trunk",
    "Sternum": "upper_trunk",
    "Head": "head",
    "LeftShoulder": "clavicle_left",
    "RightShoulder": "clavicle_right",
    "LeftUpperArm": "upper_arm_left",
    "RightUpperArm": "upper_arm_right",
    "LeftForeArm": "forearm_left",
    "RightForeArm": "forearm_right",
    "LeftHand": "hand_left",
    "RightHand": "hand_right",
}
"""Xsens's names to those of ``UpperBody``, which has no legs."""

LEGS: Final = "sensors that are not on the upper body"
BAD: Final = "readings that no inertial sensor can have made"
BACKWARDS: Final = "frames whose index does not advance"
_AXES: Final = "xyz"


class MvnxError(BodyTrackingError):
    """Raised when an MVNX file violates its format; the message names file and frame."""


@dataclass(frozen=True, slots=True, eq=False)
class MvnxHeader:
    """The header of a recording.

    Attributes:
        version: of the format.
        rate_hz: frames per second.
        segments: s names, in the file's order.
        sensors: m names.
        joints: j names.
    """

    version: str
    rate_hz: float
    segments: tuple[str, ...]
    sensors: tuple[str, ...]
    joints: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MvnxFrame:
    """One frame; None for missing quantities.

    Attributes:
        kind: ``normal``, or the name of a pose.
        index: of a normal frame, from 0; -1 of a pose.
        segment_xyzw: (s, 4) quaternions, segment to earth.
        segment_positions: (s, 3) metres.
        sensor_xyzw: (m, 4) quaternions, sensor to earth.
        sensor_acceleration: (m, 3) m/s2 in the earth frame, without gravity.
        joint_angles: (j, 3) radians.
    """

    kind: str
    index: int
    segment_xyzw: FloatArray | None
    segment_positions: FloatArray | None
    sensor_xyzw: FloatArray | None
    sensor_acceleration: FloatArray | None
    joint_angles: FloatArray | None


class MvnxRecording:
    """Reads one recording, frame by frame.

    Args:
        path: the file; gzip is recognised by the suffix ``.gz``.
        partial: read a truncated file up to its last complete frame, with a warning, instead of raising an error.

    Raises:
        MvnxError: while iterating, if the file violates its format.
    """

    def __init__(self, path: Path | str, partial: bool = False) -> None:
        self.path = Path(path)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self.progress = 0.0
        self.header: MvnxHeader | None = None
        """Available once the first frame was read."""
        self._partial = partial

    def __iter__(self) -> Iterator[RecordedImu | RecordedAngles]:
        counts: Counter[str] = Counter()
        last = -1
        for frame in self.frames():
            header = self.header
            assert header is not None
            if frame.kind != "normal":
                continue
            if last < 0:
                others = [label for label in header.sensors if label not in SEGMENT_OF_SENSOR]
                counts[f"{LEGS} ({', '.join(others)})"] = len(others)
            counts[BACKWARDS] += frame.index <= last
            last = frame.index
            stamp_ns = round(frame.index * NANOSECONDS / header.rate_hz)
            if stamp_ns > MAX_STAMP_NS:
                raise MvnxError(f"{self.path}, frame {frame.index}: no recording is that long")
            yield from self._readings(frame, header, stamp_ns, counts)
            if frame.joint_angles is not None:
                names = tuple(f"{joint}_{axis}" for joint in header.joints for axis in _AXES)
                yield RecordedAngles(stamp_ns, names, frame.joint_angles.reshape(-1))
            self.problems = {name: count for name, count in counts.items() if count}

    def _readings(
        self, frame: MvnxFrame, header: MvnxHeader, stamp_ns: int, counts: Counter[str]
    ) -> Iterator[RecordedImu]:
        if frame.sensor_xyzw is None:
            raise MvnxError(f"{self.path}, frame {frame.index}: no sensorOrientation")
        for number, label in enumerate(header.sensors):
            segment = SEGMENT_OF_SENSOR.get(label)
            if segment is None:
                continue
            quat_xyzw, force = frame.sensor_xyzw[number], None
            try:
                if frame.sensor_acceleration is not None:
                    # the sensor's specific force: without gravity in the file, and in the earth frame
                    earth = frame.sensor_acceleration[number] + [0.0, 0.0, STANDARD_GRAVITY]
                    vector, scalar = -quat_xyzw[:3], quat_xyzw[3]
                    force = earth + 2.0 * np.cross(vector, np.cross(vector, earth) + scalar * earth)
                sample = ImuSample(stamp_ns, imu_frame(segment), quat_xyzw, None, None, force)
            except ImuSampleError as error:
                if not counts[BAD]:
                    self.warnings.append(f"{self.path}, frame {frame.index}, sensor {label}: {error}")
                counts[BAD] += 1
                continue
            yield RecordedImu(segment, stamp_ns, sample)

    def frames(self) -> Iterator[MvnxFrame]:
        """All frames with all their quantities, including the poses.

        Raises:
            MvnxError: the file violates its format.
        """
        self.warnings, self.header, self.progress = [], None, 0.0
        count = 0
        try:
            size = max(1, self.path.stat().st_size)
            with open_regular(self.path) as raw:
                source = cast(BinaryIO, gzip.GzipFile(fileobj=raw)) if self.path.suffix == ".gz" else raw
                for frame in self._parse(source):
                    count += 1
                    self.progress = min(1.0, raw.tell() / size)
                    yield frame
        except EOFError:
            self._cut("the gzip stream is cut off", count)
        except ElementTree.ParseError as error:
            if "no element found" not in str(error):
                raise MvnxError(f"{self.path}: after {count} frames: not XML ({error})") from error
            self._cut("the file is cut off", count)
        except (gzip.BadGzipFile, zlib.error) as error:
            raise MvnxError(f"{self.path}: after {count} frames: the gzip stream is damaged ({error})") from error
        except OSError as error:
            raise MvnxError(f"{self.path}: {error.strerror or error}") from error
        if count == 0:
            raise MvnxError(f"{self.path}: no frames")
        self.progress = 1.0

    def _cut(self, how: str, count: int) -> None:
        text = f"{self.path}: {how} after {count} whole frames"
        if not self._partial:
            raise MvnxError(f"{text} (--partial reads these)")
        self.warnings.append(text)

    def _parse(self, source: BinaryIO) -> Iterator[MvnxFrame]:
        version, rate = "", 0.0
        labels: dict[str, list[str]] = {"segment": [], "sensor": [], "joint": []}
        for event, element in ElementTree.iterparse(source, events=("start", "end")):
            tag = element.tag.rpartition("}")[2]
            if event == "start":
                if tag == "mvnx":
                    version = element.get("version", "unknown")
                elif tag == "subject":
                    rate = self._rate(element)
                elif not version:
                    raise MvnxError(f"{self.path}: not an MVNX file: its first element is <{tag}>")
                elif tag in labels:
                    labels[tag].append(element.get("label", ""))
                elif tag == "frames":
                    if not rate:
                        raise MvnxError(f"{self.path}: no <subject> before the frames")
                    self.header = MvnxHeader(version, rate, *(tuple(labels[name]) for name in labels))
                    if not self.header.sensors:
                        raise MvnxError(f"{self.path}: no sensors")
                    worn = [SEGMENT_OF_SENSOR[each] for each in self.header.sensors if each in SEGMENT_OF_SENSOR]
                    if twice := [segment for segment, count in Counter(worn).items() if count > 1]:
                        raise MvnxError(f"{self.path}: several sensors of the segment {twice[0]}")
            elif tag == "frame":
                if self.header is None:
                    raise MvnxError(f"{self.path}: a frame before <frames>")
                yield self._frame(element, self.header)
                element.clear()

    def _rate(self, subject: ElementTree.Element) -> float:
        text = subject.get("frameRate", "")
        try:
            rate = float(text)
        except ValueError:
            rate = 0.0
        if not 1.0 <= rate <= 1000.0:
            raise MvnxError(f"{self.path}: frameRate {text!r}, expected 1 to 1000")
        return rate

    def _frame(self, element: ElementTree.Element, header: MvnxHeader) -> MvnxFrame:
        kind, text = element.get("type", ""), element.get("index", "-1")
        where = f"{self.path}, frame {text if kind == 'normal' else kind}"
        if not re.fullmatch(r"-?[0-9]{1,18}", text) or (kind == "normal" and int(text) < 0):
            raise MvnxError(f"{where}: index {text!r}")
        found = {child.tag.rpartition("}")[2]: child.text or "" for child in element}

        def numbers(name: str, count: int, width: int) -> FloatArray | None:
            if name not in found:
                return None
            try:
                values = np.array([float(value) for value in found[name].split()])
            except ValueError as error:
                raise MvnxError(f"{where}, {name}: {error}") from None
            if values.size != count * width:
                raise MvnxError(f"{where}, {name}: {values.size} numbers, expected {count * width}")
            return values.reshape(count, width)

        def quats(name: str, count: int) -> FloatArray | None:
            wxyz = numbers(name, count, 4)
            return None if wxyz is None else wxyz[:, [1, 2, 3, 0]]

        n_segments, n_sensors = len(header.segments), len(header.sensors)
        degrees = numbers("jointAngle", len(header.joints), 3)
        return MvnxFrame(
            kind,
            int(text),
            quats("orientation", n_segments),
            numbers("position", n_segments, 3),
            quats("sensorOrientation", n_sensors),
            numbers("sensorFreeAcceleration", n_sensors, 3),
            None if degrees is None else np.radians(degrees),
        )
