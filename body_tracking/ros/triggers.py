"""The ``std_srvs/srv/Trigger`` services in the ROS domain: which there are, and a call."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from body_tracking.core import names
from body_tracking.ros.call import CallError, where
from body_tracking.ros.discovery import PATIENCE, SETTLED

ANSWER_S: Final = 30.0
"""Seconds for an answer: closing a long recording takes some."""
_TRIGGER: Final = "std_srvs/srv/Trigger"
_LOOK: Final = 0.1


class Triggers:
    """Discovers and calls services until it is closed.

    Args:
        namespace: in which they are looked for, and to which a name without a leading slash is relative.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace, self._context = namespace, rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(f"body_tracking_call_{time.time_ns()}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _types(self) -> dict[str, list[str]]:
        return dict(self._node.get_service_names_and_types())

    def now(self) -> list[str]:
        """The services that have been discovered, sorted, relative to the namespace."""
        # a name without a server belongs to a client alone; the viewer has a client for each service
        kinds = {name: kinds for name, kinds in self._types().items() if self._node.count_services(name)}
        found = (names.within(name, self._namespace) for name in kinds if _TRIGGER in kinds[name])
        return sorted(name.removeprefix("/") for name in found if name is not None)

    def look(self) -> list[str]:
        """The services, once no more appear; empty where none appears for :data:`PATIENCE`."""
        found: list[str] = []
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            time.sleep(_LOOK)
            now = self.now()
            if now != found:
                end, found = time.monotonic() + SETTLED, now
        return found

    def call(self, service: str) -> str:
        """Call a service.

        Returns:
            Its message, or "done" for an empty one.

        Raises:
            CallError: it is not there, refused, or did not answer.
        """
        name = service if service.startswith("/") else f"{self._namespace.rstrip('/')}/{service}"
        client = self._node.create_client(Trigger, name)
        if not self._until(client.service_is_ready, PATIENCE):
            raise CallError(self._absent(name))
        future = client.call_async(Trigger.Request())
        if not self._until(future.done, ANSWER_S):
            raise CallError(f"{name}: no answer within {ANSWER_S:.0f} s")
        answer = future.result()
        if answer is None or not answer.success:
            raise CallError(f"{name}: {(answer and answer.message) or 'refused'}")
        return answer.message or "done"

    def _until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Wait, in steps that leave room for Ctrl-C."""
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=_LOOK)
        return condition()

    def _absent(self, name: str) -> str:
        kinds = [kind for kind in self._types().get(name, []) if kind != _TRIGGER]
        if kinds:
            return f"{name} is a service of type {', '.join(kinds)}, not {_TRIGGER}"
        there = self.now()
        listed = (
            f"there: {', '.join(there)}" if there else "does body_tracking up run, in a shell with the same variables?"
        )
        return f"no service {name} {where(self._namespace)}; {listed}"
