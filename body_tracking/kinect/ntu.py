"""Skeletons of the NTU RGB+D data sets: ``.skeleton`` files, recorded with three Kinect v2 at once.

The file is text, a value or a row of values per line: the number of frames; per frame the number of bodies; per body
ten values (tracking id, clipped edges, confidence and state of the left and the right hand, restricted, lean x and y,
tracking state), the number of joints, and per joint twelve: x, y, z (metres, camera space), depth x and y, colour x
and y (pixels), orientation w, x, y, z, tracking state. The file has no times; the sensors ran at 30 Hz. The name
``SsssCcccPpppRrrrAaaa`` gives setup, camera, performer, repetition and action.

Source: Shahroudy, Liu, Ng, Wang, "NTU RGB+D: A Large Scale Dataset for 3D Human Activity Analysis", CVPR 2016, and the
reader ``read_skeleton_file.m`` that the authors publish with it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import open_regular
from body_tracking.core.skeleton import (
    MAX_RANGE,
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    Skeleton,
    TrackingState,
)
from body_tracking.core.sources import NOT_FINITE, RecordedFrame, check_sensor_name, optical_frame
from body_tracking.kinect.axes import camera_space_to_optical
from body_tracking.kinect.csv_recording import FAR

FRAME_RATE = 30
"""Hertz, nominal."""

EMPTY = "frames without a body"

_BODY_VALUES = 10
_JOINT_VALUES = 12
_STATE = 11
_NAME = re.compile(r"S\d{3}C(\d{3})P\d{3}R\d{3}A\d{3}")


class NtuError(BodyTrackingError):
    """Raised for an invalid ``.skeleton`` file; the text names file and line."""


class _CutOff(Exception):
    """Raised where the file ends in the middle of a frame."""


def sensor_of(path: Path) -> str | None:
    """``kinect<camera>`` from a file name of the data set; None for any other name."""
    match = _NAME.search(path.name)
    return f"kinect{int(match[1])}" if match else None


class NtuRecording:
    """Reads one view of one sequence. Bodies are numbered 0, 1, ... in the order in which they appear.

    Args:
        path: the file.
        sensor: the sensor's name; None to take ``kinect<camera>`` from the file's name.
        partial: read a truncated file up to its last whole frame, with a warning, instead of refusing it.

    Raises:
        NtuError: no name for the sensor; or, while iterating, the file violates the format.
        SensorNameError: an invalid name.
    """

    def __init__(self, path: Path | str, sensor: str | None = None, partial: bool = False) -> None:
        self.path = Path(path)
        name = sensor or sensor_of(self.path)
        if name is None:
            raise NtuError(f"{self.path}: the file name does not give the camera (SsssCcccPpppRrrrAaaa): --sensor NAME")
        self.sensor = check_sensor_name(name)
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self.progress = 0.0
        self._partial = partial
        self._lines: list[str] = []
        self._next = 0
        self._whole = True

    def __iter__(self) -> Iterator[RecordedFrame]:
        self.warnings, self._next = [], 0
        counts: Counter[str] = Counter()
        numbers: dict[str, int] = {}
        try:
            with open_regular(self.path) as file:
                text = file.read().decode("ascii")
        except OSError as error:
            raise NtuError(f"{self.path}: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise NtuError(f"{self.path}: not a text file") from error
        self._lines = text.splitlines()
        if not text.strip():
            raise NtuError(f"{self.path}: the file is empty")
        self._whole = text.endswith("\n")
        try:
            n_frames = self._count("number of frames")
        except _CutOff:
            raise NtuError(f"{self.path}, line 1: no number of frames") from None
        for index in range(n_frames):
            try:
                stamp_ns = round(index * NANOSECONDS / FRAME_RATE)
                n_bodies = self._count("number of bodies")
                skeletons = tuple(self._body(stamp_ns, numbers, counts) for _ in range(n_bodies))
            except _CutOff:
                text = f"{self.path}: cut off after {index} of {n_frames} frames"
                if not self._partial:
                    raise NtuError(f"{text} (--partial reads these)") from None
                self.warnings.append(text)
                break
            self.progress = (index + 1) / n_frames
            if skeletons:
                yield RecordedFrame(self.sensor, skeletons[0].stamp_ns, skeletons)
            else:
                counts[EMPTY] += 1
            self.problems = {name: count for name, count in counts.items() if count}
        if any(line.strip() for line in self._lines[self._next :]) and not self.warnings:
            raise NtuError(f"{self.path}, line {self._next + 1}: continues after the last of {n_frames} frames")
        self.progress = 1.0

    def _error(self, text: str) -> Exception:
        """The error of the current line; :class:`_CutOff` for an incomplete last line."""
        if self._next == len(self._lines) and not self._whole:
            return _CutOff()
        return NtuError(f"{self.path}, line {self._next}: {text}")

    def _take(self) -> str:
        if self._next >= len(self._lines):
            raise _CutOff
        self._next += 1
        return self._lines[self._next - 1]

    def _count(self, what: str) -> int:
        text = self._take()
        try:
            number = int(text)
        except ValueError:
            number = -1
        if number < 0:
            raise self._error(f"{what}: {text.strip()[:40]!r}, expected a whole number")
        return number

    def _body(self, stamp_ns: int, numbers: dict[str, int], counts: Counter[str]) -> Skeleton:
        values = self._take().split()
        if len(values) != _BODY_VALUES:
            raise self._error(f"{len(values)} values of a body, expected {_BODY_VALUES}")
        # The id has 17 digits, more than a double holds: it stays text.
        number = numbers.setdefault(values[0], len(numbers))
        n_joints = self._count("number of joints")
        if n_joints != N_JOINTS:
            raise self._error(f"{n_joints} joints, expected {N_JOINTS}")
        joints: FloatArray = np.array([self._joint() for _ in range(N_JOINTS)])
        lost: BoolArray = np.asarray(~np.isfinite(joints[:, :3]).all(axis=1))
        counts[NOT_FINITE] += int(lost.sum())
        positions = camera_space_to_optical(np.where(lost[:, None], np.nan, joints[:, :3]))
        counts[FAR] += int((np.abs(positions) >= MAX_RANGE).any(axis=1).sum())
        states = np.where(lost, TrackingState.NOT_TRACKED, joints[:, _STATE]).astype(np.uint8)
        return Skeleton(stamp_ns, optical_frame(self.sensor), positions, states, number)

    def _joint(self) -> list[float]:
        row = self._take().split()
        if len(row) != _JOINT_VALUES:
            raise self._error(f"{len(row)} values of a joint, expected {_JOINT_VALUES}")
        try:
            values = [float(cell) for cell in row]
        except ValueError as error:
            raise self._error(f"not a number ({error})") from None
        if values[_STATE] not in tuple(TrackingState):
            raise self._error(f"tracking state {row[_STATE]}, expected 0, 1 or 2")
        return values
