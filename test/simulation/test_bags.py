"""The shipped recordings: repeatable, small, with the clocks, poses and errors that they say they have."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.messages import (
    cloud_to_skeletons,
    time_reference_to_clock,
    to_nanoseconds,
    transform_to_pose,
)
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.simulation.bags import MOTIONS, RECEIVED_FROM_NS, START_NS, add_parser, simulate, write_bag
from body_tracking.skeleton import NANOSECONDS, Joint, TrackingState

BAGS = Path(__file__).resolve().parents[2] / "bags"
NAMES = [motion.name for motion in MOTIONS]
TRUTH = "/ground_truth/skeleton"


def contents(folder: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(folder) as bag:
        return [(raw.topic, raw.log_time_ns, bytes(raw.cdr)) for raw in bag.messages()]


def read(folder: Path, topic: str) -> list[object]:
    with BagReader(folder) as bag:
        return [deserialize(bag.topics[topic].type_name, raw.cdr) for raw in bag.messages([topic])]


@pytest.mark.parametrize("name", NAMES)
def test_the_shipped_bags_are_whole_and_small(name: str) -> None:
    folder = BAGS / name
    with BagReader(folder) as bag:
        assert not bag.warnings
        assert set(bag.topics) == {
            "/kinect1/skeleton",
            "/kinect2/skeleton",
            TRUTH,
            "/ground_truth/joint_states",
            "/ground_truth/calibration",
            "/ground_truth/calibration/clock",
        }
        assert 12.0 < (bag.end_ns - bag.start_ns) / NANOSECONDS < 20.0
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2_000_000


def test_the_same_seed_gives_the_same_messages_and_another_seed_others(tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        write_bag(simulate(MOTIONS[0], seed), tmp_path / folder)
    a, b, c = (contents(tmp_path / folder) for folder in ("a", "b", "c"))
    assert a == b and a != c


def test_the_shipped_bags_are_what_the_command_makes(tmp_path: Path) -> None:
    """To a tenth of a millimetre: other versions of numpy and scipy round differently."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["make-bags", "-o", str(tmp_path), "--motion", NAMES[1]])
    run: Callable[[argparse.Namespace], int] = args.run
    assert run(args) == 0
    for topic in ("/kinect1/skeleton", "/kinect2/skeleton"):
        made, shipped = (read(folder / NAMES[1], topic) for folder in (tmp_path, BAGS))
        assert len(made) == len(shipped)
        for one, other in zip(made, shipped, strict=True):
            (here,), (there,) = cloud_to_skeletons(one), cloud_to_skeletons(other)
            assert here.stamp_ns == there.stamp_ns
            assert_allclose(here.positions, there.positions, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_poses_and_clocks_explain_what_the_sensors_say(name: str) -> None:
    """Bring each sensor's joints into the world and its stamps into the reference clock: they meet the truth there."""
    folder = BAGS / name
    poses = {pose.sensor: pose for pose in map(transform_to_pose, read(folder, "/ground_truth/calibration"))}
    clocks = [time_reference_to_clock(message) for message in read(folder, "/ground_truth/calibration/clock")]
    assert {sensor for sensor, _, _ in clocks} == {"kinect2"}
    truth = [cloud_to_skeletons(message)[0] for message in read(folder, TRUTH)]
    true_ns = np.array([skeleton.stamp_ns for skeleton in truth])
    true_positions = np.array([skeleton.positions for skeleton in truth])
    for sensor, pose in poses.items():
        errors = []
        for message in read(folder, f"/{sensor}/skeleton"):
            (skeleton,) = cloud_to_skeletons(message)
            reference_ns = skeleton.stamp_ns
            if sensor == "kinect2":
                nearest = min(clocks, key=lambda item: abs(item[2].to_reference(skeleton.stamp_ns) - item[1]))
                reference_ns = nearest[2].to_reference(skeleton.stamp_ns)
            k = int(np.clip(np.searchsorted(true_ns, reference_ns), 1, len(truth) - 1))
            share = (reference_ns - true_ns[k - 1]) / (true_ns[k] - true_ns[k - 1])
            expected = (1 - share) * true_positions[k - 1] + share * true_positions[k]
            tracked = skeleton.states == TrackingState.TRACKED
            errors.append(np.linalg.norm(pose.apply(skeleton.positions) - expected, axis=1)[tracked])
        error = np.concatenate(errors)
        assert 0.02 < np.median(error) < 0.05  # Kinect v2 against markers: 20 to 40 mm
        assert error.max() < 0.8


def test_the_second_clock_is_seconds_off_and_drifts() -> None:
    clocks = [time_reference_to_clock(m) for m in read(BAGS / NAMES[2], "/ground_truth/calibration/clock")]
    at_ns = np.array([valid_ns for _, valid_ns, _ in clocks], dtype=float)
    offsets = np.array([clock.offset_ns for _, _, clock in clocks], dtype=float)
    assert offsets[0] / NANOSECONDS == pytest.approx(-2.718, abs=0.01)
    assert np.polyfit(at_ns - at_ns[0], offsets, 1)[0] * 1e6 == pytest.approx(38.0, abs=0.5)


@pytest.mark.parametrize("name", NAMES)
def test_receipt_follows_capture_with_a_delay_that_varies(name: str) -> None:
    folder = BAGS / name
    with BagReader(folder) as bag:
        info = bag.topics["/kinect1/skeleton"].type_name
        delays = [
            raw.log_time_ns - RECEIVED_FROM_NS - (to_nanoseconds(deserialize(info, raw.cdr).header.stamp) - START_NS)
            for raw in bag.messages(["/kinect1/skeleton"])
        ]
    assert 0.02e9 < min(delays) < max(delays) < 0.2e9
    assert np.std(delays) > 0.002e9


def test_a_twist_hides_the_far_arm_and_frames_get_lost() -> None:
    recording = simulate(MOTIONS[2])
    for sensor in ("kinect1", "kinect2"):
        states = np.array([frame.skeletons[0].states for frame in recording.frames if frame.sensor == sensor])
        arms = states[:, [Joint.WRIST_LEFT, Joint.WRIST_RIGHT, Joint.HAND_LEFT, Joint.HAND_RIGHT]]
        assert 0.05 < (arms != TrackingState.TRACKED).mean() < 0.3
        assert (states[:, Joint.SPINE_MID] == TrackingState.TRACKED).all()
        stamps = np.array([f.skeletons[0].stamp_ns for f in recording.frames if f.sensor == sensor])
        assert (np.diff(stamps) > 0).all() and np.diff(stamps).max() > 0.15 * NANOSECONDS
        assert len(stamps) < 0.995 * MOTIONS[2].duration * 30


def test_the_truth_has_angles_by_name() -> None:
    message = read(BAGS / NAMES[0], "/ground_truth/joint_states")[60]
    assert message.name == [f"{name}_body1" for name in ANGLE_NAMES]  # type: ignore[attr-defined]
    elevation = message.name.index("shoulder_elevation_left_body1")  # type: ignore[attr-defined]
    assert np.degrees(message.position[elevation]) == pytest.approx(88.0, abs=0.5)  # type: ignore[attr-defined]
