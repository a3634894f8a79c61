"""Diagnostics, angles and clock of the graph, as the status line of ``body_tracking up``."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from body_tracking.core import names
from body_tracking.core.qos import RELIABLE
from body_tracking.kinect.system import sensors_of
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.node_status import NodeStatus, update_statuses
from body_tracking.pipeline import graph
from body_tracking.pipeline.roles import NOTABLE_LATE, ROLES, role_of
from body_tracking.pipeline.system import Options
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.executor import BatchNode, LeanExecutor

_CHAIN = ("skeleton_filter", "joint_angles")
_OWN_PART = ("calibration", "robot_commands")
"""Nodes that have a part of their own in the status line."""
_LOSSES = ("dropped ", "lost ", "left out after a standstill ")
"""Beginnings of the keys, before the topic, by which a node counts messages that it did not process."""
_SHOWING = ("viewer", "body_markers")
"""Nodes that show the latest messages, and leave out others on purpose."""
_NOTABLE_LOSS, _FEW = 0.01, 10
"""Share of a node's received messages, and a number that is lost where a node has just started."""
_REPORTED_S = 1.5
"""Seconds of a bag after which each node has reported what it gets of it."""
_FRESH = 3.0
"""Seconds for which a node's diagnostics are valid."""
_RECENT_S = 5.0
"""Seconds: the status line names the messages that were not processed in these last ones."""
_END_S = 0.05
"""Seconds before the end of a bag that count as its end."""
_SILENT_S = 10.0
"""Seconds without a bag after which a sensor that has never sent is named."""


def calibration_part(status: NodeStatus | None, sensors: Collection[str]) -> list[str]:
    """The calibration's part of the status line; none in a graph of markers alone, which has nothing to calibrate."""
    if status is None and not sensors:
        return []
    return [f"calibration: {status.text if status is not None else 'none'}"]


def problem_parts(statuses: Mapping[str, NodeStatus], waiting: Collection[str] = ()) -> list[str]:
    """The problems that nodes report, with their names; not those of nodes that have a part of their own.

    Args:
        statuses: by node.
        waiting: nodes that rightly wait for others, and whose warnings are left out.
    """
    left_out = {*_OWN_PART, *(name for name in waiting if name in statuses and statuses[name].level == 1)}
    bad = {name: each.text for name, each in statuses.items() if each.level and each.text and name not in left_out}
    return [f"{name}: {text}" for name, text in sorted(bad.items())]


def losses_part(
    statuses: Mapping[str, NodeStatus], before: Mapping[str, NodeStatus] | None = None, *, reliable: bool = False
) -> list[str]:
    """The messages that nodes did not process, where they are more than ten, and than one in a hundred received ones.

    Args:
        statuses: by node.
        before: earlier ones; only what came since counts.
        reliable: no message should be lost, so a single one is named.
    """
    found = []
    for name, status in sorted(statuses.items()):
        if name in _SHOWING:
            continue
        lost, received = _losses(status)
        if before and name in before:
            earlier = _losses(before[name])
            if earlier[0] <= lost and earlier[1] <= received:  # the node was not started anew
                lost, received = lost - earlier[0], received - earlier[1]
        if lost > (0.0 if reliable else max(_FEW, _NOTABLE_LOSS * received)):
            found.append(f"{name} {lost:.0f}")
    return [f"messages not processed (machine or network too slow): {', '.join(found)}"] if found else []


def _losses(status: NodeStatus) -> tuple[float, float]:
    """Numbers of messages that a node did not process, and that it received.

    A message whose results were not published, because a standstill made them old, counts once, whatever the number of
    the node's outputs.
    """
    lost = {key: status.number(key) or 0.0 for key in status.values if key.startswith(_LOSSES)}
    outputs = {key for key in lost if f"subscribers {key.rpartition(' ')[2]}" in status.values}
    inputs = sum(number for key, number in lost.items() if key not in outputs)
    return inputs + max((lost[key] for key in outputs), default=0.0), status.number("received") or 0.0


def _malformed(statuses: Mapping[str, NodeStatus]) -> tuple[int, str]:
    """The number of malformed messages that nodes received, and the topic of one of the last with the reason."""
    numbers = [int(status.values.get("malformed", 0)) for status in statuses.values()]
    reasons = [status.values.get("last malformed", "") for status in statuses.values()]
    return sum(numbers), next(filter(None, reasons), "")


class GraphMonitor:
    """Subscribes in its own thread.

    Args:
        angles_topics: of the joint angles that the graph publishes.
        namespace: of the graph.
    """

    def __init__(self, angles_topics: Sequence[str], namespace: str = "/") -> None:
        self.clock_ns = 0
        """The latest time on ``/clock``; 0 before the first."""
        self.last_angles = 0.0
        """Steady time of receipt of the latest angles, seconds."""
        self.angles = 0
        """Number of received angle messages."""
        self.end_asked = False
        """Whether somebody has called the service that ends the graph."""
        self._angles_topics = tuple(angles_topics)
        self._statuses: dict[str, NodeStatus] = {}
        self._past: deque[tuple[float, Mapping[str, NodeStatus]]] = deque()
        """Those of the last seconds, with their times."""
        self._awaited: list[str] = []
        """Nodes that have not reported, of those that a bag waits for."""
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._namespace = namespace
        # the time in the name shows which of two is older
        self._node = BatchNode(f"{graph.UP_NODE}_{time.time_ns()}", namespace=namespace, context=self._context)
        self._node.create_subscription(
            DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self._on_diagnostics, to_profile(RELIABLE)
        )
        for topic in self._angles_topics:
            # a deep queue, so that all are counted, and as bytes, which nobody reads
            name, qos = names.relative(topic), to_profile(graph.RELIABLE_SKELETON)
            self._node.create_subscription(JointState, name, self._on_angles, qos, raw=True)
        clock_qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(Clock, graph.CLOCK_TOPIC, self._on_clock, clock_qos)
        self._node.create_service(Trigger, graph.END, self._on_end)
        self._executor = LeanExecutor(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        rclpy.try_shutdown(context=self._context)
        self._thread.join(timeout=2.0)
        self._executor.shutdown()  # before Python destroys objects in any order
        self._node.destroy_node()  # otherwise other processes still discover it

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def _on_diagnostics(self, message: Any) -> None:
        known = dict(self._statuses)  # the other thread reads them
        update_statuses(known, statuses(message, time.monotonic(), self._namespace))
        self._statuses = known

    def _on_angles(self, message: Any) -> None:
        self.angles += 1
        self.last_angles = time.monotonic()

    def _on_clock(self, message: Any) -> None:
        with contextlib.suppress(MessageError):
            self.clock_ns = to_nanoseconds(message.clock)

    def _on_end(self, request: Any, response: Any) -> Any:
        self.end_asked = response.success = True
        response.message = "the graph ends"
        return response

    def has_predecessor(self) -> bool:
        """Whether another ``up`` was started earlier in this domain and namespace and still runs.

        A killed one does not count: it does not answer the discovery of later participants.
        """
        name, namespace = self._node.get_name(), self._node.get_namespace()
        return any(
            other.startswith(f"{graph.UP_NODE}_") and where == namespace and (len(other), other) < (len(name), name)
            for other, where in self._node.get_node_names_and_namespaces()
        )

    def has_subscribers(self, wanted: Mapping[str, int], nodes: Collection[str]) -> bool:
        """Whether the publishers of these topics report at least so many subscribers.

        Only the publisher's own report counts, because the time of discovery differs between processes.

        Args:
            wanted: numbers by topic; a topic that none of the nodes publishes does not count.
            nodes: that must all have reported.
        """
        statuses = [self._statuses.get(name) for name in nodes]
        self._awaited = [name for name in nodes if name not in self._statuses]
        for topic, number in wanted.items():
            key = f"subscribers {names.resolved(topic, self._namespace)}"
            found = [status.number(key) or 0.0 for status in statuses if status is not None and key in status.values]
            if found and sum(found) < number:
                return False
        return None not in statuses

    # --- texts

    def line(self, options: Options, elapsed: float, restarts: Mapping[str, int]) -> str:
        """The status line: rates, delay, calibration, restarts."""
        now = time.monotonic()
        fresh = {name: status for name, status in self._statuses.items() if now - status.received < _FRESH}
        player = fresh.get("bag_player")
        position = 0.0 if player is None else player.number("position s") or 0.0
        # nodes report once a second: until then they know nothing of a bag that plays already
        starts = bool(options["bag"]) and (not self.clock_ns or (player is not None and position < _REPORTED_S))
        parts = [f"{elapsed:6.1f} s"]
        if starts and not position and not self.angles:
            which = (
                f"these nodes have started: {', '.join(self._awaited)}" if self._awaited else "all nodes have started"
            )
            parts[0] += f" (the bag plays once {which})"
        else:
            ended = player is not None and player.text == "at the end"  # there it waits for the page
            if ended:
                parts[0] += " (the bag is at its end)"
            elif player is not None:
                parts[0] += f" (bag {position:.1f}/{player.number('duration s') or 0.0:.1f} s)"
            elif not fresh:
                parts[0] += " (the nodes are starting)"
            rates = self._rates(options, fresh)
            if not ended and not (starts and " -" in rates):
                parts.append(rates)
                parts += filter(None, [self._delay(options, fresh)])
            parts += calibration_part(fresh.get("calibration"), sensors_of(options))
            if not options["bag"] and elapsed > _SILENT_S:
                parts += self._silent_sensors(options, fresh)
        if not self.angles:
            # all wait for the bag, and joint_angles for a filter that may not have started
            waiting = (*fresh,) if starts else ("joint_angles",) * (elapsed < _SILENT_S)
            parts += problem_parts(fresh, waiting)
        elif "bag_recorder" in fresh and fresh["bag_recorder"].level == 2:
            parts.append(f"bag_recorder: {fresh['bag_recorder'].text}")
        malformed, _ = _malformed(fresh)
        if malformed:
            parts.append(f"malformed {malformed}")
        parts += losses_part(fresh, self._earlier(now), reliable=bool(options["reliable"]))
        values = {f"{key}: {value}" for status in fresh.values() for key, value in status.values.items()}
        parts += sorted(each for each in values if each.startswith("publishers "))
        if options["robot"]:
            parts.append(f"robot {fresh['robot_commands'].text if 'robot_commands' in fresh else '-'}")
        if restarts:
            parts.append("restarts " + ", ".join(f"{name} {count}" for name, count in restarts.items()))
        return " | ".join(parts)

    def _too_late(self, bag: bool) -> str:
        """That ``ekf`` left out many measurements, and what helps; empty where it used nearly all."""
        status = self._statuses.get("skeleton_filter", NodeStatus("", 0, ""))
        late, received = (status.number(key) or 0.0 for key in ("too_late", "received"))
        if late <= NOTABLE_LATE * received:
            return ""
        advice = "--rate 0.5 plays more slowly" if bag else "see docs/troubleshooting.md"
        return f"; {late:.0f} measurements came too late for skeleton_filter; {advice}"

    def _earlier(self, now: float) -> Mapping[str, NodeStatus]:
        """What the nodes reported :data:`_RECENT_S` before, or first."""
        if not self._past or now - self._past[-1][0] > 1.0:
            self._past.append((now, self._statuses))
        while len(self._past) > 1 and now - self._past[1][0] >= _RECENT_S:
            self._past.popleft()
        return self._past[0][1]

    def _silent_sensors(self, options: Options, fresh: Mapping[str, NodeStatus]) -> list[str]:
        """The sensors of which fusion has not received a message."""
        if "fusion" not in fresh:
            return []
        topics = {name: names.resolved(graph.skeleton_topic(name), self._namespace) for name in sensors_of(options)}
        silent = {name: topic for name, topic in topics.items() if f"rate in {topic}" not in fresh["fusion"].values}
        if not silent:
            return []
        return [
            f"nothing comes from {', '.join(silent.values())}; `body_tracking doctor --sensors {','.join(silent)}` "
            "says more"
        ]

    def _rates(self, options: Options, fresh: Mapping[str, NodeStatus]) -> str:
        def rate(node: str, way: str, topic: str) -> str:
            key = f"rate {way} {names.resolved(topic, self._namespace)}"
            value = fresh[node].values.get(key) if node in fresh else None
            return f"{float(value):.0f}" if value is not None else "-"

        sensors = " ".join(f"{name} {rate('fusion', 'in', graph.skeleton_topic(name))}" for name in sensors_of(options))
        skeletons = f"{sensors}, fused {rate('fusion', 'out', graph.FUSED)}, " if sensors else ""
        rates = {topic.split("/")[-2]: self._angles_rate(topic, fresh) for topic in self._angles_topics}
        # of the people with angles, and of markers; of the first one if there are none
        known = {each: rate for each, rate in rates.items() if rate not in ("-", "0")}
        named = ", ".join(f"{each} {rate}" for each, rate in known.items())
        angles = named if len(known) > 1 else next(iter((known or rates).values()), "-")
        return f"{skeletons}angles {angles} Hz"

    def _angles_rate(self, topic: str, fresh: Mapping[str, NodeStatus]) -> str:
        """The rate of a topic, in hertz, by the node that publishes it."""
        key = f"rate out {names.resolved(topic, self._namespace)}"
        found = [status.values[key] for status in fresh.values() if key in status.values]
        return f"{float(found[0]):.0f}" if found else "-"

    @staticmethod
    def _delay(options: Options, fresh: Mapping[str, NodeStatus]) -> str:
        """From a sensor's message to the angles: the sum of the nodes' delays, each with the transport to it."""
        running = fresh.get("skeleton_filter")
        # the filter may have changed since the start
        role = ROLES.get(running.text.partition(" ")[0] if running is not None else "")
        option = options["filter_input"]
        source = (role or role_of(options)).input if option in ("", graph.AUTO) else option
        chain = _CHAIN if source == graph.SENSORS_INPUT else ("fusion", *_CHAIN)
        values = [fresh[name].values.get("delay median ms") if name in fresh else None for name in chain]
        known = [float(value) for value in values if value is not None]
        return f"delay {sum(known):.1f} ms" if len(known) == len(chain) else ""

    def summary(self, options: Options, elapsed: float, restarts: Mapping[str, int], *, played: bool = True) -> str:
        """The last line of a run; ``played`` says whether a bag came to its end."""
        seconds = f"{elapsed:.1f} s"
        what = f"ran for {seconds}"
        player = self._statuses.get("bag_player")
        if player is not None and (duration := player.number("duration s")):  # it may wait there, for the page
            played |= (player.number("position s") or 0.0) >= duration - _END_S
        if options["bag"] and played:
            what = f"played {options['bag']} in {seconds} (start and end included)"
        elif options["bag"]:
            what = f"stopped before the end of {options['bag']}, after {seconds} (start included)"
        text = f"{what}: {self.angles} frames of joint angles"
        problems = [] if self.angles else problem_parts(self._statuses)
        malformed, reason = _malformed(self._statuses)
        if malformed and not self.angles:
            problems.append(f"malformed {malformed}, such as {reason}")
        text += f" ({'; '.join(problems)})" if problems else ""
        recorder = self._statuses.get("bag_recorder")
        last = recorder.values.get("bag", "") if recorder is not None and recorder.number("messages") else ""
        if options["record"]:
            first = Path(str(options["record"]))
            text += f", recorded in {first}" if first.exists() else ", nothing was recorded"
            if last and Path(last) != first:  # each round of a bag that loops has a folder
                text += f" to {last}"
        elif last:
            text += f", recorded in {last}"  # by the page or the service
        if recorder is not None and (lost := recorder.number("lost")):
            text += f" ({lost:.0f} messages or more are missing)"
        reliable = bool(options.get("reliable"))
        losses = losses_part(self._statuses, reliable=reliable)
        text += "".join(f"; {part}" for part in losses)
        if losses and not reliable:
            later = options["bag"] and not options.get("robot")  # which does not follow late angles
            text += "; --reliable processes them, later" if later else "; see docs/troubleshooting.md"
        text += self._too_late(bool(options["bag"]))
        if restarts:
            text += "; restarts: " + ", ".join(f"{name} {count}" for name, count in restarts.items())
        return text
