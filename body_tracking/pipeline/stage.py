"""A stage: what one node does, without ROS.

A node hosts a stage (:mod:`body_tracking.ros.host`), and the offline runner hosts the same stages
(:mod:`body_tracking.pipeline.offline`); both decode what a stage takes and encode what it returns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import Qos
from body_tracking.messages.codecs import Codec


class Now(NamedTuple):
    """When a message arrived.

    Attributes:
        ros_ns: in ROS time, nanoseconds; in a replay the time at which it was recorded.
        steady_ns: in a clock that never goes back, nanoseconds; in a replay the same as ``ros_ns``.
    """

    ros_ns: int
    steady_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Port:
    """A topic that a stage takes or publishes.

    Attributes:
        topic: its name in the root namespace.
        codec: of its messages.
        qos: what publishers offer.
        waiting: messages of an input that may wait while the stage is busy; 0 for the depth of ``qos``.
        droppable: an input of which a node that is too slow drops the oldest messages.
        perishable: an input that is of no use when it was sent before the process stood still.
        measured: an output whose delay and latency are reported.
        optional: an output whose message type not every installation has: left out there, and offline.
        absolute: the user chose the name, which holds in every namespace where it begins with a slash.
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
        wanted: whether anybody listens to a topic of this name; nobody needs messages that are not wanted.

    Attributes:
        NAME: of the node.
        PARAMETERS: of the node.
        events: lines for the log, which the host takes out.
        inputs: topics that it takes; may change with the parameters, and when :meth:`look` says so.
        outputs: topics that it publishes; may change with the parameters.
        services: what ``std_srvs/Trigger`` services of these names do; each returns a line for whoever called.

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
        """Take other values of the parameters that are live.

        Raises:
            BodyTrackingError: they do not go together, or not now; nothing has changed.
        """
        self.values = values

    def start(self, now: Now) -> Iterable[Output]:
        """What holds before the first message."""
        return ()

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        """One message of an input.

        Raises:
            BodyTrackingError: it is of no use.
        """
        raise NotImplementedError

    def poll(self, steady_ns: int) -> Iterable[Output]:
        """What is due at a time; to be called at :attr:`deadline_ns`, and after messages."""
        return ()

    @property
    def deadline_ns(self) -> int | None:
        """When a message that waits is due, in steady time; None where none waits."""
        return None

    @property
    def due_ns(self) -> int | None:
        """When :meth:`poll` has something to publish though no message waits; None for never."""
        return None

    def settle(self) -> None:
        """Do what the next message would have to wait for; called when there is nothing else to do."""

    def drain(self) -> Iterable[Output]:
        """At the end: what waits for messages that do not come."""
        while (deadline_ns := self.deadline_ns) is not None:
            yield from self.poll(deadline_ns)

    def refused(self, topic: str) -> None:
        """A message of an input could not be decoded."""

    def reset(self, topic: str) -> None:
        """Forget what was seen, because the stamps of an input jumped back."""

    def look(self, published: Callable[[str], bool]) -> bool:
        """Follow what other nodes publish; whether :attr:`inputs` have changed."""
        return False

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Level, line and values for diagnostics."""
        return 0, "", {}

    def save(self) -> None:
        """Write to disk what is to outlive the process; called every other second, and at the end.

        Raises:
            BodyTrackingError: it cannot be written.
        """

    @property
    def counters(self) -> Mapping[str, int]:
        """What happened since the construction."""
        return {}
