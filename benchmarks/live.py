"""Live benchmarks: the graph's nodes as processes, and a node that replaces the sensors and times received messages.

Import it before rclpy: it selects a random ROS domain that is limited to this machine.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))

import numpy as np
import psutil
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from sensor_msgs.msg import JointState

from body_tracking.calibration.storage import save
from body_tracking.core.clocks import ClockModel
from body_tracking.core.parameters import SECTION, to_ros
from body_tracking.core.qos import RELIABLE
from body_tracking.core.sensor_poses import CalibrationResult, SensorPose, SensorQuality
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.diagnostics import NodeStatus, statuses
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import Options
from body_tracking.ros.bag_topics import to_profile
from body_tracking.systems import nodes_for, options_of

STAMP = struct.Struct("<iI")
"""Stamp of a message, behind the encapsulation (4 bytes): every message here begins with its header."""

Event = tuple[float, str, bytearray]
"""Seconds, topic, and message as CDR. The stamp is set at sending: a driver is cheap, and so must this be."""

# --- processes


def calibrated(
    file: Path,
    poses: Mapping[str, SensorPose],
    clocks: Mapping[str, ClockModel] | None = None,
    drift_ppm: float = np.inf,
) -> str:
    """Write the calibration of sensors at these poses, with these clocks (default: one clock); returns its path.

    ``drift_ppm``: standard deviation of the clocks' drifts.
    """
    own = {name: ClockModel() for name in poses} | dict(clocks or {})
    stated = {name: replace(clock, stddev=0.002, drift_stddev_ppm=drift_ppm) for name, clock in own.items()}
    quality = {name: SensorQuality(0.03, 0.005, 0.01, 500) for name in poses}
    save(CalibrationResult(next(iter(poses)), dict(poses), stated, quality), file)
    return str(file)


def node_commands(folder: Path, options: Options, level: str = "WARN") -> list[list[str]]:
    """Command lines of a graph's nodes without its Kinects, which the benchmark replaces.

    Args:
        folder: for files with the nodes' parameters.
        options: of the graph.
        level: of logging.
    """
    lines = []
    for spec in nodes_for(options):
        if spec.executable == "kinect_skeleton":
            continue
        values = {name: to_ros(value) for name, value in {**spec.defaults, **spec.parameters}.items()}
        file = parameters_file(folder / f"{spec.name}.parameters.yaml", {spec.full_name: values})
        line = ["-m", "body_tracking.nodes", spec.executable, "--ros-args", "-r", f"__node:={spec.name}"]
        lines.append([sys.executable, *line, "--log-level", level, "--params-file", file])
    return lines


def parameters_file(file: Path, values: Mapping[str, Mapping[str, Any]]) -> str:
    """Write parameters by name of node; returns the path."""
    sections = {name: {SECTION: dict(each)} for name, each in values.items()}
    file.write_text(yaml.safe_dump(sections), encoding="utf-8")
    return str(file)


@contextlib.contextmanager
def processes(
    lines: Iterable[Sequence[str]], log: Path | None = None, patience: float = 30.0, **options: Any
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A process for each command line. It ends with this process; at the end of the context all get SIGINT.

    Args:
        lines: the commands.
        log: file for all output; None for this process's own output.
        patience: seconds until processes that do not end are killed.
        options: of ``Popen``.
    """
    environment = {**os.environ, graph.PARENT_VARIABLE: str(os.getpid())}
    running: list[subprocess.Popen[bytes]] = []
    with contextlib.ExitStack() as stack:
        output = {"stdout": stack.enter_context(log.open("wb")), "stderr": subprocess.STDOUT} if log else {}
        given: dict[str, Any] = {"stdin": subprocess.DEVNULL, "env": environment, "start_new_session": True}
        try:
            running.extend(subprocess.Popen(line, **(given | output | options)) for line in lines)
            yield running
        finally:
            for process in running:
                process.send_signal(signal.SIGINT)
            for process in running:
                try:
                    process.wait(patience)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def up_command(*words: object) -> list[str]:
    """Command line of ``body_tracking up``, which ends its nodes itself."""
    return [sys.executable, "-m", "body_tracking.cli", "up", *(str(word) for word in words)]


def wait(
    what: str,
    ready: Callable[[], bool],
    running: Iterable[subprocess.Popen[bytes]] = (),
    seconds: float = 60.0,
    log: Path | None = None,
) -> None:
    """Wait until ``ready``.

    Args:
        what: name of the awaited thing, for the error.
        ready: whether it is up.
        running: processes that must not end meanwhile.
        seconds: time limit.
        log: file whose end the error quotes.

    Raises:
        SystemExit: time is up, or a process ended.
    """
    end, running = time.monotonic() + seconds, list(running)
    while not ready():
        if time.monotonic() > end or any(process.poll() is not None for process in running):
            raise SystemExit(f"{what} did not come up\n{log.read_text()[-2000:] if log else ''}")
        time.sleep(0.1)


def nodes_of(pid: int) -> dict[str, psutil.Process]:
    """The node processes started by ``body_tracking up``, by name."""
    found = {}
    for process in psutil.Process(pid).children():
        with contextlib.suppress(psutil.Error):
            words = process.cmdline()
            names = [word.removeprefix("__node:=") for word in words if word.startswith("__node:=")]
            if names:
                found[names[0]] = process
    return found


def cpu_seconds(process: psutil.Process, children: bool = False) -> float:
    """Processor time, user and system, seconds; with that of its children if requested."""
    counted = (process, *(process.children(recursive=True) if children else ()))
    return float(sum(sum(each.cpu_times()[:2]) for each in counted))


# --- the node of a benchmark


class Ear:
    """Subscriber that notes the receipt of messages, and keeps the latest diagnostics.

    Attributes:
        node: of this process.
        received: by name and stamp (ns), the time of receipt (ns) by ``now``.
        topics: by name.
        statuses: by node, the wall time in s and its last diagnostics.
    """

    def __init__(self, name: str, now: Callable[[], int] = time.perf_counter_ns) -> None:
        rclpy.init()
        self.node = rclpy.create_node(name)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.received: dict[str, dict[int, int]] = {}
        self.topics: dict[str, str] = {}
        self.statuses: dict[str, tuple[float, NodeStatus]] = {}
        self._now = now
        self._thread: threading.Thread | None = None

    def time(self, name: str, topic: str, kind: type = JointState, qos: Any = RELIABLE) -> None:
        """Note the first receipt of each stamp on a topic."""
        received = self.received.setdefault(name, {})
        self.topics[name] = topic

        def on_message(cdr: bytes) -> None:
            seconds, rest = STAMP.unpack_from(cdr, 4)
            received.setdefault(seconds * NANOSECONDS + rest, self._now())

        self.node.create_subscription(kind, topic, on_message, to_profile(qos), raw=True)

    def hear_diagnostics(self) -> None:
        """Subscribe to the diagnostics."""
        self.node.create_subscription(
            DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self.on_diagnostics, to_profile(RELIABLE)
        )

    def on_diagnostics(self, message: DiagnosticArray, _info: Any = None) -> None:
        """Keep the statuses of one message."""
        for status in statuses(message):
            self.statuses[status.node] = time.time(), status

    def values(self, node: str) -> Mapping[str, str]:
        """Values of a node's last diagnostics."""
        return dict(self.statuses[node][1].values) if node in self.statuses else {}

    def number(self, node: str, key: str) -> float:
        """One value of a node's last diagnostics; 0 if absent."""
        return float(self.values(node).get(key, 0.0))

    def spin(self) -> None:
        """Spin in a thread, until :meth:`close`."""

        def run() -> None:
            with contextlib.suppress(ExternalShutdownException):
                self.executor.spin()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Shut rclpy down, and wait for the thread: one that Python ends within rclpy aborts the process."""
        rclpy.try_shutdown()
        if self._thread is not None:
            self._thread.join(10.0)


class Bench(Ear):
    """Also publishes the sensors' messages in real time.

    Attributes:
        sent: by name and stamp (ns), the time just before publishing (ns).
        start_ns: time of second 0.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.sent: dict[str, dict[int, int]] = {}
        self.start_ns = 0
        self._outputs: dict[str, Any] = {}

    def publisher(self, topic: str, kind: type, qos: Any = graph.SKELETON) -> None:
        """Create a publisher, best effort by default."""
        self._outputs[topic] = self.node.create_publisher(kind, topic, to_profile(qos))

    def connected(self, listeners: Mapping[str, int]) -> bool:
        """Whether each topic has at least this number of subscribers."""
        return all(self.node.count_subscribers(topic) >= count for topic, count in listeners.items())

    def publish(self, events: Iterable[Event], counted: Mapping[str, str], since: float = 0.0) -> list[float]:
        """Publish each event at its time, with its time as the stamp.

        Args:
            events: in the order of time.
            counted: by topic, the name under which the time of sending is noted.
            since: seconds before which nothing is noted.

        Returns:
            Delay of each sending, milliseconds.
        """
        self.start_ns, late = time.perf_counter_ns() + NANOSECONDS // 10, []
        for at, topic, message in events:
            due = self.start_ns + round(at * NANOSECONDS)
            STAMP.pack_into(message, 4, *divmod(due, NANOSECONDS))
            time.sleep(max(0, due - time.perf_counter_ns()) / NANOSECONDS)
            now = time.perf_counter_ns()
            late.append((now - due) / 1e6)
            if at >= since and topic in counted:
                self.sent.setdefault(counted[topic], {})[due] = now
            self._outputs[topic].publish(bytes(message))
        return late

    def delays_ms(self, name: str, begin_ns: float = 0, end_ns: float = np.inf) -> tuple[FloatArray, int]:
        """(n,) delays of received messages sent between two times, in the order of sending, ms; the number of lost."""
        sent = [(stamp, at) for stamp, at in sorted(self.sent.get(name, {}).items()) if begin_ns <= at < end_ns]
        received = self.received[name]
        delays = [received[stamp] - at for stamp, at in sent if stamp in received]
        return np.array(delays) / 1e6, len(sent) - len(delays)


def percentiles(delays: FloatArray, what: str, late: int = 99) -> dict[str, float]:
    """Median and a late percentile, ms.

    Raises:
        SystemExit: ``delays`` is empty.
    """
    if not len(delays):
        raise SystemExit(f"nothing came through {what}")
    median, last = np.percentile(delays, [50, late])
    return {"median_ms": round(float(median), 3), f"p{late}_ms": round(float(last), 3), "frames": len(delays)}


@contextlib.contextmanager
def graph_of(
    bench: Bench,
    listeners: Mapping[str, int],
    *,
    poses: Mapping[str, SensorPose] | None = None,
    further: Iterable[Sequence[str]] = (),
    level: str = "WARN",
    **options: Any,
) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The nodes of a graph as processes, once they have subscribed; then the bench spins, and closes at the end.

    Args:
        bench: publishes the sensors' messages.
        listeners: by topic, the number of subscribers to wait for.
        poses: of the sensors, for a calibration.
        further: more command lines.
        level: of the nodes' logging.
        options: of the graph.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.callback(bench.close)
        if poses is not None:
            options["calibration"] = calibrated(folder / "calibration.yaml", poses)
        lines = [*node_commands(folder, options_of(**options), level), *further]
        running = stack.enter_context(processes(lines))
        outputs = [bench.topics[name] for name in bench.received]
        wait("the nodes", lambda: bench.connected(listeners), running, 120.0)
        wait("their output", lambda: any(map(bench.node.count_publishers, outputs)), running)
        time.sleep(1.0)
        bench.spin()
        yield running


class Stream:
    """Skeletons of one sensor by time.

    Positions are interpolated between two frames: with positions from before or after the stamps, the calibration would
    estimate a wrong clock.

    Args:
        frames: (n,) the bodies in each frame.
        clock: of the sensor.
        span: first and last time seen by all sensors, ns by the reference's clock, played forwards, then backwards,
            so that nobody jumps.
    """

    def __init__(self, frames: Sequence[Sequence[Skeleton]], clock: ClockModel, span: tuple[int, int]) -> None:
        self._frames = frames
        self._times = np.array([clock.to_reference(skeletons[0].stamp_ns) for skeletons in frames])
        self._span = span

    def at(self, seconds: float) -> bytearray:
        """The message for a time since the start, in seconds."""
        first, length = self._span[0], self._span[1] - self._span[0]
        way = round(seconds * NANOSECONDS) % (2 * length)
        at = first + min(way, 2 * length - way)
        after = int(np.clip(np.searchsorted(self._times, at), 1, len(self._times) - 1))
        share = (at - self._times[after - 1]) / (self._times[after] - self._times[after - 1])
        earlier, later = self._frames[after - 1], self._frames[after]
        nearest = later if share > 0.5 else earlier
        if [each.body for each in earlier] != [each.body for each in later]:
            return bytearray(encode_skeletons(nearest))
        between = [
            replace(each, positions=(1.0 - share) * a.positions + share * b.positions)
            for each, a, b in zip(nearest, earlier, later, strict=True)
        ]
        return bytearray(encode_skeletons(between))


def streams(frames: Mapping[str, Sequence[Sequence[Skeleton]]], clocks: Mapping[str, ClockModel]) -> dict[str, Stream]:
    """The stream of each sensor over the time seen by all of them."""
    ends = [[clocks[name].to_reference(own[index][0].stamp_ns) for name, own in frames.items()] for index in (0, -1)]
    span = (max(ends[0]), min(ends[1]))
    return {name: Stream(own, clocks[name], span) for name, own in frames.items()}
