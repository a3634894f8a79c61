"""Messages as CDR bytes: direct writing and reading equals that of the serialisers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.message_types import IMAGE, IMU
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import MAX_STAMP_NS, Skeleton
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.base import MessageError
from body_tracking.messages.cdr import decode_skeletons, encode_skeletons
from body_tracking.messages.imus import message_to_orientation, orientation_to_message
from body_tracking.messages.model import (
    covariance_to_image,
    estimate_to_joint_state,
    estimate_to_stddevs,
    image_to_covariance,
    joint_state_to_model,
)
from body_tracking.messages.skeletons import cloud_to_skeletons, skeletons_to_cloud
from body_tracking.recording.rosbag2 import BAG_MESSAGES, deserialize, serialize

MODEL = UpperBody()
CLOUD, STATES = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/JointState"
FRAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=30)
STAMPS = st.integers(0, MAX_STAMP_NS)


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


@example(334, 0, "", 2, 0)  # only the second body has a joint that is not seen
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
def test_other_bytes_are_not_decoded(data: bytes) -> None:
    assert decode_skeletons(data) is None


@given(st.integers(0, 2**32), st.integers(0, 2), st.data())
def test_damaged_message_is_decoded_like_the_serialiser_or_not_at_all(
    seed: int, kind: int, data: st.DataObject
) -> None:
    cdr = bytearray(encode_skeletons(skeletons(seed, 10**9, "world", 1, kind)))
    position = data.draw(st.integers(0, len(cdr) - 1))
    cdr[position] = data.draw(st.integers(0, 255))
    fast = decode_skeletons(bytes(cdr))
    if fast is not None:
        (slow,) = cloud_to_skeletons(deserialize(CLOUD, bytes(cdr)))
        assert_same(slow, fast[0])


def test_unterminated_name_is_not_decoded() -> None:
    cdr = bytearray(encode_skeletons(skeletons(0, 10**9, "world", 1, 0)))
    assert cdr[16:22] == b"world\0"
    cdr[21] = 1
    assert decode_skeletons(bytes(cdr)) is None


@given(st.integers(0, 2**32), st.integers(0, 2), st.integers(1, 60))
def test_truncated_message_is_not_decoded(seed: int, kind: int, missing: int) -> None:
    cdr = encode_skeletons(skeletons(seed, 10**9, "world", 1, kind))
    assert decode_skeletons(cdr[:-missing]) is None


def test_padding_bytes_are_ignored() -> None:
    """Fast CDR does not initialise padding."""
    serialization = pytest.importorskip("rclpy.serialization", reason="ROS is not installed")
    from body_tracking.messages.base import RosMessages

    for kind in (0, 1, 2):
        (body,) = skeletons(kind, 10**9, "world", 1, kind)
        for _ in range(20):
            decoded = decode_skeletons(serialization.serialize_message(skeletons_to_cloud([body], RosMessages())))
            assert decoded is not None
            assert_same(body, decoded[0])


# --- the state of a body model


def estimate(seed: int, stamp_ns: int = 10**9, frame_id: str = "world") -> ModelEstimate:
    """A random estimate."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(2, MODEL.nv, MODEL.nv))
    covariance = np.zeros((2 * MODEL.nv, 2 * MODEL.nv))
    covariance[: MODEL.nv, : MODEL.nv], covariance[MODEL.nv :, MODEL.nv :] = root @ root.transpose(0, 2, 1)
    covariance = covariance.astype(np.float32).astype(np.float64)
    q = MODEL.integrate(MODEL.neutral(), random.normal(size=MODEL.nv))
    lengths = MODEL.default_lengths()
    return ModelEstimate(stamp_ns, frame_id, 0, q, random.normal(size=MODEL.nv), covariance, lengths, 0.1 * lengths)


@given(st.integers(0, 2**32), STAMPS, FRAMES)
def test_a_model_state_and_its_uncertainty_survive_serialisation(seed: int, stamp_ns: int, frame_id: str) -> None:
    given_estimate = estimate(seed, stamp_ns, frame_id)
    cdr = serialize(estimate_to_joint_state(given_estimate, MODEL, BAG_MESSAGES))
    *header, q, velocity = joint_state_to_model(deserialize(STATES, cdr), MODEL)
    assert header == [stamp_ns, frame_id]
    np.testing.assert_allclose(MODEL.difference(given_estimate.q, q), 0.0, atol=1e-9)
    np.testing.assert_array_equal(velocity, given_estimate.velocity)
    deviations = deserialize(STATES, serialize(estimate_to_stddevs(given_estimate, MODEL, BAG_MESSAGES)))
    variances = np.square([*deviations.position, *deviations.velocity])
    np.testing.assert_allclose(variances, given_estimate.covariance.diagonal(), rtol=1e-12)
    cdr = serialize(covariance_to_image(given_estimate, BAG_MESSAGES))
    stamp, covariance = image_to_covariance(deserialize(IMAGE, cdr), MODEL)
    assert stamp == stamp_ns
    np.testing.assert_array_equal(covariance, given_estimate.covariance)


@given(st.integers(0, 2**32), STAMPS, FRAMES.filter(bool), st.booleans())
def test_an_orientation_survives_serialisation(seed: int, stamp_ns: int, frame_id: str, turning: bool) -> None:
    measurement = orientation(seed, stamp_ns, frame_id, turning)
    cdr = serialize(orientation_to_message(measurement, BAG_MESSAGES))
    read = message_to_orientation(deserialize(IMU, cdr), "head")
    assert (read.stamp_ns, read.frame_id, read.segment) == (stamp_ns, frame_id, "head")
    np.testing.assert_allclose(read.rotation, measurement.rotation, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(read.covariance, measurement.covariance)
    assert (read.angular_velocity is None) == (measurement.angular_velocity is None)


def orientation(seed: int, stamp_ns: int, frame_id: str, turning: bool) -> SegmentOrientation:
    """A random one of a head."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(3, 3))
    rotation = so3.quat_to_matrix(so3.exp(random.normal(size=3)))
    rate = {"angular_velocity": random.normal(size=3), "angular_velocity_variance": 1e-3} if turning else {}
    covariance = root @ root.T + 0.01 * np.eye(3)
    return SegmentOrientation(stamp_ns, "imu_head", "head", rotation, covariance, frame_id=frame_id, **rate)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("name", [*MODEL.coordinate_names[:-1], "nose"], "unknown name 'nose'"),
        ("name", list(reversed(MODEL.coordinate_names)), "32 names, or in another order"),
        ("position", np.zeros(31), "31 position values, expected 32"),
        ("velocity", np.zeros(0), "0 velocity values, expected 32"),
        ("position", np.full(32, np.nan), "position of base_x is nan"),
        ("velocity", np.full(32, -np.inf), "velocity of base_x is -inf"),
    ],
)
def test_invalid_model_state_is_refused(field: str, value: object, said: str) -> None:
    message = estimate_to_joint_state(estimate(0), MODEL, BAG_MESSAGES)
    setattr(message, field, value)
    with pytest.raises(MessageError, match=said):
        joint_state_to_model(message, MODEL)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("height", 32, "32 x 32 pixels of 32FC1"),
        ("width", 31, "covariance of 64 x 31, expected 64 x 32"),
        ("step", 64, "64 bytes a row"),
        ("data", np.zeros(100, np.uint8), "100 in all"),
        ("encoding", "64FC1", "encoding '64FC1', expected one of 32FC1"),
        ("data", np.full(64 * 32, np.nan, "<f4").view(np.uint8), "a covariance is NaN"),
        ("data", np.full(64 * 32, -1.0, "<f4").view(np.uint8), "a variance is negative"),
    ],
)
def test_invalid_covariance_is_refused(field: str, value: object, said: str) -> None:
    message = covariance_to_image(estimate(0), BAG_MESSAGES)
    setattr(message, field, value)
    with pytest.raises(MessageError, match=said):
        image_to_covariance(message, MODEL)
