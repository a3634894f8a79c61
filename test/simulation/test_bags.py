"""Simulated recordings are repeatable, with the documented topics, poses, clocks and body numbers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from body_tracking.cli import main
from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import left_right_axes
from body_tracking.core.message_types import IMU, JOINT_STATE, MAGNETIC_FIELD, POINT_CLOUD, TIME_REFERENCE, TRANSFORM
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, TrackingState
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.kinect.simulated import KinectErrors, errors_as_yaml, parameters, read_errors
from body_tracking.kinect.simulated_sensor import RATE
from body_tracking.kinematics.positional import ANGLE_NAMES, positional_angles
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.messages.model import joint_state_to_model
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.simulation.bags import SHIPPED, shipped, write_bag
from body_tracking.simulation.layouts import DISTANCE
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.repertoire import TPOSE_S
from body_tracking.simulation.scene import RECEIVED_FROM_NS, Setup, SimulatedRecording, simulate
from draws import some

BAGS = Path(__file__).resolve().parents[2] / "bags"
SENSORS = ("kinect1", "kinect2")
TRUTHS = {
    graph.TRUE_SKELETON: POINT_CLOUD,
    graph.TRUE_MODEL_STATE: JOINT_STATE,
    graph.TRUE_ANGLES: JOINT_STATE,
    graph.TRUE_CALIBRATION: TRANSFORM,
    graph.TRUE_CLOCK: TIME_REFERENCE,
}
CLOUDS = {graph.skeleton_topic(sensor): POINT_CLOUD for sensor in SENSORS}
BRIEF = Setup("standing_still", seconds=3.0)


def contents(folder: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(folder) as bag:
        return [(raw.topic, raw.log_time_ns, bytes(raw.cdr)) for raw in bag.messages()]


def types(folder: Path) -> dict[str, str]:
    with BagReader(folder) as bag:
        assert not bag.warnings
        return {topic: info.type_name for topic, info in bag.topics.items()}


def read(folder: Path, topic: str) -> list[Any]:
    with BagReader(folder) as bag:
        return [deserialize(bag.topics[topic].type_name, raw.cdr) for raw in bag.messages([topic])]


def stamps(messages: list[Any]) -> list[int]:
    return [to_nanoseconds(message.header.stamp) for message in messages]


# --- content of a bag


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatedRecording, Path]:
    """Three people; the first wears an inertial sensor with orientation, and two without."""
    imus = (
        SimulatedImu("forearm", "forearm_left", usual_mounting("forearm_left"), 100.0, oriented=True),
        SimulatedImu("chest", "upper_trunk", usual_mounting("upper_trunk"), 50.0),
        SimulatedImu("back", "pelvis", usual_mounting("pelvis"), 50.0, magnetometer=False, clock=ClockModel(10**9)),
    )
    recording = simulate(replace(BRIEF, number=3, imus=imus))
    folder = tmp_path_factory.mktemp("simulated") / "crowd"
    write_bag(recording, folder)
    return recording, folder


def test_topics_and_types_are_as_documented(crowd: tuple[SimulatedRecording, Path]) -> None:
    assert types(crowd[1]) == TRUTHS | CLOUDS | {
        "/forearm/imu/data": IMU,
        "/forearm/imu/mag": MAGNETIC_FIELD,
        "/chest/imu/data_raw": IMU,
        "/chest/imu/mag": MAGNETIC_FIELD,
        "/back/imu/data_raw": IMU,
    }


def test_everybody_is_in_one_cloud(crowd: tuple[SimulatedRecording, Path]) -> None:
    recording, folder = crowd
    truth = [cloud_to_skeletons(message) for message in read(folder, graph.TRUE_SKELETON)]
    assert len(truth) == len(recording.truths[0].stamps_ns)
    for k, skeletons in enumerate(truth):
        assert [each.body for each in skeletons] == [0, 1, 2]
        for each, true in zip(skeletons, recording.truths, strict=True):
            assert each.stamp_ns == true.stamps_ns[k] and each.frame_id == "world"
            assert_allclose(each.positions, true.positions[k], rtol=1e-7, atol=1e-9)
            assert (each.states == TrackingState.TRACKED).all() and each.velocities is None
    for sensor in SENSORS:
        published = [cloud_to_skeletons(message) for message in read(folder, graph.skeleton_topic(sensor))]
        meant = [frame.skeletons for frame in recording.frames if frame.sensor == sensor]
        for skeletons, others in zip(published, meant, strict=True):
            assert {each.body for each in skeletons} <= {0, 1, 2}
            for each, other in zip(skeletons, others, strict=True):
                assert (each.stamp_ns, each.body, each.frame_id) == (other.stamp_ns, other.body, other.frame_id)
                assert_array_equal(each.states, other.states)
                assert_allclose(each.positions, other.positions, rtol=1e-7, atol=1e-9)


def test_the_true_model_state_is_the_configuration_of_the_first(crowd: tuple[SimulatedRecording, Path]) -> None:
    recording, folder = crowd
    truth = recording.truths[0]
    published = [joint_state_to_model(message, MODEL) for message in read(folder, graph.TRUE_MODEL_STATE)]
    assert [stamp_ns for stamp_ns, _, _, _ in published] == truth.stamps_ns.tolist()
    assert {frame_id for _, frame_id, _, _ in published} == {"world"}
    q, rates = (np.stack([each[column] for each in published]) for column in (2, 3))
    assert_allclose(MODEL.difference(q, truth.q), 0.0, atol=1e-9)
    assert_allclose(rates, truth.rates, atol=1e-12)
    assert_allclose(MODEL.forward(q, truth.person.lengths).positions, truth.positions[:, MODEL.joints], atol=1e-9)


def test_the_true_angles_are_those_of_the_true_joints(crowd: tuple[SimulatedRecording, Path]) -> None:
    recording, folder = crowd
    for k, message in enumerate(read(folder, graph.TRUE_ANGLES)):
        assert message.name == [f"{name}_{graph.DEFAULT_BODY}" for name in ANGLE_NAMES]
        angles = positional_angles(recording.truths[0].skeleton(k))
        assert_allclose(message.position, angles.position, rtol=0, atol=1e-12)
        assert_allclose(message.velocity, angles.velocity, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("number", "topic"), [(0, "data"), (1, "data_raw"), (2, "data_raw")])
def test_inertial_messages_hold_the_samples(crowd: tuple[SimulatedRecording, Path], number: int, topic: str) -> None:
    recording, folder = crowd
    imu, samples = recording.imus[number]
    messages = read(folder, f"/{imu.name}/imu/{topic}")
    assert stamps(messages) == samples.stamps_ns.tolist()
    assert {message.header.frame_id for message in messages} == {f"{imu.name}_link"}
    for k, message in enumerate(messages):
        for published, meant in (
            (message.angular_velocity, samples.angular_velocity[k]),
            (message.linear_acceleration, samples.linear_acceleration[k]),
        ):
            assert_array_equal([published.x, published.y, published.z], meant)
        assert_array_equal(message.angular_velocity_covariance, samples.angular_velocity_covariance.ravel())
        assert_array_equal(message.linear_acceleration_covariance, samples.linear_acceleration_covariance.ravel())
        if imu.oriented:
            assert samples.orientation is not None
            quat = message.orientation
            assert_array_equal([quat.x, quat.y, quat.z, quat.w], samples.orientation[k])
            assert_array_equal(message.orientation_covariance, samples.orientation_covariance[k].ravel())
            assert np.linalg.eigvalsh(message.orientation_covariance.reshape(3, 3)).min() > 0.0
        else:
            assert message.orientation_covariance[0] == -1.0  # REP-145: no orientation
    # on a standing person the sensor measures little but gravity
    force = np.linalg.norm(samples.linear_acceleration, axis=1)
    assert force.mean() == pytest.approx(9.81, abs=0.5)


def test_magnetometers_publish_the_field(crowd: tuple[SimulatedRecording, Path]) -> None:
    recording, folder = crowd
    for imu, samples in recording.imus:
        if samples.magnetic_field is None:
            continue
        messages = read(folder, f"/{imu.name}/imu/mag")
        assert stamps(messages) == samples.stamps_ns.tolist()
        published = [
            [message.magnetic_field.x, message.magnetic_field.y, message.magnetic_field.z] for message in messages
        ]
        assert_array_equal(published, samples.magnetic_field)
        assert 15e-6 < np.linalg.norm(published, axis=1).mean() < 100e-6  # tesla: of the earth
        for message in messages:
            assert_array_equal(message.magnetic_field_covariance, samples.magnetic_field_covariance.ravel())


def test_messages_are_logged_in_the_order_and_at_the_time_of_their_receipt(
    crowd: tuple[SimulatedRecording, Path],
) -> None:
    recording, folder = crowd
    logged: dict[str, list[int]] = {}
    for topic, log_ns, _ in contents(folder):
        logged.setdefault(topic, []).append(log_ns)
    assert all(earlier <= later for times in logged.values() for earlier, later in pairwise(times))
    for sensor in SENSORS:
        received = [frame.received_ns for frame in recording.frames if frame.sensor == sensor]
        assert logged[graph.skeleton_topic(sensor)] == received
    for imu, samples in recording.imus:
        topic = f"/{imu.name}/imu/{'data' if imu.oriented else 'data_raw'}"
        assert logged[topic] == samples.received_ns.tolist()


# --- the shipped ones


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_bags_are_whole_and_small(name: str) -> None:
    folder = BAGS / name
    assert types(folder) == TRUTHS | CLOUDS
    with BagReader(folder) as bag:
        assert 12.0 < (bag.end_ns - bag.start_ns) / NANOSECONDS < 25.0
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2_000_000


def test_the_command_reproduces_the_shipped_bags(tmp_path: Path) -> None:
    """To a tenth of a millimetre: other versions of numpy and scipy round differently."""
    name = "tpose_slow_down"
    assert main(["make-bags", "-o", str(tmp_path), "--motion", name]) == 0
    for topic in CLOUDS:
        ours, theirs = (read(folder / name, topic) for folder in (tmp_path, BAGS))
        assert len(ours) == len(theirs)
        for one, other in zip(ours, theirs, strict=True):
            (here,), (there,) = cloud_to_skeletons(one), cloud_to_skeletons(other)
            assert here.stamp_ns == there.stamp_ns
            assert_allclose(here.positions, there.positions, atol=1e-4)


def poses_and_clocks(folder: Path) -> tuple[dict[str, SensorPose], list[tuple[str, int, ClockModel]]]:
    poses = {pose.sensor: pose for pose in map(transform_to_pose, read(folder, graph.TRUE_CALIBRATION))}
    return poses, [time_reference_to_clock(message) for message in read(folder, graph.TRUE_CLOCK)]


def errors_of(folder: Path, sensor: str) -> FloatArray:
    """Metres by which a sensor's tracked joints are wrong, in ``world`` and in the reference clock.

    Of the frames in which it has not exchanged left and right.
    """
    poses, clocks = poses_and_clocks(folder)
    truth = [cloud_to_skeletons(message)[0] for message in read(folder, graph.TRUE_SKELETON)]
    true_ns = np.array([skeleton.stamp_ns for skeleton in truth])
    true_positions = np.array([skeleton.positions for skeleton in truth])
    errors = []
    for message in read(folder, graph.skeleton_topic(sensor)):
        (skeleton,) = cloud_to_skeletons(message)
        reference_ns = skeleton.stamp_ns
        if sensor == "kinect2":
            nearest = min(clocks, key=lambda item: abs(item[2].to_reference(skeleton.stamp_ns) - item[1]))
            reference_ns = nearest[2].to_reference(skeleton.stamp_ns)
        k = int(np.clip(np.searchsorted(true_ns, reference_ns), 1, len(truth) - 1))
        share = (reference_ns - true_ns[k - 1]) / (true_ns[k] - true_ns[k - 1])
        expected = (1 - share) * true_positions[k - 1] + share * true_positions[k]
        tracked = skeleton.states == TrackingState.TRACKED
        found = poses[sensor].apply(skeleton.positions)
        if ((left_right_axes(found) * left_right_axes(expected)).sum(axis=-1) > 0.0).all():
            errors.append(np.linalg.norm(found - expected, axis=1)[tracked])
    return np.concatenate(errors)


def test_true_poses_and_clocks_take_the_measurements_to_the_truth(tmp_path: Path) -> None:
    """Bring each sensor's joints into the world and its stamps into the reference clock: they meet the truth there."""
    write_bag(simulate(Setup("torso_twist", seconds=12.0, errors=KinectErrors.none())), tmp_path / "exact")
    for sensor in SENSORS:
        # interpolation between frames errs by up to an eighth of (1/30 s)^2 times an acceleration, here up to 40 m/s2
        assert errors_of(tmp_path / "exact", sensor).max() < 0.006


@pytest.mark.parametrize("name", some(tuple(SHIPPED)))
def test_the_shipped_bags_err_as_a_kinect_does(name: str) -> None:
    poses, clocks = poses_and_clocks(BAGS / name)
    assert set(poses) == set(SENSORS) and {sensor for sensor, _, _ in clocks} == {"kinect2"}
    for sensor in SENSORS:
        error = errors_of(BAGS / name, sensor)
        # 50 to 101 mm are reported of one Kinect v2 against markers, with the error of placing one in the other and the
        # offsets of one subject's arms, of which the simulated one has the errors of direction alone
        assert 0.035 < error.mean() < 0.101
        assert error.max() < 0.6  # a hidden arm reported next to the body


@cache
def made(name: str) -> SimulatedRecording:
    return simulate(shipped(name))


@pytest.mark.parametrize("name", some(tuple(SHIPPED)))
def test_the_second_clock_is_published_once_a_second(name: str) -> None:
    _, clocks = poses_and_clocks(BAGS / name)
    true = made(name).sensors[1].clock
    assert 0.0 < abs(true.offset_ns) < 2 * NANOSECONDS and 0.0 < abs(true.drift_ppm) < 50.0
    at_ns = np.array([valid_ns for _, valid_ns, _ in clocks])
    assert np.diff(at_ns) / NANOSECONDS == pytest.approx(1.0, abs=1.1 / RATE)
    for _, valid_ns, clock in clocks:
        assert clock.to_sensor(valid_ns) == pytest.approx(true.to_sensor(valid_ns), abs=1)
    offsets = np.array([clock.to_sensor(valid_ns) - valid_ns for _, valid_ns, clock in clocks], dtype=float)
    assert np.polyfit((at_ns - at_ns[0]).astype(float), offsets, 1)[0] * 1e6 == pytest.approx(true.drift_ppm, abs=0.01)


def test_a_twist_hides_the_far_arm_and_never_the_trunk() -> None:
    recording = simulate(replace(shipped("tpose_torso_twist"), errors=KinectErrors.none()))
    arms = [joint for joint in Joint if joint.name.split("_")[0] in ("ELBOW", "WRIST", "HAND")]
    for sensor in SENSORS:
        frames = [frame for frame in recording.frames if frame.sensor == sensor]
        hidden = np.array([frame.skeletons[0].states for frame in frames]) != TrackingState.TRACKED
        before = np.array([frame.received_ns for frame in frames]) < RECEIVED_FROM_NS + TPOSE_S * NANOSECONDS
        assert 0.01 < hidden[:, arms].mean() < 0.3
        assert not hidden[before].any() and not hidden[:, Joint.SPINE_MID].any()


# --- the command


def simulated(folder: Path, *arguments: str) -> Path:
    assert main(["simulate", "-o", str(folder), "--motion", "standing_still", "--seconds", "2", *arguments]) == 0
    return folder


def test_the_same_arguments_give_the_same_messages_and_another_seed_others(tmp_path: Path) -> None:
    arguments = ("--people", "2", "--imus", "hand_left", "--seed")
    seeds = {"a": "5", "b": "5", "c": "6"}
    a, b, c = (contents(simulated(tmp_path / name, *arguments, seed)) for name, seed in seeds.items())
    assert a == b and a != c


def test_all_options_take_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errors = tmp_path / "errors.yaml"
    errors.write_text(errors_as_yaml(KinectErrors(delay=0.5)), encoding="utf-8")
    folder = simulated(
        tmp_path / "bag",
        *("--around=0,120,-120", "--dark", "--config", str(errors)),
        *("--imus", "hand_left,pelvis", "--raw", "--no-magnetometer", "--imu-rate", "50"),
    )
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith(f"{folder}: standing_still, 2.0 s, ") and "inertial samples" in line
    clouds = dict.fromkeys(map(graph.skeleton_topic, ("kinect1", "kinect2", "kinect3")), POINT_CLOUD)
    inertial = dict.fromkeys(("/imu_hand_left/imu/data_raw", "/imu_pelvis/imu/data_raw"), IMU)
    assert types(folder) == TRUTHS | clouds | inertial
    assert len(read(folder, "/imu_pelvis/imu/data_raw")) <= 2 * 50
    assert len(read(folder, graph.TRUE_SKELETON)) == 2 * 15
    with BagReader(folder) as bag:
        first = next(iter(bag.messages([graph.skeleton_topic("kinect1")])))
    assert first.log_time_ns >= RECEIVED_FROM_NS + NANOSECONDS // 2
    places = np.stack([pose.translation for pose in poses_and_clocks(folder)[0].values()])
    apart = np.linalg.norm(places - places[[1, 2, 0]], axis=1)
    assert_allclose(apart, np.sqrt(3.0) * DISTANCE)  # an equilateral triangle round the person


def test_the_shipped_parameters_file_holds_all_errors_at_their_defaults() -> None:
    file = BAGS.parent / "config" / "simulator.yaml"
    assert read_errors(file) == KinectErrors()
    (section,) = yaml.safe_load(file.read_text(encoding="utf-8")).values()
    assert section["ros__parameters"].keys() == {item.name for item in parameters()}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--motion", "torso_twsit"), "did you mean 'torso_twist'?"),
        (("--motion", "hop"), "unknown motion 'hop', expected one of two_handed_wave, "),
        (("--layout", "10"), "layout 10: expected 1 to 9"),
        (("--around=1,x",), "--around 1,x: expected degrees, separated by commas"),
        (("--around=",), "--around : expected degrees"),
        (("--around=5,nan",), "layout: azimuths [5.0, nan] degrees, expected finite numbers"),
        (("--people", "0"), "0 people: expected 1 to 6"),
        (("--people", "7"), "7 people: expected 1 to 6"),
        (("--seconds", "2"), "torso_twist: 2.0 s, it takes "),
        (("--seconds", "nan"), "nan seconds"),
        (("--seed", "-1", "--imus", "pelvis"), "seed -1: must not be negative"),
        (("--imus", "nose"), "segment 'nose', expected one of pelvis, "),
        (("--imus", "pelvis,pelvis"), "--imus pelvis,pelvis: pelvis comes twice"),
        (("--imus", "pelvis", "--imus", "pelvis"), "--imus pelvis,pelvis: pelvis comes twice"),
        (("--imus", "pelvis", "--imu-rate", "0"), "a rate of 0.0 Hz"),
        (("--raw",), "--raw: is about inertial sensors, which --imus names"),
        (("--no-magnetometer", "--imus="), "--no-magnetometer: is about inertial sensors"),
        (("--config", "nowhere.yaml"), "body_tracking: nowhere.yaml: cannot be read"),
    ],
)
def test_impossible_simulations_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "-o", str(tmp_path / "bag"), *arguments]) == 2
    published = capsys.readouterr().err
    assert message in published and published.count("\n") == 1
    assert not (tmp_path / "bag").exists()


def test_a_bag_is_replaced_only_if_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = simulated(tmp_path / "bag")
    before = contents(folder)
    again = ["simulate", "-o", str(folder), "--motion", "standing_still", "--seconds", "2", "--seed", "1"]
    assert main(again) == 2
    published = capsys.readouterr().err
    assert published.count("\n") == 1 and str(folder) in published
    assert contents(folder) == before
    assert main([*again, "--overwrite"]) == 0
    assert contents(folder) != before
    assert main(["make-bags", "-o", str(tmp_path), "--seed", "-1"]) == 2
