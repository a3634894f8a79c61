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
from typing import Any, Final

from body_tracking.calibration.stage import lacking
from body_tracking.calibration.storage import load
from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import DIAGNOSTICS, POINT_CLOUD
from body_tracking.core.parameters import Value, check_all
from body_tracking.core.skeleton import NANOSECONDS, Skeleton
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.filters.smoothing import WHOLE_LAG
from body_tracking.messages.codecs import Skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.node_parameters import parameters_for
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.people import SubjectSelector
from body_tracking.pipeline.roles import NOTABLE_LATE, ROLES
from body_tracking.pipeline.system import Options
from body_tracking.recording import forked
from body_tracking.recording.finding import advice_for, unused, unused_imus, with_covariances
from body_tracking.recording.progress import Progress
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, check_new_bag, deserialize
from body_tracking.recording.summary import summary
from body_tracking.systems import (
    OPTIONS,
    add_options,
    all_nodes_for,
    nodes_for,
    options_from,
    options_of,
    played,
    stage_class,
    stage_hosts,
    with_file,
)


class ReplayError(BodyTrackingError):
    """Raised when the bag lacks the input of the graph."""


OFFLINE: Final[Mapping[str, Value]] = {"deadline": 10.0}
"""Time limits of the stages, seconds: with those of a live graph, offline results would depend on the machine; with
1 s a busy one lost a frame."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """Parameters of the offline graph; defaults as the nodes'.

    Attributes:
        sensors: the first is the reference unless ``reference`` is set; all of the bag when empty, possibly none with a
            ``marker_setup``; only :data:`graph.NO_SENSORS` for none although the bag has some.
        reference: or empty.
        filter_name: one of the filters.
        convention: of the joint angles; ``graph.AUTO`` for the filter's own.
        calibration_file: start from this calibration; None for none.
        imus: segments with inertial sensors, as the parameter ``segments`` of ``imu_skeleton`` lists them.
        more: further options of the graph, by name.
        parameters: further parameters by node; they override all of the above.
        model_covariance: also write the covariance of the filter's model.
        smooth: smooth the whole recording, with more lag than a live graph may have.
    """

    sensors: tuple[str, ...] = ()
    reference: str = ""
    filter_name: str = DEFAULT_FILTER
    convention: str = graph.AUTO
    calibration_file: Path | None = None
    imus: tuple[str, ...] = ()
    more: Mapping[str, Value] = field(default_factory=dict)
    parameters: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    model_covariance: bool = False
    smooth: bool = False

    def options(self) -> Options:
        """Options of the graph."""
        given: dict[str, Value] = {
            "sensors": self.sensors or (() if self.other_sources else graph.DEFAULT_SENSORS),
            "filter": self.filter_name,
            "convention": self.convention,
            "imus": self.imus,
            "calibration": "" if self.calibration_file is None else str(self.calibration_file),
            "external": True,
        }
        return options_of(**given, **self.more)

    @property
    def other_sources(self) -> bool:
        """Whether the graph has sensors beside those of the option ``sensors``."""
        return bool(self.imus) or any(OPTIONS[name].source and bool(value) for name, value in self.more.items())

    def stages(self) -> tuple[forked.StageSettings, ...]:
        """The stages with all their parameters, in the order in which messages go through them.

        Raises:
            BodyTrackingError: inconsistent settings.
        """
        found = []
        for spec in stage_hosts(nodes_for(self.options())):
            own, table = self.parameters.get(spec.name, {}), stage_class(spec.executable).PARAMETERS
            given = {**spec.defaults, **OFFLINE, **spec.parameters, "reference": self.reference, **own}
            known = {item.name for item in table}
            values = {**own, **check_all(table, {key: value for key, value in given.items() if key in known})}
            if self.smooth and spec.executable == "skeleton_filter":
                values["lag"] = WHOLE_LAG
            found.append(forked.StageSettings(spec.name, spec.executable, values))
        return tuple(found)


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Result of a replay.

    Attributes:
        frames: number of joint angle messages.
        filter_name: the filter that made the angles; empty if none runs, as in a graph of markers alone.
        recorded_filters: the filters of the graph that was recorded, by its diagnostics; its angles are not read.
        recording_s: length of the recording by its log times.
        elapsed_s: computing time.
        counters: of events and unusable messages.
        warnings: missing or damaged parts of the bag, and what nodes would report at its end.
        unused: sources in the bag that no option takes, after these options.
    """

    frames: int
    filter_name: str
    recorded_filters: tuple[str, ...]
    recording_s: float
    elapsed_s: float
    counters: Mapping[str, int]
    warnings: tuple[str, ...]
    unused: str = ""


def sensor_topics(bag: BagReader, wanted: Sequence[str] = (), advice: str = "") -> dict[str, str]:
    """The skeleton topics of a bag's sensors.

    Args:
        bag: open.
        wanted: sensor names; all in the bag when empty.
        advice: said where the bag has no sensor at all.

    Returns:
        Sensor name by topic.

    Raises:
        ReplayError: a wanted sensor or any sensor at all is missing, or its topic has another type.
    """
    there = graph.sensors_among(bag.topics)
    names = tuple(wanted) or there
    hint = f"; {advice}" if advice and not there else ""
    if not names:
        raise ReplayError(f"{bag.path}: no topic /<sensor>/skeleton; {graph.listed(bag.topics)}{hint}")
    try:
        graph.check_skeletons(names, bag.topics)
    except graph.GraphError as error:
        raise ReplayError(f"{bag.path}: {error}{hint}") from error
    for name in names:
        kind = bag.topics[graph.skeleton_topic(name)].type_name
        if kind != POINT_CLOUD:
            raise ReplayError(f"{bag.path}: {graph.skeleton_topic(name)} holds {kind}, expected {POINT_CLOUD}")
    return {graph.skeleton_topic(name): name for name in names}


def inputs(settings: ReplaySettings, bag: BagReader) -> tuple[ReplaySettings, dict[str, str], tuple[str, ...]]:
    """The settings with the sensors of a bag, these as of :func:`sensor_topics`, and the topics of all other inputs.

    Raises:
        ReplayError: the bag lacks an input.
        BodyTrackingError: a folder that the settings name is missing or invalid.
    """
    advice = advice_for({name: each.type_name for name, each in bag.topics.items()})
    topics = {} if _without(settings, bag) else sensor_topics(bag, settings.sensors, advice)
    settings = replace(settings, sensors=tuple(topics.values()))
    try:
        return settings, topics, played(settings.options(), bag.topics)
    except graph.GraphError as error:
        raise ReplayError(f"{bag.path}: {error}") from error


def skeletons_of(
    bag: BagReader, topics: Mapping[str, str], counters: Counter[str]
) -> Iterator[tuple[str, Skeleton, int, bytes]]:
    """Each sensor's frames in log-time order: sensor, the body nearest to it, log time, and the message.

    A selected body is kept while it is tracked. Unusable frames are counted and skipped, those with several bodies
    counted.
    """
    subjects = {sensor: SubjectSelector() for sensor in topics.values()}
    last: dict[str, int] = {}
    for raw in bag.messages(topics.keys()):
        sensor = topics[raw.topic]
        try:
            skeletons = Skeletons().decode(raw.cdr, BAG_WIRE)
        except BodyTrackingError:
            counters[f"malformed {raw.topic}"] += 1
            continue
        stamp = skeletons[0].stamp_ns
        if jumped_back(stamp, last.get(sensor)):
            subjects[sensor].reset()
        last[sensor] = stamp
        if len(skeletons) > 1:
            counters["frames with several bodies"] += 1
        subject = subjects[sensor].pick(skeletons)
        if subject is None:
            counters["frames without a body"] += 1
        else:
            yield sensor, subject, raw.log_time_ns, raw.cdr


def replay(bag_path: Path, out: Path, settings: ReplaySettings, *, overwrite: bool = False) -> ReplayReport:
    """Run the graph over a bag and write its output, with the sensors' messages and the ground truth.

    Args:
        bag_path: a rosbag2 folder or an mcap file.
        out: the bag to write.
        settings: of the graph.
        overwrite: replace an existing ``out``.

    Raises:
        ReplayError: no skeletons in the bag, or no images, balls or points of markers; ``out`` is the bag itself; the
            file of the person is missing.
        BagError: the bag cannot be read, or ``out`` cannot be written.
        CalibrationError: the calibration file belongs to other sensors.
    """
    began = time.perf_counter()
    if bag_path.resolve() in (out.resolve(), *out.resolve().glob("*.mcap")):
        raise ReplayError(f"{out}: is the recording itself; give another folder")
    with RigReader(bag_path) as bag:
        settings, topics, sources = inputs(settings, bag)
        truth = [topic for topic in bag.topics if topic.startswith("/ground_truth/")]
        settings = replace(settings, more={**settings.more, "played": sources})
        others = unused({name: each.type_name for name, each in bag.topics.items()}, settings.options())
        kept = tuple(dict.fromkeys((*topics, *truth, *sources)))
        passed = {topic: (bag.topics[topic].type_name, bag.topics[topic].qos) for topic in kept}
        notes = [unused_imus(settings.options())]
        if settings.calibration_file is not None:
            lack = lacking(load(settings.calibration_file), settings.sensors)  # raises if it is missing or invalid
            notes += [f"{settings.calibration_file}{lack}"] if lack else []
        person = str(settings.more.get("person") or "")
        if person and not Path(person).expanduser().exists():  # up makes it, replay reads it only
            raise ReplayError(f"{person}: no such file; body_tracking mesh personalise makes it")
        all_stages = settings.stages()
        # the stages may raise: construct them before `out` is replaced
        first = {each.node: each.make() for each in all_stages if not forked.is_second(each.executable)}
        stages = [*first.values()]
        written_by_us = {
            p.topic: (p.codec.type_name, p.qos) for stage in stages for p in stage.outputs if not p.optional
        }
        job = forked.Job(all_stages, out, {**passed, **written_by_us}, overwrite, settings.model_covariance)
        downstream = forked.start_downstream(job)
        try:
            runner = OfflineRunner(stages, BAG_WIRE, downstream.take)
            progress = Progress(bag.start_ns, bag.end_ns)
            started = False
            recorded_filters: dict[str, None] = {}
            for raw in bag.messages((*kept, graph.DIAGNOSTICS_TOPIC)):
                if raw.topic == graph.DIAGNOSTICS_TOPIC:
                    recorded_filters.update(dict.fromkeys(_filters_in(raw.cdr)))
                    continue
                if not started and raw.topic in (topics or sources):
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
        counters = Counter(runner.counters)
        for node, stage in first.items():
            counters.update({f"{node} {name}": count for name, count in stage.counters.items()})
        counters |= Counter(written.counters)  # both halves may have counted the same message
        problems = [*dict.fromkeys((*forked.problems_of(first, runner, bag.end_ns), *written.problems))]
        problems += _left_out(counters)
        if not written.frames:
            given = ", ".join(settings.sensors or sources)
            said = "; ".join(problems) or _listed(+counters)
            raise ReplayError(f"{bag_path}: no frame of {given} came through ({said})")
        return ReplayReport(
            written.frames,
            next((str(each.values["filter"]) for each in all_stages if each.executable == "skeleton_filter"), ""),
            tuple(recorded_filters),
            (bag.end_ns - bag.start_ns) / NANOSECONDS,
            time.perf_counter() - began,
            {name: count for name, count in sorted(counters.items()) if count},
            (*bag.warnings, *filter(None, notes), *problems),
            others,
        )


def _without(settings: ReplaySettings, bag: BagReader) -> bool:
    """Whether no skeletons of sensors are used.

    Raises:
        ReplayError: neither skeletons nor other sources are selected.
    """
    if settings.sensors == (graph.NO_SENSORS,):
        if not settings.other_sources:
            raise ReplayError(f"{bag.path}: sensors none, and no images, markers or inertial sensors are asked for")
        return True
    if settings.sensors or not settings.other_sources:
        return False
    return bool(settings.options()["computed"]) or not graph.sensors_among(bag.topics)


def _left_out(counters: Mapping[str, int]) -> list[str]:
    """Warnings of measurements that a driver repeated, or that were recorded too late for ``ekf``, if many."""
    repeated = {name.partition("repeated ")[2]: count for name, count in counters.items() if "repeated " in name}
    found = [f"{count} repeated {name} were not used" for name, count in sorted(repeated.items())]
    late = counters.get("filter too_late", 0)
    if late <= NOTABLE_LATE * sum(counters.get(f"filter {name}", 0) for name in ("frames", "orientations")):
        return found
    return [*found, f"skeleton_filter: {late} measurements came more than 0.2 s late and were not used"]


def _filters_in(diagnostics: bytes) -> list[str]:
    """The filters whose nodes report in a message of ``/diagnostics``; none if it is malformed."""
    try:
        found = statuses(deserialize(DIAGNOSTICS, diagnostics))
    except BodyTrackingError:
        return []
    texts = (each.text for each in found if each.node.rpartition("/")[2] == "skeleton_filter")
    return [name for text in texts if (name := text.partition(" ")[0]) in ROLES]


def _listed(counters: Mapping[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in sorted(counters.items())) or "nothing at all"


# --- the command

_OFFLINE_OPTIONS: Final = tuple(option.name for option in OPTIONS.values() if option.offline)
_NAMED: Final = ("sensors", "filter", "convention", "calibration", "imus", "params_file", "model_covariance")
"""Options that are attributes of :class:`ReplaySettings`."""


def settings_from(args: argparse.Namespace) -> ReplaySettings:
    """The settings of a command line."""
    options: dict[str, Any] = {**with_file(options_of(**{**options_from(args), "external": True}), args.params_file)}
    with BagReader(args.bag) as bag:
        wanted = options["sensors"] if args.sensors or options["computed"] else ()
        options["with_covariances"] = with_covariances(bag, wanted)
    specs = stage_hosts(nodes_for(options))
    left = ("use_sim_time", "sensors", "calibration_file", *OFFLINE)
    parameters = {
        node: {name: value for name, value in values.items() if name not in left}
        for node, values in parameters_for(specs, args.params_file, absent=all_nodes_for(options)).items()
    }
    for node in parameters.keys() & {"skeleton_filter", "joint_angles"}:
        parameters[node]["body"] = args.body
    if args.reference:
        for values in parameters.values():
            values["reference"] = args.reference
    sensors: tuple[str, ...] = ()
    if args.sensors:
        sensors = tuple(each for each in options["sensors"] if each not in options["computed"]) or (graph.NO_SENSORS,)
    more = ("filter_input", "angles_input", *(name for name in _OFFLINE_OPTIONS if name not in _NAMED))
    return ReplaySettings(
        sensors,
        args.reference or "",
        options["filter"] or DEFAULT_FILTER,
        options["convention"] or graph.AUTO,
        args.calibration,
        options["imus"],
        {name: options[name] for name in more},
        parameters,
        args.model_covariance,
        args.smooth,
    )


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking replay``."""
    command = subparsers.add_parser(
        "replay",
        description="Calibrates, fuses, filters and computes joint angles offline, with the same results as the live "
        "graph, and writes every topic that the graph would publish into a new bag.",
        epilog="Example: 'body_tracking replay BAG -o angles --filter ekf', then 'body_tracking show angles'.",
    )
    command.add_argument(
        "bag",
        type=Path,
        metavar="BAG",
        help="rosbag2 folder or .mcap file with /<sensor>/skeleton topics, or with images, balls or points of markers",
    )
    command.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    command.add_argument("--reference", metavar="A", help="the sensor that defines world (default: the first)")
    command.add_argument(
        "--body", default=graph.DEFAULT_BODY, help="id of the person, if only one is tracked (default: %(default)s)"
    )
    add_options(
        command,
        *_OFFLINE_OPTIONS,
        filter=f"default: {DEFAULT_FILTER}, or ekf where all sensors are colour cameras or inertial ones",
        convention="convention of the joint angles (default: that of the filter)",
        sensors="the sensors, the reference first; none: no skeletons, markers or depth alone (default: all in the "
        "bag)",
        calibration="start from this calibration (YAML)",
        model_covariance="with ekf: also write /filtered/model_covariance, which is most of such a bag",
    )
    command.add_argument(
        "--smooth",
        action="store_true",
        help="correct each frame by all that come after it, as by --lag with a lag of seconds",
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing OUT")
    command.add_argument("--json", action="store_true", help="print the report as JSON")
    command.add_argument("-v", "--verbose", action="store_true", help="also print what was left out or noted")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    check_new_bag(args.output, overwrite=args.overwrite)
    report = replay(args.bag, args.output, settings_from(args), overwrite=args.overwrite)
    if args.json:
        print(json.dumps({"bag": str(args.bag), "output": str(args.output), **asdict(report)}, indent=2))
        return 0
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    speed = report.recording_s / max(report.elapsed_s, 1e-9)
    print(
        f"{report.frames} frames of joint angles from {report.recording_s:.1f} s of recording in "
        f"{report.elapsed_s:.1f} s ({speed:.{0 if speed >= 10.0 else 1}f} times real time)"
    )
    if report.filter_name:
        others = f"; the recorded angles (filter {', '.join(report.recorded_filters)}) are not read"
        print(f"filter: {report.filter_name}{others if report.recorded_filters else ''}")
    if report.unused:
        print(f"also in the recording, not taken without an option: {report.unused}")
    for line in summary(args.output):
        print(line)
    if args.verbose:
        print(f"left out or noted on the way: {_listed(report.counters)}")
    elif report.counters:
        print(f"replay -v prints {len(report.counters)} counters of what was used, left out or noted")
    print(f"written to {args.output}")
    return 0
