"""``body_tracking import``: recordings of other formats, one or several views, as one bag.

Skeletons go to ``/<sensor>/skeleton``, inertial readings to ``/<sensor>/imu/data`` (with orientation) or
``/<sensor>/imu/data_raw``, and ``/<sensor>/imu/mag``; depth images and body index to the topics of a depth camera;
joint angles in a file to ``/ground_truth/joint_states``; points of another motion capture system to
``/markers/points``. A message's header stamp is the sensor's own clock exactly as recorded; the bag's log time is the
time of receipt.
"""

from __future__ import annotations

import argparse
import heapq
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.imu import RecordedAngles, RecordedImu
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import IMAGE, IMU, JOINT_STATE, MAGNETIC_FIELD, POINT_CLOUD
from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA, Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.core.sources import RecordedFrame, Recording
from body_tracking.inertial.imu_csv import ImuCsvRecording, is_imu_csv
from body_tracking.inertial.mvnx import MvnxRecording
from body_tracking.kinect.csv_recording import CsvRecording, sensor_column
from body_tracking.kinect.ntu import NtuRecording
from body_tracking.markers import setup
from body_tracking.markers.messages import points_to_cloud
from body_tracking.markers.trajectories import (
    C3D_SUFFIX,
    DEFAULT_NOISE,
    FRAME,
    RecordedPoints,
    TrajectoryRecording,
    is_trajectory_file,
    labels_in,
    points_of,
)
from body_tracking.mesh.ntu_mocap import DEPTH_FILE, NtuMocapRecording, RecordedDepth, RecordedMarkers, is_ntu_mocap
from body_tracking.mesh.topics import IMAGES, body_index_topic, depth_topic, info_topic
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.messages.cameras import CAMERA_INFO, camera_to_info
from body_tracking.messages.images import array_to_image
from body_tracking.messages.imus import sample_to_messages
from body_tracking.messages.skeletons import skeletons_to_cloud
from body_tracking.pipeline.graph import DEFAULT_BODY, TRUE_ANGLES
from body_tracking.recording.image_folder import COLOUR_FOLDERS, import_folder, is_image_folder
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter, check_new_bag

CSV_SUFFIXES = (".csv", ".csv.gz")
NTU_SUFFIX = ".skeleton"
MVNX_SUFFIXES = (".mvnx", ".mvnx.gz")
BAG_SUFFIX = ".mcap"
_RATE, _DEPTH_SCALE = 30.0, 1000.0
SUFFIXES = (*CSV_SUFFIXES, NTU_SUFFIX, *MVNX_SUFFIXES, C3D_SUFFIX)

_Item = RecordedFrame | RecordedImu | RecordedAngles | RecordedPoints | RecordedDepth | RecordedMarkers
_Recording = Recording[_Item]
_Message = tuple[str, str, Qos, object]
"""Topic, message type, QoS, message."""


class ImportFileError(BodyTrackingError):
    """Raised when files cannot be imported, or not together."""


@dataclass(slots=True)
class ImportedSensor:
    """The imported messages of one sensor, or of ``markers`` for points.

    Attributes:
        frames: number of messages.
        bodies: largest number of bodies in a frame; 0 for an inertial sensor and for points.
        start_ns, end_ns: time of the first and the last receipt.
        topics: in the order of their first messages.
    """

    start_ns: int
    end_ns: int
    frames: int = 0
    bodies: int = 0
    topics: dict[str, None] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        return (self.end_ns - self.start_ns) / NANOSECONDS


@dataclass(frozen=True, slots=True)
class ImportReport:
    """Result of an import.

    Attributes:
        bag: the folder.
        sensors: by name.
        seconds: from the first to the last receipt of all.
        problems: counts of irregularities, by kind; their data were imported as recorded.
        warnings: missing data, a line each.
    """

    bag: Path
    sensors: dict[str, ImportedSensor]
    seconds: float
    problems: dict[str, int]
    warnings: list[str]

    @property
    def frames(self) -> int:
        """Number of messages of all sensors."""
        return sum(sensor.frames for sensor in self.sensors.values())

    def as_json(self) -> str:
        """The report as one JSON object."""
        sensors = {
            name: {"frames": each.frames, "bodies": each.bodies, "seconds": each.seconds, "topics": list(each.topics)}
            for name, each in self.sensors.items()
        }
        report = {"bag": str(self.bag), "frames": self.frames, "recording_s": self.seconds, "sensors": sensors}
        return json.dumps({**report, "problems": self.problems, "warnings": self.warnings}, indent=2)


def open_recording(path: Path, sensor: str | None = None, partial: bool = False) -> Recording[RecordedFrame]:
    """The reader for a file of skeletons, chosen by its suffix.

    Args:
        path: ``.csv``, ``.csv.gz`` or ``.skeleton``.
        sensor: the sensor's name, if the file lacks it or to replace it.
        partial: read a truncated file up to its last whole frame.

    Raises:
        ImportFileError: another suffix, or no such file.
    """
    if not path.is_file():
        raise ImportFileError(f"{path}: no such file")
    if path.name.lower().endswith(CSV_SUFFIXES):
        return CsvRecording(path, sensor, partial)
    if path.suffix.lower() == NTU_SUFFIX:
        return NtuRecording(path, sensor, partial)
    raise ImportFileError(f"{path}: not a {', '.join((*CSV_SUFFIXES, NTU_SUFFIX))} file")


def _open_any(path: Path, name: str | None, partial: bool, labels: Sequence[str], noise: float) -> _Recording:
    """The reader for a file of skeletons, inertial readings or points, or for a folder of NTU's motion capture data."""
    if is_ntu_mocap(path):
        return NtuMocapRecording(path, name, partial)
    _check_kind(path)
    if is_trajectory_file(path):
        if name is not None:
            raise ImportFileError(f"--sensor {name}={path}: its points are of no sensor")
        return TrajectoryRecording(path, labels, noise, partial)
    if path.name.lower().endswith(MVNX_SUFFIXES):
        if name is not None:
            raise ImportFileError(f"--sensor {name}={path}: an MVNX file names its sensors itself")
        return MvnxRecording(path, partial)
    if _is_inertial(path):
        return ImuCsvRecording(path, None if name is None else name.split(","), partial)
    return open_recording(path, name, partial)


def _check_kind(path: Path) -> None:
    """Reject a path that cannot be imported, by its name and kind."""
    if path.suffix == BAG_SUFFIX or (path.is_dir() and any(path.glob(f"*{BAG_SUFFIX}"))):
        raise ImportFileError(f"{path}: a bag, which needs no import")
    if path.is_dir():
        *first, last = (f"{name}/" for name in COLOUR_FOLDERS)
        raise ImportFileError(
            f"{path}: a folder without images in {', '.join(first)} or {last} and without {DEPTH_FILE}"
        )
    if not path.exists():
        raise ImportFileError(f"{path}: no such file")
    if not path.is_file():
        raise ImportFileError(f"{path}: not a file")
    if not path.name.lower().endswith(SUFFIXES):
        raise ImportFileError(f"{path}: not a {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file")
    if not path.stat().st_size:
        raise ImportFileError(f"{path}: the file is empty")


def _is_inertial(path: Path) -> bool:
    return path.name.lower().endswith(CSV_SUFFIXES) and path.is_file() and is_imu_csv(path)


def import_files(
    files: Sequence[Path],
    bag: Path,
    *,
    sensors: Mapping[Path, str] | None = None,
    labels: Sequence[str] = (),
    noise: float = DEFAULT_NOISE,
    overwrite: bool = False,
    partial: bool = False,
) -> ImportReport:
    """Import recordings into one bag, merged in time order.

    Args:
        files: each with sensors of its own.
        bag: the folder to create.
        sensors: names by file, for files that lack the sensor's name or to replace it. By default CSV files without the
            column ``sensor`` are ``kinect1``, ``kinect2``, ...
        labels: of the points to import from another motion capture system; all when empty.
        noise: standard deviation of each coordinate of these points, metres.
        overwrite: replace an existing bag.
        partial: import truncated files up to their last whole frame.

    Raises:
        BodyTrackingError: an invalid file, two files with the same sensor, or the bag cannot be written. The incomplete
            bag is removed.
    """
    if not files:
        raise ImportFileError("no file to import")
    twice = [str(path) for path, count in Counter(files).items() if count > 1]
    if twice:
        raise ImportFileError(f"{twice[0]}: is to be imported twice")
    if not 0.0 < noise < 1.0:
        raise ImportFileError(f"noise of points {noise:g} m, expected more than 0 and less than 1")
    recordings = [
        _open_any(path, name, partial, labels, noise)
        for path, name in zip(files, _names(files, sensors or {}), strict=True)
    ]
    points = any(isinstance(each, TrajectoryRecording) for each in recordings)
    if (labels or noise != DEFAULT_NOISE) and not points:
        given = ", ".join(map(str, files))
        raise ImportFileError(f"{given}: no points of a motion capture system, for which --labels and --noise are")
    found: dict[str, ImportedSensor] = {}
    owners: dict[str, Path] = {}
    # Read all files before an existing bag is replaced: an invalid file must not destroy it.
    if overwrite and bag.exists():
        for recording in recordings:
            for _ in recording:
                pass
    writer = BagWriter(bag, overwrite=overwrite, flush_interval_s=float("inf"))
    try:
        progress = Progress(0.0, len(recordings))
        streams = [_ordered(recording, number) for number, recording in enumerate(recordings)]
        topics: set[str] = set()
        for _, number, item in heapq.merge(*streams, key=lambda item: item[:2]):
            path, messages = files[number], _messages(item)
            owner = TRUE_ANGLES if isinstance(item, RecordedAngles) else item.sensor
            if owners.setdefault(owner, path) != path:
                topic = setup.POINTS if isinstance(item, RecordedPoints) else TRUE_ANGLES
                what = topic if isinstance(item, RecordedAngles | RecordedPoints) else f"sensor {owner!r}"
                named = isinstance(recordings[number], MvnxRecording | TrajectoryRecording)
                hint = "" if named else f"; --sensor NAME={path} sets another name"
                raise ImportFileError(f"{what} is in {owners[owner]} and in {path}{hint}")
            for topic, type_name, qos, message in messages:
                if topic not in topics:
                    writer.add_topic(topic, type_name, qos)
                    topics.add(topic)
                writer.write_message(topic, message, item.received_ns)
            if not isinstance(item, RecordedAngles):
                at_ns = item.received_ns
                sensor = found.setdefault(item.sensor, ImportedSensor(at_ns, at_ns))
                sensor.start_ns, sensor.end_ns = min(sensor.start_ns, at_ns), max(sensor.end_ns, at_ns)
                sensor.frames += 1
                sensor.bodies = max(sensor.bodies, len(item.skeletons) if isinstance(item, RecordedFrame) else 0)
                sensor.topics |= dict.fromkeys(topic for topic, *_ in messages)
            progress.at(sum(recording.progress for recording in recordings))
        progress.end()
        if not found:
            text = f"{', '.join(map(str, files))}: no body in any frame, no inertial reading and no point"
            counted = [f"{count} {problem}" for each in recordings for problem, count in each.problems.items()]
            raise ImportFileError("; ".join([text, *counted, *(line for each in recordings for line in each.warnings)]))
        writer.close()
    except BaseException:
        writer.discard()
        raise
    start_ns, end_ns = min(each.start_ns for each in found.values()), max(each.end_ns for each in found.values())
    return ImportReport(
        bag,
        dict(sorted(found.items())),
        (end_ns - start_ns) / NANOSECONDS,
        dict(sum((Counter(recording.problems) for recording in recordings), Counter())),
        [warning for recording in recordings for warning in recording.warnings] + _odd_rates(found),
    )


def _odd_rates(sensors: Mapping[str, ImportedSensor]) -> list[str]:
    """A warning for each sensor whose mean interval is over a second or under 0.1 ms: its times have another unit."""
    intervals = {name: each.seconds / (each.frames - 1) for name, each in sensors.items() if each.frames > 1}
    return [
        f"{name}: {interval:.3g} s from one message to the next, in the mean: are its times in seconds?"
        for name, interval in sorted(intervals.items())
        if not 1e-4 <= interval <= 1.0
    ]


def _names(files: Sequence[Path], given: Mapping[Path, str]) -> list[str | None]:
    """The name for each file's sensor; None to take it from the file."""
    unknown = [path for path in given if path not in files]
    if unknown:
        raise ImportFileError(f"--sensor {given[unknown[0]]}={unknown[0]}: no such file is imported")
    names: list[str | None] = []
    for path in files:
        name = given.get(path)
        if name is None and path.name.lower().endswith(CSV_SUFFIXES) and path.is_file() and not sensor_column(path):
            # the inertial reader names its sensors itself, and points have none
            name = (
                None
                if _is_inertial(path) or is_trajectory_file(path)
                else f"kinect{sum(value is not None for value in names) + 1}"
            )
        names.append(name)
    return names


def _messages(item: _Item) -> list[_Message]:
    """The messages of an item."""
    if isinstance(item, RecordedFrame):
        cloud = skeletons_to_cloud(item.skeletons, BAG_MESSAGES)
        return [(f"/{item.sensor}/skeleton", POINT_CLOUD, SENSOR_DATA, cloud)]
    if isinstance(item, RecordedDepth):
        frame_id, at_ns = item.camera.frame_id, item.received_ns
        image = array_to_image(item.depth, at_ns, frame_id, BAG_MESSAGES, "16UC1")
        depth: list[_Message] = [
            (info_topic(item.sensor), CAMERA_INFO, LATCHED, camera_to_info(item.camera, at_ns, BAG_MESSAGES)),
            (depth_topic(item.sensor), IMAGE, IMAGES, image),
        ]
        if item.bodies is not None:
            index = array_to_image(item.bodies, at_ns, frame_id, BAG_MESSAGES)
            depth.insert(1, (body_index_topic(item.sensor), IMAGE, IMAGES, index))
        return depth
    if isinstance(item, RecordedMarkers):
        points = points_of(item.positions, item.received_ns, FRAME, DEFAULT_NOISE)
        return [(setup.POINTS, POINT_CLOUD, RELIABLE, points_to_cloud(points, BAG_MESSAGES))]
    if isinstance(item, RecordedPoints):
        return [(setup.POINTS, POINT_CLOUD, RELIABLE, points_to_cloud(item.points, BAG_MESSAGES))]
    if isinstance(item, RecordedAngles):
        nothing = np.full(len(item.names), np.nan)
        angles = JointAngles(item.received_ns, item.names, item.angles, nothing, nothing, nothing)
        states, _ = angles_to_joint_states(angles, DEFAULT_BODY, "", BAG_MESSAGES)
        return [(TRUE_ANGLES, JOINT_STATE, RELIABLE, states)]
    imu, field_message = sample_to_messages(item.sample, BAG_MESSAGES)
    kind = "data_raw" if item.sample.orientation is None else "data"
    found: list[_Message] = [(f"/{item.sensor}/imu/{kind}", IMU, SENSOR_DATA, imu)]
    if field_message is not None:
        found.append((f"/{item.sensor}/imu/mag", MAGNETIC_FIELD, SENSOR_DATA, field_message))
    return found


def _ordered(recording: _Recording, number: int) -> Iterator[tuple[int, int, _Item]]:
    """Items with a non-decreasing key, so that merging keeps the order within each file."""
    latest = -(2**63)
    for item in recording:
        latest = max(latest, item.received_ns)
        yield latest, number, item


# --- command line


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``import`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "import",
        description="Turn recordings into one bag with a topic /<sensor>/skeleton per camera, and /<sensor>/imu/data "
        "or data_raw, and /<sensor>/imu/mag, per inertial sensor; points of another motion capture system (C3D, CSV of "
        "Motive) go to /markers/points. Header stamps are the sensors' own clocks as recorded, the bag's log time is "
        "the time of receipt. Formats: docs/recordings.md.",
    )
    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help=".csv, .csv.gz, .skeleton, .mvnx, .mvnx.gz, .c3d, or a folder of colour and depth images or of "
        "the NTU motion capture data set",
    )
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="BAG", help="the bag (a folder) to make")
    parser.add_argument(
        "--sensor",
        action="append",
        default=[],
        metavar="NAME[=FILE]",
        help="the sensor's name, if the file lacks it or to replace it; with several files, once per file; "
        "NAME,NAME,... for a file of several inertial sensors",
    )
    parser.add_argument(
        "--labels",
        type=labels_in,
        default=(),
        metavar="LABEL,...",
        help="import only these points of a .c3d file or of an export of Motive (default: all)",
    )
    parser.add_argument(
        "--noise",
        type=float,
        default=DEFAULT_NOISE,
        metavar="METRES",
        help="standard deviation of each coordinate of these points (default %(default)s)",
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=_RATE,
        metavar="HZ",
        help="images a second of a folder whose files have no stamps as names (default %(default)s)",
    )
    parser.add_argument(
        "--depth-scale",
        type=float,
        default=_DEPTH_SCALE,
        metavar="N",
        help="numbers to a metre in its depth images (default %(default)s: millimetres)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    parser.add_argument("--partial", action="store_true", help="import the complete part of files that are cut off")
    parser.add_argument("--json", action="store_true", help="print what was imported as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking import``."""
    check_new_bag(args.output, overwrite=args.overwrite)
    if any(map(is_image_folder, args.files)):
        if len(args.files) > 1:
            raise ImportFileError(f"{args.files[0]}: a folder of images is imported alone")
        if args.labels or args.noise != DEFAULT_NOISE or args.partial:
            raise ImportFileError(f"{args.files[0]}: --labels, --noise and --partial are not for a folder of images")
        camera = _parse_sensors(args.sensor, args.files).get(args.files[0], "camera1")
        given = args.files[0], args.output, camera, args.rate, args.depth_scale
        images = import_folder(*given, overwrite=args.overwrite)
        print(images.as_json() if args.json else images.text())
        return 0
    if (args.rate, args.depth_scale) != (_RATE, _DEPTH_SCALE):
        named = ", ".join(map(str, args.files))
        raise ImportFileError(f"{named}: no folder of images, for which --rate and --depth-scale are")
    report = import_files(
        args.files,
        args.output,
        sensors=_parse_sensors(args.sensor, args.files),
        labels=args.labels,
        noise=args.noise,
        overwrite=args.overwrite,
        partial=args.partial,
    )
    if args.json:
        print(report.as_json())
        return 0
    for sensor in report.sensors.values():
        bodies = f", up to {sensor.bodies} bodies" if sensor.bodies > 1 else ""
        kind = "frames" if sensor.bodies else "readings"
        print(f"{', '.join(sensor.topics)}: {sensor.frames} {kind} in {sensor.seconds:.1f} s{bodies}")
    for problem, count in report.problems.items():
        print(f"counted: {count} {problem}")
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{report.bag}: {report.frames} frames, {report.seconds:.1f} s")
    return 0


def _parse_sensors(options: Sequence[str], files: Sequence[Path]) -> dict[Path, str]:
    """``NAME=FILE``, or ``NAME`` for the only file."""
    names: dict[Path, str] = {}
    for option in options:
        name, equals, file = option.partition("=")
        if not equals and len(files) > 1:
            raise ImportFileError(f"--sensor {name}: of which of the {len(files)} files? --sensor {name}=FILE")
        path = Path(file) if equals else files[0]
        if path in names:
            raise ImportFileError(f"--sensor {option}: {path} has the name {names[path]} already")
        names[path] = name
    return names
