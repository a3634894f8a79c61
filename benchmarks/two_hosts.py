"""Two Kinects on one computer, the graph on another, and a bad network between them: angles, stamps and recovery.

A simulated person stands in front of two Kinects. ``kinect_sender --replay`` streams both from one host to another with
the graph of ``body_tracking up``, through a relay that loses packets, delays each of them differently, and cuts the
link for a while. The hosts are network namespaces, a time namespace shifts the senders' clock: this needs root, or a
system with user namespaces. The graph starts with the true poses of the sensors.

The angles are compared with those of the same chain offline, from the whole recording, and from the received frames;
the latter shows the effect of the loss alone. Left out are angles with a standard deviation above 15 degrees, and the
time from the start of the cut to a second after its end. Errors of stamps are counted without their median: no receiver
can know the delay of the fastest frame.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common
import hosts
import live
import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.message_types import DIAGNOSTICS, JOINT_STATE, POINT_CLOUD
from body_tracking.core.qos import SENSOR_DATA
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.filters import DEFAULT_FILTER, FILTERS
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, BagWriter, deserialize
from body_tracking.simulation import scene
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import RECEIVED_FROM_NS, Setup, SimulatedRecording

SETTLE = 4.0
"""Seconds of initialisation of person and noise, before the comparison."""

LEAD, LEAD_FACTOR = 2.0, 3.0
"""Seconds from the start of the graph to that of the recording, plus this multiple of a sender's start time."""
READY_TIMEOUT = 180.0

WORST_STDDEV = np.radians(15.0)
LIMITS = {"angle_deg": 0.5, "all_angles_deg": 0.25, "recovery_s": 1.0}
NO_NAMESPACES = 77
"""Exit code where the system does not permit namespaces."""

_SEED = 11
_LAYOUT = around(np.radians([45.0, -45.0]).tolist(), (2.0, 2.0), (1.0, 1.0))
_PORT = 7525


@dataclass(frozen=True, slots=True)
class Link:
    """Probability of loss, largest delay in seconds, and wall times of the start and the end of the cut."""

    loss: float
    jitter: float
    cut: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Options:
    """Seconds compared before and after the cut, of the cut, and between the clocks; link, filter, and a folder."""

    seconds: float
    cut: float
    shift: float
    link: Link
    filter: str
    keep: Path | None


# --- the recording


def simulate(seconds: float, folder: Path) -> SimulatedRecording:
    """Write the recording as a bag, and its calibration as two files: for recorded stamps and for ROS time."""
    recording = scene.simulate(Setup("torso_twist", _LAYOUT, seconds=seconds, seed=_SEED, standard=True))
    write_bag(recording, folder / "bag")
    poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
    trusted = dict.fromkeys(poses, ClockModel(anchor_ns=RECEIVED_FROM_NS))
    live.calibrated(folder / "recorded.yaml", poses, trusted)
    live.calibrated(folder / "received.yaml", poses)
    return recording


def captures(recording: SimulatedRecording) -> dict[str, FloatArray]:
    """Per sensor (n, 3) integer nanoseconds: stamp of a frame, its capture in reference time, its receipt."""
    clocks = {sensor.pose.sensor: sensor.clock for sensor in recording.sensors}
    found: dict[str, list[tuple[int, int, int]]] = {name: [] for name in clocks}
    for frame in recording.frames:
        stamp = frame.skeletons[0].stamp_ns
        found[frame.sensor].append((stamp, clocks[frame.sensor].to_reference(stamp), frame.received_ns))
    return {name: np.array(rows) for name, rows in found.items()}


# --- the run


@dataclass(frozen=True, slots=True)
class Run:
    """Wall time of the recording's start, link with its cut, number of node restarts, exit codes of the senders."""

    start: float
    link: Link
    restarts: int
    codes: dict[str, int]


def run(recording: SimulatedRecording, folder: Path, options: Options) -> Run:
    """Stream the recording through the graph."""
    link, before = options.link, SETTLE + options.seconds
    names = [sensor.pose.sensor for sensor in recording.sensors]
    key = folder / "key"
    sender = [sys.executable, "-m", "body_tracking.kinect.kinect_sender"]
    subprocess.run([*sender, "--make-key", str(key)], check=True, stdout=subprocess.DEVNULL)
    begun = time.monotonic()
    subprocess.run([*sender, "--replay", str(folder / "bag"), "--sensor", "nobody"], stderr=subprocess.DEVNULL)
    lead = LEAD + LEAD_FACTOR * (time.monotonic() - begun)
    ports = {name: _PORT + k for k, name in enumerate(names)}
    network = {"backend": "network", "address": hosts.INSIDE, "key_file": str(key)}
    values = {f"{name}_skeleton": {**network, "port": port} for name, port in ports.items()}
    parameters = live.parameters_file(folder / "parameters.yaml", values)
    up = live.up_command("--filter", options.filter, "--sensors", ",".join(names), "--params-file", parameters)
    up += ["--calibration", str(folder / "received.yaml"), "--record", str(folder / "live")]
    up += ["--log-dir", str(folder), "--reliable"]
    with hosts.hosts() as (outside, middle), contextlib.ExitStack() as stack:

        def begin(name: str, command: Sequence[str]) -> subprocess.Popen[bytes]:
            log = folder / f"{name}.log"
            (made,) = stack.enter_context(live.processes([command], log, 20.0, stdin=subprocess.PIPE))
            return made

        middleman = begin("relay", [*middle, *hosts.command("relay", link.loss, link.jitter, *ports.values())])
        graph_process = begin("up", up)
        # the sensors' nodes start last: all subscribers are up by then
        ports_open = [f":{port:04X}" for port in ports.values()]
        live.wait(
            "two_hosts: the graph",
            lambda: all(port in Path("/proc/net/udp").read_text() for port in ports_open),
            [graph_process],
            READY_TIMEOUT,
            folder / "up.log",
        )
        start = time.time() + lead
        link = replace(link, cut=(start + before, start + before + options.cut) if options.cut else (0.0, 0.0))
        assert middleman.stdin is not None
        middleman.stdin.write(f"{link.cut[0]} {link.cut[1]}\n".encode())
        middleman.stdin.flush()
        senders = {}
        for name in names:
            words = [*sender, "--replay", str(folder / "bag"), "--sensor", name, "--key-file", str(key)]
            words += ["--to", f"{hosts.RELAY_OUT}:{ports[name]}", "--start-time", repr(start)]
            senders[name] = begin(name, [*outside, *hosts.command("shift", options.shift, *words)])
        while time.time() < start + recording.duration + 1.0:
            if graph_process.poll() is not None or middleman.poll() is not None:
                raise SystemExit(f"two_hosts: a process ended too early\n{(folder / 'up.log').read_text()[-2000:]}")
            time.sleep(0.1)
        codes = {name: process.wait(60.0) for name, process in senders.items()}
    return Run(start, link, (folder / "up.log").read_text().count("starting it again"), codes)


# --- evaluation


@dataclass(frozen=True, slots=True, eq=False)
class Angles:
    """Joint angles over time: names, (n,) stamps ns, (n,) receipt ns, (n, k) radians, (n, k) standard deviations."""

    names: tuple[str, ...]
    stamps: FloatArray
    received: FloatArray
    values: FloatArray
    stddevs: FloatArray

    def at(self, stamps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Angles and standard deviations, linearly interpolated."""
        unwrapped = np.unwrap(self.values, axis=0)
        columns = range(len(self.names))
        return (
            np.stack([np.interp(stamps, self.stamps, unwrapped[:, k]) for k in columns], axis=1),
            np.stack([np.interp(stamps, self.stamps, self.stddevs[:, k]) for k in columns], axis=1),
        )


def read_angles(bag: Path) -> Angles:
    """The joint angles in a recording, by time."""
    topics = (graph.joint_states_topic(graph.DEFAULT_BODY), graph.joint_states_stddev_topic(graph.DEFAULT_BODY))
    values: dict[int, tuple[int, FloatArray]] = {}
    stddevs: dict[int, FloatArray] = {}
    names: tuple[str, ...] = ()
    with BagReader(bag) as reader:
        for raw in reader.messages(topics):
            message = deserialize(JOINT_STATE, raw.cdr)
            stamp = to_nanoseconds(message.header.stamp)
            if raw.topic == topics[0]:
                names = tuple(message.name)
                values[stamp] = raw.log_time_ns, np.array(message.position)
            else:
                stddevs[stamp] = np.minimum(np.array(message.position), 10.0)
    stamps = sorted(values.keys() & stddevs.keys())
    return Angles(
        tuple(name.removesuffix(f"_{graph.DEFAULT_BODY}") for name in names),
        np.array(stamps),
        np.array([values[stamp][0] for stamp in stamps]),
        np.array([values[stamp][1] for stamp in stamps]),
        np.array([stddevs[stamp] for stamp in stamps]),
    )


def match(recording: SimulatedRecording, live: Path) -> dict[str, FloatArray]:
    """Per sensor (m, 3): index of a received frame in the recording, its stamp in the live bag, its receipt; ns.

    A frame is identified by its coordinates, which the network keeps to the bit.
    """
    known = {name: {} for name in captures(recording)}
    count = dict.fromkeys(known, 0)
    for frame in recording.frames:
        known[frame.sensor][frame.skeletons[0].positions.astype(np.float32).tobytes()] = count[frame.sensor]
        count[frame.sensor] += 1
    found: dict[str, list[tuple[int, int, int]]] = {name: [] for name in known}
    topics = {graph.skeleton_topic(name): name for name in known}
    with BagReader(live) as reader:
        for raw in reader.messages(topics):
            (skeleton,) = cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
            name = topics[raw.topic]
            index = known[name][skeleton.positions.astype(np.float32).tobytes()]
            found[name].append((index, skeleton.stamp_ns, raw.log_time_ns))
    return {name: np.array(rows) for name, rows in found.items()}


def without_lost(folder: Path, came: Mapping[str, FloatArray]) -> Path:
    """The recording with the received frames only."""
    out = folder / "came"
    topics = {graph.skeleton_topic(name): set(rows[:, 0].tolist()) for name, rows in came.items()}
    count = dict.fromkeys(topics, 0)
    with BagReader(folder / "bag") as reader, BagWriter(out) as writer:
        for topic in topics:
            writer.add_topic(topic, POINT_CLOUD, SENSOR_DATA)
        for raw in reader.messages(topics):
            if count[raw.topic] in topics[raw.topic]:
                writer.write(raw.topic, raw.cdr, raw.log_time_ns)
            count[raw.topic] += 1
    return out


def offline(folder: Path, bag: Path, out: Path, name: str) -> Angles:
    """Angles of the chain from a recording, offline."""
    calibration = folder / f"{out.name}.yaml"
    shutil.copy(folder / "recorded.yaml", calibration)
    command = [sys.executable, "-m", "body_tracking.cli", "replay", str(bag), "-o", str(out), "--filter", name]
    subprocess.run([*command, "--calibration", str(calibration)], check=True, stdout=subprocess.DEVNULL)
    return read_angles(out)


def measure(options: Options) -> dict[str, Any]:
    """Run the benchmark once."""
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="two_hosts_")))
        folder.mkdir(parents=True, exist_ok=True)
        recording = simulate(SETTLE + 2.0 * options.seconds + options.cut, folder)
        ran = run(recording, folder, options)
        start, link = ran.start, ran.link
        came = match(recording, folder / "live")
        if not all(len(rows) for rows in came.values()):
            raise SystemExit("two_hosts: no frame of a sensor came through")
        live = read_angles(folder / "live")
        whole = offline(folder, folder / "bag", folder / "whole", options.filter)
        lossy = offline(folder, without_lost(folder, came), folder / "of_what_came", options.filter)
        values = last_values(folder / "live")
        reference = next(iter(came))
        with RigReader(folder / "bag") as reader:
            frames = [decode_skeletons(raw.cdr) or () for raw in reader.messages([graph.skeleton_topic(reference)])]
            recorded = np.array([skeleton.stamp_ns for (skeleton,) in frames])
    result: dict[str, Any] = {
        "seconds": recording.duration,
        "cut_s": options.cut,
        "filter": options.filter,
        "loss": link.loss,
        "jitter_ms": link.jitter * 1e3,
    }
    result["shift_ms"] = options.shift * 1e3
    result |= {"restarts": ran.restarts, "sender_exit_codes": ran.codes, "sensors": {}}
    truth = captures(recording)
    begun = round(start * NANOSECONDS) - RECEIVED_FROM_NS
    for sensor, rows in came.items():
        delivered = truth[sensor][:, 2] + begun
        in_cut = (delivered >= link.cut[0] * NANOSECONDS) & (delivered < link.cut[1] * NANOSECONDS)
        lost = len(delivered) - len(rows) - int(in_cut.sum())
        # capture in wall time: as long before delivery as by the reference sensor's clock, which has the wall's rate
        errors = (rows[:, 1] - (truth[sensor][rows[:, 0], 1] + begun)) / 1e6
        steady = delivered[rows[:, 0]] > (start + SETTLE) * NANOSECONDS
        errors = errors[steady] - np.median(errors[steady])
        back = rows[rows[:, 2] >= link.cut[1] * NANOSECONDS, 2]
        result["sensors"][sensor] = {
            "recorded": len(delivered),
            "received": len(rows),
            # a sender on a busy machine drops frames that are late by half a second
            "not_sent": max(0, len(delivered) - len(rows) - int(values[f"{sensor}_skeleton"].get("lost", 0))),
            "lost_percent": round(100.0 * lost / max(1, int((~in_cut).sum())), 2),
            "stamp_rms_ms": round(float(np.sqrt((errors**2).mean())), 3),
            "stamp_max_ms": round(float(np.abs(errors).max()), 3),
            "first_frame_after_s": round(float(back[0]) / NANOSECONDS - link.cut[1], 3)
            if options.cut and len(back)
            else None,
            **{
                key: values[f"{sensor}_skeleton"].get(key)
                for key in ("sessions", "round trip ms", "lost", "clock drift ppm")
            },
        }
    rows = came[reference]
    # map this machine's ROS time to the recording's, by the frames with both stamps
    slope, base = np.polyfit((rows[:, 1] - rows[0, 1]) / NANOSECONDS, recorded[rows[:, 0]] - rows[:, 1], 1)
    stamps = live.stamps + base + slope * (live.stamps - rows[0, 1]) / NANOSECONDS
    result["angles"] = compare(live, stamps, whole, lossy, start, link)
    return result


def compare(live: Angles, stamps: FloatArray, whole: Angles, lossy: Angles, start: float, link: Link) -> dict[str, Any]:
    """Differences by angle in degrees, and the recovery."""
    wall = live.stamps / NANOSECONDS
    judged = (wall > start + SETTLE) & ~((wall > link.cut[0] - 0.2) & (wall < link.cut[1] + 1.0))
    judged &= (stamps > lossy.stamps[0]) & (stamps < lossy.stamps[-1])
    by_whole, dev_whole = whole.at(stamps)
    by_lossy, dev_lossy = lossy.at(stamps)
    certain = np.maximum(np.maximum(dev_whole, dev_lossy), live.stddevs) < WORST_STDDEV
    use = certain & judged[:, None]
    apart = np.degrees(np.abs(wrapped(live.values - by_lossy)))
    from_whole = np.degrees(np.abs(wrapped(live.values - by_whole)))
    loss_alone = np.degrees(np.abs(wrapped(by_lossy - by_whole)))
    rows = {}
    for k, name in enumerate(live.names):
        if use[:, k].sum() > 50:
            own = use[:, k]
            rows[name] = {
                "samples": int(own.sum()),
                "rms_to_whole_deg": _rms(from_whole[own, k]),
                "rms_deg": _rms(apart[own, k]),
                "loss_alone_deg": _rms(loss_alone[own, k]),
            }
    result: dict[str, Any] = {
        "by_angle": rows,
        "all_deg": _rms(apart[use]),
        "all_to_whole_deg": _rms(from_whole[use]),
        "loss_alone_deg": _rms(loss_alone[use]),
    }
    if link.cut[1]:
        result |= recovery(live.received / NANOSECONDS, wall, np.where(certain, apart, np.nan), start, link)
    return result


def recovery(received: FloatArray, wall: FloatArray, apart: FloatArray, start: float, link: Link) -> dict[str, Any]:
    """Seconds from the end of the cut to the first angles, and to the first half second as good as before the cut.

    The limit is the 99th percentile of the half seconds' RMS differences before the cut, at least a degree.
    """

    def half_second(at: float) -> float:
        found = apart[(wall >= at) & (wall < at + 0.5)]
        return _rms(found) if np.isfinite(found).any() else float("inf")

    before = [half_second(at) for at in np.arange(start + SETTLE, link.cut[0] - 0.5, 0.1)]
    limit = max(1.0, float(np.percentile([each for each in before if np.isfinite(each)], 99.0)))
    after = np.flatnonzero(wall > link.cut[1])
    good = next((k for k in after if half_second(wall[k]) <= limit), None)
    return {
        "first_angles_after_s": round(float(received[after[0]] - link.cut[1]), 3) if len(after) else None,
        "recovery_limit_deg": round(limit, 2),
        "recovery_s": None if good is None else round(float(received[good] - link.cut[1]), 3),
    }


def _rms(values: FloatArray) -> float:
    return round(common.rms(values), 3) if np.isfinite(values).any() else 0.0


def last_values(bag: Path) -> dict[str, dict[str, str]]:
    """Values of each node's last diagnostics."""
    found = {}
    with BagReader(bag) as reader:
        for raw in reader.messages([graph.DIAGNOSTICS_TOPIC]):
            for status in statuses(deserialize(DIAGNOSTICS, raw.cdr)):
                found[status.node] = dict(status.values)
    return found


# --- the command


def bars(result: dict[str, Any]) -> dict[str, bool]:
    """Whether each bar is met."""
    angles, sensors = result["angles"], result["sensors"].values()
    met = {
        "every angle as from the recording within the loss": all(
            row["rms_to_whole_deg"] <= row["loss_alone_deg"] + LIMITS["angle_deg"]
            for row in angles["by_angle"].values()
        ),
        "all angles together": angles["all_to_whole_deg"] <= angles["loss_alone_deg"] + LIMITS["all_angles_deg"],
        "no restart, one session each": result["restarts"] == 0
        and all(code == 0 for code in result["sender_exit_codes"].values())
        and all(row["sessions"] == "1" for row in sensors),
        "stamps": all(row["stamp_max_ms"] <= 0.5 * result["jitter_ms"] for row in sensors),
    }
    if result["cut_s"]:
        recovered = angles["recovery_s"] is not None and angles["recovery_s"] <= LIMITS["recovery_s"]
        met["recovery after the cut"] = recovered
    return met


def main() -> int:
    """The command: 0 where every bar is met, 1 where not, 77 where namespaces are not permitted."""
    parser = common.parser(__doc__)
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="to compare before and after the cut, each (default 20)"
    )
    parser.add_argument("--cut", type=float, default=30.0, help="seconds without a link (default 30; 0 for none)")
    parser.add_argument("--loss", type=float, default=2.0, help="percent of packets lost (default 2)")
    parser.add_argument("--jitter", type=float, default=5.0, help="milliseconds of delay at most (default 5)")
    parser.add_argument("--shift", type=float, default=0.3, help="seconds between the clocks (default 0.3)")
    parser.add_argument("--filter", choices=FILTERS, default=DEFAULT_FILTER, help="default %(default)s")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for recordings and logs, to look at them later")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not args.inside:
        return _inside()
    link = Link(args.loss / 100.0, args.jitter / 1e3)
    result = measure(Options(args.seconds, args.cut, args.shift, link, args.filter, args.keep))
    result["bars"] = bars(result)
    common.report(args, result)
    return common.verdicts(args, result["bars"])


def _inside() -> int:
    """Run the same command in its own network namespace, which is the host of the graph."""
    reason = hosts.not_permitted()
    if reason:
        common.progress(f"two_hosts: network and time namespaces are not permitted here ({reason})")
        return NO_NAMESPACES
    command = hosts.in_own_network([sys.executable, __file__, "--inside", *sys.argv[1:]])
    process = subprocess.Popen(command)  # in the ROS domain chosen by `live`
    try:
        return process.wait()
    except KeyboardInterrupt:
        return process.wait()


if __name__ == "__main__":
    sys.exit(main())
