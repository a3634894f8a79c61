"""Nodes as real processes in a ROS domain of their own, and a node to talk to them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import rclpy
from bench_node import BenchNode
from diagnostic_msgs.msg import DiagnosticArray
from node_process import NodeProcess
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from body_tracking.core.skeleton import Skeleton
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline.graph import PARENT_VARIABLE, skeleton_topic
from body_tracking.recording.rosbag2 import BagReader, deserialize
from domains import domain
from patience import PATIENCE
from spinning import spin_until

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "tpose_wave"
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def environment() -> dict[str, str]:
    """Environment of processes that only communicate with each other."""
    return {
        **os.environ,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(domain()),
        "RCUTILS_COLORIZED_OUTPUT": "0",
    }


def stop(process: subprocess.Popen[Any] | NodeProcess) -> int:
    """End a process as Ctrl-C does; its exit code. One that does not end prints where it is."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(15.0)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # for faulthandler
        process.wait(15.0)
        raise


def words_of(parameters: Mapping[str, object], name: str = "") -> list[str]:
    """The arguments of a node with parameters, under another name where one is given."""
    words = ["-r", f"__node:={name}"] if name else []
    return words + [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]


def refusal(folder: Path, executable: str, *arguments: str) -> str:
    """The one line with which a node refuses to start in a folder."""
    process = NodeProcess(executable, ["--ros-args", *arguments], folder / "refusal.log", environment(), folder)
    assert process.wait(60.0) == 2, process.output()
    (line,) = process.output().splitlines()
    assert line.startswith(f"{executable}: ")
    return line


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def recorded(sensor: str) -> list[Skeleton]:
    """The frames of one sensor of ``BAG``."""
    topic = skeleton_topic(sensor)
    with BagReader(BAG) as reader:
        type_name = reader.topics[topic].type_name
        return [cloud_to_skeletons(deserialize(type_name, raw.cdr))[0] for raw in reader.messages([topic])]


class Running:
    """Processes and a node.

    Attributes:
        diagnostics: by node the values of its last diagnostics, its text as the value of ""; see :meth:`said`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = environment()
        self.processes: dict[str, subprocess.Popen[bytes] | NodeProcess] = {}
        self.diagnostics: dict[str, dict[str, str]] = {}
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=int(self.environment["ROS_DOMAIN_ID"]))
        self.node = BenchNode("bench", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        for name, process in self.processes.items():
            try:
                stop(process)
            except subprocess.TimeoutExpired as error:
                error.add_note(self.log(name))
                raise
        # otherwise this node's publishers would still exist when the domain is used again
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in statuses(message):
            self.diagnostics[status.node] = {**status.values, "": status.text, "level": str(status.level)}

    def said(self, node: str) -> dict[str, str]:
        """A node's last diagnostics; nothing before the first."""
        return self.diagnostics.get(node, {})

    def number(self, node: str, key: str) -> float:
        """A value of a node's last diagnostics; 0 where there is none."""
        return float(self.said(node).get(key, 0))

    def start(
        self, executable: str, name: str = "", file_size_limit: int | None = None, **parameters: object
    ) -> NodeProcess:
        """Start a node, under another name where one is given; its output goes to a file."""
        words = words_of(parameters, name)
        log = self.folder / f"{name or executable}.log"
        process = NodeProcess(executable, ["--ros-args", *words], log, self.environment, None, file_size_limit)
        self.processes[name or executable] = process
        return process

    def start_interpreter(self, executable: str, name: str = "", **parameters: object) -> subprocess.Popen[bytes]:
        """Start a node that runs its own imports, for tests with other installed packages."""
        words = words_of(parameters, name)
        return self.start_module(name or executable, "body_tracking.nodes", executable, "--ros-args", *words)

    def start_module(
        self, name: str, module: str, *words: str | Path, folder: Path | None = None
    ) -> subprocess.Popen[bytes]:
        """Run ``python -m`` in a folder; its output goes to a file."""
        variables = {**self.environment, PARENT_VARIABLE: str(os.getpid())}  # no node outlives the tests
        if folder is not None:
            variables["PYTHONPATH"] = str(ROOT)
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = process = subprocess.Popen(
                [sys.executable, "-m", module, *words], stdout=log, stderr=subprocess.STDOUT, env=variables, cwd=folder
            )
        return process

    def replay(self, name: str, port: int) -> subprocess.Popen[bytes]:
        """Send ``BAG`` to a port of this machine, again and again."""
        words = ("--loop", "--replay", BAG, "--to", f"127.0.0.1:{port}")
        return self.start_module(name, "body_tracking.kinect.kinect_sender", *words)

    def wait_for_links(self, links: Mapping[str, Mapping[str, int]], timeout: float = PATIENCE) -> None:
        """Wait until nodes have found their subscribers.

        Args:
            links: number of subscribers by node and topic.
            timeout: seconds, after which the test fails.
        """

        def missing() -> list[str]:
            return [
                f"{node}: {topic}"
                for node, topics in links.items()
                for topic, number in topics.items()
                if self.number(node, f"subscribers {topic}") < number
            ]

        assert self.until(lambda: not missing(), timeout), (missing(), self.diagnostics)

    def call(self, kind: type[Any], name: str, request: Any, timeout: float = PATIENCE) -> Any:
        """The response of a service, which may be called several times.

        DDS lists the service of a killed node for a while, and a request may go to it alone.
        """
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout), name
        end = time.monotonic() + timeout
        futures = []
        while time.monotonic() < end:
            futures.append(client.call_async(request))
            self.until(lambda: any(future.done() for future in futures), 5.0)
            for future in futures:
                if future.done():
                    self.node.destroy_client(client)
                    return future.result()
        raise AssertionError(f"{name} does not answer: {self.diagnostics}")

    def resume(self, timeout: float = PATIENCE) -> None:
        """Let a ``bag_player`` that was started paused go on."""
        assert self.call(Trigger, "/bag_player/resume", Trigger.Request(), timeout).success

    def set_parameter(self, node: str, name: str, value: ParameterValue) -> tuple[bool, str]:
        """Whether a node accepts the value, and the reason if not."""
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        (result,) = self.call(SetParameters, f"/{node}/set_parameters", request).results
        return result.successful, result.reason

    def log(self, executable: str) -> str:
        """A node's output so far."""
        return (self.folder / f"{executable}.log").read_text()

    def until(self, condition: Callable[[], object], timeout: float = PATIENCE) -> bool:
        """Spin until a condition holds; returns whether it held in time."""
        return spin_until(self.executor, condition, timeout)

    def collect(self, kind: type[Any], topic: str, qos: QoSProfile = RELIABLE) -> list[Any]:
        """A list into which the messages of a topic come."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, qos)
        return received
