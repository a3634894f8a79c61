"""The node that hosts a stage: its topics, services, alarms and parameters, over ROS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, ClassVar

from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import Value
from body_tracking.core.qos import Qos, request_for
from body_tracking.pipeline.stage import Now, Output, Port, Stage
from body_tracking.ros.bag_topics import UnknownTypeError, from_profile, message_class, to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import STEADY, GraphNode
from body_tracking.ros.wire import WIRE
from body_tracking.systems import stage_class

_LOOK_S = 0.1
"""Seconds between two checks of the published topics."""
_AGAIN_NS = 100_000_000
"""Nanoseconds from an error in what is due until the next attempt."""
_SILENT_S = 3.0
"""Seconds without a message from which a node says that nothing of a driver arrives."""
_SAVE_S = 2.0
"""Seconds between two writes of the stage's state to disk."""


class StageNode(GraphNode):
    """Base of the nodes that host a stage of the class ``STAGE``."""

    STAGE: ClassVar[type[Stage]]

    def __init_subclass__(cls) -> None:
        cls.NAME, cls.PARAMETERS = cls.STAGE.NAME, cls.STAGE.PARAMETERS
        cls.__doc__ = cls.STAGE.__doc__

    def __init__(self) -> None:
        self.inputs: dict[str, tuple[Port, Subscription]] = {}
        self.outputs: dict[str, tuple[Port, Publisher | None]] = {}
        self._requested: dict[str, Qos] = {}
        self.sent_ns: int | None = None
        """Wall time at which the current message was sent."""
        super().__init__()

    def configure(self, values: Mapping[str, Value]) -> None:
        self.stage = self.STAGE(values, self.wanted)

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        self.stage.change(values)
        self.connect()

    def start(self) -> None:
        self._started = time.monotonic()
        self.due = self.make_alarm(self.poll)
        self.connect()
        for name, action in self.stage.services.items():
            self.create_service(Trigger, name, partial(self.answer, action))
        if any(port.foreign for port in self.stage.inputs):
            self.create_timer(_LOOK_S, self.adapt, clock=STEADY)
        if type(self.stage).look is not Stage.look:
            self.create_timer(_LOOK_S, self.look, clock=STEADY)
        if type(self.stage).save is not Stage.save:
            self.create_timer(_SAVE_S, self.stage.save, clock=STEADY)
        self.publish(self.stage.start(Now(self.now_ns(), self.waiting_ns())))
        self.poll()  # a stage that needs no message has its first output due

    def connect(self) -> None:
        """Make and destroy publishers and subscriptions so that they match the stage's outputs and inputs."""
        offered = {port.topic: port for port in self.stage.outputs}
        for topic in self.outputs.keys() - offered.keys():
            _, publisher = self.outputs.pop(topic)
            if publisher is not None:
                self.destroy_publisher(publisher)
        for topic, port in offered.items():
            publisher = self.outputs[topic][1] if topic in self.outputs else self._publisher(port)
            self.outputs[topic] = port, publisher
        taken = {port.topic: port for port in self.stage.inputs}
        for topic in self.inputs.keys() - taken.keys():
            self.unsubscribe_port(*self.inputs.pop(topic))
        for topic, port in taken.items():
            self.inputs[topic] = port, self.inputs[topic][1] if topic in self.inputs else self._subscription(port)

    def _publisher(self, port: Port) -> Publisher | None:
        try:
            return self.make_publisher(message_class(port.codec.type_name), port.topic, to_profile(port.qos))
        except UnknownTypeError:
            if not port.optional:
                raise
            return None

    def _request(self, port: Port) -> Qos:
        """The profile of an input's subscription, whose depth is at least that of the waiting messages."""
        depth = max(port.qos.depth, port.waiting)
        if port.foreign and (publishers := self.get_publishers_info_by_topic(self.full_name(port.topic))):
            return request_for([from_profile(each.qos_profile) for each in publishers], depth)
        return replace(port.qos, depth=depth)

    def adapt(self) -> None:
        """Subscribe again where the publishers of another package offer another quality of service than before."""
        for topic, (port, subscription) in tuple(self.inputs.items()):
            if port.foreign and self._request(port) != self._requested[topic]:
                self.unsubscribe_port(port, subscription)
                self.inputs[topic] = port, self._subscription(port)

    def _subscription(self, port: Port) -> Subscription:
        requested = self._requested[port.topic] = self._request(port)
        kind = message_class(port.codec.type_name)
        return self.subscribe_port(port, requested, kind, partial(self.on_message, port.topic))

    def wanted(self, topic: str) -> bool:
        """Whether a topic has subscribers."""
        _, publisher = self.outputs[topic]
        return publisher is not None and publisher.get_subscription_count() > 0

    # --- messages

    def on_message(self, topic: str, cdr: bytes, sent_ns: int) -> None:
        """Decode a message, pass it to the stage and publish its outputs."""
        port, _ = self.inputs[topic]
        if port.perishable and self.is_stale(self.full_name(topic), sent_ns):
            return
        try:
            payload = port.codec.decode(cdr, WIRE)
        except BodyTrackingError:
            self.stage.refused(topic)
            raise
        stamp_ns = port.codec.stamp_ns(payload)
        if stamp_ns is not None and self.monitor.message_in(topic, stamp_ns):
            self.log_jump(self.full_name(topic))
            self.stage.reset(topic)
        self.sent_ns = sent_ns
        self.publish(self.stage.take(topic, payload, Now(self.arrived_ns, self.arrived_waiting_ns)))
        if self.simulated:  # after each message, as offline
            self.poll()

    def batch_done(self) -> None:
        """Publish the outputs that are due after a batch of messages; called by the executor."""
        self.poll()
        self.stage.settle()
        self.sent_ns = None

    def poll(self) -> None:
        """Publish the outputs that are due, and set the alarm for the next deadline.

        After an error it is a moment later: what cannot be used may wait on, and be due at once.
        """
        now_ns = self.waiting_ns()
        earliest_ns = now_ns + _AGAIN_NS
        try:
            self.publish(self.stage.poll(now_ns))
            earliest_ns = 0
        except BodyTrackingError as error:
            self.malformed("a message that waited", str(error), "refused")
        finally:
            due_ns = self.stage.due_ns if self.stage.deadline_ns is None else self.stage.deadline_ns
            self.due.at(None if due_ns is None else max(due_ns, earliest_ns))

    def publish(self, outputs: Iterable[Output]) -> None:
        """Publish outputs of the stage, and log its events."""
        for output in outputs:
            port, publisher = self.outputs[output.topic]
            if publisher is None:
                continue
            cdr = port.codec.encode(output.payload, WIRE)
            if port.measured:
                self.send(publisher, cdr, output.stamp_ns, self.sent_ns)
            elif self.sent_ns is None or not self.is_stale(publisher.topic_name, self.sent_ns):
                publisher.publish(cdr)
        self.log_events()

    def log_events(self) -> None:
        while self.stage.events:
            self.get_logger().info(self.stage.events.pop(0))

    # --- everything else

    def look(self) -> None:
        """Let the stage choose its inputs among the published topics."""
        if self.stage.look(lambda topic: self.count_publishers(self.full_name(topic)) > 0):
            self.connect()

    def answer(self, action: Callable[[], str], request: Any, response: Any) -> Any:
        response.message, response.success = action(), True
        self.get_logger().info(response.message)
        self._report()  # robot_commands must not wait a second to know that the calibration was reset
        return response

    def finish(self) -> None:
        self.publish(self.stage.drain())

    def restart(self) -> None:
        self.stage.restart()

    def state(self) -> tuple[int, str, dict[str, object]]:
        level, text, values = self.stage.state(self.now_ns())
        if not level and (silent := self._silent_drivers()):
            level, text = 1, f"nothing arrives on {', '.join(silent)}"
        self.log_events()
        return level, text, {**self.stage.counters, **values}

    def _silent_drivers(self) -> list[str]:
        """The needed topics of other packages' drivers, if nothing has arrived at all; a bag's are checked before."""
        started = time.monotonic() - self._started > _SILENT_S
        if self.monitor.totals["received"] or not started or self.get_parameter("use_sim_time").value:
            return []
        return [topic for topic, (port, _) in self.inputs.items() if port.foreign and not port.optional]

    def close(self) -> None:
        try:
            self.stage.save()
            self.log_events()
        except BodyTrackingError as error:
            self.get_logger().error(str(error))


@cache
def node_of(executable: str) -> type[StageNode]:
    """The class of the node that hosts the stage of this executable."""

    class Host(StageNode):
        STAGE = stage_class(executable)

    return Host


def main_of(executable: str) -> Callable[[], None]:
    """``main`` of that node."""
    return partial(run, node_of(executable))
