"""Plays a bag: the recorded messages on their topics with their QoS, and ``/clock``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import RELIABLE, Qos
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.messages.base import to_time
from body_tracking.pipeline import graph
from body_tracking.recording.player import Playback
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagError
from body_tracking.ros.bag_topics import UnknownTypeError, message_class, to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import STEADY, GraphNode
from body_tracking.ros.ticks import Ticks
from body_tracking.ros.wire import ROS

PARAMETERS = (
    Parameter("bag", "", "the bag: a folder, or a single mcap file"),
    Parameter("rate", 1.0, "playback speed, recorded seconds per second", min=1e-3, max=1e4, live=True),
    Parameter("loop", False, "play again from the beginning at the end; /clock and stamps then jump back", live=True),
    Parameter("start_offset", 0.0, "skip this much at the beginning of the bag", unit="s", min=0.0, max=1e9),
    Parameter(
        "position",
        0.0,
        "set while the bag plays, or idles at its end: continue at this place, seconds from its beginning",
        unit="s",
        min=0.0,
        max=1e9,
        live=True,
    ),
    Parameter("topics", (), "play only these topics; empty for all"),
    Parameter(
        "clock_rate",
        100.0,
        "publish /clock this often, and before each message; 0 for no /clock",
        unit="Hz",
        min=0.0,
        max=1000.0,
    ),
    Parameter("reliable", False, "offer every topic reliably, whatever was recorded, so that nothing is lost"),
    Parameter(
        "wait_for_subscribers",
        (),
        "topics that must have a subscriber before the bag starts, as /topic or /topic:NUMBER_OF_SUBSCRIBERS",
    ),
    Parameter(
        "wait_timeout",
        30.0,
        "start without subscribers after this; 0 to wait without limit",
        unit="s",
        min=0.0,
        max=1e9,
    ),
    Parameter("start_paused", False, "wait for ~/resume before the first message"),
    Parameter(
        "on_end",
        "exit",
        "what to do after the last message; while it idles, position and loop play it again",
        choices=("exit", "idle"),
    ),
)

_LOOK_NS = 20_000_000  # between two counts of subscribers
_SETTLE_NS = 250_000_000  # for the subscribers, once found, to discover this node too


class BagPlayer(GraphNode):
    """Publishes the messages of a bag when they are due."""

    NAME = "bag_player"
    PARAMETERS = PARAMETERS

    playback: Playback | None = None
    phase = "waiting for subscribers"
    clock_ns = 0

    def configure(self, values: Mapping[str, Value]) -> None:
        given: dict[str, Any] = dict(values)
        if self.playback is not None:
            self.playback.set_rate(given["rate"], time.monotonic_ns())
            self.playback.loop = given["loop"]
            ended = self.phase == "at the end"
            if given["position"] != self.values["position"]:
                if ended and given["on_end"] == "exit":
                    raise BagError("the bag has ended")
                self.playback.seek(given["position"], time.monotonic_ns())
            if ended and not self.playback.finished:
                self.phase = "playing"
            if self.phase == "playing":
                self.wake(0)

    def start(self) -> None:
        """Open the bag and offer its topics."""
        given: dict[str, Any] = dict(self.values)
        if not given["bag"]:
            raise BagError("parameter 'bag': no bag to play")
        self.reader = RigReader(given["bag"])
        self.offers = self.offer(given["topics"] or tuple(self.reader.topics))
        self.absent = self.wanted_subscribers(given["wait_for_subscribers"])
        self.playback = Playback(
            self.reader,
            rate=given["rate"],
            loop=given["loop"],
            start_offset_s=given["start_offset"],
            topics=tuple(self.offers),
            clock_hz=given["clock_rate"],
            paused=given["start_paused"],
        )
        self.clock_ns = self.reader.start_ns
        self.published = Ticks()
        self.clock_topic = None
        if given["clock_rate"]:
            depth = graph.RELIABLE_SKELETON.depth if given["reliable"] else RELIABLE.depth
            qos = Qos(RELIABLE.reliability, RELIABLE.durability, depth)
            self.clock_topic = self.make_publisher(Clock, graph.CLOCK_TOPIC, to_profile(qos))
        self.warned = 0
        self.warn_of_damage()
        for service, paused in (("~/pause", True), ("~/resume", False), ("~/toggle_paused", None)):
            self.create_service(Trigger, service, partial(self.set_paused, paused))
        self.give_up_ns = time.monotonic_ns() + round((given["wait_timeout"] or 1e9) * NANOSECONDS)
        self.alarm = self.create_timer(1.0, self.wait, clock=STEADY)
        self.wake(0)

    def wake(self, after_ns: int) -> None:
        """Set the timer."""
        self.alarm.timer_period_ns = max(1, after_ns)
        self.alarm.reset()

    def now_ns(self) -> int:
        """The bag's time if this node publishes ``/clock``; 0 before it begins."""
        return self.clock_ns if self.values["clock_rate"] else super().now_ns()

    def played_ns(self) -> int | None:
        """The bag's time that was played, if this node publishes ``/clock``."""
        return self.published.played_ns if self.published else None

    # --- topics

    def offer(self, topics: tuple[str, ...]) -> dict[str, Any]:
        """A publisher for each topic that can be played."""
        missing = [topic for topic in topics if topic not in self.reader.topics]
        if missing:
            has = ", ".join(self.reader.topics) or "none"
            raise BagError(f"{self.reader.path}: no topic {', '.join(missing)}; it has {has}")
        publishers = {}
        for topic in topics:
            if topic == graph.CLOCK_TOPIC and self.values["clock_rate"]:
                self.get_logger().info("the recorded /clock is not played: the player publishes its own")
                continue
            info = self.reader.topics[topic]
            qos = info.qos
            if self.values["reliable"]:
                qos = Qos("reliable", qos.durability, max(qos.depth, graph.RELIABLE_SKELETON.depth))
            try:
                publishers[topic] = self.make_publisher(message_class(info.type_name), topic, to_profile(qos))
            except UnknownTypeError as error:
                self.monitor.totals["topics not played"] += 1
                self.get_logger().error(f"{topic} is not played: {error}")
        if not publishers:
            raise BagError(f"{self.reader.path}: none of its topics can be played")
        return publishers

    def wanted_subscribers(self, texts: tuple[str, ...]) -> dict[str, int]:
        """The required number of subscribers of each topic in ``/topic`` or ``/topic:2``."""
        wanted = {}
        for text in texts:
            topic, colon, number = text.partition(":")
            if topic not in self.offers:
                raise BagError(f"parameter 'wait_for_subscribers': {topic!r} is not played")
            if colon and not number.isdecimal():
                raise BagError(f"parameter 'wait_for_subscribers': {text!r}, expected /topic or /topic:NUMBER")
            wanted[topic] = int(number or 1)
        return wanted

    # --- callbacks of the timer

    def wait(self) -> None:
        """Wait for the required subscribers, then play."""
        self.absent = {
            topic: number
            for topic, number in self.absent.items()
            if self.offers[topic].get_subscription_count() < number
        }
        late = time.monotonic_ns() > self.give_up_ns
        if self.absent and not late:
            self.wake(_LOOK_NS)
            return
        if self.absent:
            self.get_logger().warning(f"starting without enough subscribers of {', '.join(self.absent)}")
        self.phase = "playing"
        self.alarm.callback = self.play
        self.wake(_SETTLE_NS if self.values["wait_for_subscribers"] and not late else 0)

    def play(self) -> None:
        """Publish the messages that are due."""
        assert self.playback is not None
        step = self.playback.step(time.monotonic_ns())
        for batch in step.batches:
            self.clock_ns = batch.clock_ns
            if self.clock_topic is not None:
                self.clock_topic.publish(Clock(clock=to_time(batch.clock_ns, ROS)))
                self.published.add(batch.clock_ns, time.time_ns())
            for message in batch.messages:
                self.send(self.offers[message.topic], message.cdr)
        if step.wake_ns is None:
            self.end()
        else:
            self.wake(step.wake_ns - time.monotonic_ns())

    def end(self) -> None:
        """After the last message: wait for its acknowledgement, then exit or stay."""
        self.phase = "at the end"
        self.alarm.cancel()
        self._report()
        self.hand_over()
        if self.values["on_end"] == "exit":
            self.context.try_shutdown()

    # --- services

    def set_paused(self, paused: bool | None, _: Any, response: Any) -> Any:
        """Pause or resume; None toggles."""
        assert self.playback is not None
        if paused is None:
            paused = not self.playback.paused
        now_ns = time.monotonic_ns()
        if paused:
            self.playback.pause(now_ns)
        else:
            self.playback.resume(now_ns)
        if self.phase == "playing":
            self.wake(0)
        at_s = (self.playback.bag_time_ns(now_ns) - self.reader.start_ns) / NANOSECONDS
        response.success = self.phase != "at the end"
        response.message = f"{'paused' if paused else self.phase} at {at_s:.3f} s of the bag"
        return response

    # --- diagnostics

    def warn_of_damage(self) -> None:
        """Log damage that was found in the bag since the last call."""
        for warning in self.reader.warnings[self.warned :]:
            self.get_logger().warning(warning)
        self.warned = len(self.reader.warnings)

    def state(self) -> tuple[int, str, dict[str, object]]:
        assert self.playback is not None
        self.warn_of_damage()
        text = "paused" if self.playback.paused else self.phase
        return (
            1 if self.warned else 0,
            text,
            {
                "bag": self.reader.path,
                "position s": f"{(self.clock_ns - self.reader.start_ns) / NANOSECONDS:.3f}",
                "duration s": f"{(self.reader.end_ns - self.reader.start_ns) / NANOSECONDS:.3f}",
                "rate": self.playback.rate,
                "loop": self.playback.loop,
                "sent": self.playback.sent,
                "late ms": f"{self.playback.late_ns / 1e6:.3f}",
                "loops": self.playback.loops,
                "damages": self.warned,
            },
        )

    def close(self) -> None:
        self.reader.close()


main = partial(run, BagPlayer)
