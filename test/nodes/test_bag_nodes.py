"""The player and the recorder as processes over DDS: recorded messages arrive byte by byte."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from nav_msgs.msg import Goals  # noqa: E402
from node_process import NodeProcess  # noqa: E402
from rcl_interfaces.msg import ParameterValue  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from running import RELIABLE as RELIABLE_QOS  # noqa: E402
from running import Running  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA  # noqa: E402
from body_tracking.messages.base import to_nanoseconds  # noqa: E402
from body_tracking.pipeline.graph import MODEL_COVARIANCE  # noqa: E402
from body_tracking.recording.rosbag2 import (  # noqa: E402
    BAG_MESSAGES,
    BagError,
    BagReader,
    BagWriter,
    deserialize,
    serialize,
)
from draws import some  # noqa: E402
from excerpts import contents  # noqa: E402

Stored = tuple[str, bytes, int]

TOPICS = {
    "/left/text": ("std_msgs/msg/String", SENSOR_DATA),
    "/right/text": ("std_msgs/msg/String", RELIABLE),
    "/latched": ("std_msgs/msg/Float64", LATCHED),
}
START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000


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
    return [(found.topic, found.cdr, found.log_time_ns) for found in contents(path)]


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


class Bench(Running):
    """The processes of one test, and a node that observes them."""

    def wait_until(self, condition: Callable[[], Any], what: str, seconds: float = 30.0) -> None:
        """Spin until a condition holds; the test fails if it does not."""
        assert self.until(condition, seconds), f"waited {seconds} s for: {what}"

    def publish(self, hertz: float, make: Callable[[], str], *topics: str) -> None:
        """Texts, again and again."""
        publishers = [self.node.create_publisher(String, topic, RELIABLE_QOS) for topic in topics]
        self.node.create_timer(1.0 / hertz, lambda: [each.publish(String(data=make())) for each in publishers])

    def trigger(self, name: str) -> Any:
        return self.call(Trigger, name, Trigger.Request())

    def finished(self, process: NodeProcess, how: signal.Signals | None = None) -> str:
        """The output of a process that ends properly, by itself or as a user ends it."""
        if how is not None:
            process.send_signal(how)
        assert process.wait(30.0) == 0, process.output()
        return process.output()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with Bench(tmp_path) as bench:
        yield bench


ALL_SUBSCRIBERS = [f"{topic}:1" for topic in TOPICS]


# --- bytes


def test_recording_of_a_played_bag_is_identical(bench, tmp_path):
    stored = write_bag(tmp_path / "original", 240)
    recorder = bench.start("bag_recorder", folder=tmp_path / "copy", topics=list(TOPICS))
    began = time.monotonic()
    player = bench.start(
        "bag_player", bag=tmp_path / "original", rate=2.0, reliable=True, wait_for_subscribers=ALL_SUBSCRIBERS
    )
    bench.finished(player)
    assert time.monotonic() - began >= 239 * STEP_NS / 1e9 / 2, "never faster than the rate"
    bench.finished(recorder, signal.SIGINT)
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
    player = bench.start("bag_player", bag=tmp_path / "bag", start_paused=True)
    bench.wait_until(
        lambda: all(bench.node.get_publishers_info_by_topic(topic) for topic in TOPICS), "the player's topics"
    )
    offered = {topic: bench.node.get_publishers_info_by_topic(topic)[0].qos_profile for topic in TOPICS}
    assert offered["/left/text"].reliability == ReliabilityPolicy.BEST_EFFORT
    assert offered["/right/text"].reliability == ReliabilityPolicy.RELIABLE
    assert offered["/right/text"].durability == DurabilityPolicy.VOLATILE
    assert offered["/latched"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    bench.finished(player, signal.SIGINT)


def test_a_recorder_with_simulated_time_follows_the_clock(bench, tmp_path):
    stored = write_bag(tmp_path / "original", 90)
    recorder = bench.start("bag_recorder", folder=tmp_path / "copy", topics=list(TOPICS), use_sim_time=True)
    player = bench.start("bag_player", bag=tmp_path / "original", reliable=True, wait_for_subscribers=ALL_SUBSCRIBERS)
    bench.finished(player)
    bench.finished(recorder, signal.SIGTERM)
    found = read_bag(tmp_path / "copy")
    assert sorted(cdr for _, cdr, _ in found) == sorted(on_the_wire(cdr) for _, cdr, _ in stored)
    assert all(stored[0][2] <= at <= stored[-1][2] for _, _, at in found)


def test_each_round_of_a_looping_player_becomes_a_bag_of_its_own(bench, tmp_path):
    stored = write_bag(tmp_path / "original", 300)
    recorder = bench.start("bag_recorder", folder=tmp_path / "copy", topics=list(TOPICS), use_sim_time=True)
    original = {"bag": tmp_path / "original", "reliable": True, "wait_for_subscribers": ALL_SUBSCRIBERS}
    player = bench.start("bag_player", loop=True, rate=2.0, **original)
    bench.wait_until((tmp_path / "copy_3").exists, "the third round")
    bench.finished(player, signal.SIGINT)
    bench.finished(recorder, signal.SIGTERM)
    rounds = [read_bag(tmp_path / name) for name in ("copy", "copy_2")]
    for number, found in enumerate(rounds):
        assert [at for _, _, at in found] == sorted(at for _, _, at in found), number
        # a message may arrive after the clock of the next round
        assert len({cdr for _, cdr, _ in found}) > len(stored) - 10, number
        assert any(topic == "/latched" for topic, _, _ in found), number
    assert {cdr for found in rounds for _, cdr, _ in found} == {on_the_wire(cdr) for _, cdr, _ in stored}


def test_a_recording_that_is_continued_in_a_later_round_has_a_bag_of_its_own(bench, tmp_path):
    write_bag(tmp_path / "original", 300)
    clock = bench.collect(Clock, "/clock")
    recorder = bench.start("bag_recorder", folder=tmp_path / "copy", topics=list(TOPICS), use_sim_time=True)
    player = bench.start("bag_player", bag=tmp_path / "original", loop=True, wait_for_subscribers=ALL_SUBSCRIBERS)
    bench.wait_until(lambda: clock and to_nanoseconds(clock[-1].clock) > START_NS + 200 * STEP_NS, "most of a round")
    assert bench.trigger("/recorder/stop").message.endswith("/copy")
    bench.wait_until(lambda: to_nanoseconds(clock[-1].clock) < START_NS + 50 * STEP_NS, "the next round")
    assert bench.trigger("/recorder/start").message.endswith("/copy_2")
    bench.finished(player, signal.SIGINT)
    bench.finished(recorder, signal.SIGTERM)


# --- playing


def test_pause_rate_and_clock(bench, tmp_path):
    write_bag(tmp_path / "bag", 600)
    clock = bench.collect(Clock, "/clock")
    texts = bench.collect(String, "/right/text")
    player = bench.start(
        "bag_player",
        bag=tmp_path / "bag",
        start_paused=True,
        topics=["/right/text"],
        wait_for_subscribers=["/right/text"],
    )
    bench.wait_until(lambda: len(clock) > 20, "the clock, standing still")
    assert texts == [] and {to_nanoseconds(tick.clock) for tick in clock} == {START_NS}

    assert bench.trigger("/bag_player/resume").success
    bench.wait_until(lambda: len(texts) >= 20, "messages")
    assert bench.trigger("/bag_player/pause").success
    bench.until(lambda: False, 0.3)
    n_texts, n_clock = len(texts), len(clock)
    bench.until(lambda: False, 0.5)
    assert len(texts) == n_texts, "paused"
    standing = {to_nanoseconds(tick.clock) for tick in clock[n_clock:]}
    assert len(standing) == 1, "the clock goes on telling where it stands"

    assert not bench.set_parameter("bag_player", "rate", ParameterValue(type=3, double_value=0.0))[0]
    assert bench.set_parameter("bag_player", "rate", ParameterValue(type=3, double_value=20.0))[0]
    assert bench.trigger("/bag_player/toggle_paused").success
    bench.wait_until(lambda: len(texts) == 200, "all messages")
    bench.finished(player)
    numbers = [int(text.data.split()[0]) for text in texts]
    assert numbers == list(range(1, 600, 3)), "in order, and none left out"
    bench.wait_until(lambda: to_nanoseconds(clock[-1].clock) >= START_NS + 597 * STEP_NS, "the clock's last tick")
    times = [to_nanoseconds(tick.clock) for tick in clock]
    assert times == sorted(times)


def test_loop(bench, tmp_path):
    write_bag(tmp_path / "bag", 30)
    clock = bench.collect(Clock, "/clock")
    texts = bench.collect(String, "/right/text")
    player = bench.start("bag_player", bag=tmp_path / "bag", loop=True, wait_for_subscribers=["/right/text"])

    def jumps() -> list[int]:
        times = [to_nanoseconds(tick.clock) for tick in list(clock)]
        return [after for before, after in pairwise(times) if after < before]

    # The player waits for subscribers of its topics; the first rounds of /clock may be over when it is discovered.
    bench.wait_until(lambda: len(texts) >= 35 and len(jumps()) >= 3, "the fourth round, and three jumps of /clock")
    bench.finished(player, signal.SIGINT)
    numbers = [int(text.data.split()[0]) for text in texts]
    assert numbers == [1 + 3 * (index % 10) for index in range(len(numbers))]
    assert set(jumps()) == {START_NS}


def test_start_offset_and_topics(bench, tmp_path):
    write_bag(tmp_path / "bag", 120)
    texts = bench.collect(String, "/right/text")
    left = bench.collect(String, "/left/text", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
    player = bench.start(
        "bag_player",
        bag=tmp_path / "bag",
        start_offset=0.6,
        topics=["/right/text"],
        wait_for_subscribers=["/right/text"],
        on_end="idle",
    )
    bench.wait_until(lambda: texts and texts[-1].data.startswith("118 "), "the last message")
    assert [int(text.data.split()[0]) for text in texts] == list(range(61, 120, 3))
    assert left == [] and player.poll() is None, "it idles at the end"
    texts.clear()
    assert bench.set_parameter("bag_player", "position", ParameterValue(type=3, double_value=0.9)) == (True, "")
    bench.wait_until(lambda: texts and texts[-1].data.startswith("118 "), "the last message again")
    assert [int(text.data.split()[0]) for text in texts] == list(range(91, 120, 3))
    bench.finished(player, signal.SIGINT)


def test_a_damaged_bag_is_played_as_far_as_it_goes(bench, tmp_path):
    stored = write_bag(tmp_path / "bag", 300)
    path = tmp_path / "bag" / "bag_0.mcap"
    path.write_bytes(path.read_bytes()[:-1500])
    expected = [cdr for topic, cdr, _ in read_bag(tmp_path / "bag") if topic == "/right/text"]
    texts = bench.collect(String, "/right/text")
    player = bench.start(
        "bag_player", bag=tmp_path / "bag", rate=5.0, wait_for_subscribers=["/right/text"], reliable=True
    )
    assert "cut off" in bench.finished(player)
    bench.wait_until(lambda: len(texts) == len(expected), "the messages that are whole")
    assert len(stored) // 3 >= len(expected) > 0


# --- recording


def test_kill_9_and_a_restart_lose_little(bench, tmp_path):
    sent = []

    def text() -> str:
        sent.append(f"message {len(sent)}")
        return sent[-1]

    bench.publish(100.0, text, "/talk")
    folder = tmp_path / "bag"
    recorder = bench.start("bag_recorder", folder=folder, topics=["/talk"], chunk_seconds=0.1)
    bench.wait_until(lambda: len(read_so_far(folder)) > 50, "a recording")
    recorder.kill()
    recorder.wait(10)
    first = read_bag(folder)
    assert len(first) > 50

    again = bench.start("bag_recorder", folder=folder, topics=["/talk"], chunk_seconds=0.1)
    bench.wait_until(lambda: len(read_so_far(folder)) > len(first) + 50, "more of it")
    bench.finished(again, signal.SIGTERM)
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
    numbers = itertools.count()
    bench.publish(100.0, lambda: f"message {next(numbers)}", "/talk")
    folder = tmp_path / "bag"
    recorder = bench.start("bag_recorder", folder=folder, start_recording=False, chunk_seconds=0.1)
    for part in range(2):
        assert not (folder / f"bag_{part}.mcap").exists()
        assert bench.trigger("/recorder/start").success
        bench.wait_until(lambda part=part: len(read_so_far(folder / f"bag_{part}.mcap")) > 30, f"part {part}")
        assert bench.trigger("/recorder/stop").success
        with BagReader(folder) as reader:
            assert reader.whole, "closed by recorder/stop"
    n_messages = len(read_bag(folder))
    bench.until(lambda: False, 0.5)
    assert len(read_bag(folder)) == n_messages
    bench.finished(recorder, signal.SIGINT)
    with BagReader(folder) as reader:
        # Topics of the nodes themselves (all but /clock, /rosout, /parameter_events) were recorded, too.
        assert "/talk" in reader.topics and "/diagnostics" in reader.topics and "/rosout" not in reader.topics


def test_a_recording_without_a_name_is_named_by_the_time_at_which_it_starts(bench, tmp_path):
    given = ["--ros-args", "-p", "start_recording:=false"]
    log = tmp_path / "bag_recorder.log"
    recorder = bench.processes["bag_recorder"] = NodeProcess("bag_recorder", given, log, bench.environment, tmp_path)
    assert bench.trigger("/recorder/stop").message == "nothing was recorded"
    made: set[str] = set()
    for _ in range(3):
        pressed = datetime.now().replace(microsecond=0)
        name = bench.trigger("/recorder/start").message.removeprefix("recording into ")
        began = datetime.strptime(name[: len("body_tracking_2000_01_01-00_00_00")], "body_tracking_%Y_%m_%d-%H_%M_%S")
        assert pressed <= began <= datetime.now()
        assert bench.trigger("/recorder/stop").message.endswith(f" messages in {name}")
        made.add(name)
        bench.until(lambda: False, 0.7)  # two of them may start in one second
    assert len(made) == 3
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == made
    bench.finished(recorder, signal.SIGINT)


@pytest.mark.parametrize(
    "parameters", some([{}, {"model_covariance": True}, {"topics": [MODEL_COVARIANCE, "/talk"]}], 2), ids=str
)
def test_model_covariance_is_recorded_only_by_option(bench, tmp_path, parameters):
    bench.publish(100.0, lambda: "x", MODEL_COVARIANCE, "/talk")
    recorder = bench.start("bag_recorder", folder=tmp_path / "bag", chunk_seconds=0.05, **parameters)
    bench.wait_until(lambda: len(of_topic(read_so_far(tmp_path / "bag"), "/talk")) > 30, "the other topic")
    bench.finished(recorder, signal.SIGINT)
    with BagReader(tmp_path / "bag") as reader:
        assert (MODEL_COVARIANCE in reader.topics) == bool(parameters)


def test_unknown_message_type_is_counted_and_other_topics_recorded(bench, tmp_path):
    bench.node.create_publisher(Goals, "/goals", RELIABLE_QOS)
    bench.publish(50.0, lambda: "still here", "/talk")
    recorder = bench.start("bag_recorder", folder=tmp_path / "bag", chunk_seconds=0.1)

    def named() -> bool:
        said = bench.said("bag_recorder")
        return said.get("") == "recording" and "/goals (nav_msgs/msg/Goals)" in said.values()

    bench.wait_until(named, "a diagnostic that names /goals")
    bench.wait_until(lambda: len(of_topic(read_so_far(tmp_path / "bag"), "/talk")) > 10, "the other topic")
    bench.finished(recorder, signal.SIGINT)


def test_messages_of_a_second_type_are_named_and_those_of_the_first_are_recorded_on(bench, tmp_path):
    bench.publish(50.0, lambda: "still here", "/talk")
    recorder = bench.start("bag_recorder", folder=tmp_path / "bag", topics=["/talk"], chunk_seconds=0.1)
    bench.wait_until(lambda: bench.said("bag_recorder").get("topics") == "1", "the topic")
    # DDS refuses a second type within one process
    script = (
        "import rclpy; from std_msgs.msg import Bool; from rclpy.qos import qos_profile_sensor_data as qos; "
        "rclpy.init(); node = rclpy.create_node('other'); node.create_publisher(Bool, '/talk', qos); rclpy.spin(node)"
    )
    with subprocess.Popen([sys.executable, "-c", script], env=bench.environment) as other:
        try:
            bench.wait_until(
                lambda: bench.said("bag_recorder").get("refused") == "/talk (std_msgs/msg/Bool)", "its second type"
            )
            bench.until(lambda: False, 2.0)  # the recorder looks for topics again
            count = len(of_topic(read_so_far(tmp_path / "bag"), "/talk"))
            bench.wait_until(
                lambda: len(of_topic(read_so_far(tmp_path / "bag"), "/talk")) > count + 20, "more of the first type"
            )
        finally:
            other.kill()
    assert "/talk is recorded as std_msgs/msg/String, not as std_msgs/msg/Bool" in bench.finished(
        recorder, signal.SIGINT
    )


def test_full_disk_is_reported_without_a_crash(bench, tmp_path):
    # slowly: what a busy machine receives late together is one chunk, which has to fit, too
    bench.publish(50.0, lambda: os.urandom(400).hex(), "/talk")
    # shared memory is made of files too, and would meet the limit first
    bench.environment["FASTDDS_BUILTIN_TRANSPORTS"] = "UDPv4"
    folder = tmp_path / "bag"
    recorder = bench.start("bag_recorder", file_size_limit=60_000, folder=folder, topics=["/talk"], chunk_seconds=0.05)

    def lost() -> bool:
        return bench.said("bag_recorder").get("level") == "2" and bench.number("bag_recorder", "lost") > 20

    bench.wait_until(lost, "an error in the diagnostics, with a count of what is lost")
    assert recorder.poll() is None
    bench.finished(recorder, signal.SIGINT)
    with BagReader(folder) as reader:
        assert len(list(reader.messages())) > 20


def test_a_recording_that_is_deleted_meanwhile_is_reported_and_can_begin_again(bench, tmp_path):
    bench.publish(50.0, lambda: "hello", "/talk")
    folder = tmp_path / "bag"
    bench.start("bag_recorder", folder=folder, topics=["/talk"], chunk_seconds=0.05)
    bench.wait_until(lambda: bench.number("bag_recorder", "messages") > 5, "messages are recorded")
    shutil.rmtree(folder)
    text = f"{folder / 'bag_0.mcap'}: the file was deleted"
    bench.wait_until(lambda: bench.said("bag_recorder").get("") == text, "an error in the diagnostics")
    bench.wait_until(lambda: bench.number("bag_recorder", "lost") > 5, "a count of what is lost")
    assert bench.call(Trigger, "/recorder/start", Trigger.Request()).success
    bench.wait_until(lambda: len(read_so_far(folder)) > 5, "the recording goes on")
