"""Messages as CDR bytes: what is written and read directly is what the serialisers write and read."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.cdr import decode_skeletons, encode_angles, encode_skeletons
from body_tracking.kinematics.angles import JointAngles
from body_tracking.messages import angles_to_joint_states, cloud_to_skeletons, skeletons_to_cloud
from body_tracking.recording.rosbag2 import BAG_MESSAGES, deserialize, serialize
from body_tracking.skeleton import Skeleton

CLOUD, STATES = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/JointState"
FRAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=30)
STAMPS = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)


def skeletons(seed: int, stamp_ns: int, frame_id: str, count: int, kind: int) -> list[Skeleton]:
    """Random bodies; kind 0: as sensors see them, 1: with covariances, 2: and with velocities."""
    random = np.random.default_rng(seed)
    made = []
    for body in range(count):
        root = random.normal(size=(25, 3, 3))
        positions = random.normal(size=(25, 3)).astype(np.float32).astype(np.float64)
        positions[random.random(25) < 0.1] = np.nan
        covariances = (root @ root.transpose(0, 2, 1)).astype(np.float32).astype(np.float64) if kind else None
        velocities = random.normal(size=(25, 3)).astype(np.float32).astype(np.float64) if kind == 2 else None
        states = random.integers(0, 3, 25).astype(np.uint8)
        made.append(Skeleton(stamp_ns, frame_id, positions, states, 7 * body + 1, covariances, velocities))
    return made


def assert_same(left: Skeleton, right: Skeleton) -> None:
    assert (left.stamp_ns, left.frame_id, left.body) == (right.stamp_ns, right.frame_id, right.body)
    for name in ("positions", "states", "covariances", "velocities"):
        one, other = getattr(left, name), getattr(right, name)
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype


@given(st.integers(0, 2**32), STAMPS, FRAMES, st.integers(1, 6), st.integers(0, 2))
def test_skeletons_are_written_and_read_as_by_the_serialiser(
    seed: int, stamp_ns: int, frame_id: str, count: int, kind: int
) -> None:
    if kind:
        count = 1
    bodies = skeletons(seed, stamp_ns, frame_id, count, kind)
    cdr = encode_skeletons(bodies)
    assert cdr == serialize(skeletons_to_cloud(bodies, BAG_MESSAGES))
    decoded = decode_skeletons(cdr)
    assert decoded is not None
    for body, slow, fast in zip(bodies, cloud_to_skeletons(deserialize(CLOUD, cdr)), decoded, strict=True):
        assert_same(slow, fast)
        assert_same(body, fast)


@given(st.binary(max_size=200))
def test_other_bytes_are_left_to_others(data: bytes) -> None:
    assert decode_skeletons(data) is None


@given(st.integers(0, 2**32), st.integers(0, 2), st.data())
def test_a_damaged_message_is_read_as_by_the_serialiser_or_left_to_it(
    seed: int, kind: int, data: st.DataObject
) -> None:
    cdr = bytearray(encode_skeletons(skeletons(seed, 10**9, "world", 1, kind)))
    position = data.draw(st.integers(0, len(cdr) - 1))
    cdr[position] = data.draw(st.integers(0, 255))
    fast = decode_skeletons(bytes(cdr))
    if fast is not None:
        (slow,) = cloud_to_skeletons(deserialize(CLOUD, bytes(cdr)))
        assert_same(slow, fast[0])


@given(st.integers(0, 2**32), st.integers(0, 2), st.integers(1, 60))
def test_a_message_that_is_cut_off_is_left_to_others(seed: int, kind: int, missing: int) -> None:
    cdr = encode_skeletons(skeletons(seed, 10**9, "world", 1, kind))
    assert decode_skeletons(cdr[:-missing]) is None


def test_the_padding_may_hold_anything() -> None:
    """Fast CDR leaves in the padding what was in its buffer."""
    serialization = pytest.importorskip("rclpy.serialization", reason="ROS is not installed")
    from body_tracking.messages import RosMessages

    for kind in (0, 1, 2):
        (body,) = skeletons(kind, 10**9, "world", 1, kind)
        for _ in range(20):
            decoded = decode_skeletons(serialization.serialize_message(skeletons_to_cloud([body], RosMessages())))
            assert decoded is not None
            assert_same(body, decoded[0])


@given(st.integers(0, 2**32), STAMPS, FRAMES, st.integers(0, 20))
def test_angles_read_as_they_were_written(seed: int, stamp_ns: int, frame_id: str, count: int) -> None:
    random = np.random.default_rng(seed)
    names = tuple(f"angle_{'x' * index}" for index in range(count))
    values = random.normal(size=(4, count))
    values[random.random((4, count)) < 0.2] = np.inf
    angles = JointAngles(stamp_ns, names, *values)
    ours = encode_angles(angles, "body1", frame_id)
    for cdr, message in zip(ours, angles_to_joint_states(angles, "body1", frame_id, BAG_MESSAGES), strict=True):
        read = deserialize(STATES, cdr)
        assert read.header == message.header
        assert read.name == message.name
        np.testing.assert_array_equal(read.position, message.position)
        np.testing.assert_array_equal(read.velocity, message.velocity)
        assert len(read.effort) == 0


def test_ros_reads_angles_as_they_were_written() -> None:
    serialization = pytest.importorskip("rclpy.serialization", reason="ROS is not installed")
    from sensor_msgs.msg import JointState

    for frame_id in ("", "a", "ab", "abc", "abcd", "world"):
        for count in range(4):
            names = tuple("abcd"[:count])
            position, velocity, *stddev = np.arange(4.0 * count).reshape(4, count)
            angles = JointAngles(5, names, position, velocity, stddev[0], stddev[1])
            message = serialization.deserialize_message(encode_angles(angles, "b", frame_id)[0], JointState)
            assert message.name == [f"{name}_b" for name in names]
            assert list(message.position) == list(position)
            assert list(message.velocity) == list(velocity)
            assert message.header.frame_id == frame_id
