"""Shows the graph on a live page in a browser, and passes on what people press there."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

import contextlib
import ipaddress
import os
import threading
import time
import traceback
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.client import Client
from rclpy.parameter import Parameter as RosParameter
from sensor_msgs.msg import JointState, MultiDOFJointState, PointCloud2
from std_srvs.srv import Trigger

from body_tracking import systems
from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import Parameter
from body_tracking.core.qos import LATCHED, LATEST, RELIABLE
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray, Skeleton
from body_tracking.core.sources import check_sensor_name
from body_tracking.filters import FILTERS
from body_tracking.kinematics.tracking import ALL_CONVENTIONS
from body_tracking.messages.angles import joint_state_values
from body_tracking.messages.base import MessageError
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.model import joint_state_to_segments
from body_tracking.messages.node_status import NodeStatus, update_statuses
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.roles import ROLES
from body_tracking.pipeline.system import load
from body_tracking.ros.bag_topics import message_class, to_profile
from body_tracking.ros.node import BODY, SENSORS, GraphNode, deserialized, run
from body_tracking.ros.wire import WIRE
from body_tracking.viewing.curves import AngleHistory
from body_tracking.viewing.snapshot import PageError, Seen, Snapshot

PARAMETERS = (
    Parameter(
        "host", "127.0.0.1", "address to serve the page at; any other than this machine's own lets others press buttons"
    ),
    Parameter("port", 8080, "first port that is tried; the next ones where it is taken, 0 for any", min=0, max=65535),
    Parameter(
        "rate", 15.0, "draw at most this often, and only while a browser shows the page", unit="Hz", min=0.1, max=60.0
    ),
    Parameter("plot_rate", 4.0, "draw the curves of joint angles at most this often", unit="Hz", min=0.1, max=30.0),
    Parameter("window", 15.0, "how much of the joint angles is shown", unit="s", min=1.0, max=120.0),
    SENSORS,
    BODY,
)

_STALE_S = 1.0
"""What is older is drawn pale, seconds."""
_TOGETHER_S = 0.4
"""Somebody who is not in the messages of a topic any more is shown for this much longer, seconds."""
_ANSWER_S = 30.0
"""Time that a node has to answer, seconds."""
_WAITING = 64
"""Messages of joint angles that may wait for the next drawing; while nobody looks, older ones go."""
_SHARE = 0.25
"""Share of the time for which the page may be drawn, whatever the rate."""
_FAILURES = 10
"""Drawings that fail one after the other, after which the node ends."""
_NICE = 10


class ViewerNode(GraphNode):
    """Keeps the latest message of each topic as it came; a thread of its own reads and draws them."""

    NAME = "viewer"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
        """Open the page, listen and begin to draw."""
        given: dict[str, Any] = dict(self.values)
        self.sensors = tuple(check_sensor_name(sensor) for sensor in given["sensors"])
        self.latest: dict[str, tuple[bytes, float]] = {}
        self.read: dict[str, bytes] = {}
        self.people: dict[str, dict[int, tuple[Skeleton, float]]] = {}
        self.poses: dict[str, SensorPose] = {}
        self.statuses: dict[str, NodeStatus] = {}
        self.angles: deque[bytes] = deque(maxlen=_WAITING)
        self.stddevs: deque[bytes] = deque(maxlen=_WAITING)
        self.history = AngleHistory(given["window"])
        self.drawn, self.drawing_s = 0, 0.0
        self.ended = threading.Event()
        self.triggers = {each.name: self.create_client(Trigger, each.name) for each in systems.SERVICES}
        self.setters = {
            name: self.create_client(SetParametersAtomically, f"{name}/set_parameters_atomically")
            for name in ("skeleton_filter", "joint_angles")
        }
        self.page = self.open_page(given)
        for topic in (*map(graph.skeleton_topic, self.sensors), graph.FUSED, graph.FILTERED):
            self.subscribe(topic, PointCloud2, to_profile(LATEST), partial(self.on_latest, topic), raw=True)
        self.codecs = {layer.topic: load(layer.codec)() for layer in systems.LAYERS}
        for topic, codec in self.codecs.items():
            kind = message_class(codec.type_name)
            self.subscribe(topic, kind, to_profile(LATEST), partial(self.on_latest, topic), raw=True)
        self.subscribe(graph.CALIBRATION, TransformStamped, to_profile(LATCHED), self.on_pose)
        self.subscribe(graph.DIAGNOSTICS_TOPIC, DiagnosticArray, to_profile(RELIABLE), self.on_diagnostics)
        self.of_body: list[Any] = []
        self.body = ""
        self.choose_body(graph.check_body(given["body"]))
        give_way()
        self.thread = threading.Thread(target=self.keep_drawing, daemon=True)
        self.thread.start()

    def open_page(self, given: dict[str, Any]) -> Any:
        """The page, at a loopback address unless another was asked for.

        Raises:
            PageError: there is no viser, or the address is not of this machine.
        """
        try:
            from body_tracking.viewing.page import Page
        except ImportError as error:
            raise PageError(f"the page needs viser ({error}): pip install 'body_tracking[viewer]'") from error
        page = Page(
            given["host"],
            given["port"],
            self.sensors,
            self,
            tuple(FILTERS),
            tuple(ALL_CONVENTIONS),
            given["window"],
            systems.LAYERS,
        )
        print(f"open {page.address} in a browser", flush=True)
        self.get_logger().info(f"the page is at {page.address}")
        if not _is_loopback(given["host"]):
            self.get_logger().warning(
                f"the page is at {page.address}: whoever reaches that address can press its buttons"
            )
        return page

    # --- what comes

    def on_latest(self, topic: str, cdr: bytes, sent_ns: int) -> None:
        """Keep it as it is; whether it is read, the next drawing decides."""
        self.monitor.totals["received"] += 1
        self.latest[topic] = cdr, time.monotonic()

    def on_pose(self, message: Any, sent_ns: int) -> None:
        """A sensor's pose."""
        pose = transform_to_pose(message)
        if pose.sensor in self.sensors:
            self.poses[pose.sensor] = pose

    def on_diagnostics(self, message: Any, sent_ns: int) -> None:
        """What a node says of itself."""
        statuses_now = dict(self.statuses)  # the other thread reads them
        update_statuses(statuses_now, statuses(message, time.monotonic(), self.get_namespace()))
        self.statuses = statuses_now

    # --- drawing, in a thread of its own

    def keep_drawing(self) -> None:
        """Draw while somebody looks; errors that nobody expected, time and again, end the node, which is started anew.

        One alone does not: what is drawn wakes up viser's server in another thread, which now and then goes wrong
        ("deque mutated during iteration"), and the next drawing shows what that one would have.
        """
        rest, failed = 1.0 / float(str(self.values["rate"])), 0
        self.plotted = self.status_drawn = 0.0
        while not self.ended.wait(rest):
            if not self.page.watched:
                continue
            begin = time.monotonic()
            try:
                self.draw(begin)
                self.drawn += 1
                failed = 0
            except Exception:
                failed += 1
                self.monitor.totals["drawings failed"] += 1
                if self.ended.is_set():
                    return
                if failed == _FAILURES:
                    self.get_logger().fatal(f"drawing failed {failed} times: {traceback.format_exc()}")
                    self.context.try_shutdown()
                    return
                self.log_throttled("drawing", f"drawing failed, and is tried again: {traceback.format_exc()}")
            spent = time.monotonic() - begin
            self.drawing_s += spent
            rest = max(1.0 / float(str(self.values["rate"])) - spent, spent * (1.0 / _SHARE - 1.0))

    def draw(self, now: float) -> None:
        """What is due at a steady time."""
        self.page.draw(self.snapshot())
        if now - self.plotted >= 1.0 / float(str(self.values["plot_rate"])):
            self.plotted = now
            self.collect_angles()
            self.page.draw_curves(self.history)
        if now - self.status_drawn >= 1.0:
            self.status_drawn = now
            self.page.draw_status(self.statuses, now)
            self.page.draw_bodies(self.bodies(), self.body)

    def snapshot(self) -> Snapshot:
        """What is there now."""
        origins, quats = self.segments()
        return Snapshot(
            {sensor: self.seen(graph.skeleton_topic(sensor)) for sensor in self.sensors},
            dict(self.poses),
            self.seen(graph.FUSED),
            self.seen(graph.FILTERED),
            origins,
            quats,
            {layer.name: self.payload(layer.topic) for layer in systems.LAYERS},
        )

    def seen(self, topic: str) -> Seen:
        """The latest skeletons of a topic, each message read once; people who come in separate messages, together."""
        cdr, received = self.latest.get(topic, (b"", -np.inf))
        people = self.people.setdefault(topic, {})
        if cdr and cdr is not self.read.get(topic):
            self.read[topic] = cdr
            try:
                skeletons = decode_skeletons(cdr) or cloud_to_skeletons(deserialized(cdr, PointCloud2))
            except BodyTrackingError as error:
                self.malformed(topic, str(error))
            else:
                people.update({each.body: (each, received) for each in skeletons})
                for body in [body for body, (_, since) in people.items() if received - since > _TOGETHER_S]:
                    del people[body]
        return Seen(tuple(each for each, _ in people.values()), time.monotonic() - received > _STALE_S)

    def segments(self) -> tuple[FloatArray, FloatArray]:
        """(n, 3) origins and (n, 4) quaternions of the model's segments; none where the filter has no model."""
        cdr, received = self.latest.get(graph.segments_topic(self.body), (b"", -np.inf))
        if time.monotonic() - received > _STALE_S:
            return np.empty((0, 3)), np.empty((0, 4))
        try:
            return joint_state_to_segments(deserialized(cdr, MultiDOFJointState))[1:]
        except MessageError as error:
            self.malformed(graph.segments_topic(self.body), str(error))
            return np.empty((0, 3)), np.empty((0, 4))

    def payload(self, topic: str) -> Any:
        """The latest message of a layer's topic; None for none, or none that is new."""
        cdr, received = self.latest.get(topic, (b"", -np.inf))
        if time.monotonic() - received > _STALE_S:
            return None
        try:
            return self.codecs[topic].decode(cdr, WIRE)
        except BodyTrackingError as error:
            self.malformed(topic, str(error))
            return None

    def collect_angles(self) -> None:
        """Take the joint angles that have come, each with its standard deviations."""
        stddevs: dict[int, tuple[tuple[str, ...], FloatArray]] = {}
        try:
            while self.stddevs:
                stamp_ns, names, values = joint_state_values(deserialized(self.stddevs.popleft(), JointState))
                stddevs[stamp_ns] = names, values
            newest = max(stddevs, default=0)
            # angles are sent before their deviations: those that are newer wait for the next time
            while self.angles:
                stamp_ns, names, values = joint_state_values(deserialized(self.angles[0], JointState))
                if stamp_ns > newest:
                    break
                self.angles.popleft()
                if stamp_ns in stddevs and stddevs[stamp_ns][0] == names:
                    own = [name.removesuffix(f"_{self.body}") for name in names]
                    self.history.add(stamp_ns, own, values, stddevs[stamp_ns][1])
        except MessageError as error:
            self.angles.clear()
            self.malformed(graph.joint_states_topic(self.body), str(error))

    def bodies(self) -> tuple[str, ...]:
        """The persons whose joint angles are published."""
        own = (names.within(topic, self.get_namespace()) for topic, _ in self.get_topic_names_and_types())
        return graph.bodies_among(topic for topic in own if topic is not None)

    # --- what people press, in threads of the page's own

    def call(self, service: str) -> str:
        """Call a trigger; what it answers."""
        answer = self.ask(self.triggers[service], Trigger.Request())
        if not answer.success:
            raise PageError(answer.message or f"{service}: refused")
        return str(answer.message) or "done"

    def choose_filter(self, name: str) -> str:
        """Another filter, and what the joint angles then are made of."""
        convention = ROLES[name].convention
        self.set_parameters_of("skeleton_filter", filter=name)
        self.set_parameters_of("joint_angles", convention=convention, input=graph.AUTO)
        return f"{name}, with angles {convention}"

    def choose_convention(self, name: str) -> str:
        """Other angles of the filter that runs."""
        self.set_parameters_of("joint_angles", convention=name, input=graph.AUTO)
        return f"angles {name}"

    def choose_body(self, name: str) -> str:
        """Another person's joint angles."""
        for subscription in self.of_body:
            self.destroy_subscription(subscription)
        self.body = name
        self.angles.clear()
        self.stddevs.clear()
        qos = to_profile(LATEST)
        segments = graph.segments_topic(name)
        self.of_body = [
            self.subscribe(
                graph.joint_states_topic(name), JointState, qos, lambda cdr, _: self.angles.append(cdr), raw=True
            ),
            self.subscribe(
                graph.joint_states_stddev_topic(name),
                JointState,
                qos,
                lambda cdr, _: self.stddevs.append(cdr),
                raw=True,
            ),
            self.subscribe(segments, MultiDOFJointState, qos, partial(self.on_latest, segments), raw=True),
        ]
        return f"angles of {name}"

    def set_parameters_of(self, node: str, **values: str) -> None:
        """Set parameters of another node, all or none.

        Raises:
            PageError: it refuses, with its reason, or does not answer.
        """
        parameters = [RosParameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        answer = self.ask(self.setters[node], SetParametersAtomically.Request(parameters=parameters))
        if not answer.result.successful:
            raise PageError(f"{node}: {answer.result.reason or 'refused'}")

    def ask(self, client: Client, request: Any) -> Any:
        """Call a service and wait for its answer; not in the executor's thread.

        Raises:
            PageError: nobody offers it, or nobody answers.
        """
        if not client.service_is_ready():
            raise PageError(f"{client.service_name}: no node that offers it runs")
        future = client.call_async(request)
        end = time.monotonic() + _ANSWER_S
        # a callback of the future would be a task, which our executor only sees to when nothing else is to be done
        while not future.done():
            if time.monotonic() > end or self.ended.wait(0.02):
                client.remove_pending_request(future)
                raise PageError(f"{client.service_name}: no answer in {_ANSWER_S:g} s")
        return future.result()

    # --- diagnostics

    def state(self) -> tuple[int, str, dict[str, object]]:
        """Who looks, and what drawing costs."""
        watched = self.page.watched
        values: dict[str, object] = {"browsers": watched, "drawings": self.drawn}
        if self.drawn:
            values["drawing mean ms"] = f"{1e3 * self.drawing_s / self.drawn:.1f}"
        return 0, f"{self.page.address}, {watched} browser{'s' * (watched != 1)}", values

    def close(self) -> None:
        """Stop drawing and serving."""
        self.ended.set()
        self.thread.join(timeout=2.0)
        self.page.close()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def give_way() -> None:
    """Let everybody else have the processor first; a page that comes late harms nobody."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, int(thread.name), _NICE)
    # Where the scheduler shares by session, only this counts; but a terminal's session is not ours to slow down.
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")


def main() -> None:
    """The executable ``viewer``."""
    run(ViewerNode)


if __name__ == "__main__":
    main()
