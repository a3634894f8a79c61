"""Runs the whole graph offline on a bag and writes a bag; deterministic, as fast as the processor allows.

The stages are those of the nodes, and exchange serialised messages, so that the angles are those of the live graph.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from body_tracking.calibration.online import CalibrationParameters
from body_tracking.calibration.storage import load
from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import POINT_CLOUD
from body_tracking.core.parameters import Parameter, Value, check_all, fields_of, matches, parameters_from, read_file
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.filters import DEFAULT_FILTER, parameter_prefix
from body_tracking.fusion.fusion import FusionParameters
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.node_parameters import parameters_for as parameters_of_nodes
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.people import PeopleParameters, SubjectSelector
from body_tracking.pipeline.system import Options
from body_tracking.recording import forked
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, RawMessage, deserialize
from body_tracking.systems import (
    STAGES,
    add_options,
    all_nodes_for,
    nodes_for,
    options_from,
    options_of,
    played,
    stage_class,
    with_file,
)

_P = TypeVar("_P")


class ReplayError(BodyTrackingError):
    """Raised when the bag lacks the input of the graph."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """Parameters of the offline graph; defaults as the nodes'.

    Attributes:
        sensors: the first is the reference unless ``reference`` is set; all of the bag when empty, which may be none
            with a ``marker_setup``; :data:`graph.NO_SENSORS` alone for none although the bag has some.
        reference: or empty.
        filter_name: one of the filters.
        convention: of the joint angles; ``graph.AUTO`` for the filter's own.
        filter_input, angles_input: as the parameters ``input`` of ``skeleton_filter`` and ``joint_angles``.
        calibration_file: start from this calibration; None for none.
        imus: segments with inertial sensors, as the parameter ``segments`` of ``imu_skeleton`` lists them.
        marker_setup, marker_points: the options of these names: folder of infrared markers, topic of their points.
        depth, person: the options of these names: depth cameras, file of the person's body.
        played: topics of the bag that take the place of sensors.
        people: whom to track.
        calibration, fusion, tracking: parameters of the calibration, the fusion and the inertial sensors.
        filter_parameters: parameters of the filter, without its prefix.
        parameters: further parameters by node; they override all of the above.
        model_covariance: also write the covariance of the filter's model.
    """

    sensors: tuple[str, ...] = ()
    reference: str = ""
    filter_name: str = DEFAULT_FILTER
    convention: str = graph.AUTO
    filter_input: str = graph.AUTO
    angles_input: str = graph.AUTO
    calibration_file: Path | None = None
    imus: tuple[str, ...] = ()
    marker_setup: str = ""
    marker_points: str = ""
    depth: tuple[str, ...] = ()
    person: str = ""
    played: tuple[str, ...] = ()
    people: PeopleParameters = field(default_factory=PeopleParameters)
    calibration: CalibrationParameters = field(default_factory=CalibrationParameters)
    fusion: FusionParameters = field(default_factory=FusionParameters)
    tracking: TrackingParameters = field(default_factory=TrackingParameters)
    filter_parameters: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    model_covariance: bool = False

    def options(self) -> Options:
        """Options of the graph."""
        return options_of(
            sensors=self.sensors or (() if self.marker_setup or self.depth else graph.DEFAULT_SENSORS),
            filter=self.filter_name,
            filter_input=self.filter_input,
            convention=self.convention,
            angles_input=self.angles_input,
            imus=self.imus,
            marker_setup=self.marker_setup,
            marker_points=self.marker_points,
            depth=self.depth,
            person=self.person,
            played=self.played,
            calibration="" if self.calibration_file is None else str(self.calibration_file),
            external=True,
        )

    def values(self) -> dict[str, dict[str, Value]]:
        """All parameters of each stage, by its name.

        Raises:
            BodyTrackingError: inconsistent settings.
        """
        specs = sorted(
            (spec for spec in nodes_for(self.options()) if spec.name in STAGES),
            key=lambda spec: STAGES.index(spec.name),
        )
        prefix = parameter_prefix(self.filter_name)
        people = asdict(self.people)
        own: dict[str, dict[str, Any]] = {
            "calibration": asdict(self.calibration),
            "fusion": {**asdict(self.fusion), **people},
            "imu_skeleton": {**asdict(self.tracking), "subject": self.people.subject},
            "skeleton_filter": {f"{prefix}{name}": each for name, each in self.filter_parameters.items()} | people,
            # of the time that a live graph has: here it would make the results depend on the machine
            "rigid_body_tracker": {"deadline": 1.0},
            "joint_angles": {"subject": self.people.subject, "people": self.people.people},
        }
        found = {}
        for spec in specs:
            given = {**spec.defaults, **own.get(spec.name, {}), **spec.parameters, "reference": self.reference}
            given |= self.parameters.get(spec.name, {})
            table = stage_class(spec.name).PARAMETERS
            known = {item.name for item in table}
            checked = check_all(table, {name: each for name, each in given.items() if name in known})
            found[spec.name] = {**own.get(spec.name, {}), **checked}
        return found


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Result of a replay.

    Attributes:
        frames: number of joint angle messages.
        recording_s: length of the recording by its log times.
        elapsed_s: computing time.
        counters: of events and unusable messages.
        warnings: missing or damaged parts of the bag.
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
        wanted: sensor names; all in the bag when empty.

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


class _Frames:
    """Decodes the frames of sensors, and counts unusable ones.

    Args:
        topics: sensor name by topic.
        counters: counts malformed messages, time jumps and frames without a body.
    """

    def __init__(self, topics: Mapping[str, str], counters: Counter[str]) -> None:
        self._topics, self._counters = topics, counters
        self._last: dict[str, int] = {}

    def skeletons(self, raw: RawMessage) -> tuple[Skeleton, ...] | None:
        """The bodies in a frame; None for an unusable one."""
        try:
            skeletons = decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
        except BodyTrackingError:
            self._counters[f"malformed {raw.topic}"] += 1
            return None
        stamp = skeletons[0].stamp_ns
        if jumped_back(stamp, self._last.get(raw.topic)):
            self._counters["time jumps"] += 1
        self._last[raw.topic] = stamp
        if not any(skeleton.valid.any() for skeleton in skeletons):
            self._counters["frames without a body"] += 1
            return None
        return skeletons


def skeletons_of(
    bag: BagReader, topics: Mapping[str, str], counters: Counter[str]
) -> Iterator[tuple[str, Skeleton, int, bytes]]:
    """Each sensor's frames in log-time order: sensor, the body nearest to it, log time, and the message.

    A selected body is kept while it is tracked. Unusable frames are counted and skipped.
    """
    subjects = {sensor: SubjectSelector() for sensor in topics.values()}
    last: dict[str, int] = {}
    frames = _Frames(topics, counters)
    for raw in bag.messages(topics.keys()):
        skeletons, sensor = frames.skeletons(raw), topics[raw.topic]
        if skeletons is None:
            continue
        stamp = skeletons[0].stamp_ns
        if jumped_back(stamp, last.get(sensor)):
            subjects[sensor].reset()
        last[sensor] = stamp
        subject = subjects[sensor].pick(skeletons)
        assert subject is not None  # a body is there
        yield sensor, subject, raw.log_time_ns, raw.cdr


class Progress:
    """A percentage on stderr, where that is a terminal."""

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start, self._length = start_ns, max(1, end_ns - start_ns)
        self._shown = -1
        self._on = sys.stderr.isatty()

    def at(self, log_time_ns: int) -> None:
        """Update the percentage."""
        percent = min(100, 100 * (log_time_ns - self._start) // self._length)
        if self._on and percent != self._shown:
            self._shown = percent
            print(f"\r{percent:3d} %", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Clear the line."""
        if self._on:
            print("\r     \r", end="", file=sys.stderr, flush=True)


def replay(bag_path: Path, out: Path, settings: ReplaySettings, *, overwrite: bool = False) -> ReplayReport:
    """Run the graph over a bag and write its output, with the sensors' messages and the ground truth.

    Args:
        bag_path: a rosbag2 folder or an mcap file.
        out: the bag to write.
        settings: of the graph.
        overwrite: replace an existing ``out``.

    Raises:
        ReplayError: no skeletons in the bag, or no images, balls or points of markers.
        BagError: the bag cannot be read, or ``out`` cannot be written.
        CalibrationError: the calibration file belongs to other sensors.
    """
    began = time.perf_counter()
    counters: Counter[str] = Counter()
    with RigReader(bag_path) as bag:
        topics = {} if _without(settings, bag) else sensor_topics(bag, settings.sensors)
        settings = replace(settings, sensors=tuple(topics.values()))
        truth = [topic for topic in bag.topics if topic.startswith("/ground_truth/")]
        try:
            settings = replace(settings, played=played(settings.options(), bag.topics))
        except graph.GraphError as error:
            raise ReplayError(f"{bag_path}: {error}") from error
        kept = tuple(dict.fromkeys((*topics, *truth, *settings.played)))
        passed = {topic: (bag.topics[topic].type_name, bag.topics[topic].qos) for topic in kept}
        if settings.calibration_file is not None:
            load(settings.calibration_file)  # raises if it is missing or invalid
        values = settings.values()
        # before `out` is touched
        stages = [stage_class(name)(each) for name, each in values.items() if not forked.is_second(name)]
        written_by_us = {
            p.topic: (p.codec.type_name, p.qos) for stage in stages for p in stage.outputs if not p.optional
        }
        job = forked.Job(values, out, {**passed, **written_by_us}, overwrite, settings.model_covariance)
        downstream = forked.start_downstream(job)
        try:
            runner = OfflineRunner(stages, BAG_WIRE, downstream.take)
            progress, frames = Progress(bag.start_ns, bag.end_ns), _Frames(topics, counters)
            started = False
            for raw in bag.messages(kept):
                if raw.topic in topics and frames.skeletons(raw) is None:
                    continue
                if not started and raw.topic in (topics or settings.played):
                    started = True
                    runner.start(raw.log_time_ns)
                downstream.take(raw.topic, raw.cdr, raw.log_time_ns)
                runner.push(raw.topic, raw.cdr, raw.log_time_ns)
                progress.at(raw.log_time_ns)
            runner.finish(bag.end_ns)
            written = downstream.finish(bag.end_ns)
        except BaseException:
            downstream.abandon()
            raise
        progress.end()
        counters.update(runner.counters)
        if not written.frames:
            sources = ", ".join(settings.sensors or settings.played)
            raise ReplayError(f"{bag_path}: no frame of {sources} came through ({_listed(counters)})")
        for stage in stages:
            counters.update({f"{stage.NAME} {name}": count for name, count in stage.counters.items()})
        counters.update(written.counters)
        return ReplayReport(
            written.frames,
            (bag.end_ns - bag.start_ns) / NANOSECONDS,
            time.perf_counter() - began,
            {name: count for name, count in sorted(counters.items()) if count},
            tuple(bag.warnings),
        )


def _without(settings: ReplaySettings, bag: BagReader) -> bool:
    """Whether no skeletons of sensors are used.

    Raises:
        ReplayError: none are wanted, and nothing else is.
    """
    if settings.sensors == (graph.NO_SENSORS,):
        if not (settings.marker_setup or settings.depth):
            raise ReplayError(f"{bag.path}: sensors none, and neither a marker setup nor a depth camera")
        return True
    other = settings.depth or (settings.marker_setup and not graph.sensors_among(bag.topics))
    return bool(other) and not settings.sensors


def _listed(counters: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in sorted(counters.items())) or "nothing at all"


# --- the command


def parameters_for(
    node: str, parameter_class: type[_P], file: Path | None, own: Mapping[str, Value]
) -> tuple[_P, dict[str, object]]:
    """A node's parameters from a parameters file.

    Args:
        node: its name, such as ``fusion``.
        parameter_class: the dataclass of its parameters.
        file: a ROS parameters file, or None.
        own: names and defaults of the node's parameters that are not in the class.

    Returns:
        The parameters, and the values of ``own`` in the file.

    Raises:
        ParameterError: an invalid file, a value of the wrong type or out of range, an unknown name.
    """
    checked, others = values_for(node, parameters_from(parameter_class), file, own)
    return parameter_class(**fields_of(parameter_class, checked)), others


def values_for(
    node: str, table: Sequence[Parameter], file: Path | None, own: Mapping[str, Value]
) -> tuple[dict[str, Value], dict[str, object]]:
    """As :func:`parameters_for`, for a table of parameters."""
    given: dict[str, object] = {}
    for pattern, values in read_file(file).items() if file is not None else ():
        if matches(pattern, f"/{node}"):
            given |= values
    others = {name: value for name, value in given.items() if name in own}
    return check_all(table, {name: value for name, value in given.items() if name not in own}), others


def settings_from(args: argparse.Namespace) -> ReplaySettings:
    """The settings of a command line."""
    chosen = with_file(options_of(**{**options_from(args), "external": True}), args.params_file)
    specs = [spec for spec in nodes_for(chosen) if spec.name in STAGES]
    given = parameters_of_nodes(specs, args.params_file, absent=all_nodes_for(chosen))
    left = ("use_sim_time", "sensors", "calibration_file", "deadline")
    parameters = {
        node: {name: value for name, value in values.items() if name not in left} for node, values in given.items()
    }
    whom = given.get("skeleton_filter", {})
    people = {name: whom[name] for name in ("subject", "people") if name in whom}
    for node in parameters.keys() & {"skeleton_filter", "joint_angles"}:
        parameters[node]["body"] = args.body
    if args.reference:
        for values in parameters.values():
            values["reference"] = args.reference
    options: dict[str, Any] = dict(chosen)
    sensors: tuple[str, ...] = ()
    if args.sensors:
        sensors = tuple(each for each in options["sensors"] if each not in options["computed"]) or (graph.NO_SENSORS,)
    return ReplaySettings(
        sensors,
        args.reference or "",
        options["filter"] or DEFAULT_FILTER,
        options["convention"] or graph.AUTO,
        options["filter_input"] or graph.AUTO,
        options["angles_input"] or graph.AUTO,
        args.calibration,
        options["imus"],
        options["marker_setup"],
        options["marker_points"],
        options["depth"],
        options["person"],
        (),
        PeopleParameters(**people),  # type: ignore[arg-type]
        parameters=parameters,
        model_covariance=args.model_covariance,
    )


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking replay``."""
    command = subparsers.add_parser(
        "replay",
        description="Calibrates, fuses, filters and computes joint angles offline, with the same results as the live "
        "graph, and writes every topic that the graph would publish into a new bag.",
    )
    command.add_argument(
        "bag",
        type=Path,
        metavar="BAG",
        help="rosbag2 folder or .mcap file with /<sensor>/skeleton topics, or with images, balls or points of markers",
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    command.add_argument("--reference", metavar="A", help="the sensor that defines world (default: the first)")
    command.add_argument("--body", default=graph.DEFAULT_BODY, help="id of the only subject (default: %(default)s)")
    names = ("sensors", "filter", "convention", "calibration", "imus", "subject", "people", "params_file")
    cameras = ("marker_setup", "marker_points", "depth", "person")
    add_options(
        command,
        *names,
        *cameras,
        "model_covariance",
        filter=f"default: {DEFAULT_FILTER}",
        convention="of the joint angles (default: by the filter)",
        sensors="use these, the first as reference; none: no skeletons, markers or depth alone (default: all in the "
        "bag)",
        calibration="start from this calibration (YAML)",
        model_covariance="with ekf: write /filtered/model_covariance, too; it is most of such a bag",
    )
    command.add_argument("--overwrite", action="store_true", help="replace OUT if it is there")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
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
