"""The base of all nodes: parameters, diagnostics, callbacks that cannot end the node, start and end.

Over 500 lines: the methods that override rclpy.node.Node belong together.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, wraps
from types import MappingProxyType
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import PointCloud2

from body_tracking.core import names
from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import Parameter, ParameterError, Value, to_ros, unknown_parameter
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.qos import SENSOR_DATA, Qos
from body_tracking.core.skeleton import Skeleton
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.diagnostics import diagnostics
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import skeleton_input
from body_tracking.pipeline.stage import FAILURES, Port
from body_tracking.ros.backlog import Backlog, Sequences, Standstill
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.declare import declare
from body_tracking.ros.executor import BatchNode
from body_tracking.ros.monitor import Monitor
from body_tracking.ros.ticks import Ticks
from body_tracking.ros.wire import ROS, WIRE

RCLError: type[Exception] = _rclpy.RCLError
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_TICKS = 1000
"""Queue of simulated time, ticks: a busy node must still handle each message at the time at which it was sent."""
_ACKNOWLEDGE_S = 2.0
"""Seconds for subscribers to acknowledge a node's last messages."""
_FORGOTTEN_S = 25.0
"""Seconds after which DDS has removed a killed process: Fast DDS's lease of 20 s, and a margin."""

_EVERYWHERE = frozenset({"/rosout", "/parameter_events", graph.DIAGNOSTICS_TOPIC})
"""Outputs that every node has."""
_LOG_PERIOD_S, _DOUBLED_PERIOD_S = 5.0, 30.0
_REPORT_S = 1.0
"""Seconds between two reports of a node in ``/diagnostics``."""
_LOOK_S = 0.2
"""Seconds between two checks whether to report."""
_NAMELESS = "_NODE_NAME_UNKNOWN_"
"""What rclpy calls a publisher whose node is no longer known."""
_STATE_LEVELS = ("OK", "warning", "error", "stale")
_SIMULATED = Parameter("use_sim_time", False, "whether the node's time is /clock")


class Alarm:
    """A one-shot timer by :meth:`GraphNode.waiting_ns`.

    Setting a timer wakes up the node and costs more than one superfluous expiry. So a timer that expires too early is
    left alone and set again when it expires. Simulated time needs no timer: every tick checks the alarms.

    Args:
        node: the owner.
        ring: the callback.
        simulated: whether time is simulated.
    """

    def __init__(self, node: GraphNode, ring: Callable[[], None], *, simulated: bool) -> None:
        self._ring, self._now = ring, node.waiting_ns
        self._wanted_ns: int | None = None
        self._set_ns: int | None = None
        self._timer = None if simulated else node.create_timer(1.0, self._on_timer, clock=STEADY)
        if self._timer is not None:
            self._timer.cancel()

    def at(self, time_ns: int | None) -> None:
        """Set the time of the call, in place of an earlier one; None cancels it."""
        self._wanted_ns = time_ns
        if time_ns is not None and (self._set_ns is None or time_ns < self._set_ns):
            self._set(time_ns)

    def look(self) -> None:
        """Call if the time has come."""
        wanted_ns = self._wanted_ns
        if wanted_ns is None:
            return
        if wanted_ns > self._now():
            self._set(wanted_ns)
            return
        self._wanted_ns = None
        self._ring()

    def _set(self, time_ns: int) -> None:
        if self._timer is not None:
            self._set_ns = time_ns
            self._timer.timer_period_ns = max(1, time_ns - self._now())
            self._timer.reset()

    def _on_timer(self) -> None:
        assert self._timer is not None
        self._timer.cancel()
        self._set_ns = None
        self.look()


class GraphNode(BatchNode):
    """Base of the nodes.

    A node has a name and parameters, and overrides ``configure`` and ``start``. It subscribes by :meth:`subscribe`, so
    that no message can end it.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[tuple[Parameter, ...]]

    def __init__(self) -> None:
        self.monitor = Monitor()
        self._failed_in_a_row: Counter[str] = Counter()
        self._reported_failures = 0
        super().__init__(self.NAME)
        self.backlog = Backlog()
        self.sequences = Sequences()
        self.standstill = Standstill()
        self._droppable: dict[Subscription, str] = {}
        self._reported_dropped: Counter[str] = Counter()
        self._logged: dict[str, float] = {}
        self._switched: Counter[str] = Counter()
        self._several_since: dict[str, float] = {}
        self.simulated = bool(self.get_parameter("use_sim_time").value)
        self._simulated_ns = 0
        self._ticks = Ticks()
        self._rewinds = self._rewinds_logged = 0  # backward jumps of /clock
        self._rewinds_known: Counter[str] = Counter()
        self._sent_ns = 0  # wall time at which the newest handled message was sent
        self._alarms: list[Alarm] = []
        self.arrived_ns = 0
        """ROS time of arrival of the current message, nanoseconds."""
        self.arrived_waiting_ns = 0
        """Time of its arrival by :meth:`waiting_ns`."""
        self.values: Mapping[str, Value] = declare(self, self.PARAMETERS)
        if self.simulated:
            # a lost tick would make the next message seem early, which disturbs estimates of a clock's least delay
            transport = RELIABLE_QOS if self.values.get("reliable") else SENSOR_DATA
            qos = to_profile(Qos(transport.reliability, transport.durability, _TICKS))
            self.create_subscription(ClockMessage, graph.CLOCK_TOPIC, self._on_clock, qos)
        self.configure(self.values)
        self.add_on_set_parameters_callback(self._on_set)
        self._diagnostics = self.create_publisher(DiagnosticArray, graph.DIAGNOSTICS_TOPIC, to_profile(RELIABLE_QOS))
        self.start()
        self._reported = -_REPORT_S
        self._reported_subscribers: dict[str, object] = {}
        self.create_timer(_LOOK_S, self._look, clock=STEADY)

    # --- overridden by nodes

    def configure(self, values: Mapping[str, Value]) -> None:
        """Apply the parameters at the start; a BodyTrackingError ends the node."""

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        """Apply changed parameters; a BodyTrackingError refuses the change."""
        self.configure(values)

    def start(self) -> None:
        """Make publishers, subscriptions, services and timers."""

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Level, text and values for the node's diagnostics."""
        return 0, "", {}

    def finish(self) -> None:
        """Publish at the end the outputs that still wait for messages."""

    def close(self) -> None:
        """Release resources at the end, also where there is no time for :meth:`finish`."""

    # --- parameters

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Called by the parameter services; a refusal states our reason, not rcl's."""
        table = {parameter.name: parameter for parameter in (*self.PARAMETERS, _SIMULATED)}
        changes = []
        for change in parameter_list:
            try:
                if change.name in table:
                    value = table[change.name].check_change(change.value)
                    change = RosParameter(change.name, value=to_ros(value))
                elif not self.has_parameter(change.name):
                    raise unknown_parameter(change.name, table)
            except ParameterError as error:
                return SetParametersResult(successful=False, reason=f"{self.get_name()}: {error}")
            changes.append(change)
        result: SetParametersResult = super().set_parameters_atomically(changes)
        return result

    def _on_set(self, changes: list[RosParameter]) -> SetParametersResult:
        table = {parameter.name: parameter for parameter in self.PARAMETERS}
        values = dict(self.values)
        try:
            for change in changes:
                if change.name in table:
                    values[change.name] = table[change.name].check(change.value)
            if values != self.values:
                self.reconfigure(MappingProxyType(values))
        except BodyTrackingError as error:
            return SetParametersResult(successful=False, reason=f"{self.get_name()}: {error}")
        self.values = MappingProxyType(values)
        return SetParametersResult(successful=True)

    def hand_over(self) -> None:
        """Publish the last messages, and wait until reliable subscribers have acknowledged them or a timeout ends."""
        self.finish()
        end = time.monotonic() + _ACKNOWLEDGE_S
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))

    # --- time

    def now_ns(self) -> int:
        """ROS time: the wall clock, or with ``use_sim_time`` the last tick before the current message was sent."""
        return self._simulated_ns if self.simulated else int(self.get_clock().now().nanoseconds)

    def waiting_ns(self) -> int:
        """The clock for timeouts: monotonic, or ``/clock`` with ``use_sim_time``, so that the load of the machine does
        not change the results of a recording.
        """
        return self._simulated_ns if self.simulated else time.monotonic_ns()

    def played_ns(self) -> int | None:
        """Simulated time that has passed altogether, for rates; None before its first tick and for real time."""
        return self._ticks.played_ns if self._ticks else None

    def _arrived(self, info: Mapping[str, int]) -> None:
        """Note the time of arrival of the current message, which may be well before it is handled."""
        if self.simulated:
            self.arrived_ns = self.arrived_waiting_ns = self._simulated_ns
            self._sent_ns = max(self._sent_ns, info["source_timestamp"])
            return
        now_ns = time.time_ns()
        self.arrived_ns = info["received_timestamp"] or now_ns  # not every RMW reports it
        self.arrived_waiting_ns = time.monotonic_ns() - max(0, now_ns - self.arrived_ns)

    def _on_clock(self, clock: ClockMessage, info: Mapping[str, int]) -> None:
        self.sequences.note(graph.CLOCK_TOPIC, info["publication_sequence_number"])
        if info["source_timestamp"] < self._sent_ns:
            self.monitor.totals["late ticks"] += 1
        now_ns = to_nanoseconds(clock.clock)
        self._rewinds += jumped_back(now_ns, self._simulated_ns)
        self._simulated_ns = now_ns
        self._ticks.add(now_ns, info["source_timestamp"])
        for alarm in self._alarms:
            alarm.look()

    def make_alarm(self, ring: Callable[[], None]) -> Alarm:
        """An alarm with this callback."""
        alarm = Alarm(self, ring, simulated=self.simulated)
        self._alarms.append(alarm)
        return alarm

    # --- callbacks

    def guarded(self, where: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a callback so that its errors are counted and logged, and never end the node.

        Args:
            where: its topic, service or other caller, for the log.
            callback: takes any arguments.
        """

        @wraps(callback)
        def guard(*given: Any) -> Any:
            try:
                result = callback(*given)
            except (ExternalShutdownException, InvalidHandle):
                raise  # for the executor
            except BodyTrackingError as error:
                self.malformed(where, str(error), "malformed" if isinstance(error, MessageError) else "refused")
            except Exception as error:
                if not self.context.ok():
                    raise  # the node is ending
                self._failed(where, error)
            else:
                self._failed_in_a_row.pop(where, None)
                return result

        return guard

    def _failed(self, where: str, error: Exception) -> None:
        """Count and log an unexpected error; after consecutive failures of one callback reset the state."""
        kind = type(error).__name__
        self.monitor.failures[f"{where} {kind}"] += 1
        self._failed_in_a_row[where] += 1
        key = f"raised {where} {kind}"
        if self._may_log(key):
            trace = "".join(traceback.format_exception(error))
            self.get_logger().error(f"{where}: {kind} in a callback; message skipped: {error}\n{trace}")
        if self._failed_in_a_row[where] % FAILURES == 0:
            self.log_throttled(f"anew {where}", f"{where}: failed {FAILURES} times in a row; resetting")
            with contextlib.suppress(Exception):
                self.restart()

    def create_subscription(self, msg_type: Any, topic: str, callback: Any, *given: Any, **named: Any) -> Subscription:
        """As rclpy's, with a guarded callback."""
        if msg_type is ClockMessage and callback != self._on_clock:
            callback = self._valid_times_only(callback)
        guard = self.guarded(self.resolve_topic_name(topic), callback)
        return super().create_subscription(msg_type, topic, guard, *given, **named)

    def create_timer(self, timer_period_sec: float, callback: Any, *given: Any, **named: Any) -> Timer:
        """As rclpy's, with a guarded callback."""
        guard = self.guarded(f"timer {getattr(callback, '__name__', 'callback')}", callback)
        return super().create_timer(timer_period_sec, guard, *given, **named)

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, *given: Any, **named: Any) -> Service:
        """As rclpy's, with a guarded callback; if it raises, the caller gets a response that says so."""
        guard = self.guarded(f"service {srv_name}", callback)

        def answer(request: Any, response: Any) -> Any:
            answered = guard(request, response)
            if answered is None:
                answered = srv_type.Response()
                if hasattr(answered, "message"):
                    answered.message = "failed; the log of the node says why"
            return answered

        return super().create_service(srv_type, srv_name, answer, *given, **named)

    def _valid_times_only(self, callback: Callable[[ClockMessage], None]) -> Callable[[ClockMessage], None]:
        """Wrap rclpy's own subscriber of ``/clock``, which would raise for an invalid time."""

        def checked(message: ClockMessage) -> None:
            with contextlib.nullcontext() if not self.simulated else contextlib.suppress(MessageError):
                to_nanoseconds(message.clock)
                callback(message)

        return checked

    # --- messages

    def full_name(self, topic: str) -> str:
        """The full name of a topic of the graph, with this node's namespace and remappings."""
        return str(self.resolve_topic_name(names.relative(topic)))

    def make_publisher(self, kind: type[Any], topic: str, qos: QoSProfile) -> Publisher:
        """A publisher of a topic of the graph."""
        return self.create_publisher(kind, names.relative(topic), qos)

    def subscribe(
        self,
        topic: str,
        kind: type[Any],
        qos: QoSProfile,
        handle: Callable[[Any, int], None],
        *,
        raw: bool = False,
        absolute: bool = False,
    ) -> Subscription:
        """Subscribe; a malformed message is counted and logged, and never ends the node.

        Args:
            topic: of the graph.
            kind: the message class.
            qos: the profile.
            handle: callback of the message and the wall time in nanoseconds at which it was sent.
            raw: pass the message as CDR bytes.
            absolute: the user chose the name; with a leading slash it holds in every namespace.
        """
        name = self.resolve_topic_name(topic) if absolute else self.full_name(topic)

        def callback(message: Any, info: dict[str, int]) -> None:
            if topic != graph.DIAGNOSTICS_TOPIC:  # each node publishes there, and the numbers do not say which
                self.sequences.note(name, info["publication_sequence_number"])
            self.monitor.arrived(name)
            self._arrived(info)
            handle(message, info["source_timestamp"])

        checked: Any = callback  # rclpy passes the message info to callbacks of two arguments
        return self.create_subscription(kind, topic if absolute else names.relative(topic), checked, qos, raw=raw)

    def subscribe_to_skeletons(self, topic: str, handle: Callable[[tuple[Skeleton, ...], int], None]) -> Subscription:
        """Subscribe to a skeleton topic; a backward jump of its stamps calls :meth:`restart` first.

        Best effort also with ``reliable``, since a sensor of another package may publish so.
        """
        name, port = self.full_name(topic), skeleton_input(topic, self.values)

        def convert(cdr: bytes, sent_ns: int) -> None:
            if self.is_stale(name, sent_ns):
                return
            skeletons: tuple[Skeleton, ...] = port.codec.decode(cdr, WIRE)
            if self.monitor.message_in(topic, skeletons[0].stamp_ns):
                self.log_jump(name)
                self.restart()
            handle(skeletons, sent_ns)

        qos = replace(SENSOR_DATA, depth=max(port.qos.depth, port.waiting))
        return self.subscribe_port(port, qos, PointCloud2, convert)

    def subscribe_port(self, port: Port, qos: Qos, kind: type[Any], handle: Callable[[Any, int], None]) -> Subscription:
        """Subscribe to the CDR bytes of a port's topic; arguments as of :meth:`subscribe`."""
        subscription = self.subscribe(port.topic, kind, to_profile(qos), handle, raw=True, absolute=port.absolute)
        if port.droppable:
            self._droppable[subscription] = self.full_name(port.topic)
        return subscription

    def unsubscribe_port(self, port: Port, subscription: Subscription) -> None:
        """End a subscription of :meth:`subscribe_port`; what is published until the next one is not lost."""
        self._droppable.pop(subscription, None)
        name = self.resolve_topic_name(port.topic) if port.absolute else self.full_name(port.topic)
        self.sequences.forget(name)
        self.destroy_subscription(subscription)

    def is_stale(self, topic: str, sent_ns: int) -> bool:
        """Whether a frame was sent before a standstill of this process and is too old; never with ``reliable``."""
        return not self.values.get("reliable") and self.standstill.is_stale(topic, sent_ns, time.time_ns())

    def drop_late(self, messages: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        """The messages without the late frames of a node that is too slow; called by the executor."""
        frames = [place for place, (subscription, _) in enumerate(messages) if subscription in self._droppable]
        if not frames:
            self.backlog.late((), time.time_ns())
            return messages
        taken = [(self._droppable[messages[place][0]], messages[place][1][1]) for place in frames]
        arrived = [(topic, info["received_timestamp"]) for topic, info in taken]
        late = {frames[each] for each in self.backlog.late(arrived, time.time_ns())}
        for place in sorted(late):  # a number that is not in order would count as another publisher's
            subscription, (_, info) = messages[place]
            self.sequences.note(self._droppable[subscription], info["publication_sequence_number"])
        return [each for place, each in enumerate(messages) if place not in late] if late else messages

    def log_jump(self, topic: str) -> None:
        """Log and count a backward jump of an input's stamps.

        It is a fault, unless ``/clock`` went back before, as of a recording that is played again or from an earlier
        place.

        Args:
            topic: full name.
        """
        if self._rewinds > self._rewinds_known[topic]:
            self._rewinds_known[topic] = self._rewinds
            if self._rewinds > self._rewinds_logged:
                self._rewinds_logged = self._rewinds
                self.get_logger().info("the recording goes on from an earlier place, resetting")
                self.monitor.totals["rewinds"] += 1
        else:
            self.monitor.totals["time jumps"] += 1
            self.log_throttled("jump", f"{topic}: time jumped back, resetting", period_s=1.0)

    def restart(self) -> None:
        """Reset the state, because stamps jumped back, or because it may be the cause of failures in a row."""

    def send(self, publisher: Publisher, message: Any, stamp_ns: int | None = None, sent_ns: int | None = None) -> bool:
        """Publish and count; nothing is published if the input became stale by a standstill of the process.

        Args:
            publisher: of the topic.
            message: a message, or its CDR bytes.
            stamp_ns: its capture time, for the latency: of a bag its recorded part, and the real time since.
            sent_ns: wall time at which the input that caused it was sent, for the delay.

        Returns:
            Whether the message was published.
        """
        if sent_ns is not None and self.is_stale(publisher.topic_name, sent_ns):
            return False
        publisher.publish(message)
        now_ns = time.time_ns()
        self.monitor.message_out(
            publisher.topic_name,
            None if sent_ns is None else now_ns - sent_ns,
            None
            if stamp_ns is None
            else self._since_capture_ns(stamp_ns, now_ns if sent_ns is None else sent_ns, now_ns),
        )
        return True

    def _since_capture_ns(self, stamp_ns: int, sent_ns: int, now_ns: int) -> int:
        """Time since a stamp, given the wall times at which the input was sent and now."""
        if self.simulated:
            return self._ticks.since_ns(stamp_ns, sent_ns, now_ns) if self._ticks else self.now_ns() - stamp_ns
        return self.now_ns() - stamp_ns

    def malformed(self, topic: str, reason: str, what: str = "malformed") -> None:
        """Count and log a message that is not used."""
        self.monitor.totals[what] += 1
        self.monitor.last_reason = f"{topic}: {reason}"
        ignored = f" {what} message ignored:" if topic.startswith("/") else ""  # timers and services have none
        self.log_throttled(f"{what} {topic}", f"{topic}:{ignored} {reason}")

    def log_throttled(self, key: str, text: str, period_s: float = _LOG_PERIOD_S) -> None:
        """Warn at most once per key and period."""
        if self._may_log(key, period_s):
            self.get_logger().warning(text)

    def _may_log(self, key: str, period_s: float = _LOG_PERIOD_S) -> bool:
        """Whether the period of a key is over; if so, it begins again."""
        now = time.monotonic()
        due = now - self._logged.get(key, -period_s) >= period_s
        if due:
            self._logged[key] = now
        return due

    # --- diagnostics

    @cached_property
    def _status_name(self) -> str:
        return f"{self.get_fully_qualified_name().removeprefix('/')}: stream"

    def _look(self) -> None:
        """Report every second, and at once when the number of subscribers changes: a source may wait for that."""
        if time.monotonic() - self._reported >= _REPORT_S or self._reported_subscribers != self._subscriber_counts():
            self._report()

    def _report(self) -> None:
        self._reported = time.monotonic()
        self._reported_subscribers = self._subscriber_counts()
        level, text, values = self.state()
        values = {**self.monitor.values(self.played_ns()), **self._reported_subscribers, **values}
        values |= {f"dropped {topic}": count for topic, count in self.backlog.dropped.items()}
        values |= {f"lost {topic}": count for topic, count in self.sequences.lost.items()}
        values |= {f"left out after a standstill {topic}": n for topic, n in self.standstill.left_out.items()}
        for topic, nodes in self._doubled().items():
            values[f"publishers {topic}"] = ", ".join(nodes)
            problem = f"{len(nodes)} publishers of {topic}: {', '.join(nodes)}"
            level, text = max(level, 1), problem + (f"; {text}" if text else "")
            self.log_throttled(f"publishers {topic}", problem, _DOUBLED_PERIOD_S)
        dropped = self.backlog.dropped - self._reported_dropped
        if dropped:
            self._reported_dropped = Counter(self.backlog.dropped)
            counts = ", ".join(f"{count} frames of {topic}" for topic, count in sorted(dropped.items()))
            problem = f"too slow: dropped {counts}"
            level, text = max(level, 1), problem + (f"; {text}" if text else "")
            self.log_throttled("dropped", problem)
        failures = self.monitor.failures.total()
        if failures > self._reported_failures:
            self._reported_failures = failures
            problem = f"{failures} callbacks failed, lately of {next(reversed(self.monitor.failures))}"
            level, text = max(level, 2), problem + (f"; {text}" if text else "")
        if self.monitor.totals["malformed"] and level == 0:
            text = text or f"{self.monitor.totals['malformed']} malformed messages"
        message = diagnostics(self.now_ns(), self._status_name, "", level, text or _STATE_LEVELS[level], values, ROS)
        self._diagnostics.publish(message)

    def publishers_of(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic, this one included; DDS lists a killed node for 20 s more."""
        found = self.get_publishers_info_by_topic(topic)
        return sorted(
            "a node that no longer answers"
            if _NAMELESS in each.node_name
            else f"{each.node_namespace.rstrip('/')}/{each.node_name}"
            for each in found
        )

    def _doubled(self) -> dict[str, list[str]]:
        """The publishers of inputs that must have one publisher and have several.

        Two publishers with the same node name may be one node that was killed and started again, and that DDS still
        lists. They count only when their messages alternate, or after DDS would have removed the dead one.
        """
        now, found = time.monotonic(), {}
        inputs = {each.topic_name for each in self.subscriptions}
        for topic in sorted(filter(graph.has_one_publisher, inputs)):
            nodes = self.publishers_of(topic) if self.count_publishers(topic) > 1 else []
            switched, self._switched[topic] = self._switched[topic], self.sequences.switched[topic]
            if len(nodes) < 2:
                self._several_since.pop(topic, None)
                continue
            since = self._several_since.setdefault(topic, now)
            if len(set(nodes)) > 1 or self._switched[topic] > switched + 1 or now - since > _FORGOTTEN_S:
                found[topic] = nodes
        return found

    def _subscriber_counts(self) -> dict[str, object]:
        """The number of subscribers that this node has found for each of its outputs."""
        return {
            f"subscribers {each.topic_name}": each.get_subscription_count()
            for each in self.publishers
            if each.topic_name not in _EVERYWHERE
        }
