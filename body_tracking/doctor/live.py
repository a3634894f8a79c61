"""What runs in the ROS domain: whether processes find each other, which sensors are alive, what the nodes say."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, TypeAlias

from body_tracking import graph
from body_tracking.doctor.finding import OK, PROBLEM, WARNING, Finding
from body_tracking.messages.base import POINT_CLOUD
from body_tracking.node_status import NodeStatus

Tick: TypeAlias = Callable[[float], None]
"""Called now and then with the seconds so far."""

START_TIMEOUT = 9.0
"""Seconds for a process to import ROS and make a node, besides the time for which it listens."""
LONGEST_WAIT = 10.0
"""Seconds for a sensor that was asked for to begin."""
SLOW_RATE = 20.0
"""A Kinect has 30 Hz, and 15 Hz in the dark."""
IMU_RATE = 50.0
OLD = 0.5
"""Seconds after which a stamp is not just delayed but of another clock."""
TRACKED = 0.3
"""With a person in view more of the joints are tracked than this."""
LOST = 0.02
"""Share of messages."""


@dataclass(slots=True)
class Stream:
    """What a sensor sent while we listened.

    Attributes:
        type: of the messages.
        publishers: how many there are.
        received: messages that could be read.
        seconds: from the first to the last.
        age: the least, by this machine's clock, seconds; None before the first message.
        tracked: share of joints with tracking state 2; None where there are none.
        malformed: messages that could not be read.
        reason: why not.
    """

    type: str
    publishers: int
    received: int = 0
    seconds: float = 0.0
    age: float | None = None
    tracked: float | None = None
    malformed: int = 0
    reason: str = ""

    @property
    def rate(self) -> float:
        """Hertz."""
        return (self.received - 1) / self.seconds if self.received > 1 and self.seconds > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Observation:
    """What the listening process saw.

    Attributes:
        rmw: the middleware.
        heard_after: seconds until it heard the other process, counted from when both were there; None for not at all.
        streams: by topic.
        nodes: by the name of their status.
    """

    rmw: str
    heard_after: float | None
    streams: dict[str, Stream]
    nodes: dict[str, NodeStatus]


def observation_from(text: str) -> Observation:
    """Of what :func:`~body_tracking.nodes.doctor_probe.listen` printed."""
    content: dict[str, Any] = json.loads(text)
    return Observation(
        content["rmw"],
        content["heard_after"],
        {topic: Stream(**values) for topic, values in content["streams"].items()},
        {name: NodeStatus(**values) for name, values in content["nodes"].items()},
    )


def observe(
    environment: Mapping[str, str],
    seconds: float,
    tick: Tick | None = None,
    start_timeout: float = START_TIMEOUT,
    wanted: Sequence[str] = (),
) -> Observation | str:
    """Let two processes talk and one of them listen to everything; what was seen, or why that was not possible.

    Args:
        environment: of the processes.
        seconds: to listen.
        tick: called now and then with the seconds so far.
        start_timeout: seconds that the processes may take to start.
        wanted: sensors that are waited for half as long, at most ``LONGEST_WAIT``, as they may just have been started.
    """
    patience = min(0.5 * start_timeout, LONGEST_WAIT) if wanted else 0.0
    token = f"t{os.urandom(4).hex()}"
    command = [sys.executable, "-m", "body_tracking.nodes.doctor_probe"]
    with ExitStack() as stack:
        output = stack.enter_context(tempfile.TemporaryFile("w+"))
        errors = stack.enter_context(tempfile.TemporaryFile("w+"))
        total = seconds + patience + start_timeout

        def start(stdout: Any, stderr: Any, role: str, *arguments: object) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [*command, role, token, *map(str, arguments)],
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                env={**environment, "RCUTILS_COLORIZED_OUTPUT": "0"},
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        start(subprocess.DEVNULL, subprocess.DEVNULL, "speak", total)
        topics = [graph.skeleton_topic(sensor) for sensor in wanted]
        listener = start(output, errors, "listen", seconds, patience, *topics)
        began = time.monotonic()
        while listener.poll() is None and time.monotonic() - began < total:
            time.sleep(0.1)
            if tick is not None:
                tick(time.monotonic() - began)
        for file in (output, errors):
            file.seek(0)
        lines = output.read().splitlines()
        if listener.poll() == 0 and lines:
            return observation_from(lines[-1])
        if listener.poll() is None:
            return f"no node came up within {total:.0f} s"
        said = [line for line in errors.read().splitlines() if line.strip()]
        # of a traceback, the line that names the error; rcl's own are several lines long, the first tells most
        telling = [line for line in said if not line.startswith((" ", "Traceback", ">>>", "[", "During", "The above"))]
        return (telling or said or [f"exit code {listener.returncode}"])[-1].strip()


# --- what it means


def discovery(seen: Observation | str, environment: Mapping[str, str], local: bool) -> Finding:
    """Whether two processes on this machine hear each other."""
    if isinstance(seen, str):
        return _no_ros(seen, environment)
    if seen.heard_after is None:
        return Finding(
            "discovery",
            PROBLEM,
            f"two processes on this machine do not hear each other ({seen.rmw})",
            "export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST; where that does not help: a firewall (sudo ufw status), "
            "or a VPN that takes multicast away"
            if not local
            else "export FASTDDS_BUILTIN_TRANSPORTS=UDPv4, which leaves shared memory out",
        )
    return Finding("discovery", OK, f"two processes heard each other after {seen.heard_after:.1f} s ({seen.rmw})")


def _no_ros(text: str, environment: Mapping[str, str]) -> Finding:
    rmw = environment.get("RMW_IMPLEMENTATION", "")
    if "No module named 'rclpy'" in text:
        remedy = "pip install 'body_tracking[ros]', or source a ROS install: . /opt/ros/jazzy/setup.bash"
    elif rmw and (rmw in text or "rmw" in text.lower()):
        remedy = "unset RMW_IMPLEMENTATION, or install what it names; all nodes must have the same"
    elif "cannot open shared object file" in text:
        remedy = "unset _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH; use a shell in which no other ROS is sourced"
    elif "no node came up" in text:
        remedy = "the machine is too busy (top), or discovery waits for a server that is not there (env | grep ROS_)"
    else:
        remedy = "see the environment's findings above"
    return Finding("discovery", PROBLEM, f"no node can be made: {text}", remedy)


def sensors(seen: Observation, wanted: Sequence[str] = ()) -> Iterator[Finding]:
    """Which sensors are alive.

    Args:
        seen: what was seen.
        wanted: cameras that must be there.
    """
    there = sorted(  # of every rig, with its namespace
        topic.removeprefix("/").removesuffix(graph.SKELETON_SUFFIX)
        for topic, stream in seen.streams.items()
        if stream.type == POINT_CLOUD
    )
    for sensor in wanted:
        if sensor not in there:
            yield Finding(
                "sensors",
                PROBLEM,
                f"{graph.skeleton_topic(sensor)}: nobody publishes it; there are {', '.join(there) or 'no sensors'}",
                f"start the sensor's node; on another machine: compare env | grep ROS_ there; ros2 topic info "
                f"{graph.skeleton_topic(sensor)}",
            )
    for topic, stream in sorted(seen.streams.items()):
        yield _stream(topic, stream)
    if not seen.streams and not wanted:
        yield Finding("sensors", OK, "no sensor is publishing in this domain")


def _stream(topic: str, stream: Stream) -> Finding:
    camera = stream.type == POINT_CLOUD
    if stream.malformed and not stream.received:
        return Finding(
            "sensors",
            PROBLEM,
            f"{topic}: {stream.malformed} malformed messages: {stream.reason}",
            "its publisher must send the fields of docs/your_own_sensor.md",
        )
    if not stream.received:
        return Finding(
            "sensors",
            WARNING if camera else PROBLEM,
            f"{topic}: there is a publisher, but nothing came",
            "a person must be in view, a bag must not be paused; else see the node's diagnostics"
            if camera
            else "is the sensor switched on and streaming? see its driver's log",
        )
    text = f"{topic}: {stream.rate:.1f} Hz"
    if stream.tracked is not None:
        text += f", {100.0 * stream.tracked:.0f} % of the joints tracked"
    assert stream.age is not None
    text += f", {_age(stream.age)}"
    if stream.publishers > 1:
        return Finding(
            "sensors",
            PROBLEM,
            f"{topic}: {stream.publishers} publishers",
            f"end all but one: ros2 topic info -v {topic}",
        )
    if stream.rate < (SLOW_RATE if camera else IMU_RATE):
        return Finding(
            "sensors",
            WARNING,
            f"{text}: slow",
            "more light (a Kinect halves its rate in the dark), USB 3 on a controller of its own, less load"
            if camera
            else "raise the sensor's rate to 50 Hz at least, 100 Hz is better",
        )
    if stream.tracked is not None and stream.tracked < TRACKED:
        return Finding("sensors", WARNING, f"{text}: hardly anybody in view", "see docs/placing_sensors.md")
    if not -OLD < stream.age < OLD:
        return Finding("sensors", OK, f"{text}: a recording, or a clock of its own, which calibration finds out")
    return Finding("sensors", OK, text)


def _age(age: float) -> str:
    if abs(age) < 10.0:
        return f"stamps {1e3 * age:.0f} ms old"
    if abs(age) < 86400.0:
        return f"stamps {age:.0f} s old"
    return "stamps of another day"


def nodes(seen: Observation) -> Iterator[Finding]:
    """What the nodes that run say of themselves."""
    if not seen.nodes:
        yield Finding("nodes", OK, "no node reports in this domain; body_tracking up starts the graph")
    for name, status in sorted(seen.nodes.items()):
        node = name.partition(":")[0]
        text = f"{node}: {status.text}"
        values = status.values
        lost = sum(float(count) for key, count in values.items() if key.split()[0] in ("lost", "dropped"))
        received = _number(values, "received")
        unheard = [
            key.removeprefix("subscribers ") for key, n in values.items() if key.startswith("subscr") and n == "0"
        ]
        if status.level >= 2:
            yield Finding("nodes", PROBLEM, text, "the text says what; the node's log says more")
        elif _number(values, "malformed"):
            yield Finding(
                "nodes",
                WARNING,
                f"{node}: {values['malformed']} malformed messages, the last: {values.get('last malformed', '')}",
                "see who publishes that topic: ros2 topic info -v",
            )
        elif status.level == 1:
            yield Finding("nodes", WARNING, text, "see docs/troubleshooting.md")
        elif lost > LOST * max(1.0, lost + received):
            yield Finding(
                "nodes",
                WARNING,
                f"{text}; it lost {lost:.0f} of {lost + received:.0f} messages",
                "too much load (top) or too small buffers; body_tracking up --reliable loses none, and is later",
            )
        elif unheard:
            yield Finding("nodes", OK, f"{text}; nobody listens to {', '.join(unheard)}")
        else:
            yield Finding("nodes", OK, text)


def _number(values: Mapping[str, str], key: str) -> float:
    return float(values.get(key, 0))
