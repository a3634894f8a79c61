"""A recording by the sensors' own clocks is read in ROS time."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from body_tracking.core.message_types import TIME_REFERENCE
from body_tracking.core.qos import SENSOR_DATA
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray
from body_tracking.messages.calibration import time_reference_to_clock
from body_tracking.pipeline import graph
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagReader, BagWriter, deserialize, serialize
from body_tracking.recording.stamps import RecordedClock

ROOT = Path(__file__).resolve().parents[2]
EPOCH_NS = 1_750_000_000 * NANOSECONDS
LEAST_S = 0.02
KINECT = graph.skeleton_topic("kinect1")
HELD = {graph.CALIBRATION, graph.CALIBRATION_CLOCK, "/tf_static"}
"""Topics whose stamps are the times from which the messages hold."""


def nanoseconds(seconds: FloatArray) -> IntArray:
    return np.rint(np.asarray(seconds) * NANOSECONDS).astype(np.int64)


def captured(n: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """(n,) seconds of capture and of receipt, at 30 Hz, with the delays of a busy network."""
    times = np.arange(n) / 30.0
    return times, times + LEAST_S + np.random.default_rng(seed).exponential(0.003, n)


def to_ros(stamps: FloatArray, received: FloatArray) -> FloatArray:
    """Seconds since the epoch of the log."""
    stamps_ns, log_ns = nanoseconds(stamps), EPOCH_NS + nanoseconds(received)
    clock = RecordedClock(stamps_ns, log_ns)
    found = [clock.to_ros(*pair) - EPOCH_NS for pair in zip(stamps_ns.tolist(), log_ns.tolist(), strict=True)]
    return np.array(found) / NANOSECONDS


@pytest.mark.parametrize("drift", [-1e-4, 0.0, 5e-5, 5e-4])
@pytest.mark.parametrize("n", [2, 60, 9000])
def test_offset_and_drift_are_found_to_within_the_least_delay(drift: float, n: int) -> None:
    times, received = captured(n)
    found = to_ros(40.0 + times * (1.0 + drift), received)
    assert (np.diff(found) > 0.0).all()
    assert (found <= received + 1e-9).all()
    if n > 100:
        np.testing.assert_allclose(found, times + LEAST_S, atol=5e-4)


def test_messages_that_were_held_up_keep_their_time() -> None:
    times, received = captured(900)
    held = (times > 10.0) & (times < 14.0)
    received[held] = 14.02
    np.testing.assert_allclose(to_ros(40.0 + times, received), times + LEAST_S, atol=5e-4)


@pytest.mark.parametrize("step", [-35.0, -2.0, 2.0, 1e6])
def test_time_goes_on_where_the_clock_was_set(step: float) -> None:
    times, received = captured(1800)
    found = to_ros(40.0 + times + np.where(times > 30.0, step, 0.0), received)
    np.testing.assert_allclose(found, times + LEAST_S, atol=1e-3)


def test_ros_time_stays_as_it_is_however_wrong_within_a_minute() -> None:
    times, received = captured(60)
    stamps = EPOCH_NS / NANOSECONDS + times - 30.0
    clock = RecordedClock(nanoseconds(stamps), EPOCH_NS + nanoseconds(received))
    assert clock.is_ros_time
    assert clock.to_ros(1234567890123456789, EPOCH_NS) == 1234567890123456789


def test_log_times_that_were_not_recorded_live_are_ignored() -> None:
    times, _ = captured(100)
    clock = RecordedClock(nanoseconds(1000.0 + times), np.arange(100))
    assert clock.is_ros_time


# --- of whole bags


def stamp_of(cdr: bytes) -> int:
    seconds, rest = struct.unpack_from("<iI", cdr, 4)
    return int(seconds * NANOSECONDS + rest)


def write(path: Path, topics: dict[str, tuple[str, Sequence[float], Sequence[float]]]) -> Path:
    """A bag with messages of a type by topic, by stamps and times of receipt since the epoch of the log, seconds."""
    with BagWriter(path) as writer:
        for topic, (kind, stamps, received) in topics.items():
            writer.add_topic(topic, kind, SENSOR_DATA)
            for stamp_ns, log_ns in zip(nanoseconds(stamps).tolist(), nanoseconds(received).tolist(), strict=True):
                time = BAG_MESSAGES.make(
                    "builtin_interfaces/msg/Time", **dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True))
                )
                header = BAG_MESSAGES.make("std_msgs/msg/Header", stamp=time, frame_id="f")
                vector = BAG_MESSAGES.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
                content = {
                    "sensor_msgs/msg/MagneticField": {
                        "magnetic_field": vector,
                        "magnetic_field_covariance": np.zeros(9),
                    },
                    "geometry_msgs/msg/Vector3Stamped": {"vector": vector},
                }[kind]
                writer.write(topic, serialize(BAG_MESSAGES.make(kind, header=header, **content)), EPOCH_NS + log_ns)
    return path


def ages(path: Path) -> dict[str, FloatArray]:
    """Log time minus stamp, seconds, by topic."""
    found: dict[str, list[float]] = {}
    with RigReader(path) as bag:
        for raw in bag.messages():
            found.setdefault(raw.topic, []).append((raw.log_time_ns - stamp_of(raw.cdr)) / NANOSECONDS)
    return {topic: np.array(each) for topic, each in found.items()}


def test_topics_of_one_clock_keep_their_distance_and_results_go_by_the_nearest_sensor(tmp_path: Path) -> None:
    times, received = captured(300)
    kind, field = "geometry_msgs/msg/Vector3Stamped", "sensor_msgs/msg/MagneticField"
    bag = write(
        tmp_path / "bag",
        {
            "/arm/imu/data": (kind, 40.0 + times, received),
            "/arm/imu/mag": (field, 40.0 + times, received + 0.03),
            "/leg/imu/data": (kind, 900.0 + times, received + 0.2),
            "/fused/skeleton": (kind, 40.0 + times, received + 0.1),
            "/filtered/skeleton": (kind, 900.0 + times, received + 0.25),
            "/ros/time": (kind, EPOCH_NS / NANOSECONDS + times, received),
            "/unstamped": (kind, 0.0 * times, received),
        },
    )
    found = {topic: float(each.min()) for topic, each in ages(bag).items()}
    for topic, least in {
        "/arm/imu/data": 0.0,
        "/arm/imu/mag": 0.03,
        "/leg/imu/data": 0.0,
        "/fused/skeleton": 0.1,
        "/filtered/skeleton": 0.05,
        "/ros/time": LEAST_S,
    }.items():
        assert found[topic] == pytest.approx(least, abs=1e-3), topic
    assert found["/unstamped"] >= EPOCH_NS / NANOSECONDS


def test_a_recording_in_ros_time_is_left_alone_byte_by_byte(tmp_path: Path) -> None:
    times, received = captured(30)
    kind = "geometry_msgs/msg/Vector3Stamped"
    bag = write(tmp_path / "bag", {"/arm/imu/data": (kind, EPOCH_NS / NANOSECONDS + times, received)})
    with RigReader(bag) as rig, BagReader(bag) as reader:
        assert list(rig.messages()) == list(reader.messages())


@pytest.mark.parametrize("name", ["tpose_wave", "tpose_torso_twist", "tpose_slow_down"])
def test_the_truth_keeps_its_distance_to_the_sensors_of_a_shipped_bag(name: str) -> None:
    with RigReader(ROOT / "bags" / name) as rig, BagReader(ROOT / "bags" / name) as reader:
        theirs = {
            topic: [stamp_of(raw.cdr) for raw in rig.messages([topic])] for topic in (KINECT, graph.TRUE_SKELETON)
        }
        own = {topic: [stamp_of(raw.cdr) for raw in reader.messages([topic])] for topic in theirs}
        shift = {topic: np.array(theirs[topic]) - np.array(own[topic]) for topic in theirs}
        assert np.ptp(np.concatenate(list(shift.values()))) < 100_000  # nanoseconds, by drift
        for raw in rig.messages([graph.TRUE_CLOCK]):
            _, _, clock = time_reference_to_clock(deserialize(TIME_REFERENCE, raw.cdr))
            assert abs(clock.offset) < 1e-3  # the difference of the two least delays, instead of a second


def test_every_stamp_of_a_replay_is_in_ros_time(replayed_wave: Path) -> None:
    found = {topic: each for topic, each in ages(replayed_wave).items() if each.max() < 1e6}
    assert {KINECT, graph.FUSED, graph.FILTERED, graph.joint_states_topic("body1")} <= found.keys()
    for topic, each in found.items():
        # the truth is logged without any delay, the quickest frame with its own of 22 ms
        early = 0.025 if topic.startswith("/ground_truth") else 1.0 if topic in HELD else 0.0
        assert -early <= each.min() and each.max() < 1.0, topic
