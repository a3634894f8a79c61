"""The whole graph offline: a bag in, a bag out, deterministic, as fast as the processor allows.

The library's classes are called as the nodes call them, and every skeleton passes through its message between them, so
that the angles are those of the live graph.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from body_tracking import graph
from body_tracking.calibration.online import CalibrationParameters, CalibrationUpdate, OnlineCalibration
from body_tracking.calibration.storage import load
from body_tracking.cdr import decode_skeletons, encode_angles, encode_skeletons
from body_tracking.errors import BodyTrackingError
from body_tracking.filters import FILTERS, LinearKalmanParameters, make_filter
from body_tracking.fusion.fusion import Fusion, FusionParameters
from body_tracking.fusion.subject import SubjectSelector
from body_tracking.kinematics.positional import positional_angles
from body_tracking.messages import (
    JOINT_STATE,
    POINT_CLOUD,
    TIME_REFERENCE,
    TRANSFORM,
    clock_to_time_reference,
    cloud_to_skeletons,
    pose_to_transform,
    time_reference_to_clock,
    transform_to_pose,
)
from body_tracking.parameters import Value, check_all, fields_of, matches, parameters_from, read_file
from body_tracking.recording.qos import LATCHED, RELIABLE, SENSOR_DATA
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagReader, BagWriter, deserialize, serialize
from body_tracking.skeleton import NANOSECONDS, Skeleton

DEFAULT_FILTER = "lkf_constant_velocity"
_JUMP_BACK_NS = NANOSECONDS
_P = TypeVar("_P")


class ReplayError(BodyTrackingError):
    """The bag holds nothing to run the graph on."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """What the offline graph is to do; defaults as the nodes'.

    Attributes:
        sensors: the first is the reference unless ``reference`` says otherwise.
        reference: or empty.
        filter_name: one of the filters.
        body: the id in topics and names of angles.
        calibration: parameters of the calibration.
        fusion: parameters of the fusion.
        filter_parameters: parameters of the filter.
        calibration_file: start from this calibration; None for none.
    """

    sensors: tuple[str, ...]
    reference: str = ""
    filter_name: str = DEFAULT_FILTER
    body: str = graph.DEFAULT_BODY
    calibration: CalibrationParameters = field(default_factory=CalibrationParameters)
    fusion: FusionParameters = field(default_factory=FusionParameters)
    filter_parameters: Mapping[str, Any] = field(default_factory=dict)
    calibration_file: Path | None = None


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What a replay did.

    Attributes:
        frames: joint angle messages that came out.
        recording_s: length of the recording by its log times.
        elapsed_s: time that it took.
        counters: what was seen and left out on the way.
        warnings: what the bag itself lacks.
    """

    frames: int
    recording_s: float
    elapsed_s: float
    counters: Mapping[str, int]
    warnings: tuple[str, ...]


def sensor_topics(bag: BagReader, wanted: Sequence[str] = ()) -> dict[str, str]:
    """The skeleton topics of a bag's sensors.

    Args:
        bag: open.
        wanted: sensor names; all that are there when empty.

    Returns:
        Sensor name by topic.

    Raises:
        ReplayError: a wanted sensor or any sensor at all is missing, or its topic has another type.
    """
    there = graph.sensors_among(bag.topics)
    names = tuple(wanted) or there
    missing = [name for name in names if name not in there]
    if missing or not names:
        what = f"no topic {graph.skeleton_topic(missing[0])}" if missing else "no topic /<sensor>/skeleton"
        raise ReplayError(f"{bag.path}: {what}; it holds {', '.join(sorted(bag.topics)) or 'no topics'}")
    for name in names:
        kind = bag.topics[graph.skeleton_topic(name)].type_name
        if kind != POINT_CLOUD:
            raise ReplayError(f"{bag.path}: {graph.skeleton_topic(name)} holds {kind}, expected {POINT_CLOUD}")
    return {graph.skeleton_topic(name): name for name in names}


def skeletons_of(
    bag: BagReader, topics: Mapping[str, str], counters: Counter[str]
) -> Iterator[tuple[str, Skeleton, int, bytes]]:
    """The subject of each sensor's frames in log-time order: sensor, skeleton, log time, the message itself.

    Malformed messages are counted and skipped, with the last reason in ``counters`` only as a number per topic.
    """
    subjects = {sensor: SubjectSelector() for sensor in topics.values()}
    last: dict[str, int] = {}
    for raw in bag.messages(topics.keys()):
        sensor = topics[raw.topic]
        try:
            skeletons = decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
        except BodyTrackingError:
            counters[f"malformed {raw.topic}"] += 1
            continue
        stamp = skeletons[0].stamp_ns
        if stamp < last.get(sensor, stamp) - _JUMP_BACK_NS:
            counters["time jumps"] += 1
            subjects[sensor].reset()
        last[sensor] = stamp
        subject = subjects[sensor].pick(skeletons)
        if subject is None:
            counters["frames without a body"] += 1
            continue
        yield sensor, subject, raw.log_time_ns, raw.cdr


class OfflineGraph:
    """Calibration, fusion, filter and angles in one process, connected by their messages.

    Args:
        settings: what to run.
        writer: where everything goes; None to only compute.
    """

    def __init__(self, settings: ReplaySettings, writer: BagWriter | None = None) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self.frames = 0
        reference = settings.reference or None
        self.calibration = OnlineCalibration(settings.sensors, settings.calibration, reference)
        if settings.calibration_file is not None:
            self.calibration.load(load(settings.calibration_file))
        self.fusion = Fusion(settings.sensors, settings.fusion, reference)
        self.filter = make_filter(settings.filter_name, **settings.filter_parameters)
        self._writer = writer
        self._states = graph.joint_states_topic(settings.body)
        self._stddevs = graph.joint_states_stddev_topic(settings.body)
        if writer is not None:
            for topic, kind, qos in (
                (graph.CALIBRATION, TRANSFORM, LATCHED),
                (graph.CALIBRATION_CLOCK, TIME_REFERENCE, LATCHED),
                (graph.FUSED, POINT_CLOUD, SENSOR_DATA),
                (graph.FILTERED, POINT_CLOUD, SENSOR_DATA),
                (self._states, JOINT_STATE, RELIABLE),
                (self._stddevs, JOINT_STATE, RELIABLE),
            ):
                writer.add_topic(topic, kind, qos)
        self._started = False

    def push(self, sensor: str, skeleton: Skeleton, log_time_ns: int) -> None:
        """One frame of one sensor."""
        if not self._started:
            self._started = True
            self._calibrated(self.calibration.current_update(), log_time_ns)
        for update in self.calibration.push(sensor, skeleton, log_time_ns):
            self._calibrated(update, log_time_ns)
        for fused in self.fusion.push(sensor, skeleton, log_time_ns):
            self._fused(fused, log_time_ns)

    def finish(self, log_time_ns: int) -> None:
        """What still waits for a frame that does not come."""
        deadline = self.fusion.deadline_ns
        if deadline is not None:
            for fused in self.fusion.poll(max(deadline, log_time_ns)):
                self._fused(fused, log_time_ns)

    def _calibrated(self, update: CalibrationUpdate, log_time_ns: int) -> None:
        result = update.result
        for sensor, clock in result.clocks.items():
            if sensor != result.reference:
                reference = clock_to_time_reference(sensor, clock, update.valid_from_ns, BAG_MESSAGES)
                self._write(graph.CALIBRATION_CLOCK, serialize(reference), log_time_ns)
                self.fusion.set_clock(*time_reference_to_clock(reference))
        for pose in result.poses.values():
            transform = pose_to_transform(pose, self.fusion.world, BAG_MESSAGES)
            self._write(graph.CALIBRATION, serialize(transform), log_time_ns)
            self.fusion.set_pose(transform_to_pose(transform))

    def _fused(self, skeleton: Skeleton, log_time_ns: int) -> None:
        filtered = self.filter.update(self._through(graph.FUSED, skeleton, log_time_ns))
        if filtered is None:
            return
        arrived = self._through(graph.FILTERED, filtered, log_time_ns)
        states, stddevs = encode_angles(positional_angles(arrived), self.settings.body, arrived.frame_id)
        self.frames += 1
        self._write(self._states, states, log_time_ns)
        self._write(self._stddevs, stddevs, log_time_ns)

    def _through(self, topic: str, skeleton: Skeleton, log_time_ns: int) -> Skeleton:
        """The skeleton as whoever subscribes gets it: in single precision."""
        cdr = encode_skeletons([skeleton])
        self._write(topic, cdr, log_time_ns)
        arrived = decode_skeletons(cdr)
        assert arrived is not None
        return arrived[0]

    def _write(self, topic: str, cdr: bytes, log_time_ns: int) -> None:
        if self._writer is not None:
            self._writer.write(topic, cdr, log_time_ns)


class Progress:
    """A percentage on stderr, where that is a terminal."""

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start, self._length = start_ns, max(1, end_ns - start_ns)
        self._shown = -1
        self._on = sys.stderr.isatty()

    def at(self, log_time_ns: int) -> None:
        """Show how far it is."""
        percent = min(100, 100 * (log_time_ns - self._start) // self._length)
        if self._on and percent != self._shown:
            self._shown = percent
            print(f"\r{percent:3d} %", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Clear the line."""
        if self._on:
            print("\r     \r", end="", file=sys.stderr, flush=True)


def replay(bag_path: Path, out: Path, settings: ReplaySettings, *, overwrite: bool = False) -> ReplayReport:
    """Run the graph over a bag and write all that it publishes, beside the sensors' own messages and the ground truth.

    Args:
        bag_path: a rosbag2 folder or an mcap file.
        out: the bag to be made.
        settings: with the sensors to use; all sensors of the bag when that is empty.
        overwrite: replace ``out`` if it is there.

    Raises:
        ReplayError: no skeletons in the bag.
        BagError: the bag cannot be read, or ``out`` cannot be written.
        CalibrationError: the calibration file belongs to other sensors.
    """
    began = time.perf_counter()
    with BagReader(bag_path) as bag:
        topics = sensor_topics(bag, settings.sensors)
        passed = [topic for topic in bag.topics if topic in topics or topic.startswith("/ground_truth/")]
        settings = _with_sensors(settings, tuple(topics.values()))
        with BagWriter(out, overwrite=overwrite) as writer:
            for topic in passed:
                writer.add_topic(topic, bag.topics[topic].type_name, bag.topics[topic].qos)
            offline = OfflineGraph(settings, writer)
            progress = Progress(bag.start_ns, bag.end_ns)
            last = bag.start_ns
            counters = offline.counters
            truth = _Passed(bag, [topic for topic in passed if topic not in topics], writer)
            for sensor, skeleton, log_time_ns, cdr in skeletons_of(bag, topics, counters):
                truth.until(log_time_ns)
                writer.write(graph.skeleton_topic(sensor), cdr, log_time_ns)
                offline.push(sensor, skeleton, log_time_ns)
                progress.at(log_time_ns)
                last = log_time_ns
            truth.until(None)
            offline.finish(last)
            progress.end()
        if not offline.frames:
            raise ReplayError(
                f"{bag_path}: no frame of {', '.join(settings.sensors)} came through ({_listed(counters)})"
            )
        counters.update({f"fusion {name}": count for name, count in offline.fusion.counters.items()})
        counters.update({f"filter {name}": count for name, count in offline.filter.counters.items()})
        return ReplayReport(
            offline.frames,
            (bag.end_ns - bag.start_ns) / NANOSECONDS,
            time.perf_counter() - began,
            {name: count for name, count in sorted(counters.items()) if count},
            tuple(bag.warnings),
        )


class _Passed:
    """Messages that go from one bag to the other as they are, in step with the rest."""

    def __init__(self, bag: BagReader, topics: Collection[str], writer: BagWriter) -> None:
        self._messages = iter(bag.messages(topics)) if topics else iter(())
        self._next = next(self._messages, None)
        self._writer = writer

    def until(self, log_time_ns: int | None) -> None:
        while self._next is not None and (log_time_ns is None or self._next.log_time_ns <= log_time_ns):
            self._writer.write(self._next.topic, self._next.cdr, self._next.log_time_ns)
            self._next = next(self._messages, None)


def _listed(counters: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in sorted(counters.items())) or "nothing at all"


def _with_sensors(settings: ReplaySettings, sensors: tuple[str, ...]) -> ReplaySettings:
    values = {name: getattr(settings, name) for name in ReplaySettings.__slots__}
    return ReplaySettings(**(values | {"sensors": sensors}))


# --- the command


def parameters_for(
    node: str, parameter_class: type[_P], file: Path | None, own: Mapping[str, Value]
) -> tuple[_P, dict[str, object]]:
    """What a parameters file tells a node, for the library class behind it.

    Args:
        node: its name, such as ``fusion``.
        parameter_class: the dataclass of its parameters.
        file: a ROS parameters file, or None.
        own: names and defaults of the node's parameters beside those of the class.

    Returns:
        The parameters, and the others as given.

    Raises:
        ParameterError: a file that is none, a value of the wrong type or out of range, an unknown name.
    """
    table = parameters_from(parameter_class)
    given: dict[str, object] = {}
    for pattern, values in read_file(file).items() if file is not None else ():
        if matches(pattern, f"/{node}"):
            given |= values
    others = {name: value for name, value in given.items() if name in own}
    checked = check_all(table, {name: value for name, value in given.items() if name not in own})
    return parameter_class(**fields_of(parameter_class, checked)), others


_SHARED: dict[str, Value] = {
    "use_sim_time": False,
    "reliable": False,
    "world_frame": "",
    "sensors": (),
    "reference": "",
}


def settings_from(args: argparse.Namespace) -> ReplaySettings:
    """The settings that a command line asks for."""
    file = args.params_file
    calibration, _ = parameters_for("calibration", CalibrationParameters, file, {**_SHARED, "calibration_file": ""})
    fusion, shared = parameters_for("fusion", FusionParameters, file, _SHARED)
    filtering, own = parameters_for("skeleton_filter", LinearKalmanParameters, file, {**_SHARED, "filter": ""})
    return ReplaySettings(
        tuple(args.sensors.split(",")) if args.sensors else (),
        args.reference or str(shared.get("reference", "")),
        args.filter or str(own.get("filter", DEFAULT_FILTER)),
        args.body,
        calibration,
        fusion,
        {name: getattr(filtering, name) for name in LinearKalmanParameters.__slots__},
        args.calibration,
    )


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking replay``."""
    command = subparsers.add_parser(
        "replay",
        help="run the whole graph offline over a bag",
        description="Calibrates, fuses, filters and computes joint angles offline, with the same results as the live "
        "graph, and writes every topic that the graph would publish into a new bag.",
    )
    command.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file with /<sensor>/skeleton topics"
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    command.add_argument("--filter", choices=FILTERS, help=f"default: {DEFAULT_FILTER}")
    command.add_argument("--sensors", metavar="A,B", help="use these, the first as reference (default: all in the bag)")
    command.add_argument("--reference", metavar="A", help="the sensor that defines world (default: the first)")
    command.add_argument("--calibration", type=Path, metavar="FILE", help="start from this calibration (YAML)")
    command.add_argument("--params-file", type=Path, metavar="F", help="ROS parameters file, as for the nodes")
    command.add_argument("--body", default=graph.DEFAULT_BODY, help="id of the person (default: %(default)s)")
    command.add_argument("--overwrite", action="store_true", help="replace OUT if it is there")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """The command."""
    report = replay(args.bag, args.output, settings_from(args), overwrite=args.overwrite)
    if args.json:
        print(
            json.dumps(
                {
                    "bag": str(args.bag),
                    "output": str(args.output),
                    "frames": report.frames,
                    "recording_s": report.recording_s,
                    "elapsed_s": report.elapsed_s,
                    "counters": dict(report.counters),
                    "warnings": list(report.warnings),
                },
                indent=2,
            )
        )
        return 0
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(
        f"{report.frames} frames of joint angles from {report.recording_s:.1f} s of recording in "
        f"{report.elapsed_s:.1f} s ({report.recording_s / max(report.elapsed_s, 1e-9):.0f} times real time)"
    )
    print(f"left out or noted on the way: {_listed(report.counters)}")
    print(f"written to {args.output}")
    return 0
