"""Inertial messages: what is written is what is read, in both families of classes, and REP-145's -1 is kept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from body_tracking.messages.base import MessageTypes, RosMessages
from body_tracking.messages.imus import message_to_magnetic_field, message_to_sample, sample_to_messages
from body_tracking.recording.rosbag2 import BAG_MESSAGES
from body_tracking.sensors.imu import ImuSample, ImuSampleError
from body_tracking.skeleton import FloatArray

vectors = st.none() | arrays(np.float64, 3, elements=st.floats(-40.0, 40.0))
fields = st.none() | arrays(np.float64, 3, elements=st.floats(-1e-4, 1e-4))
covariances = st.none() | st.floats(1e-6, 1.0).map(lambda variance: variance * np.eye(3))
oriented = st.tuples(st.just(np.array([0.5, -0.5, 0.5, 0.5])), covariances) | st.just((None, None))


def equal(a: FloatArray | None, b: FloatArray | None) -> bool:
    return a is b if a is None or b is None else bool(np.array_equal(a, b))


@pytest.mark.parametrize("family", ["ros", "bag"])
@given(st.integers(0, 2**60), oriented, vectors, vectors, fields)
def test_there_and_back(
    family: str,
    stamp_ns: int,
    orientation: tuple[FloatArray | None, FloatArray | None],
    rate: FloatArray | None,
    force: FloatArray | None,
    magnetic: FloatArray | None,
) -> None:
    types: MessageTypes = BAG_MESSAGES
    if family == "ros":
        pytest.importorskip("sensor_msgs.msg")
        types = RosMessages()
    sample = ImuSample(stamp_ns, "wrist_link", *orientation, rate, force, magnetic)
    imu, field = sample_to_messages(sample, types)
    back = message_to_sample(imu, None if field is None else message_to_magnetic_field(field)[2])
    for name in ImuSample.__slots__:
        if name in ("stamp_ns", "frame_id"):
            assert getattr(back, name) == getattr(sample, name)
        else:
            assert equal(getattr(back, name), getattr(sample, name)), name
    if sample.orientation is None:
        assert imu.orientation_covariance[0] == -1.0


def zero_quaternion() -> Any:
    imu, _ = sample_to_messages(ImuSample(0, "wrist_link", orientation=np.array([0.0, 0.0, 0.0, 1.0])), BAG_MESSAGES)
    imu.orientation.w = 0.0
    return imu


def test_a_zero_quaternion_is_none_only_if_it_says_so() -> None:
    message = zero_quaternion()
    with pytest.raises(ImuSampleError, match="zero quaternion"):
        message_to_sample(message)
    message.orientation_covariance[0] = -1.0
    assert message_to_sample(message).orientation is None
