"""The player and the recorder as processes over DDS: what was recorded is what arrives, byte by byte."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from nav_msgs.msg import Goals  # noqa: E402
from node_process import NodeProcess  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking.graph import MODEL_COVARIANCE  # noqa: E402
from body_tracking.messages.base import to_nanoseconds  # noqa: E402
from body_tracking.recording.qos import LATCHED, RELIABLE, SENSOR_DATA  # noqa: E402
from body_tracking.recording.rosbag2 import (  # noqa: E402
    BAG_MESSAGES,
    BagError,
    BagReader,
    BagWriter,
    deserialize,
    serialize,
)
from domains import domain  # noqa: E402

Stored = tuple[str, bytes, int]

TOPICS = {
    "/left/text": ("std_msgs/msg/String", SENSOR_DATA),
    "/right/text": ("std_msgs/msg/String", RELIABLE),
    "/latched": ("std_msgs/msg/Float64", LATCHED),
}
START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
RELIABLE_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


def stored_messages(count: int) -> list[Stored]:
    """Messages of all topics in turn, 10 ms apart; the text holds the number."""
    names = list(TOPICS)
    return [
        (
            names[index % 3],
            serialize(
                BAG_MESSAGES.make("std_msgs/msg/Float64", data=float(index))
                if names[index % 3] == "/latched"
                else BAG_MESSAGES.make("std_msgs/msg/String", data=f"{index} " + "x" * (index % 50))
            ),
            START_NS + index * STEP_NS,
        )
        for index in range(count)
    ]


def write_bag(folder: Path, count: int) -> list[Stored]:
    stored = stored_messages(count)
    with BagWriter(folder) as writer:
        for topic, (type_name, qos) in TOPICS.items():
            writer.add_topic(topic, type_name, qos)
        for item in stored:
            writer.write(*item)
    return stored


def read_bag(path: Path) -> list[Stored]:
    with BagReader(path) as reader:
        return [(found.topic, found.cdr, found.log_time_ns) for found in reader.messages()]


def read_so_far(path: Path) -> list[Stored]:
    """The messages of a bag that is being recorded; none before its first bytes are on the disk."""
    try:
        return read_bag(path)
    except BagError:
        return []


def of_topic(stored: list[Stored], topic: str) -> list[bytes]:
    return [on_the_wire(cdr) for name, cdr, _ in stored if name == topic]


def on_the_wire(cdr: bytes) -> bytes:
    """RTPS fills a serialised message up to a multiple of four bytes; readers of CDR ignore these."""
    return cdr + bytes(-len(cdr) % 4)


class Bench:
    """The processes of one test and a node to look at what they do, in a ROS domain of their own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain()))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        self.folder = folder
        self.processes: list[NodeProcess] = []
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = Node("bench", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def run(
        self,
        executable: str,
        environment: dict[str, str] | None = None,
        file_size_limit: int | None = None,
        **parameters: Any,
    ) -> NodeProcess:
        """Start a node."""
        arguments = [word for name, value in parameters.items() for word in ("-p", f"{name}:={_text(value)}")]
        log = self.folder / f"{executable}{len(self.processes)}.log"
        process = NodeProcess(
            executable,
            ["--ros-args", *arguments],
            log,
            {**os.environ, **(environment or {})},
            self.folder,
            file_size_limit,
        )
        self.processes.append(process)
        return process

    def listen(self, kind: type, topic: str, qos: QoSProfile = RELIABLE_QOS) -> list[Any]:
        """The messages of a topic, as they come."""
        messages: list[Any] = []
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def until(self, condition: Callable[[], Any], what: str, seconds: float = 30.0) -> None:
        """Spin until something is so; it failing is the test failing."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"waited {seconds} s for: {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, kind: type, name: str, request: Any) -> Any:
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, f"service {name}")
        future = client.call_async(request)
        self.until(future.done, f"answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def trigger(self, name: str) -> Any:
        return self.call(Trigger, name, Trigger.Request())

    def wait_for(self, process: NodeProcess, seconds: float = 30.0) -> str:
        """The output of a process that ends by itself, properly."""
        assert process.wait(seconds) == 0, process.output()
        return process.output()

    def stop(self, process: NodeProcess, how: signal.Signals = signal.SIGINT) -> str:
        """End a process as a user does."""
        process.send_signal(how)
        return self.wait_for(process)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait(30.0)
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else str(value)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(monkeypatch, tmp_path)
    yield bench
    bench.close()


def everybody(number: int = 1) -> tuple[str, ...]:
    return tuple(f"{topic}:{number}" for topic in TOPICS)


# --- bytes


def test_what_is_played_is_recorded_byte_by_byte(bench, tmp_path):
    stored = write_bag(tmp_path / "original", 240)
    recorder = bench.run("bag_recorder", folder=tmp_path / "copy", topics=tuple(TOPICS))
    began = time.monotonic()
    player = bench.run(
        "bag_player", bag=tmp_path / "original", rate=2.0, reliable=True, wait_for_subscribers=everybody()
    )
    bench.wait_for(player)
    assert time.monotonic() - began >= 239 * STEP_NS / 1e9 / 2, "never faster than told"
    bench.stop(recorder)
    with BagReader(tmp_path / "copy") as reader:
        found = [(item.topic, item.cdr, item.log_time_ns) for item in reader.messages()]
        assert reader.warnings == [] and reader.whole
        assert {name: topic.type_name for name, topic in reader.topics.items()} == {
            name: kind for name, (kind, _) in TOPICS.items()
        }
        assert reader.topics["/latched"].qos.durability == "transient_local"
        assert {topic.qos.reliability for topic in reader.topics.values()} == {"reliable"}
        # Received now, whatever the original's times are.
        assert abs(reader.end_ns - time.time_ns()) < 60e9
    for topic in TOPICS:
        assert of_topic(found, topic) == of_topic(stored, topic)
    with Reader(tmp_path / "copy") as other:
        assert other.message_count == len(stored)
        assert sorted(bytes(data) for _, _, data in other.messages()) == sorted(
            on_the_wire(cdr) for _, cdr, _ in stored
        )


def test_recorded_qos_is_offered_again(bench, tmp_path):
    write_bag(tmp_path / "bag", 9)
    player = bench.run("bag_player", bag=tmp_path / "bag", start_paused=True)
    bench.until(lambda: all(bench.node.get_publishers_info_by_topic(topic) for topic in TOPICS), "the player's topics")
    offered = {topic: bench.node.get_publishers_info_by_topic(topic)[0].qos_profile for topic in TOPICS}
    assert offered["/left/text"].reliability == ReliabilityPolicy.BEST_EFFORT
    assert offered["/right/text"].reliability == ReliabilityPolicy.RELIABLE
    assert offered["/right/text"].durability == DurabilityPolicy.VOLATILE
    assert offered["/latched"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    bench.stop(player)


def test_a_recorder_with_simulated_time_follows_the_clock(bench, tmp_path):
    stored = write_bag(tmp_path / "original", 90)
    recorder = bench.run("bag_recorder", folder=tmp_path / "copy", topics=tuple(TOPICS), use_sim_time=True)
    player = bench.run("bag_player", bag=tmp_path / "original", reliable=True, wait_for_subscribers=everybody())
    bench.wait_for(player)
    bench.stop(recorder, signal.SIGTERM)
    found = read_bag(tmp_path / "copy")
    assert sorted(cdr for _, cdr, _ in found) == sorted(on_the_wire(cdr) for _, cdr, _ in stored)
    assert all(stored[0][2] <= at <= stored[-1][2] for _, _, at in found)


# --- playing


def test_pause_rate_and_clock(bench, tmp_path):
    write_bag(tmp_path / "bag", 600)
    clock = bench.listen(Clock, "/clock")
    texts = bench.listen(String, "/right/text")
    player = bench.run(
        "bag_player",
        bag=tmp_path / "bag",
        start_paused=True,
        topics=("/right/text",),
        wait_for_subscribers=("/right/text",),
    )
    bench.until(lambda: len(clock) > 20, "the clock, standing still")
    assert texts == [] and {to_nanoseconds(tick.clock) for tick in clock} == {START_NS}

    assert bench.trigger("/bag_player/resume").success
    bench.until(lambda: len(texts) >= 20, "messages")
    assert bench.trigger("/bag_player/pause").success
    bench.spin(0.3)
    n_texts, n_clock = len(texts), len(clock)
    bench.spin(0.5)
    assert len(texts) == n_texts, "paused"
    standing = {to_nanoseconds(tick.clock) for tick in clock[n_clock:]}
    assert len(standing) == 1, "the clock goes on telling where it stands"

    answer = bench.call(SetParameters, "/bag_player/set_parameters", _rate(0.0))
    assert not answer.results[0].successful
    answer = bench.call(SetParameters, "/bag_player/set_parameters", _rate(20.0))
    assert answer.results[0].successful, answer
    assert bench.trigger("/bag_player/toggle_paused").success
    bench.until(lambda: len(texts) == 200, "all messages")
    bench.wait_for(player)
    numbers = [int(text.data.split()[0]) for text in texts]
    assert numbers == list(range(1, 600, 3)), "in order, and none left out"
    bench.until(lambda: to_nanoseconds(clock[-1].clock) >= START_NS + 597 * STEP_NS, "the clock's last tick")
    times = [to_nanoseconds(tick.clock) for tick in clock]
    assert times == sorted(times)


def _rate(value: float) -> SetParameters.Request:
    parameter = Parameter(name="rate", value=ParameterValue(type=3, double_value=value))
    return SetParameters.Request(parameters=[parameter])


def test_loop(bench, tmp_path):
    write_bag(tmp_path / "bag", 30)
    clock = bench.listen(Clock, "/clock")
    texts = bench.listen(String, "/right/text")
    player = bench.run("bag_player", bag=tmp_path / "bag", loop=True, wait_for_subscribers=("/right/text",))
    bench.until(lambda: len(texts) >= 35, "the fourth round")
    bench.stop(player)
    numbers = [int(text.data.split()[0]) for text in texts]
    assert numbers == [1 + 3 * (index % 10) for index in range(len(numbers))]
    times = [to_nanoseconds(tick.clock) for tick in clock]
    jumps = [(before, after) for before, after in pairwise(times) if after < before]
    assert len(jumps) >= 3 and all(after == START_NS for _, after in jumps)


def test_start_offset_and_topics(bench, tmp_path):
    write_bag(tmp_path / "bag", 120)
    texts = bench.listen(String, "/right/text")
    left = bench.listen(String, "/left/text", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
    player = bench.run(
        "bag_player",
        bag=tmp_path / "bag",
        start_offset=0.6,
        topics=("/right/text",),
        wait_for_subscribers=("/right/text",),
        on_end="idle",
    )
    bench.until(lambda: texts and texts[-1].data.startswith("118 "), "the last message")
    assert [int(text.data.split()[0]) for text in texts] == list(range(61, 120, 3))
    assert left == [] and player.poll() is None, "it idles at the end"
    bench.stop(player)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"bag": "absent"}, "no such recording"),
        ({}, "no bag to play"),
        ({"bag": "bag", "topics": ("/nothing",)}, "no topic /nothing"),
        ({"bag": "bag", "wait_for_subscribers": ("/nothing",)}, "/nothing"),
        ({"bag": "bag", "start_offset": 99.0}, "no message to play after 99 s"),
        ({"bag": "bag", "rate": 0.0}, "rate"),
        ({"bag": "bag", "on_end": "explode"}, "on_end"),
        ({"bag": "empty.mcap"}, "empty"),
    ],
)
def test_what_cannot_be_played_is_one_line(bench, tmp_path, parameters, text):
    write_bag(tmp_path / "bag", 9)
    (tmp_path / "empty.mcap").touch()
    process = bench.run("bag_player", **parameters)
    process.wait(30.0)
    output = process.output()
    assert process.returncode == 2 and text in output and len(output.strip().splitlines()) == 1, output


def test_a_damaged_bag_is_played_as_far_as_it_goes(bench, tmp_path):
    stored = write_bag(tmp_path / "bag", 300)
    path = tmp_path / "bag" / "bag_0.mcap"
    path.write_bytes(path.read_bytes()[:-1500])
    expected = [cdr for topic, cdr, _ in read_bag(tmp_path / "bag") if topic == "/right/text"]
    texts = bench.listen(String, "/right/text")
    player = bench.run(
        "bag_player", bag=tmp_path / "bag", rate=5.0, wait_for_subscribers=("/right/text",), reliable=True
    )
    assert "cut off" in bench.wait_for(player)
    bench.until(lambda: len(texts) == len(expected), "the messages that are whole")
    assert len(stored) // 3 >= len(expected) > 0


# --- recording


def test_kill_9_and_a_restart_lose_little(bench, tmp_path):
    publisher = bench.node.create_publisher(String, "/talk", RELIABLE_QOS)
    sent = []

    def talk() -> None:
        sent.append(f"message {len(sent)}")
        publisher.publish(String(data=sent[-1]))

    bench.node.create_timer(0.01, talk)
    folder = tmp_path / "bag"
    recorder = bench.run("bag_recorder", folder=folder, topics=("/talk",), chunk_seconds=0.1)
    bench.until(lambda: len(read_so_far(folder)) > 50, "a recording")
    recorder.kill()
    recorder.wait(10)
    first = read_bag(folder)
    assert len(first) > 50

    again = bench.run("bag_recorder", folder=folder, topics=("/talk",), chunk_seconds=0.1)
    bench.until(lambda: len(read_so_far(folder)) > len(first) + 50, "more of it")
    bench.stop(again, signal.SIGTERM)
    with BagReader(folder) as reader:
        assert reader.whole and reader.warnings == []
        found = [(item.topic, item.cdr, item.log_time_ns) for item in reader.messages()]
    assert found[: len(first)] == first
    numbers = [sent.index(text_of(cdr)) for _, cdr, _ in found]
    assert numbers == sorted(set(numbers)), "in order, none twice"
    with Reader(folder) as other:
        assert other.message_count == len(found)


def text_of(cdr: bytes) -> str:
    return str(deserialize("std_msgs/msg/String", cdr).data)


def test_recording_is_started_and_stopped_by_service(bench, tmp_path):
    publisher = bench.node.create_publisher(String, "/talk", RELIABLE_QOS)
    count = 0

    def talk() -> None:
        nonlocal count
        publisher.publish(String(data=f"message {count}"))
        count += 1

    bench.node.create_timer(0.01, talk)
    folder = tmp_path / "bag"
    recorder = bench.run("bag_recorder", folder=folder, start_recording=False, chunk_seconds=0.1)
    for part in range(2):
        assert not (folder / f"bag_{part}.mcap").exists()
        assert bench.trigger("/recorder/start").success
        bench.until(lambda part=part: len(read_so_far(folder / f"bag_{part}.mcap")) > 30, f"part {part}")
        assert bench.trigger("/recorder/stop").success
        with BagReader(folder) as reader:
            assert reader.whole, "closed by recorder/stop"
    n_messages = len(read_bag(folder))
    bench.spin(0.5)
    assert len(read_bag(folder)) == n_messages
    bench.stop(recorder)
    with BagReader(folder) as reader:
        # What is there by itself (all but /clock, /rosout, /parameter_events) was recorded too.
        assert "/talk" in reader.topics and "/diagnostics" in reader.topics and "/rosout" not in reader.topics


@pytest.mark.parametrize(
    "parameters", [{}, {"model_covariance": True}, {"topics": (MODEL_COVARIANCE, "/talk")}], ids=str
)
def test_the_covariance_of_a_model_is_recorded_only_where_asked_for(bench, tmp_path, parameters):
    publishers = [bench.node.create_publisher(String, topic, RELIABLE_QOS) for topic in (MODEL_COVARIANCE, "/talk")]
    bench.node.create_timer(0.01, lambda: [publisher.publish(String(data="x")) for publisher in publishers])
    recorder = bench.run("bag_recorder", folder=tmp_path / "bag", chunk_seconds=0.05, **parameters)
    bench.until(lambda: len(of_topic(read_so_far(tmp_path / "bag"), "/talk")) > 30, "the other topic")
    bench.stop(recorder)
    with BagReader(tmp_path / "bag") as reader:
        assert (MODEL_COVARIANCE in reader.topics) == bool(parameters)


def test_a_type_that_is_not_known_is_counted_and_the_rest_recorded(bench, tmp_path):
    statuses = bench.listen(DiagnosticArray, "/diagnostics")
    bench.node.create_publisher(Goals, "/goals", RELIABLE_QOS)
    publisher = bench.node.create_publisher(String, "/talk", RELIABLE_QOS)
    bench.node.create_timer(0.02, lambda: publisher.publish(String(data="still here")))
    recorder = bench.run("bag_recorder", folder=tmp_path / "bag", chunk_seconds=0.1)
    bench.until(
        lambda: any(
            status.message == "recording" and {"/goals (nav_msgs/msg/Goals)"} & {value.value for value in status.values}
            for array in statuses
            for status in array.status
        ),
        "a diagnostic that names /goals",
    )
    bench.until(lambda: len(of_topic(read_so_far(tmp_path / "bag"), "/talk")) > 10, "the other topic")
    bench.stop(recorder)


def test_a_full_disk_is_said_and_not_a_crash(bench, tmp_path):
    statuses = bench.listen(DiagnosticArray, "/diagnostics")
    publisher = bench.node.create_publisher(String, "/talk", RELIABLE_QOS)
    bench.node.create_timer(0.005, lambda: publisher.publish(String(data=os.urandom(400).hex())))
    recorder = bench.run(
        "bag_recorder",
        # Shared memory is made of files too, and would meet the limit first.
        {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"},
        folder=tmp_path / "bag",
        topics=("/talk",),
        chunk_seconds=0.05,
        file_size_limit=60_000,
    )

    def lost() -> int:
        return max(
            (
                int(value.value)
                for array in statuses
                for status in array.status
                for value in status.values
                if status.level == b"\x02" and value.key == "lost"
            ),
            default=0,
        )

    bench.until(lambda: lost() > 20, "an error in the diagnostics, with a count of what is lost")
    assert recorder.poll() is None
    bench.stop(recorder)
    with BagReader(tmp_path / "bag") as reader:
        assert len(list(reader.messages())) > 20
