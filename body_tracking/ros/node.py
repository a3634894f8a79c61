"""What every node does the same way: parameters, diagnostics, surviving bad messages, starting and ending.

Over 500 lines: the base of all nodes: what it overrides of rclpy.node.Node belongs together.
"""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import contextlib
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
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
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import PointCloud2

from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import (
    Parameter,
    ParameterError,
    Value,
    to_ros,
    unknown_parameter,
)
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.qos import SENSOR_DATA, Qos
from body_tracking.core.skeleton import Skeleton
from body_tracking.messages.base import MessageError, RosMessages, to_nanoseconds
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.diagnostics import diagnostics
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import BODY, FRAMES_KEPT, REFERENCE, RELIABLE, SENSORS, WORLD_FRAME
from body_tracking.pipeline.shared import result_qos as shared_result_qos
from body_tracking.pipeline.shared import skeleton_qos as shared_skeleton_qos
from body_tracking.ros.backlog import Backlog, Sequences, Standstill
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.declare import declare
from body_tracking.ros.main import run as run
from body_tracking.ros.monitor import Monitor

__all__ = ["BODY", "REFERENCE", "RELIABLE", "SENSORS", "WORLD_FRAME"]

RCLError: type[Exception] = _rclpy.RCLError
ROS = RosMessages()
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_TICKS = 1000
"""Ticks of simulated time that may wait while a node is busy: each message is to be handled by the time at which it was
sent."""
_ACKNOWLEDGE_S = 2.0
"""Seconds for those who listen to take a node's last messages."""
_FORGOTTEN_S = 25.0
"""Seconds after which DDS has forgotten a process that was killed: Fast DDS's lease of 20 s, and some more."""

_EVERYWHERE = frozenset({"/rosout", "/parameter_events", graph.DIAGNOSTICS_TOPIC})
"""Outputs that every node has."""
_LOG_PERIOD_S, _DOUBLED_PERIOD_S = 5.0, 30.0
_REPORT_S = 1.0
"""Seconds between two reports of a node in ``/diagnostics``."""
_LOOK_S = 0.2
"""Seconds between two looks whether to report."""
_FAILURES = 10
"""Callbacks of one input that fail one after the other, after which the node forgets its state."""
_STATE_LEVELS = ("OK", "warning", "error", "stale")


class Alarm:
    """Calls once when a time has come, by :meth:`GraphNode.waiting_ns`.

    To set a timer wakes the node up and costs more than to let it go off in vain: one that goes off earlier than it is
    needed is left as it is, and set anew then. Simulated time needs no timer: it goes on with its ticks.

    Args:
        node: whose.
        ring: what is called.
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
        """Call at this time instead of any that was given before; None for not at all."""
        self._wanted_ns = time_ns
        if time_ns is not None and (self._set_ns is None or time_ns < self._set_ns):
            self._set(time_ns)

    def look(self) -> None:
        """Whether it is time."""
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


class GraphNode(Node):
    """Base of the nodes.

    A node names itself, lists its parameters, sets itself up in ``configure`` and ``start``, and hands its callbacks
    through :meth:`subscribe`, so that no message can end it.
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
        self._sent_ns = 0  # wall time at which the newest message that was handled had been sent
        self._alarms: list[Alarm] = []
        self.arrived_ns = 0
        """ROS time at which the message in hand came; nanoseconds."""
        self.arrived_waiting_ns = 0
        """The same by :meth:`waiting_ns`."""
        self.values: Mapping[str, Value] = declare(self, self.PARAMETERS)
        if self.simulated:
            # after a lost tick the next message would seem to come earlier, which a clock's least delay is sensitive to
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

    # --- to be written by a node

    def configure(self, values: Mapping[str, Value]) -> None:
        """Take the parameters at the start.

        Raises:
            BodyTrackingError: they do not go together, and the node ends.
        """

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        """Take the parameters when some of them have changed; as at the start, unless a node knows better.

        Raises:
            BodyTrackingError: they do not go together, or not now; the change is refused for this reason.
        """
        self.configure(values)

    def start(self) -> None:
        """Make publishers, subscriptions, services and timers."""

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Level, line and values that the node adds to its diagnostics."""
        return 0, "", {}

    def finish(self) -> None:
        """Publish what still waits for something that does not come, at the end."""

    def close(self) -> None:
        """Finish what the node has in hand, at its end; also where there is no time for :meth:`finish`."""

    # --- parameters

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """As the parameter services call it: what is refused is refused with our reason, not rcl's."""
        table = {parameter.name: parameter for parameter in self.PARAMETERS}
        changes = []
        for change in parameter_list:
            try:
                if change.name in table:
                    # a whole number serves as a number here, too
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
        """At the end: the last messages, and until those who listen reliably have them, or do not answer."""
        self.finish()
        end = time.monotonic() + _ACKNOWLEDGE_S
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))

    # --- time

    def now_ns(self) -> int:
        """ROS time: the wall clock, or ``/clock`` with ``use_sim_time``: by its last tick that was sent before the
        message in hand, however late that is handled.
        """
        return self._simulated_ns if self.simulated else int(self.get_clock().now().nanoseconds)

    def waiting_ns(self) -> int:
        """The clock by which a node waits: one that nobody sets, or ``/clock`` with ``use_sim_time``.

        What a node makes of a recording then does not depend on how busy the machine is.
        """
        return self._simulated_ns if self.simulated else time.monotonic_ns()

    def _arrived(self, info: Mapping[str, int]) -> None:
        """Note when the message in hand came, which may be well before it is handled."""
        if self.simulated:
            self.arrived_ns = self.arrived_waiting_ns = self._simulated_ns
            self._sent_ns = max(self._sent_ns, info["source_timestamp"])
            return
        now_ns = time.time_ns()
        self.arrived_ns = info["received_timestamp"] or now_ns  # not every RMW tells
        self.arrived_waiting_ns = time.monotonic_ns() - max(0, now_ns - self.arrived_ns)

    def _on_clock(self, clock: ClockMessage, info: Mapping[str, int]) -> None:
        self.sequences.note(graph.CLOCK_TOPIC, info["publication_sequence_number"])
        if info["source_timestamp"] < self._sent_ns:
            self.monitor.totals["late ticks"] += 1
        self._simulated_ns = to_nanoseconds(clock.clock)
        for alarm in self._alarms:
            alarm.look()

    def make_alarm(self, ring: Callable[[], None]) -> Alarm:
        """Something that rings by :meth:`waiting_ns`."""
        alarm = Alarm(self, ring, simulated=self.simulated)
        self._alarms.append(alarm)
        return alarm

    # --- callbacks, whatever they raise

    def guarded(self, where: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """A callback that does not raise: what it raises is counted and logged, and the node goes on.

        Args:
            where: the topic, the service, or what else calls it, for people.
            callback: takes anything.
        """

        @wraps(callback)
        def guard(*given: Any) -> Any:
            try:
                result = callback(*given)
            except (ExternalShutdownException, InvalidHandle):
                raise  # the executor's
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
        """Count an error that nobody expected; where the same goes wrong time and again, forget the state."""
        kind = type(error).__name__
        self.monitor.failures[f"{where} {kind}"] += 1
        self._failed_in_a_row[where] += 1
        key = f"raised {where} {kind}"
        if self._may_log(key):
            trace = "".join(traceback.format_exception(error))
            self.get_logger().error(f"{where}: {kind} in a callback, which is left out: {error}\n{trace}")
        if self._failed_in_a_row[where] % _FAILURES == 0:
            self.log_throttled(f"anew {where}", f"{where}: failed {_FAILURES} times in a row; starting anew")
            with contextlib.suppress(Exception):
                self.time_jumped_back(where)

    def create_subscription(self, msg_type: Any, topic: str, callback: Any, *given: Any, **named: Any) -> Subscription:
        """Subscribe with a callback that cannot end the node."""
        if msg_type is ClockMessage and callback != self._on_clock:
            callback = self._without_false_times(callback)
        guard = self.guarded(self.resolve_topic_name(topic), callback)
        return super().create_subscription(msg_type, topic, guard, *given, **named)

    def create_timer(self, timer_period_sec: float, callback: Any, *given: Any, **named: Any) -> Timer:
        """A timer with a callback that cannot end the node."""
        guard = self.guarded(f"timer {getattr(callback, '__name__', 'callback')}", callback)
        return super().create_timer(timer_period_sec, guard, *given, **named)

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, *given: Any, **named: Any) -> Service:
        """A service with a callback that cannot end the node; where that raises, whoever called gets an answer."""
        guard = self.guarded(f"service {srv_name}", callback)

        def answer(request: Any, response: Any) -> Any:
            answered = guard(request, response)
            if answered is None:
                answered = srv_type.Response()
                if hasattr(answered, "message"):
                    answered.message = "failed; the log of the node says why"
            return answered

        return super().create_service(srv_type, srv_name, answer, *given, **named)

    def _without_false_times(self, callback: Callable[[ClockMessage], None]) -> Callable[[ClockMessage], None]:
        """rclpy's own reader of ``/clock`` without times that there are not, for which it would raise."""

        def checked(message: ClockMessage) -> None:
            with contextlib.nullcontext() if not self.simulated else contextlib.suppress(MessageError):
                to_nanoseconds(message.clock)
                callback(message)

        return checked

    # --- messages

    def skeleton_qos(self) -> QoSProfile:
        """Of skeleton topics, by the parameter ``reliable``."""
        return to_profile(shared_skeleton_qos(self.values))

    def result_qos(self) -> QoSProfile:
        """Of results, which are reliable; as deep as skeletons by the parameter ``reliable``."""
        return to_profile(shared_result_qos(self.values))

    def full_name(self, topic: str) -> str:
        """The full name of a topic of the graph, in this node's namespace and as it is remapped."""
        return str(self.resolve_topic_name(names.relative(topic)))

    def make_publisher(self, kind: type[Any], topic: str, qos: QoSProfile) -> Publisher:
        """Publish on a topic of the graph."""
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
        """Subscribe, so that a message which is not as it should be is counted and logged, and never ends the node.

        Args:
            topic: of the graph.
            kind: the message class.
            qos: the profile.
            handle: takes the message, and the wall time in nanoseconds at which it was sent.
            raw: hand over the message as CDR bytes.
            absolute: the name was chosen by the user, and one with a leading slash holds in every namespace.
        """
        name = self.resolve_topic_name(topic) if absolute else self.full_name(topic)

        def callback(message: Any, info: dict[str, int]) -> None:
            self.sequences.note(name, info["publication_sequence_number"])
            self.monitor.arrived(name)
            self._arrived(info)
            handle(message, info["source_timestamp"])

        checked: Any = callback  # rclpy passes the message info to callbacks of two arguments
        return self.create_subscription(kind, topic if absolute else names.relative(topic), checked, qos, raw=raw)

    def subscribe_to_skeletons(self, topic: str, handle: Callable[[tuple[Skeleton, ...], int], None]) -> Subscription:
        """Subscribe to a skeleton topic; a backward jump of its stamps calls :meth:`time_jumped_back` first."""
        name = self.full_name(topic)

        def convert(cdr: bytes, sent_ns: int) -> None:
            if self.is_stale(name, sent_ns):
                return
            skeletons = decode_skeletons(cdr) or cloud_to_skeletons(deserialized(cdr, PointCloud2))
            if self.monitor.message_in(topic, skeletons[0].stamp_ns):
                self.log_throttled("jump", f"{name}: time jumped back, starting anew", period_s=1.0)
                self.time_jumped_back(topic)
            handle(skeletons, sent_ns)

        qos = self.skeleton_qos()
        qos.depth = max(qos.depth, FRAMES_KEPT)
        subscription = self.subscribe(topic, PointCloud2, qos, convert, raw=True)
        if not self.values["reliable"]:
            self._droppable[subscription] = name
        return subscription

    def is_stale(self, topic: str, sent_ns: int) -> bool:
        """Whether a frame was sent before this process stood still, and is too old now; never with ``reliable``."""
        return not self.values["reliable"] and self.standstill.is_stale(topic, sent_ns, time.time_ns())

    def drop_late(self, messages: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        """All messages but frames that are too late where the node is too slow; called by the executor."""
        frames = [place for place, (subscription, _) in enumerate(messages) if subscription in self._droppable]
        if not frames:
            self.backlog.late((), time.time_ns())
            return messages
        taken = [(self._droppable[messages[place][0]], messages[place][1][1]) for place in frames]
        arrived = [(topic, info["received_timestamp"]) for topic, info in taken]
        late = {frames[each] for each in self.backlog.late(arrived, time.time_ns())}
        for place in late:
            subscription, (_, info) = messages[place]
            self.sequences.note(self._droppable[subscription], info["publication_sequence_number"])
        return [each for place, each in enumerate(messages) if place not in late] if late else messages

    def work_done(self) -> None:
        """Note how long that took; called by the executor."""
        if self._droppable:
            self.backlog.done(time.time_ns())

    def time_jumped_back(self, topic: str) -> None:
        """Forget the state, because the stamps of an input jumped back."""

    def send(self, publisher: Publisher, message: Any, stamp_ns: int | None = None, sent_ns: int | None = None) -> bool:
        """Publish and count; nothing is published if the process stood still since it received the input.

        Args:
            publisher: where to.
            message: what; a message, or one as CDR bytes.
            stamp_ns: its capture time, for the latency.
            sent_ns: wall time at which the input that it answers was sent, for the delay.

        Returns:
            Whether the message was published.
        """
        if sent_ns is not None and self.is_stale(publisher.topic_name, sent_ns):
            return False
        publisher.publish(message)
        self.monitor.message_out(
            publisher.topic_name,
            None if sent_ns is None else time.time_ns() - sent_ns,
            None if stamp_ns is None or not self.monitor.wants_latency() else self.now_ns() - stamp_ns,
        )
        return True

    def malformed(self, topic: str, reason: str, what: str = "malformed") -> None:
        """Count a message that is not used, and why."""
        self.monitor.totals[what] += 1
        self.monitor.last_reason = f"{topic}: {reason}"
        self.log_throttled(f"{what} {topic}", f"{topic}: {what} message ignored: {reason}")

    def log_throttled(self, key: str, text: str, period_s: float = _LOG_PERIOD_S) -> None:
        """Warn, but not again about the same within some seconds."""
        if self._may_log(key, period_s):
            self.get_logger().warning(text)

    def _may_log(self, key: str, period_s: float = _LOG_PERIOD_S) -> bool:
        """Whether something is to be logged: not again within some seconds."""
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
        """Report every second, and at once when somebody else listens: a source may wait for that."""
        if time.monotonic() - self._reported >= _REPORT_S or self._reported_subscribers != self._subscriber_counts():
            self._report()

    def _report(self) -> None:
        self._reported = time.monotonic()
        self._reported_subscribers = self._subscriber_counts()
        level, text, values = self.state()
        values = {**self.monitor.values(), **self._reported_subscribers, **values}
        values |= {f"dropped {topic}": count for topic, count in self.backlog.dropped.items()}
        values |= {f"lost {topic}": count for topic, count in self.sequences.lost.items()}
        values |= {f"left out after a standstill {topic}": n for topic, n in self.standstill.left_out.items()}
        for topic, nodes in self._doubled().items():
            values[f"publishers {topic}"] = ", ".join(nodes)
            said = f"{len(nodes)} publishers of {topic}: {', '.join(nodes)}"
            level, text = max(level, 1), said + (f"; {text}" if text else "")
            self.log_throttled(f"publishers {topic}", said, _DOUBLED_PERIOD_S)
        dropped = self.backlog.dropped - self._reported_dropped
        if dropped:
            self._reported_dropped = Counter(self.backlog.dropped)
            said = ", ".join(f"{count} frames of {topic}" for topic, count in sorted(dropped.items()))
            level, text = max(level, 1), f"too slow: dropped {said}" + (f"; {text}" if text else "")
            self.log_throttled("dropped", text)
        failures = self.monitor.failures.total()
        if failures > self._reported_failures:
            self._reported_failures = failures
            said = f"{failures} callbacks failed, lately of {next(reversed(self.monitor.failures))}"
            level, text = max(level, 2), said + (f"; {text}" if text else "")
        if self.monitor.totals["malformed"] and level == 0:
            text = text or f"{self.monitor.totals['malformed']} malformed messages"
        message = diagnostics(self.now_ns(), self._status_name, "", level, text or _STATE_LEVELS[level], values, ROS)
        self._diagnostics.publish(message)

    def publishers_of(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic, this one's among them; one that was killed for 20 s more."""
        found = self.get_publishers_info_by_topic(topic)
        return sorted(f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in found)

    def _doubled(self) -> dict[str, list[str]]:
        """Who publishes the inputs that should have one publisher and have several.

        Where their nodes have the same name, one may be what DDS still knows of a node that was killed and started
        again. They count once messages come from them in turn, or when DDS would have forgotten the dead one.
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
        """How many subscribers this node has found of each of its outputs: none yet is why nothing arrives."""
        return {
            f"subscribers {each.topic_name}": each.get_subscription_count()
            for each in self.publishers
            if each.topic_name not in _EVERYWHERE
        }


def deserialized(cdr: bytes, kind: type[Any]) -> Any:
    """A message of CDR bytes.

    Raises:
        MessageError: they are no such message.
    """
    try:
        return deserialize_message(cdr, kind)
    except Exception as error:  # the client library's own kinds of errors, one per RMW
        raise MessageError(f"{len(cdr)} bytes are no {kind.__name__}") from error
