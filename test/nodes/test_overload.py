"""A node that is too slow for its inputs drops the oldest frames, handles the newest, and reports it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from sensor_msgs.msg import PointCloud2  # noqa: E402

from body_tracking.core.skeleton import Skeleton  # noqa: E402
from body_tracking.messages.cdr import encode_skeletons  # noqa: E402
from body_tracking.pipeline.shared import RELIABLE, skeleton_qos  # noqa: E402
from body_tracking.ros.bag_topics import to_profile  # noqa: E402
from body_tracking.ros.executor import LeanExecutor  # noqa: E402
from body_tracking.ros.node import GraphNode  # noqa: E402
from domains import domain  # noqa: E402
from patience import PATIENCE  # noqa: E402

TOPICS = ("/kinect1/skeleton", "/kinect2/skeleton")
WORK = 0.06
"""Seconds for a frame, of which two come in a thirtieth of a second: three of four cannot be handled."""


class Slow(GraphNode):
    """Takes its time for every frame."""

    NAME = "slow"
    PARAMETERS = (RELIABLE,)

    def start(self) -> None:
        self.waited: list[tuple[str, float]] = []
        for topic in TOPICS:
            self.subscribe_to_skeletons(topic, lambda skeletons, sent_ns, topic=topic: self.work(topic, sent_ns))

    def work(self, topic: str, sent_ns: int) -> None:
        self.waited.append((topic, (time.time_ns() - sent_ns) / 1e9))
        time.sleep(WORK)


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Iterator[Slow]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(domain_id=domain())
    yield Slow()
    rclpy.try_shutdown()


def test_dropped_frames_are_not_taken_for_lost_ones(slow: Slow) -> None:
    """Whatever their places in a batch, they count in the order of their numbers."""
    subscription = next(iter(slow._droppable))
    topic = slow._droppable[subscription]
    old_ns = time.time_ns() - 10**9
    slow.backlog._above_since_ns = 0  # the frames have come too late for long
    frames = [
        (subscription, (b"", {"publication_sequence_number": 1 + number, "received_timestamp": old_ns + number}))
        for number in range(3)
    ]
    assert slow.drop_late([(None, None)] * 7 + frames) == [(None, None)] * 7 + frames[-1:]
    slow.sequences.note(topic, 3)
    assert slow.backlog.dropped[topic] == 2
    assert not slow.sequences.lost[topic] and not slow.sequences.switched[topic]


@pytest.mark.alone
def test_slow_node_drops_old_frames_and_reports_them(slow: Slow) -> None:
    reports: list[Any] = []
    slow._diagnostics.publish = reports.append
    source = rclpy.create_node("source")
    publishers = [
        source.create_publisher(PointCloud2, topic, to_profile(skeleton_qos(slow.values))) for topic in TOPICS
    ]
    executor = LeanExecutor(slow)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    end = time.monotonic() + 20.0
    while not all(publisher.get_subscription_count() for publisher in publishers) and time.monotonic() < end:
        time.sleep(0.05)
    body = Skeleton(0, "kinect1_optical_frame", np.ones((25, 3)), np.full(25, 2, np.uint8))
    sent = 0

    def publish() -> None:
        nonlocal sent
        stamp_ns = 10**9 + sent * 33_000_000
        cloud = encode_skeletons([Skeleton(stamp_ns, body.frame_id, body.positions, body.states)])
        for publisher in publishers:
            publisher.publish(cloud)
        sent += 1

    def accounted(topic: str) -> int:
        handled = sum(each == topic for each, _ in slow.waited)
        left_out = slow.standstill.left_out[topic]  # where the machine stood still
        return handled + slow.backlog.dropped[topic] + slow.sequences.lost[topic] + left_out

    # A publisher discovers its subscription before the subscription discovers the publisher: frames before the first
    # handled one were never received. Once the next one is handled, none of them is on its way any more.
    end = time.monotonic() + PATIENCE
    for frames in (1, 2):
        while (
            any(sum(each == topic for each, _ in slow.waited) < frames for topic in TOPICS) and time.monotonic() < end
        ):
            publish()
            time.sleep(0.1)
    unheard = {topic: sent - accounted(topic) for topic in TOPICS}
    begin = time.monotonic()
    begun = sent
    while time.monotonic() - begin < 6.0:
        publish()
        time.sleep(max(0.0, begin + (sent - begun) / 30 - time.monotonic()))
    before = len(slow.waited)
    time.sleep(1.5)  # for the remaining frames and the report
    # no standing queue: the frames handled last are recent, and few remain
    late = [seconds for _, seconds in slow.waited[before // 2 : before]]
    assert np.median(late) < 0.3 and len(slow.waited) - before <= 16
    end = time.monotonic() + PATIENCE
    while any(accounted(topic) + unheard[topic] < sent for topic in TOPICS) and time.monotonic() < end:
        publish()  # a loss shows with the next frame
        time.sleep(0.1)
    backlog = slow.backlog.dropped
    assert set(backlog) == set(TOPICS)
    for topic in TOPICS:
        assert accounted(topic) + unheard[topic] == sent
    statuses = [message.status[0] for message in reports]
    warned = [status for status in statuses if status.message.startswith("too slow: dropped ")]
    assert warned and all(status.level == b"\x01" and TOPICS[0] in status.message for status in warned)
    values = {item.key: item.value for item in statuses[-1].values}
    assert values[f"dropped {TOPICS[0]}"] == str(backlog[TOPICS[0]])
    executor.stop()
    thread.join(10.0)
    assert not thread.is_alive()
