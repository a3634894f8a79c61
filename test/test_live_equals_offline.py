"""The live graph publishes the messages that ``replay`` writes: every topic, for every filter and shipped recording.

The comparison knows no nodes: all common topics are compared, whatever publishes them.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
import signal
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from body_tracking import cli
from body_tracking.calibration.storage import save
from body_tracking.core.message_types import TRANSFORM
from body_tracking.core.parameters import SECTION
from body_tracking.core.sensor_poses import CalibrationResult, SensorQuality
from body_tracking.core.times import NANOSECONDS
from body_tracking.filters import FILTERS
from body_tracking.mesh.topics import mesh_topic
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.calibration import transform_to_pose
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.diagnostics import statuses
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import ALL as EVERYBODY
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, deserialize, first_field
from draws import ALL
from excerpts import beginning
from pose_networks import MISSING

pytest.importorskip("rclpy", reason="ROS is not installed")

from test_up import Up

ROOT = Path(__file__).resolve().parent.parent
BAGS = ROOT / "bags"
MARKERS, SETUP = "markers_arm", ROOT / "config" / "marker_setup"
"""The recording of image pairs, and the setup that tracks its markers."""
MESH = "mesh_reaching"
"""The recording of depth images."""
CAMERA = "camera_reaching"
"""The recording of colour and depth images."""
CAMERAS = "cameras_turning"
"""The recording of two colour cameras."""
SMOOTHED = "wave with a lag"
SAME = 1e-4
"""Largest difference of live and offline, in metres, radians and other units: far less than any accuracy. They are
equal to the last bit with the same number of BLAS threads; with another number sums round differently (4e-5)."""
PATIENT = {"activation_delay": 2.0, "max_wait": 1.0, "order_wait": 1.0, "predict_after": 1000.0}
"""Waiting times for a busy machine, on which messages get lost and are resent: a node that lags by less gives the
offline results."""
OF_NODES = {
    "calibration": ("activation_delay",),
    "fusion": ("max_wait",),
    "skeleton_filter": ("order_wait", "predict_after"),
}
"""The nodes to which these parameters belong."""
LATE = re.compile(r"late( ticks| frames)?|missed|lost .+|late_frames")
"""Counters of a node that say that a message came too late for its results to be those of an offline run."""
LATEST_S = 10.0
"""Longest time from capture to the log on a busy machine; the sensors' own clocks are minutes and years away."""
TICK_S = 0.05
"""Period of ``/clock``: the recorder may have received one tick less than the publisher of a stamp."""
HOLD_FROM_S = PATIENT["activation_delay"] + TICK_S
"""Calibration is stamped with the time from which on it holds."""
OTHERS = {graph.DIAGNOSTICS_TOPIC, graph.CLOCK_TOPIC, mesh_topic("kinect1")}
"""Topics that are not compared: a node's own figures, the clock of a bag, and a topic that needs a subscriber."""


def parameters(folder: Path, **more: object) -> Path:
    """A parameters file for all nodes."""
    file = folder / "parameters.yaml"
    file.write_text(yaml.safe_dump({"/**": {SECTION: {**PATIENT, **more}}}))
    return file


def numbers(message: Any) -> Iterator[float]:
    """All numbers in a message, and texts as the numbers of their bytes."""
    if hasattr(message, "nanosec"):  # seconds
        yield message.sec + message.nanosec / NANOSECONDS
    elif dataclasses.is_dataclass(message):
        for each in dataclasses.fields(message):
            if each.name != "__msgtype__":
                yield from numbers(getattr(message, each.name))
    elif isinstance(message, str):
        yield from message.encode()
    elif isinstance(message, (list, tuple)) or (isinstance(message, np.ndarray) and message.dtype != np.uint8):
        for each in message:
            yield from numbers(each)
    elif isinstance(message, np.ndarray):  # points and matrices are single precision numbers
        yield from np.frombuffer(message.tobytes()[: message.nbytes // 4 * 4], np.float32).astype(float).tolist()
    else:
        yield float(message)


def published(bag: Path, without: set[str]) -> dict[str, dict[int, list[list[float]]]]:
    """All messages of each topic, by their stamps."""
    found: dict[str, dict[int, list[list[float]]]] = {}
    with RigReader(bag) as reader:
        topics = {name: info.type_name for name, info in reader.topics.items() if name not in without}
        for raw in reader.messages(topics):
            message = deserialize(topics[raw.topic], raw.cdr)
            stamp_ns = to_nanoseconds(message.header.stamp) if hasattr(message, "header") else 0
            found.setdefault(raw.topic, {}).setdefault(stamp_ns, []).append(list(numbers(message)))
    return found


def differences(live: Path, offline: Path, without: set[str], share: float = 0.0, within: float = SAME) -> list[str]:
    """Topics of two recordings of which more than this share of the messages differ, a line each."""
    one, other = published(live, without), published(offline, without)
    assert one.keys() & other.keys(), (one.keys(), other.keys())
    found = [f"{topic}: not live" for topic in other.keys() - one.keys()]
    for topic in one.keys() & other.keys():
        mine, theirs = one[topic], other[topic]
        apart = [
            stamp
            for stamp in sorted(mine.keys() | theirs.keys())
            if len(mine.get(stamp, ())) != len(theirs.get(stamp, ()))
            or not all(
                len(a) == len(b) and np.allclose(a, b, rtol=0.0, atol=within, equal_nan=True)
                for a, b in zip(mine[stamp], theirs[stamp], strict=True)
            )
        ]
        if len(apart) > share * len(theirs):
            first = (apart[0] - min(theirs)) / NANOSECONDS
            found.append(f"{topic}: {len(apart)} of {len(theirs)} stamps, the first after {first:.3f} s")
    return found


def late_messages(bag: Path) -> list[str]:
    """The counters of late and lost messages in a recording's diagnostics."""
    found: dict[str, str] = {}
    with RigReader(bag) as reader:
        kind = reader.topics[graph.DIAGNOSTICS_TOPIC].type_name
        for raw in reader.messages([graph.DIAGNOSTICS_TOPIC]):
            for status in statuses(deserialize(kind, raw.cdr)):
                found |= {
                    f"{status.node}: {name}": value for name, value in status.values.items() if LATE.fullmatch(name)
                }
    return [f"{name} {value}" for name, value in found.items() if value != "0"]


def recorded(folder: Path, name: str, *arguments: str | Path) -> Path:
    """A recording of the live graph."""
    live = folder / name
    graph_up = Up(folder, *arguments, "--record", live, "--reliable")
    try:
        assert graph_up.until(lambda: graph_up.process.poll() is not None, timeout=150.0), graph_up.text()
        assert graph_up.process.returncode == 0, graph_up.text()
        assert "XMLPARSER" not in graph_up.text()  # Fast DDS takes a file of profiles as a whole or not at all
    finally:
        graph_up.close()
    return live


def live_as_offline(
    folder: Path, bag: Path, arguments: Sequence[str | Path], without: set[str], calibration: Path | None = None
) -> Path:
    """The live graph's recording of a bag, which is that in ``offline`` but for some topics.

    If a graph reports that messages came too late, the bag is played once more, and slower; a difference without such
    a report is an error.
    """
    said: list[object] = []
    saved: tuple[str | Path, ...] = () if calibration is None else ("--calibration", calibration)
    for rate in ("1", "0.5", "0.25"):
        live = recorded(folder, f"live_{rate}", "--bag", bag, "--rate", rate, *arguments, *saved)
        found = differences(live, folder / "offline", without)
        if not found:
            return live
        said.append((rate, found, late_messages(live)))
        assert late_messages(live), said
    raise AssertionError(said)


def inputs(bag: Path) -> set[str]:
    with RigReader(bag) as reader:
        return set(reader.topics)


CASES = [
    ("wave", "ekf"),
    *((SMOOTHED, each) for each in ("ekf", "lkf_constant_velocity")),
    (MARKERS, ""),
    (MESH, ""),
    *((name, "") for name in (CAMERA, CAMERAS) if not MISSING),
    *(
        (bag.name, each)
        for bag in sorted(BAGS.iterdir())
        if bag.name not in (MARKERS, CAMERA, CAMERAS)
        for each in FILTERS
    ),
]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, wave: Path) -> Callable[[str, str], Path]:
    """A function: the live graph's recording of a bag with a filter, which equals that of ``replay``."""

    @cache
    def play(name: str, filter_name: str) -> Path:
        folder = tmp_path_factory.mktemp(f"{name}_{filter_name}")
        bag = wave if name in ("wave", SMOOTHED) else BAGS / name
        if name == MARKERS:
            bag, file = beginning(bag, folder / "excerpt", 1.5), folder / "parameters.yaml"
            file.write_text(yaml.safe_dump({"/**": {SECTION: {"max_wait": 1.0, "deadline": 1.0}}}))
            arguments: tuple[str | Path, ...] = ("--marker-setup", SETUP, "--params-file", file)
        elif name == MESH and not filter_name:
            bag = beginning(bag, folder / "excerpt", 1.5)
            arguments = ("--depth", "kinect1", "--params-file", parameters(folder))
        elif name == CAMERA:
            bag = beginning(bag, folder / "excerpt", 2.0)
            arguments = ("--camera", "camera1", "--compressed", "colour", "--params-file", parameters(folder))
        elif name == CAMERAS:
            bag = beginning(bag, folder / "excerpt", 2.0)
            arguments = ("--camera-rig", ROOT / "config" / "camera_rig", "--compressed", "colour")
            arguments += ("--params-file", parameters(folder))
        else:
            arguments = ("--filter", filter_name, "--params-file", parameters(folder))
            arguments += ("--lag", "0.15") if name == SMOOTHED else ()
        assert cli.main(["replay", str(bag), "-o", str(folder / "offline"), *map(str, arguments)]) == 0
        return live_as_offline(folder, bag, arguments, inputs(bag) | OTHERS)

    return play


@pytest.mark.parametrize(("name", "filter_name"), CASES if ALL else CASES[:1])
def test_a_recording_gives_the_same_live_and_offline(
    played: Callable[[str, str], Path], name: str, filter_name: str
) -> None:
    played(name, filter_name)


def test_every_stamp_of_a_live_graph_is_in_the_time_of_its_clock(played: Callable[[str, str], Path]) -> None:
    """All stamps can be compared with ``/clock``, though the sensors have clocks of their own."""
    found: dict[str, list[float]] = {}
    poses: list[int] = []
    shown: list[int] = []
    with BagReader(played(*CASES[0])) as reader:
        for raw in reader.messages():  # logged by /clock
            if first_field(reader.topics[raw.topic].type_name)[1] != "std_msgs/msg/Header":
                continue
            seconds, rest = struct.unpack_from("<iI", raw.cdr, 4)
            stamp_ns = seconds * NANOSECONDS + rest
            if stamp_ns:  # calibration before anything is known holds always
                found.setdefault(raw.topic, []).append((raw.log_time_ns - stamp_ns) / NANOSECONDS)
            if raw.topic == graph.CALIBRATION:
                poses.append(transform_to_pose(deserialize(TRANSFORM, raw.cdr)).valid_from_ns)
            elif raw.topic == graph.joint_states_topic("body1"):
                shown.append(stamp_ns)
    wanted = {graph.skeleton_topic("kinect1"), graph.FUSED, graph.FILTERED, graph.joint_states_topic("body1")}
    assert wanted <= found.keys()
    for topic, ages in found.items():
        holds = topic in (graph.CALIBRATION, graph.CALIBRATION_CLOCK)
        early = HOLD_FROM_S if holds else TICK_S
        assert -early <= min(ages) and max(ages) < LATEST_S, (topic, min(ages), max(ages))
    # as for a buffer of tf2: at the time of these angles a pose is in force, by its own stamp
    later = [stamp for stamp in shown if any(0 < pose <= stamp for pose in poses)]
    assert len(later) > 30


def two_people(folder: Path) -> tuple[Path, Path]:
    """A simulated recording of two who walk past each other, and the calibration of its sensors."""
    from body_tracking.simulation.bags import write_bag  # not by every worker: they take a second
    from body_tracking.simulation.layouts import around
    from body_tracking.simulation.scene import Setup, lanes, simulate

    recording = simulate(
        Setup(
            "walking_and_turning",
            around(np.radians([25.0, -35.0]).tolist(), distances=2.7),
            number=2,
            seconds=6.0,
            standard=True,
            places=lanes(2),
        )
    )
    write_bag(recording, folder / "people")
    poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
    clocks = {sensor.pose.sensor: replace(sensor.clock, stddev=0.002) for sensor in recording.sensors}
    quality = {name: SensorQuality(0.03, 0.005, 0.01, 500) for name in poses}
    save(CalibrationResult("kinect1", poses, clocks, quality), folder / "true.yaml")
    return folder / "people", folder / "true.yaml"


@pytest.mark.slow
def test_two_people_are_the_same_live_and_offline(tmp_path: Path) -> None:
    bag, calibration = two_people(tmp_path)
    settings = ReplaySettings(
        ("kinect1", "kinect2"),
        parameters={node: {name: PATIENT[name] for name in names} for node, names in OF_NODES.items()},
        calibration_file=calibration,
        more={"subject": EVERYBODY, "people": 3},
    )
    replay(bag, tmp_path / "offline", settings)
    arguments = ("--subject", "all", "--people", "3", "--params-file", parameters(tmp_path))
    # a loaded calibration is published when a node starts: live before the first frame, offline with it
    without = inputs(bag) | OTHERS | {graph.CALIBRATION, graph.CALIBRATION_CLOCK}
    with BagReader(live_as_offline(tmp_path, bag, arguments, without, calibration)) as reader:
        angles = [reader.topics[graph.joint_states_topic(body)].count for body in ("body1", "body2", "body3")]
        numbers = [
            tuple(each.body for each in decode_skeletons(raw.cdr) or ()) for raw in reader.messages([graph.FILTERED])
        ]
    assert min(angles[:2]) > 100 and angles[2] == 0
    assert numbers.count((1, 2)) > 100 and set(numbers) <= {(1, 2), (1,), (2,)}


def played_to_the_end(folder: Path, number: int, *arguments: str | Path) -> Path:
    """A recording of a live graph whose sensors are files, which ends when these do."""
    live = folder / f"live_{number}"
    graph_up = Up(folder, *arguments, "--record", live, "--reliable")
    try:
        assert graph_up.until(lambda: len(graph_up.received) > 100, timeout=60.0), graph_up.text()
        count = 0
        while len(graph_up.received) > count:
            count = len(graph_up.received)
            graph_up.until(lambda: False, timeout=1.0)
        graph_up.process.send_signal(signal.SIGINT)
        assert graph_up.until(lambda: graph_up.process.poll() is not None, timeout=60.0), graph_up.text()
    finally:
        graph_up.close()
    return live


def frames(bag: Path) -> dict[str, int]:
    with RigReader(bag) as reader:
        return {name: reader.topics[name].count for name in map(graph.skeleton_topic, graph.DEFAULT_SENSORS)}


@pytest.mark.slow
@pytest.mark.alone
def test_files_in_place_of_sensors_give_what_a_replay_of_their_recording_gives(tmp_path: Path, wave: Path) -> None:
    """In real time, without a bag's clock."""
    calibration = tmp_path / "calibration.yaml"
    assert cli.main(["calibrate", str(wave), "-o", str(calibration)]) == 0
    said: list[object] = []
    for number in range(4):
        file = parameters(tmp_path, file=str(wave))
        shutil.copy(calibration, tmp_path / "live.yaml")  # the graph writes its estimate into it
        arguments = ("--sensors", ",".join(graph.DEFAULT_SENSORS), "--params-file", file)
        live = played_to_the_end(tmp_path, number, *arguments, "--calibration", tmp_path / "live.yaml")
        if frames(live) != frames(wave):  # files do not wait for a recorder that is late
            said.append((frames(live), frames(wave)))
            continue
        offline = tmp_path / f"offline_{number}"
        words = ("--calibration", calibration, "--params-file", parameters(tmp_path))
        assert cli.main(["replay", str(live), "-o", str(offline), *map(str, words)]) == 0
        # what was loaded is published when a node starts: live before the first frame, offline with it, so that two or
        # three frames at the beginning differ, and the stamp of what was loaded
        apart = differences(live, offline, OTHERS, share=0.02)
        found = [each for each in apart if not each.startswith(graph.CALIBRATION_CLOCK)]
        if not found:
            return
        said.append(found)
    raise AssertionError(said)
