"""What the viewer costs the graph: the delay from capture to joint angles with it, beside the delay without it.

The graph of benchmarks/latency.py with two sensors of 30 Hz runs all the time. Stretches in which nobody looks and no
viewer runs alternate with stretches in which the viewer runs and a real browser (headless Chromium) shows it; the
figures are ratios between these, of one run. Delays are from just before a frame is published until its angles are
received, by one clock, in one process. The viewer runs as ``body_tracking up`` starts it, in a session of its own.

The browser has no graphics card here and draws in software; on a desk it would not share the graph's processors, or
draw on the card. So it draws few pixels (``--sharpness``) and yields to everybody else; how much of a processor it
still took, the last line says.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# first of all: it chooses a ROS domain of its own
import latency
import node_processes
import numpy as np
import psutil
import rclpy
from playwright.sync_api import sync_playwright
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState, PointCloud2

from body_tracking import graph
from body_tracking.messages.base import RosMessages, to_nanoseconds, to_time
from body_tracking.messages.skeletons import skeletons_to_cloud
from body_tracking.nodes.bag_topics import to_profile
from body_tracking.recording.qos import RELIABLE
from body_tracking.skeleton import NANOSECONDS

ROS = RosMessages()
LIMIT = 1.10
PATIENCE_MS = 180e3
SETTLE = 2.0
"""Seconds at the beginning of each stretch that do not count."""


class Stretches:
    """Publishes both sensors' frames all the time, in a thread of its own, and takes the time of what comes back."""

    def __init__(self, frames: dict[str, latency.Stream]) -> None:
        self.frames = frames
        self.sent: dict[int, int] = {}
        self.received: dict[int, int] = {}
        self.node = rclpy.create_node("viewer_bench")
        self.outputs = {
            name: self.node.create_publisher(PointCloud2, graph.skeleton_topic(name), to_profile(graph.SKELETON))
            for name in latency.SENSORS
        }
        topic = graph.joint_states_topic(graph.DEFAULT_BODY)
        self.node.create_subscription(JointState, topic, self._on_angles, to_profile(RELIABLE))
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.ended = threading.Event()

    def _on_angles(self, message: JointState) -> None:
        self.received.setdefault(to_nanoseconds(message.header.stamp), time.perf_counter_ns())

    def ready(self) -> bool:
        """Whether the graph listens."""
        chain = all(self.node.count_subscribers(topic) for topic in (graph.FUSED, graph.FILTERED))
        sensors = (self.node.count_subscribers(graph.skeleton_topic(name)) for name in latency.SENSORS)
        return chain and all(count >= 2 for count in sensors)

    def publish(self) -> None:
        """Until it is ended."""
        start = time.perf_counter_ns()
        due = dict.fromkeys(latency.SENSORS, start)
        while not self.ended.is_set():
            name = min(due, key=lambda each: due[each])
            at = due[name]
            due[name] += round(latency.PERIODS[latency.SENSORS.index(name)] * NANOSECONDS)
            cloud = skeletons_to_cloud([self.frames[name].at((at - start) / NANOSECONDS)], ROS)
            cloud.header.stamp = to_time(at, ROS)
            time.sleep(max(0, at - time.perf_counter_ns()) / NANOSECONDS)
            if name == latency.SENSORS[0]:
                self.sent[at] = time.perf_counter_ns()
            self.outputs[name].publish(cloud)

    def delays_ms(self, begin_ns: int, end_ns: int) -> np.ndarray:
        """Of the frames between these times that came through."""
        sent = dict(self.sent)
        return np.array(
            [
                (self.received[stamp] - at) / 1e6
                for stamp, at in sent.items()
                if begin_ns <= at < end_ns and stamp in self.received
            ]
        )


def yields() -> None:
    """In a process that is to draw whenever nobody else has anything to do."""
    os.setsid()
    os.nice(19)
    # where the scheduler shares by session (sched(7)), niceness counts only within one
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")


@contextlib.contextmanager
def chromium(folder: Path) -> Iterator[Any]:
    """A browser that stays, and yields to everybody; its first page shows nothing."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("viewer: no chromium here: apt-get install chromium")
    command = [path, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command += [
        "--remote-debugging-port=0",
        f"--user-data-dir={folder / 'profile'}",
        "--window-size=800,600",
        "about:blank",
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, preexec_fn=yields, text=True)
    assert process.stderr is not None
    try:
        address = next(match[0] for line in process.stderr if (match := re.search(r"ws://\S+", line)))
        threading.Thread(target=process.stderr.read, daemon=True).start()
        with sync_playwright() as driver:
            browser = driver.chromium.connect_over_cdp(address, timeout=PATIENCE_MS)
            yield browser.contexts[0].pages[0], psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait(20.0)


@contextlib.contextmanager
def viewer(page: Any, folder: Path, sharpness: float) -> Iterator[psutil.Process]:
    """The viewer, shown by the browser: it draws."""
    log = folder / "viewer.log"
    environment = {**os.environ, graph.PARENT_VARIABLE: str(os.getpid())}
    command = [sys.executable, "-m", "body_tracking.nodes", "viewer", "--ros-args", "-p", "port:=0"]
    with log.open("wb") as output:
        process = subprocess.Popen(
            command, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
    try:
        end = time.monotonic() + 120.0
        while not (found := re.search(r"http://\S+", log.read_text())):
            if time.monotonic() > end or process.poll() is not None:
                raise SystemExit(f"viewer: it did not come up\n{log.read_text()}")
            time.sleep(0.1)
        page.goto(f"{found[0]}/?fixedDpr={sharpness}", timeout=PATIENCE_MS)
        page.wait_for_function(
            "Object.values(window.__viserTestpoints?.uplots ?? {}).some(plot => plot.chart.data[0].length > 20)",
            timeout=PATIENCE_MS,
        )
        yield psutil.Process(process.pid)
        page.goto("about:blank")
    finally:
        node_processes.stop([process])


def _seconds(process: psutil.Process) -> float:
    """Of processor time, with those that it started."""
    times = [each.cpu_times() for each in (process, *process.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


def measure(seconds: float, pairs: int, sharpness: float) -> dict[str, Any]:
    """Alternate, and compare."""
    frames, poses = latency.recorded()
    rclpy.init()
    bench = Stretches(frames)
    spans: dict[str, list[tuple[int, int]]] = {"off": [], "on": []}
    used: dict[str, list[float]] = {"viewer": [], "browser": []}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.callback(rclpy.try_shutdown)
        graph_processes = latency.start(folder, poses, relays=False)
        stack.callback(node_processes.stop, graph_processes)
        page, browser = stack.enter_context(chromium(folder))
        deadline = time.monotonic() + 60.0
        while not bench.ready():
            if time.monotonic() > deadline:
                raise SystemExit("viewer: the graph did not come up")
            time.sleep(0.1)
        for run in (bench.publish, lambda: latency.spin(bench.executor)):
            threading.Thread(target=run, daemon=True).start()
        stack.callback(bench.ended.set)

        def stretch(name: str) -> None:
            time.sleep(SETTLE)
            begin = time.perf_counter_ns()
            time.sleep(seconds)
            spans[name].append((begin, time.perf_counter_ns()))

        for number in range(pairs):
            stretch("off")
            with viewer(page, folder, sharpness) as shown:
                before = [_seconds(shown), _seconds(browser)]
                stretch("on")
                for name, process, had in zip(used, (shown, browser), before, strict=True):
                    used[name].append((_seconds(process) - had) / (SETTLE + seconds))
            print(f"stretch {number + 1} of {pairs}", file=sys.stderr)
        stretch("off")
        time.sleep(0.5)
    result: dict[str, Any] = {"seconds": seconds, "pairs": pairs}
    for name, own in spans.items():
        delays = np.concatenate([bench.delays_ms(*span) for span in own])
        if not len(delays):
            raise SystemExit("viewer: no angles came")
        median, p95 = np.percentile(delays, [50, 95])
        result[name] = {"median_ms": round(float(median), 3), "p95_ms": round(float(p95), 3), "frames": len(delays)}
    for key in ("median", "p95"):
        result[f"ratio_{key}"] = round(result["on"][f"{key}_ms"] / result["off"][f"{key}_ms"], 3)
    result["cpu_percent"] = {name: round(100.0 * float(np.mean(shares)), 1) for name, shares in used.items()}
    result["load"] = round(os.getloadavg()[0], 1)
    result["cores"] = os.cpu_count()
    return result


def main() -> int:
    """The command: 0, or 1 when the bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each stretch (default 15)")
    parser.add_argument("--pairs", type=int, default=4, help="stretches with the viewer (default 4)")
    parser.add_argument(
        "--sharpness", type=float, default=0.2, help="pixels that the browser draws per pixel (default 0.2)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    result = measure(args.seconds, args.pairs, args.sharpness)
    met = all(result[f"ratio_{key}"] <= LIMIT for key in ("median", "p95"))
    result["met"] = met
    if args.json:
        print(json.dumps(result, indent=2))
        return 0 if met else 1
    print(
        f"capture to joint angles, {args.pairs} stretches of {args.seconds:g} s with the viewer, between such without"
    )
    for name, text in (("off", "without"), ("on", "with a browser")):
        row = result[name]
        print(
            f"  {text:16} median {row['median_ms']:7.2f} ms   95 % {row['p95_ms']:7.2f} ms   ({row['frames']} frames)"
        )
    ratios = f"median {result['ratio_median']:7.3f}      95 % {result['ratio_p95']:7.3f}"
    print(f"  ratio            {ratios}      (bar {LIMIT}: {'met' if met else 'missed'})")
    shares = ", ".join(f"{name} {share:.1f}" for name, share in result["cpu_percent"].items())
    print(f"  processor time, % of one core: {shares}; load {result['load']} on {result['cores']} cores")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
