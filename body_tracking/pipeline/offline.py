"""The offline runner: stages that exchange messages in one process, in a fixed order."""

from __future__ import annotations

import contextlib
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.messages.codecs import Wire
from body_tracking.pipeline.stage import FAILURES, Now, Output, Port, Stage

_LOOKS = 2
"""Looks at the same topics after which a stage changes its inputs."""


def connect(stages: Sequence[Stage], published: Iterable[str] = ()) -> None:
    """Let each stage choose its inputs among the outputs of all stages and other published topics."""
    there = {port.topic for stage in stages for port in stage.outputs} | set(published)
    for stage in stages:
        for _ in range(_LOOKS):
            stage.look(there.__contains__)


class OfflineRunner:
    """Feeds stages with messages, and passes their outputs to each other and to a sink.

    Stages exchange serialised messages, with single precision where the messages have it, so that the results are
    those of the live graph.

    Args:
        stages: in the order in which they take each message.
        wire: for messages that this package does not write itself.
        sink: gets topic, message and time of every output.
        published: topics that are not outputs of these stages.

    Attributes:
        counters: inputs that could not be used, by topic, and failures of the stages.
        reasons: by counter, why the first could not.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        wire: Wire,
        sink: Callable[[str, bytes, int], None],
        published: Iterable[str] = (),
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self._stages, self._wire, self._sink = stages, wire, sink
        self._queue: deque[tuple[str, bytes]] = deque()
        self._last_ns: dict[tuple[str, int], int] = {}
        self._failed_in_a_row: Counter[tuple[str, int]] = Counter()
        connect(stages, published)
        self._outputs = [{port.topic: port for port in stage.outputs} for stage in stages]
        self._inputs: dict[str, list[tuple[int, Stage, Port]]] = {}
        for number, stage in enumerate(stages):
            for port in stage.inputs:
                self._inputs.setdefault(port.topic, []).append((number, stage, port))

    @property
    def problems(self) -> tuple[str, ...]:
        """The counters with their reasons, a line each."""
        return tuple(f"{what}: {self.counters[what]}, the first: {why}" for what, why in self.reasons.items())

    @property
    def outputs(self) -> tuple[Port, ...]:
        """The outputs of all stages."""
        return tuple(port for ports in self._outputs for port in ports.values())

    def start(self, at_ns: int) -> None:
        """Publish the outputs that the stages have before the first message."""
        for number, stage in enumerate(self._stages):
            self._publish(self._encoded(number, stage.start(Now(at_ns, at_ns))), at_ns)
        self._deliver(at_ns)

    def push(self, topic: str, cdr: bytes, at_ns: int) -> None:
        """Take one message from outside, at the time at which it was recorded."""
        self._poll(at_ns)
        self._queue.append((topic, cdr))
        self._deliver(at_ns)

    def finish(self, at_ns: int) -> None:
        """Publish the outputs that still wait for later messages."""
        for number, stage in enumerate(self._stages):
            self._publish(self._guarded(number, "what waited", stage.drain), at_ns)
            self._deliver(at_ns)

    def _poll(self, at_ns: int) -> None:
        """Let every stage publish the outputs that are due."""
        for number, stage in enumerate(self._stages):
            due_ns = stage.deadline_ns if stage.deadline_ns is not None else stage.due_ns
            if due_ns is not None and due_ns <= at_ns:
                self._publish(self._guarded(number, "what waited", stage.poll, at_ns), at_ns)
                self._deliver(at_ns)

    def _deliver(self, at_ns: int) -> None:
        """Deliver the queued messages, and the outputs that follow from them, in the order of publication."""
        now = Now(at_ns, at_ns)
        while self._queue:
            topic, cdr = self._queue.popleft()
            decoded: dict[type, Any] = {}
            counted = False
            for number, stage, port in self._inputs.get(topic, ()):
                kind = type(port.codec)
                if kind not in decoded:
                    try:
                        decoded[kind] = port.codec.decode(cdr, self._wire)
                    except Exception as error:
                        ours = isinstance(error, BodyTrackingError)
                        if not counted:
                            self._count(topic, error, "malformed" if ours else "failed")
                        counted = True
                        if ours:
                            stage.refused(topic)
                        continue
                taken = self._guarded(number, topic, self._take, number, stage, port, decoded[kind], now)
                self._publish(taken, at_ns)
                self._publish(self._guarded(number, "what waited", stage.poll, at_ns), at_ns)

    def _take(self, number: int, stage: Stage, port: Port, payload: Any, now: Now) -> Iterable[Output]:
        """Pass a message to a stage, which is reset before if the stamps jumped back."""
        stamp_ns, key = port.codec.stamp_ns(payload), (port.topic, number)
        if stamp_ns is not None:
            if jumped_back(stamp_ns, self._last_ns.get(key)):
                stage.reset(port.topic)
            self._last_ns[key] = stamp_ns
        return stage.take(port.topic, payload, now)

    def _guarded(
        self, number: int, where: str, call: Callable[..., Iterable[Output]], *given: Any
    ) -> Iterator[tuple[str, bytes]]:
        """The messages of a call of a stage; an error ends them and is counted, as in a node."""
        try:
            yield from self._encoded(number, call(*given))
        except BodyTrackingError as error:
            self._count(where, error, "refused")
        except Exception as error:
            self._count(where, error, "failed")
            self._failed_in_a_row[where, number] += 1
            if self._failed_in_a_row[where, number] % FAILURES == 0:
                with contextlib.suppress(Exception):
                    self._stages[number].restart()
        else:
            self._failed_in_a_row.pop((where, number), None)

    def _count(self, where: str, error: Exception, what: str) -> None:
        reason = str(error)
        if not isinstance(error, BodyTrackingError):
            *_, place = traceback.extract_tb(error.__traceback__)
            reason = f"{type(error).__name__}: {reason} ({Path(place.filename).name}, line {place.lineno})"
        self.counters[f"{what} {where}"] += 1
        self.reasons.setdefault(f"{what} {where}", reason)

    def _encoded(self, number: int, outputs: Iterable[Output]) -> Iterator[tuple[str, bytes]]:
        for output in outputs:
            port = self._outputs[number][output.topic]
            if not port.optional:
                yield output.topic, port.codec.encode(output.payload, self._wire)

    def _publish(self, messages: Iterable[tuple[str, bytes]], at_ns: int) -> None:
        for topic, cdr in messages:
            self._sink(topic, cdr, at_ns)
            self._queue.append((topic, cdr))
