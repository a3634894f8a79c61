"""``body_tracking up``: starts and supervises the graph's nodes as processes, and shows a status line.

Over 500 lines: the supervisor and its command belong together.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import TYPE_CHECKING, NoReturn, TextIO

import yaml

from body_tracking.core import names
from body_tracking.core.arguments import Parser
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import SECTION, Value, to_ros
from body_tracking.core.signals import signals_held
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.node_parameters import parameters_for
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import names_in
from body_tracking.pipeline.system import NodeSpec, Options
from body_tracking.recording.finding import advice_for, unused, unused_imus, with_covariances
from body_tracking.recording.rig import RigReader
from body_tracking.robot.system import convention_of
from body_tracking.ros import dds
from body_tracking.ros.doctor import cause
from body_tracking.systems import (
    FLOW,
    OPTIONS,
    add_options,
    all_nodes_for,
    angles_topics,
    found_sensors,
    is_source,
    names_sensors,
    nodes_for,
    options_from,
    options_of,
    played,
    subscribers,
    with_file,
)

if TYPE_CHECKING:
    from body_tracking.ros.graph_monitor import GraphMonitor

BACKOFFS = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds before a node is restarted, by the number of deaths in a row soon after a start."""

SETTLED = 10.0
"""A node that has run for this long, seconds, is restarted at once."""

IN_FLIGHT = 0.3
"""Angles received within this time after a restart, seconds, may be from before the node's death."""

LISTENERS_TIMEOUT = 30.0
"""Seconds after which a source starts even if subscribers are missing."""

START_DELAY = 5.0
"""Seconds from the start until recordings in place of sensors begin, in step; by then every node runs."""

CANNOT_START = 2
"""Exit code of a node that cannot start; its last line of output states the reason."""

NOTHING_RECORDED = 30.0
"""Seconds from the start within which a graph that fails leaves no recording, since the next try would be refused."""

STOP_TIMEOUT = 12.0
"""Seconds for a node to end after a signal."""

FINISH_TIMEOUT = 60.0
"""Seconds for a node to handle its remaining messages after the end of a bag."""

ANSWER_DELAY = 0.3
"""Seconds for the answer to the caller of the service that ends the graph."""

LOOK_PERIOD = 0.25
"""Seconds between two looks at the graph, for the status line and for another ``up``."""

LINE_PERIOD = 5.0
"""Seconds between status lines where stdout is no terminal."""

_ROS_LOG = re.compile(r"^(?:\x1b\[[0-9;]*m)?\[(DEBUG|INFO|WARN|ERROR|FATAL)\]")
_FAST_DDS = re.compile(r"RTPS_|\[[A-Z_]+ (?:Error|Warning)\]")


class UpError(BodyTrackingError):
    """The graph cannot be started with these options."""


class NoSourceError(UpError):
    """Raised when the options take nothing from a recording."""


# --- options and parameters


def options_for(args: argparse.Namespace, found: Mapping[str, Value] = MappingProxyType({})) -> Options:
    """The graph's options from a command line of ``up`` or of ``ros2 launch``.

    Args:
        args: the command line.
        found: further options, for sensors that publish.

    Raises:
        BodyTrackingError: the bag cannot be read or lacks the sensors, the recording exists already, the robot's
            mapping is invalid or for angles of another convention.
    """
    given = {**options_from(args), **found}
    topics: frozenset[str] = frozenset()
    if args.record is not None and args.record.exists() and (not args.record.is_dir() or any(args.record.iterdir())):
        raise UpError(f"{args.record}: exists already; a recording needs a new folder")
    if args.external and args.bag is not None:
        raise UpError("external: cannot be combined with a bag, which is played in place of the sensors")
    if args.bag is None:
        for name in ("rate", "loop", "start"):
            if getattr(args, name) != OPTIONS[name].default:
                raise UpError(f"{name}: needs a bag")
    else:
        if not 0.01 <= args.rate <= 100.0:
            raise UpError(f"rate {args.rate:g}: expected 0.01 to 100")
        with RigReader(args.bag) as reader:
            topics = frozenset(reader.topics)
            types = {name: each.type_name for name, each in reader.topics.items()}
            there = graph.sensors_among(reader.topics)
            stated = with_covariances(reader)
            duration = (reader.end_ns - reader.start_ns) / NANOSECONDS
        if args.start and not 0.0 < args.start < duration:
            raise UpError(f"start {args.start:g}: expected 0 to {duration:.1f}, the seconds of the bag")
        if not there and not names_sensors({**given, **_in_file(args.params_file)}):
            given |= found_sensors(types)
        if not options_of(**given)["computed"]:
            given.setdefault("sensors", there)
    if args.robot is not None:
        given["convention"] = convention_of(args.robot, args.convention or "")
    given["namespace"] = names.check_namespace(args.namespace or "/")
    options = with_file(options_of(**given), args.params_file)
    if options["robot"] and options["lag"]:
        raise UpError("lag: a robot must not follow angles that come late")
    if args.bag is not None:
        sensors = names_in(options["sensors"])
        options = {**options, "with_covariances": tuple(each for each in stated if each in sensors)}
        try:
            options = {**options, "played": played(options, topics)}
        except graph.GraphError as error:
            raise UpError(f"{args.bag}: {error}") from error
        if not options["played"]:
            advice = advice_for(types)
            what = f"no topic /<sensor>/skeleton; {graph.listed(topics)}"
            raise NoSourceError(f"{args.bag}: {what}{f'; {advice}' if advice else ''}")
    return options


def _in_file(file: Path | None) -> dict[str, Value]:
    """The options that a parameters file sets."""
    return {name: value for name, value in with_file(options_of(), file).items() if value != OPTIONS[name].default}


def all_parameters(
    options: Options,
    specs: Sequence[NodeSpec],
    file: Path | None,
    defaults: Mapping[str, Mapping[str, Value]] | None = None,
) -> dict[str, dict[str, Value]]:
    """The parameters of every node; the file may have sections for every node that the graph could have.

    Args:
        options: the graph.
        specs: its nodes.
        file: a ROS parameters file, or None.
        defaults: more defaults by node name.

    Raises:
        ParameterError: the file is invalid, has a section for an unknown node, unknown names or values that are not
            allowed.
        UpError: a sensor node has nothing to read: neither a bag nor the file names a source.
    """
    result = parameters_for(specs, file, defaults, all_nodes_for(options))
    for spec in specs:
        given = result[spec.name]
        without_backend = given.get("backend") in (None, "recording") and not given.get("file")
        if spec.executable == "kinect_skeleton" and without_backend:
            raise UpError(
                f"{spec.name}: nothing to read: give a bag, a parameters file with this sensor's backend or file, or "
                "--external if another program publishes its skeletons"
            )
        if spec.executable == "bag_player":
            count = subscribers(specs, result)
            waited = (f"{topic}:{count[topic]}" for topic in names_in(given["topics"]) if topic in count)
            given["wait_for_subscribers"] = tuple(waited)
    return result


# --- one process


@dataclass(slots=True)
class Child:
    """A node's process.

    Attributes:
        spec: of the node.
        parameters: of the node.
        process: None while it is not running.
        started: steady time of its last start, seconds.
        restarts: number of restarts.
        deaths: number of deaths in a row soon after a start.
        died: steady time of its last death, seconds, until the console has reported that angles come again; else None.
        due: steady time of the next start; None while it runs, or when it must not run any more.
        done: it has ended on purpose.
    """

    spec: NodeSpec
    parameters: dict[str, Value]
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    restarts: int = 0
    deaths: int = 0
    died: float | None = None
    due: float | None = field(default_factory=time.monotonic)
    done: bool = False
    reader: threading.Thread | None = None
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=3))


class Console:
    """A status at the bottom of a terminal, and lines above it; plain lines where there is no terminal."""

    def __init__(self) -> None:
        self._terminal = sys.stdout.isatty()
        self._lock = threading.Lock()
        self._status = ""
        self._drawn = 0
        """Lines of the status that are on the terminal."""
        self._last = time.monotonic()

    def line(self, text: str, *, error: bool = False) -> None:
        """Print a line above the status line."""
        with self._lock:
            self._erase()
            self._print(f"{text}\n", sys.stderr if error else sys.stdout)
            self._draw()

    def status(self, text: str) -> None:
        """Replace the status; without a terminal, print it every :data:`LINE_PERIOD`."""
        with self._lock:
            if self._terminal:
                self._status = text
                self._erase()
                self._draw()
            elif time.monotonic() - self._last >= LINE_PERIOD:
                self._last = time.monotonic()
                self._print(f"{text}\n")

    def end(self) -> None:
        """Leave the status line as the last one."""
        with self._lock:
            if self._terminal and self._status:
                self._print("\n")
            self._status, self._drawn = "", 0

    def _draw(self) -> None:
        if self._terminal and self._status:
            lines = textwrap.wrap(self._status, shutil.get_terminal_size().columns - 1, subsequent_indent=" " * 9)
            self._print("\n".join(lines))
            self._drawn = len(lines)

    def _erase(self) -> None:
        if self._drawn:
            up = f"\x1b[{self._drawn - 1}A" if self._drawn > 1 else ""
            self._print(f"\r{up}\x1b[J")
            self._drawn = 0

    @staticmethod
    def _print(text: str, stream: TextIO | None = None) -> None:
        """Print; a full disk does not end the graph, but a pipe without a reader does."""
        try:
            print(text, end="", file=stream, flush=True)
        except BrokenPipeError:
            raise
        except OSError:
            pass


class Supervisor:
    """Starts the nodes, restarts those that die, and ends all of them.

    Args:
        options: the graph.
        specs: its nodes.
        parameters: of each node.
        folder: for logs and parameters.
    """

    def __init__(
        self,
        options: Options,
        specs: Sequence[NodeSpec],
        parameters: Mapping[str, dict[str, Value]],
        folder: Path,
    ) -> None:
        self.options = options
        self.folder = folder
        self.subscribers = subscribers(specs, parameters)
        self.console = Console()
        self.children = [Child(spec, dict(parameters[spec.name])) for spec in specs]
        # Not an Event: its lock may be held by the very wait that a signal interrupts.
        self.stopping = False
        self.interrupted = False
        """A signal was received."""
        self.failure = ""
        self._bag_start_ns = 0
        if options["bag"]:
            with RigReader(str(options["bag"])) as reader:
                self._bag_start_ns = reader.start_ns

    def run(self, monitor: GraphMonitor) -> None:
        """Run until the bag ends, a user ends the graph or a node cannot start (reason: :attr:`failure`).

        A graph that could not start, and gave no angles, leaves no recording. A longer recording stays: another ``up``
        may be discovered when a network comes back.
        """
        handlers = {number: signal.signal(number, self._on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
        handlers[signal.SIGHUP] = signal.signal(signal.SIGHUP, self._on_signal)
        begin = time.monotonic()
        self.console.line(f"starting {', '.join(child.spec.name for child in self.children)}")
        try:
            looked = begin
            while not self.stopping:
                time.sleep(0.05)
                self._supervise(monitor)
                if any(child.done for child in self.children):
                    self._finish()
                    break
                if time.monotonic() - looked < LOOK_PERIOD:
                    continue
                looked = time.monotonic()
                if monitor.has_predecessor():
                    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
                    self.failure = (
                        f"another body_tracking up runs in ROS domain {domain} already, and the two would mix; "
                        "end it, or give this one another ROS_DOMAIN_ID"
                    )
                    break
                if monitor.end_asked:
                    time.sleep(ANSWER_DELAY)
                    break
                self.console.status(monitor.line(self.options, looked - begin, self._restarts()))
        finally:
            ran = time.monotonic() - begin
            self._stop_all()
            for number, handler in handlers.items():
                signal.signal(number, handler)
        self.console.end()
        if self.failure:
            self.console.line(f"body_tracking: {self.failure}", error=True)
            started = monitor.angles and not monitor.has_predecessor()
            if self.options["record"] and ran < NOTHING_RECORDED and not started:
                shutil.rmtree(str(self.options["record"]), ignore_errors=True)
            return
        elapsed = time.monotonic() - begin
        played = any(child.done for child in self.children)
        self.console.line(monitor.summary(self.options, elapsed, self._restarts(), played=played))
        self.console.line(f"logs: {self.folder}")

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.stopping = self.interrupted = True

    def _restarts(self) -> dict[str, int]:
        return {child.spec.name: child.restarts for child in self.children if child.restarts}

    # --- starting

    def _supervise(self, monitor: GraphMonitor) -> None:
        now = time.monotonic()
        for child in self.children:
            if child.process is not None and child.process.poll() is not None:
                self._ended(child, now, monitor)
            if child.died is not None and child.process is not None and monitor.last_angles > child.started + IN_FLIGHT:
                self.console.line(f"{child.spec.name} is back: angles {monitor.last_angles - child.died:.1f} s later")
                child.died = None
            if child.due is not None and now >= child.due and self._may_start(child, now, monitor):
                self._start(child)

    def _may_start(self, child: Child, now: float, monitor: GraphMonitor) -> bool:
        """Whether the node is no source, or its subscribers are there or have timed out."""
        assert child.due is not None
        if not is_source(child.spec):
            return True
        others = [other.spec.name for other in self.children if not is_source(other.spec)]
        return now - child.due > LISTENERS_TIMEOUT or monitor.has_subscribers(self.subscribers, others)

    def _start(self, child: Child) -> None:
        spec = child.spec
        file = self.folder / f"{spec.name}.parameters.yaml"
        values = {name: to_ros(value) for name, value in child.parameters.items()}
        text = yaml.safe_dump({spec.full_name: {SECTION: values}})
        try:
            self.folder.mkdir(parents=True, exist_ok=True)  # somebody may have cleared the logs
            # a full disk would make an unchanged file an empty one
            if not file.exists() or file.read_text(encoding="utf-8") != text:
                file.write_text(text, encoding="utf-8")
        except OSError as error:
            self.console.line(f"{spec.name} cannot be started: {file}: {error.strerror}; trying again", error=True)
            child.due = time.monotonic() + BACKOFFS[-1]
            return
        command = [sys.executable, "-m", "body_tracking.nodes", spec.executable, "--ros-args"]
        command += ["-r", f"__node:={spec.name}", "-r", f"__ns:={spec.namespace}", "--params-file", str(file)]
        for source, target in spec.remappings:
            command += ["-r", f"{source}:={target}"]
        environment = {
            **os.environ,
            graph.PARENT_VARIABLE: str(os.getpid()),
            "ROS_LOG_DIR": str(self.folder / "ros"),
            "RCUTILS_COLORIZED_OUTPUT": "0",
            "PYTHONUNBUFFERED": "1",
        }
        # A group of its own: Ctrl-C in the terminal goes only to the supervisor, which ends the nodes in order.
        with signals_held():  # so that a node ends in order also while it starts
            child.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment,
                process_group=0,
            )
        child.started, child.due = time.monotonic(), None
        child.reader = threading.Thread(target=self._read, args=(child, child.process), daemon=True)
        child.reader.start()

    def _ended(self, child: Child, now: float, monitor: GraphMonitor) -> None:
        assert child.process is not None
        code, child.process = child.process.returncode, None
        if child.reader is not None:
            child.reader.join(timeout=1.0)
        playing = child.spec.executable == "bag_player"
        if playing and (code == 0 or (child.restarts and code == CANNOT_START)):
            child.done = True
            return
        if code == CANNOT_START and child.restarts == 0:
            self.failure = child.last_lines[-1] if child.last_lines else f"{child.spec.name} could not start"
            self.stopping = True
            return
        child.deaths = 1 if now - child.started > SETTLED else child.deaths + 1
        child.due = now + BACKOFFS[min(child.deaths, len(BACKOFFS)) - 1]
        child.restarts += 1
        child.died = now
        if playing and monitor.clock_ns and not self.options["loop"]:  # a looped bag restarts at its given offset
            child.parameters["start_offset"] = max(0.0, (monitor.clock_ns - self._bag_start_ns) / NANOSECONDS)
        how = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
        self.console.line(f"{child.spec.name} died ({how}); starting it again", error=True)

    def _read(self, child: Child, process: subprocess.Popen[bytes]) -> None:
        """Write a node's output to its log, and warnings and errors to the console."""
        assert process.stdout is not None
        file = self.folder / f"{child.spec.name}.log"
        with process.stdout:
            for raw in process.stdout:
                text = raw.decode("utf-8", "replace").rstrip()
                with contextlib.suppress(OSError), file.open("a", encoding="utf-8") as log:  # the disk may be full
                    print(text, file=log)
                level = _ROS_LOG.match(text)
                if not text or (level is not None and level[1] in ("DEBUG", "INFO")) or _FAST_DDS.search(text):
                    continue
                child.last_lines.append(text)
                if not self.stopping and not text.startswith(f"{child.spec.executable}: "):
                    self.console.line(f"{child.spec.name}: {text}", error=True)

    # --- ending

    def _finish(self) -> None:
        """End the nodes from source to angles after the bag, so that each handles all its remaining messages."""
        for executable in FLOW:
            running = [child for child in self.children if child.spec.executable == executable and child.process]
            for child in running:
                assert child.process is not None
                child.process.send_signal(signal.SIGINT)
            end = time.monotonic() + FINISH_TIMEOUT
            while any(child.process is not None and child.process.poll() is None for child in running):
                time.sleep(0.02)
                if self.stopping:
                    return
                if time.monotonic() > end:
                    self.console.line(f"{executable} did not finish in {FINISH_TIMEOUT:g} s", error=True)
                    break

    def _stop_all(self) -> None:
        self.stopping = True
        recorders = [child for child in self.children if child.spec.executable == "bag_recorder"]
        others = [child for child in self.children if child not in recorders]
        for group in (others, recorders):  # the recorder last, so that it records everything
            running = [child.process for child in group if child.process is not None]
            for process in running:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGINT)
            end = time.monotonic() + STOP_TIMEOUT
            for process in running:
                try:
                    process.wait(max(0.0, end - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        for child in self.children:
            if child.reader is not None:
                child.reader.join(timeout=1.0)


# --- command line


def _log_folder(given: Path | None) -> Path:
    """A new folder below ROS's logs (``ROS_LOG_DIR``, ``ROS_HOME/log``, ``~/.ros/log``), else a temporary one."""
    name = f"body_tracking_up_{datetime.now():%Y%m%d_%H%M%S}_{os.getpid()}"
    home = os.environ.get("ROS_HOME")
    base = given or Path(os.environ.get("ROS_LOG_DIR") or (Path(home) if home else Path.home() / ".ros") / "log")
    try:
        folder = base.expanduser() / name
        folder.mkdir(parents=True)
    except OSError as error:
        if given is not None:
            raise UpError(f"{given}: cannot write logs there ({error.strerror})") from error
        return Path(tempfile.mkdtemp(prefix=f"{name}_"))
    return folder


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``up`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "up",
        description="Start the graph as separate processes: the sensors (or a bag in their place), calibration, "
        "fusion, filter, joint angles and, with --record, a recorder. A node that dies is started again. Ends with "
        "Ctrl-C, or when the bag ends.",
        epilog="Without sensors, --bag and --params-file it takes all that publish. A parameters file says what the "
        "node of each sensor reads, under its name <sensor>_skeleton. Examples: 'body_tracking up --viewer' with the "
        "sensors that publish, 'body_tracking up --bag BAG --record NEW_BAG' with a recording.",
    )
    add_options(parser)
    parser.add_argument("--log-dir", type=Path, metavar="FOLDER", help="folder for logs (default: that of ROS)")
    parser.set_defaults(run=run)


def has_sensors(file: Path) -> bool:
    """Whether a parameters file says what the node of a sensor reads."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return False
    return "ros__parameters" in text and "_skeleton:" in text and ("backend:" in text or "file:" in text)


class _Parser(Parser):
    def error(self, message: str) -> NoReturn:
        raise UpError(message.removeprefix("argument --"))  # launch has no dashes


def arguments_from(words: Sequence[str]) -> argparse.Namespace:
    """The parsed arguments of ``body_tracking up``, for another program; UpError for an invalid one."""
    parser: argparse.ArgumentParser = _Parser()
    add_parser(parser.add_subparsers())
    return parser.parse_args(["up", *words])


def no_ros(error: ImportError) -> UpError:
    """The error of a command that needs ROS where ROS cannot be imported."""
    reason, remedy = cause(str(error).splitlines())
    return UpError(f"no ROS here ({reason}): {remedy}")


def _sensors_there(namespace: str, file: Path | None) -> Mapping[str, Value]:
    """The options of a graph that takes the sensors that publish; UpError without any, or without ROS.

    The error says that the parameters ``file`` names none either.
    """
    print("looking for sensors that publish", flush=True)
    dds.stay_on_this_machine()
    dds.prepare()
    try:
        from body_tracking.ros.discovery import look
    except ImportError as error:
        raise no_ros(error) from error
    found = look(namespace).sensors
    if not found:
        others = (
            "on this machine (set ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET to look on others, too)"
            if dds.is_local()
            else "anywhere"
        )
        others += "" if namespace == "/" else f" in the namespace {namespace}"
        said = "" if file is None else f", and {file} has no section <sensor>_skeleton with a backend or a file"
        raise UpError(
            f"no sensor publishes in ROS domain {os.environ.get('ROS_DOMAIN_ID') or '0'} {others}: no skeletons, depth "
            f"images or readings of inertial sensors{said}. Play a recording with --bag BAG, name the sensors with "
            "--params-file FILE, choose on a page with body_tracking view, or see what publishes: body_tracking doctor"
        )
    print(f"found: {' '.join(flags(found))}", flush=True)
    return found


def flags(options: Mapping[str, Value]) -> Iterator[str]:
    """Options as on a command line."""
    for name, value in options.items():
        values = value if isinstance(value, tuple) and name != "sensors" else (value,)
        for each in values:
            text = ",".join(each) or graph.NO_SENSORS if isinstance(each, tuple) else "" if each is True else str(each)
            yield f"--{name.replace('_', '-')} {text}".rstrip()


def without_effect(args: argparse.Namespace, specs: Sequence[NodeSpec]) -> list[str]:
    """The options of a command line that change nothing in a graph of these nodes."""
    found = ["--marker-images"] if args.marker_images and args.bag is not None else []
    if not any(spec.executable == "joint_angles" for spec in specs):  # of markers alone
        found += [f"--{name}" for name in ("filter", "convention", "lag") if getattr(args, name)]
    return found


def run(args: argparse.Namespace) -> int:
    """``body_tracking up``."""
    found: Mapping[str, Value] = {}
    look_for = args.bag is None and not args.external
    if args.params_file is not None:
        look_for &= not has_sensors(args.params_file) and not names_sensors(_in_file(args.params_file))
    if look_for and not names_sensors(options_from(args)):
        options_for(args)  # raises before anything starts
        found = _sensors_there(names.check_namespace(args.namespace or "/"), args.params_file)
    supervisor = supervise(args, found)
    return 2 if supervisor.failure else 0


def supervise(
    args: argparse.Namespace,
    found: Mapping[str, Value] = MappingProxyType({}),
    settings: Mapping[str, Mapping[str, Value]] = MappingProxyType({}),
) -> Supervisor:
    """Run a graph to its end; returns its supervisor.

    Args:
        args: the command line.
        found: further options, for sensors that publish.
        settings: parameters by node name that override all others.

    Raises:
        BodyTrackingError: the graph cannot be started with these options.
    """
    options = options_for(args, found)
    specs = nodes_for(options)
    if any(spec.parameters.get("save") is False for spec in specs):
        print(f"{options['calibration']}: only loaded, as a bag plays", flush=True)
    if note := unused_imus(options):
        print(f"note: {note}", flush=True)
    if unheard := without_effect(args, specs):
        print(f"note: without effect here: {', '.join(unheard)}", flush=True)
    if args.bag is not None:
        with RigReader(args.bag) as reader:
            others = unused({name: each.type_name for name, each in reader.topics.items()}, options)
        if others:
            print(f"also in the recording, not taken without an option: {others}", flush=True)
    try:
        from body_tracking.ros.graph_monitor import GraphMonitor
    except ImportError as error:
        raise no_ros(error) from error
    all_parameters(options, specs, args.params_file)  # raises before a folder is made
    dds.stay_on_this_machine()
    dds.prepare()
    folder = _log_folder(args.log_dir)
    defaults: dict[str, dict[str, Value]] = {
        # from which a restarted calibration node continues
        "calibration": {"calibration_file": str(folder / "calibration.yaml")}
    }
    parameters = all_parameters(options, specs, args.params_file, defaults)
    start = time.time() + START_DELAY
    for spec in specs:
        if spec.executable == "kinect_skeleton" and not parameters[spec.name].get("start_time"):
            parameters[spec.name]["start_time"] = start
        parameters[spec.name] |= settings.get(spec.name, {})
    monitor = GraphMonitor(angles_topics(specs, parameters), str(options["namespace"]))
    supervisor = Supervisor(options, specs, parameters, folder)
    try:
        supervisor.run(monitor)
    finally:
        monitor.close()
    return supervisor
