"""The delay from capture to joint angles through the real processes, beside a chain of bare relays.

Two sensors of 30 Hz with different periods, as two Kinects have (every phase between them occurs), feed the graph's own
calibration, fusion, filter and angle nodes. In the same run, half a frame later each time, the same skeleton passes
through as many relay processes. For each message, a relay only publishes a prepared message of the same type and size:
its delay is that of a chain of rclpy nodes by itself. Delays are from just before a frame is published until its angles
are received, by one clock, in one process.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import sys
import time
from collections.abc import Iterator, Mapping
from typing import Any

import common
import live
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState, PointCloud2

from body_tracking.core.clocks import ClockModel
from body_tracking.core.message_types import TIME_REFERENCE, TRANSFORM
from body_tracking.core.qos import RELIABLE
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import Skeleton
from body_tracking.kinematics.positional import positional_angles
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.messages.base import RosMessages
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.messages.skeletons import cloud_to_skeletons, skeletons_to_cloud
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.ros.bag_topics import to_profile
from body_tracking.ros.supervised import die_with_parent

BAG = common.ROOT / "bags" / "tpose_wave"
SENSORS = ("kinect1", "kinect2")
CHAIN = ("fusion", "skeleton_filter", "joint_angles")
PERIODS = (1.0 / 30.0, 1.0 / 29.7)
"""Periods of the sensors, seconds: the phase between them wraps around in about 3 s."""

RELAYED = ("/relay/sensor", "/relay/fused", "/relay/filtered", "/relay/joint_states")
LISTENERS = {graph.FUSED: 1, graph.FILTERED: 1, **{graph.skeleton_topic(name): 2 for name in SENSORS}}
"""Number of subscribers of each topic once the graph is up."""
TARGETS = {"median": 2.0, "p99": 2.5}


# --- the relays: this file as a command, one process each


def relay(stage: int) -> None:
    """For each received message, publish a prepared message of the stage's type and size with the same stamp."""
    die_with_parent()
    rclpy.init()
    node = rclpy.create_node(f"relay{stage}")
    skeleton = _sample(stage)
    skeletons, states, types = to_profile(graph.SKELETON), to_profile(RELIABLE), RosMessages()
    if stage < len(CHAIN) - 1:
        outputs = [node.create_publisher(PointCloud2, RELAYED[stage + 1], skeletons)]
        messages: list[Any] = [skeletons_to_cloud([skeleton], types)]
    else:
        names = (RELAYED[stage + 1], f"{RELAYED[stage + 1]}_stddev")
        outputs = [node.create_publisher(JointState, name, states) for name in names]
        messages = list(angles_to_joint_states(positional_angles(skeleton), "body1", "world", types))

    def on_message(received: PointCloud2) -> None:
        for output, message in zip(outputs, messages, strict=True):
            message.header.stamp = received.header.stamp
            output.publish(message)

    node.create_subscription(PointCloud2, RELAYED[stage], on_message, skeletons)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


def _sample(stage: int) -> Skeleton:
    """A skeleton of the kind that the graph's node of this stage publishes (the last one: receives)."""
    positions = np.random.default_rng(0).normal(size=(25, 3))
    covariances = np.broadcast_to(np.eye(3) * 1e-4, (25, 3, 3)).copy()
    velocities = np.zeros((25, 3)) if stage > 0 else None
    return Skeleton(0, "world", positions, np.full(25, 2, np.uint8), 1, covariances, velocities)


def relay_commands() -> list[list[str]]:
    """Command lines of the relays."""
    return [[sys.executable, __file__, "--relay", str(stage)] for stage in range(len(CHAIN))]


# --- the measurement


def recorded() -> tuple[dict[str, live.Stream], dict[str, SensorPose]]:
    """Frames of a shipped recording, and the true poses of its sensors."""
    frames: dict[str, list[tuple[Skeleton, ...]]] = {name: [] for name in SENSORS}
    poses: dict[str, SensorPose] = {}
    clocks = {name: ClockModel() for name in SENSORS}
    with BagReader(BAG) as reader:
        for message in reader.messages([graph.skeleton_topic(name) for name in SENSORS]):
            skeletons = cloud_to_skeletons(deserialize(reader.topics[message.topic].type_name, message.cdr))
            frames[message.topic.split("/")[1]].append(skeletons[:1])
        for message in reader.messages([graph.TRUE_CALIBRATION]):
            pose = transform_to_pose(deserialize(TRANSFORM, message.cdr))
            poses[pose.sensor] = pose
        for message in reader.messages([graph.TRUE_CLOCK]):
            sensor, _, clocks[sensor] = time_reference_to_clock(deserialize(TIME_REFERENCE, message.cdr))
    return live.streams(frames, clocks), poses


def events(streams: Mapping[str, live.Stream], relays: bool = True) -> Iterator[live.Event]:
    """Endless frames of both sensors, and for the relays those of the first one, half a frame later."""

    def regular(topic: str, stream: live.Stream, period: float, phase: float) -> Iterator[live.Event]:
        return (((k + phase) * period, topic, stream.at((k + phase) * period)) for k in itertools.count())

    sources = [
        regular(graph.skeleton_topic(name), streams[name], period, 0.0)
        for name, period in zip(SENSORS, PERIODS, strict=True)
    ]
    if relays:
        sources.append(regular(RELAYED[0], streams[SENSORS[0]], PERIODS[0], 0.5))
    return heapq.merge(*sources, key=lambda event: event[0])


def bench_of_graph(name: str) -> live.Bench:
    """A node that publishes the skeletons of both sensors, and notes the receipt of joint angles."""
    bench = live.Bench(name)
    for sensor in SENSORS:
        bench.publisher(graph.skeleton_topic(sensor), PointCloud2)
    bench.time("graph", graph.joint_states_topic(graph.DEFAULT_BODY))
    return bench


def measure(seconds: float, warm_up: float) -> dict[str, Any]:
    """Run both chains and compare their delays."""
    streams, poses = recorded()
    bench = bench_of_graph("latency_bench")
    bench.publisher(RELAYED[0], PointCloud2)
    bench.time("relay", RELAYED[-1])
    listeners = LISTENERS | dict.fromkeys(RELAYED[:-1], 1)
    with live.graph_of(bench, listeners, poses=poses, further=relay_commands(), sensors=SENSORS):
        until = itertools.takewhile(lambda event: event[0] < warm_up + seconds, events(streams))
        bench.publish(until, {graph.skeleton_topic(SENSORS[0]): "graph", RELAYED[0]: "relay"}, warm_up)
        time.sleep(0.5)
    result: dict[str, Any] = {"seconds": seconds, "sensors": len(SENSORS), "processes": len(CHAIN)}
    for chain in ("graph", "relay"):
        delays, lost = bench.delays_ms(chain)
        result[chain] = {**live.percentiles(delays, f"the {chain}"), "lost": lost}
    result["ratio"] = {
        key: round(result["graph"][f"{key}_ms"] / result["relay"][f"{key}_ms"], 3) for key in ("median", "p99")
    }
    return result


def main() -> int:
    """The command; the exit code is 0 even if a target is missed."""
    parser = common.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=40.0, help="to measure (default: %(default)g)")
    parser.add_argument("--warm-up", type=float, default=3.0, help="before that, not measured (default: %(default)g)")
    parser.add_argument("--relay", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.relay is not None:
        relay(args.relay)
        return 0
    result = measure(args.seconds, args.warm_up)
    common.report(args, result)
    ratio = result["ratio"]
    common.verdicts(args, {f"ratio of the {key} at most {bar}": ratio[key] <= bar for key, bar in TARGETS.items()})
    return 0


if __name__ == "__main__":
    sys.exit(main())
