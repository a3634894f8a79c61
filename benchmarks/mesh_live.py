"""Delay of the graph behind depth cameras, from the depth image to the angles, in milliseconds.

The images and the forearms' inertial sensors of ``bags/mesh_reaching`` (30 images a second of 512x424 pixels), four
times in a row, go to the ``mesh_tracker`` of one camera, without and with the sensors, and to those of two cameras, at
half the rate and at the whole one, each with fusion, the filter and the angles behind it, in processes of their own.
The first round is not measured: the shape of the person is estimated in it. Bars of the issue, on two free cores: one
camera at 30 Hz loses no image, and its delay does not grow.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import common
import live
import numpy as np
from sensor_msgs.msg import CameraInfo, Image, Imu

from body_tracking.core.qos import LATCHED
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.mesh.topics import IMAGES, depth_topic, info_topic, mesh_sensor
from body_tracking.messages.codecs import Pose
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, RawMessage
from body_tracking.simulation.depth_bags import SHIPPED

RECORDED = "kinect1"
FOREARMS = ("forearm_left", "forearm_right")
ROUNDS = 4
GROWTH = 1.5
"""Largest ratio of the last round's delay to that of the second."""


def recorded() -> tuple[bytearray, SensorPose, list[RawMessage]]:
    """The camera's calibration and pose, and images and inertial readings in the order of their times."""
    with BagReader(common.ROOT / "bags" / SHIPPED) as bag:
        (info,) = [raw.cdr for raw in bag.messages([info_topic(RECORDED)])]
        (pose,) = [Pose().decode(raw.cdr, BAG_WIRE) for raw in bag.messages([graph.TRUE_CALIBRATION])]
        readings = list(bag.messages([depth_topic(RECORDED), *map(_imu_topic, FOREARMS)]))
    return bytearray(info), pose, readings


def _imu_topic(segment: str) -> str:
    return f"/{segment}/imu/data"


def events(names: list[str], every: int, imus: tuple[str, ...]) -> Iterator[live.Event]:
    """One of ``every`` images to all cameras, and the readings of these sensors, round after round."""
    info, _, messages = recorded()
    yield from ((0.0, info_topic(name), info) for name in names)
    start, end = messages[0].log_time_ns, messages[-1].log_time_ns
    length = (end - start) / NANOSECONDS + 1.0 / 30.0
    for number in range(ROUNDS):
        images = 0
        for raw in messages:
            at = 1.0 + number * length + (raw.log_time_ns - start) / NANOSECONDS
            if raw.topic != depth_topic(RECORDED):
                if raw.topic.split("/")[1] in imus:
                    yield at, raw.topic, bytearray(raw.cdr)
                continue
            images += 1
            if images % every == 0:
                yield from ((at, depth_topic(name), bytearray(raw.cdr)) for name in names)


def measured(cameras: int, every: int, imus: tuple[str, ...]) -> dict[str, Any]:
    """One run with this number of cameras, one of ``every`` images, and these sensors."""
    names = [f"depth{number + 1}" for number in range(cameras)]
    bench = live.Bench("mesh_live")
    for name in names:
        bench.publisher(depth_topic(name), Image, IMAGES)
        bench.publisher(info_topic(name), CameraInfo, LATCHED)
    for segment in imus:
        bench.publisher(_imu_topic(segment), Imu)
    bench.time("angles", graph.joint_states_topic(graph.DEFAULT_BODY))
    bench.hear_diagnostics()
    sensors = [mesh_sensor(name) for name in names]
    _, pose, _ = recorded()
    poses = {name: replace(pose, sensor=name) for name in sensors}
    inputs = {depth_topic(name): 1 for name in names} | {_imu_topic(segment): 1 for segment in imus}
    with live.graph_of(bench, inputs, poses=poses, sensors=(), depth=tuple(names), imus=imus):
        sent = list(events(names, every, imus))
        since = 1.0 + (sent[-1][0] - 1.0) / ROUNDS
        late = bench.publish(sent, {depth_topic(names[0]): "angles"}, since)
        time.sleep(2.5)
    counters = [dict(bench.values(name)) for name in sensors]
    delays, lost = bench.delays_ms("angles")
    rounds = [float(np.median(each)) for each in np.array_split(delays, ROUNDS - 1)]
    return {
        **live.percentiles(delays, "the graph", 95),
        "lost": lost,
        "dropped": sum(int(float(value)) for each in counters for key, value in each.items() if "dropped" in key),
        "rounds, ms": [round(each, 1) for each in rounds],
        "sending late ms (95 %)": round(float(np.percentile(late, 95)), 1),
    }


def main() -> int:
    """The benchmark."""
    args = common.parser(__doc__).parse_args()
    figures: dict[str, Any] = {}
    met: dict[str, bool] = {}
    runs = {
        "one camera, 30 Hz": (1, 1, ()),
        "one camera, 30 Hz, two sensors": (1, 1, FOREARMS),
        "two cameras, 15 Hz": (2, 2, ()),
        "two cameras, 30 Hz": (2, 1, ()),
    }
    for what, (cameras, every, imus) in runs.items():
        common.progress(f"{what} ...")
        row = figures[what] = measured(cameras, every, imus)
        if what.startswith("one"):
            met[f"{what}: {row['lost']} of {row['lost'] + row['frames']} images lost"] = not row["lost"]
            growth = row["rounds, ms"][-1] / row["rounds, ms"][0]
            met[f"{what}: {growth:.2f} times the delay at the end, at most {GROWTH:g}"] = growth <= GROWTH
    common.report(args, figures)
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
