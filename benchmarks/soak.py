"""The full graph for an hour at ten times the rate: does memory grow, does a process die, does latency grow?

``body_tracking up`` plays a simulated recording of a person with two Kinects in a loop, and
records. At each start of the loop stamps jump back, and every node resets. Once a minute the recorder
closes its bag through its service, the bag is deleted, and the next one begins. At the end every node is killed once.

Memory is the private part of each process (USS), which does not depend on other processes with the same libraries.
Latency is from the writer's time of a reference sensor's frame to that of the angles with its stamp, both noted by the
middleware. The rate is the rate reached by the player: it sends everything, late if necessary. The latency is only
meaningful if the graph keeps up: see ``rate`` and ``taken_percent``.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import common
import live
import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import Trigger
from tqdm import tqdm

from body_tracking.core.skeleton import FloatArray
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader
from body_tracking.ros import dds

GROWTH = 0.05
"""Largest relative growth of private memory from the second minute to the last tenth."""
LATER = 1.2
"""Largest ratio of the last tenth's median latency to the first's."""
TENTHS = 10
WARM_UP = 60.0
"""Seconds at the start that do not count."""
PERIOD, LISTENING = 10.0, 2.0
"""Seconds between two samples, and of listening at each: this process must not use a core itself."""
LOOK = 0.05
"""Seconds between two polls while it listens: a wakeup per message would cost more than a node of the graph."""
_KEPT = 200
"""Depth of the queues between two polls."""
BACK_WITHIN = 20.0
"""Seconds in which a killed node must be up again."""
BAG_SECONDS = 60.0


@dataclass(slots=True)
class Samples:
    """Samples of the graph's state.

    Attributes:
        memory: of each process, rows of (seconds since the start, USS in bytes).
        latency: (seconds since the start, latency in seconds) of frames.
        progress: (seconds, seconds of the bag played, frames sent, frames received by the fusion).
        machine: (seconds, load average).
        deaths: processes that died by themselves, and services without success.
    """

    memory: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    latency: list[tuple[float, float]] = field(default_factory=list)
    progress: list[tuple[float, float, float, float]] = field(default_factory=list)
    machine: list[tuple[float, float]] = field(default_factory=list)
    deaths: list[str] = field(default_factory=list)


class Ear(live.Ear):
    """Subscribes to a reference sensor, the angles and the diagnostics."""

    def __init__(self, sensor: str) -> None:
        dds.prepare()
        super().__init__("soak_bench")
        self.sent: dict[bytes, int] = {}
        self.latencies: list[float] = []
        self.angles_at = 0.0
        quick = QoSProfile(depth=_KEPT, reliability=ReliabilityPolicy.BEST_EFFORT)
        # polled by listen() in this order, not by an executor
        topics: tuple[tuple[Any, str, Any, bool], ...] = (
            (PointCloud2, graph.skeleton_topic(sensor), self._on_frame, True),
            (JointState, graph.joint_states_topic(graph.DEFAULT_BODY), self._on_angles, True),
            (DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self.on_diagnostics, False),
        )
        self.subscriptions = [
            self.node.create_subscription(kind, topic, handle, quick, raw=raw) for kind, topic, handle, raw in topics
        ]
        self.triggers = {name: self.node.create_client(Trigger, f"recorder/{name}") for name in ("start", "stop")}

    def _on_frame(self, cdr: bytes, info: Mapping[str, int]) -> None:
        self.sent[cdr[4:12]] = info["source_timestamp"]

    def _on_angles(self, cdr: bytes, info: Mapping[str, int]) -> None:
        self.angles_at = time.time()
        sent = self.sent.pop(cdr[4:12], None)
        # a large difference means the same stamp of another loop of the bag
        if sent is not None and 0 <= info["source_timestamp"] - sent < 2_000_000_000:
            self.latencies.append((info["source_timestamp"] - sent) / 1e9)

    def listen(self, seconds: float) -> None:
        """Poll all subscriptions for this number of seconds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(LOOK)
            # frames first: an angle's frame was published before it
            for subscription in self.subscriptions:
                while (taken := subscription.handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                    subscription.callback(*taken)

    def call(self, name: str) -> str:
        """Call a service of the recorder; returns the failure, or an empty string."""
        if not self.triggers[name].wait_for_service(timeout_sec=30.0):
            return "is not there"
        future = self.triggers[name].call_async(Trigger.Request())
        self.executor.spin_until_future_complete(future, timeout_sec=60.0)
        answer: Any = future.result()
        if answer is None:
            return "gave no answer"
        return "" if answer.success else f"said {answer.message}"


def up_command(folder: Path, bag: Path, args: argparse.Namespace) -> list[str]:
    """Command line of ``body_tracking up`` with a bag in a loop, and a recorder."""
    parameters = live.parameters_file(folder / "parameters.yaml", {"bag_player": {"loop": True}})
    words = ["--bag", bag, "--rate", args.rate, "--record", folder / "recording"]
    return live.up_command(*words, "--log-dir", folder, "--params-file", parameters)


# --- the measurement


def sample(samples: Samples, now: float, processes: Mapping[str, psutil.Process], ear: Ear, duration: float) -> None:
    """Take one sample of all figures."""
    for name, process in processes.items():
        with contextlib.suppress(psutil.Error):
            samples.memory[name].append((now, process.memory_full_info().uss))
    samples.latency += [(now, each) for each in ear.latencies]
    ear.latencies.clear()
    ear.sent.clear()
    played = ear.number("bag_player", "loops") * duration + ear.number("bag_player", "position s")
    samples.progress.append((now, played, ear.number("bag_player", "sent"), ear.number("fusion", "received")))
    samples.machine.append((now, os.getloadavg()[0]))


def soak(args: argparse.Namespace, folder: Path) -> tuple[Samples, dict[str, Any]]:
    """Run the graph; returns the samples, and the recovery times of killed nodes."""
    samples = Samples()
    bag = folder / "bag"
    command = [sys.executable, "-m", "body_tracking.cli", "simulate", "-o", str(bag), "--motion", "torso_twist"]
    subprocess.run([*command, "--seconds", str(BAG_SECONDS)], check=True, stdout=subprocess.DEVNULL)
    with BagReader(bag) as reader:
        duration = (reader.end_ns - reader.start_ns) / 1e9
        sensor = graph.sensors_among(reader.topics)[0]
    with contextlib.ExitStack() as stack:
        (up,) = stack.enter_context(live.processes([up_command(folder, bag, args)], folder / "up.log"))
        ear = Ear(sensor)
        stack.callback(ear.close)
        begin = time.monotonic()
        while not ear.angles_at:
            if up.poll() is not None or time.monotonic() - begin > 60.0:
                raise SystemExit(f"soak: the graph did not start:\n{(folder / 'up.log').read_text()}")
            ear.listen(0.5)
        begin, recorded_since = time.monotonic(), time.monotonic()
        pids = {name: process.pid for name, process in live.nodes_of(up.pid).items()}
        total = 60.0 * args.minutes
        bar = stack.enter_context(
            tqdm(total=total, unit="s", disable=None, bar_format="{l_bar}{bar}| {n:.0f}/{total:.0f} s")
        )
        cpu: dict[str, float] = {}
        while (now := time.monotonic() - begin) < total:
            if up.poll() is not None:
                samples.deaths.append(f"the whole graph after {now:.0f} s: {(folder / 'up.log').read_text()[-500:]}")
                return samples, {"back_s": {}, "cpu": {}}
            processes = live.nodes_of(up.pid)
            for name, pid in pids.items():
                if name not in processes or processes[name].pid != pid:
                    samples.deaths.append(f"{name} after {now:.0f} s")
            pids |= {name: process.pid for name, process in processes.items()}
            sample(samples, now, {**processes, "up": psutil.Process(up.pid)}, ear, duration)
            if time.monotonic() - recorded_since > 60.0:
                recorded_since = time.monotonic()
                failure = ear.call("stop")
                if not failure:
                    shutil.rmtree(folder / "recording")
                    failure = ear.call("start")
                if failure:
                    samples.deaths.append(f"a service of bag_recorder {failure} after {now:.0f} s")
            bar.update(now - bar.n)
            time.sleep(max(0.0, min(PERIOD, total) - LISTENING - (time.monotonic() - begin - now)))
            ear.listen(LISTENING)
        for name, process in live.nodes_of(up.pid).items():
            cpu[name] = live.cpu_seconds(process) / (time.time() - process.create_time())
        back = {name: _killed(name, up, ear) for name in pids}
    return samples, {"back_s": back, "cpu": cpu}


def _killed(name: str, up: subprocess.Popen[bytes], ear: Ear) -> float | None:
    """Kill a node; seconds until it reports again and angles arrive; None if that takes too long."""
    live.nodes_of(up.pid)[name].kill()
    killed, since = time.monotonic(), time.time()
    while time.monotonic() - killed < BACK_WITHIN:
        ear.listen(0.2)
        # messages that were on their way when the node died do not count
        reported = ear.statuses.get(name, (0.0, None))[0] > since + 0.5
        if reported and name in live.nodes_of(up.pid) and ear.angles_at > since + 0.5:
            return round(time.monotonic() - killed, 1)
    return None


# --- the result


def _edges(total: float) -> FloatArray:
    """Start times of the tenths of the run after the warm-up, and end of the last one, seconds."""
    return np.linspace(min(WARM_UP, total / 2), total, TENTHS + 1)


def _latencies(samples: Samples, total: float) -> list[dict[str, float]]:
    """Latency figures of each tenth."""
    latency, rows = np.array(samples.latency).reshape(-1, 2), []
    for begin, end in itertools.pairwise(_edges(total)):
        # a sample holds the latencies since the previous sample
        chosen = latency[(latency[:, 0] > begin) & (latency[:, 0] <= end), 1]
        if len(chosen):
            median, late = (round(float(value), 2) for value in 1e3 * np.percentile(chosen, [50, 99]))
            row = {"minute": round(float(begin) / 60.0, 1), "median_ms": median, "p99_ms": late, "frames": len(chosen)}
            rows.append(row)
    return rows


def result_of(samples: Samples, more: Mapping[str, Any], args: argparse.Namespace) -> dict[str, Any]:
    """All figures."""
    total = 60.0 * args.minutes
    rows = {}
    for name, values in samples.memory.items():
        table = np.array(values)
        times, megabytes = table[:, 0], table[:, 1] / 2**20
        warm = min(WARM_UP, total / 2)
        early, late = (times >= warm) & (times < 2 * warm), times >= min(_edges(total)[-2], times[-1])
        if not early.any() or not late.any():
            continue
        first, last = (float(np.median(megabytes[part])) for part in (early, late))
        rows[name] = {
            "uss_mb": [round(first, 2), round(last, 2)],
            "growth_percent": round(100.0 * (last / first - 1.0), 2),
            "cpu_percent": round(100.0 * more["cpu"].get(name, 0.0), 1),
        }
    progress = np.array(samples.progress)
    progress = progress[progress[:, 0] >= min(WARM_UP, total / 2)]
    elapsed, played, sent, taken = progress[-1] - progress[0] if len(progress) > 1 else np.full(4, np.nan)
    load = np.array(samples.machine)
    return {
        "minutes": args.minutes,
        "rate_asked": args.rate,
        "rate": round(float(played / elapsed), 2),
        "taken_percent": round(100.0 * float(taken / sent), 2),
        "load_average": round(float(load[:, 1].mean()), 2),
        "cores": psutil.cpu_count(),
        "processes": rows,
        "latency": _latencies(samples, total),
        "deaths": samples.deaths,
        "back_s": more["back_s"],
    }


def bars(result: Mapping[str, Any]) -> dict[str, bool]:
    """Whether each bar is met."""
    latency = result["latency"]
    return {
        "memory_flat": all(row["growth_percent"] <= 100.0 * GROWTH for row in result["processes"].values()),
        "nothing_died": not result["deaths"],
        "latency_unchanged": len(latency) > 1 and latency[-1]["median_ms"] <= LATER * latency[0]["median_ms"],
        "every_node_back_after_a_kill": all(seconds is not None for seconds in result["back_s"].values()),
    }


def main() -> int:
    """The command: 0, or 1 when a bar is missed."""
    parser = common.parser(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="to run (default: %(default)g)")
    parser.add_argument("--rate", type=float, default=10.0, help="times the recording's (default: %(default)g)")
    args = parser.parse_args()
    if not 0.5 <= args.minutes <= 1440.0:
        parser.error(f"--minutes {args.minutes:g}: expected 0.5 to 1440")
    with tempfile.TemporaryDirectory() as folder:
        samples, more = soak(args, Path(folder))
    result = result_of(samples, more, args)
    result["bars"] = bars(result)
    common.report(args, result)
    return common.verdicts(args, result["bars"])


if __name__ == "__main__":
    sys.exit(main())
