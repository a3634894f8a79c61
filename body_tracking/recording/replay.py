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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from body_tracking import graph
from body_tracking.calibration.online import CalibrationParameters
from body_tracking.cdr import decode_skeletons
from body_tracking.errors import BodyTrackingError
from body_tracking.filtering import (
    ANGLES,
    FILTER,
    INPUT,
    ORDER_WAIT,
    ORIENTATIONS,
    PEOPLE,
    PREDICT_AFTER,
    filter_parameters,
    filter_table,
    people_from,
)
from body_tracking.filters import DEFAULT_FILTER, FILTERS
from body_tracking.fusion.fusion import FusionParameters
from body_tracking.fusion.subject import SubjectSelector
from body_tracking.imu_tracking import IMU_PARAMETERS, ImuSettings
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.kinematics.tracking import ALL_CONVENTIONS
from body_tracking.messages.base import POINT_CLOUD
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.parameters import Parameter, Value, check_all, fields_of, matches, parameters_from, read_file
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, RawMessage, deserialize
from body_tracking.recording.stages import JUMP_BACK_NS, ReplaySettings, Sink, Upstream, start_downstream
from body_tracking.skeleton import NANOSECONDS, Skeleton

_P = TypeVar("_P")


class ReplayError(BodyTrackingError):
    """The bag holds nothing to run the graph on."""


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


def frames_of(
    bag: BagReader, topics: Mapping[str, str], counters: Counter[str]
) -> Iterator[tuple[str, tuple[Skeleton, ...], int, bytes]]:
    """Each sensor's frames in log-time order: sensor, the bodies in it, log time, the message itself.

    Malformed messages are counted and skipped, with the last reason in ``counters`` only as a number per topic; so are
    frames without a body.
    """
    last: dict[str, int] = {}
    for raw in bag.messages(topics.keys()):
        sensor = topics[raw.topic]
        try:
            skeletons = decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
        except BodyTrackingError:
            counters[f"malformed {raw.topic}"] += 1
            continue
        stamp = skeletons[0].stamp_ns
        if stamp < last.get(sensor, stamp) - JUMP_BACK_NS:
            counters["time jumps"] += 1
        last[sensor] = stamp
        if not any(skeleton.valid.any() for skeleton in skeletons):
            counters["frames without a body"] += 1
            continue
        yield sensor, skeletons, raw.log_time_ns, raw.cdr


def skeletons_of(
    bag: BagReader, topics: Mapping[str, str], counters: Counter[str]
) -> Iterator[tuple[str, Skeleton, int, bytes]]:
    """The same with the body that is nearest to the sensor, as long as it is there, instead of all."""
    subjects = {sensor: SubjectSelector() for sensor in topics.values()}
    last: dict[str, int] = {}
    for sensor, skeletons, log_time_ns, cdr in frames_of(bag, topics, counters):
        stamp = skeletons[0].stamp_ns
        if stamp < last.get(sensor, stamp) - JUMP_BACK_NS:
            subjects[sensor].reset()
        last[sensor] = stamp
        subject = subjects[sensor].pick(skeletons)
        assert subject is not None  # a body is there
        yield sensor, subject, log_time_ns, cdr


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
    counters: Counter[str] = Counter()
    with RigReader(bag_path) as bag:
        topics = sensor_topics(bag, settings.sensors)
        settings = replace(settings, sensors=tuple(topics.values()))
        truth = [topic for topic in bag.topics if topic.startswith("/ground_truth/")]
        inertial = () if settings.imus is None else graph.played_imu_topics(settings.imus.segments, bag.topics)
        kept = (*topics, *truth, *inertial)
        passed = {topic: (bag.topics[topic].type_name, bag.topics[topic].qos) for topic in kept}
        upstream = Upstream(settings)  # before `out` is touched
        downstream = start_downstream(settings, out, passed, overwrite=overwrite)
        try:
            upstream.sink = downstream
            progress = Progress(bag.start_ns, bag.end_ns)
            beside = _Passed(bag, truth, downstream)
            felt = _Felt(bag, inertial, downstream, upstream, counters)
            started = False
            for sensor, skeletons, log_time_ns, cdr in frames_of(bag, topics, counters):
                beside.until(log_time_ns)
                felt.until(log_time_ns)
                if not started:
                    started = True
                    upstream.start(log_time_ns)
                downstream.take(graph.skeleton_topic(sensor), cdr, log_time_ns)
                upstream.push(sensor, skeletons, log_time_ns)
                progress.at(log_time_ns)
            beside.until(None)
            felt.until(None)
            upstream.finish(bag.end_ns)
            written = downstream.finish()
        except BaseException:
            downstream.abandon()
            raise
        progress.end()
        if not written.frames:
            raise ReplayError(
                f"{bag_path}: no frame of {', '.join(settings.sensors)} came through ({_listed(counters)})"
            )
        if upstream.imus is not None:
            counters.update({f"inertial {name}": count for name, count in upstream.imus.tracker.counters.items()})
        counters.update({f"fusion {name}": count for name, count in upstream.fusion.counters.items()})
        counters.update({f"filter {name}": count for name, count in written.counters.items()})
        return ReplayReport(
            written.frames,
            (bag.end_ns - bag.start_ns) / NANOSECONDS,
            time.perf_counter() - began,
            {name: count for name, count in sorted(counters.items()) if count},
            tuple(bag.warnings),
        )


class _Passed:
    """Messages that go from one bag to the other as they are, in step with the rest."""

    def __init__(self, bag: BagReader, topics: Collection[str], sink: Sink) -> None:
        self._messages = iter(bag.messages(topics)) if topics else iter(())
        self._next = next(self._messages, None)
        self._sink = sink

    def until(self, log_time_ns: int | None) -> None:
        """All up to a log time, or all."""
        while self._next is not None and (log_time_ns is None or self._next.log_time_ns <= log_time_ns):
            self._pass(self._next)
            self._next = next(self._messages, None)

    def _pass(self, message: RawMessage) -> None:
        self._sink.take(message.topic, message.cdr, message.log_time_ns)


class _Felt(_Passed):
    """Likewise messages of inertial sensors, which are tracked besides; malformed ones are counted."""

    def __init__(
        self, bag: BagReader, topics: Collection[str], sink: Sink, upstream: Upstream, counters: Counter[str]
    ) -> None:
        super().__init__(bag, topics, sink)
        self._upstream, self._counters = upstream, counters

    def _pass(self, message: RawMessage) -> None:
        super()._pass(message)
        try:
            self._upstream.feel(message.topic, message.cdr, message.log_time_ns)
        except BodyTrackingError:
            self._counters[f"malformed {message.topic}"] += 1


def _listed(counters: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in sorted(counters.items())) or "nothing at all"


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
    checked, others = values_for(node, parameters_from(parameter_class), file, own)
    return parameter_class(**fields_of(parameter_class, checked)), others


def values_for(
    node: str, table: Sequence[Parameter], file: Path | None, own: Mapping[str, Value]
) -> tuple[dict[str, Value], dict[str, object]]:
    """The same for a table of parameters: the value of each, and the others as given."""
    given: dict[str, object] = {}
    for pattern, values in read_file(file).items() if file is not None else ():
        if matches(pattern, f"/{node}"):
            given |= values
    others = {name: value for name, value in given.items() if name in own}
    return check_all(table, {name: value for name, value in given.items() if name not in own}), others


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
    whom: dict[str, Value] = {item.name: item.default for item in PEOPLE}
    fusion, shared = parameters_for("fusion", FusionParameters, file, {**_SHARED, **whom})
    own = {**_SHARED, "body": ""}
    table = (FILTER, INPUT, ORDER_WAIT, PREDICT_AFTER, ORIENTATIONS, *PEOPLE, *filter_table())
    filtering, _ = values_for("skeleton_filter", table, file, own)
    values_for("joint_angles", ANGLES, file, {**own, **whom})
    # What one node is told and another must know: from the command line, else from the file.
    options = graph.GraphOptions(
        filter_name=args.filter or "", convention=args.convention or "", subject=args.subject or "", people=args.people
    )
    chosen = graph.with_file(options, file)
    if chosen.subject:
        filtering["subject"] = chosen.subject
    if chosen.people:
        filtering["people"] = chosen.people
    filter_name = chosen.filter_name or DEFAULT_FILTER
    imus = _imus_from(chosen, file)
    return ReplaySettings(
        tuple(args.sensors.split(",")) if args.sensors else (),
        args.reference or str(shared.get("reference", "")),
        filter_name,
        chosen.filter_input or graph.AUTO,
        float(str(filtering["predict_after"])),
        float(str(filtering["order_wait"])),
        chosen.convention or graph.AUTO,
        chosen.angles_input or graph.AUTO,
        args.body,
        calibration,
        fusion,
        filter_parameters(filter_name, filtering),
        args.calibration,
        imus,
        _names(filtering["orientations"]) or tuple(each.segment for each in graph.imu_topics(chosen.imus)),
        people_from(filtering),
        args.model_covariance,
    )


def _imus_from(chosen: graph.GraphOptions, file: Path | None) -> ImuSettings | None:
    """The inertial sensors that a parameters file lists; None where it lists none."""
    values, _ = values_for("imu_skeleton", IMU_PARAMETERS, file, {**_SHARED, "subject": ""})
    if not chosen.imus:
        return None
    parameters: dict[str, Any] = fields_of(TrackingParameters, values)
    return ImuSettings(chosen.imus, _names(values["mountings"]), TrackingParameters(**parameters))


def _names(value: Value) -> tuple[str, ...]:
    return value if isinstance(value, tuple) else ()


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking replay``."""
    command = subparsers.add_parser(
        "replay",
        description="Calibrates, fuses, filters and computes joint angles offline, with the same results as the live "
        "graph, and writes every topic that the graph would publish into a new bag.",
    )
    command.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file with /<sensor>/skeleton topics"
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    command.add_argument("--filter", choices=FILTERS, help=f"default: {DEFAULT_FILTER}")
    command.add_argument("--convention", choices=ALL_CONVENTIONS, help="of the joint angles (default: by the filter)")
    command.add_argument("--sensors", metavar="A,B", help="use these, the first as reference (default: all in the bag)")
    command.add_argument("--reference", metavar="A", help="the sensor that defines world (default: the first)")
    command.add_argument("--calibration", type=Path, metavar="FILE", help="start from this calibration (YAML)")
    command.add_argument("--params-file", type=Path, metavar="F", help="ROS parameters file, as for the nodes")
    command.add_argument("--body", default=graph.DEFAULT_BODY, help="id of the only subject (default: %(default)s)")
    graph.add_people(command)
    command.add_argument(
        "--model-covariance",
        action="store_true",
        help="with ekf: write /filtered/model_covariance, too; it is most of such a bag",
    )
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
