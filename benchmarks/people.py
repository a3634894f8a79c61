"""Several people: identities in crossings, in a real recording of two people, and of six people live.

1. Simulated people who walk past each other, one or two sensors, with the errors of the poses that calibrations have.
   The sensors' own body numbers are those of a Kinect (a body that was lost returns with the lowest free one), or
   shuffled in every frame, which makes them worthless. Identity switches are counted (Bernardin and Stiefelhagen 2008,
   "Evaluating multiple object tracking performance: the CLEAR MOT metrics"): changes of a true person's number.
2. Two people seen by two real sensors (KinectMultiTrack), without a truth. Counted are the assigned numbers, changed
   assignments, and jumps of a person by more than half a metre between two frames of a sensor.
3. Six people in front of two sensors at 30 Hz through the live graph: rates, delays over time, dropped messages and
   diagnostics, with the default filter and with the extended one.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import common
import live
import numpy as np
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

from body_tracking.calibration.online import CalibrationParameters
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton
from body_tracking.fusion.people import People
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL, PeopleParameters
from body_tracking.pipeline.roles import role_of
from body_tracking.recording.calibrate import calibrate
from body_tracking.recording.importer import import_files
from body_tracking.recording.replay import sensor_topics
from body_tracking.recording.rig import RigReader
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import Setup, SimulatedRecording, lanes, simulate

_TRUNK = [Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER]
EVERYBODY = PeopleParameters(ALL)


# --- 1: crossings


def crossing(seed: int, sensors: int, people: int = 2, seconds: float = 20.0) -> SimulatedRecording:
    """People who walk to and fro in lanes, across the sensors' views or obliquely."""
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
    """A pose with the errors of a calibration: some centimetres and a degree or two."""
    turn = Rotation.from_rotvec(np.radians(1.5) * rng.normal(size=3)) * Rotation.from_matrix(pose.rotation)
    return SensorPose(pose.sensor, pose.translation + 0.04 * rng.normal(size=3), turn.as_quat())


def shuffled(skeletons: tuple[Skeleton, ...], rng: np.random.Generator) -> tuple[Skeleton, ...]:
    """The same bodies with shuffled numbers, in the order of these."""
    numbers = rng.permutation(6)[: len(skeletons)].tolist()
    return tuple(sorted((replace(s, body=n) for s, n in zip(skeletons, numbers, strict=True)), key=lambda s: s.body))


def switches(recording: SimulatedRecording, worthless: bool, seed: int) -> dict[str, int]:
    """Counts of frames, identity switches and events of the association in one recording."""
    rng = np.random.default_rng([seed, 12])
    sensors = {sensor.pose.sensor: sensor for sensor in recording.sensors}
    people = People(tuple(sensors), EVERYBODY)
    for number, sensor in enumerate(sensors.values()):
        people.set_pose(moved(sensor.pose, rng) if number else sensor.pose)
        people.set_clock(sensor.pose.sensor, 0, sensor.clock)
    middles = np.stack([truth.positions[:, _TRUNK].mean(axis=1) for truth in recording.truths], axis=1)
    stamps = recording.truths[0].stamps_ns
    # begin and end of the latest period in which some sensor saw all people
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
    counted.update(people.counts)
    return dict(counted)


def crossings(seeds: Iterable[int]) -> list[dict[str, Any]]:
    """Part 1."""
    rows = []
    cases = [(people, sensors) for people in (2, 3) for sensors in (1, 2)]
    for people, sensors in cases:
        totals = {False: Counter[str](), True: Counter[str]()}
        for seed in seeds:
            common.progress(f"{people} people, {sensors} sensor(s), seed {seed}")
            recording = crossing(seed, sensors, people)
            for worthless, total in totals.items():
                total.update(switches(recording, worthless, seed))
        for worthless, total in totals.items():
            numbers = "shuffled" if worthless else "a Kinect's"
            rows.append({"crossing": people, "sensors": sensors, "numbers": numbers, **total})
    return rows


# --- 2: two real people


def real(file: Path, folder: Path) -> dict[str, Any]:
    """Part 2."""
    bag = folder / "two_people"
    import_files([file], bag)
    result, *_ = calibrate(bag, CalibrationParameters())
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
        for raw in reader.messages(topics):
            sensor, skeletons = topics[raw.topic], decode_skeletons(raw.cdr)
            if not skeletons or not any(body.valid.any() for body in skeletons):
                continue
            counted["frames"] += 1
            counted["bodies"] += len(skeletons)
            at_ns = result.clocks[sensor].to_reference(skeletons[0].stamp_ns)
            # the recording has pauses that are longer than a lost person is kept
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
        **{f"association {name}": count for name, count in people.counts.items()},
    }


# --- 3: six people, live


def streams_of(recording: SimulatedRecording) -> dict[str, live.Stream]:
    """Endless stream of each sensor, forwards and backwards."""
    names = [sensor.pose.sensor for sensor in recording.sensors]
    frames = {name: [frame.skeletons for frame in recording.frames if frame.sensor == name] for name in names}
    return live.streams(frames, {sensor.pose.sensor: sensor.clock for sensor in recording.sensors})


class Ear(live.Bench):
    """Also counts diagnostics that report a node as too slow."""

    def __init__(self) -> None:
        super().__init__("people_bench")
        self.warnings: Counter[str] = Counter()
        self.hear_diagnostics()

    def on_diagnostics(self, message: Any, _info: Any = None) -> None:
        super().on_diagnostics(message)
        for status in statuses(message):
            self.warnings[status.node] += status.level > 0 and status.text.startswith("too slow")


def run_live(filter_name: str, recording: SimulatedRecording, people: int, seconds: float) -> dict[str, Any]:
    """Part 3 with one filter."""
    streams, ear = streams_of(recording), Ear()
    poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
    by_sensor = role_of({"filter": filter_name}).input == graph.SENSORS_INPUT
    for body in graph.bodies(people):
        ear.time(body, graph.joint_states_topic(body))
    topics = {name: graph.skeleton_topic(name) for name in streams}
    for topic in topics.values():
        ear.publisher(topic, PointCloud2)
    moments = sorted(
        ((k + 0.4 * number) / 30.0, sensor) for number, sensor in enumerate(topics) for k in range(round(30 * seconds))
    )
    events = ((at, topics[sensor], streams[sensor].at(at)) for at, sensor in moments)
    listeners = dict.fromkeys(topics.values(), 2 + by_sensor)
    given = {"sensors": tuple(poses), "filter": filter_name, "subject": ALL, "people": people}
    with live.graph_of(ear, listeners, poses=poses, level="ERROR", **given):
        common.progress(f"{people} people, {filter_name}: {seconds:.0f} s")
        ear.publish(events, {})
        time.sleep(2.0)
    return {"filter": filter_name, "people": people, "seconds": seconds, **figures_of(ear, seconds)}


def figures_of(ear: Ear, seconds: float) -> dict[str, Any]:
    """Figures of one run; delays are without the first fifth, in which the nodes start."""
    rows = [np.array(sorted(received.items())).reshape(-1, 2) for received in ear.received.values()]
    stamps, received = np.concatenate(rows).T
    delays, stamps = (received - stamps) / 1e6, (stamps - ear.start_ns) / NANOSECONDS
    parts = np.linspace(0.2 * seconds, seconds, 5)
    quarters = [delays[(stamps >= a) & (stamps < b)] for a, b in pairwise(parts)]
    dropped: dict[str, dict[str, int]] = {}
    for node in ear.statuses:
        values = ear.values(node)
        found = {key: int(value) for key, value in values.items() if key.startswith(("dropped ", "lost "))}
        if any(found.values()):
            dropped[node] = found
    return {
        "rate of each, Hz": {
            body: round(len(each) / seconds, 1) for body, each in sorted(ear.received.items()) if each
        },
        "angles in each quarter": [len(each) for each in quarters],
        "delay ms, median of each quarter": [round(float(np.median(each)), 1) for each in quarters if len(each)],
        "delay ms, 99 % of each quarter": [round(float(np.percentile(each, 99)), 1) for each in quarters if len(each)],
        "dropped and lost": dropped,
        "seconds in which diagnostics said that it is too slow": dict(+ear.warnings),
        "association": {key: value for key, value in ear.values("fusion").items() if key.startswith("association")},
    }


def main() -> int:
    """The benchmark; exit code 1 for an identity switch while all people were visible to a sensor."""
    parser = common.parser(__doc__, data=True, seeds=10)
    parser.add_argument("--only", choices=("crossings", "real", "live"), help="one of the three")
    parser.add_argument("--people", type=int, default=6, metavar="N", help="live (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=40.0, metavar="S", help="of each live run (default: 40)")
    parser.add_argument("--filters", type=common.names, default=["lkf_constant_velocity", "ekf"], metavar="A,B",
                        help="live (default: both)")  # fmt: skip
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
            common.progress(f"the real recording is absent ({args.data})")
    if args.only in (None, "live"):
        recording = crossing(0, 2, args.people, seconds=10.0)
        result["live"] = [run_live(name, recording, args.people, args.seconds) for name in args.filters]
    common.report(args, result)
    return int(any(row["switches while all were visible to a sensor"] for row in result.get("crossings", ())))


if __name__ == "__main__":
    sys.exit(main())
