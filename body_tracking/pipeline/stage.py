"""A stage: the processing of one node, without ROS.

A node (:mod:`body_tracking.ros.host`) or the offline runner (:mod:`body_tracking.pipeline.offline`) hosts it: the host
decodes the stage's inputs and encodes its outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import Qos
from body_tracking.messages.codecs import Codec

FAILURES = 10
"""Consecutive unexpected errors of one input, or of what waits, after which the host restarts the stage."""


class Now(NamedTuple):
    """When a message arrived.

    Attributes:
        ros_ns: ROS time, nanoseconds; in a replay the time at which it was recorded.
        steady_ns: monotonic time, nanoseconds; in a replay the same as ``ros_ns``.
    """

    ros_ns: int
    steady_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Port:
    """A topic that a stage takes or publishes.

    Attributes:
        topic: its name in the root namespace.
        codec: of its messages.
        qos: of the publishers.
        waiting: least depth of an input's queue, messages; 0 for the depth of ``qos``.
        droppable: an input whose oldest messages are dropped where the node is too slow.
        perishable: an input whose messages are dropped if they were sent before a standstill of the process.
        measured: an output whose delay and latency are reported.
        optional: an output whose message type may not be installed: left out there, and offline; an input that the
            stage does not need.
        absolute: the user chose the name; with a leading slash it holds in every namespace.
        foreign: an input of other packages' publishers: its subscription asks for the strongest quality of service that
            they offer, and for ``qos`` before there are any.
    """

    topic: str
    codec: Codec
    qos: Qos
    waiting: int = 0
    droppable: bool = False
    perishable: bool = False
    measured: bool = False
    optional: bool = False
    absolute: bool = False
    foreign: bool = False


class Output(NamedTuple):
    """A message to be published.

    Attributes:
        topic: one of the stage's outputs.
        payload: for its codec.
        stamp_ns: capture time; None for messages that state none.
    """

    topic: str
    payload: Any
    stamp_ns: int | None = None


class Stage:
    """Base of the stages.

    Args:
        values: of :attr:`PARAMETERS`, checked.
        wanted: whether a topic has a subscriber; outputs without one may be left out.

    Attributes:
        NAME: of the node.
        PARAMETERS: of the node.
        events: lines for the log, which the host removes.
        inputs: topics that it takes; may change with the parameters, and by :meth:`look`.
        outputs: topics that it publishes; may change with the parameters.
        services: callbacks of ``std_srvs/Trigger`` services; each returns a line for the caller.

    Raises:
        BodyTrackingError: the values do not go together.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[tuple[Parameter, ...]]

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        self.values, self.wanted = values, wanted
        self.events: list[str] = []
        self.inputs: tuple[Port, ...] = ()
        self.outputs: tuple[Port, ...] = ()
        self.services: Mapping[str, Callable[[], str]] = {}

    def change(self, values: Mapping[str, Value]) -> None:
        """Change live parameters.

        Raises:
            BodyTrackingError: the values do not go together, or not now; nothing has changed.
        """
        self.values = values

    def start(self, now: Now) -> Iterable[Output]:
        """Outputs before the first message."""
        return ()

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        """Process one message of an input.

        Raises:
            BodyTrackingError: it cannot be used.
        """
        raise NotImplementedError

    def poll(self, steady_ns: int) -> Iterable[Output]:
        """Outputs that are due; called at :attr:`deadline_ns`, and after messages."""
        return ()

    @property
    def deadline_ns(self) -> int | None:
        """Steady time at which a waiting message is due; None where none waits."""
        return None

    @property
    def due_ns(self) -> int | None:
        """Steady time at which :meth:`poll` has an output although no message waits; None for never."""
        return None

    def settle(self) -> None:
        """Do work in advance that the next message would wait for; called when the node is idle."""

    def drain(self) -> Iterable[Output]:
        """Outputs that still wait for messages at the end."""
        while (deadline_ns := self.deadline_ns) is not None:
            yield from self.poll(deadline_ns)

    def refused(self, topic: str) -> None:
        """Called for a message of an input that could not be decoded."""

    def reset(self, topic: str) -> None:
        """Forget the state, because the stamps of an input jumped back."""

    def restart(self) -> None:
        """Forget the state, because it may be the cause of :data:`FAILURES` errors in a row."""
        for port in self.inputs:
            self.reset(port.topic)

    def look(self, published: Callable[[str], bool]) -> bool:
        """Choose the inputs among the published topics; returns whether :attr:`inputs` have changed."""
        return False

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Level, text and values for the diagnostics."""
        return 0, "", {}

    def save(self) -> None:
        """Write the persistent state to disk; called every other second, and at the end.

        Raises:
            BodyTrackingError: it cannot be written.
        """

    @property
    def counters(self) -> Mapping[str, int]:
        """Counts of events since the construction."""
        return {}
