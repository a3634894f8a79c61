"""Live colour-and-depth cameras: images to joint angles through the nodes, one camera at 30 Hz and two at 15.

The images of the shipped recording (480x360 pixels, JPEG; depth at half the size) are published reliably to the nodes,
over and over. The delay is from just before the colour image is published until the angles with its stamp are received,
by one clock. ``beyond inference``: the median delay minus the networks' time for an image, measured just before in as
many processes at the same time as there are cameras, since each camera has a node. ``lost``: images without angles;
``dropped``: images of either kind that the nodes' diagnostics count as dropped. ``cpu``: processor time of the camera
nodes per pair of images that they use, beside the networks' alone; other work on the machine changes it less. The bars
assume a machine that does nothing else.
"""

from __future__ import annotations

import itertools
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import common
import live
import numpy as np
import psutil
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import PoseModel
from body_tracking.camera.settings import THREADS
from body_tracking.camera.topics import COMPRESSED, DRIVERS
from body_tracking.core.qos import LATCHED
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.mesh.topics import IMAGES
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader
from body_tracking.simulation.camera_bags import SHIPPED

BEYOND_MS = 15.0
EXECUTABLE = "camera_skeleton"


def recorded() -> tuple[list[tuple[str, bytearray]], list[dict[str, bytearray]]]:
    """CameraInfo messages, and pairs of images, of the recording's camera, as CDR by kind."""
    names = DRIVERS["plain"].of("camera1")
    infos: list[tuple[str, bytearray]] = []
    images: dict[str, list[bytearray]] = {"colour": [], "depth": []}
    with BagReader(common.ROOT / "bags" / SHIPPED) as bag:
        for raw in bag.messages():
            if raw.topic in (names.colour_info, names.depth_info):
                infos.append(("colour_info" if raw.topic == names.colour_info else "depth_info", bytearray(raw.cdr)))
            elif raw.topic in (names.colour + COMPRESSED, names.depth):
                images["depth" if raw.topic == names.depth else "colour"].append(bytearray(raw.cdr))
    pairs = [dict(zip(images, both, strict=True)) for both in zip(*images.values(), strict=True)]
    return infos, pairs


def inference_ms(number_of_images: int) -> tuple[float, float]:
    """Median wall and processor time of the networks for an image in which the person is tracked, milliseconds."""
    tracker, times = PersonTracker(PoseModel(default_folder(), int(str(THREADS.default))), 1, 0.3), []
    _, pairs = recorded()
    for number, pair in enumerate(itertools.islice(itertools.cycle(pairs), number_of_images)):
        _, _, image = CompressedColour().decode(bytes(pair["colour"]), BAG_WIRE)
        begin = time.perf_counter(), time.process_time()
        tracker.update(number * NANOSECONDS // 15, image)
        times.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
    wall, processor = 1e3 * np.median(times[10:], axis=0)
    return float(wall), float(processor)


def used_pairs(bench: live.Bench, names: Sequence[str]) -> float:
    """Pairs of images that the nodes of these cameras have used so far."""
    return sum(float(bench.values(f"{name}_skeleton").get("pairs of images", 0)) for name in names)


def measured(cameras: int, rate: float, seconds: float, warm_up: float) -> dict[str, Any]:
    """One run with this number of cameras."""
    infos, pairs = recorded()
    with ProcessPoolExecutor(cameras, mp_context=multiprocessing.get_context("spawn")) as pool:
        networks, networks_cpu = np.mean(list(pool.map(inference_ms, [200] * cameras)), axis=0).tolist()
    names = [f"camera{number + 1}" for number in range(cameras)]
    topics = {name: DRIVERS["plain"].of(name) for name in names}
    bench = live.Bench("camera_live")
    for each in topics.values():
        bench.publisher(each.colour + COMPRESSED, CompressedImage, IMAGES)
        bench.publisher(each.depth, Image, IMAGES)
        for info in (each.colour_info, each.depth_info):
            bench.publisher(info, CameraInfo, LATCHED)
    bench.time("angles", graph.joint_states_topic(graph.DEFAULT_BODY))
    bench.hear_diagnostics()
    poses = {name: SensorPose(name, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])) for name in names}

    def events() -> Iterator[live.Event]:
        there = [*range(len(pairs)), *range(len(pairs) - 2, 0, -1)]
        for name in names:
            for field, message in infos:
                yield 0.0, getattr(topics[name], field), message
        for number in range(round((warm_up + seconds) * rate)):
            pair = pairs[there[number % len(there)]]
            for name in names:
                yield 1.0 + number / rate, topics[name].colour + COMPRESSED, pair["colour"]
                yield 1.0 + number / rate, topics[name].depth, pair["depth"]

    first = {each.colour + COMPRESSED: 1 for each in topics.values()}
    with live.graph_of(bench, first, poses=poses, sensors=(), camera=tuple(names), compressed="colour") as running:
        nodes = [psutil.Process(each.pid) for each in running if EXECUTABLE in each.args]
        begun, before = sum(live.cpu_seconds(each) for each in nodes), used_pairs(bench, names)
        bench.publish(events(), {topics[names[0]].colour + COMPRESSED: "angles"}, 1.0 + warm_up)
        time.sleep(2.5)
        used, after = sum(live.cpu_seconds(each) for each in nodes) - begun, used_pairs(bench, names)
    values = [dict(bench.values(f"{name}_skeleton")) for name in names]
    delays, lost = bench.delays_ms("angles")
    return {
        **live.percentiles(delays, "the graph", 95),
        "lost": lost,
        "dropped": sum(int(float(value)) for each in values for key, value in each.items() if "dropped" in key),
        "networks, ms": networks,
        "beyond inference, ms": float(np.median(delays)) - networks,
        "networks' cpu, ms": networks_cpu,
        "cpu, ms": 1e3 * float(used) / max(1.0, after - before),
    }


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, metavar="S", help="of each run (default: %(default)s)")
    parser.add_argument("--cameras", type=int, choices=(1, 2), help="only the run with so many")
    args = parser.parse_args()
    figures: dict[str, Any] = {}
    met: dict[str, bool] = {}
    for cameras, rate in ((1, 30.0), (2, 15.0)):
        if args.cameras in (None, cameras):
            row = figures[f"{cameras} at {rate:g} Hz"] = measured(cameras, rate, args.seconds, 5.0)
            met[f"{cameras} at {rate:g} Hz: {row['lost']} of {row['lost'] + row['frames']} lost"] = not row["lost"]
            beyond = row["beyond inference, ms"]
            met[f"{cameras} at {rate:g} Hz: {beyond:.1f} ms beyond inference, at most {BEYOND_MS:g}"] = (
                beyond <= BEYOND_MS
            )
    common.report(args, figures)
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())
