"""The lean executor behaves like rclpy's, with messages, timers, services, and entities that come and go."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator
from typing import Self

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking.ros.executor import BatchNode, LeanExecutor  # noqa: E402
from body_tracking.ros.node import STEADY  # noqa: E402
from domains import domain  # noqa: E402


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[rclpy.node.Node]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init(domain_id=domain())
    yield BatchNode("lean")
    rclpy.try_shutdown()


class Spinning:
    """The executor in a thread, until the test is done."""

    def __init__(self, node: rclpy.node.Node) -> None:
        self.thread = threading.Thread(target=self.spin, args=(LeanExecutor(node),), daemon=True)
        self.ended: type[BaseException] | None = None

    def spin(self, executor: LeanExecutor) -> None:
        try:
            executor.spin()
        except BaseException as error:
            self.ended = type(error)

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        rclpy.shutdown()
        self.thread.join(10.0)
        assert not self.thread.is_alive()


def until(condition: object, timeout: float = 10.0) -> bool:
    end = time.monotonic() + timeout
    while not condition():  # type: ignore[operator]
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def answers(node: rclpy.node.Node, count: int) -> list[str]:
    """Responses of the service "ask" to ``count`` simultaneous requests, as far as they come in time."""
    other = rclpy.Context()
    rclpy.init(context=other, domain_id=node.context.get_domain_id())
    caller = rclpy.create_node("caller", context=other)
    executor = SingleThreadedExecutor(context=other)
    executor.add_node(caller)
    client = caller.create_client(Trigger, "ask")
    assert client.wait_for_service(10.0)
    futures = [client.call_async(Trigger.Request()) for _ in range(count)]
    end = time.monotonic() + 20.0
    while not all(future.done() for future in futures) and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    rclpy.try_shutdown(context=other)
    return [future.result().message for future in futures if future.done()]


def test_messages_timers_and_services_are_served_while_others_come_and_go(node: rclpy.node.Node) -> None:
    texts: list[str] = []
    later: list[str] = []
    ticks: list[int] = []
    publisher = node.create_publisher(String, "text", 10)
    node.create_subscription(String, "text", lambda message: texts.append(message.data), 10)

    def tick() -> None:
        ticks.append(1)
        publisher.publish(String(data=str(len(ticks))))
        if len(ticks) == 3:  # an entity that appears while others are waited for
            node.create_subscription(String, "text", lambda message: later.append(message.data), 10)

    timer = node.create_timer(0.02, tick, clock=STEADY)
    node.create_service(Trigger, "ask", lambda _, response: Trigger.Response(success=True, message="here"))
    with Spinning(node) as spinning:
        assert until(lambda: len(texts) >= 10 and len(later) >= 3)
        assert texts == [str(number + 1) for number in range(len(texts))]
        assert answers(node, 1) == ["here"]
        node.destroy_timer(timer)
        time.sleep(0.1)
        count = len(ticks)
        time.sleep(0.2)
        assert len(ticks) == count
    assert spinning.ended is ExternalShutdownException


def test_a_node_that_lags_handles_all_topics_in_the_order_of_sending(node: rclpy.node.Node) -> None:
    handled: list[int] = []
    topics = ("one", "two", "three")
    publishers = [node.create_publisher(String, topic, 100) for topic in topics]
    for topic in topics:
        node.create_subscription(String, topic, lambda message: handled.append(int(message.data)), 100)
    assert until(lambda: all(publisher.get_subscription_count() for publisher in publishers))
    # Not in turn: the topics have different numbers of messages.
    order = random.Random(3).choices(range(3), weights=(1, 3, 6), k=120)
    for number, topic in enumerate(order):
        publishers[topic].publish(String(data=str(number)))
    with Spinning(node):
        assert until(lambda: len(handled) == len(order))
    assert handled == list(range(len(order)))


class Noting(BatchNode):  # type: ignore[misc]
    """Records messages, ends of batches and timeouts; a timeout must not overtake a waiting message."""

    def __init__(self) -> None:
        super().__init__("noting")
        self.said: list[str] = []
        for topic in ("one", "two"):
            self.create_subscription(String, topic, lambda message: self.said.append(message.data), 10)
        self.create_timer(0.02, lambda: self.said.append("timer"), clock=STEADY)

    def batch_done(self) -> None:
        self.said.append("all")


def test_batch_callback_follows_all_waiting_messages(node: rclpy.node.Node) -> None:
    noting = Noting()
    publishers = [node.create_publisher(String, topic, 10) for topic in ("one", "two")]
    assert until(lambda: all(publisher.get_subscription_count() for publisher in publishers))
    for number in range(6):
        publishers[number % 2].publish(String(data=str(number)))
    time.sleep(0.1)  # the timer is ready, too
    with Spinning(noting):
        assert until(lambda: "timer" in noting.said)
        assert noting.said[:8] == [*"012345", "all", "timer"]
        publishers[0].publish(String(data="more"))
        assert until(lambda: noting.said.count("all") == 2)
    assert noting.said[noting.said.index("more") + 1] == "all"


@pytest.mark.parametrize("work", [0.0, 0.03])
def test_busy_node_answers_services(node: rclpy.node.Node, work: float) -> None:
    publisher = node.create_publisher(String, "text", 10)
    node.create_subscription(String, "text", lambda message: time.sleep(work), 10)
    node.create_timer(0.02, lambda: publisher.publish(String(data="more")), clock=STEADY)
    node.create_service(Trigger, "ask", lambda _, response: Trigger.Response(success=True, message="here"))
    with Spinning(node):
        assert answers(node, 5) == ["here"] * 5


@pytest.mark.alone
def test_idle_node_uses_no_cpu(node: rclpy.node.Node) -> None:
    with Spinning(node):
        time.sleep(0.3)
        before = time.process_time()
        time.sleep(1.0)
        assert time.process_time() - before < 0.5


def test_a_timer_that_is_set_anew_fires_once_each_time(node: rclpy.node.Node) -> None:
    fired: list[float] = []

    def fire() -> None:
        timer.cancel()
        fired.append(time.monotonic())
        if len(fired) < 5:
            timer.timer_period_ns = 20_000_000
            timer.reset()

    timer = node.create_timer(0.02, fire, clock=STEADY)
    with Spinning(node):
        assert until(lambda: len(fired) == 5)
        time.sleep(0.1)
    assert len(fired) == 5


def test_finish_handles_only_messages_sent_before_it(node: rclpy.node.Node) -> None:
    handled: list[str] = []
    publisher = node.create_publisher(String, "text", 100)

    def handle(message: String) -> None:
        handled.append(message.data)
        time.sleep(0.02)
        publisher.publish(String(data="later"))  # later messages must not delay the end

    node.create_subscription(String, "text", handle, 100)
    assert until(lambda: publisher.get_subscription_count() == 1)
    executor = LeanExecutor(node)
    for number in range(20):
        publisher.publish(String(data=str(number)))
    time.sleep(0.5)  # on their way
    executor.finish()
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    thread.join(20.0)
    assert not thread.is_alive()
    assert handled == [str(number) for number in range(20)]
