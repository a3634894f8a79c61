"""Recordings of the NTU motion capture data set of Jatesiktat et al. (2018), section IV: one folder per recording.

The authors document the format (github.com/koonyook/mocap_dataset, mocapDataViewer). The reader uses these files of a
recording's folder:

- ``kinect/``: ``timestamp.bin`` (float64, ms), ``depthBuffer.bin`` (uint16, mm, 424x512 for each stamp),
  ``bodyIndexBuffer.bin`` (uint8, as many pixels; 255 for nobody), ``cameraIntrinsics.bin`` (7 float32: focal lengths,
  principal point, three radial coefficients), ``depthToCameraSpaceTable.bin`` (float32, x and y of each pixel's ray, to
  check the intrinsics), ``OfflineBodyframe.protobuf`` (skeletons);
- ``imu*/RawSample.RawSampleListProto``: counts of an LSM303D and an L3GD20, with stamps in the Kinect's clock, and
  ``magCalibrationParameters.bin``; ``setting.SettingProto`` maps sensors to segments;
- ``vicon/viconRecord.TRC`` (markers, mm) and ``viconStartOffset.bin`` (float64, the Kinect's frame of the first
markers).

The SDK's images are mirrored: their columns follow its camera space, whose x points to the sensor's left. The reader
flips them to the optical frame's direction.

Stamps, depth images and intrinsics are required; warnings name other missing files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import open_regular
from body_tracking.core.imu import STANDARD_GRAVITY, ImuSample, ImuSampleError, RecordedImu, imu_frame
from body_tracking.core.protobuf import Fields, ProtobufError, fields, message, number, signed
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame, check_sensor_name, optical_frame

WIDTH, HEIGHT = 512, 424
DEPTH_FILE: Final = "kinect/depthBuffer.bin"
_STAMPS, _BODIES = "kinect/timestamp.bin", "kinect/bodyIndexBuffer.bin"
_INTRINSICS, _TABLE = "kinect/cameraIntrinsics.bin", "kinect/depthToCameraSpaceTable.bin"
_SKELETONS, _SETTING = "kinect/OfflineBodyframe.protobuf", "setting.SettingProto"
_SAMPLES, _FIELD = "RawSample.RawSampleListProto", "magCalibrationParameters.bin"
_MARKERS, _OFFSET = "vicon/viconRecord.TRC", "vicon/viconStartOffset.bin"
_MS: Final = NANOSECONDS // 1000
_RATE: Final = np.radians(0.070)
"""rad/s per count of the gyroscope."""
_FORCE: Final = 0.00018 * STANDARD_GRAVITY
"""m/s2 per count of the accelerometer."""
_TESLA: Final = 0.080e-7
"""Tesla per count of the magnetometer: 0.08 milligauss."""
_PLACES: Final = {1: "camera", 2: "forearm_left", 3: "forearm_right"}
"""Segment of each inertial sensor, by the field of ``SettingProto`` with its number."""
_TO_OPTICAL: Final = np.array([-1.0, -1.0, 1.0])
"""Factors from camera space (x to the sensor's left, y up) to the optical frame."""
_OFF: Final = 2e-3
"""Largest difference between rays of the intrinsics and the table in the middle of the image (about a pixel)."""
BAD: Final = "readings that no inertial sensor can have made"


class NtuMocapError(BodyTrackingError):
    """Raised for a folder that is not a recording of the data set, or a damaged file in it."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedDepth:
    """A depth image with its body index.

    Attributes:
        sensor: the camera's name.
        received_ns: nanoseconds of the Kinect's clock.
        depth: (424, 512) millimetres, 0 where missing.
        bodies: (424, 512) number of the body, 255 for nobody; None if not recorded.
        camera: intrinsics.
    """

    sensor: str
    received_ns: int
    depth: NDArray[np.uint16]
    bodies: NDArray[np.uint8] | None
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class RecordedMarkers:
    """The markers (n, 3) of one frame, metres in the frame of the other system, and their names."""

    sensor: str
    received_ns: int
    positions: FloatArray
    names: tuple[str, ...]


Item = RecordedFrame | RecordedImu | RecordedDepth | RecordedMarkers


def is_ntu_mocap(path: Path) -> bool:
    """Whether a path is a folder with a depth buffer of this data set."""
    return path.is_dir() and (path / DEPTH_FILE).exists()


class NtuMocapRecording:
    """Iterates over the items of one recording in the order of time.

    Args:
        path: its folder.
        sensor: name of the Kinect.
        partial: read a truncated recording up to its last whole image, skeleton or reading.

    Attributes:
        problems: counts of irregularities, by kind.
        warnings: one line per missing part.
        progress: share read, 0 to 1.

    Raises:
        NtuMocapError: while iterating: a file is missing, damaged or inconsistent with the others.
        SensorNameError: an invalid name.
    """

    def __init__(self, path: Path, sensor: str | None = None, partial: bool = False) -> None:
        self._path, self._sensor, self._partial = path, check_sensor_name(sensor or "kinect1"), partial
        self.problems: dict[str, int] = {}
        self.warnings: list[str] = []
        self.progress = 0.0

    def __iter__(self) -> Iterator[Item]:
        self.warnings, self.problems = [], {}
        stamps = self._stamps()
        items: list[Item] = [*self._skeletons(stamps), *self._readings(), *self._points(stamps)]
        items.sort(key=lambda item: item.received_ns)
        images, rest = self._images(stamps), iter(items)
        waiting = next(rest, None)
        for count, image in enumerate(images):
            while waiting is not None and waiting.received_ns < image.received_ns:
                yield waiting
                waiting = next(rest, None)
            yield image
            self.progress = (count + 1) / len(stamps)
        while waiting is not None:
            yield waiting
            waiting = next(rest, None)

    # --- files

    def _numbers(self, name: str, kind: str, count: int | None = None) -> NDArray[Any]:
        """All numbers of a binary file."""
        file = self._path / name
        data = self._bytes(name)
        whole = len(data) - len(data) % np.dtype(kind).itemsize
        if whole != len(data) and not self._partial:
            raise NtuMocapError(f"{file}: {len(data)} bytes are no whole number of {np.dtype(kind)}")
        found = np.frombuffer(data[:whole], kind)
        if count is not None and len(found) != count:
            raise NtuMocapError(f"{file}: {len(found)} numbers, expected {count}")
        return found

    def _bytes(self, name: str) -> bytes:
        try:
            with open_regular(self._path / name) as file:
                return file.read()
        except OSError as error:
            raise NtuMocapError(f"{self._path / name}: {error.strerror}") from error

    def _there(self, name: str, what: str) -> bool:
        if (self._path / name).exists():
            return True
        self.warnings.append(f"{self._path}: no {what} ({name})")
        return False

    def _stamps(self) -> NDArray[np.int64]:
        """(n,) nanoseconds of the images."""
        stamps = self._numbers(_STAMPS, "<f8")
        if not len(stamps) or not np.isfinite(stamps).all() or (np.diff(stamps) <= 0.0).any():
            raise NtuMocapError(f"{self._path / _STAMPS}: expected milliseconds that ascend")
        if stamps[0] < 0.0 or stamps[-1] * _MS >= 2.0**62:
            raise NtuMocapError(f"{self._path / _STAMPS}: {stamps[0]:g} to {stamps[-1]:g} are no milliseconds")
        return np.round(stamps * _MS).astype(np.int64)

    # --- parts of a recording

    def _images(self, stamps: NDArray[np.int64]) -> Iterator[RecordedDepth]:
        camera, pixels = self._camera(), HEIGHT * WIDTH
        depth = self._frames(DEPTH_FILE, "<u2", len(stamps))
        bodies = self._frames(_BODIES, "u1", len(stamps)) if self._there(_BODIES, "body index") else None
        for count in range(len(depth) // pixels):
            part = slice(count * pixels, (count + 1) * pixels)
            own = (
                None
                if bodies is None or part.stop > len(bodies)
                else np.array(bodies[part].reshape(HEIGHT, WIDTH)[:, ::-1])
            )
            image = np.array(depth[part].reshape(HEIGHT, WIDTH)[:, ::-1], dtype=np.uint16)
            yield RecordedDepth(self._sensor, int(stamps[count]), image, own, camera)

    def _frames(self, name: str, kind: str, count: int) -> NDArray[Any]:
        """The pixels of all images, memory-mapped because of hundreds of megabytes."""
        file = self._path / name
        wanted = count * HEIGHT * WIDTH * np.dtype(kind).itemsize
        try:
            with open_regular(file) as opened:
                size = opened.seek(0, 2)
        except OSError as error:
            raise NtuMocapError(f"{file}: {error.strerror}") from error
        if size != wanted:
            text = f"{file}: {size} bytes, expected {wanted} for {count} images of {WIDTH} x {HEIGHT}"
            if not self._partial or size > wanted:
                raise NtuMocapError(text)
            self.warnings.append(text)
        if not size // np.dtype(kind).itemsize:
            return np.zeros(0, kind)
        return np.memmap(file, np.dtype(kind), "r", shape=(size // np.dtype(kind).itemsize,))

    def _camera(self) -> Camera:
        """The intrinsics, checked against the table of rays."""
        fx, fy, cx, cy, second, fourth, sixth = self._numbers(_INTRINSICS, "<f4", 7).astype(np.float64).tolist()
        values = np.array([fx, fy, cx, cy, second, fourth, sixth])
        if not np.isfinite(values).all() or not 100.0 < fx < 1000.0 or not 100.0 < fy < 1000.0:
            raise NtuMocapError(
                f"{self._path / _INTRINSICS}: {values.round(3).tolist()} are no intrinsics of a Kinect v2"
            )
        matrix = np.array([[fx, 0.0, WIDTH - 1.0 - cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        distortion = np.array([second, fourth, 0.0, 0.0, sixth])
        camera = Camera(optical_frame(self._sensor), WIDTH, HEIGHT, matrix, distortion)
        if self._there(_TABLE, "table of rays"):
            rays = -self._numbers(_TABLE, "<f4", 2 * HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 2)[:, ::-1]
            middle = np.stack(np.meshgrid(np.arange(128.0, 384.0, 16.0), np.arange(112.0, 312.0, 16.0)), axis=-1)
            at = middle.astype(np.intp)
            off = np.abs(camera.undistort(middle) - rays[at[..., 1], at[..., 0]]).max()
            if not off < _OFF:
                raise NtuMocapError(f"{self._path / _TABLE}: rays differ from the intrinsics by {off:.4f}")
        return camera

    def _messages(self, data: bytes, name: str) -> Iterator[Fields]:
        """The messages in field 1 of a list."""
        try:
            parts = fields(data).get(1, [])
        except ProtobufError as error:
            raise NtuMocapError(f"{self._path / name}: {error}") from error
        for count, part in enumerate(parts):
            try:
                if not isinstance(part, bytes):
                    raise ProtobufError("a number, expected a message")
                yield fields(part)
            except ProtobufError as error:
                raise NtuMocapError(f"{self._path / name}, item {count}: {error}") from error

    def _skeletons(self, stamps: NDArray[np.int64]) -> Iterator[RecordedFrame]:
        if not self._there(_SKELETONS, "skeletons"):
            return
        for count, frame in enumerate(self._messages(self._bytes(_SKELETONS), _SKELETONS)):
            if count >= len(stamps):
                raise NtuMocapError(f"{self._path / _SKELETONS}: more frames than the {len(stamps)} images")
            stamp_ns = int(stamps[count])
            try:
                bodies = [fields(each) for each in frame.get(3, []) if isinstance(each, bytes)]
                tracked = tuple(
                    self._skeleton(body, place, stamp_ns) for place, body in enumerate(bodies) if number(body, 2)
                )
            except ProtobufError as error:
                raise NtuMocapError(f"{self._path / _SKELETONS}, frame {count}: {error}") from error
            if tracked:
                yield RecordedFrame(self._sensor, stamp_ns, tracked)

    def _skeleton(self, body: Fields, place: int, stamp_ns: int) -> Skeleton:
        positions, states = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, np.uint8)
        for entry in body.get(4, []):
            pair = fields(entry) if isinstance(entry, bytes) else {}
            joint, value = int(number(pair, 1)), message(pair, 2)
            state = int(number(value, 2))
            if not 0 <= joint < N_JOINTS or state not in tuple(TrackingState):
                raise ProtobufError(f"joint {joint} with state {state}")
            point = message(value, 1)
            position = np.array([number(point, axis) for axis in (1, 2, 3)])
            if state != TrackingState.NOT_TRACKED and np.isfinite(position).all():
                positions[joint], states[joint] = position, state
        return Skeleton(stamp_ns, optical_frame(self._sensor), positions * _TO_OPTICAL, states, place)

    def _readings(self) -> Iterator[RecordedImu]:
        if not self._there(_SETTING, "setting of the inertial sensors"):
            return
        try:
            setting = fields(self._bytes(_SETTING))
            numbers = {place: int(number(setting, field)) for field, place in _PLACES.items()}
        except ProtobufError as error:
            raise NtuMocapError(f"{self._path / _SETTING}: {error}") from error
        counts: Counter[str] = Counter()
        for place, own in numbers.items():
            name = f"imu{own}/{_SAMPLES}"
            if own and self._there(name, f"readings of the inertial sensor {place}"):
                yield from self._of_sensor(f"imu_{place}", f"imu{own}", name, counts)
        self.problems |= dict(counts)

    def _of_sensor(self, sensor: str, folder: str, name: str, counts: Counter[str]) -> Iterator[RecordedImu]:
        centre, scaled = np.zeros(3), np.eye(3)
        if self._there(f"{folder}/{_FIELD}", f"calibration of the magnetometer of {sensor}"):
            values = self._numbers(f"{folder}/{_FIELD}", "<f4", 12).astype(np.float64)
            centre, scaled = values[:3], values[3:].reshape(3, 3)
        for count, sample in enumerate(self._messages(self._bytes(name), name)):
            try:
                force, rate, field = (
                    np.array([signed(message(sample, of), axis) for axis in (1, 2, 3)], dtype=np.float64)
                    for of in (8, 9, 10)
                )
                bias = np.array([number(message(sample, 17), axis) for axis in (1, 2, 3)])
                stamp_ms = number(sample, 15)
            except ProtobufError as error:
                raise NtuMocapError(f"{self._path / name}, item {count}: {error}") from error
            if not 0.0 <= stamp_ms * _MS < 2.0**62:
                counts[BAD] += 1
                continue
            stamp_ns = round(stamp_ms * _MS)
            try:
                reading = ImuSample(
                    stamp_ns,
                    imu_frame(sensor),
                    angular_velocity=_RATE * (rate - bias),
                    acceleration=_FORCE * force,
                    magnetic_field=_TESLA * (scaled @ (field - centre)),
                )
            except ImuSampleError:
                counts[BAD] += 1
                continue
            yield RecordedImu(sensor, stamp_ns, reading)

    def _points(self, stamps: NDArray[np.int64]) -> Iterator[RecordedMarkers]:
        if not self._there(_MARKERS, "markers"):
            return
        file = self._path / _MARKERS
        lines = self._bytes(_MARKERS).decode("utf-8", "replace").splitlines()
        try:
            rate = float(lines[2].split("\t")[0])
            names = tuple(each.partition(":")[2] or each for each in lines[3].split("\t")[2:] if each.strip())
            start = float(self._numbers(_OFFSET, "<f8", 1)[0]) if (self._path / _OFFSET).exists() else None
        except (ValueError, IndexError) as error:
            raise NtuMocapError(f"{file}: no header of a TRC file ({error})") from error
        if not 0.0 < rate < 10000.0 or not names:
            raise NtuMocapError(f"{file}: {rate:g} Hz, {len(names)} markers")
        if start is None or not 0.0 <= start <= len(stamps) - 1:
            raise NtuMocapError(
                f"{self._path / _OFFSET}: the markers' first frame is at {start} of {len(stamps)} images"
            )
        first_ns = float(np.interp(start, np.arange(len(stamps)), stamps))
        for count, line in enumerate(line for line in lines[5:] if line.strip()):
            cells = line.split("\t")[2 : 2 + 3 * len(names)]
            cells += [""] * (3 * len(names) - len(cells))
            try:
                places = np.array([float(cell) if cell.strip() else np.nan for cell in cells]).reshape(-1, 3) / 1e3
            except ValueError as error:
                raise NtuMocapError(f"{file}, line {count + 6}: {error}") from error
            seen = np.asarray(np.isfinite(places).all(axis=1))
            yield RecordedMarkers(
                "markers",
                round(first_ns + count * NANOSECONDS / rate),
                places[seen],
                tuple(name for name, there in zip(names, seen, strict=True) if there),
            )
