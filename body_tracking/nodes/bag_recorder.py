"""Records the serialised messages of topics into a bag."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from std_srvs.srv import Trigger

from body_tracking.core import names
from body_tracking.core.clocks import jumped_back
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import Parameter, ParameterError, Value
from body_tracking.core.qos import LATCHED, Qos, request_for
from body_tracking.pipeline import graph
from body_tracking.pipeline.graph import is_model_covariance
from body_tracking.recording.rosbag2 import BagError, BagWriter
from body_tracking.ros.bag_topics import from_profile, message_class, to_profile
from body_tracking.ros.main import RCLError, run
from body_tracking.ros.node import STEADY, GraphNode

PARAMETERS = (
    Parameter(
        "folder",
        "",
        "the bag; an existing one is continued. Empty for body_tracking_<date and time> in the working directory, a "
        "new one at each start of a recording. May change while nothing is recorded",
        live=True,
    ),
    Parameter(
        "topics",
        (),
        "record only these topics; empty for all that appear in the node's namespace, /tf and /diagnostics. May change "
        "while nothing is recorded",
        live=True,
    ),
    Parameter(
        "exclude",
        ("/clock", "/rosout", "/parameter_events"),
        "topics not to record, where topics is empty. May change while nothing is recorded",
        live=True,
    ),
    Parameter(
        "model_covariance",
        False,
        "where topics is empty: also record /filtered/model_covariance (of each person); with ekf it is most of a "
        "recording, and body_tracking replay computes it again. May change while nothing is recorded",
        live=True,
    ),
    Parameter(
        "start_recording", True, "record from the start; false: wait for recorder/start", fixed="it is about the start"
    ),
    Parameter(
        "chunk_seconds",
        1.0,
        "longest time between two writes to the disk, which a power failure may cost",
        unit="s",
        min=0.01,
        max=3600.0,
    ),
)

_DEPTH = 1000  # messages of a topic that may wait while the disk is slow
_EARLY_S = 1.0
"""With simulated time, messages received within this time before the first ``/clock`` get its time; older ones are
dropped, except for latched ones."""
_EARLY_BYTES = 16 << 20
"""Limit of all waiting messages."""
_MESSAGE_BYTES = 250
"""Approximate memory of a waiting message without its content."""


@dataclass(frozen=True, slots=True)
class _Input:
    """A recorded topic: its type, what its publishers offer, what is requested of them, and the subscription."""

    type_name: str
    offered: tuple[Qos, ...]
    request: Qos
    subscription: Any

    @property
    def latched(self) -> bool:
        return self.request.durability == LATCHED.durability


class BagRecorder(GraphNode):
    """Records one bag; recording can be stopped and continued."""

    NAME = "bag_recorder"
    PARAMETERS = PARAMETERS

    last_ns: int | None
    """Simulated time of the last message."""
    folder: Path | None = None
    """The current bag, or the last one; None before the first recording where the parameter is empty."""

    def configure(self, values: Mapping[str, Value]) -> None:
        given: dict[str, Any] = dict(values)
        chosen, exclude = (self.topics_in(name, given[name]) for name in ("topics", "exclude"))
        self.chosen, self.exclude = chosen, exclude
        self.named = bool(given["folder"])
        if self.named:
            self.use_folder(Path(given["folder"]).expanduser())
        self.model_covariance = bool(given["model_covariance"])

    def topics_in(self, parameter: str, topics: tuple[str, ...]) -> frozenset[str]:
        """The full names of a parameter's topics; ParameterError where one is none."""
        found = set()
        for topic in topics:
            try:
                found.add(self.resolve_topic_name(topic))
            except RCLError as error:
                reason = str(error).partition(", at ")[0]  # then the line in the source of rcl
                raise ParameterError(f"parameter {parameter!r}: {topic!r:.80} is no topic ({reason})") from error
        return frozenset(found)

    def use_folder(self, folder: Path) -> None:
        """Record into this folder from the next start on."""
        self.folder = self.first = folder
        self.last_ns = None

    def reconfigure(self, values: Mapping[str, Value]) -> None:
        """Apply the parameters to the next recording; BagError while a bag is being recorded."""
        if self.writer is not None:
            raise BagError(f"{self.folder} is being recorded; call recorder/stop first, and recorder/start afterwards")
        self.configure(values)

    def start(self) -> None:
        given: dict[str, Any] = dict(self.values)
        self.writer: BagWriter | None = None
        self.inputs: dict[str, _Input] = {}
        self.refused: dict[str, str] = {}
        self.early: list[tuple[float, str, bytes]] = []
        """Messages from before the first ``/clock``: (steady seconds until which it is kept, topic, CDR bytes)."""
        self.before_the_clock = 0
        self.error = ""
        self.written = self.lost = self.n_bytes = 0
        self.create_service(Trigger, "recorder/start", partial(self.answer, self.begin))
        self.create_service(Trigger, "recorder/stop", partial(self.answer, self.stop))
        # Steady timers: a recording goes on while a simulated clock stands still.
        self.create_timer(1.0, self.discover, clock=STEADY)
        self.create_timer(given["chunk_seconds"], self.flush, clock=STEADY)
        if given["start_recording"]:
            self.begin()

    # --- beginning and stopping

    def begin(self) -> str:
        """Record into the next file of the bag; returns the answer to the caller.

        Raises:
            BagError: the bag cannot be written.
        """
        if self.writer is None:
            if not self.named:
                dated = Path(f"body_tracking_{datetime.now():%Y_%m_%d-%H_%M_%S}")
                self.use_folder(_next_to(dated) if dated.exists() else dated)
                self.written = 0
            self.open(self.now_ns() if self.simulated else None)
            self.error = ""
            # After a failure the subscriptions still exist, but the new file lacks their topics.
            for topic in tuple(self.inputs):
                self.forget(topic)
            self.discover()
        return f"recording into {self.folder}"

    def open(self, now_ns: int | None) -> None:
        """Open the folder's next file, or another folder's where simulated time (None without) has jumped back.

        In one bag the messages of both rounds of a player that loops would be mixed.

        Raises:
            BagError: the file cannot be written.
        """
        if now_ns is not None and jumped_back(now_ns, self.last_ns):
            before, self.written = self.folder, 0
            self.folder = _next_to(self.first)
            self.get_logger().warning(f"time has jumped back: {before} is complete, {self.folder} goes on")
        self.last_ns = now_ns
        interval: Any = self.values["chunk_seconds"]
        assert self.folder is not None
        self.writer = BagWriter(self.folder, resume=True, flush_interval_s=interval)
        self.get_logger().info(f"recording into {self.writer.path}")

    def stop(self) -> str:
        """Close the bag; returns the answer to the caller.

        Raises:
            BagError: its end cannot be written.
        """
        for topic in tuple(self.inputs):
            self.forget(topic)
        if self.simulated and self.now_ns() == 0:
            self.before_the_clock += len(self.early)
            self.early = []
        self.write_early()
        writer, self.writer = self.writer, None
        if writer is not None:
            self.written += writer.message_count
            writer.close()
        return "nothing was recorded" if self.folder is None else f"{self.written} messages in {self.folder}"

    def answer(self, action: Callable[[], str], _: Any, response: Any) -> Any:
        """Callback of ``recorder/start`` and ``recorder/stop``."""
        try:
            response.message = action()
            response.success = True
        except BagError as error:
            self.fail(error)
            response.message = str(error)
        return response

    def fail(self, error: BagError) -> None:
        """After a failure of the disk: log it, count lost messages, and stay alive for ``recorder/start``."""
        self.error = str(error)
        self.get_logger().error(f"recording has stopped: {error}")
        if self.writer is not None:
            self.written += self.writer.message_count
            self.writer = None

    def close(self) -> None:
        try:
            self.stop()
        except BagError as error:
            self.get_logger().error(str(error))

    # --- topics

    def discover(self) -> None:
        """Subscribe to new topics."""
        if self.writer is None:
            return
        for topic, types in self.get_topic_names_and_types():
            if self.wanted(topic):
                known = self.inputs.get(topic)
                kept = known.type_name if known is not None and known.type_name in types else types[0]
                self.adapt(topic, kept)
                others = ", ".join(each for each in types if each != kept)
                if others and self.refused.get(topic) != others:
                    self.refused[topic] = others
                    self.get_logger().warning(f"{topic} is recorded as {kept}, not as {others}")

    def wanted(self, topic: str) -> bool:
        """Whether the topic of this full name is to be recorded."""
        if self.chosen:
            return topic in self.chosen
        if is_model_covariance(topic) and not self.model_covariance:
            return False
        return topic not in self.exclude and names.within(topic, self.get_namespace()) is not None

    def adapt(self, topic: str, type_name: str) -> None:
        """Subscribe with the strongest QoS that all publishers match; subscribe again when that QoS has changed."""
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers or self.writer is None or self.refused.get(topic) == type_name:
            return
        offered = tuple(from_profile(publisher.qos_profile) for publisher in publishers)
        request = request_for(offered, _DEPTH)
        if topic in self.inputs and self.inputs[topic].request == request:
            return
        self.forget(topic)
        try:
            kind = message_class(type_name)
            self.writer.add_topic(topic, type_name, offered)
        except BodyTrackingError as error:
            if self.writer.failure is not None:
                self.fail(self.writer.failure)
                return
            self.refused[topic] = type_name
            self.get_logger().warning(f"{topic} is not recorded: {error}")
            return

        def receive(cdr: bytes, info: dict[str, int]) -> None:
            self.monitor.arrived(topic)
            self.receive(topic, cdr, info)

        callback: Any = receive  # rclpy passes the message info to callbacks of two arguments
        subscription = self.create_subscription(kind, topic, callback, to_profile(request), raw=True)
        self.inputs[topic] = _Input(type_name, offered, request, subscription)

    def forget(self, topic: str) -> None:
        """End a subscription."""
        if topic in self.inputs:
            self.destroy_subscription(self.inputs.pop(topic).subscription)

    # --- messages

    def receive(self, topic: str, cdr: bytes, info: dict[str, int]) -> None:
        """Write a message, with the time of its receipt."""
        if not self.simulated:
            received_ns = info["received_timestamp"] or time.time_ns()
            self.write(topic, cdr, received_ns, info["source_timestamp"] or received_ns)
        elif self.now_ns() == 0:
            self.wait_for_clock(topic, cdr)
        else:
            self.write_early()
            now_ns = self.now_ns()
            self.keep_time_forward(now_ns)
            self.write(topic, cdr, now_ns)

    def wait_for_clock(self, topic: str, cdr: bytes) -> None:
        """Keep a message from before the first ``/clock``: time 0 would put it years before the rest of the bag."""
        latched = topic in self.inputs and self.inputs[topic].latched
        self.early.append((math.inf if latched else time.monotonic() + _EARLY_S, topic, cdr))
        self.forget_early()

    def forget_early(self) -> None:
        """Drop waiting messages that are too old, and the oldest beyond the memory limit; latched ones last."""
        now, size = time.monotonic(), 0
        kept: list[tuple[float, str, bytes]] = []
        self.early.sort(key=lambda each: each[0])
        for message in reversed(self.early):
            size += len(message[-1]) + _MESSAGE_BYTES
            if message[0] < now or size > _EARLY_BYTES:
                break
            kept.append(message)
        self.before_the_clock += len(self.early) - len(kept)
        self.early = kept[::-1]

    def write_early(self) -> None:
        """Write the messages from before the first ``/clock``, latched ones first."""
        if self.early:
            self.forget_early()
            early, self.early = self.early, []
            for _, topic, cdr in sorted(early, key=lambda each: each[0] < math.inf):
                self.write(topic, cdr, self.now_ns())

    def write(self, topic: str, cdr: bytes, received_ns: int, sent_ns: int | None = None) -> None:
        """Write a message, or count it as lost."""
        if self.writer is None:
            self.lost += bool(self.error)
            return
        try:
            self.writer.write(topic, cdr, received_ns, sent_ns)
        except BagError as error:
            self.lost += 1
            self.fail(error)
        else:
            self.n_bytes += len(cdr)

    def keep_time_forward(self, now_ns: int) -> None:
        """Continue in another folder after a backward jump of simulated time."""
        if self.writer is not None and jumped_back(now_ns, self.last_ns):
            try:
                self.writer.close()
                self.open(now_ns)
                for topic, each in tuple(self.inputs.items()):
                    if each.latched:  # to get it once more
                        self.forget(topic)
                    else:
                        self.writer.add_topic(topic, each.type_name, each.offered)
            except BagError as error:
                self.fail(error)
            self.discover()
        self.last_ns = now_ns

    def flush(self) -> None:
        if self.writer is not None:
            try:
                self.writer.flush()
            except BagError as error:
                self.fail(error)

    # --- diagnostics

    def state(self) -> tuple[int, str, dict[str, object]]:
        values: dict[str, object] = {
            "bag": self.folder,
            "messages": self.written + (0 if self.writer is None else self.writer.message_count),
            "bytes": self.n_bytes,
            "topics": len(self.inputs),
            "topics refused": len(self.refused),
            "lost": self.lost,
        }
        if self.refused:
            values["refused"] = ", ".join(f"{topic} ({type_name})" for topic, type_name in self.refused.items())
        if self.before_the_clock:
            values["before the clock, not recorded"] = self.before_the_clock
        if self.error:
            return 2, self.error, values
        if self.simulated and self.now_ns() == 0 and self.writer is not None:
            self.forget_early()
            return 1, f"waiting for {graph.CLOCK_TOPIC} (use_sim_time): nothing is recorded", values
        return (1 if self.refused else 0), ("stopped" if self.writer is None else "recording"), values


def _next_to(folder: Path) -> Path:
    """The folder's name with the first number from 2 that no other folder has."""
    numbered = (folder.with_name(f"{folder.name}_{number}") for number in itertools.count(2))
    return next(each for each in numbered if not each.exists())


main = partial(run, BagRecorder)
