"""The offline runner: no message ends it, as no message ends a node."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from body_tracking.core.qos import RELIABLE
from body_tracking.messages.base import MessageError
from body_tracking.messages.codecs import Codec, Wire
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.stage import Now, Output, Port, Stage
from body_tracking.recording.rosbag2 import BAG_WIRE


class Text(Codec):
    """Bytes as text; what is not UTF-8 raises an error that nobody expects."""

    type_name = "std_msgs/msg/String"

    def encode(self, payload: str, wire: Wire) -> bytes:
        return payload.encode()

    def decode(self, cdr: bytes, wire: Wire) -> str:
        return cdr.decode()


class Echo(Stage):
    """Repeats each word; fails for some, where the word says."""

    NAME = "echo"
    PARAMETERS = ()

    def __init__(self) -> None:
        super().__init__({})
        self.inputs, self.outputs = (Port("/in", Text(), RELIABLE),), (Port("/out", Text(), RELIABLE),)
        self.waiting: list[str] = []

    def take(self, topic: str, payload: str, now: Now) -> Iterator[Output]:
        if payload == "refused":
            raise MessageError("refused")
        if payload == "wait":
            self.waiting.append(payload)
        yield Output("/out", payload)
        if payload == "take":
            raise KeyError(payload)
        if payload == "encode":
            yield Output("/out", 7)

    @property
    def deadline_ns(self) -> int | None:
        return 5 if self.waiting else None

    def poll(self, steady_ns: int) -> Iterable[Output]:
        return [Output("/out", f"{1 // 0}")] if self.waiting and steady_ns >= 5 else ()


def played(words: Iterable[bytes], sink: Callable[[str, bytes, int], None] | None = None) -> tuple[Any, list[bytes]]:
    """The runner, and the words that came out."""
    out: list[bytes] = []
    runner = OfflineRunner([Echo()], BAG_WIRE, sink or (lambda topic, cdr, at_ns: out.append(cdr)))
    for at_ns, word in enumerate(words):
        runner.push("/in", word, at_ns)
    runner.finish(10)
    return runner, out


@pytest.mark.parametrize(
    ("word", "before", "counter", "reason"),
    [
        (b"\xff", [], "failed /in", "UnicodeDecodeError: "),
        (b"take", [b"take"], "failed /in", "KeyError: 'take'"),
        (b"encode", [b"encode"], "failed /in", "AttributeError: "),
        (b"refused", [], "refused /in", "refused"),
        (b"wait", [b"wait"], "failed what waited", "ZeroDivisionError: "),
    ],
)
def test_no_message_ends_a_run(word: bytes, before: list[bytes], counter: str, reason: str) -> None:
    runner, out = played([b"one", word, b"two"])
    assert out == [b"one", *before, b"two"]
    assert runner.counters == {counter: 1}
    assert runner.reasons[counter].startswith(reason)


def test_errors_in_a_row_restart_a_stage() -> None:
    stage = Echo()
    restarts: list[int] = []
    stage.restart = lambda: restarts.append(number)  # type: ignore[method-assign]
    runner = OfflineRunner([stage], BAG_WIRE, lambda topic, cdr, at_ns: None)
    for number, word in enumerate([b"take"] * 9 + [b"one"] + [b"take"] * 21):
        runner.push("/in", word, number)
    assert restarts == [19, 29]
    assert runner.counters == {"failed /in": 30}


def test_an_output_that_cannot_be_written_ends_a_run() -> None:
    def full(topic: str, cdr: bytes, at_ns: int) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        played([b"one"], full)
