"""Several people: who is whom in crossings, in a real recording of two people, and six of them live.

1. Simulated people who walk past each other, one or two sensors, with poses that are a little wrong, as calibrations
   are. The sensors' own numbers of bodies are those of a Kinect (a body that was lost comes back with the lowest free
   one), or shuffled in every frame, which makes them worthless. Counted are identity switches (Bernardin and
   Stiefelhagen 2008, "Evaluating multiple object tracking performance: the CLEAR MOT metrics"): how often the number of
   a true person changes.
2. Two people seen by two real sensors (KinectMultiTrack). Nobody knows who is whom there; counted are the numbers that
   were given, assignments that were changed, and jumps of a person by more than half a metre between two frames of a
   sensor.
3. Six people before two sensors at 30 Hz through the live graph: rates, delays over time, what was dropped and what
   diagnostics said, with the default filter and with the extended one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))

import node_processes
import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking import graph
from body_tracking.calibration.offline import calibrate
from body_tracking.calibration.online import CalibrationParameters
from body_tracking.calibration.result import SensorPose
from body_tracking.cdr import encode_skeletons
from body_tracking.fusion.people import People, PeopleParameters
from body_tracking.fusion.subject import ALL
from body_tracking.graph import GraphOptions
from body_tracking.messages.diagnostics import statuses
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import frames_of, sensor_topics
from body_tracking.recording.rig import RigReader
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import Setup, SimulatedRecording, lanes, simulate
from body_tracking.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton

_TRUNK = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER]
EVERYBODY = PeopleParameters(ALL)


# --- 1: crossings


def crossing(seed: int, sensors: int, people: int = 2, seconds: float = 20.0) -> SimulatedRecording:
    """People who walk to and fro in lanes, which lie across the sensors' views or obliquely."""
    rng = np.random.default_rng([seed, 11])
    azimuths = np.radians(rng.uniform(-40.0, 40.0) + np.array([0.0, rng.uniform(50.0, 90.0)]))[:sensors]
    apart = float(rng.uniform(0.55, 0.8))
    return simulate(
        Setup(
            "walking_and_turning",
            around(azimuths.tolist(), distances=2.6 + 0.3 * (people - 2)),
            number=people,
            seconds=seconds,
            seed=seed,
            standard=True,
            places=lanes(people, apart),
        )
    )


def moved(pose: SensorPose, rng: np.random.Generator) -> SensorPose:
    """A pose as a calibration has it: wrong by some centimetres and a degree or two."""
    turn = Rotation.from_rotvec(np.radians(1.5) * rng.normal(size=3)) * Rotation.from_matrix(pose.rotation)
    return SensorPose(pose.sensor, pose.translation + 0.04 * rng.normal(size=3), turn.as_quat())


def shuffled(skeletons: tuple[Skeleton, ...], rng: np.random.Generator) -> tuple[Skeleton, ...]:
    """The same bodies with other numbers, in another order."""
    numbers = rng.permutation(6)[: len(skeletons)].tolist()
    return tuple(sorted((replace(s, body=n) for s, n in zip(skeletons, numbers, strict=True)), key=lambda s: s.body))


def switches(recording: SimulatedRecording, worthless: bool, seed: int) -> dict[str, int]:
    """What happens to the numbers of people in one recording."""
    rng = np.random.default_rng([seed, 12])
    sensors = {sensor.pose.sensor: sensor for sensor in recording.sensors}
    people = People(tuple(sensors), EVERYBODY)
    for number, sensor in enumerate(sensors.values()):
        people.set_pose(moved(sensor.pose, rng) if number else sensor.pose)
        people.set_clock(sensor.pose.sensor, 0, sensor.clock)
    middles = np.stack([truth.positions[:, _TRUNK].mean(axis=1) for truth in recording.truths], axis=1)
    stamps = recording.truths[0].stamps_ns
    # since when, and until when, some sensor has seen everybody all the time
    whole_since_ns = whole_ns = -(10**18)
    last: dict[int, int] = {}
    counted: Counter[str] = Counter({"frames": 0, "switches": 0, "switches while all were visible to a sensor": 0})
    for frame in recording.frames:
        sensor = sensors[frame.sensor]
        stamp_ns = sensor.clock.to_reference(frame.skeletons[0].stamp_ns)
        if len(frame.skeletons) == len(recording.truths):
            whole_since_ns = stamp_ns if stamp_ns - whole_ns > NANOSECONDS // 10 else whole_since_ns
            whole_ns = stamp_ns
        true = middles[np.abs(stamps - stamp_ns).argmin()]
        bodies = shuffled(frame.skeletons, rng) if worthless else frame.skeletons
        for number, body in people.sort(frame.sensor, bodies):
            place = np.nanmean(sensor.pose.apply(body.positions[_TRUNK]), axis=0)
            apart = np.linalg.norm(true - place, axis=1)
            if not apart.min() < 0.5:
                continue
            who = int(apart.argmin())
            counted["frames"] += 1
            if last.setdefault(who, number) != number:
                last[who] = number
                counted["switches"] += 1
                seen = stamp_ns - whole_ns <= NANOSECONDS // 10 and stamp_ns - whole_since_ns >= NANOSECONDS
                counted["switches while all were visible to a sensor"] += seen
    counted.update(people.counters)
    return dict(counted)


def crossings(seeds: Iterable[int], counts: Iterable[int] = (2, 3)) -> list[dict[str, Any]]:
    """The first measurement."""
    rows = []
    cases = [(people, sensors) for people in counts for sensors in (1, 2)]
    for people, sensors in cases:
        totals = {False: Counter[str](), True: Counter[str]()}
        for seed in seeds:
            print(f"{people} people, {sensors} sensor(s), seed {seed}", file=sys.stderr, flush=True)
            recording = crossing(seed, sensors, people)
            for worthless, total in totals.items():
                total.update(switches(recording, worthless, seed))
        for worthless, total in totals.items():
            numbers = "shuffled" if worthless else "a Kinect's"
            rows.append({"crossing": people, "sensors": sensors, "numbers": numbers, **total})
    return rows


# --- 2: two real people


def real(file: Path, folder: Path) -> dict[str, Any]:
    """The second measurement."""
    bag = folder / "two_people"
    import_files([file], bag)
    result, _ = calibrate(bag, CalibrationParameters())
    people = People(tuple(result.poses), EVERYBODY)
    for pose in result.poses.values():
        people.set_pose(pose)
    for sensor, clock in result.clocks.items():
        people.set_clock(sensor, 0, clock)
    counted: Counter[str] = Counter(
        {"frames": 0, "bodies": 0, "without a number": 0, "jumps": 0, "jumps of a sensor's own numbers": 0}
    )
    where: dict[tuple[str, str, int], tuple[int, FloatArray]] = {}
    newest_ns = -(10**18)
    numbers: Counter[int] = Counter()
    apart: list[float] = []
    with RigReader(bag) as reader:
        topics = sensor_topics(reader)
        for sensor, skeletons, _, _ in frames_of(reader, topics, Counter()):
            counted["frames"] += 1
            counted["bodies"] += len(skeletons)
            at_ns = result.clocks[sensor].to_reference(skeletons[0].stamp_ns)
            # the recording has pauses that are longer than anybody is waited for
            counted["parts"] += at_ns - newest_ns > EVERYBODY.hold * NANOSECONDS
            newest_ns = max(newest_ns, at_ns)
            found = people.sort(sensor, skeletons)
            counted["without a number"] += len(skeletons) - len(found)
            sightings = [("jumps", number, body) for number, body in found]
            sightings += [("jumps of a sensor's own numbers", body.body, body) for body in skeletons]
            for kind, number, body in sightings:
                place = body.positions[_TRUNK].mean(axis=0)
                before = where.get((kind, sensor, number))
                where[kind, sensor, number] = body.stamp_ns, place
                if before is None or body.stamp_ns - before[0] > 0.3 * NANOSECONDS:
                    continue
                counted[kind] += float(np.linalg.norm(place - before[1])) > 0.5
            for number, body in found:
                numbers[number] += 1
                stamp_ns = result.clocks[sensor].to_reference(body.stamp_ns)
                for other in set(result.poses) - {sensor}:
                    theirs = where.get(("jumps", other, number))
                    if theirs and abs(result.clocks[other].to_reference(theirs[0]) - stamp_ns) < 0.05 * NANOSECONDS:
                        here, there = result.poses[sensor].apply(where["jumps", sensor, number][1]), theirs[1]
                        apart.append(float(np.linalg.norm(here - result.poses[other].apply(there))))
    return {
        **counted,
        "frames of each number": dict(sorted(numbers.items())),
        "sensors apart, median mm": round(1e3 * float(np.median(apart))),
        "sensors apart, 99 % mm": round(1e3 * float(np.percentile(apart, 99))),
        **{f"association {name}": count for name, count in people.counters.items()},
    }


# --- 3: six people, live


class Play:
    """What the sensors saw, to and fro, so that nobody ever jumps."""

    def __init__(self, recording: SimulatedRecording) -> None:
        self.poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
        clocks = {sensor.pose.sensor: sensor.clock for sensor in recording.sensors}
        self._frames = {name: [f.skeletons for f in recording.frames if f.sensor == name] for name in clocks}
        self._times = {
            name: np.array([clocks[name].to_reference(each[0].stamp_ns) for each in frames])
            for name, frames in self._frames.items()
        }

    def at(self, sensor: str, seconds: float, stamp_ns: int) -> bytes:
        """The message at a time of the play, with a stamp."""
        times = self._times[sensor]
        length = int(times[-1] - times[0])
        way = round(seconds * NANOSECONDS) % (2 * length)
        wanted = times[0] + min(way, 2 * length - way)
        skeletons = self._frames[sensor][int(np.abs(times - wanted).argmin())]
        return encode_skeletons([replace(each, stamp_ns=stamp_ns) for each in skeletons])


class Ear:
    """Takes the time of angles, and keeps what diagnostics say."""

    def __init__(self, bodies: tuple[str, ...]) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        from body_tracking.nodes.bag_topics import to_profile
        from body_tracking.recording.qos import RELIABLE

        self.angles: list[tuple[str, int, int]] = []
        self.values: dict[str, dict[str, str]] = {}
        self.warnings: Counter[str] = Counter()
        self.node = rclpy.create_node("people_bench")
        for body in bodies:
            self.node.create_subscription(
                JointState, graph.joint_states_topic(body), self._angles(body), to_profile(RELIABLE)
            )
        self.node.create_subscription(DiagnosticArray, graph.DIAGNOSTICS_TOPIC, self._told, to_profile(RELIABLE))
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)

    def _angles(self, body: str) -> Any:
        def come(message: Any) -> None:
            stamp = message.header.stamp
            self.angles.append((body, stamp.sec * NANOSECONDS + stamp.nanosec, time.time_ns()))

        return come

    def _told(self, message: Any) -> None:
        for status in statuses(message):
            self.values[status.node] = dict(status.values)
            if status.level and status.text.startswith("too slow"):
                self.warnings[status.node] += 1


def start(folder: Path, play: Play, filter_name: str, people: int) -> list[subprocess.Popen[bytes]]:
    """The graph's nodes from its own table; this process takes the place of the sensors."""
    calibration = node_processes.calibrated(folder, play.poses)
    options = GraphOptions(
        tuple(play.poses), filter_name=filter_name, subject=ALL, people=people, calibration_file=calibration
    )
    return node_processes.start(node_processes.commands(folder, options, level="ERROR"))


def live(filter_name: str, play: Play, people: int, seconds: float) -> dict[str, Any]:
    """The third measurement."""
    import rclpy
    from sensor_msgs.msg import PointCloud2

    from body_tracking.nodes.bag_topics import to_profile

    rclpy.init()
    ear = Ear(graph.bodies(people))
    qos = to_profile(graph.SKELETON)
    outputs = {name: ear.node.create_publisher(PointCloud2, graph.skeleton_topic(name), qos) for name in play.poses}
    by_sensor = graph.role_of(GraphOptions(filter_name=filter_name)).input == graph.SENSORS_INPUT
    with tempfile.TemporaryDirectory() as name:
        processes = start(Path(name), play, filter_name, people)
        try:
            end = time.monotonic() + 60.0
            while not all(output.get_subscription_count() >= 2 + by_sensor for output in outputs.values()):
                ear.executor.spin_once(timeout_sec=0.1)
                if time.monotonic() > end or any(process.poll() is not None for process in processes):
                    raise SystemExit("people: the processes did not come up")
            begin_ns = time.time_ns() + NANOSECONDS // 2
            events = sorted(
                ((k + 0.4 * number) / 30.0, sensor)
                for number, sensor in enumerate(outputs)
                for k in range(round(30 * seconds))
            )
            print(f"{people} people, {filter_name}: {seconds:.0f} s", file=sys.stderr, flush=True)
            for at, sensor in events:
                due_ns = begin_ns + round(at * NANOSECONDS)
                while (left_ns := due_ns - time.time_ns()) > 0:
                    ear.executor.spin_once(timeout_sec=left_ns / NANOSECONDS)
                outputs[sensor].publish(play.at(sensor, at, due_ns))
            end = time.monotonic() + 2.0
            while time.monotonic() < end:
                ear.executor.spin_once(timeout_sec=0.05)
        finally:
            node_processes.stop(processes)
            ear.node.destroy_node()
            rclpy.shutdown()
    return {"filter": filter_name, "people": people, "seconds": seconds, **told(ear, begin_ns, seconds)}


def told(ear: Ear, begin_ns: int, seconds: float) -> dict[str, Any]:
    """Figures of one run; the first fifth, while everything starts, is not among the delays."""
    stamps = np.array([stamp_ns - begin_ns for _, stamp_ns, _ in ear.angles]) / NANOSECONDS
    delays = np.array([received_ns - stamp_ns for _, stamp_ns, received_ns in ear.angles]) / 1e6
    counts = Counter(body for body, _, _ in ear.angles)
    parts = np.linspace(0.2 * seconds, seconds, 5)
    quarters = [delays[(stamps >= a) & (stamps < b)] for a, b in pairwise(parts)]
    dropped: dict[str, dict[str, int]] = {}
    for node, values in ear.values.items():
        found = {key: int(value) for key, value in values.items() if key.startswith(("dropped ", "lost "))}
        if any(found.values()):
            dropped[node] = found
    return {
        "rate of each, Hz": {body: round(count / seconds, 1) for body, count in sorted(counts.items())},
        "angles in each quarter": [len(each) for each in quarters],
        "delay ms, median of each quarter": [round(float(np.median(each)), 1) for each in quarters if len(each)],
        "delay ms, 99 % of each quarter": [round(float(np.percentile(each, 99)), 1) for each in quarters if len(each)],
        "dropped and lost": dropped,
        "seconds in which diagnostics said that it is too slow": dict(ear.warnings),
        "association": {
            key: value for key, value in ear.values.get("fusion", {}).items() if key.startswith("association")
        },
    }


def main() -> int:
    """The benchmark; exit code 1 where a number was exchanged that should not have been."""
    root = Path(__file__).resolve().parent.parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("BODY_TRACKING_DATA", root.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of real recordings (default: %(default)s)")
    parser.add_argument("--only", choices=("crossings", "real", "live"), help="one of the three")
    parser.add_argument("--seeds", type=int, default=10, metavar="N", help="of the crossings (default: %(default)s)")
    parser.add_argument("--people", type=int, default=6, metavar="N", help="live (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=40.0, metavar="S", help="of each live run (default: 40)")
    parser.add_argument("--filters", default="lkf_constant_velocity,ekf", metavar="A,B", help="live (default: both)")
    args = parser.parse_args()
    result: dict[str, Any] = {}
    if args.only in (None, "crossings"):
        result["crossings"] = crossings(range(args.seeds))
    if args.only in (None, "real"):
        file = args.data / "kinect_pairs" / "two_people_p24_45deg.csv.gz"
        if file.is_file():
            with tempfile.TemporaryDirectory() as folder:
                result["two real people"] = real(file, Path(folder))
        else:
            print(f"the real recording is absent ({args.data})", file=sys.stderr)
    if args.only in (None, "live"):
        play = Play(crossing(0, 2, args.people, seconds=10.0))
        result["live"] = [live(name, play, args.people, args.seconds) for name in args.filters.split(",")]
    print(json.dumps(result, indent=2))
    return int(any(row["switches while all were visible to a sensor"] for row in result.get("crossings", ())))


if __name__ == "__main__":
    sys.exit(main())
