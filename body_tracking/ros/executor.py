"""An executor for one node with little overhead per message.

rclpy's ``SingleThreadedExecutor`` collects the node's entities and makes a wait set, a generator, a task and a
coroutine for every message: about 0.2 ms, more than the work of most of our nodes. (``EventsExecutor`` of rclpy 7.1.6
on PyPI uses a whole processor while idle, and its ``spin`` does not return at shutdown.)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.waitable import NumberOfEntities

_LOOK_PERIOD_NS = 100_000_000
"""Nanoseconds between two checks of services and events while messages keep coming; each costs as much as a message."""
_MESSAGE_ONLY = Subscription.CallbackType.MessageOnly


class BatchNode(Node):
    """A node whose messages come in batches: all messages that wait when the executor checks."""

    def guarded(self, where: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """A callback that returns None instead of raising; ``where`` names it in the log."""
        return callback

    def drop_late(self, messages: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
        """The messages of a batch to be handled, each with its subscription, in the same order."""
        return messages

    def batch_done(self) -> None:
        """Called after the callbacks of a batch."""


class LeanExecutor(SingleThreadedExecutor):
    """Runs one node's callbacks in the thread that calls :meth:`spin`; its callbacks are no coroutines.

    Messages and timers are executed directly, with a wait set that is kept. rclpy executes everything else (services,
    events, guard conditions), which is checked ten times a second while messages keep coming. Timers run after the
    messages: the timeout of a message must not fire while that message waits in a queue.
    """

    def __init__(self, node: BatchNode) -> None:
        super().__init__(context=node.context)
        self._batch_done = node.guarded("messages", node.batch_done)
        self._changed = True
        self._stopped = False
        self._until_ns: int | None = None
        self.add_node(node)
        self._node = node

    def wake(self) -> None:
        """Called by rclpy whenever the node's entities have changed."""
        self._changed = True
        super().wake()

    def stop(self) -> None:
        """Make :meth:`spin` return; from any thread."""
        self._stopped = True
        self.wake()

    def finish(self) -> None:
        """Make :meth:`spin` return after all waiting messages that were sent before this call; from any thread."""
        self._until_ns = time.time_ns()
        self.wake()

    def spin(self) -> None:
        """Execute callbacks until :meth:`stop` or :meth:`finish`.

        Raises:
            ExternalShutdownException: the context was shut down.
        """
        while self._context.ok():
            if self._stopped:
                return
            try:
                self._spin_same_entities()
            except InvalidHandle:
                continue  # an entity was destroyed before it was used
        raise ExternalShutdownException

    def _spin_same_entities(self) -> None:
        """Execute callbacks until the node's entities change."""
        self._changed = False
        node = self._node
        subscriptions, timers = list(node.subscriptions), list(node.timers)
        clients, services, waitables = list(node.clients), list(node.services), list(node.waitables)
        guards = [*node.guards, self._guard, self._sigint_gc]
        count = NumberOfEntities(len(subscriptions), len(guards), len(timers), len(clients), len(services))
        for waitable in waitables:
            count += waitable.get_num_entities()
        with ExitStack() as used:  # keeps destroyed entities until the wait set no longer needs them
            context: Any = self._context.handle
            used.enter_context(context)
            for entity in (*subscriptions, *timers, *clients, *services, *guards):
                used.enter_context(entity.handle)
            for waitable in waitables:
                used.enter_context(waitable)
            usual = _rclpy.WaitSet(
                count.num_subscriptions, count.num_guard_conditions, count.num_timers, 0, 0, 0, context
            )
            everything = _rclpy.WaitSet(
                count.num_subscriptions,
                count.num_guard_conditions,
                count.num_timers,
                count.num_clients,
                count.num_services,
                count.num_events,
                context,
            )
            # a message that the middleware cannot deserialise is left out
            takes = [node.guarded(f"taking {each.topic_name}", each.handle.take_message) for each in subscriptions]
            looked_ns = 0
            ready_since_ns: int | None = None
            while not self._changed:
                since_ns = time.monotonic_ns() - looked_ns
                whole = since_ns >= _LOOK_PERIOD_NS
                wait_set = everything if whole else usual
                wait_set.clear_entities()
                for subscription in subscriptions:
                    wait_set.add_subscription(subscription.handle)
                for timer in timers:
                    wait_set.add_timer(timer.handle)
                for guard in guards:
                    wait_set.add_guard_condition(guard.handle)
                if whole:
                    looked_ns = time.monotonic_ns()
                    for client in clients:
                        wait_set.add_client(client.handle)
                    for service in services:
                        wait_set.add_service(service.handle)
                    for waitable in waitables:
                        waitable.add_to_wait_set(wait_set)
                until_ns = self._until_ns
                wait_set.wait(0 if until_ns is not None else -1 if whole else _LOOK_PERIOD_NS - since_ns)
                if not self._context.ok():
                    return
                messages = _take_all(subscriptions, takes, wait_set)
                if until_ns is not None:
                    messages = [each for each in messages if each[1][1]["source_timestamp"] <= until_ns]
                    if not messages:
                        self._stopped = True
                        return
                if messages:
                    messages = node.drop_late(messages)
                for subscription, taken in messages:
                    if self._stopped:
                        return
                    only_message = subscription._callback_type is _MESSAGE_ONLY
                    subscription.callback(*(taken[:1] if only_message else taken))
                if messages:
                    self._batch_done()
                executed = len(messages) + _execute_timers(timers)
                if self._changed or not _others_ready(wait_set, waitables if whole else []):
                    ready_since_ns = None
                    continue
                looked_ns = 0  # check again at once: there may be several
                ready_since_ns = ready_since_ns or time.monotonic_ns()
                # also in a node that is always busy with messages
                if not executed or time.monotonic_ns() - ready_since_ns > _LOOK_PERIOD_NS:
                    self._spin_once_impl(0)


def _others_ready(wait_set: Any, waitables: list[Any]) -> bool:
    """Whether anything except messages and timers is ready."""
    kinds = ("guard_condition", "client", "service")
    return any(wait_set.get_ready_entities(kind) for kind in kinds) or any(
        waitable.is_ready(wait_set) for waitable in waitables
    )


def _take_all(subscriptions: list[Any], takes: list[Callable[..., Any]], wait_set: Any) -> list[tuple[Any, Any]]:
    """All waiting messages, each with its subscription, in the order in which they were sent.

    So a node that lags behind handles the frames of several sensors in the same order as an offline run.
    """
    arrived: list[tuple[int, int, Any]] = []
    found = bool(wait_set.get_ready_entities("subscription"))
    # Until one pass finds nothing: an earlier message may have arrived on a topic that this pass had already read.
    while found:
        found = False
        for index, (subscription, take) in enumerate(zip(subscriptions, takes, strict=True)):
            while (taken := take(subscription.msg_type, subscription.raw)) is not None:
                found = True
                arrived.append((taken[1]["source_timestamp"], index, taken))
    arrived.sort(key=lambda each: each[:2])
    return [(subscriptions[index], taken) for _, index, taken in arrived]


def _execute_timers(timers: list[Timer]) -> int:
    executed = 0
    for timer in timers:
        if timer.handle.is_timer_ready():
            executed += 1
            timer.handle.call_timer()
            timer.callback()
    return executed
