"""Shows the graph on a live page in a browser, whose controls call services and set parameters."""

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
from typing import Any, Final

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
from body_tracking.core.extras import pip_install
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import LATCHED, LATEST, RELIABLE, Qos, request_for
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.core.sources import check_sensor_name
from body_tracking.filters import FILTERS
from body_tracking.kinematics.conventions import ALL_CONVENTIONS
from body_tracking.messages.angles import joint_state_values
from body_tracking.messages.base import MessageError
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.codecs import Codec, Skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.model import joint_state_to_segments
from body_tracking.messages.node_status import NodeStatus, update_statuses
from body_tracking.pipeline import graph
from body_tracking.pipeline.roles import ROLES
from body_tracking.pipeline.shared import BODY, SENSORS
from body_tracking.pipeline.system import load
from body_tracking.ros.bag_topics import from_profile, message_class, to_profile
from body_tracking.ros.main import run
from body_tracking.ros.node import STEADY, GraphNode
from body_tracking.ros.wire import WIRE, deserialized
from body_tracking.viewing.curves import AngleHistory
from body_tracking.viewing.snapshot import PageError, Seen, Snapshot, SystemView
from body_tracking.viewing.status import FRESH

PARAMETERS = (
    Parameter(
        "host",
        "127.0.0.1",
        "address at which the page is served; all but loopback addresses let other machines press the buttons",
    ),
    Parameter("port", 8080, "the port; if it is taken, the next free one; 0 for any", min=0, max=65535),
    Parameter(
        "rate", 15.0, "draw at most this often, and only while a browser shows the page", unit="Hz", min=0.1, max=60.0
    ),
    Parameter("plot_rate", 4.0, "draw the curves of joint angles at most this often", unit="Hz", min=0.1, max=30.0),
    Parameter("window", 15.0, "how much of the joint angles is shown", unit="s", min=1.0, max=120.0),
    Parameter("start_page", False, "set by body_tracking view: its list of recordings returns when the graph ends"),
    SENSORS,
    BODY,
    *(
        Parameter(view.option, systems.OPTIONS[view.option].default, f"to show it: {systems.OPTIONS[view.option].text}")
        for view in systems.VIEWS
    ),
)

_STALE_S = 1.0
"""Age from which skeletons are drawn pale, and messages of views are not drawn, seconds."""
_TOGETHER_S = 0.4
"""Time for which a person is drawn after the last message with that person, seconds."""
_ANSWER_S = 30.0
"""Timeout of service calls, seconds."""
_WAITING = 64
"""Queue of joint angles for the next drawing, messages."""
_SHARE = 0.25
"""Largest share of the time that is spent on drawing, whatever the rate."""
_FAILURES = 10
"""Consecutive failed drawings after which the node ends."""
_NICE = 10
_RECENT = 16
"""Messages per topic of a view that are kept, to match the topics by stamp."""
_CONNECT_S = 1.0
"""Period of the check which topics the views need, seconds."""


IMPORTED_AT_START: Final = ("body_tracking.viewing.page",)
"""The import takes a second, during which a signal ends the process at once."""


class ViewerNode(GraphNode):
    """Keeps the latest serialised message of each topic; a thread of its own decodes and draws them."""

    NAME = "viewer"
    PARAMETERS = PARAMETERS

    def start(self) -> None:
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
        # the page has no buttons for those of single sensors
        named = [each.name for each in systems.SERVICES if "<" not in each.name]
        self.triggers = {name: self.create_client(Trigger, name) for name in named}
        self.setters = {
            name: self.create_client(SetParametersAtomically, f"{name}/set_parameters_atomically")
            for name in ("skeleton_filter", "joint_angles", "bag_player")
        }
        self.seeks = 0
        self.recent: dict[str, deque[tuple[bytes, int]]] = {}
        self.viewed: dict[str, tuple[Qos, Any]] = {}
        """Subscriptions of the views' topics, and their profiles."""
        self.held: set[str] = set()
        """Topics of the views whose last message stays valid at any age."""
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
        bodies = [view.body for view in self.views if view.body and not self.sensors]
        self.choose_body(graph.check_body(bodies[0] if bodies else given["body"]))
        if self.views:
            self.create_timer(_CONNECT_S, self.connect_views, clock=STEADY)
        give_way()
        self.thread = threading.Thread(target=self.keep_drawing, daemon=True)
        self.thread.start()

    def open_page(self, given: dict[str, Any]) -> Any:
        """The page; PageError without viser, or for an address that is not of this machine."""
        try:
            from body_tracking.viewing.page import Page
        except ImportError as error:
            raise PageError(f"the page needs viser ({error}): {pip_install('viewer')}") from error
        self.views: list[SystemView] = [
            load(each.make)(given[each.option]) for each in systems.VIEWS if given[each.option]
        ]
        page = Page(
            given["host"],
            given["port"],
            self.sensors,
            self,
            tuple(FILTERS),
            tuple(ALL_CONVENTIONS),
            given["window"],
            systems.LAYERS,
            self.views,
            given["start_page"],
            bool(self.get_parameter("use_sim_time").value),
        )
        print(f"open {page.address} in a browser", flush=True)
        self.get_logger().info(f"the page is at {page.address}")
        if not _is_loopback(given["host"]):
            self.get_logger().warning(f"the page is at {page.address}: everyone who can reach that address can use it")
        return page

    # --- inputs

    def on_latest(self, topic: str, cdr: bytes, sent_ns: int) -> None:
        self.monitor.totals["received"] += 1
        self.latest[topic] = cdr, time.monotonic()

    def connect_views(self) -> None:
        """Subscribe to the topics of the views, such as images, only while a browser shows their layers."""
        wanted: dict[str, Codec] = {}
        self.held = {topic for view in self.views for topic in view.held}
        if self.page.watched:
            for view in self.views:
                wanted.update(view.topics(self.page.visible))
        profiles = {topic: self.view_profile(topic) for topic in wanted}
        for topic in [each for each, (profile, _) in self.viewed.items() if profiles.get(each) != profile]:
            self.destroy_subscription(self.viewed.pop(topic)[1])
            self.recent.pop(topic, None)
        for topic in wanted.keys() - self.viewed.keys():
            self.codecs[topic] = wanted[topic]
            kind = message_class(wanted[topic].type_name)
            self.recent[topic] = deque(maxlen=_RECENT)
            profile = to_profile(profiles[topic])
            subscription = self.subscribe(topic, kind, profile, partial(self.on_recent, topic), raw=True)
            self.viewed[topic] = profiles[topic], subscription

    def view_profile(self, topic: str) -> Qos:
        """The profile of a view's subscription; for held topics the strongest one that the publishers offer."""
        publishers = self.get_publishers_info_by_topic(self.full_name(topic)) if topic in self.held else ()
        return request_for([from_profile(each.qos_profile) for each in publishers], 1) if publishers else LATEST

    def on_recent(self, topic: str, cdr: bytes, sent_ns: int) -> None:
        self.monitor.totals["received"] += 1
        self.recent[topic].append((cdr, self.waiting_ns()))

    def on_pose(self, message: Any, sent_ns: int) -> None:
        pose = transform_to_pose(message)
        if pose.sensor in self.sensors:
            self.poses[pose.sensor] = pose

    def on_diagnostics(self, message: Any, sent_ns: int) -> None:
        statuses_now = dict(self.statuses)  # the other thread reads them
        update_statuses(statuses_now, statuses(message, time.monotonic(), self.get_namespace()))
        self.statuses = statuses_now

    # --- drawing, in a thread of its own

    def keep_drawing(self) -> None:
        """Draw while a browser shows the page; consecutive errors end the node, which ``up`` restarts.

        A single error does not: drawing wakes up viser's server in another thread, which sometimes raises ("deque
        mutated during iteration"), and the next drawing replaces the failed one.
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
                self.log_throttled("drawing", f"drawing failed, trying again: {traceback.format_exc()}")
            spent = time.monotonic() - begin
            self.drawing_s += spent
            rest = max(1.0 / float(str(self.values["rate"])) - spent, spent * (1.0 / _SHARE - 1.0))

    def draw(self, now: float) -> None:
        """Draw the scene, and curves and status if they are due."""
        self.page.draw(self.snapshot())
        if self.views:
            self.page.draw_views(self.fresh(), self.decoded, dict(self.poses))
        if now - self.plotted >= 1.0 / float(str(self.values["plot_rate"])):
            self.plotted = now
            self.collect_angles()
            self.page.draw_curves(self.history)
        if now - self.status_drawn >= 1.0:
            self.status_drawn = now
            self.page.draw_status(self.statuses, now)
            self.page.draw_bodies(self.bodies(), self.body)

    def fresh(self) -> dict[str, list[bytes]]:
        """The messages of the views' topics that are not old, by the clock of timeouts.

        That clock follows the playback: a mesh at 5 Hz in the recording comes once a second in a slow playback.
        """
        now_ns, most_ns = self.waiting_ns(), _STALE_S * NANOSECONDS
        kept = dict(self.recent)  # the other thread changes it
        return {
            topic: [cdr for cdr, at_ns in list(each) if topic in self.held or 0 <= now_ns - at_ns <= most_ns]
            for topic, each in kept.items()
        }

    def snapshot(self) -> Snapshot:
        """The content of the next drawing."""
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
        """The latest skeletons of a topic; people may come in separate messages, and each message is decoded once."""
        cdr, received = self.latest.get(topic, (b"", -np.inf))
        people = self.people.setdefault(topic, {})
        if cdr and cdr is not self.read.get(topic):
            self.read[topic] = cdr
            try:
                skeletons = Skeletons().decode(cdr, WIRE)
            except BodyTrackingError as error:
                self.malformed(topic, str(error))
            else:
                people.update({each.body: (each, received) for each in skeletons})
                for body in [body for body, (_, since) in people.items() if received - since > _TOGETHER_S]:
                    del people[body]
        return Seen(tuple(each for each, _ in people.values()), self.is_old(received))

    def is_old(self, received: float) -> bool:
        """Whether what was received at a steady time is old; while a bag stands still, nothing becomes old."""
        return time.monotonic() - received > _STALE_S and not self.bag_is("paused", "at the end")

    def bag_is(self, *states: str) -> bool:
        """Whether a player reports one of these states."""
        player = self.statuses.get("bag_player")
        return player is not None and player.text in states and time.monotonic() - player.received <= FRESH

    def segments(self) -> tuple[FloatArray, FloatArray]:
        """(n, 3) origins and (n, 4) quaternions of the model's segments; none where the filter has no model."""
        cdr, received = self.latest.get(graph.segments_topic(self.body), (b"", -np.inf))
        if not cdr or self.is_old(received):
            return np.empty((0, 3)), np.empty((0, 4))
        try:
            return joint_state_to_segments(deserialized(cdr, MultiDOFJointState))[1:]
        except MessageError as error:
            self.malformed(graph.segments_topic(self.body), str(error))
            return np.empty((0, 3)), np.empty((0, 4))

    def payload(self, topic: str) -> Any:
        """The latest message of a layer's topic; None where it is absent or old."""
        cdr, received = self.latest.get(topic, (b"", -np.inf))
        return None if not cdr or self.is_old(received) else self.decoded(topic, cdr)

    def decoded(self, topic: str, cdr: bytes) -> Any:
        """The payload of a message of a layer or a view; None for one that is malformed."""
        try:
            return self.codecs[topic].decode(cdr, WIRE)
        except BodyTrackingError as error:
            self.malformed(topic, str(error))
            return None

    def collect_angles(self) -> None:
        """Add the received joint angles with their standard deviations to the curves."""
        stddevs: dict[int, tuple[tuple[str, ...], FloatArray]] = {}
        try:
            while self.stddevs:
                stamp_ns, names, values = joint_state_values(deserialized(self.stddevs.popleft(), JointState))
                stddevs[stamp_ns] = names, values
            newest = max(stddevs, default=0)
            # angles are sent before their deviations: newer ones wait for the next call
            while self.angles:
                stamp_ns, names, values = joint_state_values(deserialized(self.angles[0], JointState))
                if stamp_ns > newest:
                    break
                self.angles.popleft()
                if stamp_ns in stddevs and stddevs[stamp_ns][0] == names:
                    own = [name.removesuffix(f"_{self.body}") for name in names]
                    self.history.add(stamp_ns, own, values, stddevs[stamp_ns][1], time.monotonic_ns())
        except MessageError as error:
            self.angles.clear()
            self.malformed(graph.joint_states_topic(self.body), str(error))

    def bodies(self) -> tuple[str, ...]:
        """The persons whose joint angles are published."""
        own = (names.within(topic, self.get_namespace()) for topic, _ in self.get_topic_names_and_types())
        return graph.bodies_among(topic for topic in own if topic is not None)

    # --- controls of the page, called in its threads

    def call(self, service: str) -> str:
        """Call a trigger service; returns its message."""
        answer = self.ask(self.triggers[service], Trigger.Request())
        if not answer.success:
            raise PageError(answer.message or f"{service}: refused")
        return str(answer.message) or "done"

    def offers(self, service: str) -> bool:
        """Whether a node offers this service."""
        return not self.ended.is_set() and bool(self.triggers[service].service_is_ready())

    def seek(self, place_s: float) -> str:
        """Continue the bag at a place."""
        self.seeks += 1
        # an unchanged parameter is not applied, although the bag has gone on meanwhile: alternate by a microsecond
        self.set_parameters_of("bag_player", position=place_s + 1e-6 * (self.seeks % 2))
        return f"{'paused: resume ' if self.bag_is('paused') else ''}plays on from {place_s:.1f} s"

    def loop(self, on: bool) -> str:
        """Play the bag again at its end, or not."""
        self.set_parameters_of("bag_player", loop=on)
        return "begins again at its end" if on else "ends at its end"

    def choose_filter(self, name: str) -> str:
        """Change the filter, and the input and convention of the joint angles with it."""
        convention = ROLES[name].convention
        self.set_parameters_of("skeleton_filter", filter=name)
        self.set_parameters_of("joint_angles", convention=convention, input=graph.AUTO)
        return f"{name}, with angles {convention}"

    def choose_convention(self, name: str) -> str:
        """Change the convention of the joint angles."""
        self.set_parameters_of("joint_angles", convention=name, input=graph.AUTO)
        return f"angles {name}"

    def choose_body(self, name: str) -> str:
        """Show another person's joint angles and segments."""
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

    def set_parameters_of(self, node: str, **values: Value) -> None:
        """Set parameters of another node, all or none; PageError where it refuses them or does not answer."""
        parameters = [RosParameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        answer = self.ask(self.setters[node], SetParametersAtomically.Request(parameters=parameters))
        if not answer.result.successful:
            raise PageError(f"{node}: {answer.result.reason or 'refused'}")

    def ask(self, client: Client, request: Any) -> Any:
        """Call a service and wait for its answer, not in the executor's thread; PageError without server or answer."""
        if not client.service_is_ready():
            raise PageError(f"{client.service_name}: no node that offers it runs")
        future = client.call_async(request)
        end = time.monotonic() + _ANSWER_S
        # poll: a callback of the future would be a task, which our executor runs only when it is idle
        while not future.done():
            if time.monotonic() > end or self.ended.wait(0.02):
                client.remove_pending_request(future)
                raise PageError(f"{client.service_name}: no answer in {_ANSWER_S:g} s")
        return future.result()

    # --- diagnostics

    def state(self) -> tuple[int, str, dict[str, object]]:
        watched = self.page.watched
        values: dict[str, object] = {"browsers": watched, "drawings": self.drawn}
        if self.drawn:
            values["drawing mean ms"] = f"{1e3 * self.drawing_s / self.drawn:.1f}"
        return 0, f"{self.page.address}, {watched} browser{'s' * (watched != 1)}", values

    def close(self) -> None:
        self.ended.set()
        self.thread.join(timeout=2.0)
        if self.page.watched:
            self.page.draw_end(self.statuses)
        self.page.close()


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def give_way() -> None:
    """Lower the priority of this process, because a late page does no harm."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, int(thread.name), _NICE)
    # Where the scheduler groups processes by session, only the group's priority counts; not for a terminal's session.
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(str(_NICE), encoding="ascii")


main = partial(run, ViewerNode)
